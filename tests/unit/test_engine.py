"""From a model to its tables: what is counted, what is undetermined and why, what stays out of the tracks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from sfm_audit.audit import AuditConfig, ModelAuditor, audit_inliers, audit_model
from sfm_audit.audit.simulate.adjust import adjust_scene, sparse_model
from sfm_audit.audit.simulate.noise import NoiseKind, NoiseSpec
from sfm_audit.audit.simulate.scene import SceneSpec, simulate_scene
from sfm_audit.loaders.model import FindingCode


@pytest.fixture(scope="module")
def model():
    spec = SceneSpec(num_images=10, points_per_image=150, noise=NoiseSpec(NoiseKind.GAUSSIAN, 0.5))
    scene = simulate_scene(spec, np.random.default_rng(3))
    return sparse_model(scene, adjust_scene(scene))


def with_pose(model, image_idx, *, quat=None, translation=None):
    images = model.images
    quats, translations = images.quat_cam_from_world_wxyz.copy(), images.translation_cam_from_world.copy()
    if quat is not None:
        quats[image_idx] = quat
    if translation is not None:
        translations[image_idx] = translation
    changed = replace(images, quat_cam_from_world_wxyz=quats, translation_cam_from_world=translations)
    return replace(model, images=changed)


def reasons(row):
    return [reason.split(":")[0] for reason in row["reasons"]]


def test_a_sound_model_is_accepted_and_its_numbers_agree(model):
    result = audit_model(model)
    rows = result.images.to_pylist()
    assert [row["verdict"] for row in rows] == ["accepted"] * 10
    for row in rows:
        assert row["num_linked"] == row["num_inliers"] + row["num_behind"] + row["num_nonfinite"] + row["num_dangling"]
        assert row["num_standardised"] == row["num_inliers"] - row["num_unverifiable"]
        assert row["pose_offset_px"] < 0.01
        assert 0.8 < row["scale_ratio"] < 1.25
    summary = result.models.to_pylist()[0]
    assert summary["num_accepted"] == summary["num_accepted_ks"] == 10
    assert summary["num_observations"] == sum(row["num_linked"] for row in rows)
    assert summary["removable_share"] < 1e-6


def test_a_pose_that_is_not_finite_is_undetermined_and_harms_nobody_else(model):
    broken = with_pose(model, 4, translation=[np.nan, 0, 0])
    rows = audit_model(broken).images.to_pylist()
    assert rows[4]["verdict"] == "undetermined"
    assert reasons(rows[4]) == ["non_finite_pose"]
    assert rows[4]["num_inliers"] == 0
    assert rows[4]["num_nonfinite"] == rows[4]["num_linked"] > 0
    assert rows[4]["rms_px"] is None
    assert [row["verdict"] for row in rows].count("accepted") == 9


def test_a_missing_camera_and_a_camera_that_is_not_finite_are_undetermined(model):
    images, cameras = model.images, model.cameras
    camera_idx = images.camera_idx.copy()
    camera_idx[0] = -1
    params = cameras.params.copy()
    params[cameras.param_offsets[camera_idx[1]]] = np.inf
    broken = replace(model, images=replace(images, camera_idx=camera_idx), cameras=replace(cameras, params=params))
    rows = audit_model(broken).images.to_pylist()
    assert (reasons(rows[0]), reasons(rows[1])) == (["missing_camera"], ["non_finite_camera"])
    assert rows[0]["camera_model"] is None
    assert rows[0]["width"] is None


def test_exact_projections_are_no_measurements(model):
    residuals = ModelAuditor(model).residuals
    xy = model.observations.xy_px.copy()
    xy[residuals.observation_row] -= residuals.residuals_px.T
    exact = replace(model, observations=replace(model.observations, xy_px=xy))
    result = audit_model(exact)
    rows = result.images.to_pylist()
    assert {row["verdict"] for row in rows} == {"undetermined"}
    assert reasons(rows[0])[0] == "exact_projections"
    assert {rows[0][name] for name in ("verdict_ks", "verdict_misfit")} == {"undetermined"}
    assert FindingCode.EXACT_PROJECTIONS in [f["code"] for f in result.models.to_pylist()[0]["findings"]]


def test_dangling_points_and_points_behind_are_counted_not_dropped(model):
    point_idx = model.observations.point_idx.copy()
    first, last = model.observations.offsets[:2]
    point_idx[first : first + 3] = -1
    xyz = model.points.xyz_world.copy()
    image = model.image(0)
    behind = int(point_idx[last - 1])
    xyz[behind] = image.rotation_cam_from_world.T @ (np.array([0.1, 0.1, -5.0]) - image.translation_cam_from_world)
    changed = replace(
        model,
        observations=replace(model.observations, point_idx=point_idx),
        points=replace(model.points, xyz_world=xyz),
    )
    row = audit_model(changed).images.to_pylist()[0]
    assert (row["num_dangling"], row["num_behind"], row["num_nonfinite"]) == (3, 1, 0)
    assert row["num_linked"] == last - first


def test_a_moved_image_stays_out_of_the_tracks_of_all_others(model):
    """Its residuals are systematic; the others' statistics must be those of a model without it."""
    moved_pose = model.images.translation_cam_from_world[5] + [0.02, 0, 0]
    moved = ModelAuditor(with_pose(model, 5, translation=moved_pose))
    assert_array_equal(np.flatnonzero(moved.tracks.nonstationary), [5])
    without = ModelAuditor(with_pose(model, 5, translation=[np.nan] * 3))
    for image_idx in (0, 4, 9):
        assert_allclose(moved.image(image_idx).noise.z, without.image(image_idx).noise.z, rtol=1e-9, atol=1e-9)
    assert moved.tracks.prior == without.tracks.prior
    own = moved.image(5)
    assert own.pose_offset_px > 0.5
    assert len(own.noise.z) > 100  # its own observations keep the values of the full tracks


def test_where_most_images_moved_none_is_left_out_and_the_model_says_so(model):
    shifted = replace(
        model,
        images=replace(
            model.images, translation_cam_from_world=model.images.translation_cam_from_world + [[0.05, 0, 0]] * 10
        ),
    )
    auditor = ModelAuditor(shifted)
    assert auditor.tracks.too_many_nonstationary
    codes = [f["code"] for f in auditor.tables().models.to_pylist()[0]["findings"]]
    assert FindingCode.TRACK_STATISTICS_FROM_ALL_IMAGES in codes


def test_constant_noise_is_the_chosen_model_when_asked_for(model):
    row = audit_model(model, AuditConfig(noise="constant")).images.to_pylist()[0]
    assert row["noise_model"] == "constant"
    assert row["num_unverifiable"] == 0
    assert row["ks_p"] == row["ks_constant_p"]
    assert row["scale_ratio"] is None


def test_one_image_alone_equals_constant_noise_in_its_model(model):
    auditor = ModelAuditor(model, AuditConfig(noise="constant"))
    alone, within = audit_inliers(auditor.inliers("IMG_0003.jpg")), auditor.image("IMG_0003.jpg")
    assert alone.tests == within.tests
    assert alone.decision.judgement == within.decision.judgement


def test_alpha_moves_the_verdict_and_the_reason_carries_the_numbers(model):
    row = audit_model(model, AuditConfig(alpha=0.999, policy="paper")).images.to_pylist()[0]
    assert row["verdict"] == "rejected"
    assert row["reasons"][0].startswith("ks_rejected: p = ")
    assert f"D = {row['ks_stat']:.4f}" in row["reasons"][0]


def test_a_distance_that_matters_can_be_asked_of_ks(model):
    distance = audit_model(model, AuditConfig(alpha=0.999)).images.to_pylist()[0]["ks_stat"]
    for least, verdict in ((0.99 * distance, "rejected"), (1.01 * distance, "accepted")):
        row = audit_model(model, AuditConfig(alpha=0.999, min_ks_distance=least)).images.to_pylist()[0]
        assert row["verdict_ks"] == verdict


def test_an_empty_model_has_empty_tables(model):
    none = np.empty(0, dtype=np.int64)
    empty = replace(
        model,
        images=replace(
            model.images,
            image_id=none.astype(np.uint32),
            name=(),
            camera_id=none.astype(np.uint32),
            camera_idx=none,
            quat_cam_from_world_wxyz=np.empty((0, 4)),
            translation_cam_from_world=np.empty((0, 3)),
            num_points2d=none,
        ),
        observations=replace(
            model.observations,
            offsets=np.zeros(1, dtype=np.int64),
            point2d_idx=none,
            xy_px=np.empty((0, 2)),
            point_idx=none,
        ),
    )
    result = audit_model(empty)
    assert result.images.num_rows == 0
    assert result.models.to_pylist()[0]["num_images"] == 0
