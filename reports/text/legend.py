"""What do the first lines and the columns of a summary mean? In words, for who has read nothing before."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, Final

from sfm_audit.audit.table.words import POLICIES, Member
from sfm_audit.reports.text.wording import paragraph, plain

_ASKED: Final[dict[Member, str]] = {
    Member.MISFIT: "lens",
    Member.CAMERA: "camera",
    Member.POSE: "pose",
    Member.PLAUSIBLE: "plausibility",
    Member.NOISE: "noise",
    Member.KS: "distribution of the noise (KS)",
    Member.OUTSIDE: "witnesses outside",
}
_NOISE: Final = {
    "track": "noise predicted from the rest of each track",
    "constant": "one noise level per image",
    "keypoint": "noise predicted from the rest of each track and the size of keypoints",
}
_POINTS: Final = {
    "in-sample": "3D points triangulated from these images",
    "independent": "3D points measured independently of these images",
}
_LENGTH: Final = re.compile(r"([-+.0-9e]+) *(px|sigma)")


def settings_words(config: Mapping[str, Any], *, has_witnesses: bool) -> str:
    """Say what judged the images, at which level, and what was taken for granted; settings as ``run.json`` has them."""
    policy = config.get("policy")
    members = POLICIES.get(policy, ())  # type: ignore[arg-type] # a later version may have others
    asked = ", ".join(_ASKED[member] for member in members if has_witnesses or member is not Member.OUTSIDE)
    judged = f"each image judged by policy {plain(str(policy))}{': ' if asked else ''}{asked}"
    said = f"{judged}; {level_words(config)}" if Member.MISFIT in members else f"{judged}; {_level(config)}"
    known = [
        words[config[name]] for name, words in (("noise", _NOISE), ("points", _POINTS)) if config.get(name) in words
    ]
    return f"{said}; {'; '.join(known)}" if known else said


def level_words(config: Mapping[str, Any]) -> str:
    """Say at which level it was tested, and which effects do not matter."""
    return f"{_level(config)}; effects below {effect_words(str(config.get('min_effect')))} ignored"


def _level(config: Mapping[str, Any]) -> str:
    alpha = config.get("alpha")
    return f"{100 * alpha:.3g}% level" if isinstance(alpha, float) else f"level {plain(str(alpha))}"


def effect_words(min_effect: str) -> str:
    """Return ``0.2px`` as 0.2 px, ``0.5sigma`` as 0.5 sigma (the noise of the image)."""
    found = _LENGTH.fullmatch(min_effect.strip())
    if not found:
        return plain(min_effect)
    value, unit = found.groups()
    return f"{value} px" if unit == "px" else f"{value} sigma (the noise of the image)"


def legend(width: int, *, has_coverage: bool) -> str:
    """Return what the columns of the tables above mean; at 80 cells at most four lines."""
    coverage = "coverage: share of the image inside the inliers' hull. " if has_coverage else ""
    said = (
        "error: mean reprojection error. rms: of the inliers. noise: expected, per axis. KS p: does the noise look as "
        "expected? misfit: systematic part of the residuals and its cause. pose: residual that moving it would "
        f"remove. {coverage}All words: docs/glossary.md"
    )
    return paragraph(said, width, "  ") + "\n"
