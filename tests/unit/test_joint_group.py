"""The joint test of one group: its p, its length, and both sides of each limit (method.md section 11)."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from sfm_audit.audit.joint import group_test
from sfm_audit.audit.joint.candidates import CandidateScores
from sfm_audit.audit.joint.group_test import group_root, untested
from sfm_audit.audit.table.words import MisfitStatus

S, NAN = MisfitStatus, math.nan


def scores(num_tracks=60, num=80, gram=None, seed=1):
    track_score = np.random.default_rng(seed).normal(size=(num_tracks, 2))
    gram = np.eye(2) * num if gram is None else gram
    return CandidateScores(
        sq_length=np.full(2, float(num)),
        gram=gram,
        score=track_score.sum(axis=0) + 12.0,
        meat=track_score.T @ track_score,
        num_tracks=num_tracks,
        basis_coupling=np.zeros((0, 2)),
        support=np.zeros(0, int),
        basis_solution=np.zeros((0, 2)),
        num_observations=num,
    )


def hotelling(found, *, rms_px=9.0, meat=None, root=None):
    own = slice(0, 2)
    found = found if meat is None else replace(found, meat=meat)
    return group_test.test_group(
        found, own, group_root(found, own) if root is None else root, sigma_px=0.5, rms_px=rms_px
    )


def test_a_group_has_hotelling_s_p_and_the_length_of_what_it_explains():
    given = scores()
    result = hotelling(given)
    z, spread = given.score / math.sqrt(80), given.meat / 80
    t = z @ np.linalg.solve(spread, z)
    f = t / (60 - t) * (60 - 2) / 2
    assert result.p == pytest.approx(stats.f.sf(f, 2, 58), rel=1e-9)
    assert result.gain == pytest.approx(z @ z - np.trace(spread))
    assert result.px == pytest.approx(0.5 * math.sqrt(result.gain / 80))
    assert (result.rank, result.status) == (2, S.TESTED)


def test_scores_of_different_size_are_weighed_by_their_own_spread():
    meat = np.array([[4e4, 300.0], [300.0, 9.0]])
    given = replace(scores(), meat=meat, score=np.array([700.0, 2.0]))
    z, spread = given.score / math.sqrt(80), meat / 80
    t = z @ np.linalg.solve(spread, z)
    assert hotelling(given).p == pytest.approx(stats.f.sf(t / (60 - t) * (60 - 2) / 2, 2, 58), rel=1e-9)


def test_more_tracks_than_observations_count_as_many_as_there_are_observations():
    given = scores(num_tracks=60, num=50)
    z, spread = given.score / math.sqrt(50), given.meat / 50
    t = z @ np.linalg.solve(spread, z)
    assert hotelling(given).p == pytest.approx(stats.f.sf(t / (50 - t) * 48 / 2, 2, 48), rel=1e-9)


def test_what_noise_explains_better_has_no_length():
    given = scores()
    quiet = CandidateScores(
        **{name: getattr(given, name) for name in given.__dataclass_fields__} | {"score": np.zeros(2)}
    )
    result = hotelling(quiet)
    assert (result.px, result.p) == (0.0, pytest.approx(1.0))
    assert result.gain < 0


@pytest.mark.parametrize(("num_tracks", "num", "status"), [(8, 80, S.TESTED), (7, 80, S.NOT_ENOUGH_EVIDENCE)])
def test_four_observations_and_tracks_for_each_free_direction(num_tracks, num, status):
    assert hotelling(scores(num_tracks, num)).status is status
    assert hotelling(scores(num, num_tracks)).status is status
    assert hotelling(scores(num_tracks, num)).rank == 2


def test_an_effect_has_to_fit_into_the_residuals():
    px = hotelling(scores()).px
    assert hotelling(scores(), rms_px=px / 1.501).status is S.NOT_ESTIMABLE
    assert hotelling(scores(), rms_px=px / 1.499).status is S.TESTED
    assert hotelling(scores(), rms_px=px / 1.501).rank == 2


def test_what_cannot_be_tested_says_why():
    assert hotelling(scores(gram=np.full((2, 2), NAN))) == untested(S.NOT_FINITE)
    absorbed = hotelling(scores(gram=np.zeros((2, 2))))
    assert (absorbed.status, absorbed.rank) == (S.ABSORBED, 0)
    for meat in (np.ones((2, 2)), np.zeros((2, 2)), np.full((2, 2), NAN), np.diag([1.0, 0.0])):
        assert hotelling(scores(), meat=meat).status is S.SINGULAR
    assert math.isnan(hotelling(scores(), meat=np.ones((2, 2))).p)
    assert hotelling(scores(gram=np.array([[80.0, 0.0], [0.0, NAN]])), root=np.eye(2)) == untested(S.NOT_FINITE)


@pytest.mark.parametrize(("below_one", "status"), [(1e-13, S.SINGULAR), (1e-9, S.TESTED)])
def test_tracks_that_all_but_agree_are_singular(below_one, status):
    correlation = math.sqrt(1 - below_one)
    for unit in (1.0, 1e16):  # whatever the fields' unit
        meat = np.array([[1.0, correlation], [correlation, 1.0]]) * unit
        assert hotelling(scores(), meat=meat, root=np.eye(2)).status is status


def test_a_group_is_tested_by_itself_whatever_the_others_hold():
    """Three columns of which the last two are the group: not finite ones beside them change nothing."""
    alone = scores()
    wide = replace(
        alone,
        sq_length=np.array([NAN, 80.0, 80.0]),
        gram=np.block([[np.full((1, 1), NAN), np.full((1, 2), NAN)], [np.full((2, 1), NAN), alone.gram]]),
        score=np.array([NAN, *alone.score]),
        meat=np.block([[np.full((1, 1), NAN), np.full((1, 2), NAN)], [np.full((2, 1), NAN), alone.meat]]),
    )
    own = slice(1, 3)
    root = group_root(wide, own)
    np.testing.assert_array_equal(root, group_root(alone, slice(0, 2)))
    assert group_test.test_group(wide, own, root, sigma_px=0.5, rms_px=9.0) == hotelling(alone)


@pytest.mark.parametrize(("kept", "rank"), [(1.001e-4, 2), (0.999e-4, 1)])
def test_a_direction_that_all_but_nothing_is_left_of_is_absorbed(kept, rank):
    given = scores(gram=np.diag([80.0, 80.0 * kept]))
    root = group_root(given, slice(0, 2))
    assert len(root) == rank
    assert root @ given.gram @ root.T == pytest.approx(np.eye(rank))


def test_fields_that_are_nowhere_or_not_finite_have_no_root():
    given = scores(gram=np.diag([80.0, NAN]))
    assert group_root(given, slice(0, 2)).shape == (0, 2)
    nowhere = CandidateScores(
        **{name: getattr(given, name) for name in given.__dataclass_fields__}
        | {"sq_length": np.array([80.0, 0.0]), "gram": np.diag([80.0, 0.0])}
    )
    assert group_root(nowhere, slice(0, 2)) == pytest.approx(np.array([[1 / math.sqrt(80.0), 0.0]]))


def test_the_root_whitens_the_fields_of_an_image_in_their_own_units():
    rng = np.random.default_rng(4)
    factor = rng.standard_normal((8, 3)) * np.array([1e-3, 1.0, 1e3])
    gram = factor.T @ factor
    wide = replace(scores(), gram=gram, sq_length=np.diag(gram) * np.array([1.0, 1.5, 2.0]))
    root = group_root(wide, slice(0, 3))
    np.testing.assert_allclose(root @ gram @ root.T, np.eye(3), atol=1e-9)


def test_a_stack_of_images_is_judged_as_each_of_them_alone():
    """Different ranks, lengths, numbers of tracks, and one that is not finite: nobody hears of the others."""
    gram = np.array([[80.0, 30.0], [30.0, 70.0]])
    several = [
        scores(seed=1, gram=gram),
        scores(seed=2, gram=np.diag([80.0, 0.0]), num=90),
        replace(scores(seed=3), sq_length=np.array([40.0, 160.0])),
        scores(seed=4, gram=np.full((2, 2), NAN)),
        scores(num_tracks=3, num=30, seed=5),
        replace(scores(seed=6), meat=np.ones((2, 2))),
        replace(scores(seed=7), sq_length=np.array([0.0, 80.0])),
    ]
    own, sigma_px, rms_px = slice(0, 2), np.linspace(0.3, 0.9, 7), np.full(7, 9.0)
    rms_px[2] = 1e-3
    together = group_test.test_groups(several, own, sigma_px, rms_px)
    assert [test.status for test in together] == [
        *(S.TESTED, S.TESTED, S.NOT_ESTIMABLE, S.NOT_FINITE, S.NOT_ENOUGH_EVIDENCE, S.SINGULAR, S.TESTED)
    ]
    for k, each in enumerate(several):
        root = group_root(each, own)
        alone = group_test.test_group(each, own, root, sigma_px=sigma_px[k], rms_px=rms_px[k])
        assert (together[k].rank, together[k].status) == (alone.rank if k != 3 else None, alone.status)
        assert together[k][:3] == pytest.approx(alone[:3], nan_ok=True)
        if together[k].status is S.TESTED and len(root) == 2:
            whitened = root @ each.gram @ root.T
            assert whitened == pytest.approx(np.eye(2), abs=1e-12)
    assert group_test.test_groups([], own, np.zeros(0), np.zeros(0)) == []
