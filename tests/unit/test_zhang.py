"""Zhang's method finds the camera that made the views, and says on held-out views how wrong a poorer model is."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose

from sfm_audit.audit.calibrate.estimate import Degeneracy, DegenerateInputError
from sfm_audit.audit.calibrate.zhang import MODELS, zhang
from sfm_audit.audit.simulate.room import CORNER_SD_PX, ROOM_CAMERAS, zhang_views


@pytest.fixture(scope="module", params=list(ROOM_CAMERAS))
def calibrated(request):
    """The camera's name, its views, and the result of each model from the first 15."""
    views = zhang_views(request.param, 3, 25)
    return request.param, views, {model: zhang(views[:15], model, views[15:]) for model in MODELS}


def values_of(camera):
    (fx, fy), (cx, cy), (k1, k2, k3) = camera.focal_px, camera.principal_point_px, camera.coefficients
    values = {"f": fy, "fx": fx, "fy": fy, "cx": cx, "cy": cy, "k1": k1, "k2": k2, "k3": k3}
    return np.array([values[name] for name in camera.estimated])


@pytest.mark.parametrize("name", list(ROOM_CAMERAS))
def test_exact_views_give_the_exact_camera(name):
    views = zhang_views(name, 0, 12, corner_sd_px=0.0)
    found, true = zhang(views[:10], "M5", views[10:]), ROOM_CAMERAS[name]
    assert_allclose(found.camera.focal_px, true.focal_px, atol=5e-3)  # OpenCV reads single precision
    assert_allclose(found.camera.principal_point_px, true.principal_point_px, atol=5e-3)
    assert_allclose(found.camera.coefficients, true.coefficients, atol=2e-4)
    assert found.sd_px < 1e-4


def test_only_m5_explains_views_that_it_has_not_seen(calibrated):
    name, _, results = calibrated
    noise_px = CORNER_SD_PX[name]
    assert results["M5"].sd_px == pytest.approx(noise_px, rel=0.12)
    assert results["M5"].train_sd_px == pytest.approx(noise_px, rel=0.08)
    for model in ("M1", "M2", "M3", "M4"):
        assert results[model].sd_px > 1.25 * results["M5"].sd_px
    assert results["M1"].sd_px > results["M4"].sd_px


def test_the_parameters_are_the_true_ones_within_their_standard_deviations(calibrated):
    name, _, results = calibrated
    found = results["M5"]
    z = (values_of(found.camera) - values_of(ROOM_CAMERAS[name])) / found.parameter_sd
    assert np.abs(z).max() < 4.0
    assert 1.0 < (z**2).sum() < 24.3  # 99.9 % of chi^2(7)


def test_each_model_estimates_its_parameters_and_no_others(calibrated):
    _, views, results = calibrated
    for model, found in results.items():
        camera = found.camera
        assert camera.estimated == MODELS[model]
        assert (camera.focal_px[0] == camera.focal_px[1]) == ("f" in MODELS[model])
        middle = (0.5 * views[0].width, 0.5 * views[0].height)
        assert (camera.principal_point_px == pytest.approx(middle)) == ("cx" not in MODELS[model])
        fixed = [k not in MODELS[model] for k in ("k1", "k2", "k3")]
        assert (camera.coefficients == 0.0).tolist() == fixed
        assert len(found.parameter_sd) == len(MODELS[model])
        assert min(found.parameter_sd) > 0.0
        assert (found.num_views, found.num_held_out) == (15, 10)


def test_the_rms_is_opencvs_and_the_residuals_are_its_too(calibrated):
    """OpenCV 4 projectPoints and solvePnP (another pose solver than ours) on the held-out views."""
    _, views, results = calibrated
    found = results["M5"]
    rms, matrix, distortion, _, _ = cv2.calibrateCamera(
        [v.xyz_world.astype(np.float32) for v in views[:15]],
        [(v.xy_px - 0.5).astype(np.float32) for v in views[:15]],
        (views[0].width, views[0].height),
        None,
        None,
        flags=cv2.CALIB_ZERO_TANGENT_DIST,
    )
    assert found.train_rms_px == pytest.approx(rms, rel=1e-4)
    residuals = []
    for view in views[15:]:
        _, turn, shift = cv2.solvePnP(view.xyz_world, view.xy_px - 0.5, matrix, distortion)
        xy, _ = cv2.projectPoints(view.xyz_world, turn, shift, matrix, distortion)
        residuals.append(view.xy_px - 0.5 - xy[:, 0])
    assert_allclose(found.residuals_px, np.concatenate(residuals), atol=0.01)
    num = found.residuals_px.size
    assert found.sd_px == pytest.approx(np.sqrt((found.residuals_px**2).sum() / (num - 60)))


def test_the_unit_of_the_board_does_not_matter():
    views = zhang_views("plain", 2, 10)
    scaled = [dataclasses.replace(view, xyz_world=0.025 * view.xyz_world) for view in views]
    one, other = (zhang(some[:7], "M3", some[7:]) for some in (views, scaled))
    assert_allclose(one.camera.focal_px, other.camera.focal_px, rtol=1e-4)
    assert one.sd_px == pytest.approx(other.sd_px, rel=1e-4)


def test_degenerate_views_are_refused_with_their_reason():
    views = zhang_views("plain", 0, 6)
    bad = views[0].xy_px.copy()
    bad[3, 1] = np.nan
    few = dataclasses.replace(views[0], xy_px=views[0].xy_px[:5], xyz_world=views[0].xyz_world[:5])
    line = dataclasses.replace(views[0], xyz_world=views[0].xyz_world * [1.0, 0.0, 0.0])
    for some, held_out, degeneracy in (
        (views[:2], views[2:], Degeneracy.TOO_FEW_POINTS),
        (views[:4], [], Degeneracy.TOO_FEW_POINTS),
        (views[:4], [few], Degeneracy.TOO_FEW_POINTS),
        ([*views[:4], dataclasses.replace(views[4], xy_px=bad)], views[5:], Degeneracy.NOT_FINITE),
        ([line] * 3, views[5:], Degeneracy.NOT_A_CAMERA),
    ):
        with pytest.raises(DegenerateInputError) as error:
            zhang(some, "M1", held_out)
        assert error.value.degeneracy is degeneracy


def test_wrong_calls_are_refused():
    views = zhang_views("plain", 0, 5)
    with pytest.raises(ValueError, match="unknown model 'M6'; there are M1, M2, M3, M4, M5"):
        zhang(views[:4], "M6", views[4:])
    raised = dataclasses.replace(views[4], xyz_world=views[4].xyz_world + np.array([0.0, 0.0, 1.0]))
    with pytest.raises(ValueError, match="plane z = 0"):
        zhang(views[:4], "M1", [raised])
    with pytest.raises(ValueError, match="size of the first"):
        zhang(views[:4], "M1", [dataclasses.replace(views[4], width=999)])
