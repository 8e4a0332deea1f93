"""Compiled tests of groups of candidate fields are numpy's, and what is in doubt is left to it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from joint_reference import SPEC, model_of, system_of
from numpy.testing import assert_allclose, assert_array_equal

from sfm_audit.audit.joint import image_scores, image_tests
from sfm_audit.audit.joint.candidates import CandidateScores
from sfm_audit.audit.joint.group_test import (
    KEPT_EIGENVALUE,
    MIN_OBSERVATIONS_PER_RANK,
    SINGULAR_MEAT,
    GroupSums,
    answers,
    group_root,
)
from sfm_audit.audit.joint.group_test import test_groups as judged_by_numpy
from sfm_audit.audit.joint.image_scores import GroupSumsOfImage, scores_of_many
from sfm_audit.audit.joint.image_tests import tests_of_scores as by_scores
from sfm_audit.audit.joint.image_tests import tests_of_sums as by_sums
from sfm_audit.audit.kernels import kernels_in_use
from sfm_audit.audit.kernels.joint import DENSE, DONE, FIELDS, SCALAR
from sfm_audit.audit.kernels.joint_groups import Fields, GroupLimits, group_numbers
from sfm_audit.audit.kernels.joint_scores import Scores
from sfm_audit.audit.misfit.fields import GROUP_COLUMNS, NUM_FIELDS
from sfm_audit.audit.table.words import MisfitGroup, MisfitStatus

pytestmark = pytest.mark.skipif(not kernels_in_use(), reason="no compiled kernels here: nothing to compare")
WIDTH, NUM = 9, 12
LIMITS = GroupLimits(1e-4, KEPT_EIGENVALUE, SINGULAR_MEAT, MIN_OBSERVATIONS_PER_RANK)
SMOOTH = GROUP_COLUMNS[MisfitGroup.SMOOTH]


@pytest.fixture
def rng():
    return np.random.default_rng(3)


def factors(rng, num=NUM):
    out = np.ones((num, len(image_scores._TERMS), 2))
    out[:, 4:8] = rng.uniform(0.5, 2.0, (num, 4, 2))
    return out


def sums_of(rng, *, num=NUM, tracks=300, scale=1.0, num_null=3, done=None):
    """Sums over functions whose smooth fields have ``num_null`` directions that the base absorbs."""
    functions = scale * rng.normal(size=(num, 400, FIELDS)) * rng.uniform(0.1, 10.0, FIELDS)
    plain = functions[:, :, :SCALAR].transpose(0, 2, 1) @ functions[:, :, :SCALAR]
    functions[:, :, SCALAR : 2 * SCALAR] *= (
        np.linalg.norm(functions[:, :, :SCALAR], axis=1)[:, None]
        / np.linalg.norm(functions[:, :, SCALAR : 2 * SCALAR], axis=1)[:, None]
    )
    smooth = [*range(1, SCALAR - 1), *range(SCALAR + 1, 2 * SCALAR - 1)]
    left = functions[:, :, smooth]
    gone = rng.normal(size=(num, len(smooth), num_null))
    basis = np.linalg.qr(gone)[0] if num_null else gone
    functions[:, :, smooth] = left - left @ basis @ basis.transpose(0, 2, 1)
    by_track = rng.normal(size=(num, tracks, 400)) @ functions / 20.0
    solution = rng.normal(size=(num, WIDTH, FIELDS))
    gram, meat = (each.transpose(0, 2, 1) @ each for each in (functions, by_track))
    dense_plain = np.einsum("bii->bi", gram)[:, 2 * SCALAR :].copy()
    counts = np.full(num, tracks)
    status = np.ones(num, dtype=bool) if done is None else done
    score = by_track.sum(axis=1)
    return Scores(status, counts, gram, meat, plain, dense_plain, score, np.zeros_like(solution), solution)


def numbers_of(sums, factor, *, with_rest=True):
    asked = np.full(len(factor), with_rest)
    return group_numbers(sums, Fields(image_scores._TERMS, factor, image_scores._ENDS, asked), LIMITS)


def by_numpy(sums, factor):
    """The same sums as numpy takes them, of each image."""
    out = []
    for k, made_of in enumerate(image_scores._fields_of(factor)):
        squares = image_scores._squares(sums.plain[k], sums.dense_plain[k])
        with np.errstate(over="ignore", invalid="ignore"):
            of_fields = ((squares @ made_of) * made_of).sum(axis=0), made_of.T @ sums.gram[k] @ made_of
            score, meat = made_of.T @ sums.score[k], made_of.T @ sums.meat[k] @ made_of
        at = sums.right[k], np.arange(WIDTH), sums.solution[k]
        out.append(CandidateScores(*of_fields, score, meat, int(sums.num_tracks[k]), *at, 500, made_of))
    return out


def both(sums, factor):
    """Answers of both for each group, (groups, images) each."""
    numbers, known = numbers_of(sums, factor), by_numpy(sums, factor)
    noise = np.full(len(known), 0.5), np.full(len(known), 9.0)
    for g, own in enumerate(GROUP_COLUMNS.values()):
        mine = GroupSums(numbers.statistic[:, g], numbers.gain[:, g], numbers.rank[:, g], numbers.done)
        counts = sums.num_tracks, np.full(len(known), 500)
        yield numbers.done, answers(mine, *counts, *noise), judged_by_numpy(known, own, *noise)


@pytest.mark.parametrize("scale", [1.0, 1e-60, 1e60])
@pytest.mark.parametrize("num_null", [0, 3, 27, 28])
def test_answers_are_those_of_numpy(rng, scale, num_null):
    sums, ranks = sums_of(rng, scale=scale, num_null=num_null), []
    for done, mine, theirs in both(sums, factors(rng)):
        assert done.all()
        assert [(test.rank, test.status) for test in mine] == [(test.rank, test.status) for test in theirs]
        assert_allclose([test[:3] for test in mine], [test[:3] for test in theirs], rtol=1e-9)
        ranks += [test.rank for test in mine]
    assert ranks[-NUM:] == [28 - num_null] * NUM


@pytest.mark.parametrize("tracks", [1, 5, 27, 60])
def test_few_tracks_are_refused_alike(rng, tracks):
    sums = sums_of(rng, tracks=tracks)
    for done, mine, theirs in both(sums, factors(rng)):
        assert done.all()
        assert [(test.rank, test.status) for test in mine] == [(test.rank, test.status) for test in theirs]


def test_fields_behind_the_groups_are_given_out_where_they_are_asked_for(rng):
    sums, factor = sums_of(rng), factors(rng)
    numbers, known, rest = numbers_of(sums, factor), by_numpy(sums, factor), slice(NUM_FIELDS, None)
    for k, each in enumerate(known):
        assert_allclose(numbers.rest_square[k], each.sq_length[rest], rtol=1e-10)
        assert_allclose(numbers.rest_score[k], each.score[rest], rtol=1e-10)
        for name in ("gram", "meat"):
            expected = getattr(each, name)[rest, rest]
            assert_allclose(getattr(numbers, f"rest_{name}")[k], expected, atol=1e-10 * np.abs(expected).max())
    without = numbers_of(sums, factor, with_rest=False)
    assert not without.rest_square.any()
    assert_array_equal(without.statistic, numbers.statistic)


def test_an_image_moves_as_the_group_says(rng):
    sums, factor = sums_of(rng), factors(rng)
    change, known = numbers_of(sums, factor).change, by_numpy(sums, factor)
    for k, each in enumerate(known):
        for g, own in enumerate(GROUP_COLUMNS.values()):
            root = group_root(each, own)
            expected = -each.solution[:, own] @ (root.T @ (root @ each.score[own]))
            assert_allclose(change[k, g], expected, atol=1e-9 * np.abs(expected).max())


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e300])
@pytest.mark.parametrize("name", ["gram", "meat", "score", "plain"])
def test_what_is_not_finite_or_nearly_so_is_left_to_numpy_and_changes_nobody_else(rng, name, value):
    sums, factor = sums_of(rng), factors(rng)
    expected = numbers_of(sums, factor)
    getattr(sums, name)[3].flat[0] = value
    found = numbers_of(sums, factor)
    assert found.done.tolist() == [k != 3 for k in range(NUM)]
    others = np.arange(NUM) != 3
    for mine, theirs in zip(found, expected, strict=True):
        assert mine[others].tobytes() == theirs[others].tobytes()


@pytest.mark.parametrize(("value", "done"), [(1.0, False), (1.0 + 1e-6, True), (1.0 - 1e-6, True)])
def test_an_eigenvalue_at_the_limit_is_left_to_numpy(rng, value, done):
    sums, factor = sums_of(rng, num=1), np.ones((1, len(image_scores._TERMS), 2))
    for k in (0, 1):
        sums.gram[0, 2 * SCALAR + k] = sums.gram[0, :, 2 * SCALAR + k] = 0.0
    sums.dense_plain[0, :2] = 1.0
    sums.gram[0, 2 * SCALAR, 2 * SCALAR], sums.gram[0, 2 * SCALAR + 1, 2 * SCALAR + 1] = 1.0, value * KEPT_EIGENVALUE
    numbers = numbers_of(sums, factor)
    assert numbers.done.tolist() == [done]
    assert not done or numbers.rank[0, 0] == (2 if value > 1.0 else 1)


@pytest.mark.parametrize(
    ("pivot", "done", "status"),
    [
        (1e-10, True, MisfitStatus.TESTED),
        (2e-12, False, None),
        (5e-13, False, None),
        (1e-14, True, MisfitStatus.SINGULAR),
        (0.0, True, MisfitStatus.SINGULAR),
    ],
)
def test_a_meat_that_may_be_singular_is_left_to_numpy(rng, pivot, done, status):
    sums, factor = sums_of(rng, num=1), np.ones((1, len(image_scores._TERMS), 2))
    two = slice(2 * SCALAR, 2 * SCALAR + 2)
    sums.gram[0, two], sums.gram[0, :, two] = 0.0, 0.0
    sums.gram[0, two, two] = np.diag([1.0, 0.9])  # eigenvalues apart: their order is known
    sums.dense_plain[0, :2] = 1.0
    lean = np.sqrt(1.0 - pivot)
    sums.meat[0, two, two] = np.array([[1.0, lean], [lean, 1.0]])
    numbers = numbers_of(sums, factor)
    assert numbers.done.tolist() == [done]
    if done:
        assert next(iter(both(sums, factor)))[2][0].status is status
        assert np.isnan(numbers.statistic[0, 0]) == (status is MisfitStatus.SINGULAR)


def test_a_field_whose_functions_cancel_is_left_to_numpy(rng):
    sums, factor = sums_of(rng, num=2), factors(rng, 2)
    sums.plain[0, :2, :2] = 1.0
    affine = GROUP_COLUMNS[MisfitGroup.AFFINE].start
    factor[:, affine] = 1.0, -1.0 + 1e-3
    assert numbers_of(sums, factor).done.tolist() == [False, True]


def test_a_column_without_length_is_a_direction_less(rng):
    sums, factor = sums_of(rng), factors(rng)
    sums.plain[:, 3], sums.plain[:, :, 3] = 0.0, 0.0
    sums.gram[:, 3], sums.gram[:, :, 3] = 0.0, 0.0
    for done, mine, theirs in both(sums, factor):
        assert done.all()
        assert [(test.rank, test.status) for test in mine] == [(test.rank, test.status) for test in theirs]
        assert_allclose([test[:3] for test in mine], [test[:3] for test in theirs], rtol=1e-9)


def test_nobody_and_those_without_sums_are_not_judged(rng):
    nobody = numbers_of(sums_of(rng, num=0), factors(rng, 0))
    assert nobody.statistic.shape == (0, 6)
    done = np.arange(NUM) % 2 == 0
    assert_array_equal(numbers_of(sums_of(rng, done=done), factors(rng)).done, done)


def test_functions_that_do_not_exist_are_an_error(rng):
    sums, factor = sums_of(rng, num=1), factors(rng, 1)
    asked, terms, ends = np.ones(1, dtype=bool), image_scores._TERMS, image_scores._ENDS
    for term in (-2, FIELDS):
        wrong = terms.copy()
        wrong[3, 0] = term
        with pytest.raises(ValueError, match="other functions"):
            group_numbers(sums, Fields(wrong, factor, ends, asked), LIMITS)
    with pytest.raises(ValueError, match="other functions"):
        group_numbers(sums, Fields(terms, factor, np.array([0, 33, 48]), asked), LIMITS)
    assert DENSE + 2 * SCALAR == FIELDS
    assert DONE == 0


@pytest.fixture(scope="module", params=["SIMPLE_RADIAL", "shared", "OPENCV_FISHEYE"])
def asked(request):
    spec = dataclasses.replace(SPEC, num_images=8, shared_camera=request.param == "shared")
    spec = spec if request.param == "shared" else dataclasses.replace(spec, camera_model=request.param)
    system = system_of(model_of(spec, seed=5))
    return system, scores_of_many(system, system.base)


def test_tests_and_worth_of_images_are_those_of_their_scores(asked):
    system, many = asked
    images = list(range(len(system.model.images)))
    summed, scores = many.tested(images, [1] * len(images)), many.scores(images, [1] * len(images))
    assert all(isinstance(each, GroupSumsOfImage) for each in summed)
    fields = {i: each.only(slice(0, NUM_FIELDS)) for i, each in zip(images, scores, strict=True)}
    mine, theirs = by_sums(system, summed, 1.1), by_scores(system, fields, 1.1)
    assert mine.keys() == theirs.keys()
    for image in images:
        for group in GROUP_COLUMNS:
            own, other = mine[image][0][group], theirs[image][0][group]
            assert (own.rank, own.status) == (other.rank, other.status)
            assert_allclose(own[:3], other[:3], rtol=1e-9)
        assert mine[image][1].keys() == theirs[image][1].keys()
        worth, expected = ([*each[image][1].values()] for each in (mine, theirs))
        assert_allclose(worth, expected, rtol=1e-8, atol=1e-10)
    for own, other in zip(summed, scores, strict=True):
        rest, expected = own.missing(), other.only(slice(NUM_FIELDS, None))
        for name in ("sq_length", "gram", "score", "meat"):
            theirs = getattr(expected, name)
            assert_allclose(getattr(rest, name), theirs, atol=1e-10 * np.abs(theirs).max())
        assert (rest.num_tracks, rest.num_observations) == (expected.num_tracks, expected.num_observations)


def test_worth_is_asked_for_below_alpha_alone(asked):
    system, many = asked
    images = list(range(len(system.model.images)))
    found = by_sums(system, many.tested(images, [0] * len(images)), 0.3)
    told = {(i, group) for i, (_, worth) in found.items() for group in worth}
    assert told == {(i, group) for i, (tests, _) in found.items() for group, test in tests.items() if test.p < 0.3}
    assert told


def test_images_in_doubt_have_their_scores_and_the_others_the_same_bits(asked, monkeypatch):
    system, many = asked
    images = list(range(len(system.model.images)))
    before = many.tested(images, [0] * len(images))
    numbers_of_all = image_scores._numbers_of

    def doubtful(summed):
        found = numbers_of_all(summed)
        found.done[[1, 4]] = False
        return found

    monkeypatch.setattr(image_scores, "_numbers_of", doubtful)
    after = many.tested(images, [0] * len(images))
    for image, (own, other) in enumerate(zip(after, before, strict=True)):
        assert isinstance(own, CandidateScores) == (image in {1, 4})
        if isinstance(own, GroupSumsOfImage):
            assert own.batch.numbers.statistic[image].tobytes() == other.batch.numbers.statistic[image].tobytes()
    scores = many.scores([4], [0])[0]
    assert after[4].gram.tobytes() == scores.gram.tobytes()
    assert image_tests.tests_of_sums(system, [], 0.05) == {}
