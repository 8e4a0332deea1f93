"""Numbers that a band bounds, and those of the poses among them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from sfm_audit.reports.compare.comparison import ScopeChange
from sfm_audit.reports.compare.keys import Noted
from sfm_audit.reports.text.wording import counted


@dataclass(frozen=True, slots=True)
class Measure:
    """One number that a band bounds: how far a scope is from its baseline.

    value: NaN where the baseline has the number and the run has not.    words: the number in words.
    """

    key: str
    value: float
    words: str
    images: Noted = ()


def pose_measures(change: ScopeChange) -> Iterator[Measure]:
    """Yield what the alignment of the poses says; nothing where no two models could be aligned."""
    if not change.poses:
        return
    total = sum(len(each.images) for each in change.poses)
    fragments = [fragment for each in change.poses for fragment in each.fragments]
    torn: Noted = tuple(
        (key, f"fragment {k}: {one.turn_deg:.1f} deg, {one.shift:.2f} median depths")
        for k, one in enumerate(fragments, 1)
        for key in one.images
    )
    folds = "; ".join(f"fold: {fragment.words}" for fragment in fragments)
    yield Measure("fragments", len(fragments), folds or "no group of images moved together", torn)
    moved = change.moved
    words = f"{len(moved)} of {counted(total, 'image')} moved against the others ({100 * len(moved) / total:.3g} %)"
    yield Measure("moved_images", len(moved) / total, words, moved)
    for key, number, words in (
        ("pose_centre", max(each.centre_error for each in change.poses), "median change of centres {} median depths"),
        ("pose_rotation_deg", max(each.rotation_deg for each in change.poses), "median change of rotations {} deg"),
        ("bending", max(each.bending for each in change.poses), "bent by {} median depths along the images"),
    ):
        yield Measure(key, number, words.format(f"{number:.3g}"))
