"""Misfit tests of many images at once: sums in C are those of numpy, and tests from sums those of one image alone."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from misfit_models import LENSES, NUMBERS, SURE, assert_same, model_of, nearly_flat
from numpy.testing import assert_allclose

from sfm_audit.audit.inliers.projected import image_inliers
from sfm_audit.audit.inliers.residuals import model_residuals
from sfm_audit.audit.kernels import kernels_in_use, numpy_only
from sfm_audit.audit.kernels.misfit import NUM_FEATURES, Observed, misfit_sums
from sfm_audit.audit.misfit import (
    MisfitGroup,
    candidate_fields,
    coincident_keypoints,
    mixed,
    nuisance_columns,
    prepare,
)
from sfm_audit.audit.misfit import images as images_module
from sfm_audit.audit.misfit.features import affine_offset, image_features, sums_of, widened, widened_columns
from sfm_audit.audit.misfit.fields import GROUP_COLUMNS
from sfm_audit.audit.misfit.images import misfit_of_images
from sfm_audit.audit.misfit.outcome import judged_by_f
from sfm_audit.audit.misfit.stacked import Sizes, judged_by_f_together, profiled, ranks_of
from sfm_audit.audit.misfit.sums import ModelSums

compiled = pytest.mark.skipif(not kernels_in_use(), reason="no compiled kernels")


def window_of(model, residuals, images=None):
    source = ModelSums(model, residuals)
    (window,) = source.windows(list(range(len(model.images))) if images is None else images)
    return window


def assert_close(found, expected, rtol=1e-9):
    scale = np.abs(expected).max(axis=tuple(range(1, expected.ndim)), keepdims=True)
    assert np.abs((found - expected) / scale).max() < rtol


@compiled
@pytest.mark.parametrize("name", LENSES)
def test_sums_are_those_of_numpy(tmp_path, name):
    model, residuals = model_of(tmp_path, name, twins=20)
    window = window_of(model, residuals)
    (gram, on_y) = window.sums()
    found = profiled(
        widened(gram, window.offset, window.num_own),
        widened_columns(on_y, window.offset, window.num_own),
        window.num_own,
    )
    meat, leverage, num_clusters = window.meat(found.to_basis, found.on_y)
    with numpy_only():
        plain = window_of(model, residuals)
        plain_gram, plain_on_y = plain.sums()
        plain_meat, plain_leverage, plain_clusters = plain.meat(found.to_basis, found.on_y)
    root = np.sqrt(np.einsum("bii->bi", plain_gram))
    assert_close(gram / root[:, :, None] / root[:, None, :], plain_gram / root[:, :, None] / root[:, None, :])
    assert_close(on_y / root, plain_on_y / root)
    root = np.sqrt(np.einsum("bii->bi", plain_meat))
    both = [each / root[:, :, None] / root[:, None, :] for each in (meat, plain_meat)]
    used = both[0] != 0.0
    assert used[:, : window.num_own].all()
    assert_close(both[0], np.where(used, both[1], 0.0))
    assert_allclose(leverage, plain_leverage, rtol=1e-9)
    assert num_clusters.tolist() == plain_clusters.tolist()
    assert NUMBERS[0] - 26 < num_clusters[0] <= NUMBERS[0] - 20


@pytest.mark.parametrize("path", [pytest.param("compiled", marks=compiled), "numpy"])
@pytest.mark.parametrize("name", LENSES)
def test_tests_from_sums_are_those_of_one_image_alone(tmp_path, name, path):
    model, residuals = model_of(tmp_path, name, twins=20, seed=2)
    if path == "numpy":
        with numpy_only():
            found = misfit_of_images(ModelSums(model, residuals), range(len(NUMBERS)))
    else:
        found = misfit_of_images(ModelSums(model, residuals), range(len(NUMBERS)))
    assert 0 in found or name not in SURE
    for image, own in found.items():
        nuisance, expected = alone(model, residuals, image)
        flat = nuisance.reshape(len(nuisance), -1)
        assert_allclose(own.gram, flat @ flat.T, rtol=1e-9, atol=1e-9 * np.abs(flat @ flat.T).max())
        assert_same(own.tests, expected)


def alone(model, residuals, image):
    own = image_inliers(model, residuals, image)
    projected = own.projected
    nuisance = nuisance_columns(own.camera.model, projected)
    prepared = prepare(nuisance, candidate_fields(own.camera, projected), clusters=coincident_keypoints(own.xy_px))
    return nuisance, prepared.test(own.residuals_px)


def test_features_span_the_candidate_fields(tmp_path):
    """Fields in the units of the sums are candidate fields times a number."""
    model, residuals = model_of(tmp_path, "OPENCV", (200,))
    own = image_inliers(model, residuals, 0)
    fields = candidate_fields(own.camera, own.projected).reshape(42, -1)
    gram, _ = sums_of(image_features(own))
    q = len(gram) - NUM_FEATURES
    found = widened(gram[None], np.array([affine_offset(own.camera)]), q)[0, q:, q:]
    root = np.sqrt(np.diagonal(found))
    length = np.linalg.norm(fields, axis=1)
    for columns in GROUP_COLUMNS.values():
        unit = found[columns, columns] / root[columns] / root[columns, None]
        expected = fields[columns] @ fields[columns].T / length[columns] / length[columns, None]
        assert_allclose(unit, expected, atol=1e-12)


@pytest.mark.parametrize("scale", [1e-9, 1e-3, 1e9])
def test_the_unit_of_the_world_does_not_matter(tmp_path, scale):
    model, residuals = model_of(tmp_path / "1", "SIMPLE_RADIAL", (120, 90))
    images = dataclasses.replace(
        model.images, translation_cam_from_world=scale * model.images.translation_cam_from_world
    )
    points = dataclasses.replace(model.points, xyz_world=scale * model.points.xyz_world)
    other = dataclasses.replace(model, images=images, points=points)
    found = misfit_of_images(ModelSums(other, model_residuals(other)), [0, 1])
    expected = misfit_of_images(ModelSums(model, residuals), [0, 1])
    assert sorted(found) == [0, 1]
    for image, own in found.items():
        assert_same(own.tests, expected[image].tests)


@pytest.mark.parametrize("path", [pytest.param("compiled", marks=compiled), "numpy"])
@pytest.mark.parametrize("k1", [0.0, 1e-5, 1e-4, 1e-3])
def test_smooth_fields_that_nearly_are_absorbed_keep_their_digits(tmp_path, monkeypatch, k1, path):
    model, residuals = nearly_flat(tmp_path, (300, 130, 90), k1, twins=20)
    asked = []
    monkeypatch.setattr(images_module, "smooth_tests", lambda *a: asked.append(a[1]) or mixed.smooth_tests(*a))
    if path == "numpy":
        with numpy_only():
            found = misfit_of_images(ModelSums(model, residuals), [0, 1, 2])
    else:
        found = misfit_of_images(ModelSums(model, residuals), [0, 1, 2])
    assert sorted(found) == [0, 1, 2]
    assert bool(asked) == (k1 > 0)
    for image, own in found.items():
        assert_same(own.tests, alone(model, residuals, image)[1])
        assert own.tests[MisfitGroup.SMOOTH].rank == (26 if k1 >= 1e-4 else 25)


@compiled
def test_mixed_sums_are_those_of_numpy(tmp_path):
    model, residuals = model_of(tmp_path, "OPENCV", (300, 130, 70), twins=20)
    rng = np.random.default_rng(4)
    chosen, q = np.array([0, 2]), 12
    basis, on_y = rng.normal(size=(3, q, q)) * 1e-6, rng.normal(size=(3, q)) * 1e-4
    mixing = chosen, rng.normal(size=(2, 28, 28)), rng.normal(size=(2, q, 28)) * 1e-2
    found = window_of(model, residuals).mixed(basis, on_y, *mixing)
    with numpy_only():
        expected = window_of(model, residuals).mixed(basis, on_y, *mixing)
    for one, other in zip(found, expected, strict=True):
        assert_close(one, other)
    with pytest.raises(ValueError, match="mix of shape"):
        window_of(model, residuals).mixed(basis, on_y, chosen, mixing[1][:, 1:].copy(), mixing[2])


def test_ranks_near_the_threshold_stay_in_doubt():
    values = np.array([[0.5, 2.0], [0.95, 2.0], [1.05, 2.0], [0.1, 0.2]])
    ranks, certain = mixed._ranks_of(values, np.ones(4))
    assert ranks.tolist() == [1, 1, 2, 0]
    assert certain.tolist() == [True, False, False, False]


def test_images_in_doubt_are_left_out(tmp_path):
    """The numerator and the denominator of FULL_OPENCV can hardly be told apart where both are small."""
    model, residuals = model_of(tmp_path, "FULL_OPENCV", (200, 150))
    assert not misfit_of_images(ModelSums(model, residuals), [0, 1])


def test_panoramas_and_empty_images_have_no_sums(tmp_path):
    model, residuals = model_of(tmp_path, "SIMPLE_RADIAL", (100, 0))
    assert list(misfit_of_images(ModelSums(model, residuals), [0, 1])) == [0]
    assert not misfit_of_images(ModelSums(model, residuals), [])


def test_few_points_are_not_enough_evidence(tmp_path):
    model, residuals = model_of(tmp_path, "SIMPLE_RADIAL", (300, *range(1, 30, 3)))
    found = misfit_of_images(ModelSums(model, residuals), range(len(model.images)))
    assert max(found) > 5
    for image, own in found.items():
        assert_same(own.tests, alone(model, residuals, image)[1])


@compiled
@pytest.mark.parametrize("value", [math.nan, math.inf, 1e300, 5e-324, 1e17])
def test_numbers_out_of_range_are_left_to_numpy(tmp_path, value):
    model, residuals = model_of(tmp_path, "SIMPLE_RADIAL", (100, 80))
    for field in ("residuals_px", "point_jacobian"):
        array = getattr(residuals, field).copy()
        array[0, ..., 3] = value
        odd = dataclasses.replace(residuals, **{field: array})
        found = misfit_of_images(ModelSums(model, odd), [0, 1])
        with numpy_only():
            assert sorted(misfit_of_images(ModelSums(model, odd), [0, 1])) == sorted(found)
        assert 1 in found
        if not math.isfinite(value):
            assert 0 not in found


@compiled
def test_the_kernel_takes_no_other_arrays(tmp_path):
    model, residuals = model_of(tmp_path, "OPENCV", (100, 80))
    source = ModelSums(model, residuals)
    cameras = [source.camera(0), source.camera(1)]
    window = source.window([0, 1], cameras)
    observed = source.observed
    assert misfit_sums(observed, window) is not None
    for changed in (
        {"rows": window.rows + 100},
        {"rows": window.rows[:, ::-1].copy()},
        {"numbers": window.numbers[:, 1:].copy()},
        {"facts": np.array([4, 2, 0, 4, -1, -1, -1])},
        {"d_extra": (window.d_extra[0], window.d_extra[0])},
    ):
        with pytest.raises(ValueError, match=r"of shape|not there"):
            misfit_sums(observed, window._replace(**changed))
    point_idx = observed.point_idx.copy()
    point_idx[5] = len(observed.xyz_world)
    with pytest.raises(ValueError, match="row"):
        dataclasses.replace(observed, point_idx=point_idx)
    with pytest.raises(ValueError, match="lengths"):
        dataclasses.replace(observed, residuals_px=observed.residuals_px[:, 1:])
    wide = np.zeros((2, 400))[:, ::2]
    taken = Observed.of(
        observed.xyz_world,
        observed.xy_px,
        (observed.point_idx.astype(np.int64), observed.observation_row),
        wide[:, : len(observed.point_idx)],
        observed.point_jacobian,
    )
    assert taken.point_idx.dtype == np.int32
    assert misfit_sums(taken, window) is not None


def test_ranks_are_certain_only_with_digits():
    values = np.array([[1e-14, 0.5], [1e-12, 0.5], [1e-8, 0.5], [0.3, 0.5]])
    along = np.zeros((4, 3, 2))
    along[3, 0, 1] = 1e10
    ranks, certain = ranks_of(values, along)
    assert ranks.tolist() == [1, 2, 2, 2]
    assert certain.tolist() == [True, False, True, False]


def test_groups_judged_together_are_judged_as_alone():
    rng = np.random.default_rng(3)
    g = rng.standard_normal((5, 3, 40))
    g[2, 1] = g[2, 0]  # a singular meat is in doubt
    scores, meat = g.sum(axis=2), g @ g.swapaxes(1, 2)
    sizes = Sizes(np.full(5, 40), np.array([40, 39, 38, 37, 36]))
    found = judged_by_f_together(scores, meat, sizes)
    assert found[2] is None
    for b in (0, 1, 3, 4):
        (expected,) = judged_by_f(scores[b], meat[b], [3], int(sizes.num_clusters[b]), 40)
        assert found[b] is not None
        assert_allclose(found[b][:2], expected[:2], rtol=1e-9)
        assert found[b][2:] == expected[2:]
