"""The two radial cameras: against OpenCV and pycolmap, their derivatives, and the way back."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pycolmap
import pytest
from calibrate_samples import DIVISION, FORWARD
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from sfm_audit.audit.calibrate import camera as module
from sfm_audit.audit.calibrate.camera import CalibratedCamera

CAMERAS = {"forward": FORWARD, "division": DIVISION}
ALL = ("f", "fx", "fy", "cx", "cy", "k1", "k2", "k3")


def points(n=200, seed=0):
    rng = np.random.default_rng(seed)
    depth = rng.uniform(2.0, 9.0, n)
    return np.column_stack([rng.uniform(-0.9, 0.9, (n, 2)) * depth[:, None], depth])


def test_the_forward_model_is_opencv_s():
    """cv2.projectPoints, 4.14; OpenCV's first pixel centre is (0, 0), which only shifts what one calls the centre."""
    xyz = points()
    (fx, fy), (cx, cy), (k1, k2, k3) = FORWARD.focal_px, FORWARD.principal_point_px, FORWARD.coefficients
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    theirs = cv2.projectPoints(xyz, np.zeros(3), np.zeros(3), matrix, np.array([k1, k2, 0.0, 0.0, k3]))[0][:, 0]
    assert_allclose(FORWARD.project(xyz).xy_px.T, theirs, atol=1e-9)


@pytest.mark.parametrize("camera", [FORWARD, replace(DIVISION, coefficients=np.array([-0.06, 0.0, 0.0]))])
def test_the_colmap_camera_projects_alike(camera):
    """pycolmap 4.2.1 img_from_cam, FULL_OPENCV and DIVISION."""
    record = camera.colmap
    theirs = pycolmap.Camera(model=record.model.name, width=1600, height=1600, params=record.params)
    assert_allclose(camera.project(points()).xy_px.T, theirs.img_from_cam(points()), atol=1e-8)


def test_a_division_model_of_three_is_none_of_colmap_s():
    assert DIVISION.colmap is None


@pytest.mark.parametrize("name", CAMERAS)
def test_derivatives_are_those_of_the_projection(name):
    camera, xyz, step = replace(CAMERAS[name], estimated=ALL), points(50), 1e-6
    projected = camera.project(xyz)

    def moved(i, by):
        fx, fy, cx, cy, *k = [*camera.focal_px, *camera.principal_point_px, *camera.coefficients]
        values = {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "k1": k[0], "k2": k[1], "k3": k[2]}
        for key in ("fx", "fy") if ALL[i] == "f" else (ALL[i],):
            values[key] += by
        shape = ((values["fx"], values["fy"]), (values["cx"], values["cy"]))
        coefficients = np.array([values["k1"], values["k2"], values["k3"]])
        return CalibratedCamera(1600, 1600, camera.distortion, *shape, coefficients, ALL).project(xyz).xy_px

    for i, parameter in enumerate(ALL):
        numeric = (moved(i, step) - moved(i, -step)) / (2.0 * step)
        assert_allclose(projected.d_params[i], numeric, atol=1e-4, err_msg=parameter)
    for i in range(6):
        change = step * np.eye(6)[i]
        images = [camera.project(Rotation.from_rotvec(s * change[:3]).apply(xyz) + s * change[3:]) for s in (1, -1)]
        numeric = (images[0].xy_px - images[1].xy_px) / (2.0 * step)
        assert_allclose(projected.pose[i], numeric, atol=1e-4, err_msg=f"pose {i}")


@pytest.mark.parametrize("name", CAMERAS)
def test_undistort_is_the_way_back(name):
    xyz = points()
    u = CAMERAS[name].undistort(CAMERAS[name].project(xyz).xy_px.T)
    assert_allclose(u, xyz[:, :2] / xyz[:, 2:], atol=1e-12)


@pytest.mark.parametrize("name", CAMERAS)
@pytest.mark.parametrize("scale", [-3.0, -1.0, 0.0, 1.0, 4.0, 20.0])
def test_newton_finds_what_the_bracket_finds(name, scale, monkeypatch):
    camera = replace(CAMERAS[name], coefficients=scale * CAMERAS[name].coefficients)
    xyz = np.vstack([points(), [[0.0, 0.0, 1.0], [40.0, 0.0, 1.0]]])
    pixels = np.vstack([camera.project(points()).xy_px.T, [[800.0, 800.0], [20000.0, 800.0]]])
    fast = camera.project(xyz).xy_px, camera.undistort(pixels)
    monkeypatch.setattr(module, "_NEWTON_CHANGE", -1.0)
    slow = camera.project(xyz).xy_px, camera.undistort(pixels)
    for one, other in zip(fast, slow, strict=True):
        assert_allclose(one, other, rtol=1e-11)


@pytest.mark.parametrize("name", CAMERAS)
def test_newton_is_enough_for_usual_lenses(name, monkeypatch):
    """The bracket costs ten times as much."""
    monkeypatch.delattr(module, "_bracketed_root_before")
    CAMERAS[name].undistort(CAMERAS[name].project(points()).xy_px.T)


def test_a_pixel_beyond_the_fold_has_no_ray():
    """r (1 - 0.6 r^2 + 0.12 r^4) turns at 0.857, at the height 0.535, and has 2 and 3 again further out."""
    camera = replace(FORWARD, coefficients=np.array([-0.6, 0.12, 0.0]))
    heights = np.array([0.53, 0.54, 0.6, 2.0, 3.0])
    found = camera.undistort(800.0 + 800.0 * np.column_stack([heights, np.zeros(5)]))
    assert 0.75 < found[0, 0] < camera.fold_radius < 0.9
    assert np.isnan(found[1:]).all()


def test_points_behind_the_camera_have_no_pixel():
    for camera in CAMERAS.values():
        assert np.isnan(camera.project(-points()).xy_px).all()


@pytest.mark.parametrize(
    ("camera", "coefficients"),
    [
        (FORWARD, [-0.2, 0.0, 0.0]),
        (FORWARD, [-0.3, 0.05, -0.01]),
        (DIVISION, [0.2, 0.0, 0.0]),
        (DIVISION, [0.3, 0.1, 0.0]),
    ],
)
def test_the_fold_is_where_the_image_turns_back(camera, coefficients):
    camera = replace(camera, coefficients=np.array(coefficients))
    fold = camera.fold_radius
    at = camera.project(np.column_stack([fold * np.array([0.98, 0.999, 1.001]), np.zeros(3), np.ones(3)])).xy_px[0]
    assert at[0] < at[1]
    assert np.isnan(at[2]) or at[2] - at[1] < 1e-3 * (at[1] - at[0])  # a division model has no image beyond


def test_a_lens_that_only_pulls_out_has_no_fold():
    assert replace(FORWARD, coefficients=np.array([0.1, 0.1, 0.1])).fold_radius == np.inf
    assert replace(DIVISION, coefficients=np.array([-0.1, 0.0, 0.0])).fold_radius == np.inf
