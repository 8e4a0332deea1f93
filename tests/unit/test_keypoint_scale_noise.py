"""Keypoint scale as a predictor of noise: the fit of its power, weighted tracks, the paper's form (method.md 2, 3)."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from corpus import CORPUS, needs_corpus
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy import integrate, stats

from sfm_audit.audit.inliers.distortion import DistortionDerivatives
from sfm_audit.audit.inliers.residuals import ModelResiduals, model_residuals
from sfm_audit.audit.noise.keypoint import fit_scale_power, keypoint_noise, keypoint_tracks, scale_only_noise
from sfm_audit.audit.noise.standardise import model_tracks, track_noise
from sfm_audit.audit.normality import normality_tests as normality_of
from sfm_audit.loaders import open_model
from sfm_audit.loaders.colmap.database import find_database, read_keypoint_shapes

THRESHOLDS = {"pose_offset_threshold_px": 0.5, "min_track_length": 3, "min_eigenvalue": 0.05}


def simulate(rng, gamma, *, num_images=6, num_points=600, nu0=4.0, spread=0.6, coarse_image=None):
    """Every image sees every point; noise 0.3 px scale^gamma, one variance per track; points at their optimum."""
    n = num_images * num_points
    point_idx = np.tile(np.arange(num_points), num_images)
    scale_px = np.exp(rng.normal(0.0, spread, n))
    if coarse_image is not None:
        scale_px[coarse_image * num_points : (coarse_image + 1) * num_points] *= 4.0
    track_sd = 0.3 if nu0 is None else 0.3 * np.sqrt(nu0 / rng.chisquare(nu0, num_points))[point_idx]
    noise = rng.normal(size=(2, n)) * track_sd * scale_px**gamma
    jacobian = rng.normal(size=(2, 3, n)) * 100.0
    none = np.zeros(num_images, dtype=np.int64)
    offsets = np.arange(num_images + 1) * num_points
    residuals = ModelResiduals(
        offsets,
        np.arange(n, dtype=np.int32),
        point_idx,
        noise,
        jacobian,
        np.zeros(num_images),
        DistortionDerivatives({}),
        none,
        none,
        none,
        none,
    )
    return at_optimum(residuals, num_points), scale_px


def at_optimum(residuals, num_points):
    """Residuals after unweighted triangulation, as bundle adjustment leaves them."""
    rows = residuals.point_jacobian.transpose(2, 0, 1)
    information, gradient = np.zeros((num_points, 3, 3)), np.zeros((num_points, 3))
    np.add.at(information, residuals.point_idx, rows.transpose(0, 2, 1) @ rows)
    np.add.at(gradient, residuals.point_idx, np.einsum("nai,an->ni", rows, residuals.residuals_px))
    moved = np.linalg.solve(information, gradient[:, :, None])[:, :, 0]
    fitted = residuals.residuals_px - np.einsum("nai,ni->an", rows, moved[residuals.point_idx])
    return replace(residuals, residuals_px=fitted)


def power_of(residuals, scale_px):
    used = np.ones(len(scale_px), dtype=bool)
    return fit_scale_power(
        residuals.residuals_px, residuals.point_jacobian, residuals.point_idx, np.log(scale_px), used
    )


@pytest.mark.parametrize("gamma", [0.0, 0.3, 0.5, 1.0])
def test_the_power_is_found(gamma):
    found = [power_of(*simulate(np.random.default_rng(seed), gamma)).gamma for seed in range(4)]
    assert np.mean(found) == pytest.approx(gamma, abs=0.03)


def test_the_gain_is_half_a_chi_square_where_scale_does_not_matter():
    gains = np.array(
        [
            power_of(*simulate(np.random.default_rng(seed), 0.0, num_points=100)).log_likelihood_gain
            for seed in range(60)
        ]
    )
    assert (gains == 0.0).mean() == pytest.approx(0.5, abs=0.2)  # gamma at its bound in half of the cases
    assert (2 * gains > stats.chi2.isf(0.1, 1)).mean() < 0.15  # 5 % expected


def test_likelihood_ratio_is_that_of_integrals_over_point_and_variance():
    """One track of two observations with a point on a line: everything by quadrature."""
    rng = np.random.default_rng(3)
    num_tracks = 20
    residuals, scale_px = simulate(rng, 0.5, num_images=2, num_points=num_tracks)
    direction = np.array([1.0, 0.0, 0.0])[:, None]
    jacobian = residuals.point_jacobian * direction  # the point moves along one axis only: rank 1, m = 3
    found = fit_scale_power(
        residuals.residuals_px, jacobian, residuals.point_idx, np.log(scale_px), np.ones(2 * num_tracks, dtype=bool)
    )
    assert found.num_tracks == num_tracks

    variance = np.exp(np.linspace(math.log(1e-7), math.log(1e5), 4000))[:, None]

    def log_likelihood(gamma, nu0, s0):
        weight = scale_px.reshape(2, 1, num_tracks) ** gamma
        eps = residuals.residuals_px.reshape(2, 2, num_tracks).swapaxes(0, 1) / weight
        column = jacobian[:, 0].reshape(2, 2, num_tracks).swapaxes(0, 1) / weight
        information = (column**2).sum(axis=(0, 1))
        left = (eps**2).sum(axis=(0, 1)) - (column * eps).sum(axis=(0, 1)) ** 2 / information
        prior = stats.invgamma.pdf(variance, nu0 / 2, scale=nu0 * s0**2 / 2)
        density = prior * variance**-1.5 * np.exp(-left / (2 * variance))
        inside = integrate.trapezoid(density * variance, np.log(variance), axis=0)
        return (np.log(inside) - 2 * np.log(weight).sum(axis=(0, 1)) - 0.5 * np.log(information)).sum()

    def profile(gamma):
        grid = [(nu0, s0) for nu0 in (1, 2, 4, 8, 30, 1000) for s0 in np.geomspace(0.05, 3, 40)]
        return max(log_likelihood(gamma, *prior) for prior in grid)

    assert profile(found.gamma) - profile(0.0) == pytest.approx(found.log_likelihood_gain, abs=0.1)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 50), unit=st.sampled_from([0.25, 2.0, 8.0]))
def test_units_of_pixels_scales_and_world_do_not_matter(seed, unit):
    residuals, scale_px = simulate(np.random.default_rng(seed), 0.5, num_points=60)
    reference = keypoint_tracks(residuals, 60, scale_px, **THRESHOLDS)
    changed = replace(
        residuals, residuals_px=unit * residuals.residuals_px, point_jacobian=3.0 * residuals.point_jacobian
    )
    found = keypoint_tracks(changed, 60, 5.0 * scale_px, **THRESHOLDS)
    assert found.power.gamma == pytest.approx(reference.power.gamma, abs=2e-3)
    assert_allclose(found.weight, reference.weight, rtol=1e-2)
    assert found.median_scale_px == pytest.approx(5.0 * reference.median_scale_px)


def test_equal_scales_are_the_noise_model_track():
    residuals, _ = simulate(np.random.default_rng(1), 0.0)
    plain = model_tracks(residuals, 600, **THRESHOLDS)
    found = keypoint_tracks(residuals, 600, np.full(3600, 2.5), **THRESHOLDS)
    for image in range(6):
        ours, theirs = keypoint_noise(found, plain, image, 1.0), track_noise(plain, image, 1.0)
        assert_allclose(ours.z, theirs.z, atol=1e-8)
        assert ours.sigma_predicted_px == pytest.approx(theirs.sigma_predicted_px)
        assert ours.scale_ratio == pytest.approx(theirs.scale_ratio)


def test_standardises_where_track_alone_does_not():
    residuals, scale_px = simulate(np.random.default_rng(2), 1.0, num_points=3000)
    plain = model_tracks(residuals, 3000, **THRESHOLDS)
    found = keypoint_tracks(residuals, 3000, scale_px, **THRESHOLDS)
    ours = [normality_of(keypoint_noise(found, plain, image, 1.0).z) for image in range(6)]
    theirs = [normality_of(track_noise(plain, image, 1.0).z) for image in range(6)]
    assert min(test.ks_fitted_p for test in ours) > 1e-3
    assert max(test.ks_fitted_p for test in theirs) < 1e-3
    assert abs(np.mean([test.kurtosis_excess for test in ours])) < 0.1


def test_predicted_noise_has_the_weights_put_back():
    rng = np.random.default_rng(4)
    residuals, scale_px = simulate(rng, 0.7, nu0=None, num_points=2000, coarse_image=0)
    plain = model_tracks(residuals, 2000, **THRESHOLDS)
    found = keypoint_tracks(residuals, 2000, scale_px, **THRESHOLDS)
    coarse, fine = (keypoint_noise(found, plain, image, 1.0) for image in (0, 1))
    assert coarse.sigma_predicted_px == pytest.approx(np.median(0.3 * scale_px[:2000] ** 0.7), rel=0.05)
    assert fine.sigma_predicted_px == pytest.approx(np.median(0.3 * scale_px[2000:4000] ** 0.7), rel=0.05)
    assert coarse.sigma_predicted_px > 2.0 * fine.sigma_predicted_px
    assert coarse.converged


def test_the_paper_s_form_takes_each_observation_s_own_scale():
    residuals, scale_px = simulate(np.random.default_rng(8), 1.0, nu0=None, num_points=200)
    strong = residuals.point_jacobian.copy()
    strong[:, :, 5:40] *= 100.0  # these observations decide where their points are: not verifiable
    residuals = at_optimum(replace(residuals, point_jacobian=strong), 200)
    scale_px[[2, 60]] = np.nan
    plain = model_tracks(residuals, 200, **THRESHOLDS)
    noise = keypoint_noise(keypoint_tracks(residuals, 200, scale_px, **THRESHOLDS), plain, 0, 1.0)
    rows = np.flatnonzero(plain.statistics.verified[:200] & np.isfinite(scale_px[:200]))
    assert 150 <= len(rows) <= 165
    direct = scale_only_noise(plain.statistics.whitened_px[:, rows], scale_px[rows], 1.0)
    assert (noise.sigma_d_px, noise.sigma_l) == (direct.sigma_d_px, direct.sigma_l)
    assert direct.sigma_l > 0.1


def test_observations_without_a_scale_are_left_out():
    residuals, scale_px = simulate(np.random.default_rng(5), 0.5, num_points=200)
    unknown = scale_px.copy()
    unknown[[3, 250]] = np.nan
    unknown[7] = 0.0
    unknown[11] = -1.0
    found = keypoint_tracks(residuals, 200, unknown, **THRESHOLDS)
    plain = model_tracks(residuals, 200, **THRESHOLDS)
    kept = np.isfinite(unknown) & (unknown > 0)
    assert (found.known == kept).all()
    assert len(keypoint_noise(found, plain, 0, 1.0).z) == 197
    assert len(keypoint_noise(found, plain, 1, 1.0).z) == 199
    # the tracks that lost an observation are shorter by one
    length = found.tracks.statistics.track_length[np.flatnonzero(residuals.point_idx[kept] == 3)]
    assert (length == 5).all()


def test_no_scale_at_all_is_undetermined():
    residuals, scale_px = simulate(np.random.default_rng(5), 0.5, num_points=50)
    found = keypoint_tracks(residuals, 50, np.full_like(scale_px, np.nan), **THRESHOLDS)
    plain = model_tracks(residuals, 50, **THRESHOLDS)
    noise = keypoint_noise(found, plain, 0, 1.0)
    assert noise.z.shape == (0, 2)
    assert math.isnan(found.power.gamma)
    assert not noise.converged


def test_too_few_tracks_are_not_fitted():
    residuals, scale_px = simulate(np.random.default_rng(5), 0.5, num_points=19)
    assert math.isnan(power_of(residuals, scale_px).gamma)
    exact = replace(residuals, residuals_px=np.zeros_like(residuals.residuals_px))
    found = keypoint_tracks(exact, 19, scale_px, **THRESHOLDS)
    assert (found.weight == 1.0).all()


def test_images_with_wrong_poses_do_not_decide():
    rng = np.random.default_rng(6)
    residuals, scale_px = simulate(rng, 0.5, num_points=300)
    alone = keypoint_tracks(residuals, 300, scale_px, **THRESHOLDS).power
    offset = np.zeros(6)
    offset[2] = 1.0
    spoiled = residuals.residuals_px.copy()
    spoiled[:, 600:900] += 50.0 / scale_px[600:900]
    changed = replace(residuals, residuals_px=spoiled, pose_offset_px=offset)
    assert keypoint_tracks(changed, 300, scale_px, **THRESHOLDS).power.gamma == pytest.approx(alone.gamma, abs=0.08)


def test_the_paper_s_form_finds_both_variances():
    rng = np.random.default_rng(7)
    scale = np.exp(rng.normal(0.5, 0.6, 20_000))
    whitened = rng.normal(size=(2, 20_000)) * np.sqrt(0.3**2 + 0.2**2 * scale**2)
    noise = scale_only_noise(whitened, scale, 1.0)
    assert noise.sigma_d_px == pytest.approx(0.3, rel=0.05)
    assert noise.sigma_l == pytest.approx(0.2, rel=0.05)
    assert stats.kstest(noise.z.ravel(), "norm").pvalue > 0.01
    assert noise.converged


@needs_corpus
@pytest.mark.corpus
@pytest.mark.parametrize(("component", "gamma"), [("9001/sparse/manhattan/0", 0.53), ("9002/sparse/manhattan/0", 0.08)])
def test_powers_of_real_photos(component, gamma):
    location = CORPUS / "megadepth_like" / "MegaDepth_v1_SfM" / component
    model = open_model(location)
    scale_px = read_keypoint_shapes(find_database(location), model).scale_px
    found = keypoint_tracks(model_residuals(model), len(model.points), scale_px, **THRESHOLDS)
    assert found.power.gamma == pytest.approx(gamma, abs=0.02)
