"""Validation of calibrated cameras: laws, and numbers of OpenCV, SciPy and the auditor's own COLMAP cameras."""

import dataclasses
import math

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
from calibrate_doubles import D1, D3, SIZE, board, fitted, moved, true_camera
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from sfm_audit.audit.calibrate.camera import CalibratedCamera, Distortion
from sfm_audit.audit.calibrate.estimate import Degeneracy, DegenerateInputError, estimate_of
from sfm_audit.audit.calibrate.evidence import camera_folds, correlation_focal_depth, expected_error_of, plane_geometry
from sfm_audit.audit.calibrate.lens_misfit import expected_points, misfit_tests
from sfm_audit.audit.calibrate.rows import calibration_row, calibration_table, degenerate_row, residuals_table
from sfm_audit.audit.calibrate.undistort import undistort_image, undistort_map
from sfm_audit.audit.calibrate.validation import DEFAULTS, validate
from sfm_audit.audit.camera_quality.expected_error import expected_error_map
from sfm_audit.audit.camera_quality.plausibility import folds_over
from sfm_audit.audit.misfit import MisfitGroup, MisfitStatus, candidate_fields, prepare
from sfm_audit.audit.noise.standardise import constant_noise
from sfm_audit.audit.table import CALIBRATION, CALIBRATION_RESIDUALS, schema
from sfm_audit.audit.table.words import Member, ReasonCode, Verdict
from sfm_audit.loaders.camera_models import BY_NAME
from sfm_audit.loaders.model import CameraRecord
from sfm_audit.reports.text.calibration import render_calibration
from sfm_audit.reports.text.drawing import Page

REJECTED, UNDETERMINED, ACCEPTED = Verdict.REJECTED, Verdict.UNDETERMINED, Verdict.ACCEPTED
SETTINGS = {"alpha": 0.05, "min_effect": "0.5sigma", "policy": "full"}


def estimated(name="D3", seed=0, **options):
    correspondences, rotation, translation = board(np.random.default_rng(seed), **options)
    names = {"D1": D1, "D3": D3}[name]
    return fitted(name, names, correspondences, rotation, translation), correspondences


def with_neighbours(correspondences, step=1e-3):
    """Neighbours in the board's own directions: they are enough for a_x and a_y."""
    pan, tilt = (correspondences.xyz_world + step * np.eye(3)[axis] for axis in (0, 1))
    return dataclasses.replace(correspondences, pan_xyz_world=pan, tilt_xyz_world=tilt)


def codes(judgement):
    return [reason.code for reason in judgement.reasons]


def test_a_right_camera_is_accepted_and_its_noise_known():
    found = validate(*estimated("D3"))
    assert (found.verdict, found.decision.reasons) == (ACCEPTED, ())
    assert found.noise_name == "constant"
    assert 0.027 < found.sd_px < 0.033
    assert found.robust.sd_px == pytest.approx(found.sd_px, rel=0.1)
    assert found.plain.sd_px == found.sd_px
    assert found.pose_offset_px < 1e-6
    radial = found.tests[MisfitGroup.RADIAL]
    assert (radial.status, radial.rank) == (MisfitStatus.ABSORBED, 0)


def test_a_lens_of_one_coefficient_is_rejected_by_misfit_alone():
    found = validate(*estimated("D1"))
    assert found.decision.of(Member.MISFIT) == REJECTED
    assert codes(found.decision.members[Member.MISFIT])[0] == ReasonCode.MISFIT_RADIAL
    assert found.decision.of(Member.POSE) == ACCEPTED
    assert found.olsson_accepts  # the rule that the paper argues against


def test_the_radial_score_is_what_more_coefficients_remove():
    """SciPy's least squares with k2 and k3 free: to first order |s|^2 is the drop of the sum of squares."""
    camera = true_camera((-0.0684, 0.002, 0.0))
    correspondences, rotation, translation = board(np.random.default_rng(1), camera=camera, extent=0.6)
    fits = [fitted(name, names, correspondences, rotation, translation) for name, names in (("D1", D1), ("D3", D3))]
    one, three = (float((fit.residuals_px**2).sum()) for fit in fits)
    projected = fits[0].project(correspondences.xyz_world)
    nuisance = np.concatenate([projected.pose, projected.d_params])
    prepared = prepare(nuisance, candidate_fields(fits[0].camera.pinhole, projected))
    y = np.ascontiguousarray(fits[0].residuals_px.T)
    assert (prepared.explained_px(y, MisfitGroup.RADIAL) ** 2).sum() == pytest.approx(one - three, rel=0.01)
    test = misfit_tests(fits[0], correspondences)[MisfitGroup.RADIAL]
    assert test.p == pytest.approx(prepared.test(y)[MisfitGroup.RADIAL].p, rel=1e-6)
    assert (test.p < 1e-6, test.rank) == (True, 2)
    assert 0.7 < correspondences.num * test.px**2 / (one - three) < 1.0  # px is cleaned of tr M


@given(scale=st.sampled_from([1e-3, 0.1, 30.0]), turn=st.floats(-3.0, 3.0))
@settings(max_examples=5, deadline=None)
def test_the_world_s_unit_and_frame_do_not_matter(scale, turn):
    estimate, correspondences = estimated("D1", seed=3)
    here = validate(estimate, correspondences)
    rotation, shift = Rotation.from_euler("zyx", [turn, 0.3, -0.2]).as_matrix(), np.array([3.0, -2.0, 1.0])
    world = scale * (correspondences.xyz_world @ rotation.T + shift)
    r = estimate.rotation_cam_from_world @ rotation.T
    t = scale * (estimate.translation_cam_from_world - r @ shift)
    other = dataclasses.replace(correspondences, xyz_world=world)
    there = validate(estimate_of("D1", estimate.camera, r, t, other, inliers=estimate.inliers), other)
    for group, test in here.tests.items():
        assert_allclose(there.tests[group].p, test.p, rtol=1e-5)
    assert_allclose(there.identifiability.sd_focal_rel, here.identifiability.sd_focal_rel, rtol=1e-6)
    assert_allclose(there.expected_error.error_px, here.expected_error.error_px, rtol=1e-6)
    assert_allclose(there.geometry.tilt_deg, here.geometry.tilt_deg, rtol=1e-6)
    assert there.verdict == here.verdict


def test_plane_geometry_of_known_planes():
    rng = np.random.default_rng(0)
    flat = np.column_stack([rng.uniform(-1, 1, (50, 2)), np.zeros(50)])
    for degrees in (0.0, 0.5, 12.0, 60.0):
        tilted = flat @ Rotation.from_euler("y", degrees, degrees=True).as_matrix().T + [0, 0, 4]
        geometry = plane_geometry(tilted)
        assert geometry.tilt_deg == pytest.approx(degrees, abs=1e-6)
        assert geometry.planarity < 1e-12
        assert geometry.is_fronto_parallel == (degrees < 5)
    assert not plane_geometry(rng.uniform(-1, 1, (50, 3))).is_fronto_parallel
    assert math.isnan(plane_geometry(flat[:2]).tilt_deg)
    assert math.isnan(plane_geometry(np.ones((5, 3))).planarity)


def test_a_fronto_parallel_board_determines_no_focal_length():
    found = validate(*estimated("D3", tilt_deg=(0.3, -0.2), extent=0.7))
    assert found.verdict == UNDETERMINED
    assert {ReasonCode.FOCAL_NOT_IDENTIFIED, ReasonCode.FRONTO_PARALLEL} <= set(codes(found.decision.judgement))
    assert abs(correlation_focal_depth(found.estimate)) > 0.9999
    assert found.identifiability.sd_focal_rel > 0.01


def test_a_moved_pose_is_rejected():
    estimate, correspondences = estimated("D3")
    found = validate(moved(estimate, correspondences, np.array([0.003, 0.0, 0.0])), correspondences)
    assert found.decision.of(Member.POSE) == REJECTED
    assert found.pose_offset_px > 0.5


def test_too_few_and_too_exact():
    correspondences, rotation, translation = board(np.random.default_rng(0))
    few = np.arange(correspondences.num) % 12 == 0
    found = validate(fitted("D1", D1, correspondences, rotation, translation, inliers=few), correspondences)
    assert found.verdict == UNDETERMINED
    assert codes(found.decision.judgement) == [ReasonCode.TOO_FEW_OBSERVATIONS]
    exact, rotation, translation = board(np.random.default_rng(0), noise_px=0.0)
    estimate = estimate_of("D3", true_camera(), rotation, translation, exact, inliers=np.ones(exact.num, dtype=bool))
    found = validate(estimate, exact)
    assert found.decision.of(Member.KS) == found.decision.of(Member.MISFIT) == UNDETERMINED
    assert ReasonCode.EXACT_PROJECTIONS in codes(found.decision.judgement)


def test_outliers_stay_out():
    correspondences, rotation, translation = board(np.random.default_rng(2))
    wrong = np.zeros(correspondences.num, dtype=bool)
    wrong[::20] = True
    spoilt = dataclasses.replace(correspondences, xy_px=correspondences.xy_px + 40.0 * wrong[:, None])
    found = validate(fitted("D3", D3, spoilt, rotation, translation, inliers=~wrong), spoilt)
    assert (found.verdict, len(found.xy_px)) == (ACCEPTED, int((~wrong).sum()))
    table = residuals_table([found], spoilt)
    assert table["z_x"].null_count == wrong.sum()
    assert np.abs(table["residual_x_px"].to_numpy()[wrong]).min() > 30


def test_the_plain_scale_hides_what_the_robust_one_shows():
    """A tenth of the corners is ten times worse: the paper's robust scale sees it, the plain one absorbs it."""
    estimate, correspondences = estimated("D3", seed=5)
    bad = np.random.default_rng(0).uniform(size=correspondences.num) < 0.1
    spoilt = dataclasses.replace(
        correspondences,
        xy_px=correspondences.xy_px + np.where(bad[:, None], 10.0 * estimate.residuals_px, 0.0),
    )
    found = validate(
        estimate_of(
            "D3",
            estimate.camera,
            estimate.rotation_cam_from_world,
            estimate.translation_cam_from_world,
            spoilt,
            inliers=estimate.inliers,
        ),
        spoilt,
    )
    assert found.plain.sd_px > 2.0 * found.robust.sd_px
    assert 0.03 < found.robust.sd_px < 0.045  # a tenth of outliers, each counted as two sd
    assert found.robust.tests.kurtosis_excess > 3


def test_expected_error_is_that_of_colmap_s_camera():
    """audit.expected_error on SIMPLE_RADIAL, whose Jacobians are pycolmap's, for D1: the same parameters."""
    estimate, correspondences = estimated("D1")
    camera = estimate.camera
    params = np.array([camera.focal_px[0], *camera.principal_point_px, camera.coefficients[0]])
    colmap = CameraRecord(1, BY_NAME["SIMPLE_RADIAL"], SIZE, SIZE, params)
    depth = float(np.median(estimate.xyz_cam(correspondences.xyz_world)[:, 2]))
    named = dataclasses.replace(
        estimate.covariance, names=tuple({"k1": "k"}.get(name, name) for name in estimate.covariance.names)
    )
    theirs = expected_error_map(colmap, named, 0.03, depth)
    ours = expected_error_of(estimate, correspondences, 0.03)
    assert_allclose(ours.error_px, theirs.error_px, rtol=1e-6)
    assert_allclose(ours.xy_px, theirs.xy_px)


@pytest.mark.parametrize("k1", [-0.5, -0.2, -0.05, 0.2, 0.9])
def test_folding_is_colmap_s(k1):
    for distortion, model in ((Distortion.FORWARD, "SIMPLE_RADIAL"), (Distortion.DIVISION, "SIMPLE_DIVISION")):
        camera = true_camera((k1, 0.0, 0.0), distortion=distortion)
        # COLMAP's division model is undistorted = distorted / (1 + k r^2), as ours
        colmap = CameraRecord(1, BY_NAME[model], SIZE, SIZE, np.array([800.0, 800.0, 800.0, k1]))
        if distortion is Distortion.FORWARD:
            assert camera_folds(camera) == folds_over(colmap)
        else:
            r_sq = 2.0  # of the corners; a ray must exist there, and be no other pixel's
            assert camera_folds(camera) == (1 + k1 * r_sq <= 0 or 1 - k1 * r_sq <= 0)


def test_a_division_model_that_dips_before_the_corner_folds():
    """p - r p' = 1 - 3.2 r^2 + 2 r^4 is negative between the radii 0.65 and 1.09, positive at the corner, 1.41."""
    k = np.array([3.2, -2.0 / 3.0, 0.0])
    r = np.linspace(0, math.sqrt(2), 400)
    p = 1 + k[0] * r**2 + k[1] * r**4 + k[2] * r**6
    rising = np.diff(r / p) > 0
    assert rising[-1]
    assert not rising.all()
    assert camera_folds(true_camera(k, distortion=Distortion.DIVISION))


def test_undistorting_is_opencv_s():
    size, half = 320, (160.0, 160.0)  # a fifth of SIZE, and the same rays
    camera = CalibratedCamera(size, size, Distortion.FORWARD, half, half, true_camera().coefficients, D3)
    k = np.array([[160.0, 0, 159.5], [0, 160.0, 159.5], [0, 0, 1]])  # OpenCV's first pixel centre is (0, 0)
    k1, k2, k3 = camera.coefficients
    x, y = cv2.initUndistortRectifyMap(k, np.array([k1, k2, 0, 0, k3]), np.eye(3), k, (size, size), cv2.CV_32FC1)
    ours = undistort_map(camera) - 0.5
    assert_allclose(ours[..., 0], x, atol=4e-4)
    assert_allclose(ours[..., 1], y, atol=4e-4)
    photo = np.random.default_rng(0).integers(0, 255, (size, size), dtype=np.uint8)
    theirs = cv2.remap(photo, x, y, cv2.INTER_LINEAR)
    assert np.mean(np.abs(undistort_image(photo, camera).astype(int) - theirs)) < 0.1


def test_undistorting_refuses_another_size_and_shows_black_where_nothing_is():
    camera = CalibratedCamera(40, 30, Distortion.FORWARD, (20.0, 20.0), (20.0, 15.0), np.array([0.8, 0.0, 0.0]), D1)
    out = undistort_image(np.full((30, 40, 3), 200, dtype=np.uint8), camera)
    assert out[15, 20].tolist() == [200, 200, 200]
    assert out[0, 0].tolist() == [0, 0, 0]
    with pytest.raises(ValueError, match="40 x 40"):
        undistort_image(np.zeros((40, 40), dtype=np.uint8), camera)


def test_expected_points_at_both_ends():
    """All noise is the lidar's: the point is where it was seen. All is the detector's: where the scan has it."""
    estimate, correspondences = estimated("D3", noise_px=0.2)
    correspondences = with_neighbours(correspondences)
    noise = dataclasses.replace(constant_noise(estimate.residuals_px.T), sigma_l=1.0)
    all_lidar = expected_points(estimate, correspondences, dataclasses.replace(noise, sigma_d_px=0.0))
    seen = estimate.camera.project(all_lidar).xy_px.T
    assert_allclose(seen, correspondences.xy_px, atol=2e-3)
    assert_allclose(all_lidar, estimate.xyz_cam(correspondences.xyz_world), atol=2e-3)
    all_detector = expected_points(estimate, correspondences, dataclasses.replace(noise, sigma_l=0.0))
    assert_allclose(all_detector, estimate.xyz_cam(correspondences.xyz_world), atol=1e-12)


def test_lidar_noise_where_there_are_neighbours():
    estimate, correspondences = estimated("D3")
    near = with_neighbours(correspondences)
    found = validate(estimate, near)
    assert (found.noise_name, validate(estimate, near, noise="constant").noise_name) == ("lidar", "constant")
    assert found.robust.sd_px == pytest.approx(found.sd_px, rel=0.1)
    assert found.verdict == ACCEPTED
    with pytest.raises(ValueError, match="no neighbours"):
        validate(estimate, correspondences, noise="lidar")


def test_a_neighbour_without_image_costs_its_own_row_only():
    estimate, correspondences = estimated("D3")
    near = with_neighbours(correspondences)
    pan = near.pan_xyz_world.copy()
    pan[:5, 2] -= 100.0  # behind the camera
    found = validate(estimate, dataclasses.replace(near, pan_xyz_world=pan))
    assert found.robust.tests.num_values == 2 * (correspondences.num - 5)
    assert found.decision.of(Member.KS) == ACCEPTED
    assert math.isfinite(found.robust.sd_px)


def test_tau_and_alpha_are_settings():
    estimate, correspondences = estimated("D1", extent=0.5)
    assert validate(estimate, correspondences).decision.members[Member.MISFIT].verdict == REJECTED
    coarse = DEFAULTS.model_copy(update={"min_effect": "9px"})
    found = validate(estimate, correspondences, config=coarse)
    assert found.decision.of(Member.MISFIT) == ACCEPTED
    assert (found.misfit.group, found.tau_px) == (MisfitGroup.RADIAL, 9.0)
    assert (
        validate(estimate, correspondences, config=DEFAULTS.model_copy(update={"policy": "paper"})).verdict == ACCEPTED
    )


def test_rows_become_tables_that_say_what_they_are(tmp_path):
    estimate, correspondences = estimated("D3")
    found = validate(estimate, correspondences)
    error = DegenerateInputError(Degeneracy.COLLINEAR, "second / first singular value 1e-17")
    rows = [
        calibration_row(found, correspondences, "a.csv", 0.05),
        degenerate_row("pnprf", error, correspondences, "a.csv"),
    ]
    table = calibration_table(rows)
    table.validate(full=True)
    pq.write_table(table, tmp_path / "t.parquet")
    assert pq.read_table(tmp_path / "t.parquet").schema.equals(schema("calibration"), check_metadata=True)
    first, second = table.to_pylist()
    assert first["fx_px"] == estimate.camera.focal_px[0]
    assert first["sd_px"] == pytest.approx(float(np.sqrt(np.mean(estimate.residuals_px**2))))
    assert first["rms_px"] == pytest.approx(first["sd_px"] * math.sqrt(2))
    assert first["camera_model"] == "FULL_OPENCV"
    assert second["verdict"] == second["plausible"] == "undetermined"
    assert second["reasons"] == ["degenerate_input: collinear, second / first singular value 1e-17"]
    assert second["fx_px"] is None
    residuals_table([], correspondences).validate(full=True)
    assert len({column.name for column in CALIBRATION}) == len(CALIBRATION)
    for column in (*CALIBRATION, *CALIBRATION_RESIDUALS):
        assert column.unit
        assert column.meaning
        assert not column.name.endswith("_px") or column.unit == "px"


def test_the_page_fits_and_says_what_speaks_against_each():
    estimate, correspondences = estimated("D1")
    error = DegenerateInputError(Degeneracy.FRONTO_PARALLEL, "tilt 0.0001 deg")
    rows = [
        calibration_row(validate(estimate, correspondences), correspondences, "a/long/folder/board.csv", 0.05),
        degenerate_row("pnprf", error, correspondences, "a/long/folder/board.csv"),
    ]
    text = render_calibration(calibration_table(rows).to_pylist(), SETTINGS, Page())
    assert max(map(len, text.splitlines())) <= 80
    assert "D1  misfit_radial:" in text
    assert "pnprf  degenerate_input: fronto_parallel, tilt 0.0001 deg" in text
    only = render_calibration(calibration_table(rows[1:]).to_pylist(), SETTINGS, Page())
    assert "no camera found" in " ".join(only.split())
