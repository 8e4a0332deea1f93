"""Laws of the joint system: what must not change when the world is moved, scaled, reordered, measured otherwise."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from joint_reference import SPEC, model_of, system_of, with_poses
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from sfm_audit.audit.joint import image_gains, implied_parameters, joint_misfit, own_parameters
from sfm_audit.audit.table.words import GROUPS
from sfm_audit.loaders.model import ImageTable, ObservationTable

seeds = st.integers(0, 3)
TAU_PX = np.full(SPEC.num_images, 0.2)


@functools.cache
def scene(seed):
    return model_of(dataclasses.replace(SPEC, shared_camera=seed % 2 == 1), seed=seed)


@functools.cache
def told(seed):
    return answers(scene(seed))


def answers(model):
    """Everything that the room says: steps, tests, implied parameters."""
    system = system_of(model)
    steps = own_parameters(system)
    return system, steps, joint_misfit(system, alpha=0.5, tau_px=TAU_PX), implied_parameters(system, steps)


def assert_same(found, expected, order=None):
    """Equal but for the order of the images."""
    (system, steps, misfit, implied), (old_system, old_steps, old_misfit, old_implied) = found, expected
    order = range(len(misfit.tests)) if order is None else order
    for new, old in zip(steps, old_steps, strict=True):
        assert_allclose(new.step / old.sd, old.step / old.sd, atol=1e-5)
        assert_allclose(new.plain_step / old.sd, old.plain_step / old.sd, atol=1e-5)
        assert_allclose(new.sd, old.sd, rtol=1e-6)
        assert_allclose(new.own_step_px, old.own_step_px, rtol=1e-5, atol=1e-7)
    for new, old in zip(implied, old_implied, strict=True):
        assert new.found == old.found
        assert_allclose(new.step / old.sd, old.step / old.sd, atol=1e-4)
        assert_allclose(new.sd, old.sd, rtol=1e-5)
    for new_idx, old_idx in enumerate(order):
        assert misfit.included[new_idx] == old_misfit.included[old_idx]
        assert misfit.cause[new_idx] is old_misfit.cause[old_idx]
        (gains,), (old_gains,) = image_gains(system, [new_idx]), image_gains(old_system, [old_idx])
        assert_allclose(dataclasses.astuple(gains), dataclasses.astuple(old_gains), rtol=1e-4, atol=1e-4)
        for group in GROUPS:
            new, old = misfit.tests[new_idx][group], old_misfit.tests[old_idx][group]
            assert (new.rank, new.status) == (old.rank, old.status)
            assert_allclose(new.p, old.p, rtol=1e-4)
            assert_allclose(new.q, old.q, rtol=1e-4)
            assert_allclose(new.px, old.px, rtol=1e-4, atol=1e-6)
            assert_allclose(new.worth, old.worth, rtol=1e-3, atol=1e-7)


@settings(max_examples=6, deadline=None)
@given(seed=seeds, turn=st.integers(0, 2**32 - 1), gain=st.sampled_from([1e-3, 1.0, 250.0]))
def test_the_frame_and_the_unit_of_the_world_do_not_matter(seed, turn, gain):
    model, rng = scene(seed), np.random.default_rng(turn)
    rotation, shift = Rotation.random(rng=rng), 100.0 * rng.normal(size=3)
    points = dataclasses.replace(model.points, xyz_world=gain * (rotation.apply(model.points.xyz_world) + shift))
    quat = Rotation.from_quat(model.images.quat_cam_from_world_wxyz, scalar_first=True) * rotation.inv()
    translation = gain * (model.images.translation_cam_from_world - quat.apply(shift))
    moved = with_poses(model, quat.as_quat(scalar_first=True), translation)
    assert_same(answers(dataclasses.replace(moved, points=points)), told(seed))


@settings(max_examples=4, deadline=None)
@given(seed=seeds, order=st.permutations(range(SPEC.num_images)))
def test_the_order_of_the_images_does_not_matter(seed, order):
    model = scene(seed)
    images, observations = model.images, model.observations
    rows = [np.arange(*observations.offsets[i : i + 2]) for i in order]
    everything = np.concatenate(rows)
    picked = {
        field.name: getattr(images, field.name)[order]
        for field in dataclasses.fields(ImageTable)
        if field.name != "name" and getattr(images, field.name) is not None
    }
    shuffled = dataclasses.replace(
        model,
        images=ImageTable(**picked, name=tuple(images.name[i] for i in order)),
        observations=ObservationTable(
            np.concatenate([[0], np.cumsum([len(r) for r in rows])]).astype(np.int64),
            observations.point2d_idx[everything],
            observations.xy_px[everything],
            observations.point_idx[everything],
        ),
    )
    assert_same(answers(shuffled), told(seed), order)


@settings(max_examples=4, deadline=None)
@given(seed=seeds, data=st.data())
def test_the_order_of_the_points_does_not_matter(seed, data):
    model = scene(seed)
    order = np.random.default_rng(data.draw(st.integers(0, 2**32 - 1))).permutation(len(model.points))
    back = np.argsort(order)
    points = type(model.points)(*(getattr(model.points, f.name)[order] for f in dataclasses.fields(model.points)))
    observations = dataclasses.replace(model.observations, point_idx=back[model.observations.point_idx])
    assert_same(answers(dataclasses.replace(model, points=points, observations=observations)), told(seed))


@settings(max_examples=4, deadline=None)
@given(seed=seeds, gain=st.sampled_from([0.5, 4.0]))
def test_more_pixels_of_the_same_picture_say_the_same(seed, gain):
    """Image, keypoints, focal length and principal point times ``gain``: px scale, ranks, p and k1 do not."""
    model = scene(seed)
    cameras = model.cameras
    params = cameras.params.reshape(len(cameras), -1) * [gain, gain, gain, 1.0]
    scaled = dataclasses.replace(
        cameras,
        params=params.ravel(),
        width=(gain * cameras.width).astype(np.int64),
        height=(gain * cameras.height).astype(np.int64),
    )
    observations = dataclasses.replace(model.observations, xy_px=gain * model.observations.xy_px)
    found = answers(dataclasses.replace(model, cameras=scaled, observations=observations))
    for new, old in zip(found[1], told(seed)[1], strict=True):
        assert_allclose(new.step / new.sd, old.step * [gain, 1.0] / new.sd, atol=1e-5)
        assert_allclose(new.own_step_px, gain * old.own_step_px, rtol=1e-5, atol=1e-7)
        assert_allclose(new.sd_focal_rel, old.sd_focal_rel, rtol=1e-6)
    first = joint_misfit(found[0], alpha=1e-12, tau_px=TAU_PX)
    second = joint_misfit(told(seed)[0], alpha=1e-12, tau_px=TAU_PX)
    for new, old in zip(first.tests, second.tests, strict=True):
        for group in GROUPS:
            assert_allclose(new[group].p, old[group].p, rtol=1e-4)
            assert_allclose(new[group].px, gain * old[group].px, rtol=1e-4, atol=1e-6)


@settings(max_examples=6, deadline=None)
@given(seed=seeds, alpha=st.sampled_from([0.05, 0.5, 0.999]), tau=st.sampled_from([1e-6, 0.05, 0.2]))
def test_no_effect_exceeds_what_is_possible(seed, alpha, tau):
    system = told(seed)[0]
    found = joint_misfit(system, alpha=alpha, tau_px=np.full(SPEC.num_images, tau))
    for image, tests in enumerate(found.tests):
        for test in tests.values():
            assert np.isnan(test.px) or test.px <= 1.5 * system.observations.rms_px[image]
            assert np.isnan(test.p) or 0.0 <= test.p <= test.q <= 1.0
    assert 2 * np.count_nonzero(found.included) <= SPEC.num_images
