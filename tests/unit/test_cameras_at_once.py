"""Cameras are decided together and their points counted without sorting: the same as one by one."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from sfm_audit.audit.decision.diagnostics import GroupDiagnostics
from sfm_audit.audit.decision.misfit import decide_each
from sfm_audit.audit.misfit.sums import ModelSums
from sfm_audit.audit.table.words import GROUPS, MisfitGroup, MisfitStatus

SEEN = [[4, 7, 4, 0, 4], [9, 8], [], [3, 3], [0, 1, 2, 3, 4, 5, 6, 7, 8, 9]]


def sums_of(seen, num_points):
    offsets = np.cumsum([0, *map(len, seen)])
    residuals = SimpleNamespace(
        point_idx=np.concatenate([np.array(each, dtype=np.int64) for each in seen]),
        rows=lambda i: slice(int(offsets[i]), int(offsets[i + 1])),
    )
    return ModelSums(SimpleNamespace(points=range(num_points)), residuals)


@pytest.mark.parametrize("num_points", [10, 10_000])
@pytest.mark.parametrize("images", [[0], [1], [2], [3], [4], [0, 1], [0, 3, 4]])
def test_points_are_counted_once_however_often_they_are_seen(num_points, images):
    source = sums_of(SEEN, num_points)
    expected = len({point for image in images for point in SEEN[image]})
    assert source.num_points_of(images) == expected
    assert source.num_points_of([4]) == 10  # what an earlier question left behind does not count
    assert source.num_points_of(images) == expected


@pytest.mark.parametrize("images", [[0], [2], [3, 1], [0, 1], [4, 0, 2, 3], [0, 3, 4]])
def test_tracks_are_numbered_as_they_are_seen(images):
    source = sums_of(SEEN, 10)
    source.tracks([4, 0])  # what an earlier question left behind does not count
    of_row, num_tracks, reach = source.tracks(images)
    numbers = [of_row[source.residuals.rows(image)].tolist() for image in images]
    number_of = dict(zip((p for i in images for p in SEEN[i]), (t for own in numbers for t in own), strict=True))
    assert numbers == [[number_of[point] for point in SEEN[image]] for image in images]
    assert sorted(number_of.values()) == list(range(num_tracks))
    firsts = [max(own, default=-1) for own in numbers]
    assert all(max(own) < num_tracks for own in numbers if own)
    assert reach.tolist() == [[min(own, default=num_tracks), last] for own, last in zip(numbers, firsts, strict=True)]
    before: set[int] = set()
    for image in images:
        new = set(SEEN[image]) - before
        assert {number_of[point] for point in new} == set(range(len(before), len(before) + len(new)))
        before |= new


def groups_of(strong, px, q=0.001):
    quiet = GroupDiagnostics(0.8, 0.05, -5.0, MisfitStatus.TESTED)
    return dict.fromkeys(GROUPS, quiet) | {strong: GroupDiagnostics(q, px, 30.0, MisfitStatus.TESTED)}


CAMERAS = [
    (groups_of(MisfitGroup.RADIAL, 0.6), 0.2),
    (groups_of(MisfitGroup.RADIAL, 0.6), 1.0),  # the same below its tau
    (groups_of(MisfitGroup.AFFINE, 0.6), 0.2),
    (groups_of(MisfitGroup.AFFINE, 0.6, q=0.2), 0.2),
    (groups_of(MisfitGroup.RADIAL, 0.6), math.nan),
]


def test_cameras_are_decided_together_as_alone():
    together = decide_each([groups for groups, _ in CAMERAS], alpha=0.05, tau_px=np.array([tau for _, tau in CAMERAS]))
    alone = [decide_each([groups], alpha=0.05, tau_px=np.array([tau]))[0] for groups, tau in CAMERAS]
    assert [str(each) for each in together] == [str(each) for each in alone]  # NaN is not equal to itself
    assert [each.group for each in together] == [
        *(MisfitGroup.RADIAL, MisfitGroup.RADIAL, MisfitGroup.AFFINE, None, MisfitGroup.RADIAL)
    ]
    assert [each.material for each in together] == [(MisfitGroup.RADIAL,), (), (MisfitGroup.AFFINE,), (), ()]


def test_no_camera_is_no_decision():
    assert decide_each([], alpha=0.05, tau_px=np.empty(0)) == []
