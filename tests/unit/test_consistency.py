"""Parts that do not belong together: each planted fault is named, sound models and moved poses are left alone."""

from __future__ import annotations

import dataclasses
import math
import re

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import optimize
from scipy.spatial.transform import Rotation

from sfm_audit.audit.cameras import project
from sfm_audit.audit.consistency import Cause, ConsistencyCode, consistency_of, fit_affine, image_consistency
from sfm_audit.audit.simulate.adjust import sparse_model, true_claim
from sfm_audit.audit.simulate.scene import SceneSpec, simulate_scene
from sfm_audit.loaders.camera_models import BY_NAME
from sfm_audit.loaders.model import CameraRecord, ImageRecord, rotation_from_quat

W, H = 1600, 1200
NUM_IMAGES = 12


def simulated(seed=3, **spec):
    spec = SceneSpec(num_images=NUM_IMAGES, points_per_image=150, shared_camera=True, k1_range=(0.02, 0.03), **spec)
    scene = simulate_scene(spec, np.random.default_rng(seed))
    return sparse_model(scene, true_claim(scene))


@pytest.fixture(scope="module")
def sound():
    return simulated()


def with_observed(model, change, images=range(NUM_IMAGES)):
    """The model with ``change`` applied to the observed points (n, 2) of some images."""
    xy = model.observations.xy_px.copy()
    for i in images:
        rows = slice(*model.observations.offsets[i : i + 2])
        xy[rows] = change(xy[rows])
    return dataclasses.replace(model, observations=dataclasses.replace(model.observations, xy_px=xy))


def with_params(model, change):
    cameras = dataclasses.replace(model.cameras, params=change(model.cameras.params.copy()))
    return dataclasses.replace(model, cameras=cameras)


def with_poses(model, change, images=range(NUM_IMAGES)):
    """The model with (rotation (3, 3), translation) of some images changed."""
    quat, translation = (
        model.images.quat_cam_from_world_wxyz.copy(),
        model.images.translation_cam_from_world.copy(),
    )
    for i in images:
        rotation, translation[i] = change(rotation_from_quat(quat[i]), translation[i])
        quat[i] = Rotation.from_matrix(rotation).as_quat()[[3, 0, 1, 2]]
    table = dataclasses.replace(model.images, quat_cam_from_world_wxyz=quat, translation_cam_from_world=translation)
    return dataclasses.replace(model, images=table)


def with_points(model, change):
    points = dataclasses.replace(model.points, xyz_world=change(model.points.xyz_world))
    return dataclasses.replace(model, points=points)


def quaternions_as_xyzw(model):
    quat = model.images.quat_cam_from_world_wxyz[:, [1, 2, 3, 0]]
    return dataclasses.replace(model, images=dataclasses.replace(model.images, quat_cam_from_world_wxyz=quat))


def swapped(model, i, j):
    order = np.arange(NUM_IMAGES)
    order[[i, j]] = j, i
    table = dataclasses.replace(
        model.images,
        quat_cam_from_world_wxyz=model.images.quat_cam_from_world_wxyz[order],
        translation_cam_from_world=model.images.translation_cam_from_world[order],
    )
    return dataclasses.replace(model, images=table)


def linked_wrongly(model, share, images=range(NUM_IMAGES)):
    """A share of each image's links goes to one and the same point."""
    point_idx = model.observations.point_idx.copy()
    for i in images:
        first, last = model.observations.offsets[i : i + 2]
        point_idx[first : first + round(share * (last - first))] = point_idx[first]
    return dataclasses.replace(model, observations=dataclasses.replace(model.observations, point_idx=point_idx))


def scaled(values, factors):
    values[: len(factors)] *= factors
    return values


FLIP = np.diag([1.0, -1.0, -1.0])
PARTS, BEHIND, SOME = ConsistencyCode.PARTS_DISAGREE, ConsistencyCode.POINTS_BEHIND, ConsistencyCode.IMAGES_DISAGREE
FAULTS = {
    "half size": (lambda m: with_observed(m, lambda xy: 0.5 * xy), PARTS, Cause.RESOLUTION, "are 0.500 x"),
    "third size": (lambda m: with_observed(m, lambda xy: xy / 3), PARTS, Cause.RESOLUTION, "are 0.333 x"),
    "focal": (lambda m: with_params(m, lambda p: scaled(p, [0.795])), PARTS, Cause.FOCAL_LENGTH, "by a factor 0.795"),
    "principal point": (
        lambda m: with_params(m, lambda p: scaled(p, [1, 0, 0])),
        PARTS,
        Cause.PRINCIPAL_POINT_ZERO,
        r"shifted by \((800\.\d|799\.9), (600\.\d|599\.9)\) px",
    ),
    "crop": (
        lambda m: with_observed(m, lambda xy: xy - [0, 400]),
        PARTS,
        Cause.SHIFT,
        r"shifted by .*-(400\.\d|399\.9)",
    ),
    "y up": (
        lambda m: with_observed(m, lambda xy: [0, H] + xy * [1, -1]),
        PARTS,
        Cause.MIRRORED,
        r"y_observed = (1200\.\d|1199\.9) - y_projected",
    ),
    "x mirrored": (lambda m: with_observed(m, lambda xy: [W, 0] + xy * [-1, 1]), PARTS, Cause.MIRRORED, "in x"),
    "x and y exchanged": (lambda m: with_observed(m, lambda xy: xy[:, ::-1]), PARTS, Cause.MIRRORED, "exchanged"),
    "turned, three": (
        lambda m: with_observed(m, lambda xy: np.column_stack([H - xy[:, 1], xy[:, 0]]), (1, 4, 7)),
        SOME,
        Cause.TURNED,
        "0002.jpg, .*0005.jpg, .*0008.jpg",
    ),
    "turned back": (
        lambda m: with_observed(m, lambda xy: np.column_stack([xy[:, 1], W - xy[:, 0]])),
        PARTS,
        Cause.TURNED,
        "by 270 degrees",
    ),
    "upside down": (lambda m: with_observed(m, lambda xy: [W, H] - xy), PARTS, Cause.TURNED, "by 180 degrees"),
    "opengl": (lambda m: with_poses(m, lambda r, t: (FLIP @ r, FLIP @ t)), BEHIND, Cause.CAMERA_AXES, "OpenGL"),
    "nerf": (
        lambda m: with_poses(m, lambda r, t: (r.T @ FLIP, -r.T @ t)),
        BEHIND,
        Cause.INVERTED_POSES,
        "world_from_cam",
    ),
    "inverted, one": (
        lambda m: with_poses(m, lambda r, t: (r.T, -r.T @ t), (5,)),
        SOME,
        Cause.INVERTED_POSES,
        "0006.jpg",
    ),
    "quaternion order": (quaternions_as_xyzw, PARTS, Cause.QUATERNION_ORDER, "x, y, z, w"),
    "swapped": (lambda m: swapped(m, 2, 8), SOME, Cause.POSES_OR_POINTS, "0003.jpg, .*0009.jpg"),
    "points twice as large": (
        lambda m: with_points(m, lambda xyz: 2 * xyz),
        PARTS,
        Cause.POINT_SCALE,
        "are 2 x|are 2.00. x|are 1.99. x",
    ),
    "links": (lambda m: linked_wrongly(m, 0.33), PARTS, Cause.LINKS, "most 2D points fit"),
    "all poses moved": (
        lambda m: with_poses(m, lambda r, t: (Rotation.from_rotvec([0.03, 0.02, 0.05]).as_matrix() @ r, t)),
        PARTS,
        Cause.POSES,
        "poses are off",
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_planted_fault_is_named(sound, fault):
    plant, code, cause, text = FAULTS[fault]
    found = consistency_of(plant(sound))
    assert [(finding.code, finding.cause) for finding in found.findings] == [(code, cause)]
    assert re.search(text, found.findings[0].text), found.findings[0].text
    assert found.parts_disagree == (code is not SOME)
    assert found.points_behind == (code is BEHIND)
    if code is SOME:  # and nobody else is blamed
        assert found.inconsistent.sum() == found.findings[0].count < NUM_IMAGES / 2


@pytest.mark.parametrize("seed", range(4))
def test_a_sound_model_has_no_finding(seed):
    found = consistency_of(simulated(seed))
    assert found.findings == ()
    assert not found.inconsistent.any()
    assert all(image.inconsistent is False and not image.moved for image in found.images)


SMALL_FAULTS = {
    "rounded poses": lambda m: with_poses(m, lambda r, t: (r.round(3), t.round(3))),
    "no distortion": lambda m: with_params(m, lambda p: scaled(p, [1, 1, 1, 0])),
    "integers": lambda m: with_params(m, np.round),
    "one per cent of the focal length": lambda m: with_params(m, lambda p: scaled(p, [1.01])),
    "one link in ten": lambda m: linked_wrongly(m, 0.1),
}


@pytest.mark.parametrize("fault", SMALL_FAULTS)
def test_small_faults_are_the_business_of_other_tests(sound, fault):
    found = consistency_of(SMALL_FAULTS[fault](sound))
    assert found.findings == ()
    assert not any(image.inconsistent or image.moved for image in found.images)


def test_one_moved_pose_is_moved_and_not_inconsistent(sound):
    turned = Rotation.from_rotvec([0.0, math.radians(3.0), 0.0]).as_matrix()
    found = consistency_of(with_poses(sound, lambda r, t: (turned @ r, turned @ t), (6,)))
    assert [i for i, image in enumerate(found.images) if image.moved] == [6]
    assert found.images[6].inconsistent is False
    assert found.images[6].explanation.cause is Cause.POSES
    assert found.images[6].stored_rms_px > 40
    assert found.images[6].rms_px < 5
    assert found.findings == ()


@pytest.mark.parametrize("sign", [1, -1])
def test_half_a_pixel_is_a_finding_and_rejects_nothing(sound, sign):
    found = consistency_of(with_observed(sound, lambda xy: xy + 0.5 * sign))
    assert [(finding.code, finding.cause) for finding in found.findings] == [(ConsistencyCode.PIXEL_CONVENTION, None)]
    assert f"{0.5 * sign:+.1f}" in found.findings[0].text
    assert found.findings[0].count >= 0.8 * NUM_IMAGES
    assert not found.inconsistent.any()
    assert not found.parts_disagree


@pytest.mark.parametrize("shift", [(0.5, -0.5), (0.25, 0.25), (1.0, 1.0), (0.5, 0.0)])
def test_other_shifts_are_no_pixel_convention(sound, shift):
    assert consistency_of(with_observed(sound, lambda xy: xy + shift)).findings == ()


def test_half_a_pixel_in_half_of_the_images_is_none(sound):
    assert consistency_of(with_observed(sound, lambda xy: xy + 0.5, range(NUM_IMAGES // 2))).findings == ()


def test_a_fifth_of_the_points_behind_is_too_much(sound):
    def with_share_behind(share):
        xyz_world = sound.points.xyz_world.copy()
        image = sound.image(0)
        rows = sound.observations.point_idx[slice(*sound.observations.offsets[:2])]
        behind = rows[: round(share * len(rows))]
        xyz_cam = image.cam_from_world(xyz_world[behind])
        xyz_world[behind] = (xyz_cam * [1, 1, -1] - image.translation_cam_from_world) @ image.rotation_cam_from_world
        return consistency_of(with_points(sound, lambda _: xyz_world))

    below, above = with_share_behind(0.15).images[0], with_share_behind(0.25).images[0]
    assert below.share_in_front == pytest.approx(0.85, abs=0.01)
    assert below.inconsistent is False
    assert above.inconsistent is True
    assert "behind the camera, limit 20%" in above.explanation.text


def single(camera, xy_px, xyz_world, **pose):
    quat = pose.get("quat", np.array([1.0, 0, 0, 0]))
    image = ImageRecord(1, "a.jpg", 1, camera, quat, pose.get("translation", np.zeros(3)), len(xy_px))
    return image_consistency(image, xy_px, xyz_world)


CAMERA = CameraRecord(1, BY_NAME["SIMPLE_PINHOLE"], W, H, np.array([1000.0, 800.0, 600.0]))


def cloud(rng, n=200):
    xyz = np.column_stack([rng.uniform(-3, 3, n), rng.uniform(-2, 2, n), rng.uniform(4, 10, n)])
    return xyz, xyz[:, :2] / xyz[:, 2:] * 1000 + [800, 600] + rng.normal(size=(n, 2))


def test_what_cannot_be_known_is_unknown():
    xyz, xy = cloud(np.random.default_rng(0))
    nothing_known = [
        single(None, xy, xyz),
        single(dataclasses.replace(CAMERA, params=np.array([np.nan, 800, 600])), xy, xyz),
        single(CAMERA, xy, xyz, quat=np.full(4, np.nan)),
        single(CAMERA, xy, xyz, translation=np.full(3, np.inf)),
        single(CAMERA, xy, np.full_like(xyz, np.nan)),
        single(CAMERA, np.full_like(xy, np.inf), xyz),
        single(dataclasses.replace(CAMERA, width=0), xy, xyz),
        single(CAMERA, xy[:19], xyz[:19]),
        single(CAMERA, xy[:19], -xyz[:19]),
        single(CAMERA, xy[:0], xyz[:0]),
    ]
    assert [known.inconsistent for known in nothing_known] == [None] * len(nothing_known)
    assert all(known.explanation is None and not known.moved for known in nothing_known)
    assert single(CAMERA, xy[:20], xyz[:20]).inconsistent is False
    partly = np.where(np.arange(200)[:, None] < 100, xyz, np.nan)
    assert single(CAMERA, xy, partly).num_linked == 100
    assert single(CAMERA, np.where(np.arange(200)[:, None] < 100, xy, np.nan), xyz).num_linked == 100


@pytest.mark.parametrize("value", [1e60, 1e154, 1e300, -1e300])
def test_absurd_numbers_are_answered_without_a_warning(value):
    xyz, xy = cloud(np.random.default_rng(1))
    huge = np.where(np.arange(200)[:, None] < 100, value, 1.0)
    for known in (
        single(CAMERA, xy * huge, xyz),
        single(CAMERA, xy, xyz * huge),
        single(dataclasses.replace(CAMERA, params=np.array([value, 800.0, 600.0])), xy, xyz),
        single(CAMERA, xy, xyz, quat=np.array([value, 0, 0, 1.0])),
    ):
        assert known.inconsistent in (True, False, None)


def test_one_wrong_link_does_not_condemn_an_image():
    xyz, xy = cloud(np.random.default_rng(2))
    xy[0] = 1e9
    known = single(CAMERA, xy, xyz)
    assert known.stored_rms_px > 1e7
    assert known.inconsistent is False
    assert not known.moved


def test_the_rest_decides_above_twenty_pixels_in_large_images():
    """A focal length that is off by 5 % leaves 28 px at 12 Mpx: under 1 % of the width, and not lens or noise."""
    rng = np.random.default_rng(3)
    xyz = np.column_stack([rng.uniform(-3, 3, 300), rng.uniform(-2, 2, 300), rng.uniform(1, 10, 300)])
    xyz[:, :2] *= xyz[:, 2:] / 6
    xy = xyz[:, :2] / xyz[:, 2:] * 3000 + [2000, 1500] + 0.5 * rng.normal(size=(300, 2))
    camera = CameraRecord(1, BY_NAME["SIMPLE_PINHOLE"], 4000, 3000, np.array([3000 * 1.05, 2000.0, 1500.0]))
    known = single(camera, xy, xyz)
    assert 20 < known.rms_px < 40
    assert known.inconsistent is True
    assert known.explanation.cause is Cause.FOCAL_LENGTH
    smaller = single(dataclasses.replace(camera, params=np.array([3000 * 1.03, 2000.0, 1500.0])), xy, xyz)
    assert smaller.rms_px > 20 * smaller.affine.rest_rms_px
    assert smaller.rms_px < 20
    assert smaller.inconsistent is False
    noisy = single(camera, xy + 8 * rng.normal(size=(300, 2)), xyz)
    assert 20 < noisy.rms_px < 40
    assert noisy.inconsistent is False


def test_a_panorama_has_no_affine_map_and_is_judged_by_its_rms():
    rng = np.random.default_rng(4)
    xyz = rng.normal(size=(300, 3))
    xyz[:30, 0], xyz[:30, 2] = 1e-3 * xyz[:30, 0], -1.0  # at the seam
    camera = CameraRecord(1, BY_NAME["EQUIRECTANGULAR"], 2000, 1000, np.array([2000.0, 1000.0]))
    xy = project(camera.model, camera.params, xyz)
    noisy = xy + rng.normal(size=(300, 2))
    noisy[:, 0] %= 2000  # some cross the seam
    sound = single(camera, noisy, xyz)
    assert abs(noisy - xy).max() > 1990
    assert sound.stored_rms_px < 2
    assert sound.inconsistent is False
    assert sound.affine is None
    assert sound.share_in_front == 1.0
    assert single(camera, xy[::-1], xyz).inconsistent is True


def test_affine_fit_is_scipy_s_with_the_cauchy_loss():
    rng = np.random.default_rng(5)
    projected = rng.uniform(0, 1000, (2, 300))
    linear, offset = np.array([[1.01, 0.02], [-0.01, 0.98]]), np.array([3.0, -7.0])
    observed = linear @ projected + offset[:, None] + 0.5 * rng.standard_t(3, (2, 300))
    fit = fit_affine(projected, observed - projected)

    def lengths(x):
        return np.hypot(*(observed - x[:4].reshape(2, 2) @ projected - x[4:, None]))

    knee = 2.385 * fit.noise_px
    theirs = optimize.least_squares(
        lengths, [1, 0, 0, 1, 0, 0], loss="cauchy", f_scale=knee, x_scale=[1e-3] * 4 + [1.0] * 2, xtol=1e-14, ftol=1e-14
    ).x
    assert_allclose(fit.linear.ravel(), theirs[:4], atol=2e-2 * fit.sd_shift_px / 300)
    assert_allclose(fit.offset_px, theirs[4:], atol=5e-2 * fit.sd_shift_px)
    assert_allclose(fit.linear @ fit.centre_px + fit.offset_px, fit.centre_px + fit.shift_px, atol=1e-9)
    assert abs(fit.linear - linear).max() < 5 * fit.sd_shift_px / fit.spread_px.min()


def test_points_on_a_line_have_no_affine_map():
    line = np.outer([1.0, 2.0], np.arange(50.0))
    assert fit_affine(line, np.zeros((2, 50))) is None
    assert fit_affine(line[:, :3], np.zeros((2, 3))) is None
    assert fit_affine(line, np.full((2, 50), np.nan)) is None


def test_links_to_points_that_do_not_exist_are_left_out(sound):
    point_idx = sound.observations.point_idx.copy()
    point_idx[::3] = -1
    model = dataclasses.replace(sound, observations=dataclasses.replace(sound.observations, point_idx=point_idx))
    found = consistency_of(model)
    assert sum(image.num_linked for image in found.images) == np.count_nonzero(point_idx >= 0)
    assert found.findings == ()
