"""Models that were printed, exported or flipped: what is said of them, and what is not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sfm_audit import AuditConfig, audit_model, audit_reconstruction
from sfm_audit.audit.inliers.residuals import model_residuals
from sfm_audit.audit.inliers.stored_errors import compare_stored_errors, stale_finding
from sfm_audit.audit.simulate.adjust import adjust_scene, sparse_model
from sfm_audit.audit.simulate.scene import SceneSpec, simulate_scene
from sfm_audit.audit.table.words import POLICIES
from sfm_audit.loaders.model import FindingCode


def simulated(num_images=8, points_per_image=120):
    scene = simulate_scene(
        SceneSpec(num_images=num_images, points_per_image=points_per_image), np.random.default_rng(3)
    )
    return sparse_model(scene, adjust_scene(scene))


@pytest.fixture(scope="module")
def model():
    model = simulated()
    errors = model_residuals(model)
    count = np.bincount(errors.point_idx, minlength=len(model.points))
    total = np.bincount(errors.point_idx, np.hypot(*errors.residuals_px), minlength=len(model.points))
    stored = np.divide(total, count, out=np.full(len(count), -1.0), where=count > 0)
    return replace(model, points=replace(model.points, stored_error_px=stored))


def feed_forward(model):
    """As a network writes it: one view per point, points unprojected in float32, pixels as 2D points."""
    residuals = model_residuals(model)
    rows = residuals.observation_row
    xyz_world = np.empty((len(rows), 3))
    xy_px = np.round(model.observations.xy_px[rows])
    quats = np.empty((len(model.images), 4))
    offsets = np.zeros(len(model.images) + 1, dtype=np.int64)
    for i in range(len(model.images)):
        image, own = model.image(i), residuals.rows(i)
        focal, cx, cy = (np.float32(value) for value in image.camera.params[:3])
        depth = image.cam_from_world(model.points.xyz_world[residuals.point_idx[own]])[:, 2].astype(np.float32)
        rotation = image.rotation_cam_from_world.astype(np.float32)
        cam = np.column_stack([(xy_px[own].astype(np.float32) - [cx, cy]) / focal * depth[:, None], depth])
        cam = cam.astype(np.float32)
        translation = image.translation_cam_from_world.astype(np.float32)
        xyz_world[own] = ((cam - translation) @ rotation).astype(np.float32)
        x, y, z, w = Rotation.from_matrix(rotation.astype(np.float64)).as_quat()
        quats[i], offsets[i + 1] = [w, x, y, z], own.stop
    translations = model.images.translation_cam_from_world.astype(np.float32).astype(np.float64)
    params = model.cameras.params.astype(np.float32).astype(np.float64)
    params[model.cameras.param_offsets[:-1] + 3] = 0.0  # networks have pinhole cameras
    own_point = np.arange(len(rows), dtype=np.int64)
    return replace(
        model,
        cameras=replace(model.cameras, params=params),
        images=replace(model.images, quat_cam_from_world_wxyz=quats, translation_cam_from_world=translations),
        points=replace(
            model.points,
            point3d_id=own_point.astype(np.uint64),
            xyz_world=xyz_world,
            stored_error_px=np.full(len(rows), -1.0),
        ),
        observations=replace(
            model.observations, offsets=offsets, point2d_idx=own_point, xy_px=xy_px, point_idx=own_point
        ),
    )


def test_a_feed_forward_export_is_undetermined_under_every_policy_and_says_what_can_be_asked(model):
    exported = feed_forward(model)
    largest = np.hypot(*model_residuals(exported).residuals_px).max()
    assert 0.0 < largest < 0.01
    result = audit_reconstruction(exported)
    (text,) = [f["text"] for f in result.models.findings.item() if f["code"] == FindingCode.EXACT_PROJECTIONS]
    assert text.startswith("the 2D points of 8 images are projections of the 3D points, not measurements: ask whether ")
    assert "match the photos and triangulate" in text
    for policy in POLICIES:
        assert set(audit_model(exported, AuditConfig(policy=policy)).images.column("verdict").to_pylist()) == {
            "undetermined"
        }, policy
    assert all(any(r.startswith("exact_projections:") for r in reasons) for reasons in result.images.reasons)


@pytest.mark.parametrize("points_per_image", [15, 120])
def test_an_image_whose_points_all_lie_behind_it_says_so(points_per_image):
    model = simulated(10, points_per_image)
    flip = np.diag([-1.0, 1.0, -1.0])
    x, y, z, w = Rotation.from_matrix(flip @ model.image(2).rotation_cam_from_world).as_quat()
    quats, translations = (
        model.images.quat_cam_from_world_wxyz.copy(),
        model.images.translation_cam_from_world.copy(),
    )
    quats[2], translations[2] = [w, x, y, z], flip @ translations[2]
    images = replace(model.images, quat_cam_from_world_wxyz=quats, translation_cam_from_world=translations)
    rows = audit_model(replace(model, images=images)).images.to_pylist()
    assert rows[2]["num_inliers"] == 0
    said = "; ".join(rows[2]["reasons"])
    if points_per_image == 15:
        assert (rows[2]["verdict"], said.partition(":")[0]) == ("undetermined", "points_behind")
        assert f"all {rows[2]['num_behind']} observations lie behind the camera" in said
    else:
        assert rows[2]["verdict"] == "rejected"
        assert "100% of the points behind the camera" in said
    assert not any("behind" in reason for k in (0, 1, 3) for reason in rows[k]["reasons"])


def printed(model, digits=6):
    """As a C++ stream prints it."""

    def rounded(values):
        return np.array([float(f"{v:.{digits}g}") for v in values.ravel()]).reshape(values.shape)

    points = replace(
        model.points,
        xyz_world=rounded(model.points.xyz_world),
        stored_error_px=rounded(model.points.stored_error_px),
    )
    return replace(
        model, points=points, observations=replace(model.observations, xy_px=rounded(model.observations.xy_px))
    )


def errors_of(model):
    return compare_stored_errors(model, model_residuals(model))


def test_a_model_printed_with_six_digits_is_not_stale_where_its_mean_holds(model):
    errors = errors_of(printed(model))
    assert errors.share_stale > 0.01, "the errors of single points did change"
    assert errors.is_rounded
    assert stale_finding(errors) is None
    assert stale_finding(replace(errors, is_rounded=False)).code is FindingCode.STORED_ERRORS_STALE
    assert stale_finding(replace(errors, mean_change_px=-2e-3)).code is FindingCode.STORED_ERRORS_STALE


def test_errors_that_are_wrong_are_stale_however_they_were_printed(model):
    whole = replace(model.points, stored_error_px=model.points.stored_error_px * 1.02)
    for wrong in (replace(model, points=whole), printed(replace(model, points=whole))):
        assert stale_finding(errors_of(wrong)).code is FindingCode.STORED_ERRORS_STALE
    assert not errors_of(model).is_rounded
    assert not errors_of(printed(model, 8)).is_rounded
