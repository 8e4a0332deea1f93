"""What included fields do to all residuals, compiled: as if the step were taken from the start."""

from __future__ import annotations

import dataclasses
from functools import partial

import numpy as np
import pytest
from joint_reference import SPEC, model_of, system_of
from numpy.testing import assert_allclose

from sfm_audit.audit.joint import inclusion, misfit
from sfm_audit.audit.joint.banded_inverse import BandedInverse
from sfm_audit.audit.joint.inclusion import Candidate, include
from sfm_audit.audit.joint.sums import joint_sums
from sfm_audit.audit.joint.system import with_step
from sfm_audit.audit.kernels import kernels_in_use, numpy_only
from sfm_audit.audit.kernels.joint_inclusion import take_change
from sfm_audit.audit.misfit.fields import GROUP_COLUMNS
from sfm_audit.audit.table.words import MisfitGroup

pytestmark = pytest.mark.skipif(not kernels_in_use(), reason="no compiled kernels here: nothing to compare")
ROUNDS = ((3, 1), (4,))


@pytest.fixture(scope="module", params=[False, True], ids=["a camera each", "one camera"])
def system(request):
    return system_of(model_of(dataclasses.replace(SPEC, shared_camera=request.param, num_images=8), seed=4))


def grown(system):
    """The bases of two rounds."""
    base, out = system.base, []
    for images in ROUNDS:
        candidates = []
        for image in images:
            own = GROUP_COLUMNS[MisfitGroup.SMOOTH if image == 1 else MisfitGroup.ROLLING_SHUTTER]
            nuisance = partial(system.observations.nuisance, image)
            candidates.append(Candidate(image, misfit._columns_of(system, image)[:, :, own], nuisance))
        base = include(base, candidates)
        out.append(base)
    return out


def test_residuals_are_those_of_the_whole_step(system, monkeypatch):
    calls = []
    kernel = inclusion.take_change
    monkeypatch.setattr(inclusion, "take_change", lambda *given: calls.append(1) or kernel(*given))
    for base in grown(system):
        expected = with_step(base, base.step)
        assert_allclose(base.left_px, expected.left_px, atol=1e-11 * np.abs(expected.left_px).max())
        assert_allclose(base.point_step, expected.point_step, atol=1e-9 * np.abs(expected.point_step).max())
        assert np.abs(base.left_px - system.base.left_px).max() > 1e-6
    assert len(calls) == len(ROUNDS)


@pytest.mark.parametrize("at_once", [1, 10])
def test_fields_solved_for_together_are_those_of_one_after_the_other(monkeypatch, at_once):
    spec = dataclasses.replace(SPEC, num_images=60, points_per_image=60, max_neighbours=3, max_track_length=4)
    system = system_of(model_of(spec, seed=2))
    assert isinstance(system.base.inverse.main, BandedInverse)
    together = grown(system)
    monkeypatch.setattr(inclusion, "_COLUMNS_AT_ONCE", at_once)
    for one, other in zip(grown(system), together, strict=True):
        assert_allclose(one.step, other.step, atol=1e-9 * np.abs(other.step).max())
        assert_allclose(one.left_px, other.left_px, atol=1e-9 * np.abs(other.left_px).max())


def test_both_paths_include_alike(system):
    with numpy_only():
        theirs = grown(system)
    for mine, other in zip(grown(system), theirs, strict=True):
        assert_allclose(mine.left_px, other.left_px, atol=1e-9 * np.abs(other.left_px).max())
        assert_allclose(mine.step, other.step, atol=1e-8 * np.abs(other.step).max())
        assert mine.included.keys() == other.included.keys()


@pytest.mark.parametrize("scale", [1e-200, 1.0, 1e200, np.nan, np.inf])
def test_a_change_is_taken_as_numpy_would_take_it(system, scale):
    base, observations = system.base, system.observations
    rng = np.random.default_rng(1)
    sums = joint_sums(observations, base.left_px, observations.weight, base.point_inverse)
    moved = 1e-4 * rng.normal(size=(len(system.model.images), observations.layout.width))
    fields = {image: rng.normal(size=(observations.num_of(image), 2)) for image in (6, 2)}
    fields[2][0] *= scale
    steps, left = take_change(sums, moved, fields, base.point_step)
    change = np.empty_like(base.left_px)
    with np.errstate(over="ignore", invalid="ignore"):
        for image in range(len(system.model.images)):
            rows = observations.rows(image)
            own = observations.design.of(image, slice(None)) @ moved[image]
            change[rows] = own + fields.get(image, np.zeros_like(own))
        jacobian = observations.design.at(slice(None))[:, :, 3:6]
        pull = np.zeros((observations.num_points, 3))
        np.add.at(pull, observations.point_idx, np.einsum("nai,na,n->ni", jacobian, change, observations.weight))
        by_point = np.einsum("pij,pj->pi", base.point_inverse, pull)
        expected = base.left_px - (change - np.einsum("nai,ni->na", jacobian, by_point[observations.point_idx]))
    hit = observations.point_idx == observations.point_idx[observations.rows(2)][0]
    assert_allclose(left[~hit], expected[~hit], atol=1e-10)
    assert np.isfinite(left[~hit]).all()
    assert_allclose(left[hit], expected[hit], rtol=1e-9, atol=1e-10)
    assert_allclose(steps, base.point_step - by_point, rtol=1e-9, atol=1e-10)


def test_changes_of_other_images_are_an_error(system):
    base, observations = system.base, system.observations
    sums = joint_sums(observations, base.left_px, observations.weight, base.point_inverse)
    moved = np.zeros((len(system.model.images), observations.layout.width))
    with pytest.raises(ValueError, match="expected an array"):
        take_change(sums, moved[1:], {}, base.point_step)
    with pytest.raises(ValueError, match="expected an array"):
        take_change(sums, moved, {0: np.zeros((1, 2))}, base.point_step)
    with pytest.raises(ValueError, match="expected an array"):
        take_change(sums, moved, {}, base.point_step[1:])
