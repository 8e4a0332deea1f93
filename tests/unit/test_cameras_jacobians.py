"""Derivatives of the projection: against finite differences, at the limits of small arguments, and their shape."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from sfm_audit.audit.cameras import project, project_with_jacobians, unproject
from sfm_audit.audit.cameras.fisheye import angle_curvature, angle_gain
from sfm_audit.loaders.camera_models import BY_NAME, CAMERA_MODELS, CameraModel

NAMES = [model.name for model in CAMERA_MODELS]
PLAIN = {"f": 900.0, "fx": 900.0, "fy": 950.0, "cx": 800.0, "cy": 600.0, "w": 1600.0, "h": 800.0}
RADIAL = {"k": -0.11, "k0": 0.08, "k1": -0.09, "k2": 0.03, "k3": -0.02, "k4": 0.014, "k5": 0.01, "k6": -0.006}
TANGENTIAL = {"p0": -0.006, "p1": 0.008, "p2": -0.005}
THIN_PRISM = {"s0": 0.006, "s1": -0.008, "s2": 0.004, "s3": 0.009, "sx1": 0.007, "sy1": -0.009}
DISTORTED = (
    PLAIN
    | RADIAL
    | TANGENTIAL
    | THIN_PRISM
    | {"omega": 0.8, "alpha": 0.6, "beta": 1.2, "transition": 0.6, "b1": 0.01, "b2": -0.02}
)
STENCIL = ((1.0, 8.0 / 12.0), (-1.0, -8.0 / 12.0), (2.0, -1.0 / 12.0), (-2.0, 1.0 / 12.0))  # error h^4


def params_of(model: CameraModel, values: dict[str, float]) -> np.ndarray:
    return np.array([values.get(name, 0.0) for name in model.param_names])


def points(seed: int = 0, count: int = 200) -> np.ndarray:
    rng = np.random.default_rng(seed)
    xyz = rng.uniform([-0.9, -0.7, 1.0], [0.9, 0.7, 1.0], (count, 3))
    return xyz * rng.uniform(0.5, 4.0, (count, 1))


def numerical(function, start: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """d function / d start, (n, 2, len(steps)), by central differences of fourth order along the last axis."""
    columns = []
    for axis, step in enumerate(steps):
        unit = np.eye(len(steps))[axis] * step
        columns.append(sum(weight * function(start + shift * unit) for shift, weight in STENCIL) / step)
    return np.stack(columns, axis=-1)


def assert_same_derivative(ours: np.ndarray, wanted: np.ndarray, rel: float = 1e-6) -> None:
    assert np.isfinite(ours).all()
    assert_allclose(ours, wanted, rtol=rel, atol=rel * np.abs(wanted).max())


@pytest.mark.parametrize("name", NAMES)
def test_derivatives_by_the_point_are_finite_differences(name):
    model, xyz = BY_NAME[name], points()
    params = params_of(model, DISTORTED)
    ours = project_with_jacobians(model, params, xyz, with_params=False)
    assert ours.d_xy_d_params is None
    assert_same_derivative(ours.d_xy_d_cam, numerical(lambda at: project(model, params, at), xyz, np.full(3, 1e-3)))


@pytest.mark.parametrize("name", NAMES)
def test_derivatives_by_the_parameters_are_finite_differences(name):
    model, xyz = BY_NAME[name], points()
    params = params_of(model, DISTORTED)
    ours = project_with_jacobians(model, params, xyz).d_xy_d_params
    steps = np.where([parameter in PLAIN for parameter in model.param_names], 1.0, 1e-3)
    wanted = numerical(lambda at: project(model, at, xyz), params, steps)
    for idx in range(model.num_params):
        assert_same_derivative(ours[..., idx], wanted[..., idx])


@pytest.mark.parametrize("k", [-0.4, -0.05, 0.05, 0.2])
def test_division_derivatives_with_either_sign(k):
    model, xyz = BY_NAME["DIVISION"], points()
    params = np.array([900.0, 950.0, 800.0, 600.0, k])
    ours = project_with_jacobians(model, params, xyz)
    assert_same_derivative(ours.d_xy_d_cam, numerical(lambda at: project(model, params, at), xyz, np.full(3, 1e-4)))
    wanted = numerical(lambda at: project(model, at, xyz), params, np.array([1.0, 1.0, 1.0, 1.0, 1e-4]))
    assert_same_derivative(ours.d_xy_d_params, wanted)


def test_panorama_derivatives_all_around():
    model, xyz = BY_NAME["EQUIRECTANGULAR"], np.random.default_rng(3).normal(size=(300, 3))
    params = np.array([1600.0, 800.0])
    xyz = xyz[np.hypot(xyz[:, 0], xyz[:, 2]) > 0.2]
    xyz = xyz[(np.abs(xyz[:, 0]) > 0.01) | (xyz[:, 2] > 0)]  # a step must not cross the seam
    ours = project_with_jacobians(model, params, xyz).d_xy_d_cam
    assert_same_derivative(ours, numerical(lambda at: project(model, params, at), xyz, np.full(3, 1e-4)))


def test_panorama_has_no_derivative_at_its_poles():
    xyz = np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]])
    ours = project_with_jacobians(BY_NAME["EQUIRECTANGULAR"], np.array([1600.0, 800.0]), xyz)
    assert_array_equal(ours.xy_px, [[800.0, 800.0], [800.0, 0.0]])
    assert np.isnan(ours.d_xy_d_cam).all()


@pytest.mark.parametrize("omega", [-0.8, 0.005, 0.02, 0.8])
@pytest.mark.parametrize("radius", [0.002, 0.008, 0.012, 0.8])
def test_fov_derivatives_in_each_of_its_branches(omega, radius):
    model, params = BY_NAME["FOV"], np.array([900.0, 950.0, 800.0, 600.0, omega])
    angle = np.linspace(0.1, 6.0, 20)
    xyz = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.ones_like(angle)])
    ours = project_with_jacobians(model, params, xyz)
    by_point = numerical(lambda at: project(model, params, at), xyz, np.full(3, 5e-4))
    assert_same_derivative(ours.d_xy_d_cam, by_point)
    by_omega = numerical(lambda at: project(model, at, xyz), params, np.array([1.0, 1.0, 1.0, 1.0, 1e-3]))
    assert_same_derivative(ours.d_xy_d_params[..., 4], by_omega[..., 4])


@pytest.mark.parametrize("name", NAMES)
def test_the_optical_axis_is_an_ordinary_point(name):
    model = BY_NAME[name]
    params = params_of(model, DISTORTED)
    axis = np.array([[0.0, 0.0, 2.0]])
    ours = project_with_jacobians(model, params, axis)
    assert np.isfinite(ours.d_xy_d_params).all()
    assert_same_derivative(ours.d_xy_d_cam, numerical(lambda at: project(model, params, at), axis, np.full(3, 1e-4)))
    for distance in (1e-160, 1e-20, 1e-9):
        near = project_with_jacobians(model, params, axis + np.array([distance, -distance, 0.0]))
        assert_allclose(near.xy_px, ours.xy_px, atol=1e-5)
        assert_allclose(near.d_xy_d_cam, ours.d_xy_d_cam, rtol=1e-6, atol=1e-5)
        assert_allclose(near.d_xy_d_params, ours.d_xy_d_params, atol=1e-6)
    if not model.is_spherical:
        assert_allclose(ours.xy_px, [[800.0, 600.0]], atol=1e-12)
    assert_allclose(unproject(model, params, ours.xy_px), [[0.0, 0.0, 1.0]], atol=1e-14)


@pytest.mark.parametrize("name", [name for name in NAMES if BY_NAME[name].extra_idxs])
def test_without_distortion_every_model_is_its_plain_one(name):
    model = BY_NAME[name]
    plain = BY_NAME["FISHEYE" if name.endswith("FISHEYE") else "PINHOLE"]
    xyz = np.concatenate([points(), [[0.0, 0.0, 1.0]]])
    params = params_of(model, PLAIN | {"beta": 1.0, "transition": 1.0})
    reference_params = params_of(plain, PLAIN | ({} if "fy" in model.param_names else {"fy": PLAIN["f"]}))
    ours = project_with_jacobians(model, params, xyz)
    reference = project_with_jacobians(plain, reference_params, xyz)
    assert_allclose(ours.xy_px, reference.xy_px, rtol=1e-14)
    assert_allclose(ours.d_xy_d_cam, reference.d_xy_d_cam, rtol=1e-13, atol=1e-10)
    assert np.isfinite(ours.d_xy_d_params).all()
    for idx in model.extra_idxs:
        if model.param_names[idx] == "beta":
            assert_array_equal(ours.d_xy_d_params[..., idx], 0.0)  # alpha = 0: no effect
        elif model.param_names[idx] == "omega":
            assert_array_equal(ours.d_xy_d_params[..., idx], 0.0)  # even in omega
        else:
            assert np.abs(ours.d_xy_d_params[..., idx]).max() > 1.0


@pytest.mark.parametrize("name", NAMES)
def test_which_parameter_moves_which_coordinate(name):
    model, xyz = BY_NAME[name], points()
    ours = project_with_jacobians(model, params_of(model, DISTORTED), xyz)
    d_params = ours.d_xy_d_params
    assert d_params.shape == (len(xyz), 2, model.num_params)
    assert ours.d_xy_d_cam.flags.c_contiguous
    assert d_params.flags.c_contiguous
    still = {"fx": 1, "fy": 0, "cx": 1, "cy": 0, "w": 1, "h": 0, "sx1": 1, "sy1": 0, "s0": 1, "s1": 1, "s2": 0, "s3": 0}
    for idx, parameter in enumerate(model.param_names):
        if parameter in still:
            assert_array_equal(d_params[:, still[parameter], idx], 0.0)
            assert np.abs(d_params[:, 1 - still[parameter], idx]).min() > 0.0
        if parameter in {"cx", "cy"}:
            assert_array_equal(d_params[:, 1 - still[parameter], idx], 1.0)
    for row, idx in enumerate(model.focal_idxs * (2 // max(1, len(model.focal_idxs)))):
        centre = PLAIN["cx" if row == 0 else "cy"]
        assert_allclose(d_params[:, row, idx], (ours.xy_px[:, row] - centre) / PLAIN["fy" if idx else "f"], rtol=1e-11)


def test_curvature_of_the_angle_is_accurate_across_its_threshold():
    tan2 = np.array([0.0, 1e-12, 1e-6, 9.99e-4, 1.001e-3, 1e-2, 0.3])
    t = tan2.astype(np.longdouble)
    order = np.arange(1, 200)
    series = ((-1.0) ** order * 2 * order / (2 * order + 1) * t[:, None] ** (order - 1)).sum(axis=1)
    assert_allclose(angle_curvature(tan2, angle_gain(tan2)), series.astype(float), rtol=2e-12)
