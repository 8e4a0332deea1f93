"""Planted defects have the systematic size that they state: against an independent fit with pycolmap's projection."""

from __future__ import annotations

import dataclasses

import numpy as np
import pycolmap
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from sfm_audit.audit.simulate.defects import DefectKind, DefectSpec
from sfm_audit.audit.simulate.noise import NoiseSpec
from sfm_audit.audit.simulate.scene import SceneSpec, simulate_scene

SMALL = SceneSpec(num_images=10, points_per_image=250, max_track_length=10, noise=NoiseSpec(sigma_px=0.0))
SYSTEMATIC = [kind for kind in DefectKind if kind not in {DefectKind.FEW_POINTS, DefectKind.PERTURBED_POSE}]


def scene_with(spec, *defects: DefectSpec, seed=3):
    return simulate_scene(dataclasses.replace(spec, defects=defects), np.random.default_rng(seed))


def points_of(scene, image_idx):
    rows = slice(scene.offsets[image_idx], scene.offsets[image_idx + 1])
    xyz = scene.xyz_world[scene.point_idx[rows]]
    rotation, translation = (
        scene.cameras.rotation_cam_from_world[image_idx],
        scene.cameras.translation_cam_from_world[image_idx],
    )
    return xyz @ rotation.T + translation, scene.xy_px[rows]


def refitted_rms(model, params, free, xyz_cam, xy_px):
    """Smallest RMS length over pose and free parameters: SciPy's trust region, numeric derivatives, pycolmap."""
    scales = np.concatenate([np.full(3, 1e-3), np.full(3, 1e-2), np.where(np.array(free) == 0, 1.0, 1e-2)])

    def residuals(step):
        step = step * scales
        moved = Rotation.from_rotvec(step[:3]).apply(xyz_cam) + step[3:6]
        theta = np.array(params)
        theta[free] += step[6:]
        camera = pycolmap.Camera(model=model, width=1600, height=1200, params=theta)
        return (xy_px - camera.img_from_cam(moved)).ravel()

    fit = least_squares(residuals, np.zeros(6 + len(free)), jac="3-point", xtol=1e-14, ftol=1e-14, gtol=1e-12)
    return np.sqrt(2.0 * fit.cost / len(xy_px))


@pytest.mark.parametrize("kind", SYSTEMATIC)
@pytest.mark.parametrize("size_px", [0.3, 2.0])
def test_systematic_rms_is_what_a_refit_leaves(kind, size_px):
    scene = scene_with(SMALL, DefectSpec(4, kind, size_px))
    left = refitted_rms("SIMPLE_RADIAL", scene.claimed_params[4], [0, 3], *points_of(scene, 4))
    assert scene.defects[0].systematic_px == pytest.approx(left, rel=1e-4)
    assert scene.defects[0].systematic_px == pytest.approx(size_px, rel=1e-3)


@pytest.mark.parametrize(
    ("model", "free", "kind"),
    [
        ("PINHOLE", [0, 1], DefectKind.RADIAL_K2),
        ("RADIAL", [0, 3, 4], DefectKind.ROLLING_SHUTTER),
        ("SIMPLE_RADIAL_FISHEYE", [0, 3], DefectKind.RADIAL_K2),
    ],
)
def test_the_claimed_camera_decides_what_is_left(model, free, kind):
    scene = scene_with(dataclasses.replace(SMALL, camera_model=model), DefectSpec(2, kind, 1.0))
    left = refitted_rms(model, scene.claimed_params[2], free, *points_of(scene, 2))
    assert left == pytest.approx(1.0, rel=1e-3)


@pytest.mark.parametrize("kind", [DefectKind.RADIAL_K2, DefectKind.RADIAL_K3])
def test_large_defects_keep_their_size_though_points_leave_the_image(kind):
    scene = scene_with(SMALL, *(DefectSpec(i, kind, 3.0) for i in range(0, 10, 2)))
    assert [d.systematic_px for d in scene.defects] == pytest.approx([3.0] * 5, rel=1e-3)
    inside = (scene.xy_true_px >= 0) & (scene.xy_true_px <= (1600, 1200))
    assert inside.all()


def test_other_images_stay_sound():
    scene = scene_with(SMALL, DefectSpec(4, DefectKind.RADIAL_K2, 3.0))
    for i in range(SMALL.num_images):
        xyz_cam, xy = points_of(scene, i)
        camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=1600, height=1200, params=scene.claimed_params[i])
        assert (np.abs(camera.img_from_cam(xyz_cam) - xy).max() < 1e-9) == (i != 4)


def test_stated_values_are_planted_as_they_are():
    scene = scene_with(
        SMALL,
        DefectSpec(0, DefectKind.RADIAL_K2, values=(0.05,)),
        DefectSpec(1, DefectKind.TANGENTIAL, values=(1e-3, 1e-3)),
    )
    assert [d.values for d in scene.defects] == [(0.05,), (1e-3, 1e-3)]
    assert scene.cameras.params[0, 5] == 0.05
    assert scene.cameras.params[1, 6:8].tolist() == [1e-3, 1e-3]
    for defect in scene.defects:
        left = refitted_rms(
            "SIMPLE_RADIAL", scene.claimed_params[defect.image_idx], [0, 3], *points_of(scene, defect.image_idx)
        )
        assert defect.systematic_px == pytest.approx(left, rel=1e-4)
        assert f"{left:.2f} px RMS systematic" in defect.words


def test_a_perturbed_pose_moves_the_projections_by_its_size():
    scene = scene_with(SMALL, DefectSpec(6, DefectKind.PERTURBED_POSE, 1.7))
    xyz_cam, xy = points_of(scene, 6)
    values = np.array(scene.defects[0].values)
    moved = Rotation.from_rotvec(values[:3]).apply(xyz_cam) + values[3:]
    camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=1600, height=1200, params=scene.claimed_params[6])
    assert np.sqrt(((camera.img_from_cam(moved) - xy) ** 2).sum(axis=1).mean()) == pytest.approx(1.7, rel=1e-3)


def test_a_defect_that_the_claimed_camera_explains_has_no_size():
    with pytest.raises(ValueError, match="RADIAL explains radial_k2"):
        scene_with(dataclasses.replace(SMALL, camera_model="RADIAL"), DefectSpec(0, DefectKind.RADIAL_K2))
    with pytest.raises(ValueError, match="OPENCV explains aspect"):
        scene_with(dataclasses.replace(SMALL, camera_model="OPENCV"), DefectSpec(0, DefectKind.ASPECT))


def test_values_must_fit_their_kind():
    with pytest.raises(ValueError, match="tangential takes 2 values, got 1"):
        DefectSpec(0, DefectKind.TANGENTIAL, values=(1e-3,))
    with pytest.raises(ValueError, match="size_px must be positive"):
        DefectSpec(0, DefectKind.TANGENTIAL, 0.0)
