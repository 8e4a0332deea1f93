"""How well do the image's own observations pin down its camera? (method.md section 6).

Everything here is *conditional on the points*: the 3D points are taken as known exactly. In a reconstruction they are
not, so these standard deviations are lower bounds (about 2.7 times too small in the focal length, method.md).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, lru_cache, partial
from typing import Final, NamedTuple

import numpy as np

from sfm_audit.audit.misfit.in_parts import ColumnSums
from sfm_audit.audit.table.thresholds import SINGULAR_SHARE
from sfm_audit.loaders.arrays import FloatArray, IntArray
from sfm_audit.loaders.camera_models import CameraModel
from sfm_audit.loaders.model import CameraRecord

POSE_NAMES: Final = ("rotation_x", "rotation_y", "rotation_z", "translation_x", "translation_y", "translation_z")
_SMALLEST_PIVOT: Final = 1e-10  # of the Gram matrix of unit columns: below it the singular values are taken exactly


@cache
def fitted_names(model: CameraModel) -> tuple[str, ...]:
    """Names of the columns of method.md section 5's N: the pose, then all intrinsics but the principal point.

    Rotations in rad, translations in model units, both applied in the camera frame; spherical models: the pose only.
    """
    if model.is_spherical:
        return POSE_NAMES
    fixed = {model.param_names[i] for i in model.principal_point_idxs}
    return POSE_NAMES + tuple(name for name in model.param_names if name not in fixed)


@dataclass(frozen=True, slots=True, eq=False)
class ParameterCovariance:
    """Covariance of q fitted parameters, conditional on the points.

    names: (q,) the parameters; those without any effect on the observations (zero columns) are not among them.
    covariance: (q, q) in the units of the parameters; NaN where the parameters cannot be told apart or the noise is
    unknown.    singular_share: smallest / largest singular value of the unit columns; NaN without columns.
    """

    names: tuple[str, ...]
    covariance: FloatArray
    singular_share: float

    @property
    def is_singular(self) -> bool:
        """Whether some combination of the parameters leaves all predictions where they are."""
        return self.singular_share <= SINGULAR_SHARE

    @property
    def sd(self) -> FloatArray:
        """(q,) standard deviations."""
        return np.sqrt(self.covariance.diagonal())

    @property
    def correlation(self) -> FloatArray:
        """(q, q) correlation matrix, 1 on the diagonal; NaN where the covariance is."""
        sd = self.sd
        return self.covariance / (sd[:, None] * sd)

    def sd_of(self, name: str) -> float:
        """Standard deviation of one parameter; NaN when it has no effect on the observations."""
        return float(self.sd[self.names.index(name)]) if name in self.names else math.nan


def parameter_covariance(columns: FloatArray, names: tuple[str, ...], sigma_px: float) -> ParameterCovariance:
    """Return (N^T W N)^-1 with W = 1 / sigma^2, conditional on the points.

    Parameters
    ----------
    columns : (q, 2, n) or (q, m)    N, px per unit of each parameter, as of ``audit.misfit.nuisance``
    names : (q,)                     what the columns are, see `fitted_names`
    sigma_px : noise per axis, px: sigma_constant_px, of all inliers

    Raises
    ------
    ValueError
        when names and columns differ in number.

    Notes
    -----
    method.md section 6. Zero columns are dropped, the others scaled to unit length. The Gram matrix decides where its
    smallest Cholesky pivot is well above rounding; elsewhere the singular values come from the columns themselves.
    Derivatives that are not finite, or no observations, leave everything NaN.
    """
    flat = columns.reshape(len(columns), -1)
    if len(names) != len(flat):
        raise ValueError(f"{len(flat)} columns but {len(names)} names")
    with np.errstate(over="ignore", invalid="ignore"):
        gram = flat @ flat.T
    sigma, num_values = np.array([sigma_px]), np.array([flat.shape[1]])
    return covariances_of_grams(gram[None], names, sigma, num_values, lambda _, norms: unit_triangle(flat, norms))[0]


def unit_triangle(columns: FloatArray, norms: FloatArray) -> FloatArray:
    """Return R of a QR of columns (q, m), those that are not zero, scaled to unit length."""
    used = np.flatnonzero(norms != 0.0)
    return np.asarray(np.linalg.qr((columns[used] / norms[used, None]).T, mode="r"))


def covariances_of_grams(
    grams: FloatArray,
    names: tuple[str, ...],
    sigma_px: FloatArray,
    num_values: IntArray,
    triangle_of: Callable[[int, FloatArray], FloatArray],
) -> list[ParameterCovariance]:
    """Return `parameter_covariance` of each of B images from the Gram matrices (B, q, q) of their columns.

    Parameters
    ----------
    sigma_px : (B,) noise per axis        num_values : (B,) of every column
    triangle_of : gives `unit_triangle` of the b-th image's columns, given their lengths (q,); asked where the Gram
        matrix leaves doubts
    """
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        norms = np.sqrt(np.einsum("bcc->bc", grams))
        usual = (np.isfinite(norms) & (norms != 0.0)).all(axis=1) & (len(names) <= num_values)
        chosen = np.flatnonzero(usual)
        own = norms[chosen]
        values, vectors = np.linalg.eigh(grams[chosen] / own[:, :, None] / own[:, None])
        share = np.sqrt(np.maximum(values[:, 0] / values[:, -1], 0.0))
        sure = (values[:, 0] > _SMALLEST_PIVOT * values[:, -1]) & (share > SINGULAR_SHARE)
        root = vectors / np.sqrt(values)[:, None] * (sigma_px[chosen, None] / own)[:, :, None]
        covariance = root @ root.swapaxes(1, 2)
    solved = {b: k for k, b in enumerate(chosen.tolist()) if sure[k]}
    shares = share.tolist()
    out = []
    for b, gram in enumerate(grams):
        if b in solved:
            out.append(ParameterCovariance(names, covariance[solved[b]], shares[solved[b]]))
        else:
            sums = _unit_sums(gram, norms[b], int(num_values[b]))
            out.append(covariance_of_sums(names, sums, float(sigma_px[b]), partial(triangle_of, b, norms[b])))
    return out


def _unit_sums(gram: FloatArray, norms: FloatArray, num_values: int) -> ColumnSums:
    """Leave out columns that are zero, scale the others to unit length."""
    used = np.flatnonzero(norms != 0.0)
    with np.errstate(over="ignore", invalid="ignore"):
        return ColumnSums(norms, gram[np.ix_(used, used)] / norms[used] / norms[used, None], num_values)


def covariance_of_sums(
    names: tuple[str, ...], sums: ColumnSums, sigma_px: float, triangle: Callable[[], FloatArray]
) -> ParameterCovariance:
    """Return `parameter_covariance` from what the columns add up to.

    Parameters
    ----------
    triangle : gives R of a QR of the unit columns that are not zero; asked where their Gram matrix leaves doubts
    """
    norms = sums.norms
    if len(names) != len(norms):
        raise ValueError(f"{len(norms)} columns but {len(names)} names")
    used = np.flatnonzero(norms != 0.0)
    if used.size < len(norms):
        norms, names = norms[used], tuple(names[i] for i in used)
    if not names or not np.isfinite(norms).all():
        return ParameterCovariance(names, np.full((len(names),) * 2, np.nan), math.nan)
    inverse_root, share = _inverse_root(sums, triangle)
    if share <= SINGULAR_SHARE:
        return ParameterCovariance(names, np.full((len(names),) * 2, np.nan), share)
    inverse_root *= sigma_px / norms[:, None]
    return ParameterCovariance(names, inverse_root @ inverse_root.T, share)


def _inverse_root(sums: ColumnSums, triangle: Callable[[], FloatArray]) -> tuple[FloatArray, float]:
    """Return R, (q, q), with R R^T = (U U^T)^-1 for unit columns U (q, m), and smallest / largest singular value."""
    if len(sums.gram) > sums.num_values:
        return np.full((len(sums.gram),) * 2, np.nan), 0.0
    values, vectors = np.linalg.eigh(sums.gram)
    if values[0] <= _SMALLEST_PIVOT * values[-1]:
        _, singular, rows = np.linalg.svd(triangle())
        values, vectors = singular[::-1] ** 2, rows[::-1].T
    share = math.sqrt(max(float(values[0] / values[-1]), 0.0))
    if share <= SINGULAR_SHARE:
        return np.full_like(vectors, np.nan), share
    return np.asarray(vectors / np.sqrt(values)), share


@dataclass(frozen=True, slots=True, eq=False)
class Identifiability:
    """What the observations of an image say about its intrinsics, conditional on the points.

    parameters: all fitted parameters with their covariance.
    sd_focal_px: of the first focal length, px.    sd_focal_rel: largest sd_f / |f|.
    sd_k1: of the first distortion parameter.    k1: its value.    NaN where the camera has none, or where singular.
    has_focal, has_k1: whether the camera has such a parameter (panoramas have no focal length).
    """

    parameters: ParameterCovariance
    sd_focal_px: float
    sd_focal_rel: float
    sd_k1: float
    k1: float
    has_focal: bool
    has_k1: bool

    def k1_identified(self, num_sds: float = 2.0) -> bool | None:
        """Whether |k1| is at least ``num_sds`` of its standard deviations; None for cameras without distortion.

        The first distortion parameter is meant, whatever it is called (k, k1, k0, omega, alpha). Where its standard
        deviation is unknown (no effect on any observation, or singular) it is not identified.
        """
        return abs(self.k1) >= num_sds * self.sd_k1 if self.has_k1 else None


def identifiability(camera: CameraRecord, columns: FloatArray, sigma_px: float) -> Identifiability:
    """Summarise the covariance of an image's camera parameters, conditional on the points.

    Parameters
    ----------
    camera : the camera of the image
    columns : (6 + k, 2, n) or (6 + k, m)    N of `fitted_names`, px per unit
    sigma_px : sigma_constant_px, px

    Notes
    -----
    method.md section 6; of a camera shared by many images this is what *one* image says.
    """
    return identifiability_of(camera, parameter_covariance(columns, fitted_names(camera.model), sigma_px))


def identifiability_of(camera: CameraRecord, parameters: ParameterCovariance) -> Identifiability:
    """Return the same from the covariance of the parameters of `fitted_names`."""
    sd = np.sqrt(parameters.covariance.diagonal()).tolist()
    places, params = _places_of(camera.model, parameters.names), camera.params
    of_focals = [math.nan if k is None else sd[k] for k in places.focals]
    focals = [float(params[i]) for i in camera.model.focal_idxs]
    relative = [own / abs(focal) if focal else math.nan for own, focal in zip(of_focals, focals, strict=True)]
    extra = camera.model.extra_idxs
    return Identifiability(
        parameters,
        of_focals[0] if focals else math.nan,
        math.nan if not relative or any(map(math.isnan, relative)) else max(relative),
        math.nan if places.k1 is None else sd[places.k1],
        float(params[extra[0]]) if extra else math.nan,
        has_focal=bool(focals),
        has_k1=bool(extra),
    )


class _Places(NamedTuple):
    """Where focal lengths and the first distortion parameter are among fitted parameters; None where they are not."""

    focals: tuple[int | None, ...]
    k1: int | None


@lru_cache(maxsize=256)
def _places_of(model: CameraModel, names: tuple[str, ...]) -> _Places:
    def place(idx: int) -> int | None:
        name = model.param_names[idx]
        return names.index(name) if name in names else None

    extra = model.extra_idxs
    return _Places(tuple(map(place, model.focal_idxs)), place(extra[0]) if extra else None)
