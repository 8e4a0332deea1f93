"""Small images of one camera, projected together in numpy, are each by itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from kernel_samples import model_with
from numpy.testing import assert_allclose, assert_array_equal

from sfm_audit.audit.inliers import kept
from sfm_audit.audit.inliers.residuals import image_residuals, model_residuals
from sfm_audit.audit.inliers.small import groups, project_small
from sfm_audit.audit.kernels import numpy_only
from sfm_audit.loaders.camera_models import CAMERA_MODELS

SIZES = (5, 0, 40, 64, 65, 3, 1, 5)


def shared(name, sizes=SIZES, seed=0):
    """A model all of whose images have one camera."""
    model = model_with(name, seed, sizes)
    return replace(model, images=replace(model.images, camera_idx=np.zeros(len(sizes), dtype=np.int64)))


def assert_each_by_itself(model):
    with numpy_only():
        found = model_residuals(model)
    for image_idx in range(len(model.images)):
        linked = slice(*model.observations.offsets[image_idx : image_idx + 2])
        point_idx = model.observations.point_idx[linked]
        image = model.image(image_idx)
        with np.errstate(all="ignore"):
            part = image_residuals(
                image, model.observations.xy_px[linked], model.points.xyz_world[point_idx], point_idx
            )
            own, jacobian = found.rows(image_idx), image.rotation_cam_from_world.T @ part.jacobian_cam
        assert_array_equal(found.observation_row[own] - linked.start, part.inlier_row)
        assert_allclose(found.residuals_px[:, own], part.residuals_px, rtol=1e-12, atol=1e-12)
        assert_allclose(
            found.point_jacobian[:, :, own], jacobian, rtol=1e-9, atol=1e-9 * np.abs(jacobian).max(initial=0)
        )
        assert found.d_extra[image_idx].shape[1:] == part.d_extra.shape[1:]
        assert_allclose(found.d_extra[image_idx].ravel(), part.d_extra.ravel(), rtol=1e-12)
        assert_allclose(found.pose_offset_px[image_idx], part.pose_offset_px, rtol=1e-9)
    return found


@pytest.mark.parametrize("name", [model.name for model in CAMERA_MODELS])
def test_every_camera_model(name):
    assert_each_by_itself(shared(name))


def test_images_of_one_camera_are_together_and_no_others():
    model = shared("SIMPLE_RADIAL")
    found = list(groups(model, np.arange(len(SIZES))))
    assert [each.tolist() for each in found] == [[0, 2, 3, 5, 6, 7]]
    assert [each.tolist() for each in groups(model, np.array([3, 4, 7]))] == [[3, 7]]
    camera_idx = np.array([0, 0, 1, 1, 1, 0, -1, -1])
    model = replace(model, images=replace(model.images, camera_idx=camera_idx))
    assert [each.tolist() for each in groups(model, np.arange(len(SIZES)))] == [[0, 5], [2, 3]]
    assert project_small(model, np.array([2, 3])).rows.tolist() == list(range(5, 109))


def test_what_is_together_stays_in_the_cache():
    model = shared("PINHOLE", sizes=(50,) * 200)
    found = list(groups(model, np.arange(200)))
    assert np.concatenate(found).tolist() == list(range(200))
    assert max(50 * len(each) for each in found) <= 4096 + 50


@pytest.mark.parametrize("fault", ["behind", "dangling", "nan", "far", "rounding", "camera"])
def test_an_observation_that_is_no_inlier_leaves_each_image_to_itself(fault):
    model = shared("OPENCV")
    xyz, point_idx, xy = (
        model.points.xyz_world.copy(),
        model.observations.point_idx.copy(),
        model.observations.xy_px.copy(),
    )
    params = model.cameras.params.copy()
    if fault == "behind":
        xyz[point_idx[7], 2] *= -1.0
    if fault == "dangling":
        point_idx[7] = -1
    if fault == "nan":
        xy[7] = np.nan
    if fault == "far":
        xyz[point_idx[7]] = 1e13
    if fault == "rounding":
        xyz[point_idx[7]] = 1e-14
    if fault == "camera":
        params[:] = np.nan
    model = replace(
        model,
        cameras=replace(model.cameras, params=params),
        points=replace(model.points, xyz_world=xyz),
        observations=replace(model.observations, point_idx=point_idx, xy_px=xy),
    )
    assert project_small(model, np.array([0, 2, 3, 5])) is None or fault == "rounding"
    assert_each_by_itself(model)


def test_rows_of_observations_fit_32_bits_or_nothing_is_audited(monkeypatch):
    model = shared("SIMPLE_RADIAL")
    assert model_residuals(model).observation_row.dtype == np.int32
    monkeypatch.setattr(kept, "_TOO_MANY", len(model.observations))
    with pytest.raises(ValueError, match=r"fewer than 2\^31 observations"):
        model_residuals(model)
