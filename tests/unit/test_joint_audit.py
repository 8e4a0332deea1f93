"""The door of the room: exclusions, blocks, and what is said of frozen parameters."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from joint_reference import SPEC, model_of, system_of, with_param
from numpy.testing import assert_allclose

from sfm_audit.audit.engine.model import ModelAuditor
from sfm_audit.audit.joint import CameraStep, audit_jointly, covisible_blocks, implied_parameters, own_parameters
from sfm_audit.audit.joint.own import _implied_focal
from sfm_audit.audit.table.words import MisfitStatus

CHAIN = dataclasses.replace(SPEC, num_images=30, points_per_image=150, max_neighbours=6)


@pytest.fixture(scope="module")
def chain():
    return model_of(CHAIN, seed=2)


def audited(model, **options):
    auditor = ModelAuditor(model)
    tau_px = np.full(len(model.images), 0.2)
    return audit_jointly(model, auditor.residuals, auditor.sigma_constant_px, alpha=0.05, tau_px=tau_px, **options)


def test_blocks_cover_every_image_once_within_their_size(chain):
    residuals = ModelAuditor(chain).residuals
    blocks = covisible_blocks(chain, residuals, 120)
    assert len(blocks) > 2
    assert (np.sum([b.core for b in blocks], axis=0) == 1).all()
    for block in blocks:
        assert (block.members >= block.core).all()
        assert 8 * block.members.sum() <= 120
        assert block.members.sum() > block.core.sum()
    assert len(covisible_blocks(chain, residuals, 240)) == 1


def test_frames_are_not_cut_by_blocks(chain):
    frames = np.arange(30) // 3
    for block in covisible_blocks(chain, ModelAuditor(chain).residuals, 120, frames):
        assert (block.core.reshape(10, 3).any(axis=1) == block.core.reshape(10, 3).all(axis=1)).all()


def test_images_without_columns_take_no_room_in_a_block(chain):
    """Twenty of thirty images could not have columns: what is left fits one block, and everybody is answered for."""
    residuals = ModelAuditor(chain).residuals
    usable = np.arange(30) % 3 == 0
    assert len(covisible_blocks(chain, residuals, 80, usable=usable)) == 1
    blocks = covisible_blocks(chain, residuals, 40, usable=usable)
    assert len(blocks) > 1
    assert (np.sum([b.core for b in blocks], axis=0) == 1).all()
    assert len(covisible_blocks(chain, residuals, 1, usable=np.zeros(30, dtype=bool))) == 1


def test_blocks_say_nearly_what_one_system_says(chain):
    whole, parts = audited(chain), audited(chain, max_columns=160)
    assert whole.num_blocks == 1
    assert parts.num_blocks > 1
    assert [s.camera_idx for s in parts.steps] == [s.camera_idx for s in whole.steps]
    sd = np.array([s.sd for s in whole.steps])
    assert np.median(np.array([s.sd for s in parts.steps]) / sd) == pytest.approx(1.0, abs=0.35)
    moved = (np.array([s.step for s in parts.steps]) - np.array([s.step for s in whole.steps])) / sd
    assert np.abs(moved).max() < 3.0
    assert len(parts.misfit.tests) == len(parts.covariances) == len(parts.gains) == 30
    assert not (parts.misfit.effect_px > 0.2).any()
    assert all(np.isfinite(c).all() and c.shape == (8, 8) for c in parts.covariances)


def test_a_frozen_focal_length_is_named_with_its_value_and_its_image_alone_is_excluded(chain):
    stored = chain.cameras.params[chain.cameras.param_offsets[5]]
    found = audited(with_param(chain, 5, 0, 1.03 * stored))
    material = [step.camera_idx for step in found.steps if step.is_material(0.2)]
    assert material == [5]
    assert found.steps[5].names == ("f", "k")
    assert_allclose(found.steps[5].implied[0], stored, atol=5 * found.steps[5].sd[0])
    assert np.flatnonzero(found.excluded).tolist() == [5]
    assert {test.status for test in found.misfit.tests[5].values()} == {MisfitStatus.EXCLUDED}
    assert not (found.misfit.effect_px > 0.2).any()


def test_if_most_are_excluded_nobody_is(chain):
    excluded = np.arange(30) < 16
    found = audited(chain, excluded=excluded)
    assert np.isfinite(found.misfit.effect_px).all()
    half = audited(chain, excluded=np.arange(30) < 15)
    assert np.flatnonzero(np.isnan(half.misfit.effect_px)).tolist() == list(range(15))


@pytest.mark.parametrize(("true", "depth"), [(0.926, 0.926), (1.08, 1.08), (1.26, 1.0), (0.9, 1.0)])
def test_implied_focal_undoes_the_linearisation(true, depth):
    """Gauss-Newton in f and Z at points of small relief d around Z, against the truth."""
    d = np.linspace(-1e-3, 1e-3, 5)
    target, here = true / (depth + d), 1.0 / (1.0 + d)
    step, _, *_ = np.linalg.lstsq(np.stack([here, -here / (1.0 + d)], axis=1), target - here, rcond=None)[0], None
    assert _implied_focal(1000.0, 1000.0 * step[0], step[1]) == pytest.approx(1000.0 * true, rel=2e-3)


def test_implied_focal_without_an_answer_is_the_linear_one():
    assert _implied_focal(1000.0, 900.0, 1.9) == 1900.0


@pytest.mark.parametrize(
    ("changes", "material"),
    [
        ({}, True),
        ({"own_step_px": 0.19}, False),
        ({"plain_step_px": 0.19}, False),
        ({"plain_step": np.array([-60.0, 0.0])}, False),
        ({"plain_step": np.array([4.9, 0.0])}, False),
        ({"step": np.array([4.9, 0.0])}, False),
        ({"sd": np.array([np.nan, 1.0])}, False),
    ],
)
def test_a_step_is_material_if_both_say_so(changes, material):
    step = CameraStep(
        camera_idx=0,
        image_idxs=np.arange(3),
        num_observations=100,
        names=("f", "k"),
        stored=np.array([1000.0, 0.0]),
        step=np.array([50.0, 0.0]),
        sd=np.array([1.0, 1.0]),
        plain_step=np.array([60.0, 0.0]),
        own_step_px=0.21,
        plain_step_px=0.21,
        sd_focal_rel=0.001,
        focal_identified=True,
        implied=np.array([1050.0, 0.0]),
        correlation=np.eye(2),
        sigma_px=0.5,
    )
    assert dataclasses.replace(step, **changes).is_material(0.2) is material


def test_a_model_without_usable_images_says_nothing(chain):
    found = audited(chain, left_out=np.ones(30, dtype=bool))
    assert found.steps == ()
    assert found.implied == []
    assert np.isnan(found.misfit.effect_px).all()
    assert not found.misfit.most_are_wrong
    assert all(np.isnan(gains.both) for gains in found.gains)


@pytest.mark.parametrize("excluded", [(), (3,)])
def test_implied_parameters_are_the_same_whether_asked_for_alone_or_beside_the_misfit(chain, excluded):
    """A camera whose only image is not tested is asked for on its own."""
    found = audited(chain, excluded=np.isin(np.arange(30), excluded)).implied
    system = system_of(chain)
    alone = implied_parameters(system, own_parameters(system))
    assert [(one.parameter, one.camera_idx, one.found) for one in found] == [
        (one.parameter, one.camera_idx, one.found) for one in alone
    ]
    for one, other in zip(found, alone, strict=True):
        assert one.image_idxs.tolist() == other.image_idxs.tolist()
        assert_allclose(one.step, other.step, rtol=1e-6)
        assert_allclose(one.sd, other.sd, rtol=1e-6)
        assert one.px == pytest.approx(other.px, rel=1e-6)
