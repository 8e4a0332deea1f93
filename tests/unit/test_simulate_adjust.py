"""Adjusted scenes are at the optimum of their own cost, and their files are what pycolmap reads."""

from __future__ import annotations

import dataclasses

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from sfm_audit.audit.simulate.adjust import (
    AdjustmentError,
    Claim,
    adjust_scene,
    residuals_px,
    sparse_model,
    true_claim,
    write_adjusted_model,
    write_model,
)
from sfm_audit.audit.simulate.colmap_files import write_colmap_binary
from sfm_audit.audit.simulate.defects import DefectKind, DefectSpec
from sfm_audit.audit.simulate.noise import NoiseSpec
from sfm_audit.audit.simulate.scene import SceneSpec, simulate_scene

SPEC = SceneSpec(num_images=20, points_per_image=300, noise=NoiseSpec(sigma_px=0.5))


@pytest.fixture(scope="module")
def scene():
    return simulate_scene(SPEC, np.random.default_rng(11))


@pytest.fixture(scope="module")
def claim(scene):
    return adjust_scene(scene)


def moved(claim, image_idx, step):
    """The claim with one pose moved by a rotation vector and a translation in the camera frame."""
    quat, translation = claim.quat_cam_from_world_wxyz.copy(), claim.translation_cam_from_world.copy()
    turn = Rotation.from_rotvec(step[:3])
    quat[image_idx] = (turn * Rotation.from_quat(quat[image_idx], scalar_first=True)).as_quat(scalar_first=True)
    translation[image_idx] = turn.apply(translation[image_idx]) + step[3:]
    return dataclasses.replace(claim, quat_cam_from_world_wxyz=quat, translation_cam_from_world=translation)


def own_residuals(scene, claim, image_idx):
    """Residuals of one image through pycolmap's projection."""
    rows = slice(scene.offsets[image_idx], scene.offsets[image_idx + 1])
    rotation = Rotation.from_quat(claim.quat_cam_from_world_wxyz[image_idx], scalar_first=True).as_matrix()
    xyz_cam = claim.xyz_world[scene.point_idx[rows]] @ rotation.T + claim.translation_cam_from_world[image_idx]
    camera = pycolmap.Camera(model=scene.spec.camera_model, width=1600, height=1200, params=claim.params[image_idx])
    return (scene.xy_px[rows] - camera.img_from_cam(xyz_cam)).ravel()


def image_columns(scene, claim, image_idx):
    """Numeric derivative of one image's residuals by its pose, focal length and k1: (2n, 8)."""
    columns = []
    for j, h in enumerate([1e-6] * 6 + [1e-3, 1e-6]):
        sides = []
        for step in (h, -h):
            if j < 6:
                changed = moved(claim, image_idx, step * np.eye(6)[j])
            else:
                params = claim.params.copy()
                params[image_idx, [0, 3][j - 6]] += step
                changed = dataclasses.replace(claim, params=params)
            sides.append(own_residuals(scene, changed, image_idx))
        columns.append((sides[0] - sides[1]) / (2 * h))
    return np.column_stack(columns)


def removable_px(scene, claim, image_idx, columns=slice(None)):
    """What refitting one image's own parameters would remove, RMS length in px."""
    y = own_residuals(scene, claim, image_idx)
    basis, _ = np.linalg.qr(image_columns(scene, claim, image_idx)[:, columns])
    return np.linalg.norm(basis.T @ y) / np.sqrt(len(y) / 2)


def test_residuals_shrink_by_the_degrees_of_freedom(scene, claim):
    residuals = residuals_px(scene, claim)
    num_values, num_params = residuals.size, 3 * len(scene.xyz_world) + 8 * 20 - 7
    expected = 0.5 * np.sqrt(1 - num_params / num_values)
    assert np.sqrt((residuals**2).mean()) == pytest.approx(expected, rel=0.02)
    shrinkage = np.sqrt(1 - 1.5 / np.bincount(scene.point_idx).mean() - 8 / (2 * 300))  # method.md 3a
    assert np.sqrt((residuals**2).mean()) == pytest.approx(0.5 * shrinkage, rel=0.02)
    raw = np.sqrt(((scene.xy_px - scene.xy_true_px) ** 2).mean())
    assert raw == pytest.approx(0.5, rel=0.02)


def test_images_are_at_their_optimum(scene, claim):
    worst = max(removable_px(scene, claim, i) for i in range(20))
    assert worst < 1e-4
    truth = max(removable_px(scene, true_claim(scene), i) for i in range(20))
    assert truth > 0.03  # the same measure sees that the truth is not the optimum


def test_points_are_at_their_optimum(scene, claim):
    gradient = np.zeros_like(claim.xyz_world)
    for axis in range(3):
        step = 1e-5 * np.eye(3)[axis]
        ahead, behind = (
            residuals_px(scene, dataclasses.replace(claim, xyz_world=claim.xyz_world + sign * step)) for sign in (1, -1)
        )
        along = (ahead**2 - behind**2).sum(axis=1) / (4 * 1e-5)  # half the squares: r dr
        gradient[:, axis] = np.bincount(scene.point_idx, weights=along)
    assert np.abs(gradient).max() < 1e-2  # px^2 per unit; one px of displacement is ~100 per unit and observation


def test_any_start_ends_in_the_same_optimum(scene, claim):
    rng = np.random.default_rng(0)
    start = true_claim(scene)
    for i in range(2, 20):
        start = moved(start, i, rng.normal(scale=2e-3, size=6))
    start = dataclasses.replace(start, xyz_world=start.xyz_world + rng.normal(scale=5e-3, size=start.xyz_world.shape))
    again = adjust_scene(scene, start=start, num_threads=2)
    np.testing.assert_allclose(residuals_px(scene, again), residuals_px(scene, claim), atol=1e-3)
    np.testing.assert_allclose(again.params, claim.params, rtol=1e-5, atol=1e-7)


def test_without_noise_the_truth_is_the_optimum():
    scene = simulate_scene(dataclasses.replace(SPEC, noise=NoiseSpec(sigma_px=0.0)), np.random.default_rng(1))
    claim, truth = adjust_scene(scene), true_claim(scene)
    np.testing.assert_allclose(claim.params, truth.params, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(claim.xyz_world, truth.xyz_world, atol=1e-7)


def test_adjustment_recovers_the_cameras(scene, claim):
    focal = claim.params[:, 0] / scene.claimed_params[:, 0]
    assert np.abs(focal - 1).max() < 5e-3
    assert np.abs(claim.params[:, 3] - scene.claimed_params[:, 3]).max() < 5e-3
    np.testing.assert_array_equal(claim.params[:, 1:3], np.full((20, 2), [800.0, 600.0]))  # principal point fixed


def test_a_shared_camera_stays_one_camera():
    scene = simulate_scene(dataclasses.replace(SPEC, shared_camera=True), np.random.default_rng(2))
    claim = adjust_scene(scene)
    assert (claim.params == claim.params[0]).all()
    assert sparse_model(scene, claim).cameras.camera_id.tolist() == [1]
    assert max(removable_px(scene, claim, i, slice(6)) for i in range(20)) < 1e-4


def test_poses_perturbed_afterwards_are_off_and_all_others_are_not():
    defects = (DefectSpec(3, DefectKind.PERTURBED_POSE, 2.0), DefectSpec(7, DefectKind.RADIAL_K2, 1.0))
    scene = simulate_scene(dataclasses.replace(SPEC, defects=defects), np.random.default_rng(3))
    claim = adjust_scene(scene)
    offsets = np.array([removable_px(scene, claim, i, slice(6)) for i in range(20)])
    assert offsets[3] == pytest.approx(2.0, rel=0.05)
    assert np.delete(offsets, 3).max() < 0.01
    left = own_residuals(scene, claim, 7)
    assert np.sqrt((left**2).sum() / (len(left) / 2)) > 0.75  # 0.6 of noise alone


def test_an_optimum_that_does_not_exist_is_said():
    scene = simulate_scene(
        SceneSpec(num_images=4, points_per_image=60, noise=NoiseSpec(sigma_px=0.5)), np.random.default_rng(4)
    )
    nowhere = dataclasses.replace(true_claim(scene), xyz_world=np.full_like(scene.xyz_world, np.nan))
    with pytest.raises(AdjustmentError, match="did not converge"):
        adjust_scene(scene, start=nowhere)


@pytest.mark.parametrize("text", [False, True])
def test_files_are_what_pycolmap_reads(tmp_path, text):
    spec = dataclasses.replace(SPEC, num_images=8, points_per_image=120, unlinked_per_image=50)
    scene = simulate_scene(spec, np.random.default_rng(5))
    claim = write_adjusted_model(scene, tmp_path / "sparse" / "0", text=text)
    suffix = ".txt" if text else ".bin"
    assert {path.suffix for path in (tmp_path / "sparse" / "0").iterdir()} == {suffix}
    read = pycolmap.Reconstruction(str(tmp_path / "sparse" / "0"))
    assert read.num_reg_images() == 8
    assert read.num_points3D() == len(scene.xyz_world)
    assert read.compute_num_observations() == len(scene.xy_px)
    for i in range(8):
        image = read.images[i + 1]
        assert image.name == scene.image_name[i]
        assert image.num_points2D() == np.diff(scene.offsets)[i] + 50
        np.testing.assert_allclose(image.camera.params, claim.params[i], rtol=1e-15)
        linked = [(p.xy, p.point3D_id) for p in image.points2D if p.has_point3D()]
        rows = slice(scene.offsets[i], scene.offsets[i + 1])
        np.testing.assert_allclose([xy for xy, _ in linked], scene.xy_px[rows], rtol=1e-15)
        assert [point_id - 1 for _, point_id in linked] == scene.point_idx[rows].tolist()
    for track_of in range(len(scene.xyz_world)):
        elements = read.points3D[track_of + 1].track.elements
        assert sorted(e.image_id - 1 for e in elements) == scene.image_idx[scene.point_idx == track_of].tolist()
        assert all(read.images[e.image_id].points2D[e.point2D_idx].point3D_id == track_of + 1 for e in elements)
    stored = read.compute_mean_reprojection_error()
    read.update_point_3d_errors()
    assert stored == pytest.approx(read.compute_mean_reprojection_error(), rel=1e-9)


def test_the_same_claim_gives_the_same_bytes(tmp_path, scene):
    with_others = dataclasses.replace(scene, spec=dataclasses.replace(SPEC, unlinked_per_image=30))
    for name in ("a", "b"):
        write_model(with_others, true_claim(scene), tmp_path / name)
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_a_dangling_observation_has_no_track_to_be_written_in(tmp_path, scene):
    dangling = np.where(np.arange(len(scene.point_idx)) == 7, -1, scene.point_idx)
    model = sparse_model(scene, true_claim(scene))
    model = dataclasses.replace(model, observations=dataclasses.replace(model.observations, point_idx=dangling))
    with pytest.raises(ValueError, match="dangling"):
        write_colmap_binary(model, tmp_path, np.random.default_rng(0))


def test_claims_are_records(claim):
    assert isinstance(claim, Claim)
    np.testing.assert_allclose(np.linalg.norm(claim.quat_cam_from_world_wxyz, axis=1), 1.0, rtol=1e-12)
