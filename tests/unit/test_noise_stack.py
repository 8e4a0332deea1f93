"""Images with few observations, fitted together, have the noise that each of them has by itself."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from joint_reference import SPEC, model_of
from numpy.testing import assert_allclose

from sfm_audit.audit.engine.model import ModelAuditor, audit_model
from sfm_audit.audit.noise import stack
from sfm_audit.audit.noise.fits import fit_constant_variance
from sfm_audit.audit.noise.standardise import constant_noise, track_noise


@pytest.fixture(scope="module")
def auditor():
    return ModelAuditor(model_of(dataclasses.replace(SPEC, num_images=60, points_per_image=9), seed=5))


def assert_same(found, expected):
    for name, value in dataclasses.asdict(expected).items():
        assert_allclose(getattr(found, name), value, rtol=1e-9, atol=1e-12, err_msg=name)


def test_few_observations_together_are_each_by_itself(auditor):
    images = range(len(auditor.model.images))
    constant = dict(enumerate(stack.constant_noises(auditor.residuals, images, stack.constant_fits(auditor.residuals))))
    sigma_px = {image: noise.sigma_constant_px for image, noise in constant.items()}
    chosen = stack.track_noises(auditor.tracks, images, sigma_px)
    assert min(len(constant), len(chosen)) > 20
    for image, noise in constant.items():
        assert_same(noise, constant_noise(auditor.residuals.residuals_px[:, auditor.residuals.rows(image)]))
    for image, noise in chosen.items():
        assert_same(noise, track_noise(auditor.tracks, image, sigma_px[image]))
    assert len({noise.converged for noise in chosen.values()} | {noise.sigma_l > 0 for noise in chosen.values()}) > 1


def test_the_table_says_of_them_what_the_audit_of_one_says(auditor):
    table = audit_model(auditor.model).images
    for image, row in enumerate(table.to_pylist()):
        one = auditor.image(image)
        assert row["verdict"] == one.verdict
        for name, value in (
            ("ks_p", one.tests.ks_p),
            ("ks_constant_p", one.constant_tests.ks_p),
            ("sw_p", one.tests.sw_p),
            ("scale_ratio", one.noise.scale_ratio),
            ("sigma_predicted_px", one.noise.sigma_predicted_px),
        ):
            assert_allclose(math.nan if row[name] is None else row[name], value, rtol=1e-9, err_msg=name)


def test_constant_variances_of_rows():
    y = np.random.default_rng(0).standard_cauchy((40, 10)) ** 2
    y[1], y[2, 3], y[3, 1:], y[4, 0] = 0.0, math.nan, 0.0, math.inf
    y[5, 3:] = 0.0
    for found, row in zip(stack.fit_constant_variances(y), y, strict=True):
        expected = fit_constant_variance(row)
        assert_allclose(found.detector_px2, expected.detector_px2, rtol=1e-12)
        assert (found.converged, math.isnan(found.structure)) == (expected.converged, math.isnan(expected.structure))


def test_all_zero_residuals_are_left_to_the_single_fit(auditor):
    tracks = dataclasses.replace(
        auditor.tracks,
        statistics=dataclasses.replace(
            auditor.tracks.statistics, whitened_px=np.zeros_like(auditor.tracks.statistics.whitened_px)
        ),
    )
    for image, noise in stack.track_noises(tracks, range(60), dict.fromkeys(range(60), 0.5)).items():
        assert_same(noise, track_noise(tracks, image, 0.5))
