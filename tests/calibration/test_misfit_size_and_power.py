"""How often correct cameras are rejected and wrong ones found: seeded simulations with binomial bounds."""

from __future__ import annotations

import numpy as np
import pytest
from misfit_reference import NOISE, camera, points, refit, residuals_of
from scipy import stats

from sfm_audit.audit.cameras import project
from sfm_audit.audit.misfit import GROUPS, MisfitGroup, MisfitStatus, camera_tests, image_design, prepare_image
from sfm_audit.audit.simulate.defects import systematic_rms_px

TRIALS = 400
SIGMA_PX = 0.5
G = MisfitGroup


@pytest.mark.parametrize("noise", sorted(NOISE))
@pytest.mark.parametrize("n", [50, 250, 2000])
def test_size_at_5_percent(n, noise):
    rng = np.random.default_rng([n, sorted(NOISE).index(noise)])
    cam = camera()
    rejected, ran = dict.fromkeys(GROUPS, 0), dict.fromkeys(GROUPS, 0)
    for _ in range(TRIALS):
        tests = prepare_image(cam, points(rng, n)).test(SIGMA_PX * NOISE[noise](rng, n))
        for group, test in tests.items():
            if test.status is MisfitStatus.TESTED:
                ran[group] += 1
                rejected[group] += test.p < 0.05
    for group in GROUPS:
        assert ran[group] == (0 if n == 50 and group is G.SMOOTH else TRIALS), group
        if ran[group]:
            low, high = stats.binom.ppf(1e-4, TRIALS, 0.015), stats.binom.ppf(1.0 - 1e-4, TRIALS, 0.07)
            assert low <= rejected[group] <= high, (group, rejected[group] / TRIALS)


def fitted_tests(true, rng, n=250, claimed="SIMPLE_RADIAL"):
    """The tests of an image of a true camera, fitted as another one; and the true systematic RMS, px."""
    xyz = points(rng, n)
    xy_true = project(true.model, true.params, xyz)
    start = camera(claimed, (-0.05,))
    xy = xy_true + SIGMA_PX * rng.standard_normal((n, 2))
    fitted, xyz_cam = refit(start, xyz, xy)
    truth = systematic_rms_px(start.model, start.params, xyz, xy_true, rotation=np.eye(3), translation=np.zeros(3))
    return prepare_image(fitted, xyz_cam).test(residuals_of(fitted, xyz_cam, xy)), truth


@pytest.mark.parametrize(
    ("group", "extra"), [(G.RADIAL, (-0.05, 0.05, 0.0, 0.0)), (G.TANGENTIAL, (-0.05, 0.0, 1e-3, 1e-3))]
)
def test_power_and_effect(group, extra):
    """k2 = 0.05, p1 = p2 = 1e-3: found in 95 % of the images, the effect within 20 % of the truth."""
    rng = np.random.default_rng(8)
    trials = 100
    found, ratios = 0, []
    for _ in range(trials):
        tests, truth = fitted_tests(camera("OPENCV", extra), rng)
        found += tests[group].p < 0.05
        if truth > 0.1:
            ratios.append(tests[group].px / truth)
    assert found >= 0.95 * trials
    assert len(ratios) == trials
    assert 0.9 < np.median(ratios) < 1.1
    assert np.mean(np.abs(np.array(ratios) - 1.0) < 0.2) >= 0.95, ratios


def test_size_after_fitting():
    """Not only profiled: pose, focal length and k1 fitted by Gauss-Newton to 100 points."""
    rng = np.random.default_rng(9)
    tests = [fitted_tests(camera(), rng, n=100)[0] for _ in range(200)]
    for group in GROUPS:
        p = np.array([test[group].p for test in tests])
        if group is not G.SMOOTH:
            assert np.mean(p < 0.05) <= stats.binom.ppf(1.0 - 1e-4, 200, 0.07) / 200, group


def test_size_of_the_pooled_test():
    """Eight images of 60 points, tracks whose noise has its own scale; 4 r tracks and more."""
    rng = np.random.default_rng(10)
    cam, trials, num_tracks = camera(), 200, 200
    rejected = dict.fromkeys(GROUPS, 0)
    for _ in range(trials):
        scale = np.exp(0.5 * rng.standard_normal(num_tracks))
        designs = []
        for _ in range(8):
            track = rng.permutation(num_tracks)[:60]
            y = SIGMA_PX * scale[track] * rng.standard_normal((2, 60))
            designs.append(image_design(cam, points(rng, 60), y, track))
        tests = camera_tests(designs.__getitem__, 8, num_tracks).tests
        for group in GROUPS:
            rejected[group] += tests[group].p < 0.05
    for group in GROUPS:
        assert rejected[group] <= stats.binom.ppf(1.0 - 1e-4, trials, 0.07), (group, rejected[group] / trials)
