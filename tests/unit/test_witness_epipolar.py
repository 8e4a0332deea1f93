"""Sampson distances under the model's cameras: pycolmap's, the smallest move by brute force, laws."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from numpy.testing import assert_allclose
from pair_samples import moved_image
from scipy.optimize import minimize

from sfm_audit.audit.simulate.adjust import sparse_model, true_claim
from sfm_audit.audit.simulate.matches import OwnPairs
from sfm_audit.audit.simulate.noise import NoiseSpec
from sfm_audit.audit.simulate.scene import SceneSpec, simulate_scene
from sfm_audit.audit.witnesses.epipolar import count_far, sampson_px
from sfm_audit.audit.witnesses.rays import centres, image_rays
from sfm_audit.loaders.model import rotation_from_quat

SPEC = SceneSpec(num_images=6, points_per_image=200, noise=NoiseSpec(sigma_px=0.5))


@pytest.fixture(scope="module")
def model():
    scene = simulate_scene(SPEC, np.random.default_rng(11))
    return sparse_model(scene, true_claim(scene))


def distances(model, pair, source):
    rays = [image_rays(model, i, source.keypoints_px(i)) for i in (pair.first_idx, pair.second_idx)]
    centre = centres(model)
    baseline = centre[pair.second_idx] - centre[pair.first_idx]
    first, second = (r[pair.keypoint_idx[:, k]] for k, r in enumerate(rays))
    return first, second, sampson_px(first, second, np.tile(baseline / np.linalg.norm(baseline), (len(first), 1)))


def test_without_distortion_it_is_pycolmaps_but_for_the_scale_off_the_axis(model):
    """pycolmap 4.2 takes the plane Z = 1 with one focal length; a few degrees off the axis both agree."""
    source = OwnPairs(model)
    pair = next(source.pairs())
    _, _, found = distances(model, pair, source)
    images = [model.image(i) for i in (pair.first_idx, pair.second_idx)]
    cameras = [
        pycolmap.Camera(model=i.camera.model.name, width=1600, height=1200, params=i.camera.params) for i in images
    ]
    rotation = images[1].rotation_cam_from_world @ images[0].rotation_cam_from_world.T
    translation = images[1].translation_cam_from_world - rotation @ images[0].translation_cam_from_world
    x, y, z = translation
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ rotation
    px = [source.keypoints_px(i)[pair.keypoint_idx[:, k]] for k, i in enumerate((pair.first_idx, pair.second_idx))]
    plane = [camera.cam_from_img(xy)[:, :2] for camera, xy in zip(cameras, px, strict=True)]
    focal = np.mean([camera.params[0] for camera in cameras])
    wanted = focal * np.sqrt(pycolmap.compute_squared_sampson_error(*plane, essential))
    assert_allclose(found, wanted, rtol=0.25)
    axis = np.max([np.hypot(*xy.T) for xy in plane], axis=0) < 0.3
    assert axis.sum() >= 3
    assert_allclose(found[axis], wanted[axis], rtol=0.08)


def test_it_is_the_smallest_move_of_both_points_on_the_sphere(model):
    source = OwnPairs(model)
    pair = next(source.pairs())
    first, second, found = distances(model, pair, source)
    centre = centres(model)
    b = centre[pair.second_idx] - centre[pair.first_idx]
    b /= np.linalg.norm(b)
    for k in range(3):
        w1, w2 = (r[k, :3].astype(float) for r in (first, second))
        s1, s2 = first[k, 3], second[k, 3]
        basis = [np.linalg.svd(w[None])[2][1:] for w in (w1, w2)]

        def gap(v, w1=w1, w2=w2, s1=s1, s2=s2, basis=basis):
            return b @ np.cross(w1 + v[:2] / s1 @ basis[0], w2 + v[2:] / s2 @ basis[1])

        best = minimize(lambda v: v @ v, np.zeros(4), constraints={"type": "eq", "fun": gap}, tol=1e-14)
        assert found[k] == pytest.approx(np.sqrt(best.fun), rel=1e-3, abs=1e-3)


def test_right_matches_are_as_far_off_as_the_noise(model):
    """A match has one free direction of noise: sd sigma, whatever the two cameras are."""
    source = OwnPairs(model)
    all_px = np.concatenate([distances(model, pair, source)[2] for pair in source.pairs()])
    assert np.sqrt(np.mean(all_px**2)) == pytest.approx(0.5, rel=0.05)


def test_the_world_may_be_moved_and_scaled(model):
    source = OwnPairs(model)
    turn = np.array([0.5, 0.5, -0.5, 0.5])
    images = model.images
    w, x, y, z = images.quat_cam_from_world_wxyz.T
    a, b, c, d = turn * [1, -1, -1, -1]
    quat = np.column_stack(
        [
            w * a - x * b - y * c - z * d,
            w * b + x * a + y * d - z * c,
            w * c - x * d + y * a + z * b,
            w * d + x * c - y * b + z * a,
        ]
    )
    shift = np.array([3.0, -1.0, 2.0])
    translation = 7.0 * images.translation_cam_from_world - np.einsum("nij,j->ni", rotation_from_quat(quat), shift)
    other = replace(
        model, images=replace(images, quat_cam_from_world_wxyz=quat, translation_cam_from_world=translation)
    )
    for pair in source.pairs():
        assert_allclose(distances(other, pair, source)[2], distances(model, pair, source)[2], rtol=1e-3, atol=1e-3)


def test_a_turned_camera_is_far_off_in_its_pairs_alone(model):
    source = OwnPairs(model)
    counts = count_far(moved_image(model, 2, 2.0), source, 4.0)
    share = counts.num_far / counts.num_matches
    with_it = (counts.image_idx == 2).any(axis=1)
    assert with_it.sum() >= 3
    assert (share[with_it] > 0.5).all()
    assert (share[~with_it] == 0).all()
    assert (count_far(model, source, 4.0).num_far == 0).all()


def test_the_matches_of_a_pair_are_counted_once_and_in_its_own_row(model):
    source = OwnPairs(model)
    counts = count_far(model, source, 0.0)
    pairs = list(source.pairs())
    assert counts.image_idx.tolist() == [[pair.first_idx, pair.second_idx] for pair in pairs]
    assert counts.num_matches.tolist() == counts.num_far.tolist() == [len(pair.keypoint_idx) for pair in pairs]


def test_cameras_in_one_place_have_no_epipolar_geometry(model):
    images = model.images
    still = replace(images, translation_cam_from_world=np.zeros_like(images.translation_cam_from_world))
    counts = count_far(replace(model, images=still), OwnPairs(model), 0.0)
    assert (counts.num_matches == 0).all()
    assert (counts.num_far == 0).all()


def test_no_pairs_no_counts(model):
    assert len(count_far(model, OwnPairs(model, 10**6), 1.0).image_idx) == 0
