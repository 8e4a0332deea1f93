"""Pooled tests of shared cameras from sums over observations: in C as with numpy, and as from columns in memory."""

from __future__ import annotations

import numpy as np
import pytest
from misfit_models import assert_same, model_of, nearly_flat
from numpy.testing import assert_allclose

from sfm_audit.audit.inliers.projected import image_inliers
from sfm_audit.audit.kernels import kernels_in_use, numpy_only
from sfm_audit.audit.kernels.misfit import NUM_FEATURES, Tracks, misfit_tracks
from sfm_audit.audit.misfit import MisfitStatus, camera_sums, camera_tests, mixed, projected_design
from sfm_audit.audit.misfit.camera_sums import camera_tests_of_sums
from sfm_audit.audit.misfit.features import ImageFeatures, packed, sums_of, unpacked
from sfm_audit.audit.misfit.images import misfit_of_images
from sfm_audit.audit.misfit.sums import ModelSums, WindowSums

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
    of_row, num_tracks, _ = source.tracks([0, 1])
    everything = np.zeros((num_tracks, NUM_FEATURES))
    assert misfit_tracks(source.observed, window, profile, Tracks(of_row, 0, num_tracks), everything)
    part = np.zeros((20, NUM_FEATURES))
    assert misfit_tracks(source.observed, window, profile, Tracks(of_row, 30, 50), part)
    assert (part == everything[30:50]).all()
    assert (part != 0).any(axis=1).all()
    with pytest.raises(ValueError, match="per_track"):
        misfit_tracks(source.observed, window, profile, Tracks(of_row, 30, 51), part)
    with pytest.raises(ValueError, match="tracks of shape"):
        misfit_tracks(source.observed, window, profile, Tracks(of_row[1:], 30, 50), part)


@compiled
def test_the_kernel_adds_up_what_a_track_says_in_several_rows_and_images(tmp_path):
    model, residuals = model_of(tmp_path, "OPENCV", (101, 80, 90), shared=True)
    source = ModelSums(model, residuals)
    window = source.window([0, 1, 2], [source.camera(0)] * 3)
    rng = np.random.default_rng(1)
    profile = (
        rng.normal(size=(3, 9, 12)) * 1e-5,
        rng.normal(size=(3, 12)) * 1e-5,
        rng.normal(size=(3, 12, NUM_FEATURES)),
    )
    of_row = rng.integers(0, 7, len(residuals.point_idx)).astype(np.int32)
    found = np.ones((4, NUM_FEATURES))
    assert misfit_tracks(source.observed, window, profile, Tracks(of_row, 2, 6), found)
    expected = np.zeros((7, NUM_FEATURES))
    with numpy_only():
        WindowSums(source, [0, 1, 2]).add_tracks(expected, profile, Tracks(of_row, 0, 7))
    assert_allclose(found - 1.0, expected[2:6], rtol=1e-9, atol=1e-9 * np.abs(expected).max())


@pytest.mark.both_paths
@pytest.mark.parametrize("lacking", [(), (1,), (0, 2)])
def test_sums_that_are_known_are_not_made_again_and_say_the_same(tmp_path, monkeypatch, lacking):
    model, residuals = model_of(tmp_path, "SIMPLE_RADIAL", (300, 130, 200), shared=True)
    images = [0, 1, 2]
    expected = camera_tests_of_sums(ModelSums(model, residuals), images)
    known = {i: each.sums for i, each in misfit_of_images(ModelSums(model, residuals), images).items()}
    for image in lacking:
        del known[image]
    asked = []
    made = WindowSums._summed
    monkeypatch.setattr(WindowSums, "_summed", lambda own: asked.append(own.images) or made(own))
    found = camera_tests_of_sums(ModelSums(model, residuals, known), images)
    assert_same(found.tests, expected.tests)
    assert found.num_tracks == expected.num_tracks
    assert asked == ([list(lacking)] if lacking else [])


def test_sums_are_kept_of_images_that_share_a_camera(tmp_path):
    model, residuals = model_of(tmp_path / "shared", "SIMPLE_RADIAL", (130, 100), shared=True)
    assert all(each.sums is not None for each in misfit_of_images(ModelSums(model, residuals), [0, 1]).values())
    model, residuals = model_of(tmp_path / "own", "SIMPLE_RADIAL", (130, 100))
    assert all(each.sums is None for each in misfit_of_images(ModelSums(model, residuals), [0, 1]).values())


def test_packed_sums_come_back_to_the_last_bit():
    rng = np.random.default_rng(3)
    rows, monomials = rng.normal(size=(8 + 11, 2, 50)), rng.normal(size=(15, 50))
    gram, on_y = sums_of(ImageFeatures(rows, monomials))
    gram = np.triu(gram) + np.triu(gram, 1).T  # symmetric to the last bit, as kernels make it
    gram[18:33, 18:33] = gram[33:, 33:]
    kept = packed(gram[None], on_y[None], 8)
    assert kept.nbytes < 0.25 * gram.nbytes
    again = unpacked(kept, 8)
    assert (again[0] == gram).all()
    assert (again[1] == on_y).all()
