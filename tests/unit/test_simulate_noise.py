"""Simulated noise has the stated law and the stated standard deviation."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import integrate, optimize, stats

from sfm_audit.audit.simulate.noise import NoiseKind, NoiseSpec, draw_noise

NUM = 200_000
TRACKS = np.repeat(np.arange(NUM // 5), 5)


@pytest.mark.parametrize("kind", list(NoiseKind))
@pytest.mark.parametrize("sigma", [0.05, 0.5, 1.5])
def test_standard_deviation_is_the_stated_one(kind, sigma):
    noise = draw_noise(NoiseSpec(kind, sigma, log_spread=0.4), TRACKS, np.random.default_rng(7))
    assert noise.xy_px.shape == (NUM, 2)
    right = noise.sigma_px == sigma if kind is NoiseKind.WRONG_MATCHES else np.full(NUM, fill_value=True)
    rtol = 0.05 if kind is NoiseKind.TRUNCATED else 0.015  # cut at 80 sigma, its kurtosis is 200
    np.testing.assert_allclose(noise.xy_px[right].std(axis=0), sigma, rtol=rtol)
    np.testing.assert_allclose(noise.xy_px.mean(axis=0), 0.0, atol=0.02 * sigma + 0.002)
    assert np.sqrt((noise.sigma_px[right] ** 2).mean()) == pytest.approx(sigma, rel=0.015)


@pytest.mark.parametrize("kind", list(NoiseKind))
def test_recorded_sigma_is_that_of_each_observation(kind):
    noise = draw_noise(NoiseSpec(kind, 0.5, log_spread=0.8), TRACKS, np.random.default_rng(8))
    for low, high in ((0, 20), (40, 60), (80, 100)):
        edges = np.percentile(noise.sigma_px, [low, high])
        part = (noise.sigma_px >= edges[0]) & (noise.sigma_px <= edges[1])
        assert noise.xy_px[part].std() == pytest.approx(np.sqrt((noise.sigma_px[part] ** 2).mean()), rel=0.02)


@pytest.mark.parametrize(
    ("kind", "law"),
    [
        (NoiseKind.GAUSSIAN, stats.norm(scale=0.5)),
        (NoiseKind.LAPLACE, stats.laplace(scale=0.5 / np.sqrt(2.0))),
        (NoiseKind.STUDENT_T5, stats.t(5, scale=0.5 * np.sqrt(3.0 / 5.0))),
    ],
)
def test_laws_are_scipy_s(kind, law):
    noise = draw_noise(NoiseSpec(kind, 0.5), TRACKS, np.random.default_rng(9))
    assert stats.kstest(noise.xy_px[:20_000].ravel(), law.cdf).pvalue > 0.01


def test_tracks_share_their_sigma_and_differ_in_it():
    spec = NoiseSpec(NoiseKind.PER_TRACK_LOGNORMAL, 0.5, log_spread=0.6)
    sigma = draw_noise(spec, TRACKS, np.random.default_rng(1)).sigma_px.reshape(-1, 5)
    assert (sigma == sigma[:, :1]).all()
    assert np.log(sigma[:, 0]).std() == pytest.approx(0.6, rel=0.02)


def test_scales_of_observations_are_independent_within_a_track():
    spec = NoiseSpec(NoiseKind.PER_OBSERVATION_SCALE, 0.5, log_spread=0.6)
    log_sigma = np.log(draw_noise(spec, TRACKS, np.random.default_rng(1)).sigma_px.reshape(-1, 5))
    assert log_sigma.std() == pytest.approx(0.6, rel=0.02)
    assert abs(np.corrcoef(log_sigma[:, 0], log_sigma[:, 1])[0, 1]) < 0.02


def test_truncated_noise_is_a_bivariate_t_cut_at_the_limit():
    spec = NoiseSpec(NoiseKind.TRUNCATED, 0.5, truncation_px=4.0)
    xy = draw_noise(spec, TRACKS, np.random.default_rng(2)).xy_px
    radius = np.linalg.norm(xy, axis=1)
    assert radius.max() <= 4.0
    assert stats.kurtosis(xy.ravel()) > 5.0
    law = stats.multivariate_t(shape=np.eye(2), df=2)

    def share_below(limit, s):
        return integrate.quad(lambda r: 2 * np.pi * r * law.pdf([r, 0.0]), 0.0, limit / s)[0]

    def median_error(s):
        return share_below(np.median(radius), s) / share_below(4.0, s) - 0.5

    s = optimize.brentq(median_error, 0.05, 1.0)
    for limit in (0.2, 1.0, 2.0, 3.0):
        assert (radius < limit).mean() == pytest.approx(share_below(limit, s) / share_below(4.0, s), abs=0.005)


def test_wrong_matches_lie_anywhere_in_the_disc_and_are_as_many_as_stated():
    spec = NoiseSpec(NoiseKind.WRONG_MATCHES, 0.1, truncation_px=4.0, wrong_share=0.02)
    noise = draw_noise(spec, TRACKS, np.random.default_rng(3))
    wrong = noise.sigma_px > 1.0
    assert wrong.mean() == pytest.approx(0.02, abs=0.002)
    radius = np.linalg.norm(noise.xy_px[wrong], axis=1)
    assert stats.kstest((radius / 4.0) ** 2, "uniform").pvalue > 0.01


def test_no_noise_is_no_noise():
    for kind in NoiseKind:
        spec = NoiseSpec(kind, 0.0, wrong_share=0.0)
        assert not draw_noise(spec, TRACKS[:50], np.random.default_rng(0)).xy_px.any()


@pytest.mark.parametrize(
    "bad",
    [{"sigma_px": -1.0}, {"wrong_share": 1.5}, {"kind": NoiseKind.TRUNCATED, "sigma_px": 2.0}, {"sigma_px": np.nan}],
)
def test_impossible_laws_are_refused(bad):
    with pytest.raises(ValueError, match="sigma_px"):
        NoiseSpec(**bad)
