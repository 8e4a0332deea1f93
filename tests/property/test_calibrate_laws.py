"""What must not matter to an estimator: frame and unit of the world, order of the points, size of a pixel."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from calibrate_samples import DIVISION, FORWARD, LENS, SIZE, board, room
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from sfm_audit.audit.calibrate.camera import Distortion
from sfm_audit.audit.calibrate.estimators import ESTIMATORS, estimator
from sfm_audit.loaders.correspondences.records import Correspondences

seeds = st.integers(0, 2**32 - 1)
names = st.sampled_from(["D1", "D3", "pnprf", "colmap"])


def drawn(name, seed, is_board):
    rng = np.random.default_rng(seed)
    made = board(LENS[name], rng, 12.0, half=0.7, num_per_side=7) if is_board else room(LENS[name], rng)
    return made[0], ESTIMATORS[name](made[0], np.random.default_rng(seed)), rng


def assert_same(found, expected, focal_gain=1.0):
    sd = expected.covariance.sd_of("f")
    assert (found.inliers == expected.inliers).all()
    assert abs(found.camera.focal_px[0] / focal_gain - expected.camera.focal_px[0]) < 0.02 * sd
    assert_allclose(found.residuals_px / focal_gain, expected.residuals_px, atol=0.02)
    assert_allclose(found.covariance.sd_of("f") / focal_gain, sd, rtol=0.02)


@settings(max_examples=15, deadline=None)
@given(name=names, seed=seeds, is_board=st.booleans(), gain=st.sampled_from([1e-3, 1.0, 1e4]))
def test_the_frame_and_the_unit_of_the_world_do_not_matter(name, seed, is_board, gain):
    correspondences, expected, rng = drawn(name, seed, is_board)
    rotation, shift = Rotation.random(rng=rng).as_matrix(), 100.0 * rng.standard_normal(3)
    moved = replace(correspondences, xyz_world=gain * (correspondences.xyz_world @ rotation.T + shift))
    found = ESTIMATORS[name](moved, np.random.default_rng(0))
    assert_same(found, expected)
    assert_allclose(
        found.xyz_cam(moved.xyz_world) / gain, expected.xyz_cam(correspondences.xyz_world), rtol=1e-3, atol=1e-2
    )


@settings(max_examples=15, deadline=None)
@given(name=names, seed=seeds, is_board=st.booleans())
def test_the_order_of_the_points_does_not_matter(name, seed, is_board):
    correspondences, expected, rng = drawn(name, seed, is_board)
    order = rng.permutation(correspondences.num)
    shuffled = Correspondences(SIZE, SIZE, correspondences.xy_px[order], correspondences.xyz_world[order])
    found = ESTIMATORS[name](shuffled, np.random.default_rng(1))
    back = np.argsort(order)
    assert_same(replace(found, inliers=found.inliers[back], residuals_px=found.residuals_px[back]), expected)


@settings(max_examples=10, deadline=None)
@given(name=names, seed=seeds, is_board=st.booleans(), gain=st.sampled_from([0.5, 3.0]))
def test_the_size_of_a_pixel_does_not_matter(name, seed, is_board, gain):
    correspondences, expected, _ = drawn(name, seed, is_board)
    size = int(gain * SIZE)
    scaled = Correspondences(size, size, gain * correspondences.xy_px, correspondences.xyz_world)
    found = estimator(name, threshold_px=5.0 * gain)(scaled, np.random.default_rng(0))
    assert_same(found, expected, gain)
    assert_allclose(found.camera.coefficients, expected.camera.coefficients, atol=0.02)


@settings(max_examples=8, deadline=None)
@given(name=names, seed=seeds, is_board=st.booleans())
def test_the_same_seed_gives_the_same_estimate(name, seed, is_board):
    correspondences, first, _ = drawn(name, seed, is_board)
    again = ESTIMATORS[name](correspondences, np.random.default_rng(seed))
    assert first.camera.focal_px == again.camera.focal_px
    assert (first.residuals_px == again.residuals_px).all()
    assert (first.translation_cam_from_world == again.translation_cam_from_world).all()


@settings(max_examples=50, deadline=None)
@given(
    distortion=st.sampled_from(list(Distortion)),
    k=st.tuples(st.floats(-0.4, 0.4), st.floats(-0.1, 0.1), st.floats(-0.02, 0.02)),
    r=st.floats(0.0, 1.5),
)
def test_undistortion_is_the_way_back_before_the_fold(distortion, k, r):
    camera = replace(FORWARD if distortion is Distortion.FORWARD else DIVISION, coefficients=np.array(k))
    assume(r < 0.98 * camera.fold_radius)
    xyz = np.array([[0.6 * r, -0.8 * r, 1.0]])
    assert_allclose(camera.undistort(camera.project(xyz).xy_px.T), xyz[:, :2], atol=1e-7)


def test_battery_is_complete():
    assert sorted(LENS) == sorted(ESTIMATORS)
    with pytest.raises(TypeError):
        ESTIMATORS["other"] = ESTIMATORS["D1"]
