"""Scores pooled over a camera's images against one dense problem of all of them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from misfit_reference import camera, interleaved, planar_points, points, slow_tests
from numpy.testing import assert_allclose

from sfm_audit.audit.misfit import GROUPS, MisfitGroup, MisfitStatus, camera_tests, image_design, project_image
from sfm_audit.audit.misfit.fields import NUM_FIELDS

NUM_TRACKS = 500


def designs_of(cam, rng, counts=(300, 250, 3, 0, 280), where=points, field=0.0):
    """Images that share a camera; some tracks are seen twice in an image; a missing k2 of size ``field``."""
    out = []
    for n in counts:
        xyz = where(rng, n)
        track = rng.permutation(NUM_TRACKS)[:n]
        track[: n // 50] = track[n // 2 : n // 2 + n // 50]
        u = project_image(cam, xyz).u
        y = 0.5 * rng.standard_normal((2, n)) + field * 1000.0 * u * (u**2).sum(axis=0) ** 2
        out.append(image_design(cam, xyz, y, track))
    return out


def dense(designs):
    """The same as one matrix: poses block by block, intrinsics and fields stacked."""
    used = [design for design in designs if len(design.track)]
    num_values = 2 * sum(len(design.track) for design in used)
    poses = np.zeros((num_values, 6 * len(used)))
    start = 0
    for i, design in enumerate(used):
        stop = start + 2 * len(design.track)
        poses[start:stop, 6 * i : 6 * i + 6] = interleaved(design.pose)
        start = stop
    intrinsics = np.concatenate([interleaved(design.intrinsics) for design in used])
    fields = np.concatenate([interleaved(design.fields) for design in used])
    y = np.concatenate([design.residuals_px.T.ravel() for design in used])
    cluster = np.concatenate([np.repeat(design.track, 2) for design in used])
    return slow_tests(np.hstack([poses, intrinsics]), fields, y, cluster, law="chi2")


def pooled(designs, *, exact=False):
    return camera_tests(designs.__getitem__, len(designs), NUM_TRACKS, exact=exact)


def assert_same(found, reference):
    for group in GROUPS:
        test, slow = found.tests[group], reference[group]
        assert test.rank == slow.rank, group
        assert (test.status is MisfitStatus.TESTED) == (not math.isnan(slow.p)), group
        if test.status is MisfitStatus.TESTED:
            assert_allclose(test.p, slow.p, rtol=1e-6, err_msg=group)
            assert_allclose(test.px, slow.px, rtol=1e-6, atol=1e-7, err_msg=group)


CASES = {
    "simple radial": (camera(), points),
    "opencv": (camera("OPENCV"), points),
    "full opencv": (camera("FULL_OPENCV"), points),
    "fisheye": (camera("OPENCV_FISHEYE"), points),
    "rational": (camera("EUCM"), points),
    "k1 = 0": (camera("SIMPLE_RADIAL", (0.0,)), points),
    "pinhole": (camera("SIMPLE_PINHOLE"), points),
    "planar": (camera(), planar_points),
    "a part of the images": (camera(), lambda rng, n: points(rng, n, centre=(0.5, 0.5), spread=0.1)),
}


@pytest.mark.parametrize("exact", [False, True])
@pytest.mark.parametrize("case", sorted(CASES))
def test_equals_one_dense_problem(case, exact):
    cam, where = CASES[case]
    designs = designs_of(cam, np.random.default_rng(1), where=where, field=0.01)
    found = pooled(designs, exact=exact)
    assert_same(found, dense(designs))
    assert found.num_images == 4
    assert found.num_observations == 833
    assert found.num_tracks == len(np.unique(np.concatenate([design.track for design in designs])))


def test_one_image_is_the_image_clustered_by_track():
    designs = designs_of(camera(), np.random.default_rng(2), counts=(300,))
    assert_same(pooled(designs), dense(designs))


def test_four_tracks_per_rank_not_four_observations():
    """Many images of few points are little evidence."""
    rng = np.random.default_rng(3)
    cam, xyz, designs = camera(), points(rng, 23), []
    for _ in range(40):
        shift = rng.uniform(-0.2, 0.2, 3)
        designs.append(image_design(cam, xyz + shift, rng.standard_normal((2, 23)), np.arange(23)))
    tests = pooled(designs).tests
    assert tests[MisfitGroup.RADIAL].status is MisfitStatus.TESTED
    assert tests[MisfitGroup.ROLLING_SHUTTER].status is MisfitStatus.NOT_ENOUGH_EVIDENCE
    assert tests[MisfitGroup.SMOOTH].status is MisfitStatus.NOT_ENOUGH_EVIDENCE


def test_nothing_to_test():
    rng = np.random.default_rng(4)
    assert {t.status for t in pooled([]).tests.values()} == {MisfitStatus.NOT_ENOUGH_EVIDENCE}
    few = pooled(designs_of(camera(), rng, counts=(3, 2, 0)))
    assert {t.status for t in few.tests.values()} == {MisfitStatus.NOT_ENOUGH_EVIDENCE}
    panorama = pooled(designs_of(camera("EQUIRECTANGULAR"), rng, counts=(30,)))
    assert {t.status for t in panorama.tests.values()} == {MisfitStatus.NO_FIELDS}
    designs = designs_of(camera(), rng)
    designs[1].pose[2, 1, 7] = np.nan
    assert {t.status for t in pooled(designs).tests.values()} == {MisfitStatus.NOT_FINITE}
    designs = designs_of(camera(), rng)
    designs[1].fields[NUM_FIELDS - 1, 0, 7] = np.nan
    tests = pooled(designs).tests
    assert tests[MisfitGroup.SMOOTH].status is MisfitStatus.NOT_FINITE
    assert tests[MisfitGroup.RADIAL].status is MisfitStatus.TESTED


def test_a_shared_wrong_camera_is_found_and_its_healthy_twin_is_not():
    wrong = pooled(designs_of(camera(), np.random.default_rng(5), counts=(250,) * 8, field=0.05)).tests
    assert wrong[MisfitGroup.RADIAL].p < 1e-50
    healthy = pooled(designs_of(camera(), np.random.default_rng(5), counts=(250,) * 8)).tests
    assert min(test.p for test in healthy.values()) > 0.01


def test_pooling_sees_what_no_image_can():
    """k2 = 0.004 in 30 images of 150 points: a third of a sigma."""
    rng = np.random.default_rng(6)
    designs = designs_of(camera(), rng, counts=(150,) * 30, field=0.004)
    assert pooled(designs).tests[MisfitGroup.RADIAL].p < 1e-6


def test_same_input_same_digits():
    designs = designs_of(camera(), np.random.default_rng(7))
    assert repr(pooled(designs)) == repr(pooled(designs))
