"""Scores pooled over a camera's images against one dense problem of all of them."""

from __future__ import annotations

import numpy as np
import pytest
from misfit_reference import camera, points
from pooled_samples import CASES, NUM_TRACKS, assert_same, dense, designs_of

from sfm_audit.audit.misfit import MisfitGroup, MisfitStatus, camera_tests, image_design
from sfm_audit.audit.misfit.fields import NUM_FIELDS


def pooled(designs, *, exact=False):
    return camera_tests(designs.__getitem__, len(designs), NUM_TRACKS, exact=exact)


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
