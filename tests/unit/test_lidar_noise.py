"""Lidar noise: simulated scans whose sigma_d and sigma_l are known, SciPy's optimum of the likelihood, boundaries."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy import optimize, stats
from scipy.spatial.transform import Rotation

from sfm_audit.audit.calibrate.camera import CalibratedCamera, Distortion
from sfm_audit.audit.calibrate.estimate import Estimate, estimate_of
from sfm_audit.audit.calibrate.lidar import lidar_noise, lidar_predictors
from sfm_audit.audit.noise.fits import fit_variance
from sfm_audit.audit.noise.variants import fit_variance_likelihood, fit_variance_literal, literal_start
from sfm_audit.loaders.correspondences.records import Correspondences
from sfm_audit.loaders.correspondences.scan_ptx import read_ptx
from sfm_audit.loaders.correspondences.table import read_correspondences

PAN_STEP, TILT_STEP = 2e-3, 1e-3  # rad
CAMERA = CalibratedCamera(
    1600, 1200, Distortion.FORWARD, (800.0, 800.0), (800.0, 600.0), np.array([-0.07, 0.01, 0.0]), ("f", "k1", "k2")
)
TURN = Rotation.from_euler("xyz", [0.02, -0.05, 0.01]).as_matrix()


def on_sphere(pan, tilt, radius):
    """A scanner at the origin: x right, y down, z ahead, as a camera."""
    return radius[:, None] * np.column_stack(
        [np.cos(tilt) * np.sin(pan), np.sin(tilt), np.cos(tilt) * np.cos(pan)],
    )


def scanned(rng, num, sigma_d_px, sigma_l, *, offset=(0.3, 0.2, 0.0), camera=CAMERA):
    """Points that a scanner beside the camera measured with noise sigma_l steps, and a detector with sigma_d_px."""
    pan, tilt = rng.uniform(-0.6, 0.6, num), rng.uniform(-0.4, 0.4, num)
    radius = np.exp(rng.uniform(math.log(0.8), math.log(20.0), num))
    translation = np.array(offset)
    true_xy = camera.project(on_sphere(pan, tilt, radius) @ TURN.T + translation).xy_px.T
    pan = pan + sigma_l * PAN_STEP * rng.standard_normal(num)
    tilt = tilt + sigma_l * TILT_STEP * rng.standard_normal(num)
    measured = Correspondences(
        camera.width,
        camera.height,
        true_xy + sigma_d_px * rng.standard_normal((num, 2)),
        on_sphere(pan, tilt, radius),
        on_sphere(pan + PAN_STEP, tilt, radius),
        on_sphere(pan, tilt + TILT_STEP, radius),
    )
    return estimate_of("truth", camera, TURN, translation, measured, inliers=np.ones(num, dtype=bool)), measured


def standard_errors(a_sq, theta):
    """Of the maximum likelihood estimate of theta: the inverse of the Fisher information of y ~ s chi^2(1)."""
    s = theta[0] + theta[1] * a_sq
    design = np.column_stack([np.ones_like(a_sq), a_sq])
    return np.sqrt(np.diag(np.linalg.inv(design.T @ (design / (2.0 * s**2)[:, None]))))


@pytest.mark.parametrize("robust", [True, False])
@pytest.mark.parametrize(("sigma_d", "sigma_l"), [(0.3, 0.4), (0.05, 0.8), (0.5, 0.1)])
def test_the_truth_is_recovered_as_closely_as_theory_allows(robust, sigma_d, sigma_l):
    estimate, measured = scanned(np.random.default_rng(5), 6000, sigma_d, sigma_l)
    noise = lidar_noise(estimate, measured, robust=robust)
    truth = np.array([sigma_d, sigma_l]) ** 2
    error = standard_errors(lidar_predictors(estimate, measured).ravel() ** 2, truth)
    found = np.array([noise.sigma_d_px, noise.sigma_l]) ** 2
    assert noise.converged
    assert np.all(np.abs(found - truth) < (4.5 if robust else 4.0) * error + 0.005 * truth)  # robust: a little less
    assert stats.kstest(noise.z.ravel(), "norm").pvalue > 0.001
    predicted = np.sqrt(truth[0] + truth[1] * lidar_predictors(estimate, measured) ** 2)
    assert noise.sigma_predicted_px == pytest.approx(np.median(predicted), rel=0.05)


def test_ks_of_z_has_the_size_of_a_test_that_follows_a_fit():
    """At a nominal 20 %: fitting two numbers makes plain KS conservative, never liberal (method.md section 4)."""
    rng = np.random.default_rng(11)
    p = []
    for _ in range(150):
        estimate, measured = scanned(rng, 150, 0.2, 0.3)
        p.append(stats.kstest(lidar_noise(estimate, measured).z.ravel(), "norm").pvalue)
    share = np.mean(np.array(p) < 0.2)
    assert 0.0 < share < 0.2


def test_residuals_depend_on_the_pan_step_in_x_and_the_tilt_step_in_y():
    """SciPy's rotation of the camera's rays by one step each is the outside number."""
    estimate, measured = scanned(np.random.default_rng(2), 50, 0.0, 0.0, offset=(0.0, 0.0, 0.0))
    a = lidar_predictors(estimate, measured)
    pan, tilt = measured.pan_xyz_world @ TURN.T, measured.tilt_xyz_world @ TURN.T
    here = measured.xyz_world @ TURN.T
    for axis, there in enumerate((pan, tilt)):
        moved = CAMERA.project(there).xy_px.T - CAMERA.project(here).xy_px.T
        assert_allclose(a[:, axis], np.hypot(*moved.T), rtol=1e-12)
        assert np.abs(moved[:, axis]).mean() > 5.0 * np.abs(moved[:, 1 - axis]).mean()
    assert a[:, 0].mean() == pytest.approx(800.0 * PAN_STEP, rel=0.25)
    assert a[:, 1].mean() == pytest.approx(800.0 * TILT_STEP, rel=0.25)


@pytest.mark.parametrize("robust", [True, False])
def test_a_scanner_without_noise_is_a_boundary(robust):
    zeros = []
    for seed in range(12):
        estimate, measured = scanned(np.random.default_rng(seed), 400, 0.3, 0.0)
        noise = lidar_noise(estimate, measured, robust=robust)
        zeros.append(noise.sigma_l == 0.0)
        assert noise.converged
        assert noise.sigma_d_px == pytest.approx(0.3, rel=0.15)
    assert 1 <= sum(zeros) <= 11  # half of all, in theory


def test_a_detector_without_noise_is_a_boundary():
    estimate, measured = scanned(np.random.default_rng(1), 3000, 0.0, 0.5)
    for robust in (True, False):
        noise = lidar_noise(estimate, measured, robust=robust)
        assert noise.sigma_l == pytest.approx(0.5, rel=0.05)
        assert noise.sigma_d_px < 0.15 * noise.sigma_predicted_px  # a pan step also moves y a little, off the axes


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_the_plain_fit_is_scipy_s_optimum_of_the_likelihood(seed):
    rng = np.random.default_rng(seed)
    a_sq = rng.gamma(0.7, 2.0, 80)
    y = rng.standard_normal(80) ** 2 * (rng.choice([0.0, 0.3]) + rng.choice([0.0, 0.05, 0.5]) * a_sq) + 1e-12

    def cost(theta):
        s = theta[0] + theta[1] * a_sq
        return 0.5 * float(np.sum(np.log(s) + y / s))

    fit = fit_variance_likelihood(y, a_sq)
    starts = [(y.mean(), 1e-9), (1e-9, (y / a_sq).mean()), (0.5 * y.mean(), 0.1)]
    bounds = [(1e-14, None), (0.0, None)]
    best = min(optimize.minimize(cost, x, method="Nelder-Mead", bounds=bounds).fun for x in starts)
    assert cost((fit.detector_px2, fit.structure)) <= best + 1e-6
    assert min(fit.detector_px2, fit.structure) >= 0.0


@given(seed=st.integers(0, 500), gain=st.sampled_from([1e-3, 0.5, 100.0]))
def test_fits_follow_the_unit_and_not_the_order(seed, gain):
    rng = np.random.default_rng(seed)
    a_sq = rng.gamma(1.0, 1.0, 60)
    y = rng.standard_normal(60) ** 2 * (0.2 + 0.4 * a_sq)
    one, order = fit_variance_likelihood(y, a_sq), rng.permutation(60)
    other = fit_variance_likelihood(y[order] * gain**2, a_sq[order] * gain**2)
    assert_allclose(other.detector_px2, one.detector_px2 * gain**2, rtol=1e-5, atol=1e-6 * gain**2)
    assert_allclose(other.structure, one.structure, rtol=1e-5, atol=1e-6)


def test_only_the_robust_scale_keeps_wild_points_visible():
    """The paper's claim 8, on 3 % of residuals that no camera explains."""
    estimate, measured = scanned(np.random.default_rng(3), 1000, 0.2, 0.3)
    residuals = estimate.residuals_px.copy()
    residuals[:30] += 4.0
    wild = Estimate(**{name: getattr(estimate, name) for name in Estimate.__slots__} | {"residuals_px": residuals})
    robust, plain = (lidar_noise(wild, measured, robust=robust) for robust in (True, False))
    assert np.abs(robust.z[30:]).std() == pytest.approx(np.abs(lidar_noise(estimate, measured).z[30:]).std(), rel=0.1)
    assert np.abs(robust.z[:30]).mean() > 1.5 * np.abs(plain.z[:30]).mean()
    assert robust.sigma_constant_px == plain.sigma_constant_px


def test_the_literal_start_is_weighted_least_squares_and_leads_to_the_same_fit():
    rng = np.random.default_rng(0)
    a_sq = rng.gamma(1.0, 4.0, 300)
    eps = rng.standard_normal(300) * np.sqrt(0.5 + 0.2 * a_sq)
    root = np.sqrt(1.0 / stats.norm.pdf(eps, scale=5.0))
    free, *_ = np.linalg.lstsq(root[:, None] * np.column_stack([np.ones(300), a_sq]), root * eps**2, rcond=None)
    assert_allclose(literal_start(eps**2, a_sq), free, rtol=1e-9)
    literal, robust = fit_variance_literal(eps**2, a_sq), fit_variance(eps**2, a_sq)
    assert_allclose([literal.detector_px2, literal.structure], [robust.detector_px2, robust.structure], rtol=1e-5)
    far = np.append(eps, 400.0)  # 1 / p beyond float64
    assert np.isfinite(literal_start(far**2, np.append(a_sq, 1.0))).all()
    assert fit_variance_literal(far**2, np.append(a_sq, 1.0)).detector_px2 == pytest.approx(0.5, rel=0.5)


@pytest.mark.parametrize("fit", [fit_variance_likelihood, fit_variance_literal])
def test_variants_are_undetermined_where_there_is_nothing_and_constant_where_a_is_zero(fit):
    for y in (np.zeros(5), np.empty(0), np.array([1.0, np.nan])):
        assert math.isnan(fit(y, np.ones(len(y))).structure)
    y = np.random.default_rng(0).standard_normal(2000) ** 2
    assert fit(y, np.zeros(2000)).structure == 0.0
    assert fit(y, np.zeros(2000)).detector_px2 == pytest.approx(1.0, rel=0.1)


def test_a_neighbour_behind_the_camera_is_left_out_of_the_fit():
    estimate, measured = scanned(np.random.default_rng(4), 300, 0.3, 0.2)
    pan = measured.pan_xyz_world.copy()
    pan[7] *= -1.0
    cut = Correspondences(1600, 1200, measured.xy_px, measured.xyz_world, pan, measured.tilt_xyz_world)
    noise = lidar_noise(estimate, cut)
    assert np.flatnonzero(np.isnan(noise.z).any(axis=1)).tolist() == [7]
    assert math.isfinite(noise.sigma_predicted_px)
    with pytest.raises(ValueError, match="no neighbours"):
        lidar_noise(estimate, Correspondences(1600, 1200, measured.xy_px, measured.xyz_world))


def test_only_inliers_count():
    estimate, measured = scanned(np.random.default_rng(4), 300, 0.3, 0.2)
    kept = np.arange(300) % 3 > 0
    part = estimate_of("truth", CAMERA, TURN, estimate.translation_cam_from_world, measured, inliers=kept)
    assert lidar_noise(part, measured).z.shape == (200, 2)
    some = [values[kept] for values in (measured.xy_px, measured.xyz_world)]
    some += [values[kept] for values in (measured.pan_xyz_world, measured.tilt_xyz_world)]
    alone, less = Correspondences(1600, 1200, *some), np.ones(200, dtype=bool)
    same = estimate_of("truth", CAMERA, TURN, estimate.translation_cam_from_world, alone, inliers=less)
    assert_allclose(lidar_noise(part, measured).z, lidar_noise(same, alone).z)


def test_exact_points_are_undetermined():
    estimate, measured = scanned(np.random.default_rng(4), 50, 0.3, 0.2)
    names = {name: getattr(estimate, name) for name in Estimate.__slots__}
    exact = Estimate(**names | {"residuals_px": np.zeros((50, 2))})
    for robust in (True, False):
        noise = lidar_noise(exact, measured, robust=robust)
        assert not noise.converged
        assert math.isnan(noise.sigma_l)
        assert np.isnan(noise.z).all()


def test_from_a_scan_in_ptx_and_a_table_to_sigma_l(tmp_path):
    """Neighbours of a scan are as noisy as its points, which pulls sigma_l towards 0 (to 0.11 for a true 0.15)."""
    rng = np.random.default_rng(8)
    columns, rows, sigma_d, sigma_l = 120, 100, 0.1, 0.05
    pan, tilt = np.meshgrid(4.0 * PAN_STEP * (np.arange(columns) - 60), 4.0 * TILT_STEP * (np.arange(rows) - 50))
    radius = 4.0 + 3.0 * np.sin(6.0 * pan)
    true_xyz = on_sphere(pan.ravel(), tilt.ravel(), radius.ravel())
    noisy_pan = pan + 4.0 * PAN_STEP * sigma_l * rng.standard_normal(pan.shape)
    noisy_tilt = tilt + 4.0 * TILT_STEP * sigma_l * rng.standard_normal(pan.shape)
    xyz = on_sphere(noisy_pan.ravel(), noisy_tilt.ravel(), radius.ravel()).reshape(rows, columns, 3)
    header = f"{columns}\n{rows}\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"
    lines = [f"{x:.6f} {y:.6f} {z:.6f} 0.5\n" for x, y, z in xyz.transpose(1, 0, 2).reshape(-1, 3)]
    (tmp_path / "scan.ptx").write_text(header + "".join(lines))
    picked = rng.choice(rows * columns, 2000, replace=False)
    xy = CAMERA.project(true_xyz[picked] @ TURN.T).xy_px.T + sigma_d * rng.standard_normal((2000, 2))
    table = np.column_stack([xy, xyz.reshape(-1, 3)[picked]])
    text = "".join(",".join(f"{value:.5f}" for value in row) + "\n" for row in table)
    (tmp_path / "points.csv").write_text("# width=1600 height=1200\nx,y,X,Y,Z\n" + text)
    measured = read_correspondences(tmp_path / "points.csv", scan=read_ptx(tmp_path / "scan.ptx"))
    estimate = estimate_of("truth", CAMERA, TURN, np.zeros(3), measured, inliers=np.ones(2000, dtype=bool))
    noise = lidar_noise(estimate, measured)
    assert noise.sigma_l == pytest.approx(sigma_l, rel=0.1)
    assert noise.sigma_d_px == pytest.approx(sigma_d, rel=0.25)
