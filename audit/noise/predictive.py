"""Noise belongs to tracks: predict an observation from the rest of its track (method.md section 3b, (4) and (5)).

Track variances are s0^2 nu0 / chi^2(nu0) over a model. Given the rest of its track, a whitened residual is then
bivariate t; `student_to_normal` maps it to two standard normal numbers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import special

from sfm_audit.audit.noise.fits import CONSISTENCY, CUTOFF
from sfm_audit.audit.noise.others import EVERY, Others
from sfm_audit.audit.noise.prior import TrackPrior
from sfm_audit.loaders.arrays import BoolArray, FloatArray, Int32Array, IntArray

_MAX_ITERATIONS = 60
_CHUNK = 1 << 16  # observations
_STEP = 1.0 / 32.0  # node distance of the quantile tables in w
_TABLE_END = 6.0  # |w| beyond it (about six standard deviations) is transformed one by one
_NUM_CELLS = round(_TABLE_END / _STEP)
LAST_STEP = 1e-6  # in ln f
MIN_SLOPE = 1e-3  # of the robust variance in ln f, at which a step of Newton's is one
_MANY, _EVERY, _ROUGHLY = 256, 8, 0.02  # observations, from which on every 8th says, to 2 % of f, where to begin


@dataclass(frozen=True, eq=False)
class Prediction:
    """What the tracks predict for observations: scale (n,) px of (4), degrees of freedom by table row.

    prior: of the tracks.    dof_values: (v,) the distinct nu_k, ascending.
    others: of m observations, c and nu_k.    used: (m,) of which of them; all when None.
    """

    prior: TrackPrior
    dof_values: IntArray
    others: Others
    used: BoolArray | None = None

    @property
    def nu_values(self) -> FloatArray:
        """(v,) the distinct nu = nu0 + nu_k."""
        return self.prior.nu0 + self.dof_values.astype(np.float64)

    @cached_property
    def nu_row(self) -> Int32Array:
        """(n,) row of nu_values for each observation."""
        row_of = np.zeros(int(self.dof_values[-1]) + 1 if self.dof_values.size else 1, dtype=np.int32)
        row_of[self.dof_values] = np.arange(self.dof_values.size)
        other_dof = self.others.dof(EVERY)
        return row_of[other_dof if self.used is None else other_dof[self.used]]

    @cached_property
    def scale_px(self) -> FloatArray:
        """(n,) scale of (4), px."""
        other_sq_px2 = self.others.of(EVERY)[0]
        if self.used is not None:
            other_sq_px2 = other_sq_px2[self.used]
        scale_sq = (self.prior.nu0 * self.prior.s0_px**2 + other_sq_px2) / self.nu_values[self.nu_row]
        return np.asarray(np.sqrt(scale_sq), dtype=np.float64)


def predict(prior: TrackPrior, others: Others, num: int, used: BoolArray | None = None) -> Prediction:
    """Return scale^2 = (nu0 s0^2 + nu_k a_k^2) / nu and nu = nu0 + nu_k of (4) for num observations.

    Parameters
    ----------
    used : (num,) of which; all when None
    """
    is_there = np.zeros(1, dtype=np.bool_)  # small: no need to sort two million
    for start in range(0, num, _CHUNK):
        part = slice(start, min(start + _CHUNK, num))
        dof = others.dof(part)
        is_there = np.pad(is_there, (0, max(int(dof.max()) + 1 - is_there.size, 0)))
        is_there[dof if used is None else dof.compress(used[part])] = True
    return Prediction(prior, np.flatnonzero(is_there), others, used)


class StudentToNormal:
    """Map t to z = Phi^-1(T_nu(t)) for a fixed list of nu, by cubic interpolation of z / w.

    w = sign(t) sqrt(nu ln(1 + t^2 / nu)) is Wallace's (1959) variable: z / w is smooth, even and close to 1, so nodes
    1/32 apart reproduce z to 1e-9; checked against SciPy in the tests. |w| > 6 is computed one by one, in logarithms
    where T underflows.
    """

    def __init__(self, nu_values: FloatArray) -> None:
        """Tabulate.

        coefficients: (v * 193, 4) of the cubics of z / w in cells of w, the last of which begins at 6.
        log_front: (v,) logarithm of the density of t over that of z, both at 0.
        """
        self.nu_values = nu_values
        self.log_front = _log_front(nu_values)
        nodes: FloatArray = np.arange(_NUM_CELLS + 2, dtype=np.float64) * _STEP
        ratio, slope = _ratio_and_slope(nu_values, nodes)
        left, right = ratio[:, :-1], ratio[:, 1:]
        left_slope, right_slope = slope[:, :-1] * _STEP, slope[:, 1:] * _STEP
        rise = right - left
        cubic = [left, left_slope, 3.0 * rise - 2.0 * left_slope - right_slope, left_slope + right_slope - 2.0 * rise]
        self.coefficients: FloatArray = np.stack(cubic, axis=-1).reshape(-1, 4)

    def __call__(self, t: FloatArray, nu_row: Int32Array, nu: FloatArray) -> FloatArray:
        """Transform t (m,) with degrees of freedom nu (m,) = nu_values[nu_row]."""
        return self.with_w_sq(t, nu_row, nu)[0]

    def with_w_sq(self, t: FloatArray, nu_row: Int32Array, nu: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return z and w^2 (m,) of t."""
        w_sq = t * t
        w_sq /= nu
        np.log1p(w_sq, out=w_sq)
        w_sq *= nu
        w = np.sqrt(w_sq)
        fraction = w * (1.0 / _STEP)
        is_inside = fraction.size == 0 or fraction.max() < _NUM_CELLS
        outside = np.empty(0, dtype=np.int64) if is_inside else np.flatnonzero(~(fraction < _NUM_CELLS))
        if not is_inside:
            np.minimum(fraction, _NUM_CELLS, out=fraction)
        whole = np.floor(fraction)
        fraction -= whole
        cell = nu_row * (_NUM_CELLS + 1)
        cell += whole.astype(np.int32)
        c0, c1, c2, c3 = self.coefficients.take(cell, axis=0).T
        ratio = np.multiply(c3, fraction, out=whole)
        ratio += c2
        ratio *= fraction
        ratio += c1
        ratio *= fraction
        ratio += c0
        w *= ratio
        z = np.copysign(w, t, out=w)
        if outside.size:
            z[outside] = student_to_normal(t[outside], nu[outside])
        return z, w_sq


def _log_front(nu: FloatArray) -> FloatArray:
    """Logarithm of the density of Student's t over that of a normal number, both at 0."""
    return np.asarray(special.gammaln(0.5 * (nu + 1.0)) - special.gammaln(0.5 * nu) - 0.5 * np.log(0.5 * nu))


def _ratio_and_slope(nu_values: FloatArray, w: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Ratio z / w and its derivative, (v, k) each, at nodes w (k,) >= 0, w[0] = 0."""
    inner, nu, size = w[1:], nu_values[:, None], (len(nu_values), len(w) - 1)
    t = np.sqrt(nu * np.expm1(inner**2 / nu))
    z = student_to_normal(t.reshape(-1), np.repeat(nu_values, size[1])).reshape(size)
    log_front = _log_front(nu_values)
    # dz / dw = f_T(t) dt/dw / phi(z), with dt/dw = w (1 + t^2 / nu) / t and f_T ~ exp(-(nu + 1) w^2 / (2 nu))
    log_pdf = log_front[:, None] - 0.5 * (nu + 1) / nu * inner**2 + 0.5 * z * z
    dz_dw = np.exp(log_pdf + inner**2 / nu) * inner / t
    at_zero: FloatArray = np.array([math.exp(each) for each in log_front.tolist()])
    ratio = np.column_stack([at_zero, z / inner])
    slope = np.column_stack([np.zeros(size[0]), (dz_dw - z / inner) / inner])
    return ratio, slope


def student_to_normal(t: FloatArray, nu: FloatArray) -> FloatArray:
    """Return z = Phi^-1(T_nu(t)) exactly, also where T_nu(t) underflows (then through the logarithm of the tail)."""
    tail = special.stdtr(nu, -np.abs(t))
    with np.errstate(divide="ignore"):
        z = -special.ndtri(tail)
    for i in np.flatnonzero(tail < 1e-290):
        z[i] = -special.ndtri_exp(_log_student_tail(float(abs(t[i])), float(nu[i])))
    return np.copysign(z, t)


def _log_student_tail(t: float, nu: float) -> float:
    """Return ln P(T_nu > t) for large t > 0: half an incomplete beta function by its hypergeometric series."""
    a, log_u = 0.5 * nu, math.log1p(t * t / nu)  # x = nu / (nu + t^2) = exp(-log_u)
    x = math.exp(-log_u)
    log_front = -a * log_u + 0.5 * math.log1p(-x) - math.log(2.0 * a) - float(special.betaln(a, 0.5))
    term, total, k = 1.0, 1.0, 0
    while term > 1e-16 * total:
        term *= (a + 0.5 + k) / (a + 1.0 + k) * x
        total += term
        k += 1
    return log_front + math.log(total)


@dataclass(frozen=True, slots=True, eq=False)
class StandardisedImage:
    """One image's standard normal numbers z (m, 2) of (5) and its factor f; NaN f where it could not be solved."""

    z: FloatArray
    factor: float
    converged: bool


@dataclass(frozen=True, slots=True, eq=False)
class _Observations:
    """What does not change while f is looked for: t (2, m) at f = 1 and nu (m,); of both axes (2 m,) what tables need.

    half_power: (nu + 1) / (2 nu).
    """

    t: FloatArray
    nu: FloatArray
    rows: Int32Array
    both_nu: FloatArray
    log_front: FloatArray
    half_power: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class _Solution:
    """ln f, the step from there, z and d z / d ln t (2, m) there."""

    log_f: float
    move: float
    z: FloatArray
    growth: FloatArray
    converged: bool


@dataclass(frozen=True, slots=True, eq=False)
class TrackStandardiser:
    """(5) for the images of one model: tables for x (nu), and behind them those for y given x (nu + 1)."""

    prediction: Prediction
    to_normal: StudentToNormal

    @classmethod
    def build(cls, prediction: Prediction) -> TrackStandardiser:
        """Tabulate the transformations that the model's degrees of freedom need."""
        nu = prediction.nu_values
        return cls(prediction, StudentToNormal(np.concatenate([nu, nu + 1.0])))

    @property
    def tables(self) -> tuple[FloatArray, FloatArray]:
        """The coefficients of both transformations."""
        first, second = np.split(self.to_normal.coefficients, 2)
        return first, second

    def standardise(self, whitened_px: FloatArray, rows: IntArray | slice) -> StandardisedImage:
        """Solve the image's factor f and return z at it.

        Parameters
        ----------
        whitened_px : (2, m) e of the image's verified observations        rows : their rows in the prediction

        Notes
        -----
        f makes the robust variance of the pooled z equal to 1: mean(min(z^2, c^2)) = kappa. The left side decreases in
        f: Newton within a bracket, of large images first on every 8th observation. The last step, below 1e-6 in ln f,
        is one along the tangents of z.
        """
        prediction = self.prediction
        nu_row = prediction.nu_row[rows]
        nu = prediction.nu_values[nu_row]
        t = whitened_px / prediction.scale_px[rows]
        if t.size == 0 or not np.isfinite(t).all() or np.count_nonzero(t) * CUTOFF**2 <= t.size * CONSISTENCY:
            return StandardisedImage(np.full(t.T.shape, np.nan), math.nan, converged=False)
        start = 0.0
        if nu.size >= _MANY:
            some = self._observations(t[:, ::_EVERY], nu_row[::_EVERY], nu[::_EVERY])
            rough = self._solve(some, 0.0, _ROUGHLY)
            start = rough.log_f + rough.move if rough.converged else 0.0
        found = self._solve(self._observations(t, nu_row, nu), start, LAST_STEP)
        z = np.subtract(found.z, found.growth * found.move).T
        return StandardisedImage(np.ascontiguousarray(z), math.exp(found.log_f + found.move), found.converged)

    def _observations(self, t: FloatArray, nu_row: Int32Array, nu: FloatArray) -> _Observations:
        rows = np.concatenate([nu_row, nu_row + len(self.to_normal.nu_values) // 2])
        both = np.concatenate([nu, nu + 1.0])
        return _Observations(t, nu, rows, both, self.to_normal.log_front[rows], 0.5 + 0.5 / both)

    def _solve(self, image: _Observations, log_f: float, tolerance: float) -> _Solution:
        """Newton in ln f from ``log_f`` until a step is smaller than ``tolerance``; that step is not taken."""
        low, high = -math.inf, math.inf
        z, growth = np.empty((2, 0)), np.empty((2, 0))
        for _ in range(_MAX_ITERATIONS):
            z, growth = self._transform(image, image.t * math.exp(-log_f))
            excess, slope = _excess(z, growth)
            low, high = (log_f, high) if excess > 0 else (low, log_f)
            step = excess / slope if slope > MIN_SLOPE else math.copysign(math.inf, excess)
            if abs(step) <= tolerance:
                return _Solution(log_f, step, z, growth, converged=True)
            log_f = _inside(log_f, step, low, high)
        return _Solution(log_f, 0.0, z, growth, converged=False)

    def transform_stack(self, t: FloatArray, nu_row: Int32Array, nu: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return z and d z / d ln t (B, m, 2) of t (B, 2, m) with the degrees of freedom nu (B, m)."""
        flat = np.ascontiguousarray(t.transpose(1, 0, 2)).reshape(2, -1)
        z, growth = self._transform(self._observations(flat, nu_row.reshape(-1), nu.reshape(-1)), flat)
        return z.reshape(2, *nu.shape).transpose(1, 2, 0), growth.reshape(2, *nu.shape).transpose(1, 2, 0)

    def _transform(self, image: _Observations, t: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return z and d z / d ln t (2, m) of t (2, m).

        d z / d t is the density of t over that of z at the two; that of t is in proportion to
        exp(-(nu + 1) / (2 nu) w^2).
        """
        rest = t[0] * t[0]
        rest += image.nu
        given = t.copy()
        scale = image.both_nu[image.nu.size :] / rest
        given[1] *= np.sqrt(scale, out=scale)
        given = given.reshape(-1)
        z, w_sq = self.to_normal.with_w_sq(given, image.rows, image.both_nu)
        w_sq *= image.half_power
        growth = 0.5 * z
        growth *= z
        growth -= w_sq
        growth += image.log_front
        np.exp(growth, out=growth)
        growth *= given
        own = growth.reshape(2, -1)
        own[1] *= np.divide(image.nu, rest, out=rest)  # the scale of y grows with x
        return z.reshape(2, -1), own


def robust_excess(z: FloatArray, growth: FloatArray) -> tuple[FloatArray, FloatArray]:
    """mean(min(z^2, c^2)) - kappa over the last two axes, and minus its derivative in ln f; growth: d z / d ln t."""
    inside: BoolArray = z * z < CUTOFF**2
    size = z.shape[-2] * z.shape[-1]
    unclipped = np.where(inside, z, 0.0)
    clipped = 1.0 - np.count_nonzero(inside, axis=(-2, -1)) / size
    mass, falls = (np.einsum("...ij,...ij->...", unclipped, other) / size for other in (z, growth))
    return mass + CUTOFF**2 * clipped - CONSISTENCY, 2.0 * falls


def _excess(z: FloatArray, growth: FloatArray) -> tuple[float, float]:
    """`robust_excess` of one image, (2, m) each."""
    square = z * z
    falls = z * growth
    np.putmask(falls, square >= CUTOFF**2, 0.0)
    np.minimum(square, CUTOFF**2, out=square)
    mass, fallen = (float(np.add.reduce(each, axis=None)) / z.size for each in (square, falls))
    return mass - CONSISTENCY, 2.0 * fallen


def _inside(x: float, step: float, low: float, high: float) -> float:
    """The next x, kept inside the bracket (bisected where the step leaves it) and within e^3 of the last."""
    trial = x + max(-3.0, min(3.0, step))
    if low < trial < high:
        return trial
    return 0.5 * (low + high) if math.isfinite(low) and math.isfinite(high) else x + math.copysign(1.0, step)
