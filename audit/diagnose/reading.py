"""What do the numbers say? Readings of evidence and refits, one sentence each with the numbers it rests on."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final

from sfm_audit.audit.diagnose.refit import Refit
from sfm_audit.audit.misfit import GROUPS

Numbers = Mapping[str, float]

SMALL_PX: Final = 0.05
"""A field below it is not worth a sentence: with a million observations a thousandth of a pixel is significant."""
MOSTLY: Final = 0.5
SHARED_WITH_NEIGHBOURS: Final = 0.2
PERSISTS: Final = 0.5
CELLS_SHARE: Final = 0.75
HELPS: Final = 0.5
"""A refit helps if it leaves at most this share of the images that misfit rejects after the control."""
HOLDS_A_PART: Final = 0.75


def readings(tables: Numbers, found: Numbers) -> list[str]:
    """Return what `summary_numbers` and `evidence` of a model say, as sentences.

    Parameters
    ----------
    tables, found : numbers by name; a sentence whose numbers are NaN or too small is left out
    """
    said = [_common(tables, found), _rolling(tables, found), _cells(found), _shared(found), _persists(found)]
    return [sentence for sentence in said if sentence]


def _common(tables: Numbers, found: Numbers) -> str:
    own, common = tables.get("smooth_px", math.nan), found.get("common_smooth_px", math.nan)
    if not own > SMALL_PX or math.isnan(common):
        return ""
    largest = max(GROUPS, key=lambda group: _number(found, f"common_{group}_px"))
    largest_px = _number(found, f"common_{largest}_px")
    numbers = f"smooth {common:.2f} px common to all images, {own:.2f} px in the median image"
    if common >= MOSTLY * own:
        return f"Common to all images, so the lens: {numbers}; largest common field: {largest} {largest_px:.2f} px."
    if largest_px > MOSTLY * own:
        return (
            f"A common part, so the lens, and parts of single images: {numbers}; {largest} {largest_px:.2f} px common."
        )
    return f"Different from image to image, so not a shared lens: {numbers}."


def _rolling(tables: Numbers, found: Numbers) -> str:
    own, beyond = tables.get("smooth_px", math.nan), found.get("beyond_rs_px", math.nan)
    if not own > SMALL_PX or math.isnan(beyond):
        return ""
    if beyond > own:
        return "Rolling shutter does not explain it: the smooth field stays when the pose may change from row to row."
    numbers = f"{beyond:.2f} of {own:.2f} px smooth field stay when the pose may change from row to row"
    if beyond <= MOSTLY * own:
        return f"Rolling shutter explains most of it: {numbers}."
    return f"Rolling shutter alone does not explain it: {numbers}."


def _cells(found: Numbers) -> str:
    observations, cells = found.get("by_observations", math.nan), found.get("by_cells", math.nan)
    if math.isnan(observations) or math.isnan(cells) or cells >= CELLS_SHARE * observations:
        return ""
    return (
        f"Part of the significance is errors that neighbours share: {observations:.0%} of the images have a "
        f"significant smooth field by observations, {cells:.0%} when a cell of 1/24 of the image counts once."
    )


def _shared(found: Numbers) -> str:
    correlation = found.get("neighbours", math.nan)
    if not correlation >= SHARED_WITH_NEIGHBOURS:
        return ""
    return (
        f"Neighbouring points share their error (correlation {correlation:.2f}): surfaces that are placed wrongly, or "
        "keypoints that move together."
    )


def _persists(found: Numbers) -> str:
    correlation = found.get("persistence", math.nan)
    if not correlation >= PERSISTS:
        return ""
    return (
        f"A point keeps its error from one image to the next by name (correlation {correlation:.2f}): points or "
        "keypoints that drift, rather than the camera."
    )


def refit_reading(tables: Numbers, control: Refit, tried: Refit) -> str:
    """Return what a refit says beyond the control."""
    name = tried.camera_model or "as it is"
    if tried.problem is not None:
        return f"{name}: could not be refitted ({tried.problem})."
    before, after = tables["rejected_misfit"], tried.numbers["rejected_misfit"]
    numbers = f"misfit rejects {after:.0f} of {tried.numbers['images']:.0f} (was {before:.0f})"
    if not math.isnan(tried.numbers["smooth_px"] + tables["smooth_px"]):
        numbers += f", smooth {tried.numbers['smooth_px']:.2f} px (was {tables['smooth_px']:.2f})"
    if tried.camera_model is None or control.problem is not None:
        return f"{name}: {numbers}."
    verdict = "helps" if helps(control, tried) else "does not help beyond adjusting"
    return f"{name}: {verdict}; {numbers}."


def helps(control: Refit, tried: Refit) -> bool:
    """Whether a refit leaves so much less than the control that it speaks for its camera model."""
    if control.problem is not None or tried.problem is not None:
        return False
    before, after = control.numbers["rejected_misfit"], tried.numbers["rejected_misfit"]
    return before > 0 and after <= HELPS * before


def conclusion(tables: Numbers, control: Refit, tried: Sequence[Refit]) -> str:
    """Return what to do by the refits: the smallest camera model that helps, or that none does.

    tables : of `summary_numbers` before
    """
    if control.problem is not None:
        return f"It cannot be adjusted ({control.problem}); repair that first."
    if not tried and tables["rejected_misfit"] == 0:
        return f"Misfit rejects no image, so there is no lens to refit.{_adjusting(tables, control)}"
    if not tried and control.numbers["rejected_misfit"]:
        return "No larger camera model of the family can express these cameras; nothing was refitted but the control."
    if control.numbers["rejected_misfit"] == 0:
        return "Adjusting the model as it is leaves no image that misfit rejects: adjust, and keep the camera model."
    return _best_of(control, tried)


def _best_of(control: Refit, tried: Sequence[Refit]) -> str:
    """Say which refit helps, which at least holds a part, or that none does."""
    helping = [each for each in tried if helps(control, each)]
    if helping:
        return f"Refit as {helping[0].camera_model}."
    fitted = [each for each in tried if each.problem is None]
    best = min(fitted, key=lambda each: each.numbers["rejected_misfit"], default=control)
    left, rejected = best.numbers["rejected_misfit"], control.numbers["rejected_misfit"]
    if left <= HOLDS_A_PART * rejected:
        said = f"{best.camera_model} holds a part: misfit rejects {left:.0f} instead of {rejected:.0f}."
        return f"{said} What is left is not a lens of COLMAP's."
    return "No refit helps: keep the camera model; what is left is not a lens of COLMAP's."


def _adjusting(before: Numbers, control: Refit) -> str:
    """Say what adjusting changes of all rejections; nothing where it changes none for the better."""
    was, rejected = before["rejected"], control.numbers["rejected"]
    if rejected >= was:
        return ""
    return f" Adjusting the model as it is leaves {rejected:.0f} of {before['images']:.0f} rejected (was {was:.0f})."


def _number(numbers: Numbers, name: str) -> float:
    value = numbers.get(name, math.nan)
    return 0.0 if math.isnan(value) else value
