"""The paper's motivating example: y = x is true, y = x + 0.5 x^5 is claimed, and a scale must show it."""

from __future__ import annotations

from typing import Final

import numpy as np
import pandas as pd

from scripts.paper.rates import ALPHA, olsson_accepts
from sfm_audit.audit.noise.fits import fit_constant_variance
from sfm_audit.audit.normality import dagostino_pearson, ks, shapiro_wilk
from sfm_audit.loaders.arrays import FloatArray

SIZES: Final = (100, 225, 1000)
SIGMAS: Final = (0.02, 0.05, 0.1, 0.2)
SCALES: Final = ("winsorised", "MAD", "plain")
CLAIMED: Final = 0.5  # coefficient of x^5 in the wrong hypothesis
TAIL: Final = 3.0  # standardised residuals beyond it are tails: 0.27 % of a normal sample
_MAD_OF_NORMAL: Final = 0.67448975019608171


def sample(n: int, sigma: float, claimed: float, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Return x (n,), uniform in -1..1, and residuals (n,) of y = x + noise from y = x + claimed x^5."""
    x = rng.uniform(-1.0, 1.0, n)
    return x, sigma * rng.standard_normal(n) - claimed * x**5


def scale_of(residuals: FloatArray, name: str) -> float:
    """Return the standard deviation by one of `SCALES`: the auditor's robust one, the MAD's, and the sample's own."""
    if name == "winsorised":
        return float(np.sqrt(fit_constant_variance(residuals**2).detector_px2))
    if name == "MAD":
        return float(np.median(np.abs(residuals)) / _MAD_OF_NORMAL)
    return float(np.sqrt((residuals**2).mean()))


def motivating_trials(n: int, sigma: float, trials: int, seed: int, wrong: float = CLAIMED) -> pd.DataFrame:
    """Return a row per trial, hypothesis and scale; ``wrong``: the wrong hypothesis' coefficient of x^5."""
    rows = []
    for trial in range(trials):
        rng = np.random.default_rng([seed, n, round(1000 * sigma), trial])
        for hypothesis, claimed in (("wrong", wrong), ("right", 0.0)):
            _, residuals = sample(n, sigma, claimed, rng)
            accepted = olsson_accepts(np.abs(residuals))
            for name in SCALES:
                z = residuals / scale_of(residuals, name)
                rows.append(
                    {
                        "n": n,
                        "sigma": sigma,
                        "wrong": hypothesis == "wrong",
                        "scale": name,
                        "ks_rejects": ks(z).p < ALPHA,
                        "dap_rejects": dagostino_pearson(z).p < ALPHA,
                        "sw_rejects": shapiro_wilk(z).p < ALPHA,
                        "tail": float((np.abs(z) > TAIL).mean()),
                        "olsson_accepts": accepted,
                    }
                )
    return pd.DataFrame(rows)
