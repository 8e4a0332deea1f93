"""The compiled affine fits are numpy's, and what is said of a model does not depend on the path."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from joint_reference import SPEC, model_of
from numpy.testing import assert_allclose, assert_array_equal

from sfm_audit.audit.consistency import consistency_of, fit_affine, model_consistency
from sfm_audit.audit.consistency.affine import KNEE, MEDIAN_LENGTH, median_of, root_mean_square
from sfm_audit.audit.consistency.affine import _median_near as median_near
from sfm_audit.audit.consistency.image import DEFAULT_LIMITS, LinkedPoints, consistency_of_linked
from sfm_audit.audit.consistency.together import _is_clear as is_clear
from sfm_audit.audit.inliers.residuals import model_residuals
from sfm_audit.audit.kernels import kernels_in_use, numpy_only
from sfm_audit.audit.kernels.consistency import AFFINE, NOTHING, RMS, Fitted, fit_images
from sfm_audit.loaders.camera_models import BY_NAME
from sfm_audit.loaders.model import CameraTable

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


def one_by_one(model):
    """What is said where each image is asked by itself, in numpy."""
    with numpy_only():
        residuals = model_residuals(model)
        images = []
        for image_idx in range(len(model.images)):
            linked = slice(*model.observations.offsets[image_idx : image_idx + 2])
            rows = residuals.rows(image_idx)
            points = LinkedPoints(
                model.image(image_idx),
                model.observations.xy_px[linked],
                model.points.xyz_world,
                model.observations.point_idx[linked],
                residuals.observation_row[rows] - linked.start,
                residuals.residuals_px[:, rows],
                int(residuals.num_behind[image_idx]),
                int(residuals.num_unprojected[image_idx]),
            )
            images.append(consistency_of_linked(points))
    return model_consistency(images)


def _behind(model, image_idx):
    """A point behind the camera of an image."""
    image = model.image(image_idx)
    return image.rotation_cam_from_world.T @ (np.array([0.0, 0.0, -1.0]) - image.translation_cam_from_world)


def but(model, table, **changed):
    """A model with other columns in one of its tables."""
    return dataclasses.replace(model, **{table: dataclasses.replace(getattr(model, table), **changed)})


def half_a_pixel(model):
    return but(model, "observations", xy_px=model.observations.xy_px + 0.5)


def another_resolution(model):
    xy = model.observations.xy_px.copy()
    xy[: model.observations.offsets[1]] *= 0.5
    return but(model, "observations", xy_px=xy)


def no_focal_length(model):
    params = model.cameras.params.copy()
    params[0] = 0.0
    return but(model, "cameras", params=params)


def no_camera(model):
    return but(model, "images", camera_idx=np.where(model.images.camera_idx == 1, -1, model.images.camera_idx))


def no_size(model, side):
    return but(
        model, "cameras", **{side: np.where(np.arange(len(model.cameras)) == 2, 0, getattr(model.cameras, side))}
    )


def linked(model, num):
    """One image with so many links, another with none."""
    offsets, point_idx = model.observations.offsets, model.observations.point_idx.copy()
    point_idx[offsets[3] + num : offsets[4]] = -1
    point_idx[: offsets[1]] = -1
    return but(model, "observations", point_idx=point_idx)


def behind(model, image_idx, share):
    """This share of the observations of an image that have a point lie behind it."""
    xyz, point_idx = model.points.xyz_world.copy(), model.observations.point_idx
    own = point_idx[slice(*model.observations.offsets[image_idx : image_idx + 2])]
    own = own[own >= 0]
    xyz[own[: int(share * len(own))]] = _behind(model, image_idx)
    return but(model, "points", xyz_world=xyz)


def not_projected(model):
    """A point so near to the plane of a camera that COLMAP does not project it."""
    image, xyz = model.image(2), model.points.xyz_world.copy()
    quats, translation = model.images.quat_cam_from_world_wxyz.copy(), model.images.translation_cam_from_world.copy()
    quats[2], translation[2] = (1.0, 0.0, 0.0, 0.0), 0.0
    own = model.observations.point_idx[slice(*model.observations.offsets[2:4])]
    xyz[own] = image.cam_from_world(xyz[own])
    xyz[own[0]] = 0.0, 0.0, 1e-17
    return but(
        but(model, "points", xyz_world=xyz),
        "images",
        quat_cam_from_world_wxyz=quats,
        translation_cam_from_world=translation,
    )


FAULTS = {
    "nothing": lambda model: model,
    "half a pixel": half_a_pixel,
    "an image of another resolution": another_resolution,
    "a camera without focal length": no_focal_length,
    "no camera": no_camera,
    "no width": lambda model: no_size(model, "width"),
    "no height": lambda model: no_size(model, "height"),
    "one pixel wide": lambda model: but(model, "cameras", width=np.ones(len(model.cameras), dtype=np.int64)),
    "one not projected": not_projected,
    "1 linked": lambda model: linked(model, 1),
    "19 linked": lambda model: linked(model, 19),
    "20 linked": lambda model: linked(model, 20),
    "20 linked, one behind": lambda model: behind(linked(model, 20), 3, 0.05),
    "a tenth behind": lambda model: behind(model, 2, 0.1),
    "a fifth behind": lambda model: behind(model, 2, 0.25),
    "most behind": lambda model: behind(model, 1, 0.9),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_model_is_judged_as_its_images_are_one_by_one(fault):
    model = FAULTS[fault](model_of(dataclasses.replace(SPEC, num_images=6)))
    wanted = one_by_one(model)
    assert_same(consistency_of(model, model_residuals(model)), wanted)
    with numpy_only():
        assert_same(consistency_of(model, model_residuals(model)), wanted)


def test_a_model_without_cameras_is_unknown():
    model = model_of(dataclasses.replace(SPEC, num_images=3))
    none = np.empty(0, dtype=np.int64)
    cameras = CameraTable(none.astype(np.uint32), none, none, none, np.empty(0), np.zeros(1, dtype=np.int64))
    images = dataclasses.replace(model.images, camera_idx=np.full(3, -1))
    model = dataclasses.replace(model, cameras=cameras, images=images)
    assert_same(consistency_of(model), one_by_one(model))
    assert [image.num_linked for image in consistency_of(model).images] == [0, 0, 0]


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
    xy = model.observations.xy_px - model_residuals(model).residuals_px.T  # where the panorama sees them
    model = dataclasses.replace(model, observations=dataclasses.replace(model.observations, xy_px=xy + 0.3))
    found = consistency_of(model)
    assert [(image.affine, image.inconsistent) for image in found.images] == [(None, False)] * 3
    assert_same(found, one_by_one(model))


def fitted_rms(stored, rest):
    """Fits of which only lengths are known."""
    n, pairs = len(stored), np.zeros((len(stored), 2))
    maps = np.zeros((n, 2, 2))
    lengths = (np.zeros(n), np.asarray(rest), np.asarray(stored))
    return Fitted(np.ones(n, dtype=np.bool_), maps, pairs, pairs, pairs, *lengths)


def test_an_image_is_clear_below_each_limit_by_more_than_rounding():
    """1 % of 1600 px, and 20 px together with 20 times what the map leaves; of panoramas the first alone."""
    stored = np.array([15.99, 16.01, 16.0 - 1e-6, 15.99, 15.99])
    wide = np.full(5, 1600)
    flat = np.ones(5, dtype=np.bool_)
    assert is_clear(fitted_rms(stored, np.full(5, 9.0)), flat, wide, DEFAULT_LIMITS).tolist() == [
        *(True, False, False),
        *(True, True),
    ]
    rest = [1.0, 1.5, 1.24, 1.26, 0.1]
    found = is_clear(fitted_rms([19.99, 20.01, 25.0, 25.0, 20.0 - 1e-6], rest), flat, 10 * wide, DEFAULT_LIMITS)
    assert found.tolist() == [True, True, False, True, False]
    assert is_clear(fitted_rms([25.0] * 5, rest), ~flat, 10 * wide, DEFAULT_LIMITS).all()


@pytest.mark.parametrize("expected", [1e-9, 0.3, 0.48, 0.6, 5.0])
def test_the_median_is_found_wherever_it_is_expected(expected):
    values = np.random.default_rng(2).random(501)
    assert median_near(values, expected) == median_of(values) == np.sort(values)[250]
    assert math.isnan(median_near(np.empty(0), expected))
