"""How large is the noise of one image? Robust variance fits (method.md section 2, (1); the paper's P5, P9 to P12)."""

from __future__ import annotations

import math
from dataclasses import dataclass

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
_NEWTON_CHANGE = 1e-4  # of a Newton step: what is left after it is of the order of its square
_MAX_ITERATIONS = 100


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
    ends = np.array([predictor_px2.min(), predictor_px2.max()])
    if ends[0] == ends[1]:
        return constant
    excess = _excess(y, np.full(1, constant.detector_px2))
    if excess @ predictor_px2 <= 0.0:
        return constant
    if ends[0] > 0.0:
        proportional = fit_constant_variance(y / predictor_px2)
        scale = proportional.detector_px2 * predictor_px2
        if proportional.converged and (_excess(y, scale) / scale).sum() <= 0.0:
            return VarianceFit(0.0, proportional.detector_px2, converged=True)
    previous = theta = _first_step(excess, predictor_px2, constant.detector_px2, len(y))
    for _ in range(_MAX_ITERATIONS):
        previous, (theta, is_newton) = theta, _next_theta(y, predictor_px2, theta)
        scale, old = _variance(ends, theta), _variance(ends, previous)  # s / s' is monotone in a^2
        tolerance = _NEWTON_CHANGE if is_newton else _RELATIVE_CHANGE
        if np.all(np.abs(scale - old) <= tolerance * old):
            return VarianceFit(float(theta[0]), float(theta[1]), converged=True)
    theta = 0.5 * (theta + previous)
    return VarianceFit(float(theta[0]), float(theta[1]), converged=False)


def _variance(predictor: FloatArray, theta: FloatArray) -> FloatArray:
    return np.asarray(theta[0] + theta[1] * predictor, dtype=np.float64)


def _excess(y: FloatArray, s: FloatArray) -> FloatArray:
    """Return sum over the rows of min(y / s, c^2) / kappa - 1: (k, m) and (m,) or (1,) -> (m,)."""
    return np.asarray(np.minimum(y / s, CUTOFF**2).sum(axis=0) / CONSISTENCY - len(y))


def _first_step(excess: FloatArray, predictor: FloatArray, variance: float, num_rows: int) -> FloatArray:
    """`scoring_step` from (variance, 0), where it is a straight line through equally weighted responses.

    At that variance's own fixed point ``excess`` (m,) sums to 0, and where it grows with the predictor the line rises;
    if it falls below 0 at a^2 = 0 it starts there instead.
    """
    mean = float(predictor.mean())
    centred = predictor - mean
    slope = variance * float(excess @ centred) / float(centred @ centred) / num_rows
    if slope * mean <= variance:
        return np.array([variance - slope * mean, slope])
    response = variance * (1.0 + excess / num_rows)
    return np.array([0.0, float(response @ predictor) / float(predictor @ predictor)])


def _estimating_equation(y: FloatArray, predictor: FloatArray, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Left side (2,) of the estimating equation and its derivative (2, 2) in theta; y is (k, m), predictor (m,)."""
    inverse = 1.0 / np.maximum(_variance(predictor, theta), np.finfo(np.float64).tiny)
    ratio = y * inverse
    inside = ratio < CUTOFF**2
    first = np.minimum(ratio, CUTOFF**2).sum(axis=0)
    first *= 1.0 / CONSISTENCY
    first -= len(y)
    first *= inverse
    ratio *= inside
    slope = ratio.sum(axis=0)
    slope *= inverse
    slope *= 1.0 / CONSISTENCY
    slope += first
    slope *= inverse
    weighted = slope * predictor
    cross = -float(weighted.sum())
    derivative = np.array([[-float(slope.sum()), cross], [cross, -float(weighted @ predictor)]])
    return np.array([first.sum(), first @ predictor]), derivative


def _next_theta(y: FloatArray, predictor: FloatArray, theta: FloatArray) -> tuple[FloatArray, bool]:
    """One Newton step (True) if it stays near theta > 0, else one Fisher scoring step (False)."""
    if theta.min() > 0:
        equation, derivative = _estimating_equation(y, predictor, theta)
        determinant = derivative[0, 0] * derivative[1, 1] - derivative[0, 1] ** 2
        if determinant > 0 and derivative[0, 0] < 0:
            right = derivative[1, 1] * equation[0] - derivative[0, 1] * equation[1]
            left = derivative[0, 0] * equation[1] - derivative[0, 1] * equation[0]
            newton = theta - np.array([right, left]) / determinant
            if np.all(newton > 0.1 * theta) and np.all(newton < 10.0 * theta):
                return newton, True
    return scoring_step(y, predictor, theta), False


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
