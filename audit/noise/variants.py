"""Variance fits to compare with: what maximum likelihood says, and the paper's initial weights taken literally.

Both fit (1) of method.md section 2, as `fit_variance` does, whose robust fit is what verdicts stand on.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from scipy import optimize, special

from sfm_audit.audit.noise.fits import UNDETERMINED, VarianceFit, scoring_step
from sfm_audit.loaders.arrays import FloatArray

INITIAL_SIGMA_PX: Final = 5.0  # of the paper's initial weights, px
_LOG_ODDS: Final = np.linspace(-25.0, 25.0, 126)  # of theta_2's share, among which the best bracket is looked for
_LOG_ODDS_TOLERANCE: Final = 1e-9
_RELATIVE_CHANGE: Final = 1e-8
_MAX_STEPS: Final = 100


def fit_variance_likelihood(sq_residuals_px2: FloatArray, predictor_px2: FloatArray) -> VarianceFit:
    """Fit var = theta_1 + theta_2 a^2 (1) by Gaussian maximum likelihood, theta >= 0: the plain, non-robust scale.

    Parameters
    ----------
    sq_residuals_px2 : (m,) y, squared residuals of single axes, px^2
    predictor_px2 : (m,) a^2, px^2, finite and >= 0

    Notes
    -----
    Minimises sum (ln s_j + y_j / s_j) / 2, s = theta_1 + theta_2 a^2. With b_j = (1 - w) + w a_j^2 / mean a^2 and
    s = t b, the best t for a share w is mean(y / b): one bounded number is left, 0 <= w <= 1, whose profile may have
    several minima, also close to an end where a^2 spreads over decades. It is looked through, in steps of the log odds
    of w, before it is refined. A residual of exactly 0 at a^2 = 0 makes the likelihood unbounded at theta_1 = 0: that
    end is left out where some a^2 = 0. All y = 0: undetermined.
    """
    y, a_sq = sq_residuals_px2, predictor_px2
    if y.size == 0 or not np.isfinite(y).all() or not y.any():
        return UNDETERMINED
    if not a_sq.any():
        return VarianceFit(float(y.mean()), 0.0, converged=True)
    relative = a_sq / a_sq.mean()

    def shape(share: float) -> FloatArray:
        return np.asarray(1.0 - share + share * relative)

    def cost(share: float) -> float:
        b = shape(share)
        return float(np.log(np.mean(y / b)) + np.mean(np.log(b)))

    best = float(_LOG_ODDS[np.argmin([cost(float(special.expit(odds))) for odds in _LOG_ODDS])])
    step = float(_LOG_ODDS[1] - _LOG_ODDS[0])
    found = optimize.minimize_scalar(
        lambda odds: cost(float(special.expit(odds))),
        bounds=(best - step, best + step),
        method="bounded",
        options={"xatol": _LOG_ODDS_TOLERANCE},
    )
    ends = [0.0, float(special.expit(found.x)), *([1.0] if a_sq.min() > 0.0 else [])]
    share = min(ends, key=cost)
    scale = float(np.mean(y / shape(share)))
    return VarianceFit(scale * (1.0 - share), scale * share / float(a_sq.mean()), converged=bool(found.success))


def literal_start(sq_residuals_px2: FloatArray, predictor_px2: FloatArray) -> FloatArray:
    """Theta (2,) of weighted least squares of y on (1, a^2), theta >= 0, weights 1 / p(eps | sigma = 5 px).

    p is the normal density, so the weights are proportional to exp(y / 50 px^2): the largest residuals count most.
    Parameters as of `fit_variance_likelihood`; some y > 0.
    """
    log_weight = sq_residuals_px2 / (2.0 * INITIAL_SIGMA_PX**2)
    root = np.exp(0.5 * (log_weight - log_weight.max()))
    design = np.column_stack([np.ones_like(predictor_px2), predictor_px2])
    theta, _ = optimize.nnls(root[:, None] * design, root * sq_residuals_px2)
    return np.asarray(theta)


def fit_variance_literal(sq_residuals_px2: FloatArray, predictor_px2: FloatArray) -> VarianceFit:
    """Fit (1) by the scoring steps of method.md section 2 from the paper's initial weights; for the reproduction only.

    Parameters as of `fit_variance_likelihood`. The paper names the initial weights of its IRLS, 1 / p(eps | sigma = 5),
    and not those of the later steps. Weights 1 / p at the current theta would grow without bound with the residual, so
    the later steps are `scoring_step`. The start then decides only where the equation has several roots.
    """
    y, a_sq = sq_residuals_px2, predictor_px2
    if y.size == 0 or not np.isfinite(y).all() or not y.any():
        return UNDETERMINED
    theta = previous = literal_start(y, a_sq)
    for _ in range(_MAX_STEPS):
        previous, theta = theta, scoring_step(y, a_sq, theta)
        if not theta.any():  # the bulk is zero
            return UNDETERMINED
        new, old = theta[0] + theta[1] * a_sq, previous[0] + previous[1] * a_sq
        if np.all(np.abs(new - old) <= _RELATIVE_CHANGE * old):
            return VarianceFit(float(theta[0]), float(theta[1]), converged=True)
    theta = 0.5 * (theta + previous)
    return VarianceFit(float(theta[0]), float(theta[1]), converged=False)
