"""Large steps: the implied value is where bundle adjustment ends, not where one linear step ends."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from joint_reference import SPEC, model_of, with_param
from numpy.testing import assert_allclose, assert_array_equal

from sfm_audit.audit.engine.model import ModelAuditor
from sfm_audit.audit.joint import joint_system, own_parameters
from sfm_audit.audit.joint.again import _State, implied_again
from sfm_audit.loaders.model import SparseModel

SMALL = dataclasses.replace(SPEC, num_images=12, points_per_image=150)


@pytest.fixture(scope="module")
def adjusted():
    return model_of(SMALL, seed=4, adjusted=True)


def steps_of(model: SparseModel, **options):
    auditor = ModelAuditor(model)
    system = joint_system(model, auditor.residuals, auditor.sigma_constant_px, **options)
    return system, own_parameters(system)


@pytest.mark.parametrize("row", [0, 3])
def test_a_wrong_parameter_comes_back_to_where_bundle_adjustment_had_it(adjusted, row):
    change = {0: 50.0, 3: 0.06}[row]
    system, steps = steps_of(with_param(adjusted, 5, row, adjusted.camera(5).params[row] + change))
    linear = steps[5]
    found = implied_again(system, [linear])[0]
    assert (np.abs(found.implied - adjusted.camera(5).params[[0, 3]]) < 2 * linear.sd).all()
    for name in ("step", "sd", "stored"):
        assert_array_equal(getattr(found, name), getattr(linear, name))


def test_an_optimum_stays_and_independent_points_keep_the_linear_value(adjusted):
    system, steps = steps_of(adjusted)
    moved = [(a.implied - s.implied) / s.sd for a, s in zip(implied_again(system, steps), steps, strict=True)]
    assert np.abs(moved).max() < 0.2
    assert implied_again(system, []) == []
    independent, steps = steps_of(adjusted, points_independent=True)
    assert implied_again(independent, steps) == list(steps)


def test_points_in_another_order_move_by_steps_of_their_own(adjusted):
    """The system numbers points in the order of sight, whatever their rows are."""
    wrong = with_param(adjusted, 5, 0, adjusted.camera(5).params[0] + 50.0)
    order = np.random.default_rng(0).permutation(len(wrong.points))
    points = type(wrong.points)(*(getattr(wrong.points, f.name)[order] for f in dataclasses.fields(wrong.points)))
    point_idx = np.argsort(order)[wrong.observations.point_idx]
    observations = dataclasses.replace(wrong.observations, point_idx=point_idx)
    shuffled = dataclasses.replace(wrong, points=points, observations=observations)
    found, expected = (moved_points(steps_of(model)[0]) for model in (shuffled, wrong))
    assert_allclose(found, expected[order], atol=1e-6)
    assert np.abs(expected - wrong.points.xyz_world).max() > 0.1


def moved_points(system):
    base = system.base
    return (
        _State(system.model, system.residuals, system.observations, base.step, base.point_step).moved().points.xyz_world
    )
