"""Lenses that COLMAP lacks: against pycolmap's models where these hold them, and against their programs' formulas."""

import numpy as np
import pycolmap
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from sfm_audit.audit.cameras import project, project_with_jacobians, unproject
from sfm_audit.audit.misfit.capabilities import extended_params, larger_models
from sfm_audit.loaders.camera_models import BY_NAME, CAMERA_MODELS, COLMAP_MODELS

NAMES = [model.name for model in CAMERA_MODELS if not model.is_colmap]
K1, K2, K3, K4, P1, P2 = -0.11, 0.03, -0.02, 0.014, 0.008, -0.005
F, FY, CX, CY = 900.0, 950.0, 800.0, 600.0
VALUES = {"f": F, "fx": F, "fy": FY, "cx": CX, "cy": CY, "k": K1, "k1": K1, "k2": K2, "k3": K3, "k4": K4}
VALUES |= {"p1": P1, "p2": P2, "transition": 0.6, "b1": 0.01, "b2": -0.02}


def points(count: int = 300) -> np.ndarray:
    rng = np.random.default_rng(4)
    return rng.uniform([-0.8, -0.6, 1.0], [0.8, 0.6, 1.0], (count, 3)) * rng.uniform(0.5, 30.0, (count, 1))


def params_of(name: str, **changes: float) -> np.ndarray:
    return np.array([(VALUES | changes)[parameter] for parameter in BY_NAME[name].param_names])


def theirs(name: str, params: list[float], xyz: np.ndarray) -> np.ndarray:
    return pycolmap.Camera(model=name, width=1600, height=1200, params=params).img_from_cam(xyz)


FULL = [CX, CY, K1, K2, P1, P2, K3, 0.0, 0.0, 0.0]
PYCOLMAP = [
    ("BROWN", {}, "FULL_OPENCV", [F, FY, *FULL]),
    ("SIMPLE_BROWN", {}, "FULL_OPENCV", [F, F, *FULL]),
    ("RADIAL_3", {}, "FULL_OPENCV", [F, F, CX, CY, K1, K2, 0.0, 0.0, K3, 0.0, 0.0, 0.0]),
    ("SIMPLE_OPENCV_FISHEYE", {}, "OPENCV_FISHEYE", [F, F, CX, CY, K1, K2, K3, K4]),
    ("DUAL", {"transition": 1.0}, "RADIAL", [F, CX, CY, K1, K2]),
    ("DUAL", {"transition": 0.0}, "RADIAL_FISHEYE", [F, CX, CY, K1, K2]),
    ("FRAME", {"k4": 0.0, "b1": 0.0, "b2": 0.0}, "FULL_OPENCV", [F, F, *FULL]),
    ("FRAME", {"k4": 0.0, "b2": 0.0}, "FULL_OPENCV", [F * 1.01, F, *FULL]),
    ("INVERSE_RADIAL", {"k": 0.0}, "SIMPLE_PINHOLE", [F, CX, CY]),
]


@pytest.mark.parametrize(("name", "changes", "colmap_name", "colmap_params"), PYCOLMAP)
def test_what_colmap_can_express_is_pycolmap_s(name, changes, colmap_name, colmap_params):
    xyz = np.concatenate([points(), [[0.0, 0.0, 1.0], [0.1, 0.2, -1.0], [0.0, 0.0, 0.0], [np.nan, 0.0, 1.0]]])
    wanted = theirs(colmap_name, colmap_params, xyz)
    wanted[~np.isfinite(wanted).all(axis=1)] = np.nan
    ours = project_with_jacobians(BY_NAME[name], params_of(name, **changes), xyz)
    assert_allclose(ours.xy_px, wanted, rtol=0, atol=1e-9)
    assert np.isfinite(ours.d_xy_d_cam[:-3]).all()
    assert np.isnan(ours.d_xy_d_cam[-3:]).all()
    assert np.isnan(ours.d_xy_d_params[-3:]).all()


def test_frame_is_metashape_s_formula():
    """Manual of Metashape, frame cameras; its p1 and p2 are ours exchanged, its b1 and b2 are px."""
    xyz = points()
    x, y = (xyz[:, :2] / xyz[:, 2:]).T
    r = np.hypot(x, y)
    p1, p2, b1, b2 = P2, P1, 0.01 * F, -0.02 * F
    radial = 1 + K1 * r**2 + K2 * r**4 + K3 * r**6 + K4 * r**8
    xd = x * radial + (p1 * (r**2 + 2 * x**2) + 2 * p2 * x * y)
    yd = y * radial + (p2 * (r**2 + 2 * y**2) + 2 * p1 * x * y)
    u = CX + xd * F + xd * b1 + yd * b2
    v = CY + yd * F
    assert_allclose(project(BY_NAME["FRAME"], params_of("FRAME"), xyz), np.column_stack([u, v]), rtol=1e-12)


def test_dual_is_opensfm_s_formula():
    xyz = points()
    r = np.hypot(xyz[:, 0], xyz[:, 1])
    perspective, fisheye = xyz[:, :2] / xyz[:, 2:], xyz[:, :2] * (np.arctan2(r, xyz[:, 2]) / r)[:, None]
    mixed = 0.6 * perspective + (1.0 - 0.6) * fisheye
    r2 = (mixed**2).sum(axis=1, keepdims=True)
    wanted = F * mixed * (1.0 + r2 * (K1 + K2 * r2)) + (CX, CY)
    assert_allclose(project(BY_NAME["DUAL"], params_of("DUAL"), xyz), wanted, rtol=1e-12)


@pytest.mark.parametrize("k", [-0.14, -1e-9, 0.3, 4.0])
def test_inverse_radial_undoes_visualsfm_s_polynomial(k):
    xyz = points()
    measured = (project(BY_NAME["INVERSE_RADIAL"], np.array([F, CX, CY, k]), xyz) - (CX, CY)) / F
    undistorted = measured * (1.0 + k * (measured**2).sum(axis=1, keepdims=True))
    assert_allclose(undistorted, xyz[:, :2] / xyz[:, 2:], rtol=1e-12, atol=1e-14)


def test_inverse_radial_ends_where_its_polynomial_turns_back():
    """u = d (1 - d^2 / 3) is largest at d = 1, u = 2 / 3."""
    model, params = BY_NAME["INVERSE_RADIAL"], np.array([1.0, 0.0, 0.0, -1.0 / 3.0])
    xy = project(model, params, np.array([[0.6666, 0.0, 1.0], [0.6667, 0.0, 1.0], [5.0, 0.0, 1.0]]))
    assert 0.98 < xy[0, 0] < 1.0
    assert np.isnan(xy[1:]).all()
    rays = unproject(model, params, np.array([[0.98, 0.0], [1.2, 0.0]]))
    assert_allclose(rays[0, 0] / rays[0, 2], 0.98 * (1 - 0.98**2 / 3), rtol=1e-9)


@pytest.mark.parametrize("name", NAMES)
def test_rays_project_back_and_are_the_points(name):
    model, xyz = BY_NAME[name], points()
    params = params_of(name)
    xy = project(model, params, xyz)
    assert np.isfinite(xy).all()
    rays = unproject(model, params, xy)
    assert_allclose(rays, xyz / np.linalg.norm(xyz, axis=1, keepdims=True), atol=1e-9)
    assert_array_equal(unproject(model, params, np.array([[np.nan, 0.0]])), np.full((1, 3), np.nan))


@pytest.mark.parametrize("name", NAMES)
def test_advice_names_only_models_that_colmap_has(name):
    for larger in larger_models(BY_NAME[name]):
        assert larger in COLMAP_MODELS
        params = extended_params(BY_NAME[name], params_of(name, b1=0.0, b2=0.0), larger)
        if params is not None and name != "FRAME":
            xyz = points()
            assert_allclose(project(larger, params, xyz), project(BY_NAME[name], params_of(name), xyz), rtol=1e-12)


def test_colmap_s_files_do_not_know_other_programs_lenses():
    for model in COLMAP_MODELS:
        assert set(larger_models(model)) <= set(COLMAP_MODELS)
        assert model.is_colmap
