"""The compiled affine fits are numpy's, and what is said of a model does not depend on the path."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from joint_reference import SPEC, model_of
from numpy.testing import assert_allclose, assert_array_equal

from sfm_audit.audit.consistency import consistency_of, fit_affine
from sfm_audit.audit.consistency.affine import KNEE, MEDIAN_LENGTH, median_of, root_mean_square
from sfm_audit.audit.consistency.affine import _median_near as median_near
from sfm_audit.audit.inliers.residuals import model_residuals
from sfm_audit.audit.kernels import kernels_in_use, numpy_only
from sfm_audit.audit.kernels.consistency import AFFINE, NOTHING, RMS, fit_images
from sfm_audit.loaders.camera_models import BY_NAME

compiled = pytest.mark.skipif(not kernels_in_use(), reason="no compiled kernels here")


def sample(n, seed=0, *, outliers=0.0, noise=0.5, map_px=0.0):
    """Projected points (n, 2) and residuals (2, n)."""
    rng = np.random.default_rng(seed)
    projected = rng.uniform(0.0, (1600.0, 1200.0), (n, 2))
    residuals = rng.normal(0.0, noise, (2, n)) + map_px * (projected.T / 1000.0 - 0.4)
    wrong = rng.random(n) < outliers
    residuals[:, wrong] += rng.normal(0.0, 100.0, (2, int(wrong.sum())))
    return projected, residuals


def line(n):
    projected, residuals = sample(n)
    return np.column_stack([projected[:, 0], 0.5 * projected[:, 0]]), residuals


SAMPLES = {
    "clean": sample(300),
    "large": sample(5000, outliers=0.1),
    "shifted": sample(64, map_px=30.0),
    "a third wrong": sample(257, outliers=0.33),
    "few": sample(4),
    "too few": sample(3),
    "one": sample(1),
    "equal residuals": (sample(200)[0], np.repeat([[0.5], [0.25]], 200, axis=1)),
    "half zero": (sample(200)[0], sample(200)[1] * (np.arange(200) % 2)),
    "all zero": (sample(50)[0], np.zeros((2, 50))),
    "tiny": (sample(50)[0], 1e-120 * sample(50)[1]),
    "huge": (1e8 * sample(50)[0], 1e8 * sample(50)[1]),
    "absurd": (1e200 * sample(50)[0], 1e200 * sample(50)[1]),
    "nan": (sample(50)[0], np.where(np.arange(50) == 7, np.nan, sample(50)[1])),
    "infinite": (np.where(np.arange(100).reshape(50, 2) == 7, np.inf, sample(50)[0]), sample(50)[1]),
    "line": line(80),
    "nearly a line": (line(80)[0] + 1e-6 * sample(80, 1)[0], line(80)[1]),
    "one place": (np.full((30, 2), 500.0), sample(30)[1]),
}


def fitted_of(samples, wanted=None):
    projected = np.concatenate([each[0] for each in samples])
    residuals = np.concatenate([each[1] for each in samples], axis=1)
    offsets = np.concatenate([[0], np.cumsum([len(each[0]) for each in samples])])
    order = np.random.default_rng(1).permutation(len(projected))
    xy = np.empty_like(projected)
    with np.errstate(all="ignore"):
        xy[order] = projected + residuals.T
    wanted = np.full(len(samples), AFFINE) if wanted is None else np.array(wanted)
    return fit_images(offsets, residuals, order, xy, wanted=wanted, knee=KNEE)


@compiled
def test_fits_are_numpy_s():
    fitted = fitted_of(SAMPLES.values())
    for image_idx, (name, (projected, residuals)) in enumerate(SAMPLES.items()):
        wanted = fit_affine(projected.T, residuals)
        if not fitted.done[image_idx]:
            continue
        assert wanted is not None, name
        assert_allclose(np.eye(2) + fitted.slope[image_idx], wanted.linear, atol=1e-9, err_msg=name)
        scale = root_mean_square(np.hypot(*residuals))
        for field in ("shift", "centre", "spread"):
            ours = getattr(fitted, field)[image_idx]
            theirs = wanted.centre_px if field == "centre" else getattr(wanted, f"{field}_px")
            assert_allclose(ours, theirs, rtol=1e-9, atol=1e-9 * scale, err_msg=f"{name} {field}")
        assert_allclose(fitted.median[image_idx] / MEDIAN_LENGTH, wanted.noise_px, rtol=1e-9, atol=1e-9 * scale)
        assert_allclose(fitted.rest_rms[image_idx], wanted.rest_rms_px, rtol=1e-9, atol=1e-9 * scale)
        assert_allclose(fitted.stored_rms[image_idx], scale, rtol=1e-12)
    done = {name for name, is_done in zip(SAMPLES, fitted.done, strict=True) if is_done}
    odd = {"too few", "one", "all zero", "tiny", "absurd", "nan", "infinite", "line", "nearly a line", "one place"}
    assert done == set(SAMPLES) - odd


@compiled
def test_what_is_not_wanted_is_not_done():
    samples = [SAMPLES["clean"], SAMPLES["line"], SAMPLES["clean"], (np.empty((0, 2)), np.empty((2, 0)))]
    fitted = fitted_of(samples, [NOTHING, RMS, AFFINE, AFFINE])
    assert_array_equal(fitted.done, [False, True, True, False])
    assert fitted.stored_rms[1] == pytest.approx(root_mean_square(np.hypot(*SAMPLES["line"][1])), rel=1e-12)


@compiled
@pytest.mark.parametrize(("offsets", "rows"), [([0, 3], [0, 1, 9]), ([0, 3], [0, 1, -1]), ([0, 9], [0, 1, 2])])
def test_indices_that_point_outside_are_refused(offsets, rows):
    with pytest.raises(IndexError):
        fit_images(
            np.array(offsets), np.zeros((2, 3)), np.array(rows), np.zeros((4, 2)), wanted=np.array([AFFINE]), knee=KNEE
        )


def values_of(record):
    """All numbers and words of a record, those of records inside it too."""
    for field in dataclasses.fields(record):
        value = getattr(record, field.name)
        if dataclasses.is_dataclass(value):
            yield from values_of(value)
        else:
            yield field.name, value


def assert_same(found, wanted):
    assert found.findings == wanted.findings
    for ours, theirs in zip(found.images, wanted.images, strict=True):
        for (name, value), (other, expected) in zip(values_of(ours), values_of(theirs), strict=True):
            assert name == other
            if isinstance(expected, float | np.ndarray):
                assert_allclose(value, expected, rtol=1e-9, atol=1e-9, err_msg=name)
            else:
                assert value == expected
                assert type(value) is type(expected)


def changed(model, kind):
    """A model with one fault."""
    observations, images, cameras = model.observations, model.images, model.cameras
    xy, params = observations.xy_px.copy(), cameras.params.copy()
    if kind == "half a pixel":
        xy += 0.5
    if kind == "an image of another resolution":
        xy[: observations.offsets[1]] *= 0.5
    if kind == "a camera without focal length":
        params[0] = 0.0
    if kind == "no camera":
        images = dataclasses.replace(images, camera_idx=np.where(images.camera_idx == 1, -1, images.camera_idx))
    if kind == "no width":
        cameras = dataclasses.replace(cameras, width=np.where(np.arange(len(cameras)) == 2, 0, cameras.width))
    point_idx = observations.point_idx.copy()
    if kind == "few":
        point_idx[observations.offsets[3] + 19 : observations.offsets[4]] = -1
    if kind == "many behind":
        translation = images.translation_cam_from_world.copy()
        translation[2, 2] -= np.median(model.points.xyz_world[:, 2])
        images = dataclasses.replace(images, translation_cam_from_world=translation)
    return dataclasses.replace(
        model,
        cameras=dataclasses.replace(cameras, params=params),
        images=images,
        observations=dataclasses.replace(observations, xy_px=xy, point_idx=point_idx),
    )


KINDS = ("nothing", "half a pixel", "an image of another resolution", "a camera without focal length", "no camera")


@pytest.mark.parametrize("kind", [*KINDS, "no width", "few", "many behind"])
def test_a_model_is_judged_alike_on_both_paths(kind):
    model = changed(model_of(dataclasses.replace(SPEC, num_images=5)), kind)
    found = consistency_of(model, model_residuals(model))
    with numpy_only():
        assert_same(found, consistency_of(model, model_residuals(model)))


def test_panoramas_are_judged_alike_on_both_paths():
    model = model_of(dataclasses.replace(SPEC, num_images=3))
    sphere = BY_NAME["EQUIRECTANGULAR"]
    cameras = dataclasses.replace(
        model.cameras,
        model_id=np.full(len(model.cameras), sphere.model_id),
        params=np.tile([1600.0, 800.0], len(model.cameras)),
        param_offsets=2 * np.arange(len(model.cameras) + 1),
    )
    model = dataclasses.replace(model, cameras=cameras)
    found = consistency_of(model)
    assert all(image.affine is None for image in found.images)
    with numpy_only():
        assert_same(found, consistency_of(model))


@pytest.mark.parametrize("expected", [1e-9, 0.3, 0.48, 0.6, 5.0])
def test_the_median_is_found_wherever_it_is_expected(expected):
    values = np.random.default_rng(2).random(501)
    assert median_near(values, expected) == median_of(values) == np.sort(values)[250]
    assert math.isnan(median_near(np.empty(0), expected))
