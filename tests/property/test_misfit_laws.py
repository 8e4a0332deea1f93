"""Laws of the misfit test, and the trap: fields must not see the observed points."""

from __future__ import annotations

import dataclasses
import inspect

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from misfit_reference import PARAMS, camera, points
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from sfm_audit.audit import misfit
from sfm_audit.audit.misfit import (
    GROUPS,
    MisfitGroup,
    candidate_fields,
    nuisance_columns,
    prepare,
    prepare_image,
    project_image,
)
from sfm_audit.loaders.model import CameraRecord

pytestmark = pytest.mark.both_paths
seeds = st.integers(0, 2**32 - 1)
models = st.sampled_from(sorted(PARAMS))


def assert_same(found, expected, *, px_gain=1.0, rtol=1e-6):
    for group in GROUPS:
        assert found[group].rank == expected[group].rank, group
        assert found[group].status is expected[group].status, group
        assert_allclose(found[group].p, expected[group].p, rtol=rtol, err_msg=group)
        assert_allclose(found[group].px, px_gain * expected[group].px, rtol=rtol, atol=1e-7 * px_gain, err_msg=group)


def drawn(seed, name, n=150):
    rng = np.random.default_rng(seed)
    return camera(name), points(rng, n), rng.standard_t(5, (2, n)) + 0.5, rng


@settings(max_examples=20, deadline=None)
@given(seed=seeds, name=models)
def test_the_frame_of_the_world_does_not_matter(seed, name):
    cam, xyz_cam, y, rng = drawn(seed, name)
    rotation, translation = Rotation.random(rng=rng).as_matrix(), 10.0 * rng.standard_normal(3)
    xyz_world = (xyz_cam - translation) @ rotation
    back = xyz_world @ rotation.T + translation
    assert_same(prepare_image(cam, back).test(y), prepare_image(cam, xyz_cam).test(y))


@settings(max_examples=20, deadline=None)
@given(seed=seeds, name=models, gain=st.sampled_from([1e-3, 0.25, 8.0, 1e4]))
def test_the_unit_of_the_world_does_not_matter(seed, name, gain):
    cam, xyz_cam, y, _ = drawn(seed, name)
    assert_same(prepare_image(cam, gain * xyz_cam).test(y), prepare_image(cam, xyz_cam).test(y))


@settings(max_examples=20, deadline=None)
@given(seed=seeds, name=models, gain=st.sampled_from([0.5, 3.0]))
def test_the_effect_scales_with_the_pixels_and_p_does_not(seed, name, gain):
    cam, xyz_cam, y, _ = drawn(seed, name)
    params = cam.params.copy()
    in_px = [*cam.model.focal_idxs, *cam.model.principal_point_idxs]
    params[in_px] *= gain
    larger = CameraRecord(1, cam.model, int(cam.width * gain), int(cam.height * gain), params)
    found, expected = prepare_image(larger, xyz_cam).test(gain * y), prepare_image(cam, xyz_cam).test(y)
    assert_same(found, expected, px_gain=gain)


@settings(max_examples=20, deadline=None)
@given(seed=seeds, name=models)
def test_order_and_sign_do_not_matter(seed, name):
    cam, xyz_cam, y, rng = drawn(seed, name)
    order = rng.permutation(len(xyz_cam))
    assert_same(prepare_image(cam, xyz_cam[order]).test(-y[:, order]), prepare_image(cam, xyz_cam).test(y))


@settings(max_examples=20, deadline=None)
@given(seed=seeds, name=models)
def test_what_the_fit_can_absorb_is_no_misfit(seed, name):
    """Moving the pose and the fitted parameters does not change the test."""
    cam, xyz_cam, y, rng = drawn(seed, name)
    projected = project_image(cam, xyz_cam)
    nuisance, fields = nuisance_columns(cam.model, projected), candidate_fields(cam, projected)
    nuisance /= np.linalg.norm(nuisance, axis=(1, 2), keepdims=True)
    absorbed = np.tensordot(20.0 * rng.standard_normal(len(nuisance)), nuisance, axes=1)
    prepared = prepare(nuisance, fields)
    assert_same(prepared.test(y + absorbed), prepared.test(y), rtol=1e-5)


@settings(max_examples=10, deadline=None)
@given(seed=seeds, name=models)
def test_same_input_same_digits(seed, name):
    cam, xyz_cam, y, _ = drawn(seed, name)
    first, second = (prepare_image(cam, xyz_cam).test(y) for _ in range(2))
    assert repr(first) == repr(second)


def rejections(cam, n, trials, *, observed):
    """Share of pure-noise images rejected at 5 %, per group; fields of the observed points or of the predicted."""
    rng = np.random.default_rng(4)
    rejected = dict.fromkeys(GROUPS, 0)
    for _ in range(trials):
        xyz_cam, y = points(rng, n), 0.5 * rng.standard_normal((2, n))
        projected = project_image(cam, xyz_cam)
        seen = dataclasses.replace(projected, xy_px=projected.xy_px + y) if observed else projected
        tests = prepare(nuisance_columns(cam.model, projected), candidate_fields(cam, seen)).test(y)
        for group in GROUPS:
            rejected[group] += tests[group].p < 0.05
    return {group: count / trials for group, count in rejected.items()}


@pytest.mark.parametrize("name", ["SIMPLE_PINHOLE", "SIMPLE_RADIAL", "OPENCV", "SIMPLE_RADIAL_FISHEYE"])
def test_fields_of_observed_points_would_reject_everything(name):
    """The trap, sprung on purpose: x_k contains the residual, and a field linear in it explains it."""
    trapped = rejections(camera(name), 400, 25, observed=True)
    assert trapped[MisfitGroup.SMOOTH] == 1.0
    if len(camera(name).model.focal_idxs) == 2:  # (v_x, 0) minus the predicted column of fx is the residual
        assert trapped[MisfitGroup.AFFINE] == 1.0
    sound = rejections(camera(name), 400, 25, observed=False)
    assert max(sound.values()) <= 0.24


def test_no_function_that_builds_columns_takes_an_observed_point():
    for function in (misfit.project_image, misfit.candidate_fields, misfit.nuisance_columns, misfit.prepare_image):
        names = set(inspect.signature(function).parameters)
        assert names <= {"camera", "model", "xyz_cam", "projected", "param_idxs", "clusters"}, function


@settings(max_examples=20, deadline=None)
@given(seed=seeds, name=models)
def test_fields_do_not_depend_on_the_residuals(seed, name):
    """Whatever was tested before: the prepared columns stay as they are."""
    cam, xyz_cam, y, rng = drawn(seed, name)
    prepared = prepare_image(cam, xyz_cam)
    before = prepared.fields.copy(), prepared.nuisance_basis.copy(), y.copy()
    prepared.test(rng.standard_normal(y.shape))
    prepared.test(y)
    for now, then in zip((prepared.fields, prepared.nuisance_basis, y), before, strict=True):
        assert (now == then).all()
