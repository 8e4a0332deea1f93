"""Which similarity takes camera centres to measured positions of known covariance? Some of them may be wrong.

Least median of squares over triples, then Gauss-Newton on those that fit (7 parameters), with the covariances as
weights. Cameras on a line fix no turn about it: that direction is left out, and nothing that is tested depends on it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from sfm_audit.audit.alignment.similarity import Similarity
from sfm_audit.loaders.arrays import BoolArray, FloatArray

MIN_POSITIONS: Final = 6
NUM_PARAMETERS: Final = 7
CHI2_3_MEDIAN: Final = 2.3659738843753377
"""Median of chi^2 with 3 degrees of freedom (scipy.stats.chi2.ppf(0.5, 3))."""
CUT: Final = 16.266236196238129
"""Its 99.9 % point: positions above it take no part in the fit."""
_NUM_TRIPLES: Final = 300
_NUM_STEPS: Final = 20
_SINGULAR: Final = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class PositionAlignment:
    """A similarity from the model's world to that of the positions, and what it leaves.

    residual: (n, 3) position - moved centre.    chi2: (n,) of the residual under its own covariance, the fit's share
    taken into account: chi^2 with 3 degrees of freedom where the covariances are true.
    whitened: (n, 3) the residuals in units of their standard deviations.
    spread: robust sd of the residuals / what the covariances say.    sd_scale: of the scale, if they are true.
    fitted: (n,) which positions took part.
    """

    similarity: Similarity
    residual: FloatArray
    chi2: FloatArray
    whitened: FloatArray
    spread: float
    sd_scale: float
    fitted: BoolArray


def align_positions(
    centre: FloatArray, position: FloatArray, covariance: FloatArray, *, min_spread: float = 1.0, cut: float = CUT
) -> PositionAlignment | None:
    """Find the similarity that most positions follow.

    Parameters
    ----------
    centre : (n, 3) of the cameras, model units    position : (n, 3) measured    covariance : (n, 3, 3) of them
    min_spread : the least that positions are taken to scatter, in units of their covariances: 1 where these are said,
        0 where only their shares of each other are known
    cut : squared distance in units of the spread above which a position takes no part in the fit

    Returns
    -------
    PositionAlignment
        None with fewer than `MIN_POSITIONS`, where centres or positions lie in one place, or covariances are singular.

    Notes
    -----
    Residuals of positions in the fit have covariance S - J C J^T, of the others S + J C J^T, with S the covariance of
    the position, J the derivative of the moved centre in the 7 parameters and C = (sum J^T S^-1 J)^-1.
    """
    if len(centre) < MIN_POSITIONS:
        return None
    with np.errstate(all="ignore"):
        try:
            weight: FloatArray = np.linalg.inv(covariance).astype(np.float64)
        except np.linalg.LinAlgError:
            return None
        start = _least_median(centre, position, weight, np.random.default_rng(0))
        if start is None or not np.isfinite(weight).all():
            return None
        similarity, fitted = start, _fitting(start, centre, position, weight, (min_spread, cut))
        for _ in range(_NUM_STEPS):
            step = _step(similarity, centre[fitted], position[fitted], weight[fitted])
            if step is None:
                return None
            similarity = _moved(similarity, step)
            before, fitted = fitted, _fitting(similarity, centre, position, weight, (min_spread, cut))
            if (fitted == before).all() and np.abs(step).max() < 1e-9:
                break
        return _told(similarity, centre, position, covariance, fitted)


def _fitting(
    similarity: Similarity, centre: FloatArray, position: FloatArray, weight: FloatArray, limits: tuple[float, float]
) -> BoolArray:
    """Which positions are near enough, in units of their own spread; limits: its least value, and the cut."""
    chi2 = _chi2(position - similarity.points(centre), weight)
    degrees = 3 * len(centre)
    unit = float(np.median(chi2)) / CHI2_3_MEDIAN * degrees / (degrees - NUM_PARAMETERS)  # the fit took its share
    unit = max(unit, limits[0] ** 2, np.finfo(float).tiny)
    fitting: BoolArray = chi2 <= limits[1] * unit
    return fitting


def _chi2(residual: FloatArray, weight: FloatArray) -> FloatArray:
    chi2: FloatArray = np.einsum("ni,nij,nj->n", residual, weight, residual)
    return chi2


def _least_median(
    centre: FloatArray, position: FloatArray, weight: FloatArray, rng: np.random.Generator
) -> Similarity | None:
    """Return the similarity of the triple about which the median of all squared distances is least."""
    rows = np.argpartition(rng.random((_NUM_TRIPLES, len(centre))), 3, axis=1)[:, :3]
    scale, rotation, shift = _similarities(centre[rows], position[rows])
    usable = (scale > 0) & np.isfinite(scale) & np.isfinite(shift).all(axis=1)
    if not usable.any():
        return None
    scale, rotation, shift = scale[usable], rotation[usable], shift[usable]
    moved = np.einsum("k,kij,nj->kni", scale, rotation, centre) + shift[:, None]
    residual = position - moved
    chi2 = np.einsum("kni,nij,knj->kn", residual, weight, residual, optimize=True)
    cost = np.median(chi2, axis=1)
    if not np.isfinite(cost).any():
        return None
    best = int(np.nanargmin(np.where(np.isfinite(cost), cost, np.nan)))
    return Similarity(float(scale[best]), rotation[best], shift[best])


def _similarities(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Least squares of y (k, m, 3) about scale rotation x + shift, k times (Umeyama 1991); scale NaN or 0 without."""
    middle, other = x.mean(axis=1), y.mean(axis=1)
    a, b = x - middle[:, None], y - other[:, None]
    spread = (a**2).sum(axis=(1, 2))
    product = np.einsum("kmi,kmj->kij", b, a)
    left, values, right = np.linalg.svd(np.where(np.isfinite(product), product, 0.0))
    signs = np.ones((len(x), 3))
    signs[:, 2] = np.sign(np.linalg.det(left @ right))
    rotation: FloatArray = np.einsum("kij,kj,kjl->kil", left, signs, right)
    scale: FloatArray = (values * signs).sum(axis=1) / spread
    return scale, rotation, other - scale[:, None] * np.einsum("kij,kj->ki", rotation, middle)


def _jacobian(similarity: Similarity, centre: FloatArray) -> FloatArray:
    """(n, 3, 7): derivative of the moved centre in turn (left), logarithm of the scale, and shift."""
    turned = similarity.scale * centre @ similarity.rotation.T
    out = np.zeros((len(centre), 3, NUM_PARAMETERS))
    out[:, 0, 1], out[:, 0, 2] = turned[:, 2], -turned[:, 1]
    out[:, 1, 0], out[:, 1, 2] = -turned[:, 2], turned[:, 0]
    out[:, 2, 0], out[:, 2, 1] = turned[:, 1], -turned[:, 0]
    out[:, :, 3] = turned
    out[:, :, 4:] = np.eye(3)
    return out


def _inverse(jacobian: FloatArray, weight: FloatArray) -> FloatArray:
    """(7, 7) inverse of the normal matrix, without directions that nothing fixes."""
    normal = np.einsum("nia,nij,njb->ab", jacobian, weight, jacobian)
    size = np.sqrt(np.maximum(np.diag(normal), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(normal / size[:, None] / size)
    kept = values > _SINGULAR * values[-1]
    inverse: FloatArray = (vectors[:, kept] / values[kept]) @ vectors[:, kept].T / size[:, None] / size
    return inverse


def _step(similarity: Similarity, centre: FloatArray, position: FloatArray, weight: FloatArray) -> FloatArray | None:
    """(7,) Gauss-Newton step about the mean of the centres, so that turn and shift do not mix."""
    jacobian = _jacobian(similarity, centre - centre.mean(axis=0))
    gradient = np.einsum("nia,nij,nj->a", jacobian, weight, position - similarity.points(centre))
    if not np.isfinite(jacobian).all() or not np.isfinite(gradient).all():
        return None
    step: FloatArray = _inverse(jacobian, weight) @ gradient
    about = similarity.scale * similarity.rotation @ centre.mean(axis=0)  # back to a turn about the origin
    step[4:] -= np.cross(step[:3], about) + step[3] * about
    return step if np.isfinite(step).all() else None


def _moved(similarity: Similarity, step: FloatArray) -> Similarity:
    x, y, z = step[:3]
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    left, _, right = np.linalg.svd(np.eye(3) + cross + 0.5 * cross @ cross)
    scale = similarity.scale * float(np.exp(np.clip(step[3], -1.0, 1.0)))
    return Similarity(scale, left @ right @ similarity.rotation, similarity.shift + step[4:])


def _told(
    similarity: Similarity, centre: FloatArray, position: FloatArray, covariance: FloatArray, fitted: BoolArray
) -> PositionAlignment | None:
    jacobian = _jacobian(similarity, centre - centre[fitted].mean(axis=0))
    inverse = _inverse(jacobian[fitted], np.linalg.inv(covariance[fitted]).astype(np.float64))
    of_fit = np.einsum("nia,ab,njb->nij", jacobian, inverse, jacobian)
    own = covariance + np.where(fitted, -1.0, 1.0)[:, None, None] * of_fit
    residual = position - similarity.points(centre)
    values, vectors = np.linalg.eigh(0.5 * (own + own.transpose(0, 2, 1)))
    largest = np.linalg.eigvalsh(covariance)[:, -1:]
    seen = values > _SINGULAR * largest  # a position that the fit follows altogether says nothing in that direction
    whitened = np.einsum("nji,nj->ni", vectors, residual) / np.sqrt(np.where(seen, values, np.inf))
    whitened = np.einsum("nij,nj->ni", vectors, whitened)
    chi2 = np.where(seen.all(axis=1), (whitened**2).sum(axis=1), np.nan)
    if not np.isfinite(chi2).any():
        return None
    spread = float(np.sqrt(np.nanmedian(chi2) / CHI2_3_MEDIAN))
    sd_scale = similarity.scale * float(np.sqrt(inverse[3, 3]))
    return PositionAlignment(similarity, residual, chi2, whitened, spread, sd_scale, fitted)


def common_covariance(alignment: PositionAlignment) -> tuple[FloatArray, float]:
    """Return the covariance (3, 3) of the residuals in the fit, alike for all positions, and its degrees of freedom."""
    residual = alignment.residual[alignment.fitted]
    degrees = len(residual) - NUM_PARAMETERS / 3
    covariance: FloatArray = residual.T @ residual / degrees
    return covariance, degrees
