"""Laws of belonging together: the frame and the unit of the world do not matter, the unit of the image scales px."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from sfm_audit.audit.consistency import fit_affine, image_consistency
from sfm_audit.loaders.camera_models import BY_NAME
from sfm_audit.loaders.model import CameraRecord, ImageRecord

pytestmark = pytest.mark.both_paths
seeds = st.integers(0, 2**32 - 1)
# (observed from projected, turn of the pose in rad): sound, half a pixel, moved, half size, turned, garbage
faults = st.sampled_from(
    [
        (np.eye(2), 0.0, 0.0),
        (np.eye(2), 0.5, 0.0),
        (np.eye(2), 0.0, 0.05),
        (0.5 * np.eye(2), 0.0, 0.0),
        (np.array([[0.0, -1.0], [1.0, 0.0]]), 0.0, 0.0),
        (np.eye(2), 0.0, 2.0),
    ]
)


def case(seed, fault, n=120):
    """An image, its observed points and its points in the world."""
    linear, shift, turn = fault
    rng = np.random.default_rng(seed)
    camera = CameraRecord(1, BY_NAME["SIMPLE_PINHOLE"], 1600, 1200, np.array([1000.0, 800.0, 600.0]))
    xyz_cam = np.column_stack([rng.uniform(-3, 3, n), rng.uniform(-2, 2, n), rng.uniform(4, 10, n)])
    xy = (xyz_cam[:, :2] / xyz_cam[:, 2:] * 1000 + [800, 600]) @ linear.T + shift + 0.3 * rng.normal(size=(n, 2))
    rotation = Rotation.random(rng=rng)
    translation = rng.normal(size=3)
    xyz_world = rotation.inv().apply(xyz_cam - translation)
    moved = Rotation.from_rotvec([0.0, turn, 0.0]) * rotation
    return posed(camera, moved, translation), xy, xyz_world


def posed(camera, rotation, translation):
    return ImageRecord(1, "a.jpg", 1, camera, rotation.as_quat()[[3, 0, 1, 2]], translation, 0)


def assert_same(found, expected, *, px_gain=1.0):
    for name in ("num_linked", "share_in_front", "inconsistent", "moved", "half_pixel"):
        assert getattr(found, name) == getattr(expected, name), name
    assert (found.explanation and found.explanation.cause) == (expected.explanation and expected.explanation.cause)
    assert_allclose(found.stored_rms_px, px_gain * expected.stored_rms_px, rtol=1e-6)
    assert_allclose(found.rms_px, px_gain * expected.rms_px, rtol=1e-4)
    if expected.affine is not None:
        assert_allclose(found.affine.linear, expected.affine.linear, rtol=1e-5, atol=1e-5)
        assert_allclose(found.affine.shift_px, px_gain * expected.affine.shift_px, rtol=1e-5, atol=1e-4 * px_gain)


@settings(max_examples=30, deadline=None)
@given(seed=seeds, fault=faults, gain=st.sampled_from([1e-4, 0.3, 1e5]))
def test_the_frame_and_the_unit_of_the_world_do_not_matter(seed, fault, gain):
    image, xy, xyz_world = case(seed, fault)
    rng = np.random.default_rng(seed)
    turn, offset = Rotation.random(rng=rng), rng.normal(size=3)
    rotation = Rotation.from_matrix(image.rotation_cam_from_world)
    other = turn.apply(gain * xyz_world) + offset  # x = R X + t, X = turn^-1 (X' - offset) / gain
    turned = rotation * turn.inv()
    translation = gain * image.translation_cam_from_world - turned.apply(offset)
    found = image_consistency(posed(image.camera, turned, translation), xy, other)
    assert_same(found, image_consistency(image, xy, xyz_world))


@settings(max_examples=30, deadline=None)
@given(seed=seeds, fault=faults, gain=st.sampled_from([0.5, 4.0]))
def test_the_size_of_the_image_scales_what_is_in_px(seed, fault, gain):
    image, xy, xyz_world = case(seed, fault)
    camera = dataclasses.replace(
        image.camera,
        width=round(1600 * gain),
        height=round(1200 * gain),
        params=gain * image.camera.params,
    )
    found = image_consistency(dataclasses.replace(image, camera=camera), gain * xy, xyz_world)
    expected = image_consistency(image, xy, xyz_world)
    assert_same(dataclasses.replace(found, half_pixel=0), dataclasses.replace(expected, half_pixel=0), px_gain=gain)


@settings(max_examples=30, deadline=None)
@given(seed=seeds, fault=faults)
def test_the_order_of_the_observations_does_not_matter(seed, fault):
    image, xy, xyz_world = case(seed, fault)
    order = np.random.default_rng(seed).permutation(len(xy))
    assert_same(image_consistency(image, xy[order], xyz_world[order]), image_consistency(image, xy, xyz_world))


@settings(max_examples=30, deadline=None)
@given(seed=seeds, gain=st.floats(0.2, 5.0), turn=st.floats(-3.1, 3.1))
def test_an_exact_affine_map_is_recovered_from_any_start(seed, gain, turn):
    rng = np.random.default_rng(seed)
    projected = rng.uniform(0, 2000, (2, 60))
    linear = gain * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    offset = rng.uniform(-1000, 1000, 2)
    fit = fit_affine(projected, linear @ projected + offset[:, None] - projected)
    assert_allclose(fit.linear, linear, atol=1e-9)
    assert_allclose(fit.offset_px, offset, atol=1e-6)
    assert fit.rest_rms_px == pytest.approx(0.0, abs=1e-6)
