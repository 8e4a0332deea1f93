"""What do two runs say about the same poses? Who moved, model by model; the aligning is done by whoever calls.

An image is compared where both runs have a pose of it; two models that have less than three such images in common
cannot be aligned, and poses of two different models of one run have nothing to do with each other.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple, Protocol

from sfm_audit.reports.compare.keys import ImageKey, Noted
from sfm_audit.reports.run_folder.reader import Row
from sfm_audit.reports.text.wording import counted

POSE_COLUMNS: Final = ("qw", "qx", "qy", "qz", "tx", "ty", "tz", "median_depth")
MIN_COMMON: Final = 3
MAX_NAMED: Final = 4  # images of a fragment in one line; all of them are listed below it


class StoredPose(NamedTuple):
    """Camera from world as a table has it: w x y z of the quaternion, translation, median depth (None unknown)."""

    quat_wxyz: tuple[float, float, float, float]
    translation: tuple[float, float, float]
    median_depth: float | None

    @classmethod
    def of(cls, row: Row) -> StoredPose | None:
        """Return the pose of a row; None where the run does not hold it, as those of older versions."""
        numbers = [row.get(name) for name in POSE_COLUMNS]
        if any(value is None for value in numbers[:7]):
            return None
        w, x, y, z, tx, ty, tz = (float(value) for value in numbers[:7] if value is not None)
        return cls((w, x, y, z), (tx, ty, tz), numbers[7])


@dataclass(frozen=True, slots=True)
class PoseFragment:
    """Images that moved together against the others.

    turn_deg: rotation against them.    shift: median distance that its cameras moved, in median depths.
    """

    images: tuple[ImageKey, ...]
    turn_deg: float
    shift: float

    @property
    def words(self) -> str:
        """The fragment in one line: how far, and the first and last images by name."""
        names = [key.image_name for key in self.images]
        shown = ", ".join(names) if len(names) <= MAX_NAMED else f"{', '.join(names[:3])} .. {names[-1]}"
        return (
            f"{counted(len(names), 'image')} turned together by {self.turn_deg:.1f} deg and shifted by "
            f"{self.shift:.2f} median depths: {shown}"
        )


@dataclass(frozen=True, slots=True)
class PoseChange:
    """A model of one run beside a model of the other. Lengths are in median depths of the baseline's images.

    images: compared.    centre_error, rotation_deg: their medians over the images that did not move.
    moved: images that are elsewhere, with how far; fragments: those that moved together.    bending: see the aligner.
    """

    images: tuple[ImageKey, ...]
    centre_error: float
    rotation_deg: float
    moved: Noted
    fragments: tuple[PoseFragment, ...]
    bending: float


Aligner = Callable[[Sequence[ImageKey], Sequence[StoredPose], Sequence[StoredPose]], PoseChange | None]
"""Images in any order, their poses in the baseline and in the run; None where they cannot be aligned."""


class Posed(Protocol):
    """An image of a run, as far as poses go."""

    @property
    def model(self) -> tuple[str, str, str, str]:
        """The model it is in."""
        ...

    @property
    def pose(self) -> StoredPose | None:
        """Where the run says it is."""
        ...


def pose_changes(
    before: Mapping[ImageKey, Posed], after: Mapping[ImageKey, Posed], align: Aligner
) -> tuple[PoseChange, ...]:
    """Compare the poses of two runs, one model beside another."""
    together: defaultdict[tuple[object, object], list[ImageKey]] = defaultdict(list)
    for key in sorted(before.keys() & after.keys()):
        if before[key].pose is not None and after[key].pose is not None:
            together[before[key].model, after[key].model].append(key)
    out = []
    for _, keys in sorted(together.items()):
        if len(keys) >= MIN_COMMON:
            poses = [[pose for key in keys if (pose := run[key].pose) is not None] for run in (before, after)]
            out.append(align(keys, *poses))
    return tuple(change for change in out if change is not None)
