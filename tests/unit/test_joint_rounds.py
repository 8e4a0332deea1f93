"""Whom the joint test admits to the base, round by round, and the test of one group: both sides of each limit (11b)."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest

from sfm_audit.audit.joint import misfit as joint_room
from sfm_audit.audit.joint.group_test import GroupTest
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


def of_twenty(**others):
    """Twenty images, all quiet but those that are named by their row."""
    return [others.get(f"image{k}", QUIET) for k in range(20)]


def suspected(*rows: int, num=20):
    return np.isin(np.arange(num), rows)


def test_suspects_are_tested_and_included_before_anybody_else_is_tested_once(monkeypatch):
    rounds = Rounds(monkeypatch, of_twenty(image3=found(1.0), image4=[found(0.3), QUIET]))
    result = rounds.run(suspects=suspected(3, 4))
    assert np.flatnonzero(result.included).tolist() == [3]
    assert rounds.num_asked == [1] * 4 + [2] + [1] * 15  # the other suspect before and after
    all_at_once = Rounds(monkeypatch, of_twenty(image3=found(1.0), image4=[found(0.3), QUIET]))
    assert np.flatnonzero(all_at_once.run().included).tolist() == [3]
    assert all_at_once.num_asked == [2] * 3 + [1] + [2] * 16


def test_who_is_wrong_and_was_not_suspected_is_found_with_the_others(monkeypatch):
    rounds = Rounds(monkeypatch, of_twenty(image3=found(1.0), image9=found(0.4)))
    assert rounds.run(suspects=suspected(3)).round_included[3:10:6] == (0, 1)
    assert rounds.num_asked == [2] * 3 + [1] + [2] * 5 + [1] + [2] * 10


@pytest.mark.parametrize(
    ("suspects", "num_asked"),
    [
        (suspected(3), 1),
        (suspected(3, 4), 1),
        (suspected(3, 4, 5), 2),  # more than a tenth
        (suspected(), 2),
        (suspected(0), 2),  # nobody whom the test asks
        (suspected(0, 3, 4), 1),
    ],
)
def test_suspects_come_first_where_they_are_few(monkeypatch, suspects, num_asked):
    rounds = Rounds(monkeypatch, [QUIET, *of_twenty(image2=found(1.0))])
    suspects = np.append(suspects, False)
    assert np.flatnonzero(rounds.run(suspects=suspects, excluded=suspected(0, num=21)).included).tolist() == [3]
    assert rounds.num_asked[6:] == [num_asked] * 15


@pytest.mark.parametrize(("p", "admitted"), [(0.0499 / 120, [3]), (0.0501 / 120, [])])
def test_who_was_not_tested_yet_counts_as_innocent(monkeypatch, p, admitted):
    """Six groups, twenty images, one of them tested: q = 120 p, not 6 p."""
    rounds = Rounds(monkeypatch, of_twenty(image3=found(1.0, p=p)))
    assert rounds.admitted(suspects=suspected(3)) == admitted


def test_whoever_looks_beside_is_told_at_the_first_test_of_each_image(monkeypatch):
    told = []
    beside = SimpleNamespace(power=lambda _: 2, take=lambda image, scores: told.append((image, scores)))
    rounds = Rounds(monkeypatch, of_twenty(image3=found(1.0), image4=[found(0.3), QUIET]))
    monkeypatch.setattr(joint_room, "_divided", lambda scores: (scores, lambda: "missing"))
    rounds.run(suspects=suspected(3, 4), beside=beside)
    assert told[:2] == [(3, "missing"), (4, "missing")]
    assert sorted(image for image, _ in told) == list(range(20))


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
