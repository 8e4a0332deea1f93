"""Poses that somebody printed with a few decimals are found, others are not."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sfm_audit.audit.consistency import rounded_decimals
from sfm_audit.audit.engine.findings import pose_findings
from sfm_audit.audit.simulate.adjust import sparse_model, true_claim
from sfm_audit.audit.simulate.scene import SceneSpec, simulate_scene
from sfm_audit.loaders.model import FindingCode

TURNS = np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0.5, 0.5, -0.5, 0.5], [0, 0, -1, 0]], dtype=float)


def poses(num=6, seed=0):
    rng = np.random.default_rng(seed)
    return Rotation.random(num, random_state=rng).as_quat(), rng.normal(size=(num, 3)) * 40.0


def printed(values, decimals):
    """The numbers as a text file with so many decimals has them: Python's printing, not NumPy's rounding."""
    return np.array([[float(f"{value:.{decimals}f}") for value in row] for row in values])


@pytest.mark.parametrize("decimals", range(1, 8))
@pytest.mark.parametrize("size", [1.0, 1e5])
def test_the_decimals_of_printed_poses_are_found_up_to_five(decimals, size):
    quaternions, translations = poses()
    found = rounded_decimals(printed(quaternions, decimals), printed(size * translations, decimals))
    assert found == (decimals if decimals <= 5 else None)


@pytest.mark.parametrize("part", [0, 1])
def test_one_number_that_is_not_rounded_is_enough_to_say_nothing(part):
    both = [printed(values, 3) for values in poses()]
    assert rounded_decimals(*both) == 3
    both[part][2, 1] += 1e-7
    assert rounded_decimals(*both) is None


def test_full_precision_is_not_rounded():
    assert rounded_decimals(*poses()) is None


def test_quarter_and_half_turns_are_round_by_nature():
    _, translations = poses(4)
    assert rounded_decimals(TURNS, np.round(translations)) is None


@pytest.mark.parametrize(("num", "found"), [(2, None), (3, 2)])
def test_three_images_are_needed_beside_those_that_say_nothing(num, found):
    quaternions, translations = poses(num)
    both = (
        np.concatenate([printed(quaternions, 2), TURNS]),
        np.concatenate([printed(translations, 2), np.eye(4)[:, :3]]),
    )
    assert rounded_decimals(*both) == found


def test_poses_that_are_not_finite_say_nothing():
    quaternions, translations = (printed(values, 3) for values in poses())
    translations[0, 0] = np.nan
    assert rounded_decimals(quaternions, translations) is None


def test_the_finding_says_what_half_a_step_is_worth():
    scene = simulate_scene(SceneSpec(num_images=8, points_per_image=60, shared_camera=True), np.random.default_rng(2))
    model = sparse_model(scene, true_claim(scene))
    assert not pose_findings(model)
    images = dataclasses.replace(
        model.images,
        quat_cam_from_world_wxyz=printed(model.images.quat_cam_from_world_wxyz, 3),
        translation_cam_from_world=printed(model.images.translation_cam_from_world, 3),
    )
    (finding,) = pose_findings(dataclasses.replace(model, images=images))
    assert (finding.code, finding.count) == (FindingCode.ROUNDED_POSES, 8)
    focal_px = float(model.camera(0).params[0])
    half_a_step = Rotation.from_quat([0.0005, 0.0, 0.0, 1.0])  # x, y, z, w
    x, y, z = half_a_step.apply([0.0, 0.0, 1.0])
    moved_px = focal_px * np.hypot(x, y) / z
    assert f"up to {moved_px:.2g} px" in finding.text
