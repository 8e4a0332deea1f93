"""One reconstruction in two formats, in every camera model, and with several sensors: the audit sees the same."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest
from numpy.testing import assert_allclose

from sfm_audit.audit import ModelAuditor, audit_model
from sfm_audit.audit.simulate.adjust import adjust_scene, write_model
from sfm_audit.audit.simulate.scene import SceneSpec, simulate_scene
from sfm_audit.loaders import open_model
from sfm_audit.loaders.camera_models import COLMAP_MODELS

IDENTITY = ["model_path", "file_format", "dataset", "scene", "component"]


def test_binary_and_text_give_the_same_tables(tmp_path):
    scene = simulate_scene(SceneSpec(num_images=12, points_per_image=120), np.random.default_rng(2))
    claim = adjust_scene(scene)
    tables = []
    for text in (False, True):
        folder = tmp_path / str(text)
        folder.mkdir()
        write_model(scene, claim, folder, text=text)
        tables.append(audit_model(open_model(folder)))
    for name in ("images", "cameras", "models"):
        one, other = (result.tables[name].to_pandas() for result in tables)
        assert len(one) == len(other) > 0
        for column in one.columns.difference(IDENTITY):
            if one[column].dtype.kind == "f":
                assert_allclose(other[column], one[column], rtol=1e-12, atol=1e-12, err_msg=column)
            elif column == "params":
                assert_allclose(np.stack(other[column]), np.stack(one[column]), rtol=1e-12)
            elif not isinstance(one[column].dropna().head(1).squeeze(), np.ndarray):
                assert list(one[column].fillna("")) == list(other[column].fillna("")), column


def synthesized(folder, *, model=None, cameras_per_rig=1, seed=0):
    """Write a noisy reconstruction of pycolmap's own making, with rigs and frames, and return it."""
    pycolmap.set_random_seed(seed)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig = 2, cameras_per_rig
    options.num_frames_per_rig, options.num_points3D = 5, 150
    if model is not None:
        camera = pycolmap.Camera.create_from_model_name(1, model.name, 1280.0, 1024, 768)
        options.camera_model_id, options.camera_params = camera.model, camera.params.tolist()
        options.camera_width, options.camera_height = 1024, 768
    reconstruction = pycolmap.synthesize_dataset(options)
    noise = pycolmap.SyntheticNoiseOptions()
    noise.point2D_stddev = 0.5
    pycolmap.synthesize_noise(noise, reconstruction)
    folder.mkdir(exist_ok=True)
    reconstruction.write_binary(str(folder))
    return reconstruction


def assert_residuals_are_pycolmap_s(folder, reconstruction):
    model = open_model(folder)
    auditor = ModelAuditor(model)
    total = 0
    for image_idx in range(len(model.images)):
        image = reconstruction.images[int(model.images.image_id[image_idx])]
        linked = [p for p in image.points2D if p.has_point3D()]
        if not linked:
            continue
        xyz_cam = np.array([image.cam_from_world() * reconstruction.points3D[p.point3D_id].xyz for p in linked])
        projected = image.camera.img_from_cam(xyz_cam)
        spherical = image.camera.model_name == "EQUIRECTANGULAR"
        inlier = ((xyz_cam[:, 2] > 0) | spherical) & np.isfinite(projected).all(axis=1)
        expected = (np.array([p.xy for p in linked]) - projected)[inlier]
        ours = auditor.residuals.residuals_px[:, auditor.residuals.rows(image_idx)].T
        assert_allclose(ours, expected, rtol=0, atol=1e-9)
        total += len(ours)
    assert total > 500
    row = auditor.tables().models.to_pylist()[0]
    reconstruction.update_point_3d_errors()
    expected_error = reconstruction.compute_mean_reprojection_error()
    assert row["recomputed_point_error_px"] == pytest.approx(expected_error, rel=1e-9)
    return auditor


@pytest.mark.parametrize("model", COLMAP_MODELS, ids=lambda model: model.name)
def test_every_camera_model_is_audited_as_pycolmap_projects(tmp_path, model):
    reconstruction = synthesized(tmp_path / "model", model=model)
    auditor = assert_residuals_are_pycolmap_s(tmp_path / "model", reconstruction)
    images = auditor.tables().images.to_pandas()
    assert images.sigma_constant_px.between(0.2, 0.6).all()
    assert (images.camera_model == model.name).all()
    if model.is_spherical:
        assert images.misfit_radial_p.isna().all()


def test_rigs_with_several_sensors(tmp_path):
    reconstruction = synthesized(tmp_path / "rigs", cameras_per_rig=3)
    assert len(reconstruction.images) == 30
    assert_residuals_are_pycolmap_s(tmp_path / "rigs", reconstruction)


def test_a_point_across_the_seam_of_a_panorama_is_near(tmp_path):
    """Observed at one edge, predicted at the other: pycolmap measures angles, and so do we."""
    model = next(m for m in COLMAP_MODELS if m.is_spherical)
    reconstruction = synthesized(tmp_path / "seam", model=model)
    image = next(iter(reconstruction.images.values()))
    moved = 0
    for point in image.points2D:
        if point.has_point3D() and moved < 20:  # move the point behind the camera, observe it across the seam
            centre = image.cam_from_world().inverse()
            side = 1e-3 if moved % 2 else -1e-3
            reconstruction.points3D[point.point3D_id].xyz = centre * np.array([side, 0.1, -5.0])
            point.xy = np.array([0.2 if side < 0 else 1023.8, point.xy[1]])
            moved += 1
    folder = tmp_path / "moved"
    folder.mkdir()
    reconstruction.write_binary(str(folder))
    opened = open_model(folder)
    row = int(np.flatnonzero(opened.images.image_id == image.image_id)[0])
    auditor = ModelAuditor(opened)
    residuals = auditor.residuals.residuals_px[:, auditor.residuals.rows(row)]
    assert np.abs(residuals[0]).max() < 512
    result = auditor.tables().models.to_pylist()[0]
    reconstruction.update_point_3d_errors()
    assert result["recomputed_point_error_px"] == pytest.approx(
        reconstruction.compute_mean_reprojection_error(), rel=1e-9
    )
