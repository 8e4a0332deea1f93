"""Which row of a list of poses is an image of a model? By name, by timestamp in the name, or by frame number in it."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from pathlib import PurePosixPath
from typing import Final

import numpy as np

from sfm_audit.loaders.arrays import FloatArray, IntArray
from sfm_audit.loaders.errors import LoadError
from sfm_audit.loaders.evidence import ReferencePoses
from sfm_audit.loaders.references.poses import ADVICE, PoseList

MAX_GAP_SECONDS: Final = 0.1
"""Between two poses that far apart in time at most, the camera is taken to move evenly."""
_SAME_SECONDS: Final = 1e-4  # stamps that are printed with four digits
_MAX_CENTRE: Final = 1e12
_SECONDS: Final = re.compile(r"(\d{1,12}(?:\.\d{1,12})?)")
_NANOSECONDS: Final = re.compile(r"(\d{16,20})")
_NUMBER: Final = re.compile(r"(\d{1,9})\D*")


def poses_of_images(poses: PoseList, names: Sequence[str], scene: str) -> ReferencePoses:
    """Return the pose of each image of a model, NaN where the list has none.

    Parameters
    ----------
    names : of the images    scene : of the model, for lists that hold several scenes

    Raises
    ------
    LoadError
        No image is in the list.
    """
    if poses.names is not None:
        stored = poses.names
        ours = [i for i in range(len(poses)) if poses.scene and poses.scene[i] == scene] or list(range(len(poses)))
        found = _taken(poses, rows_by_name(stored, ours, names))
    elif poses.seconds is not None:
        found = _at_times(poses, np.array([_seconds_of(name) for name in names]))
    else:
        found = _taken(poses, np.array([_number_of(name, len(poses)) for name in names], dtype=np.int64))
    rotation, centre = found
    known = np.isfinite(rotation).all(axis=(1, 2)) & (np.abs(centre) < _MAX_CENTRE).all(axis=1)
    if not known.any():
        raise LoadError(poses.location, None, *_missed(poses, names))
    rotation[~known], centre[~known] = np.nan, np.nan
    return ReferencePoses(poses.location, rotation, centre, poses.is_metric)


def _missed(poses: PoseList, names: Sequence[str]) -> tuple[str, str, str]:
    example = names[0] if names else "none"
    if poses.names is not None:
        return "poses of the model's images", f"none of them, such as {example!r}", "give the reference of these images"
    how = "a timestamp within the trajectory" if poses.seconds is not None else "the number of a frame"
    return f"images that are called by {how}", f"{example!r}", ADVICE


def rows_by_name(stored: Sequence[str], among: Sequence[int], names: Sequence[str]) -> IntArray:
    """Return the row of each image: by its name, else by the last part of it, else by that without its ending; -1.

    A part that two images of either side have is not used. stored: all names; among: the rows that are meant.
    """
    out = np.full(len(names), -1, dtype=np.int64)
    for part in (str, _last, _stem):
        left = np.flatnonzero(out < 0)
        if not len(left):
            break
        theirs, ours = Counter(part(stored[i]) for i in among), Counter(part(name) for name in names)
        row_of = {part(stored[i]): i for i in among if theirs[part(stored[i])] == 1}
        for k in left.tolist():
            key = part(names[k])
            if ours[key] == 1:
                out[k] = row_of.get(key, -1)
    return out


def _last(name: str) -> str:
    return PurePosixPath(name).name


def _stem(name: str) -> str:
    last = _last(name)
    stem, dot, ending = last.rpartition(".")
    return stem if dot and ending.isalpha() else last


def _seconds_of(name: str) -> float:
    stem = _stem(name)
    if found := _NANOSECONDS.fullmatch(stem):
        return int(found[1]) * 1e-9
    found = _SECONDS.fullmatch(stem)
    return float(found[1]) if found else np.nan


def _number_of(name: str, num: int) -> int:
    """Return the last number in a name, -1 where there is none or the list has no such row."""
    numbers = re.findall(r"\d{1,9}", _stem(name))
    row = int(numbers[-1]) if numbers else -1
    return row if row < num else -1


def _taken(poses: PoseList, rows: IntArray) -> tuple[FloatArray, FloatArray]:
    rotation, centre = poses.rotation[rows], poses.centre[rows]  # row -1 is replaced
    rotation[rows < 0], centre[rows < 0] = np.nan, np.nan
    return rotation, centre


def _at_times(poses: PoseList, seconds: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Interpolate between the two poses around each time: centres along a line, rotations by their means.

    A time that is that of a pose needs no second one, however far the next is.
    """
    times = poses.seconds if poses.seconds is not None else np.empty(0)
    after = np.clip(np.searchsorted(times, seconds), 1, max(len(times) - 1, 1))
    before = after - 1
    if len(times) == 1:
        after = before = np.zeros(len(seconds), dtype=np.int64)
    gap = times[after] - times[before]
    with np.errstate(all="ignore"):
        share = np.where(gap > 0, (seconds - times[before]) / gap, 0.0)
    inside = (seconds >= times[before]) & (seconds <= times[after]) & (gap <= MAX_GAP_SECONDS + _SAME_SECONDS)
    share = np.where(inside, share, 0.0)
    nearest = np.where(np.abs(seconds - times[after]) < np.abs(seconds - times[before]), after, before)
    same = ~inside & (np.abs(seconds - times[nearest]) <= _SAME_SECONDS)
    before, after, inside = np.where(same, nearest, before), np.where(same, nearest, after), inside | same
    centre = (1 - share)[:, None] * poses.centre[before] + share[:, None] * poses.centre[after]
    mixed = (1 - share)[:, None, None] * poses.rotation[before] + share[:, None, None] * poses.rotation[after]
    inside &= np.isfinite(mixed).all(axis=(1, 2))
    rotation = np.full(mixed.shape, np.nan)
    if inside.any():
        left, _, right = np.linalg.svd(mixed[inside])
        rotation[inside] = left @ right
    centre[~inside] = np.nan
    return rotation, centre
