"""Whom the joint test admits to the base, round by round, and the test of one group: both sides of each limit (11b)."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from sfm_audit.audit.joint import group_test
from sfm_audit.audit.joint import misfit as joint_room
from sfm_audit.audit.joint.candidates import CandidateScores
from sfm_audit.audit.joint.group_test import GroupTest, group_root, untested
from sfm_audit.audit.joint.worth import NO_WORTH, Worth
from sfm_audit.audit.misfit.fields import GROUP_COLUMNS
from sfm_audit.audit.table.words import GROUPS, MisfitGroup, MisfitStatus

G, S, NAN = MisfitGroup, MisfitStatus, math.nan
NOTHING = GroupTest(0.9, 0.01, 0.0, 2, S.TESTED)


def found(px=1.0, group=G.RADIAL, p=1e-9, gain=10.0, **others):
    """Tests of an image in which one group stands out."""
    return dict.fromkeys(GROUPS, NOTHING) | {group: GroupTest(p, px, gain, 2, S.TESTED)} | others


QUIET = found(p=0.9)


class Rounds:
    """`joint_misfit` with given tests; each image has a list of answers, the last one is repeated."""

    def __init__(self, monkeypatch, answers, *, shares_points=True, has_columns=None) -> None:
        self.answers, self.num_asked, self.included = answers, [0] * len(answers), []
        num = len(answers)
        layout = SimpleNamespace(has_columns=np.ones(num, bool) if has_columns is None else np.array(has_columns))
        self.system = SimpleNamespace(
            base=None,
            observations=SimpleNamespace(
                layout=layout,
                num_points=num,
                image_idx=np.arange(num),
                point_idx=np.zeros(num, int) if shares_points else np.arange(num),
                num_of=lambda _: 100,
                parts=lambda _: [slice(None)],
                nuisance=lambda *_: None,
            ),
        )
        fields = SimpleNamespace(fields=np.zeros((1, 2, 42)), nuisance=None)
        monkeypatch.setattr(joint_room, "scores_of_many", lambda *_: None)
        monkeypatch.setattr(joint_room, "_fields_of", lambda *_, **__: fields)
        monkeypatch.setattr(joint_room, "candidate_scores", lambda *_: "scores")
        monkeypatch.setattr(joint_room, "_columns_of", lambda *_, **__: fields.fields)
        monkeypatch.setattr(joint_room, "_image_tests", self._tests)
        monkeypatch.setattr(joint_room, "include", self._include)

    def _tests(self, _system, images, scores, _alpha):
        assert scores == ["scores"] * len(images)
        return [self._answer(image) for image in images]

    def _answer(self, image):
        answer = self.answers[image]
        tests = answer[min(self.num_asked[image], len(answer) - 1)] if isinstance(answer, list) else answer
        self.num_asked[image] += 1
        return tests, {G.RADIAL: Worth(1.0, 2.0, 3.0)}

    def _include(self, _base, candidates):
        self.included.append([(each.image_idx, each.fields.shape[2]) for each in candidates])
        return "grown"

    def run(self, tau_px=0.2, alpha=0.05, **options):
        tau = np.broadcast_to(np.asarray(tau_px, float), (len(self.answers),))
        return joint_room.joint_misfit(self.system, alpha=alpha, tau_px=tau, **options)

    def admitted(self, **options):
        return np.flatnonzero(self.run(**options).included).tolist()


@pytest.mark.parametrize(
    ("px", "tau_px", "admitted"),
    [
        (0.1, 0.2, []),
        (0.1001, 0.2, [0]),
        (0.1001, 9.0, [0]),
        (0.1, 9.0, []),
        (0.05, 0.1, []),
        (0.0501, 0.1, [0]),
        (0.1, NAN, []),
        (0.1001, NAN, [0]),
    ],
)
def test_an_image_is_admitted_above_a_tenth_of_a_pixel_or_half_of_tau(monkeypatch, px, tau_px, admitted):
    assert Rounds(monkeypatch, [found(px), QUIET, QUIET, QUIET]).admitted(tau_px=tau_px) == admitted


def test_a_round_admits_what_has_half_of_the_largest_effect(monkeypatch):
    answers = [found(1.0), found(0.5), [found(0.4999), QUIET], *[QUIET] * 5]
    rounds = Rounds(monkeypatch, answers)
    result = rounds.run()
    assert result.round_included == (0, 0, -1, -1, -1, -1, -1, -1)
    assert rounds.included == [[(0, 2), (1, 2)]]
    again = Rounds(monkeypatch, [found(1.0), found(0.5), found(0.4999), *[QUIET] * 5]).run()
    assert again.round_included[:3] == (0, 0, 1)


@pytest.mark.parametrize(("num_quiet", "admitted"), [(2, [0, 1]), (1, [])])
def test_nobody_is_admitted_if_more_than_half_would_be(monkeypatch, num_quiet, admitted):
    assert Rounds(monkeypatch, [found(), found(), *[QUIET] * num_quiet]).admitted() == admitted


def test_those_admitted_before_count_too(monkeypatch):
    answers = [found(1.0), [QUIET, found(0.3)], [QUIET, found(0.3)], [QUIET, found(0.3)], QUIET, QUIET]
    result = Rounds(monkeypatch, answers).run()
    assert result.round_included == (0, -1, -1, -1, -1, -1)  # 4 of 6
    result = Rounds(monkeypatch, [*answers[:3], *[QUIET] * 3]).run()
    assert result.round_included == (0, 1, 1, -1, -1, -1)  # 3 of 6


def test_the_admitted_group_is_the_largest_significant_one(monkeypatch):
    tests = found(
        0.3, G.SMOOTH, rolling_shutter=GroupTest(1e-9, 0.5, 1.0, 6, S.TESTED), affine=NOTHING._replace(px=9.0)
    )
    rounds = Rounds(monkeypatch, [{G(group): test for group, test in tests.items()}, QUIET, QUIET])
    assert rounds.run().effect_px.tolist() == [0.5, 0.0, 0.0]
    assert rounds.included == [[(0, GROUP_COLUMNS[G.ROLLING_SHUTTER].stop - GROUP_COLUMNS[G.ROLLING_SHUTTER].start)]]


def test_only_images_that_share_points_are_asked_again_and_an_admitted_one_keeps_its_tests(monkeypatch):
    rounds = Rounds(monkeypatch, [[found(1.0), QUIET], QUIET, QUIET])
    result = rounds.run()
    assert rounds.num_asked == [1, 2, 2]
    assert result.tests[0][G.RADIAL].px == 1.0
    assert result.tests[0][G.RADIAL].worth == Worth(1.0, 2.0, 3.0)
    assert result.tests[0][G.SMOOTH].worth == NO_WORTH
    apart = Rounds(monkeypatch, [found(1.0), QUIET, QUIET], shares_points=False)
    apart.run()
    assert apart.num_asked == [1, 1, 1]


def test_rounds_end_after_eight(monkeypatch):
    answers = [[*[QUIET] * k, found()] for k in range(30)]
    result = Rounds(monkeypatch, answers).run()
    assert result.round_included[:9] == (0, 1, 2, 3, 4, 5, 6, 7, -1)
    assert result.effect_px[8:10].tolist() == [1.0, 0.0]  # asked against the last base all the same


def test_between_rounds_those_in_doubt_are_asked_again_and_all_others_once_at_the_end(monkeypatch):
    doubt, none, unknown = found(p=0.0499), found(p=0.05), found(p=NAN, smooth=GroupTest(0.04, 0.01, 0.0, 2, S.TESTED))
    rounds = Rounds(monkeypatch, [found(1.0), found(0.3), found(0.05), doubt, none, unknown, QUIET, QUIET])
    result = rounds.run()
    assert result.round_included[:3] == (0, 1, -1)
    assert rounds.num_asked == [1, 2, 3, 3, 2, 3, 2, 2]
    late = Rounds(monkeypatch, [found(1.0), [QUIET, found(0.3)], *[QUIET] * 5])  # shows itself at the end: on with it
    assert late.run().round_included[:2] == (0, 1)
    assert late.num_asked == [1, 2, 3, 3, 3, 3, 3]
    full = Rounds(monkeypatch, [found(1.0), found(0.3), found(0.3), QUIET])
    assert full.run().round_included == (0, -1, -1, -1)  # three of four would be too many
    assert full.num_asked == [1, 2, 2, 2]


def test_q_is_holm_over_groups_and_benjamini_hochberg_over_those_that_wait(monkeypatch):
    answers = [found(1.0, p=1e-9), found(0.15, p=0.004), QUIET, QUIET, QUIET]
    result = Rounds(monkeypatch, answers).run()
    assert result.tests[0][G.RADIAL].q == pytest.approx(5 * 6e-9)
    assert result.tests[0][G.RADIAL].p == 1e-9
    assert result.round_included[1] == -1
    assert result.tests[1][G.RADIAL].q == pytest.approx(4 * 6 * 0.004)  # of four that wait


@pytest.mark.parametrize(("p", "significant"), [(0.05 / 12, False), (0.0499 / 12, True)])
def test_an_effect_counts_below_alpha(monkeypatch, p, significant):
    result = Rounds(monkeypatch, [found(0.09, p=p), QUIET]).run()
    assert result.effect_px.tolist() == [0.09 if significant else 0.0, 0.0]
    assert result.cause == (G.RADIAL if significant else None, None)


@pytest.mark.parametrize(("num_quiet", "most"), [(2, False), (1, True)])
def test_most_are_wrong_if_more_than_half_are_above_tau(monkeypatch, num_quiet, most):
    assert Rounds(monkeypatch, [found(0.21), found(0.21), *[QUIET] * num_quiet]).run().most_are_wrong is most
    assert not Rounds(monkeypatch, [found(0.2), found(0.2), QUIET]).run().most_are_wrong
    assert not Rounds(monkeypatch, [found(0.3), found(0.3), QUIET]).run(tau_px=NAN).most_are_wrong


def test_the_cause_pays_most_among_those_above_tau(monkeypatch):
    tests = found(
        0.3, gain=5.0, smooth=GroupTest(1e-9, 0.25, 7.0, 2, S.TESTED), affine=GroupTest(1e-9, 0.2, 99.0, 2, S.TESTED)
    )
    image = {G(group): test for group, test in tests.items()}
    assert Rounds(monkeypatch, [image, QUIET, QUIET]).run().cause[0] is G.SMOOTH
    assert Rounds(monkeypatch, [image, QUIET, QUIET]).run(tau_px=0.4).cause[0] is G.AFFINE
    assert Rounds(monkeypatch, [image, QUIET, QUIET]).run(tau_px=NAN).cause[0] is G.AFFINE


def test_who_is_wrong_otherwise_is_not_tested_unless_most_are(monkeypatch):
    answers = [found(), QUIET, QUIET, QUIET]
    excluded = np.array([True, True, False, False])
    rounds = Rounds(monkeypatch, answers)
    result = rounds.run(excluded=excluded)
    assert np.isnan(result.effect_px).tolist() == excluded.tolist()
    assert {test.status for test in result.tests[0].values()} == {S.EXCLUDED}
    assert rounds.num_asked == [0, 0, 1, 1]
    assert Rounds(monkeypatch, answers).admitted(excluded=np.array([True, True, True, False])) == [0]


def test_images_outside_of_the_system_are_not_asked(monkeypatch):
    rounds = Rounds(monkeypatch, [found(), QUIET, QUIET, found()], has_columns=[False, True, True, True])
    result = rounds.run(excluded=np.array([True, True, False, False]))
    assert {test.status for test in result.tests[0].values()} == {S.NO_COLUMNS}
    assert {test.status for test in result.tests[1].values()} == {S.EXCLUDED}
    assert result.included.tolist() == [False, False, False, True]
    assert math.isnan(result.effect_px[0])


def test_who_is_not_tested_says_why_once_for_all(monkeypatch):
    """Two without columns, two excluded, the others tested: nothing is significant where nothing was asked."""
    rounds = Rounds(monkeypatch, [QUIET] * 8, has_columns=[False, True, True, False, True, True, True, True])
    result = rounds.run(excluded=np.array([False, True, False, True, True, False, False, False]))
    statuses = [{test.status for test in tests.values()} for tests in result.tests]
    no_columns, excluded, tested = {S.NO_COLUMNS}, {S.EXCLUDED}, {S.TESTED}
    assert statuses == [no_columns, excluded, tested, no_columns, excluded, tested, tested, tested]
    assert result.tests[0] is result.tests[3]
    assert result.tests[1] is result.tests[4]
    assert result.tests[2] is not result.tests[5]
    assert result.cause == (None,) * 8
    assert np.isnan(result.effect_px).tolist() == [True, True, False, True, True, False, False, False]
    assert all(math.isnan(test.q) and math.isnan(test.p) for test in result.tests[1].values())
    assert rounds.num_asked == [0, 0, 1, 0, 0, 1, 1, 1]


# one group


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
