"""How often correct cameras are rejected and wrong ones found: seeded simulations with binomial bounds."""

from __future__ import annotations

import numpy as np
import pytest
from misfit_reference import NOISE, camera, points, refit, residuals_of
from scipy import stats

from sfm_audit.audit.cameras import project
from sfm_audit.audit.engine.model import ModelAuditor
from sfm_audit.audit.misfit import GROUPS, MisfitGroup, MisfitStatus, camera_tests, image_design, prepare_image
from sfm_audit.audit.simulate.adjust import adjust_scene, sparse_model
from sfm_audit.audit.simulate.defects import DefectKind, DefectSpec, systematic_rms_px
from sfm_audit.audit.simulate.noise import NoiseKind, NoiseSpec
from sfm_audit.audit.simulate.scene import SceneSpec, simulate_scene

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


def joint_misfits(seed, defects=(), noise=NoiseKind.STUDENT_T5):
    """The joint tests of a bundle-adjusted scene of 20 images with cameras of their own, 150 points each."""
    spec = SceneSpec(num_images=20, points_per_image=150, noise=NoiseSpec(noise, SIGMA_PX), defects=defects)
    scene = simulate_scene(spec, np.random.default_rng(seed))
    joint = ModelAuditor(sparse_model(scene, adjust_scene(scene))).joint
    assert joint is not None
    return joint.misfit


def test_size_of_the_joint_test():
    """Bundle-adjusted scenes without defects: p < 5 % in at most 7 % of the images, and no image above tau."""
    found = [joint_misfits(20 + k, noise=kind) for k, kind in enumerate(NoiseKind)]
    for group in GROUPS:
        p = np.array([tests[group].p for misfit in found for tests in misfit.tests])
        assert np.isfinite(p).all(), group
        assert np.count_nonzero(p < 0.05) <= stats.binom.ppf(1.0 - 1e-4, p.size, 0.07), group
    assert not any((misfit.effect_px > 0.2).any() for misfit in found)


def test_the_joint_test_finds_the_guilty_and_nobody_else():
    """k2 and a rolling shutter of 0.8 px: both found and named, 18 neighbours left alone, effects below the truth.

    Points, poses and focal lengths take up a part of what the image's own refit on true points leaves.
    """
    kinds = {3: DefectKind.RADIAL_K2, 12: DefectKind.ROLLING_SHUTTER}
    found = joint_misfits(40, tuple(DefectSpec(image, kind, 0.8) for image, kind in kinds.items()))
    assert np.flatnonzero(found.effect_px > 0.2).tolist() == [3, 12]
    assert found.included[[3, 12]].all()
    assert found.cause[3] is G.RADIAL
    assert found.cause[12] in {G.ROLLING_SHUTTER, G.AFFINE}
    assert ((found.effect_px[[3, 12]] > 0.4) & (found.effect_px[[3, 12]] < 0.9)).all()
