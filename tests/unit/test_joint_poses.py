"""How well poses are known: pycolmap's covariance in the same gauge, and the laws of a gauge."""

from __future__ import annotations

import dataclasses

import numpy as np
import pycolmap
import pytest
from joint_reference import SPEC, model_of, system_of, with_poses
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from sfm_audit.audit.config import AuditConfig
from sfm_audit.audit.engine.model import audit_model
from sfm_audit.audit.inliers.frames import cross_matrix
from sfm_audit.audit.inliers.residuals import model_residuals
from sfm_audit.audit.joint import PoseGauge, audit_jointly, joint_system, pose_covariances, pose_gauge
from sfm_audit.audit.joint.poses import PoseCovariance
from sfm_audit.audit.simulate.colmap_files import write_colmap_binary
from sfm_audit.audit.table import schema
from sfm_audit.audit.table.pose_columns import GAUGE, POSE_COLUMNS

SIGMA_PX = 0.5


@pytest.fixture(scope="module")
def model():
    return model_of(dataclasses.replace(SPEC, points_per_image=300, shared_camera=True), seed=3, adjusted=True)


@pytest.fixture(scope="module")
def system(model):
    return system_of(model)


def known_of(system):
    images = list(range(len(system.model.images)))
    return pose_covariances(system, images, system.image_covariances(images))


def colmap_covariance(model, folder):
    """(6 I, 6 I) of all poses as left perturbations (w, t), for noise of 1 px, in no gauge in particular."""
    write_colmap_binary(model, folder, np.random.default_rng(0))
    reconstruction = pycolmap.Reconstruction(folder)
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in reconstruction.images:
        config.add_image(image_id)
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_extra_params = True
    options.refine_principal_point = False
    make = getattr(pycolmap, "create_default_ceres_bundle_adjuster", pycolmap.create_default_bundle_adjuster)
    wanted = pycolmap.BACovarianceOptions()
    wanted.params = pycolmap.BACovarianceOptionsParams.POSES
    wanted.damping = 1e-4  # holds the gauge, which is then projected out
    found = pycolmap.estimate_ba_covariance(wanted, reconstruction, make(options, config, reconstruction))
    ids = model.images.image_id.tolist()
    blocks = [
        [found.get_cam_cov_from_world(i) if i == j else found.get_cam_cross_cov_from_world(i, j) for j in ids]
        for i in ids
    ]
    to_left = np.zeros((6 * len(ids), 6 * len(ids)))
    for k, shift in enumerate(model.images.translation_cam_from_world):
        own = np.diag([2.0, 2.0, 2.0, 1.0, 1.0, 1.0])  # its tangent of a quaternion is half of the rotation vector
        own[3:, :3] = 2 * cross_matrix(shift)  # t' = t + w x t + its translation
        to_left[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] = own
    return to_left @ np.block(blocks) @ to_left.T


def test_covariances_are_those_of_pycolmap_in_the_same_gauge(model, system, tmp_path):
    columns = np.concatenate([system.observations.layout.pose_of_image(i) for i in range(len(model.images))])
    gauge = pose_gauge(system)
    # noise so large that no observation loses weight: S^+ is then the inverse of the plain normal matrix
    plain = joint_system(model, model_residuals(model), np.full(len(model.images), 100.0))
    information = PoseGauge.of(gauge.free, gauge.fixing, plain.base.inverse.main.apply)
    rows = gauge.free[columns], information.mixed[columns]
    ours = information.applied(plain.base.inverse.main.block(columns), *rows) / 100.0**2
    fix = np.eye(len(columns)) - gauge.free[columns] @ gauge.fixing[columns].T
    theirs = fix @ colmap_covariance(model, tmp_path) @ fix.T
    sd = np.sqrt(theirs.diagonal())
    assert_allclose(ours / sd / sd[:, None], theirs / sd / sd[:, None], atol=1e-3)
    ratios = []
    for k, pose in enumerate(known_of(system)):  # sandwich by track, of noise that is what the model assumes
        depth, own = system.median_depth(k), theirs[6 * k : 6 * k + 6, 6 * k : 6 * k + 6].diagonal()
        ratios += [
            pose.sd_rotation_deg / np.degrees(np.sqrt(own[:3].sum())) / SIGMA_PX,
            pose.sd_centre * depth / np.sqrt(own[3:].sum()) / SIGMA_PX,
        ]
    assert min(ratios) > 0.85
    assert 0.9 < np.median(ratios) < 1.1
    assert max(ratios) < 1.15


def test_what_a_similarity_explains_is_no_error(system):
    gauge = pose_gauge(system)
    move = gauge.free @ np.arange(1.0, gauge.free.shape[1] + 1)
    assert gauge.free.shape[1] == 7
    assert_allclose(gauge.removed(move), 0.0, atol=1e-10 * np.abs(move).max())
    some = np.random.default_rng(0).normal(size=len(move))
    assert_allclose(gauge.fixing.T @ gauge.removed(some), 0.0, atol=1e-9)
    assert_allclose(gauge.removed(gauge.removed(some)), gauge.removed(some), atol=1e-9)


def test_another_world_and_unit_change_nothing(model, system):
    turn = Rotation.from_euler("xyz", [40, -70, 110], degrees=True)
    scale, shift = 3.0, np.array([5.0, -2.0, 7.0])
    old = Rotation.from_quat(model.images.quat_cam_from_world_wxyz[:, [1, 2, 3, 0]])
    rotation = old * turn.inv()
    translation = scale * model.images.translation_cam_from_world - rotation.apply(shift)
    moved = with_poses(model, rotation.as_quat()[:, [3, 0, 1, 2]], translation)
    points = dataclasses.replace(model.points, xyz_world=scale * turn.apply(model.points.xyz_world) + shift)
    again = known_of(system_of(dataclasses.replace(moved, points=points)))
    for before, after in zip(known_of(system), again, strict=True):
        assert before.neighbour_idx == after.neighbour_idx
        for name in ("sd_rotation_deg", "sd_centre", "sd_rotation_rel_deg", "sd_centre_rel"):
            assert getattr(after, name) == pytest.approx(getattr(before, name), rel=1e-5)
        assert_allclose(after.sds, before.sds, rtol=1e-5)
        assert_allclose(after.correlation, before.correlation, atol=1e-5)


def test_what_is_said_of_a_pose(system):
    for image, pose in enumerate(known_of(system)):
        assert pose.sd_rotation_deg == pytest.approx(np.sqrt((pose.sds[:3] ** 2).sum()))
        assert pose.sd_centre == pytest.approx(np.sqrt((pose.sds[3:] ** 2).sum()))
        assert_allclose(pose.correlation.diagonal(), 1.0)
        assert pose.correlation.shape == (8, 8)
        assert np.linalg.eigvalsh(pose.relative).min() > 0
        shared = [
            len(np.intersect1d(*(system.residuals.point_idx[system.residuals.rows(i)] for i in (image, other))))
            for other in range(len(system.model.images))
        ]
        shared[image] = 0
        assert shared[pose.neighbour_idx] == max(shared)


@pytest.mark.parametrize("variance", [0.0, -1e-12])
def test_what_rounding_left_nothing_of_is_not_known_exactly(variance):
    """Two images and a free camera: the gauge is most of what is known, and its difference to all of it was 0."""
    known = PoseCovariance(np.diag([1.0] * 3 + [variance] * 3), None, np.full((6, 6), np.nan))
    assert np.isnan(known.sd_centre)
    assert known.sd_rotation_deg == pytest.approx(np.degrees(np.sqrt(3)))


def test_the_turn_against_a_neighbour_does_not_depend_on_the_gauge(system):
    pose = known_of(system)[2]
    other = pose.neighbour_idx
    layout = system.observations.layout
    turn = system.model.image(other).rotation_cam_from_world @ system.model.image(2).rotation_cam_from_world.T
    (both,) = system.covariances([np.concatenate([layout.pose_of_image(i) for i in (2, other)])])
    moves = np.hstack([-turn, np.zeros((3, 3)), np.eye(3), np.zeros((3, 3))])
    assert_allclose(pose.relative[:3, :3], moves @ both @ moves.T, rtol=1e-6, atol=1e-16)


def test_images_of_a_frame_are_known_together_and_have_neighbours_elsewhere(model):
    frame_idx = np.arange(len(model.images)) // 2
    system = system_of(model, frame_idx=frame_idx, image_from_frame=np.tile(np.eye(6), (len(model.images), 1, 1)))
    for image, pose in enumerate(known_of(system)):
        assert frame_idx[pose.neighbour_idx] != frame_idx[image]
        assert np.isfinite(pose.sd_rotation_deg)


def test_an_image_without_columns_and_one_that_hangs_on_no_other_are_not_known(model):
    nothing = np.zeros(len(model.images), dtype=bool)
    nothing[0] = True
    known = known_of(system_of(model, left_out=nothing))
    assert np.isnan(known[0].sd_rotation_deg)
    assert np.isnan(known[0].sd_centre_rel)
    assert known[0].neighbour_idx is None
    assert all(np.isfinite(pose.sd_centre) for pose in known[1:])
    together = np.zeros(len(model.images), dtype=np.int64)
    one = system_of(model, frame_idx=together, image_from_frame=np.tile(np.eye(6), (len(model.images), 1, 1)))
    assert all(np.isnan(pose.sd_rotation_deg) for pose in known_of(one))


def test_independent_points_hold_the_world(model):
    system = system_of(model, points_independent=True)
    assert pose_gauge(system).free.shape[1] == 0
    for image, pose in enumerate(known_of(system)):
        (own,) = system.image_covariances([image])
        assert_allclose(pose.covariance[:3, :3], own[:3, :3])
        assert pose.sd_centre == pytest.approx(np.sqrt(np.trace(own[3:6, 3:6])) / system.median_depth(image))


def test_blocks_say_the_same_of_their_images(model):
    sigma = np.full(len(model.images), SIGMA_PX)
    options = {"alpha": 0.05, "tau_px": np.full(len(model.images), 0.2), "with_poses": True}
    whole = audit_jointly(model, model_residuals(model), sigma, **options)
    parts = audit_jointly(model, model_residuals(model), sigma, max_columns=36, **options)
    assert parts.num_blocks > 1
    assert len(parts.poses) == len(whole.poses) == len(model.images)
    assert all(part.sd_rotation_deg > 0 for part in parts.poses)


def test_columns_are_null_unless_they_are_asked_for(model):
    without, asked = (audit_model(model, AuditConfig(covariance=asked)).images.to_pylist() for asked in (False, True))
    for row in without:
        assert {row[name] for name in POSE_COLUMNS} == {None}
    for row in asked:
        assert None not in {row[name] for name in POSE_COLUMNS if not isinstance(row[name], list)}
        assert len(row["pose_sds"]) == 6
        assert len(row["pose_correlations"]) == 8 * 7 // 2
        assert row["sd_neighbour"] in model.images.name
    assert schema("images").field("sd_centre").metadata[b"gauge"].decode() == GAUGE
