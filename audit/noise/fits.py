"""How large is the noise of one image? Robust variance fits (method.md section 2, (1); the paper's P5, P9 to P12)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from sfm_audit.loaders.arrays import FloatArray

CUTOFF = 2.0  # c: residuals beyond two standard deviations count as if they were there


def consistency(cutoff: float) -> float:
    """Return kappa = E min(z^2, c^2) for z ~ N(0, 1), which makes the winsorised scale consistent."""
    tail = 0.5 * math.erfc(cutoff / math.sqrt(2.0))
    density = math.exp(-0.5 * cutoff**2) / math.sqrt(2.0 * math.pi)
    return 1.0 - 2.0 * tail - 2.0 * cutoff * density + 2.0 * cutoff**2 * tail


CONSISTENCY = consistency(CUTOFF)  # kappa = 0.92053...
_RELATIVE_CHANGE = 1e-8
_NEWTON_CHANGE = 1e-6  # of a step of Newton's: what is left after it is of the order of its square, but at a kink
_MAX_ITERATIONS = 100
_NUM_EXPECTED = 2  # first steps, with the slope that normal residuals have: Newton's would go too far
_UNCLIPPED = math.erf(CUTOFF / math.sqrt(2.0)) - CUTOFF * math.exp(-0.5 * CUTOFF**2) * math.sqrt(2.0 / math.pi)

_Theta: TypeAlias = tuple[float, float]
_Symmetric: TypeAlias = tuple[float, float, float]  # 11, 12, 22


@dataclass(frozen=True, slots=True)
class VarianceFit:
    """theta of (1): var = detector_px2 + structure * a^2, both px^2 and >= 0; NaN where undetermined.

    converged: False when the iteration ended in a cycle (then the last two iterates are averaged).
    """

    detector_px2: float
    structure: float
    converged: bool


UNDETERMINED = VarianceFit(math.nan, math.nan, converged=False)


def fit_constant_variance(sq_residuals_px2: FloatArray) -> VarianceFit:
    """Fit one variance to squared residuals of any shape, robustly, consistent at the normal.

    Notes
    -----
    The fixed point of method.md section 2's Fisher scoring with a = 0 is the root of
    mean(min(y / theta, c^2)) = kappa. In u = 1 / theta the left side is increasing, concave and piecewise linear, so
    Newton from below reaches the root exactly after finitely many steps. All y = 0: undetermined.
    """
    y = sq_residuals_px2.ravel()
    n = y.size
    if n == 0 or not np.isfinite(total := float(y.sum())) or total == 0.0:
        return UNDETERMINED
    theta = total / (n * CONSISTENCY)  # below the root in u
    unclipped, unclipped_sum = y, total
    for _ in range(_MAX_ITERATIONS):
        inside = unclipped < CUTOFF**2 * theta
        if not inside.all():  # theta only falls: what is clipped stays clipped
            unclipped = unclipped[inside]
            unclipped_sum = float(unclipped.sum())
        denominator = n * CONSISTENCY - (n - unclipped.size) * CUTOFF**2
        if denominator <= 0.0 or unclipped_sum == 0.0:  # positive outliers of a bulk that is zero: no root
            return UNDETERMINED
        previous, theta = theta, unclipped_sum / denominator
        if abs(theta - previous) <= 1e-14 * theta:
            return VarianceFit(theta, 0.0, converged=True)
    return VarianceFit(theta, 0.0, converged=False)


def fit_variance(sq_residuals_px2: FloatArray, predictor_px2: FloatArray) -> VarianceFit:
    """Fit var = theta_1 + theta_2 a^2 (1) robustly, theta >= 0.

    Parameters
    ----------
    sq_residuals_px2 : (k, m) or (m,) y, squared residuals of single axes, px^2; rows share their predictors
    predictor_px2 : (m,) a^2, px^2, finite and >= 0

    Notes
    -----
    method.md section 2: Fisher scoring on winsorised squares. Its fixed points solve
    sum A_j (min(y_j / s_j, c^2) / kappa - 1) / s_j = 0 with s = A theta, or have theta_2 = 0 and a non-positive second
    component. The boundaries theta_2 = 0 and theta_1 = 0 are tried first (both are common, and there the equation is
    that of a constant), then Newton with scoring steps where Newton leaves the region. Where the paper says IRLS
    without naming weights, this is our choice; method.md says why.
    """
    y = np.atleast_2d(sq_residuals_px2)
    constant = fit_constant_variance(y)
    if not constant.converged:
        return constant
    least = float(predictor_px2.min())
    if least == predictor_px2.max():
        return constant
    excess = _excess(y, np.full(1, constant.detector_px2))
    if excess @ predictor_px2 <= 0.0:
        return constant
    if least > 0.0:
        proportional = fit_constant_variance(y / predictor_px2)
        scale = proportional.detector_px2 * predictor_px2
        if proportional.converged and (_excess(y, scale) / scale).sum() <= 0.0:
            return VarianceFit(0.0, proportional.detector_px2, converged=True)
    theta = _first_step(excess, predictor_px2, constant.detector_px2, len(y))
    ends = least, float(predictor_px2.max())
    previous = theta
    for i in range(_MAX_ITERATIONS):
        previous, (theta, is_newton) = theta, _next_theta(y, predictor_px2, theta, expected=i < _NUM_EXPECTED)
        tolerance = _NEWTON_CHANGE if is_newton else _RELATIVE_CHANGE
        old, new = ([each[0] + each[1] * a for a in ends] for each in (previous, theta))  # s / s' is monotone in a^2
        if all(abs(s - before) <= tolerance * before for s, before in zip(new, old, strict=True)):
            return VarianceFit(*theta, converged=True)
    return VarianceFit(0.5 * (theta[0] + previous[0]), 0.5 * (theta[1] + previous[1]), converged=False)


def _variance(predictor: FloatArray, theta: FloatArray) -> FloatArray:
    return np.asarray(theta[0] + theta[1] * predictor, dtype=np.float64)


def _excess(y: FloatArray, s: FloatArray) -> FloatArray:
    """Return sum over the rows of min(y / s, c^2) / kappa - 1: (k, m) and (m,) or (1,) -> (m,)."""
    return np.asarray(np.minimum(y / s, CUTOFF**2).sum(axis=0) / CONSISTENCY - len(y))


def _first_step(excess: FloatArray, predictor: FloatArray, variance: float, num_rows: int) -> _Theta:
    """`scoring_step` from (variance, 0), where it is a straight line through equally weighted responses.

    At that variance's own fixed point ``excess`` (m,) sums to 0, and where it grows with the predictor the line rises;
    if it falls below 0 at a^2 = 0 it starts there instead.
    """
    mean = float(predictor.mean())
    centred = predictor - mean
    slope = variance * float(excess @ centred) / float(centred @ centred) / num_rows
    if slope * mean <= variance:
        return variance - slope * mean, slope
    response = variance * (1.0 + excess / num_rows)
    return 0.0, float(response @ predictor) / float(predictor @ predictor)


def _estimating_equation(
    y: FloatArray, predictor: FloatArray, theta: _Theta, *, expected: bool
) -> tuple[_Theta, _Symmetric]:
    """Left side (2,) of the estimating equation and its derivative in theta; y is (k, m), predictor (m,).

    expected : the derivative is what it is on average if y / s are squares of normal numbers
    """
    inverse = predictor * theta[1]
    inverse += theta[0]
    np.maximum(inverse, np.finfo(np.float64).tiny, out=inverse)
    np.divide(1.0, inverse, out=inverse)
    ratio = y * inverse
    first = np.add.reduce(np.minimum(ratio, CUTOFF**2), axis=0)
    first *= 1.0 / CONSISTENCY
    first -= len(y)
    first *= inverse
    if expected:
        slope = inverse * (len(y) * _UNCLIPPED / CONSISTENCY)
    else:
        np.putmask(ratio, ratio >= CUTOFF**2, 0.0)
        slope = np.add.reduce(ratio, axis=0)
        slope *= inverse
        slope *= 1.0 / CONSISTENCY
        slope += first
    slope *= inverse
    equation = float(np.add.reduce(first)), float(first @ predictor)
    total = float(np.add.reduce(slope))
    slope *= predictor
    return equation, (-total, -float(np.add.reduce(slope)), -float(slope @ predictor))


def _next_theta(y: FloatArray, predictor: FloatArray, theta: _Theta, *, expected: bool) -> tuple[_Theta, bool]:
    """One step of Newton's (True) if it stays near theta > 0, else one Fisher scoring step (False).

    expected : with the slope of normal residuals (False)
    """
    if min(theta) > 0:
        equation, (d00, d01, d11) = _estimating_equation(y, predictor, theta, expected=expected)
        determinant = d00 * d11 - d01**2
        if determinant > 0 and d00 < 0:
            newton = (
                theta[0] - (d11 * equation[0] - d01 * equation[1]) / determinant,
                theta[1] - (d00 * equation[1] - d01 * equation[0]) / determinant,
            )
            if all(0.1 * old < new < 10.0 * old for new, old in zip(newton, theta, strict=True)):
                return newton, not expected
    detector, structure = scoring_step(y, predictor, np.array(theta)).tolist()
    return (detector, structure), False


def scoring_step(y: FloatArray, predictor: FloatArray, theta: FloatArray) -> FloatArray:
    """One step of method.md section 2 as it is written: winsorised pseudo-responses, rows weighted 1 / s, NNLS.

    y is (k, m) or (m,), predictor (m,).
    """
    y = np.atleast_2d(y)
    s = _variance(predictor, theta)
    positive = s > 0
    s, y, a = s[positive], y[:, positive], predictor[positive]
    weight = len(y) / (s * s)
    response = np.minimum(y / s, CUTOFF**2).sum(axis=0) / len(y) / CONSISTENCY * s
    gram = np.array([[weight.sum(), weight @ a], [weight @ a, weight @ (a * a)]])
    right = np.array([weight @ response, (weight * a) @ response])
    free = np.linalg.solve(gram, right) if np.linalg.det(gram) > 0 else np.array([-1.0, -1.0])
    if free.min() >= 0:
        return np.asarray(free)
    edges = [np.array([right[0] / gram[0, 0], 0.0])]
    if gram[1, 1] > 0:
        edges.append(np.array([0.0, right[1] / gram[1, 1]]))
    return min(edges, key=lambda t: float(t @ gram @ t - 2 * right @ t))
