"""Parameter covariance against refits to simulated noise, and against SciPy's own (method.md section 6)."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from sfm_audit.audit.camera_quality.identifiability import fitted_names, identifiability, parameter_covariance
from sfm_audit.audit.cameras import project
from sfm_audit.audit.inliers.projected import project_image
from sfm_audit.audit.misfit.nuisance import nuisance_columns
from sfm_audit.loaders.camera_models import BY_NAME, CAMERA_MODELS
from sfm_audit.loaders.model import CameraRecord

CAMERAS = {
    "SIMPLE_RADIAL": (1000.0, 800.0, 600.0, -0.05),
    "OPENCV": (1000.0, 1010.0, 800.0, 600.0, -0.05, 0.02, 1e-3, -5e-4),
    "PINHOLE": (900.0, 950.0, 800.0, 600.0),
    "OPENCV_FISHEYE": (700.0, 710.0, 800.0, 600.0, 0.03, -0.01, 2e-3, -1e-4),
    "EUCM": (700.0, 710.0, 800.0, 600.0, 0.55, 1.1),
}


def camera_of(name, params=None, width=1600, height=1200):
    return CameraRecord(1, BY_NAME[name], width, height, np.array(CAMERAS[name] if params is None else params))


def points(rng, n, spread=0.6):
    depth = rng.uniform(4.0, 10.0, n)
    return np.column_stack([rng.uniform(-spread, spread, (n, 2)) * depth[:, None], depth])


def columns_of(camera, xyz_cam):
    return nuisance_columns(camera.model, project_image(camera, xyz_cam))


def moved(camera, xyz_cam, theta):
    """Projections (2n,) after a change theta of pose and intrinsics, points fixed."""
    names = fitted_names(camera.model)
    params = camera.params.copy()
    for value, name in zip(theta[6:], names[6:], strict=True):
        params[camera.model.param_names.index(name)] += value
    xyz = Rotation.from_rotvec(theta[:3]).apply(xyz_cam) + theta[3:6]
    return project(camera.model, params, xyz).ravel()


def refit(camera, xyz_cam, observed, columns):
    """Gauss-Newton from the truth with the Jacobian taken there: three steps reach the optimum."""
    jacobian = columns.transpose(2, 1, 0).reshape(observed.size, -1)
    step = np.linalg.pinv(jacobian)
    theta = np.zeros(jacobian.shape[1])
    for _ in range(4):
        theta = theta + step @ (observed - moved(camera, xyz_cam, theta))
    return theta


@pytest.mark.parametrize("name", CAMERAS)
def test_standard_deviations_are_those_of_refits(name):
    rng = np.random.default_rng(3)
    camera, sigma = camera_of(name), 0.5
    xyz_cam = points(rng, 150)
    columns = columns_of(camera, xyz_cam)
    truth = project(camera.model, camera.params, xyz_cam).ravel()
    fits = np.array([refit(camera, xyz_cam, truth + rng.normal(0, sigma, truth.size), columns) for _ in range(1000)])
    found = parameter_covariance(columns, fitted_names(camera.model), sigma)
    assert_allclose(found.sd / fits.std(axis=0), 1.0, atol=0.1)
    assert_allclose(found.correlation, np.corrcoef(fits.T), atol=0.12)
    summary = identifiability(camera, columns, sigma)
    first_focal = fits[:, fitted_names(camera.model).index(camera.model.param_names[0])]
    assert summary.sd_focal_px == pytest.approx(first_focal.std(), rel=0.1)


def test_equals_scipy_s_covariance():
    rng = np.random.default_rng(0)
    camera = camera_of("SIMPLE_RADIAL")
    xyz_cam = points(rng, 60)
    observed = project(camera.model, camera.params, xyz_cam).ravel() + rng.normal(0, 1e-4, 120)
    start = np.zeros(8)
    fit = least_squares(
        lambda theta: (moved(camera, xyz_cam, theta) - observed) / 0.7, start, jac="3-point", x_scale="jac"
    )
    theirs = np.linalg.inv(fit.jac.T @ fit.jac)
    found = parameter_covariance(columns_of(camera, xyz_cam), fitted_names(camera.model), 0.7)
    assert_allclose(found.sd, np.sqrt(theirs.diagonal()), rtol=1e-3)


@given(sigma=st.floats(0.01, 10.0), unit=st.sampled_from([1e-6, 0.25, 8.0, 1e6]), seed=st.integers(0, 99))
def test_scales_with_the_noise_and_ignores_the_unit_of_the_world(sigma, unit, seed):
    camera = camera_of("OPENCV")
    xyz_cam = points(np.random.default_rng(seed), 40)
    reference = identifiability(camera, columns_of(camera, xyz_cam), 1.0)
    found = identifiability(camera, columns_of(camera, unit * xyz_cam), sigma)
    assert_allclose(found.sd_focal_px, sigma * reference.sd_focal_px, rtol=1e-6)
    assert_allclose(found.sd_focal_rel, sigma * reference.sd_focal_rel, rtol=1e-6)
    assert_allclose(found.sd_k1, sigma * reference.sd_k1, rtol=1e-6)


@given(seed=st.integers(0, 99))
def test_more_observations_never_say_less(seed):
    camera = camera_of("SIMPLE_RADIAL")
    columns = columns_of(camera, points(np.random.default_rng(seed), 60))
    names = fitted_names(camera.model)
    few, many = (parameter_covariance(columns[..., :n], names, 1.0).sd for n in (20, 60))
    assert (many <= few * (1 + 1e-9)).all()


def test_both_paths_agree_where_the_columns_are_nearly_dependent():
    # A small planar patch seen frontally: f and depth act almost alike, the smallest pivot is far below 1e-10.
    rng = np.random.default_rng(1)
    camera = camera_of("SIMPLE_RADIAL")
    xyz_cam = np.column_stack([rng.uniform(-0.02, 0.02, (50, 2)), 6.0 + 1e-5 * rng.normal(size=50)])
    columns = columns_of(camera, xyz_cam)
    found = parameter_covariance(columns, fitted_names(camera.model), 0.5)
    assert 1e-9 < found.singular_share < 1e-5
    flat = columns.reshape(len(columns), -1)
    norms = np.linalg.norm(flat, axis=1)
    inverse = np.linalg.pinv((flat / norms[:, None]).T, rcond=1e-12)
    assert_allclose(found.sd, 0.5 * np.linalg.norm(inverse, axis=1) / norms, rtol=1e-4)


def test_a_frontal_plane_identifies_no_focal_length():
    rng = np.random.default_rng(2)
    camera = camera_of("SIMPLE_RADIAL", (1000.0, 800.0, 600.0, 0.0))
    xyz_cam = np.column_stack([rng.uniform(-3, 3, (50, 2)), np.full(50, 6.0)])
    found = identifiability(camera, columns_of(camera, xyz_cam), 0.5)
    assert found.parameters.is_singular
    assert np.isnan([found.sd_focal_px, found.sd_focal_rel, found.sd_k1]).all()
    assert found.k1_identified() is False


def test_the_worse_of_two_focal_lengths_counts():
    rng = np.random.default_rng(2)
    camera = camera_of("PINHOLE")
    xyz_cam = points(rng, 100) * [0.2, 1.0, 1.0]  # a narrow strip: fx is known far worse than fy
    found = identifiability(camera, columns_of(camera, xyz_cam), 0.5)
    sds = found.parameters.sd_of("fx") / 900.0, found.parameters.sd_of("fy") / 950.0
    assert sds[0] > 1.2 * sds[1]
    assert found.sd_focal_rel == pytest.approx(sds[0])
    assert found.sd_focal_px == pytest.approx(900.0 * sds[0])
    turned = identifiability(camera, columns_of(camera, points(rng, 100) * [1.0, 0.2, 1.0]), 0.5)
    assert turned.sd_focal_rel == pytest.approx(turned.parameters.sd_of("fy") / 950.0)


def test_fewer_equations_than_parameters_identify_nothing():
    camera = camera_of("SIMPLE_RADIAL")
    found = identifiability(camera, columns_of(camera, points(np.random.default_rng(0), 3)), 0.5)
    assert found.parameters.is_singular
    assert np.isnan(found.sd_focal_px)


def test_parameters_without_effect_are_dropped():
    rng = np.random.default_rng(0)
    names = (*"abc",)
    columns = np.stack([rng.normal(size=20), np.zeros(20), rng.normal(size=20)])
    found = parameter_covariance(columns, names, 2.0)
    assert found.names == ("a", "c")
    assert np.isnan(found.sd_of("b"))
    expected = 4.0 * np.linalg.inv(columns[::2] @ columns[::2].T)
    assert_allclose(found.covariance, expected, rtol=1e-10)
    with pytest.raises(ValueError, match="3 columns but 2 names"):
        parameter_covariance(columns, names[:2], 1.0)


def test_k1_is_identified_at_two_standard_deviations():
    rng = np.random.default_rng(5)
    xyz_cam = points(rng, 100)
    sd = identifiability(camera_of("SIMPLE_RADIAL"), columns_of(camera_of("SIMPLE_RADIAL"), xyz_cam), 0.5).sd_k1
    verdicts = []
    for sds in (1.8, 2.2, -1.8, -2.2):
        camera = camera_of("SIMPLE_RADIAL", (1000.0, 800.0, 600.0, sds * sd))
        verdicts.append(identifiability(camera, columns_of(camera, xyz_cam), 0.5).k1_identified())
    assert verdicts == [False, True, False, True]
    pinhole = camera_of("PINHOLE")
    assert identifiability(pinhole, columns_of(pinhole, xyz_cam), 0.5).k1_identified() is None


@pytest.mark.parametrize("model", CAMERA_MODELS, ids=lambda model: model.name)
def test_names_fit_the_columns_of_every_model(model):
    size = [1600.0, 1200.0] if model.is_spherical else []
    known = {"f": 900.0, "fx": 900.0, "fy": 905.0, "cx": 800.0, "cy": 600.0, "omega": 0.9, "alpha": 0.6, "beta": 1.1}
    known |= {"k4": 0.3, "k5": -0.2, "k6": 0.1}  # a ratio of equal polynomials would be singular
    params = np.array(size or [known.get(name, 1e-3) for name in model.param_names])
    camera = CameraRecord(1, model, 1600, 1200, params)
    xyz_cam = points(np.random.default_rng(0), 80)
    found = identifiability(camera, columns_of(camera, xyz_cam), 0.5)
    assert found.has_focal is not model.is_spherical
    assert np.isfinite(found.sd_focal_px) == found.has_focal
    assert np.isfinite(found.sd_k1) == bool(model.extra_idxs)
    assert (found.parameters.sd > 0).all()


def test_unknown_noise_and_no_points_say_nothing():
    camera = camera_of("OPENCV")
    xyz_cam = points(np.random.default_rng(0), 30)
    assert np.isnan(identifiability(camera, columns_of(camera, xyz_cam), np.nan).sd_focal_rel)
    nothing = identifiability(camera, columns_of(camera, xyz_cam[:0]), 0.5)
    assert np.isnan(nothing.sd_focal_rel)
    xyz_cam[0] = np.nan
    assert np.isnan(identifiability(camera, columns_of(camera, xyz_cam), 0.5).parameters.singular_share)
