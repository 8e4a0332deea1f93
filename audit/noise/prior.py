"""How do the variances of tracks scatter over a model? Maximum likelihood (method.md section 3b, (4))."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np

from sfm_audit.audit.kernels.tracks import PriorGroups
from sfm_audit.audit.noise.others import ByRow
from sfm_audit.audit.noise.tracks import TrackStatistics
from sfm_audit.loaders.arrays import BoolArray, FloatArray, Int32Array, IntArray

MIN_OBSERVATIONS = 20
NU0_RANGE = (0.1, 1e4)
_CHUNK = 1 << 15
_MANY = 20_000  # observations, of which some say where to begin
_MAX_ITERATIONS = 60
_MAX_RADIUS = 2.0  # of a step in (ln nu0, ln s0^2)
_CONVERGED_NATS = 1e-8  # predicted gain of the last step, which is still taken


_Sums = Callable[[float, float], FloatArray]
"""From nu0 and P to the log likelihood and its derivatives by nu0, P, nu0 nu0, nu0 P, P P: (6,)."""
_IN_RANGE = (1e-140, 1e140)  # of P and of sums of squares for the compiled sums


@dataclass(frozen=True, slots=True)
class TrackPrior:
    """How track variances scatter over a model: s0^2 nu0 / chi^2(nu0); NaN where it could not be fitted.

    converged: whether (nu0, s0) is a maximum of the likelihood, possibly at a bound of nu0.
    """

    nu0: float
    s0_px: float
    converged: bool


def fit_track_prior(sq_px2: FloatArray, other_sq_px2: FloatArray, other_dof: Int32Array | IntArray) -> TrackPrior:
    """Fit (nu0, s0) by maximum likelihood over all verified observations of a model.

    Parameters
    ----------
    sq_px2 : (m,) q = |e_k|^2          other_sq_px2 : (m,) c = nu_k a_k^2 of (3)          other_dof : (m,) nu_k

    Returns
    -------
    TrackPrior
        NaN with fewer than 20 observations, where all residuals are zero, and where their sums or the likelihood
        are not finite; 0.1 <= nu0 <= 1e4.

    Notes
    -----
    With P = nu0 s0^2, B = P + c and nu = nu0 + nu_k the log likelihood of method.md (4) is
    sum ln nu + nu / 2 ln B - (nu / 2 + 1) ln(B + q): two logarithms an observation, and a 2 x 2 Hessian in closed
    form. Newton in (ln nu0, ln s0^2) from a coarse grid, first on a systematic subsample (`_maximise`).
    """
    with np.errstate(over="ignore"):
        total_sq_px2 = float(sq_px2.sum() + other_sq_px2.sum())
    if sq_px2.size < MIN_OBSERVATIONS or not sq_px2.any() or not math.isfinite(total_sq_px2):
        return TrackPrior(math.nan, math.nan, converged=False)
    stride = max(1, sq_px2.size // _MANY)
    sample = sq_px2[::stride], other_sq_px2[::stride], other_dof[::stride]
    return _fit(sample, sq_px2.size, lambda: _sums_of(sq_px2, other_sq_px2, other_dof))


def fit_prior_of_tracks(tracks: TrackStatistics, used: BoolArray) -> TrackPrior:
    """`fit_track_prior` of the observations that are used (n,), all verified, with few arrays of their size."""
    num_used = int(np.count_nonzero(used))
    if num_used < MIN_OBSERVATIONS:
        return _fit_few(tracks, used)
    groups, pieces = PriorGroups.of(tracks.whitened_px, tracks.others, used), _Pieces(tracks, used)
    own_sq_px2, total_sq_px2 = pieces.sums_of_squares() if groups is None else groups.sums_of_squares()
    if not (0.0 < own_sq_px2 < _IN_RANGE[1] and total_sq_px2 < _IN_RANGE[1]):
        return _fit_few(tracks, used)
    rows = _every(used, max(1, num_used // _MANY))
    sq_px2 = (tracks.whitened_px[:, rows] ** 2).sum(axis=0)
    other_sq_px2, dof = tracks.others.of(rows)
    sums = pieces.sums if groups is None else partial(_sums_by_group, groups)
    return _fit((sq_px2, other_sq_px2, dof), num_used, lambda: sums)


def _fit_few(tracks: TrackStatistics, used: BoolArray) -> TrackPrior:
    """`fit_track_prior` of few observations, or of some that are out of range."""
    sq_px2 = (tracks.whitened_px.compress(used, axis=1) ** 2).sum(axis=0)
    other_sq_px2, other_dof = tracks.others.of(np.flatnonzero(used))
    return fit_track_prior(sq_px2, other_sq_px2, other_dof)


def _every(used: BoolArray, stride: int) -> IntArray:
    """Every stride-th of the rows (n,) that are used."""
    found, num_before = [np.empty(0, dtype=np.int64)], 0
    for start in range(0, used.size, _CHUNK):
        rows = np.flatnonzero(used[start : start + _CHUNK])
        found.append(start + rows[-num_before % stride :: stride])
        num_before += rows.size
    return np.concatenate(found)


@dataclass(frozen=True, slots=True, eq=False)
class _Pieces:
    """Tracks, of which some observations are used (n,), a piece at a time."""

    tracks: TrackStatistics
    used: BoolArray

    def __iter__(self) -> Iterator[tuple[FloatArray, FloatArray, FloatArray]]:
        """Yield q, c and degrees of freedom."""
        for start in range(0, self.used.size, _CHUNK):
            part = slice(start, start + _CHUNK)
            used = self.used[part]
            x, y = self.tracks.whitened_px[:, part].compress(used, axis=1)
            sq = x * x
            sq += y * y
            other_sq, dof = self.tracks.others.of(part)
            yield sq, other_sq.compress(used), dof.compress(used).astype(np.float64)

    def sums_of_squares(self) -> tuple[float, float]:
        """Sums of q and of c."""
        own, other = zip(*((float(sq.sum()), float(other_sq.sum())) for sq, other_sq, _ in self), strict=True)
        return sum(own), sum(other)

    def sums(self, nu0: float, prior_sq: float) -> FloatArray:
        """`_sums` of all pieces."""
        return np.asarray(sum(_sums(nu0, prior_sq, *piece) for piece in self))


_Sample = tuple[FloatArray, FloatArray, Int32Array | IntArray]
"""q, c and degrees of freedom of some observations."""


def _fit(sample: _Sample, num_observations: int, sums_of_all: Callable[[], _Sums]) -> TrackPrior:
    """Climb on the sample, and then on all where the sample is not all."""
    grid = [
        np.array([math.log(nu0), math.log(s0_sq)])
        for s0_sq in _scale_grid(*sample)
        for nu0 in (0.3, 1.0, 3.0, 10.0, 100.0)
    ]
    sums = _sums_of(*sample)
    best = max(grid, key=lambda x: _log_likelihood(x, sums).value)
    found = _maximise(best, sums, sample[0].size)
    if sample[0].size < num_observations:
        found = _maximise(found.x, sums_of_all(), num_observations)
    if not math.isfinite(found.value):
        return TrackPrior(math.nan, math.nan, converged=False)
    return TrackPrior(math.exp(found.x[0]), math.exp(0.5 * found.x[1]), found.converged)


def _scale_grid(sq: FloatArray, other_sq: FloatArray, dof: Int32Array | IntArray) -> list[float]:
    """Plausible s0^2: around the pooled variance per degree of freedom and the median of |e|^2 / 2."""
    centre = max(float(np.median(sq)) / (2.0 * math.log(2.0)), np.finfo(np.float64).tiny)
    pooled = max(float((sq + other_sq).sum() / (dof + 2.0).sum()), centre)
    return [centre * 0.3, centre, pooled]


@dataclass(frozen=True, slots=True, eq=False)
class _Likelihood:
    """Log likelihood (nats) at a point, gradient (2,) and Hessian (2, 2) in x = (ln nu0, ln s0^2)."""

    value: float
    gradient: FloatArray
    hessian: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class _Maximum:
    """Where the ascent ended, x (2,), the log likelihood there before the last step, and whether it is a maximum."""

    x: FloatArray
    value: float
    converged: bool


def _maximise(start: FloatArray, sums: _Sums, num_observations: int) -> _Maximum:
    """Newton ascent within a trust radius in x = (ln nu0, ln s0^2).

    Notes
    -----
    Towards equal tracks (nu0 to infinity) the likelihood levels off along a ridge of constant s0, where its Hessian is
    indefinite; in these coordinates the ridge follows an axis, and `_ascent_step` goes along it. A step that gains less
    than a tenth of what the quadratic predicts is not taken, and the radius shrinks.
    """
    low, high = math.log(NU0_RANGE[0]), math.log(NU0_RANGE[1])
    x, here, radius = start, _log_likelihood(start, sums), _MAX_RADIUS
    for _ in range(_MAX_ITERATIONS):
        if not np.isfinite(here.hessian).all():
            return _Maximum(x, math.nan, converged=False)
        held = (x[0] <= low and here.gradient[0] < 0) or (x[0] >= high and here.gradient[0] > 0)
        step, gain, concave = _ascent_step(here.gradient, here.hessian, hold_first=held)
        if concave and gain <= _CONVERGED_NATS:
            return _Maximum(_on_range(x + step), here.value, converged=True)
        length = max(math.hypot(*step), 1e-300)
        trial = _on_range(x + step * min(1.0, radius / length))
        there = _log_likelihood(trial, sums)
        moved = trial - x
        predicted = float(here.gradient @ moved + 0.5 * moved @ here.hessian @ moved)
        rounding = 1e-13 * (abs(here.value) + num_observations)
        if there.value - here.value >= 0.1 * max(predicted, 0.0) - rounding:
            x, here = trial, there
            radius = min(2.0 * radius, _MAX_RADIUS)
        else:  # also where the likelihood is not finite
            radius = 0.25 * min(radius, length)
    return _Maximum(x, here.value, converged=False)


def _on_range(x: FloatArray) -> FloatArray:
    """Return the nearest x whose nu0 is in its range; s0 stays."""
    return np.array([min(max(x[0], math.log(NU0_RANGE[0])), math.log(NU0_RANGE[1])), x[1]])


def _ascent_step(gradient: FloatArray, hessian: FloatArray, *, hold_first: bool) -> tuple[FloatArray, float, bool]:
    """Return Newton's step with the eigenvalues' absolute values, its gain (nats), and whether the Hessian is negative.

    Where the Hessian is negative definite this is Newton's step; along a direction of positive curvature it goes
    uphill, away from the saddle, as far as the curvature's scale says.
    """
    free = slice(1, 2) if hold_first else slice(0, 2)
    curvature, axes = np.linalg.eigh(hessian[free, free])
    scale = np.maximum(np.abs(curvature), 1e-12 * max(float(np.abs(hessian).max()), 1e-300))
    along = axes.T @ gradient[free]
    step = np.zeros(2)
    step[free] = axes @ (along / scale)
    return step, 0.5 * float(along @ (along / scale)), bool((curvature < 0).all())


def _log_likelihood(x: FloatArray, sums: _Sums) -> _Likelihood:
    """Log likelihood of (4) with its derivatives at x = (ln nu0, ln s0^2)."""
    nu0, prior_sq = math.exp(x[0]), math.exp(x[0] + x[1])
    with np.errstate(all="ignore"):  # not finite where tracks without residuals pull s0 to 0: no step goes there
        value, d_nu, d_p, d_nu_nu, d_nu_p, d_p_p = sums(nu0, prior_sq)
        first, second = d_nu * nu0, d_p * prior_sq  # by ln nu0, ln P; then by ln nu0, ln s0^2 = ln P - ln nu0
        mixed = d_nu_p * nu0 * prior_sq
        of_nu, of_p = d_nu_nu * nu0**2 + first, d_p_p * prior_sq * prior_sq + second
    gradient = np.array([first + second, second])
    hessian = np.array([[of_nu + 2.0 * mixed + of_p, mixed + of_p], [mixed + of_p, of_p]])
    return _Likelihood(float(value), gradient, hessian)


def _sums_of(sq: FloatArray, other_sq: FloatArray, other_dof: Int32Array | IntArray) -> _Sums:
    """The sums over these observations, finite, by their number of degrees of freedom where kernels are compiled."""
    dof = other_dof.astype(np.float64)
    is_in_range = float(sq.sum() + other_sq.sum()) < _IN_RANGE[1]
    groups = PriorGroups.of(sq, ByRow(other_sq, other_dof, other_dof)) if is_in_range else None

    def sums(nu0: float, prior_sq: float) -> FloatArray:
        if groups is not None and _IN_RANGE[0] < prior_sq < _IN_RANGE[1]:
            return _sums_by_group(groups, nu0, prior_sq)
        return _sums(nu0, prior_sq, sq, other_sq, dof)

    return sums


def _sums_by_group(groups: PriorGroups, nu0: float, prior_sq: float) -> FloatArray:
    """`_sums` of groups of equal degrees of freedom; NaN, to which no step goes, where P is out of their range."""
    if not _IN_RANGE[0] < prior_sq < _IN_RANGE[1]:
        return np.full(6, math.nan)
    log_ratio, log_bq, inv_b, inv_bq, inv_b_sq, inv_bq_sq = groups.sums(prior_sq).T
    counts, nu = groups.counts, groups.dof + nu0
    half = 0.5 * nu
    return np.array(
        [
            counts @ np.log(nu) + half @ log_ratio - log_bq.sum(),
            counts @ (1.0 / nu) + 0.5 * log_ratio.sum(),
            half @ inv_b - (half + 1.0) @ inv_bq,
            -(counts @ (1.0 / (nu * nu))),
            0.5 * (inv_b - inv_bq).sum(),
            (half + 1.0) @ inv_bq_sq - half @ inv_b_sq,
        ]
    )


def _sums(nu0: float, prior_sq: float, sq: FloatArray, other_sq: FloatArray, dof: FloatArray) -> FloatArray:
    """Log likelihood and its derivatives by nu0, P, nu0 nu0, nu0 P, P P: (6,); one pass, in chunks that fit a cache."""
    total = np.zeros(6)
    for start in range(0, sq.size, _CHUNK):
        part = slice(start, start + _CHUNK)
        nu = dof[part] + nu0
        b = other_sq[part] + prior_sq
        bq = b + sq[part]
        inv_b, inv_bq, inv_nu = 1.0 / b, 1.0 / bq, 1.0 / nu
        log_b, log_bq = np.log(b), np.log(bq)
        difference = log_b - log_bq
        half = 0.5 * nu
        total += (
            np.log(nu).sum() + half @ difference - log_bq.sum(),
            inv_nu.sum() + 0.5 * difference.sum(),  # d / d nu0
            half @ inv_b - (half + 1.0) @ inv_bq,  # d / d P
            -(inv_nu @ inv_nu),  # d2 / d nu0^2
            0.5 * (inv_b.sum() - inv_bq.sum()),  # d2 / d nu0 d P
            (half + 1.0) @ (inv_bq * inv_bq) - half @ (inv_b * inv_b),  # d2 / d P^2
        )
    return total
