"""How often is an observation projected in an audit? Once; and what was kept of it is what projecting again gives."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from joint_reference import SPEC, model_of
from numpy.testing import assert_allclose

from sfm_audit.audit.cameras import projection
from sfm_audit.audit.engine.model import ModelAuditor
from sfm_audit.audit.inliers import kept
from sfm_audit.audit.inliers.projected import image_inliers, project_image
from sfm_audit.audit.inliers.residuals import model_residuals
from sfm_audit.audit.kernels import numpy_only
from sfm_audit.audit.kernels.projection import project_scene

MODELS = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE")
GRID_POINTS = 256  # of a map of expected errors, of one camera or several: rays of pixels, no observations


@pytest.fixture
def projected(monkeypatch):
    """Sizes of all that is projected from now on, measurement grids and the kernel's distortion columns apart."""
    sizes = []
    plane = projection._plane

    def counted(model, params, xyz_cam, want):
        if len(xyz_cam) % GRID_POINTS:
            sizes.append(len(xyz_cam))
        return plane(model, params, xyz_cam, want)

    def counted_scene(scene):
        found = project_scene(scene)
        sizes.append(0 if found is None else len(scene.point_idx))
        return found

    monkeypatch.setattr(projection, "_plane", counted)
    monkeypatch.setattr(kept, "project_scene", counted_scene)
    return sizes


@pytest.mark.parametrize("shared", [False, True])
def test_an_audit_projects_each_observation_once(projected, shared):
    model = model_of(dataclasses.replace(SPEC, shared_camera=shared), seed=3)
    projected.clear()
    tables = ModelAuditor(model).tables(observations=True)
    assert tables.images["verdict"].to_pylist() == ["accepted"] * len(model.images)
    assert sum(projected) == len(model.observations)
    projected.clear()
    with numpy_only():
        ModelAuditor(model).tables(observations=True)
    assert sum(projected) == len(model.observations)


@pytest.mark.parametrize(
    "name", ["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE"]
)
def test_what_was_kept_is_what_projecting_again_gives(name):
    model = model_of(dataclasses.replace(SPEC, num_images=4, camera_model=name), seed=1)
    residuals = model_residuals(model)
    chosen = np.arange(0, residuals.rows(2).stop - residuals.rows(2).start, 3)
    for own in (image_inliers(model, residuals, 2), image_inliers(model, residuals, 2, chosen)):
        kept, again = own.projected, project_image(own.camera, own.xyz_cam)
        assert len(own)
        for field in ("xy_px", "u", "pose", "d_params"):
            expected = getattr(again, field)
            scale = np.abs(expected).max(axis=-1, keepdims=True)
            assert_allclose(getattr(kept, field) - expected, 0.0 * expected, atol=1e-13 * scale.max())
        assert_allclose(own.xy_px.T - again.xy_px, own.residuals_px, atol=1e-12)
