"""The numbers that decide, with their defaults: one place for the audit, its settings, its pages and its documents."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True, slots=True)
class Threshold:
    """One number that decides: its default, and one line about it."""

    default: float
    meaning: str


ALPHA: Final = Threshold(0.05, "level of the tests: an image is rejected when its p-value is below")
MIN_EFFECT: Final = "0.2px"
"""Default of the smallest misfit that matters (tau): in px, or in sigma of the image."""
MIN_KS_DISTANCE: Final = Threshold(
    0.0,
    "verdict_ks rejects only where D is larger too; 0 is the paper's decision, which with thousands of "
    "observations an image rejects noise that is hardly different (verdict_noise asks for a visible difference)",
)
MIN_OBSERVATIONS: Final = Threshold(20, "a verdict needs that many standardised observations, or it is undetermined")
MAX_POSE_OFFSET_PX: Final = Threshold(
    0.5, "px; images with a larger pose_offset_px are left out of the statistics of tracks"
)
MIN_FOCAL_OVER_SIZE: Final = Threshold(0.3, "f / max(width, height) below which a camera is implausible")
MAX_FOCAL_OVER_SIZE: Final = Threshold(10.0, "f / max(width, height) above which a camera is implausible")
MAX_SD_FOCAL_REL: Final = Threshold(0.005, "joint sd of f / f above which the focal length is not identified")
MIN_K1_SDS: Final = Threshold(2.0, "|k1| / sd below which k1 is not identified (a remark)")
MIN_COVERAGE: Final = Threshold(0.2, "share of the image under the inliers' hull below which nothing is said")
MIN_OCCUPIED_CELLS: Final = Threshold(16, "occupied cells (of grid x grid) below which nothing is said")
MAX_NOISE_DISTANCE: Final = Threshold(
    0.03, "verdict_noise rejects where D - 1.36 / sqrt(N) is larger: a difference that can be seen at any N"
)
KS_CRITICAL: Final = 1.36
"""Times 1 / sqrt(N): the 5 % point of the Kolmogorov-Smirnov distance."""
MIN_OWN_STEP_SDS: Final = 5.0
"""An own parameter's step counts from so many of its standard deviations on (method.md section 11)."""
EXACT_SHARE: Final = 2.0**-16
"""Residuals below this share of the longer side of the image are rounding of float32, not measurement: points and poses
kept in float32 leave up to 9e-6 of it, measurements at least 4e-4 (scripts/exact_projections.py)."""
SINGULAR_SHARE: Final = 1e-9
"""Share of the largest singular value (columns of unit length) at or below which nothing is identified."""
HALF_PIXEL_SHIFT_PX: Final = 0.5**0.5
"""RMS of a shift by half a pixel in x and in y: another convention of pixel centres."""
HARD_WORTH_DEG: Final = 0.2
HARD_WORTH_FOCAL_REL: Final = 0.01
"""A misfit that is worth more than this in rotation (degrees) or in f (share) is hard ..."""
WEAK_WORTH_DEG: Final = 0.02
WEAK_WORTH_FOCAL_REL: Final = 0.001
"""... and one worth less than this in both is weak (method.md section 11)."""
MAX_WORTHLESS_TAUS: Final = 2.0
"""A misfit above so many times min_effect rejects, whatever it is worth."""
MIN_SHIFT_WORTH_CENTRE: Final = 0.001
MIN_SHIFT_WORTH_FOCAL_REL: Final = 0.003
"""What a principal point or its twin, tangential distortion, has to be worth: share of the median depth, share of f.
Degrees say nothing there: a rotation is what takes a shift up (docs/realtruth.md)."""

MIN_SHARED_POINTS: Final = 15
"""Points that two images share that hang together; fewer than the next number hold them weakly."""
WELL_SHARED_POINTS: Final = 30
MIN_STRONG_MATCHES: Final = 60
"""Verified matches of a strong pair: of healthy real pairs with fewer, 4 of 16 contradict (method.md section 13)."""
PAIR_THRESHOLD_SIGMAS: Final = 8.0
MIN_PAIR_THRESHOLD_PX: Final = 1.0
"""A match is far off above so many sigma of the model, and above so many px."""
MAX_HEALTHY_PAIR_RATE: Final = 0.01
"""Share of a healthy model's strong pairs that may contradict: 0 of 980 simulated and 0 of 27 real ones do."""
MIN_STRONG_PAIRS: Final = 3
"""Pairs from which on an image is spoken of: one contradicted pair does not say which of its two images is wrong."""
MAX_CONTRADICTING_SHARE: Final = 0.5
"""Share of an image's pairs above which another place would satisfy more of them than its own."""
MAX_REFERENCE_CENTRE: Final = 0.1
MAX_REFERENCE_ROTATION_DEG: Final = 2.0
"""An image disagrees with its reference above so many median depths, or so many degrees (docs/witnesses.md)."""
MIN_DRIFT: Final = 0.01
"""Median depths that neighbours share of their distance from a reference, from which on that is a finding."""
MAX_PRIOR_CHI2: Final = 11.344866730144373
"""99 % point of chi^2 with 3 degrees of freedom: an image nearer to its position prior never disagrees."""
MAX_PRIOR_SPREAD: Final = 1.5
"""Priors that scatter so many times as widely as their covariances say are a finding."""


def effect_px(min_effect: str, sigma_px: float | None) -> float | None:
    """Return tau in px of a min_effect such as 0.2px or 0.5sigma; None where sigma is asked for and not known."""
    if min_effect.endswith("px"):
        return float(min_effect.removesuffix("px"))
    return None if sigma_px is None else float(min_effect.removesuffix("sigma")) * sigma_px
