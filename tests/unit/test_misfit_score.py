"""The score test of one image against dense linear algebra (method.md section 5, steps 1 to 4)."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from misfit_reference import PARAMS, camera, columns_of, interleaved, planar_points, points, slow_tests
from numpy.testing import assert_allclose
from scipy import stats

from sfm_audit.audit.misfit import GROUPS, MisfitGroup, MisfitStatus, prepare, prepare_image, project_image
from sfm_audit.audit.misfit.basis import field_transform, largest_sq
from sfm_audit.audit.misfit.outcome import judged_by_f
from sfm_audit.loaders.camera_models import CAMERA_MODELS


def assert_equal_to_reference(found, reference):
    for group in GROUPS:
        test, slow = found[group], reference[group]
        assert test.rank == slow.rank, group
        assert (test.status is MisfitStatus.TESTED) == (not math.isnan(slow.p)), group
        if test.status is MisfitStatus.TESTED:
            assert_allclose(test.p, slow.p, rtol=1e-6, err_msg=group)
            assert_allclose(test.px, slow.px, rtol=1e-6, atol=1e-9, err_msg=group)


def bent(rng, projected, sigma=0.5):
    """Residuals with noise and a radial field on top."""
    away = projected.xy_px - np.array([[800.0], [600.0]])
    r2 = (away**2).sum(axis=0) / 1e6
    return sigma * rng.standard_normal(away.shape) + away * (0.002 * r2**2)


@pytest.mark.parametrize("exact", [False, True])
@pytest.mark.parametrize("n", [30, 120, 500])
@pytest.mark.parametrize("name", sorted(PARAMS))
def test_equals_dense_linear_algebra(name, n, exact):
    rng = np.random.default_rng(n)
    cam, xyz = camera(name), points(rng, n)
    y = bent(rng, project_image(cam, xyz))
    nuisance, fields = columns_of(cam, xyz)
    found = prepare(nuisance, fields, exact=exact).test(y)
    assert_equal_to_reference(found, slow_tests(interleaved(nuisance), interleaved(fields), y.T.ravel()))


AWKWARD = {
    "k1 = 0": (camera("SIMPLE_RADIAL", (0.0,)), points),
    "planar": (camera("SIMPLE_RADIAL"), planar_points),
    "planar pinhole": (camera("SIMPLE_PINHOLE"), planar_points),
    "a tenth of the image": (camera(), lambda rng, n: points(rng, n, centre=(0.8, -0.8), spread=0.1)),
    "a twentieth of the image": (camera("OPENCV"), lambda rng, n: points(rng, n, centre=(-0.5, 0.5), spread=0.05)),
    "far away": (camera(), lambda rng, n: points(rng, n, depths=(4000.0, 4000.5))),
    "one row": (camera(), lambda rng, n: points(rng, n) * np.array([1.0, 0.0, 1.0])),
    "tele": (camera(focal=40000.0), points),
}


@pytest.mark.parametrize("case", sorted(AWKWARD))
def test_gram_path_falls_back_where_ranks_are_in_doubt(case):
    cam, where = AWKWARD[case]
    rng = np.random.default_rng(3)
    nuisance, fields = columns_of(cam, where(rng, 300))
    y = rng.standard_normal((2, 300))
    fast, exact = prepare(nuisance, fields).test(y), prepare(nuisance, fields, exact=True).test(y)
    for group in GROUPS:
        assert fast[group].rank == exact[group].rank, group
        assert fast[group].status is exact[group].status, group
        assert_allclose(fast[group].p, exact[group].p, rtol=1e-6, err_msg=group)
        assert_allclose(fast[group].px, exact[group].px, rtol=1e-6, atol=1e-9, err_msg=group)


@pytest.mark.parametrize("case", ["k1 = 0", "planar", "planar pinhole", "far away", "one row", "tele"])
def test_awkward_ranks_are_those_of_dense_linear_algebra(case):
    cam, where = AWKWARD[case]
    rng = np.random.default_rng(3)
    nuisance, fields = columns_of(cam, where(rng, 300))
    y = rng.standard_normal((2, 300))
    reference = slow_tests(interleaved(nuisance), interleaved(fields), y.T.ravel())
    assert_equal_to_reference(prepare(nuisance, fields).test(y), reference)


RANKS = {
    "SIMPLE_PINHOLE": {},
    "PINHOLE": {MisfitGroup.AFFINE: 1},
    "SIMPLE_RADIAL": {},
    "RADIAL": {MisfitGroup.RADIAL: 1},
    "OPENCV": {MisfitGroup.RADIAL: 1, MisfitGroup.TANGENTIAL: 0, MisfitGroup.AFFINE: 1},
    "FULL_OPENCV": {MisfitGroup.RADIAL: 0, MisfitGroup.TANGENTIAL: 0, MisfitGroup.AFFINE: 1},
    "FOV": {MisfitGroup.AFFINE: 1},
    "SIMPLE_RADIAL_FISHEYE": {},
    "RADIAL_FISHEYE": {MisfitGroup.RADIAL: 1},
    "OPENCV_FISHEYE": {MisfitGroup.RADIAL: 0, MisfitGroup.AFFINE: 1},
    "THIN_PRISM_FISHEYE": {MisfitGroup.RADIAL: 0, MisfitGroup.TANGENTIAL: 0, MisfitGroup.AFFINE: 1},
    "RAD_TAN_THIN_PRISM_FISHEYE": {MisfitGroup.RADIAL: 0, MisfitGroup.TANGENTIAL: 0, MisfitGroup.AFFINE: 1},
    "SIMPLE_DIVISION": {},
    "DIVISION": {MisfitGroup.AFFINE: 1},
    "SIMPLE_FISHEYE": {},
    "FISHEYE": {MisfitGroup.AFFINE: 1},
    "EUCM": {MisfitGroup.AFFINE: 1},
}


@pytest.mark.parametrize("name", sorted(RANKS))
def test_a_group_that_the_camera_has_is_null_and_no_pass(name):
    rng = np.random.default_rng(5)
    found = prepare_image(camera(name), points(rng, 400)).test(rng.standard_normal((2, 400)))
    for group in (MisfitGroup.RADIAL, MisfitGroup.TANGENTIAL, MisfitGroup.AFFINE, MisfitGroup.PRINCIPAL_POINT):
        rank = RANKS[name].get(group, 2)
        assert found[group].rank == rank, group
        if rank == 0:
            assert found[group].status is MisfitStatus.ABSORBED
            assert math.isnan(found[group].p)
            assert math.isnan(found[group].px)


def test_every_camera_model_runs():
    rng = np.random.default_rng(6)
    xyz, y = points(rng, 200), rng.standard_normal((2, 200))
    for model in CAMERA_MODELS:
        found = prepare_image(camera(model.name), xyz).test(y)
        assert tuple(found) == GROUPS
        statuses = {test.status for test in found.values()}
        assert statuses == {MisfitStatus.NO_FIELDS} if model.is_spherical else MisfitStatus.TESTED in statuses


@pytest.mark.parametrize("n", range(12))
def test_few_points_are_not_enough_evidence(n):
    rng = np.random.default_rng(n)
    found = prepare_image(camera(), points(rng, n)).test(rng.standard_normal((2, n)))
    for group, test in found.items():
        tested = test.status is MisfitStatus.TESTED
        assert tested == (n >= 8 and test.rank == 2 and group is not MisfitGroup.SMOOTH), (group, test)
        assert tested or test.status is MisfitStatus.NOT_ENOUGH_EVIDENCE
        assert tested != math.isnan(test.p)


def test_four_observations_per_rank_are_enough():
    rng = np.random.default_rng(7)
    for n, enough in ((103, False), (104, True)):
        test = prepare_image(camera(), points(rng, n)).test(rng.standard_normal((2, n)))[MisfitGroup.SMOOTH]
        assert test.rank == 26
        assert (test.status is MisfitStatus.TESTED) == enough


def test_residuals_that_do_not_vary_are_null():
    rng = np.random.default_rng(8)
    prepared = prepare_image(camera(), points(rng, 200))
    for y in (np.zeros((2, 200)), np.full((2, 200), 1e200)):
        assert {test.status for test in prepared.test(y).values()} <= {MisfitStatus.SINGULAR, MisfitStatus.TESTED}
    lonely = np.zeros((2, 200))
    lonely[:, 7] = 1.0
    assert prepared.test(np.zeros((2, 200)))[MisfitGroup.RADIAL].status is MisfitStatus.SINGULAR
    assert prepared.test(lonely)[MisfitGroup.SMOOTH].p >= 0


def test_a_derivative_that_is_not_finite_refuses_its_group_only():
    rng = np.random.default_rng(9)
    nuisance, fields = columns_of(camera(), points(rng, 200))
    fields[9, 0, 3] = np.inf
    found = prepare(nuisance, fields).test(rng.standard_normal((2, 200)))
    assert found[MisfitGroup.ROLLING_SHUTTER].status is MisfitStatus.NOT_FINITE
    assert found[MisfitGroup.RADIAL].status is MisfitStatus.TESTED
    nuisance[2, 1, 5] = np.nan
    found = prepare(nuisance, fields).test(rng.standard_normal((2, 200)))
    assert {test.status for test in found.values()} == {MisfitStatus.NOT_FINITE}


def test_absurd_focal_lengths_do_not_overflow():
    rng = np.random.default_rng(10)
    cam = camera("SIMPLE_PINHOLE", focal=1e200)
    found = prepare_image(cam, points(rng, 200)).test(rng.standard_normal((2, 200)))
    assert found[MisfitGroup.RADIAL].status is MisfitStatus.TESTED


def test_clusters_and_rows():
    rng = np.random.default_rng(11)
    cam, n = camera(), 400
    nuisance, fields = columns_of(cam, points(rng, n))
    y, cluster = rng.standard_normal((2, n)), rng.integers(0, 150, n)
    rows = rng.permutation(n)[:300]
    found = prepare(nuisance, fields, rows=rows, clusters=cluster[rows]).test(y[:, rows])
    reference = slow_tests(
        interleaved(nuisance[:, :, rows]),
        interleaved(fields[:, :, rows]),
        y[:, rows].T.ravel(),
        np.repeat(cluster[rows], 2),
    )
    assert_equal_to_reference(found, reference)


def test_preparing_leaves_its_arguments_alone():
    rng = np.random.default_rng(12)
    nuisance, fields = columns_of(camera(), points(rng, 100))
    before = nuisance.copy(), fields.copy()
    y = rng.standard_normal((2, 100))
    first = prepare(nuisance, fields).test(y)
    assert (nuisance == before[0]).all()
    assert (fields == before[1]).all()
    assert prepare(nuisance, fields).test(y) == first


def test_p_keeps_its_digits_in_the_tail():
    """For r = 2 the F tail is (1 - T / n)^((n - 2) / 2) exactly."""
    for n in (10, 250, 5000):
        for share in (1e-6, 0.1, 0.5, 0.9):
            (test,) = judged_by_f(np.array([math.sqrt(share * n), 0.0]), np.eye(2), [2], n, n)
            exact = 0.5 * (n - 2) * math.log1p(-share)
            if exact > math.log(1e-300):
                assert_allclose(math.log(test.p), exact, rtol=1e-11, atol=1e-13)
    assert judged_by_f(np.array([math.sqrt(250.0), 0.0]), np.eye(2), [2], 250, 250)[0].p == 0.0


@pytest.mark.parametrize("unit", [1e-140, 1e-40, 1e-20, 1e20, 1e40, 1e140])
def test_the_units_of_fields_do_not_matter(unit):
    """Whether lengths enter with the transforms or, far from 1, with the fields."""
    rng = np.random.default_rng(15)
    nuisance, fields = columns_of(camera(), points(rng, 200))
    y = rng.standard_normal((2, 200))
    clusters = np.arange(200) // 2
    plain = prepare(nuisance, fields, clusters=clusters)
    mixed = prepare(nuisance, fields * np.where(np.arange(42) % 3, 1.0, unit)[:, None, None], clusters=clusters)
    for group in GROUPS:
        one, other = plain.test(y)[group], mixed.test(y)[group]
        assert (one.rank, one.status) == (other.rank, other.status)
        assert_allclose([other.p, other.px], [one.p, one.px], rtol=1e-8, atol=1e-12)
        assert_allclose(mixed.explained_px(y, group), plain.explained_px(y, group), rtol=1e-7, atol=1e-10)


def test_groups_judged_together_are_judged_as_alone():
    """What stands between two groups in the meat does not matter, nor does a singular neighbour."""
    rng = np.random.default_rng(14)
    ranks, n = [2, 1, 6], 400
    g = rng.standard_normal((sum(ranks), n))
    scores, meat = g.sum(axis=1), g @ g.T
    blocks = [slice(0, 2), slice(2, 3), slice(3, 9)]
    for singular in (False, True):
        if singular:
            meat[2, 2] = 0.0
        together = judged_by_f(scores, meat, ranks, n, n)
        for rank, own, test in zip(ranks, blocks, together, strict=True):
            (alone,) = judged_by_f(scores[own], meat[own, own], [rank], n, n)
            assert_allclose([test.p, test.px], [alone.p, alone.px], rtol=1e-12)
            assert (test.status, test.rank) == (alone.status, rank)
            if test.status is MisfitStatus.TESTED:
                statistic = scores[own] @ np.linalg.solve(meat[own, own], scores[own])
                f = statistic / rank * (n - rank) / n / (1.0 - statistic / n)
                assert_allclose(test.p, stats.f.sf(f, rank, n - rank), rtol=1e-9)
        assert [test.status is MisfitStatus.SINGULAR for test in together] == [False, singular, False]
    assert judged_by_f(np.empty(0), np.empty((0, 0)), [], n, n) == []


@pytest.mark.parametrize("value", [1e-3, 3.5e-10, 2.5e-10, 1e-12, 3.5e-14, 2.5e-14, 2e-15])
def test_a_rank_is_decided_by_the_largest_singular_value_before_projection(value):
    """Its bounds decide most cases; between them the eigenvalue itself does, and says so where it cannot."""
    before = np.diag([3.0, 0.5, 0.5])  # trace 4, largest 3
    transform = field_transform(np.diag([2.0, 1.0, value]), before)
    if 3e-14 < value < 3e-10:
        assert transform is None
    else:
        assert transform is not None
        assert transform.shape == (3, 3 if value > 3e-10 else 2)
    assert largest_sq(before) == 3.0


def test_explained_field_has_the_length_of_the_scores():
    rng = np.random.default_rng(13)
    cam, n = camera(), 2000
    xyz = points(rng, n)
    prepared = prepare_image(cam, xyz)
    y = bent(rng, project_image(cam, xyz), sigma=0.1)
    field = prepared.explained_px(y, MisfitGroup.RADIAL)
    test = prepared.test(y)[MisfitGroup.RADIAL]
    assert_allclose(np.sqrt((field**2).sum() / n), test.px, rtol=0.01)
    assert prepared.test(y - field)[MisfitGroup.RADIAL].px < 1e-6
    assert np.isnan(prepare_image(camera("FULL_OPENCV"), xyz).explained_px(y, MisfitGroup.RADIAL)).all()


def test_effect_is_the_length_of_the_field():
    rng = np.random.default_rng(14)
    cam, n = camera(), 3000
    nuisance, fields = columns_of(cam, points(rng, n))
    free = dataclasses.replace(prepare(nuisance, fields, exact=True))
    field = free.explained_px(fields[0], MisfitGroup.RADIAL)
    field *= 0.3 / np.sqrt((field**2).sum() / n)
    effects = [free.test(field + 0.5 * rng.standard_normal((2, n)))[MisfitGroup.RADIAL].px for _ in range(20)]
    assert_allclose(np.mean(effects), 0.3, rtol=0.03)
