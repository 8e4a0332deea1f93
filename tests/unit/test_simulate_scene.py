"""A simulated scene is what it says: pycolmap projects its points to its pixels, and the images are filled."""

from __future__ import annotations

import dataclasses

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from sfm_audit.audit.simulate.defects import CORNERS, DefectKind, DefectSpec
from sfm_audit.audit.simulate.layout import _choose
from sfm_audit.audit.simulate.noise import NoiseSpec
from sfm_audit.audit.simulate.scene import SceneSpec, simulate_scene

SMALL = SceneSpec(num_images=12, points_per_image=200, max_track_length=12)
QUIET = dataclasses.replace(SMALL, noise=NoiseSpec(sigma_px=0.0))
LENS_DEFECTS = [
    DefectSpec(0, DefectKind.RADIAL_K2),
    DefectSpec(2, DefectKind.RADIAL_K3),
    DefectSpec(3, DefectKind.TANGENTIAL),
    DefectSpec(5, DefectKind.ASPECT),
    DefectSpec(7, DefectKind.PRINCIPAL_POINT),
]


def scene_of(spec, seed=0):
    return simulate_scene(spec, np.random.default_rng(seed))


def rows_of(scene, image_idx):
    return slice(scene.offsets[image_idx], scene.offsets[image_idx + 1])


def cam_points(scene, image_idx):
    xyz = scene.xyz_world[scene.point_idx[rows_of(scene, image_idx)]]
    return (
        xyz @ scene.cameras.rotation_cam_from_world[image_idx].T + scene.cameras.translation_cam_from_world[image_idx]
    )


def camera_of(name, params):
    return pycolmap.Camera(model=name, width=1600, height=1200, params=params)


@pytest.mark.parametrize(
    "model",
    [
        "SIMPLE_PINHOLE",
        "PINHOLE",
        "SIMPLE_RADIAL",
        "RADIAL",
        "OPENCV",
        "FULL_OPENCV",
        "SIMPLE_FISHEYE",
        "FISHEYE",
        "SIMPLE_RADIAL_FISHEYE",
        "RADIAL_FISHEYE",
        "OPENCV_FISHEYE",
    ],
)
def test_without_noise_the_claimed_camera_reprojects_exactly(model):
    scene = scene_of(dataclasses.replace(QUIET, camera_model=model))
    for i in range(SMALL.num_images):
        projected = camera_of(model, scene.claimed_params[i]).img_from_cam(cam_points(scene, i))
        np.testing.assert_allclose(projected, scene.xy_px[rows_of(scene, i)], rtol=0, atol=1e-9)
    if model in {"SIMPLE_RADIAL", "OPENCV", "SIMPLE_RADIAL_FISHEYE"}:
        assert np.ptp(scene.cameras.params[:, 4]) > 0.01  # k1 differs from camera to camera


def test_lens_defects_are_those_of_the_richer_camera():
    scene = scene_of(dataclasses.replace(QUIET, defects=tuple(LENS_DEFECTS)))
    for defect in scene.defects:
        i = defect.image_idx
        f, cx, cy, k1 = scene.claimed_params[i]
        params = {"fx": f, "fy": f, "cx": cx, "cy": cy, "k1": k1, "k2": 0.0, "p1": 0.0, "p2": 0.0, "k3": 0.0}
        match defect.kind:
            case DefectKind.RADIAL_K2:
                params["k2"] = defect.values[0]
            case DefectKind.RADIAL_K3:
                params["k3"] = defect.values[0]
            case DefectKind.TANGENTIAL:
                params["p1"], params["p2"] = defect.values
            case DefectKind.ASPECT:
                params["fy"] = f * (1 + defect.values[0])
            case DefectKind.PRINCIPAL_POINT:
                params["cx"], params["cy"] = cx + defect.values[0], cy + defect.values[1]
        projected = camera_of("FULL_OPENCV", [*params.values(), 0, 0, 0]).img_from_cam(cam_points(scene, i))
        np.testing.assert_allclose(projected, scene.xy_true_px[rows_of(scene, i)], rtol=0, atol=1e-9)


def test_rolling_shutter_is_the_pose_of_the_row_that_sees_the_point():
    scene = scene_of(dataclasses.replace(QUIET, defects=(DefectSpec(4, DefectKind.ROLLING_SHUTTER, 2.0),)))
    xy, values = scene.xy_true_px[rows_of(scene, 4)], np.array(scene.defects[0].values)
    phase = (xy[:, 1:] - 600.0) / 1200.0
    moved = Rotation.from_rotvec(phase * values[:3]).apply(cam_points(scene, 4)) + phase * values[3:]
    projected = camera_of("SIMPLE_RADIAL", scene.claimed_params[4]).img_from_cam(moved)
    np.testing.assert_allclose(projected, xy, rtol=0, atol=1e-8)


def test_same_seed_same_scene_bit_for_bit_and_other_seeds_differ():
    spec = dataclasses.replace(SMALL, defects=(*LENS_DEFECTS, DefectSpec(1, DefectKind.PERTURBED_POSE)))
    one, same, other = scene_of(spec, 5), scene_of(spec, 5), scene_of(spec, 6)
    for name in ("claimed_params", "xyz_world", "offsets", "image_idx", "point_idx", "xy_true_px", "xy_px", "sigma_px"):
        assert getattr(one, name).tobytes() == getattr(same, name).tobytes()
    assert one.defects == same.defects
    assert one.xy_px.shape != other.xy_px.shape or not np.allclose(one.xy_px, other.xy_px)


@pytest.mark.parametrize("shared", [False, True])
def test_images_are_filled_evenly_up_to_their_corners(shared):
    spec = SceneSpec(num_images=30, points_per_image=500, shared_camera=shared)
    scene = scene_of(spec)
    counts = np.diff(scene.offsets)
    assert counts.sum() == pytest.approx(30 * 500, rel=0.01)
    assert counts.min() > 450
    assert counts.max() < 525
    inside = (scene.xy_true_px > 0) & (scene.xy_true_px < (1600, 1200))
    assert inside.all()
    for i in range(30):
        cells = np.floor(scene.xy_px[rows_of(scene, i)] / (1600, 1200) * 8).astype(int)
        assert len({tuple(cell) for cell in cells}) >= 54
    assert scene.camera_idx.tolist() == ([0] * 30 if shared else list(range(30)))
    assert (np.ptp(scene.claimed_params, axis=0) == 0).all() == shared


def test_no_point_is_seen_beyond_the_fold_of_the_lens():
    spec = SceneSpec(num_images=20, points_per_image=200, k1_range=(-0.14, -0.14), focal_spread=0.0)
    scene = scene_of(spec)
    xyz_cam = np.concatenate([cam_points(scene, i) for i in range(20)])
    slope = np.hypot(xyz_cam[:, 0], xyz_cam[:, 1]) / xyz_cam[:, 2]
    assert 1.1 < slope.max() < 1 / np.sqrt(3 * 0.14)  # r (1 - 0.14 r^2) turns back there


def test_the_image_that_a_point_is_drawn_in_observes_it():
    cell_seen, candidates = np.zeros((500, 12), dtype=int), np.tile(np.arange(12), (500, 1))
    wanted = np.full((12, 1), 100.0)
    wanted[0] = 1.0
    chosen = _choose(cell_seen, candidates, np.full(500, 3), wanted, np.random.default_rng(0))
    assert chosen[:, 0].all()
    assert (chosen.sum(axis=1) == 3).all()
    assert chosen[:, 1:].sum(axis=0).min() > 50


def test_tracks_are_realistic():
    scene = scene_of(SceneSpec(num_images=30, points_per_image=500))
    lengths = np.bincount(scene.point_idx)
    assert lengths.min() == 3
    assert lengths.max() == 15
    assert 5.0 < lengths.mean() < 6.0
    pairs = scene.image_idx * len(lengths) + scene.point_idx
    assert len(np.unique(pairs)) == len(pairs)  # no point twice in an image
    depths = np.concatenate([cam_points(scene, i)[:, 2] for i in range(30)])
    assert depths.min() >= 4.0
    assert depths.max() <= 10.0
    centres = -np.einsum("iba,ib->ia", scene.cameras.rotation_cam_from_world, scene.cameras.translation_cam_from_world)
    rays = centres[scene.image_idx] - scene.xyz_world[scene.point_idx]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    order = np.argsort(scene.point_idx, kind="stable")
    first = rays[order][np.searchsorted(scene.point_idx[order], scene.point_idx)]
    widest = np.zeros(len(lengths))
    np.maximum.at(widest, scene.point_idx, np.degrees(np.arccos(np.clip((rays * first).sum(axis=1), -1, 1))))
    assert np.median(widest) > 15.0  # parallax, degrees
    assert np.percentile(widest, 1) > 3.0


@pytest.mark.parametrize("corner", range(4))
def test_few_points_lie_in_their_corner(corner):
    spec = dataclasses.replace(
        SMALL, points_per_image=350, defects=(DefectSpec(3, DefectKind.FEW_POINTS, 1.0, (20, corner)),)
    )
    scene = scene_of(spec)
    xy = scene.xy_true_px[rows_of(scene, 3)] / (1600, 1200)
    assert 12 <= len(xy) <= 20
    assert ((xy > 0.65) == [corner % 2 == 1, corner >= 2]).all()
    assert ((xy < 0.35) == [corner % 2 == 0, corner < 2]).all()
    assert scene.defects[0].systematic_px is None
    assert f"only {len(xy)} points, all in the {CORNERS[corner]} corner" == scene.defects[0].words
    assert np.bincount(scene.point_idx).min() >= 3
    assert scene.sound.tolist() == [i != 3 for i in range(12)]


def test_many_images_have_local_tracks():
    scene = scene_of(SceneSpec(num_images=150, points_per_image=60))
    spread = np.zeros(len(scene.xyz_world))
    first = np.full(len(scene.xyz_world), 10**6)
    np.minimum.at(first, scene.point_idx, scene.image_idx)
    np.maximum.at(spread, scene.point_idx, scene.image_idx - first[scene.point_idx])
    assert spread.max() < 75


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        ({"defects": (DefectSpec(12, DefectKind.RADIAL_K2),)}, "at most one defect per image"),
        ({"defects": (DefectSpec(1, DefectKind.RADIAL_K2), DefectSpec(1, DefectKind.ASPECT))}, "at most one defect"),
        ({"min_track_length": 13}, "not possible with 12 images"),
        ({"camera_model": "EUCM"}, "cannot simulate EUCM"),
    ],
)
def test_impossible_specs_are_refused(bad, words):
    with pytest.raises(ValueError, match=words):
        dataclasses.replace(SMALL, **bad)


def test_cameras_that_see_too_little_in_common_are_refused():
    with pytest.raises(ValueError, match="do not see enough points in common"):
        scene_of(dataclasses.replace(SMALL, min_track_length=12, focal_px=3000.0, max_neighbours=11))
