"""Pooled tests of shared cameras from sums over observations: in C as with numpy, and as from columns in memory."""

from __future__ import annotations

import numpy as np
import pytest
from misfit_models import assert_same, model_of, nearly_flat

from sfm_audit.audit.inliers.projected import image_inliers
from sfm_audit.audit.kernels import kernels_in_use, numpy_only
from sfm_audit.audit.kernels.misfit import NUM_FEATURES, Tracks, misfit_tracks
from sfm_audit.audit.misfit import MisfitStatus, camera_sums, camera_tests, mixed, projected_design
from sfm_audit.audit.misfit.camera_sums import camera_tests_of_sums
from sfm_audit.audit.misfit.sums import ModelSums

compiled = pytest.mark.skipif(not kernels_in_use(), reason="no compiled kernels")


def old_tests(model, residuals, images):
    """The tests of a camera on images, one after the other, fields in memory."""
    points = np.unique(residuals.point_idx, return_inverse=True)[1]

    def design(k):
        own = image_inliers(model, residuals, images[k])
        return projected_design(own.camera, own.projected, own.residuals_px, points[residuals.rows(images[k])])

    return camera_tests(design, len(images), int(points.max()) + 1)


@pytest.mark.parametrize("path", [pytest.param("compiled", marks=compiled), "numpy"])
@pytest.mark.parametrize("name", ["SIMPLE_PINHOLE", "SIMPLE_RADIAL", "PINHOLE", "FOV", "DIVISION"])
def test_a_shared_camera_is_tested_from_sums_as_from_its_columns(tmp_path, monkeypatch, name, path):
    model, residuals = model_of(tmp_path, name, (300, 130, 65, 200), shared=True, twins=20)
    monkeypatch.setattr(camera_sums, "_TRACKS_AT_ONCE", 70)
    images = [0, 1, 3]
    if path == "numpy":
        with numpy_only():
            found = camera_tests_of_sums(ModelSums(model, residuals), images)
    else:
        found = camera_tests_of_sums(ModelSums(model, residuals), images)
    expected = old_tests(model, residuals, images)
    assert found is not None
    for counts in (found, expected):
        assert (counts.num_images, counts.num_observations, counts.num_tracks) == (3, 630, 300)
    assert {test.status for test in found.tests.values()} >= {MisfitStatus.TESTED}
    assert_same(found.tests, expected.tests)


@pytest.mark.parametrize("path", [pytest.param("compiled", marks=compiled), "numpy"])
@pytest.mark.parametrize("k1", [1e-5, 1e-4, 1e-3])
def test_smooth_fields_that_a_shared_camera_nearly_has_keep_their_digits(tmp_path, monkeypatch, k1, path):
    model, residuals = nearly_flat(tmp_path, (300, 130, 200), k1, shared=True)
    monkeypatch.setattr(camera_sums, "_TRACKS_AT_ONCE", 70)
    asked = []
    monkeypatch.setattr(camera_sums, "mix_of", lambda *a: asked.append(1) or mixed.mix_of(*a))
    if path == "numpy":
        with numpy_only():
            found = camera_tests_of_sums(ModelSums(model, residuals), [0, 1, 2])
    else:
        found = camera_tests_of_sums(ModelSums(model, residuals), [0, 1, 2])
    assert found is not None
    assert asked == [1]
    assert_same(found.tests, old_tests(model, residuals, [0, 1, 2]).tests)


def test_shared_cameras_in_doubt_are_left_out(tmp_path):
    model, residuals = model_of(tmp_path / "few", "SIMPLE_RADIAL", (300, 2, 200), shared=True)
    assert camera_tests_of_sums(ModelSums(model, residuals), [0, 1, 2]) is None
    assert camera_tests_of_sums(ModelSums(model, residuals), [0, 2]) is not None
    assert camera_tests_of_sums(ModelSums(model, residuals), []) is None
    model, residuals = model_of(tmp_path / "small", "SIMPLE_RADIAL", (60, 60), shared=True)
    assert camera_tests_of_sums(ModelSums(model, residuals), [0, 1]) is None
    model, residuals = model_of(tmp_path / "singular", "FULL_OPENCV", (300, 200), shared=True)
    assert camera_tests_of_sums(ModelSums(model, residuals), [0, 1]) is None


@compiled
def test_the_kernel_adds_to_no_track_that_is_not_asked_for(tmp_path):
    model, residuals = model_of(tmp_path, "SIMPLE_RADIAL", (100, 80), shared=True)
    source = ModelSums(model, residuals)
    window = source.window([0, 1], [source.camera(0)] * 2)
    rng = np.random.default_rng(1)
    profile = rng.normal(size=(2, 9, 8)) * 1e-4, rng.normal(size=(2, 8)) * 1e-4, rng.normal(size=(2, 8, NUM_FEATURES))
    of_point, num_tracks = source.tracks([0, 1])
    everything = np.zeros((num_tracks, NUM_FEATURES))
    assert misfit_tracks(source.observed, window, profile, Tracks(of_point, 0, num_tracks), everything)
    part = np.zeros((20, NUM_FEATURES))
    assert misfit_tracks(source.observed, window, profile, Tracks(of_point, 30, 50), part)
    assert (part == everything[30:50]).all()
    few, num_few = source.tracks([1])  # the same array again
    assert num_few == 80
    assert sorted(few[few >= 0].tolist()) == list(range(80))
    of_point, num_tracks = source.tracks([0, 1])
    assert (part != 0).any(axis=1).all()
    with pytest.raises(ValueError, match="per_track"):
        misfit_tracks(source.observed, window, profile, Tracks(of_point, 30, 51), part)
    with pytest.raises(ValueError, match="tracks of shape"):
        misfit_tracks(source.observed, window, profile, Tracks(of_point[1:], 30, 50), part)
