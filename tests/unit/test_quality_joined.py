"""Images with few observations, asked together, say of their camera what each of them says by itself."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from joint_reference import SPEC, model_of
from numpy.testing import assert_array_equal

from sfm_audit.audit.camera_quality.identifiability import covariances_of_grams, parameter_covariance, unit_triangle
from sfm_audit.audit.camera_quality.joined import qualities_of_joined
from sfm_audit.audit.camera_quality.measure import CameraShape, camera_quality
from sfm_audit.audit.cameras import project_columns
from sfm_audit.audit.engine.model import ModelAuditor
from sfm_audit.audit.engine.quality import quality_of_images
from sfm_audit.audit.inliers.projected import ImageInliers, image_inliers
from sfm_audit.audit.misfit import candidate_fields, nuisance_columns, prepare
from sfm_audit.audit.misfit.untestable import MAX_POINTS, untestable_tests
from sfm_audit.audit.table.words import MisfitStatus
from sfm_audit.loaders.camera_models import BY_NAME
from sfm_audit.loaders.model import CameraRecord, ImageRecord

GRID = 8


@pytest.fixture(scope="module", params=[5, 9])
def auditor(request):
    return ModelAuditor(
        model_of(dataclasses.replace(SPEC, num_images=60, points_per_image=request.param, shared_camera=True), seed=5)
    )


def test_few_inliers_together_are_each_by_itself(auditor):
    model, residuals, sigma_px = auditor.model, auditor.residuals, auditor.sigma_constant_px
    together = quality_of_images(model, residuals, sigma_px, range(60), grid=GRID)
    assert sum(each is not None for each in together) > 50
    for k, found in enumerate(together):
        if found is None:
            continue
        shape = CameraShape.of(found.shape.camera)
        alone = camera_quality(shape, image_inliers(model, residuals, k), float(sigma_px[k]), grid=GRID)
        assert repr(found.misfit) == repr(alone.misfit)
        for name in ("expected_error_px", "median_depth", "coverage", "occupied_cells"):
            assert_array_equal(getattr(found, name), getattr(alone, name), err_msg=name)
        own, expected = found.identifiability, alone.identifiability
        assert own.parameters.names == expected.parameters.names
        assert_array_equal(own.sd_focal_rel, expected.sd_focal_rel)
        assert_array_equal(own.parameters.covariance, expected.parameters.covariance)


def test_panoramas_with_few_inliers_have_no_fields_together_either():
    panorama = CameraRecord(1, BY_NAME["EQUIRECTANGULAR"], 2000, 1000, np.array([2000.0, 1000.0]))
    own = np.random.default_rng(0).normal(size=(3 * 6, 3))
    projected = project_columns(panorama.model, panorama.params, own)
    image = ImageRecord(1, "1.jpg", 1, panorama, np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3), 6)
    extra, noise = np.empty((0, 2, len(own))), np.full((2, len(own)), 0.1)
    xy_px = np.ascontiguousarray((projected.xy_px + noise).T)
    joined = ImageInliers(image, panorama, xy_px, own, noise, np.asfortranarray(own), projected.d_xy_d_cam, extra)
    found = qualities_of_joined(CameraShape.of(panorama), joined, np.full(3, 0.5), grid=GRID)
    assert {test.status for each in found for test in each.misfit.values()} == {MisfitStatus.NO_FIELDS}
    assert [each.identifiability.has_focal for each in found] == [False] * 3


def columns_of(auditor, num_points, images=range(12)):
    """N and E of the first points of some images; every third image has two of them in one place."""
    nuisance, fields = [], []
    for k in images:
        own = image_inliers(auditor.model, auditor.residuals, k)
        if len(own) < num_points:
            continue
        chosen = np.arange(num_points)
        if k % 3 == 0 and num_points > 1:
            chosen[1] = chosen[0]
        projected = own.projected
        nuisance.append(nuisance_columns(own.camera.model, projected)[:, :, chosen])
        fields.append(candidate_fields(own.camera, projected)[:, :, chosen])
    return np.array(nuisance), np.array(fields)


@pytest.fixture(scope="module")
def rich():
    return ModelAuditor(model_of(dataclasses.replace(SPEC, num_images=12, points_per_image=60), seed=3))


@pytest.mark.parametrize("num_points", range(1, MAX_POINTS + 3))
def test_what_cannot_be_tested_is_refused_as_by_itself(rich, num_points):
    nuisance, fields = columns_of(rich, num_points)
    flat = [each.reshape(*each.shape[:2], -1) for each in (nuisance, fields)]
    found = untestable_tests(*flat, np.full(len(nuisance), num_points))
    assert len(found) == len(nuisance) > 5
    for own, its_fields, tests in zip(nuisance, fields, found, strict=True):
        if tests is not None:
            assert repr(tests) == repr(prepare(own, its_fields).test(np.ones((2, num_points))))
    assert any(tests is not None for tests in found) == (4 <= num_points <= MAX_POINTS)


def test_a_group_that_can_be_tested_is_left_to_its_image(rich):
    nuisance, fields = (each.reshape(*each.shape[:2], -1) for each in columns_of(rich, 5))
    found = untestable_tests(nuisance, fields, np.full(len(nuisance), 5))
    k = next(k for k, tests in enumerate(found) if tests and any(test.rank == 2 for test in tests.values()))
    nuisance, fields = nuisance[k : k + 1], fields[k : k + 1]
    assert untestable_tests(nuisance, fields, np.array([8]))[0] is None
    for spoilt in (0.0, np.nan, 1e200):
        odd = fields.copy()
        odd[0, 30] = spoilt
        assert untestable_tests(nuisance, odd, np.array([5]))[0] is None
        odd = nuisance.copy()
        odd[0, 2] = spoilt
        assert untestable_tests(odd, fields, np.array([5]))[0] is None


def test_covariances_in_doubt_are_left_to_their_image():
    rng = np.random.default_rng(0)
    columns = rng.normal(size=(5, 4, 12))
    columns[1, 2] = 0.0
    columns[2, 3] = columns[2, 0]
    columns[3, 1, 5] = np.nan
    columns[4, 3] = columns[4, 0] + 1e-7 * columns[4, 3]
    sigma_px = np.array([0.5, 0.5, 0.5, 0.5, np.nan])
    names = tuple("abcd")
    grams = columns @ columns.swapaxes(1, 2)
    together = covariances_of_grams(
        grams, names, sigma_px, np.full(5, 12), lambda b, norms: unit_triangle(columns[b], norms)
    )
    for own, sigma, found in zip(columns, sigma_px, together, strict=True):
        alone = parameter_covariance(own, names, float(sigma))
        assert found.names == alone.names
        assert_array_equal(found.covariance, alone.covariance)
        assert_array_equal(found.singular_share, alone.singular_share)
