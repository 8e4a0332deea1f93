"""The audit's numbers on real models against pycolmap's (4.2.1), and of one model's two formats against each other."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pycolmap
import pytest
from corpus import REFUSED_BY_PYCOLMAP, parametrize_models
from numpy.testing import assert_allclose

from sfm_audit.audit import AuditConfig, ModelAuditor, audit_model
from sfm_audit.loaders import open_model

# its POINTS2D say -1 and its tracks say otherwise: pycolmap believes the tracks, an audit the images
HAND_MADE = {"gtsfm_unsorted_txt"}


@parametrize_models(excluded=frozenset(REFUSED_BY_PYCOLMAP | HAND_MADE))
def test_residuals_counts_and_point_errors_are_pycolmap_s(model_dir):
    reconstruction = pycolmap.Reconstruction(str(model_dir))
    model = open_model(model_dir)
    auditor = ModelAuditor(model)
    row = auditor.tables().models.to_pylist()[0]
    if row["stored_error_px"] is None:  # nothing but -1: pycolmap's mean over none is 0
        assert {point.error for point in reconstruction.points3D.values()} <= {-1.0}
    else:
        assert_allclose(row["stored_error_px"], reconstruction.compute_mean_reprojection_error(), rtol=1e-12)
    lost_px = {}  # by point
    for image_idx in range(len(model.images)):
        theirs = pycolmap_residuals(reconstruction, int(model.images.image_id[image_idx]))
        ours = auditor.residuals.residuals_px[:, auditor.residuals.rows(image_idx)].T
        if len(theirs) != len(ours):  # points in the camera's centre: a slope beyond arithmetic (audit.inliers.sanity)
            assert len(theirs) - len(ours) == auditor.residuals.num_unprojected[image_idx]
            first, last = model.observations.offsets[image_idx : image_idx + 2]
            seen = auditor.residuals.observation_row[auditor.residuals.rows(image_idx)]
            lost = np.setdiff1d(np.arange(first, last), seen)
            pose = reconstruction.images[int(model.images.image_id[image_idx])].cam_from_world()
            xyz_cam = pose * model.points.xyz_world[model.observations.point_idx[lost]]
            assert np.linalg.norm(xyz_cam, axis=1).max() < 1e-6
            for row_idx in lost.tolist():
                point3d_id = int(model.points.point3d_id[model.observations.point_idx[row_idx]])
                lost_px.setdefault(point3d_id, []).append(np.hypot(*theirs[row_idx - first]))
            theirs = np.delete(theirs, lost - first, axis=0)
        assert_allclose(ours, theirs, rtol=0, atol=1e-9)
    reconstruction.update_point_3d_errors()
    expected = mean_point_error_without(reconstruction, lost_px)
    assert_allclose(row["recomputed_point_error_px"], expected, rtol=1e-9, atol=1e-12)


def mean_point_error_without(reconstruction, lost_px):
    """Mean over points of their mean error, px, without some observations: their lengths by point3D id."""
    if not lost_px:
        return reconstruction.compute_mean_reprojection_error()
    errors = []
    for point3d_id, point in reconstruction.points3D.items():
        lengths = lost_px.get(point3d_id, [])
        num_left = point.track.length() - len(lengths)
        if num_left:  # a point without observations has no error
            errors.append((point.error * point.track.length() - sum(lengths)) / num_left)
    return np.mean(errors)


def pycolmap_residuals(reconstruction, image_id):
    """Observed - projected (n, 2) of the inliers, POINTS2D order, through Camera.img_from_cam."""
    image = reconstruction.images[image_id]
    linked = [point for point in image.points2D if point.has_point3D()]
    if not linked:
        return np.empty((0, 2))
    xyz_cam = np.array([image.cam_from_world() * reconstruction.points3D[p.point3D_id].xyz for p in linked])
    projected = image.camera.img_from_cam(xyz_cam)
    inlier = (xyz_cam[:, 2] > 0) & np.isfinite(projected).all(axis=1)
    return (np.array([p.xy for p in linked]) - projected)[inlier]


PX_COLUMNS = [
    "rms_px",
    "mean_px",
    "median_px",
    "p95_px",
    "max_px",
    "sigma_constant_px",
    "sigma_d_px",
    "sigma_predicted_px",
    "pose_offset_px",
]
COUNTS = ["num_points2d", "num_linked", "num_inliers", "num_unverifiable", "num_standardised", "occupied_cells"]
TEXT = ["image_name", "camera_model", "verdict", "verdict_ks"]
P_COLUMNS = ["ks_p", "ks_q", "ks_fitted_p", "ks_norm_p", "dap_p", "sw_p", "ks_constant_p"]


@pytest.mark.corpus
@pytest.mark.parametrize(("binary", "text"), [("hsu_fox_bin", "hsu_fox_txt"), ("terteros_bin", "terteros_txt")])
def test_binary_and_text_twins_give_the_same_tables(corpus, binary, text):
    one, other = (audit_model(open_model(corpus / "models" / name)).images.to_pandas() for name in (binary, text))
    for column in TEXT + COUNTS:
        pd.testing.assert_series_equal(one[column], other[column])
    for column in PX_COLUMNS:
        assert_allclose(other[column], one[column], rtol=0, atol=1e-6, err_msg=column)
    for column in P_COLUMNS:
        assert_allclose(other[column], one[column], rtol=0, atol=1e-4, err_msg=column)


@pytest.mark.corpus
def test_track_noise_explains_what_constant_noise_does_not(corpus):
    """method.md 3b on real models: plain KS rejects most images under constant noise, few under track noise."""
    shares = []
    for name in ("bartoszek_sparse", "hsu_fox_bin", "pratikk_sfm_7", "halogen_sparse", "terteros_bin"):
        images = audit_model(open_model(corpus / "models" / name), AuditConfig()).images.to_pandas()
        shares.append(
            ((images.ks_constant_p < 0.05).mean(), (images.ks_p < 0.05).mean(), images.kurtosis_excess.median())
        )
    constant, track, kurtosis = np.median(shares, axis=0)
    assert constant > 0.9
    assert track < 0.45
    assert abs(kurtosis) < 0.35
