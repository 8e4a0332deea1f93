"""The study itself: does it count right, is it reproducible, do its stand-ins do what they say?"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose

from scripts.validation.advice import advise_one, refine, with_models
from scripts.validation.bounds import all_checks, focal_ratios
from scripts.validation.frozen import Frozen, audit_frozen
from scripts.validation.page import document
from scripts.validation.plan import full_plan
from scripts.validation.rivals import biasedness
from scripts.validation.rules import best_threshold
from scripts.validation.scenes import Design, audit_images, audit_shared_camera, simulate
from scripts.validation.singles import audit_points, draw_points, exact_trials, power_trials, size_trials
from scripts.validation.study import HOLDS, VIOLATED, WITHIN_CHANCE, Check, Task, run_tasks
from sfm_audit.audit.inliers.residuals import model_residuals
from sfm_audit.audit.simulate.defects import DefectKind
from sfm_audit.audit.simulate.noise import NoiseKind
from sfm_audit.audit.simulate.scene import SceneSpec

SMALL = SceneSpec(num_images=20)
TINY = [
    Task("singles", size_trials, (NoiseKind.LAPLACE, 60, 0, 2, 1)),
    Task("power", power_trials, (DefectKind.ASPECT, 250, 0, 2, 1)),
    Task("exact", exact_trials, (DefectKind.RADIAL_K2, 0, 2, 1)),
    Task("exact", exact_trials, (DefectKind.TANGENTIAL, 0, 2, 1)),
    Task("scenes", audit_images, (Design("quarter", 3, n=60, share=0.25, scene=SMALL), 0, 1), 2.0),
    Task("scenes", audit_images, (Design("poses and corners", 7, n=90, num_poses=2, num_corners=2), 0, 1), 3.0),
    Task("cameras", audit_shared_camera, (Design("shared", 9, n=60, shared_k2=0.05, scene=SMALL), 0, 1)),
    Task("frozen", audit_frozen, (Frozen.TWO_K1, NoiseKind.GAUSSIAN, 0, 1)),
    Task("advice", advise_one, (Design("one image", 10, n=90, share=0.05, scene=SMALL), 0, 1)),
]


@pytest.mark.parametrize(
    ("hits", "trials", "outcome"),
    [(50, 1000, HOLDS), (70, 1000, HOLDS), (80, 1000, WITHIN_CHANCE), (110, 1000, VIOLATED), (0, 0, HOLDS)],
)
def test_outcomes(hits, trials, outcome):
    assert Check("claim", "cell", hits, trials, 0.015, 0.07).outcome == outcome


def test_a_bound_of_everything_leaves_nothing_to_chance():
    assert Check("claim", "cell", 99, 100, 1.0, 1.0).outcome == VIOLATED
    assert Check("claim", "cell", 1, 100, 0.0, 0.0).outcome == VIOLATED


def test_one_and_two_processes_give_the_same_page():
    one, two = run_tasks(TINY, 1), run_tasks(TINY, 2)
    for part, frame in one.items():
        pd.testing.assert_frame_equal(frame, two[part])
    pages = document(one, all_checks(one), 1)
    assert pages == document(two, all_checks(two), 1)
    text = "".join(pages.values())
    assert "nan" not in text
    assert text.count("\n## ") == 15


def test_single_images_are_fitted():
    rng = np.random.default_rng(1)
    xyz = draw_points(80, rng)
    audit = audit_points(xyz, [800.0, 600.0] + 1000.0 * xyz[:, :2] / xyz[:, 2:] + 0.5 * rng.standard_normal((80, 2)))
    assert audit.pose_offset_px < 1e-6
    assert audit.image.camera is not None
    assert abs(audit.image.camera.params[3]) < 0.01  # no distortion was put in


def test_a_larger_model_starts_as_the_same_camera_and_improves():
    scene, model, _ = simulate(Design("one image", 10, n=90, share=0.05, scene=SMALL), 2, 1)
    row = scene.defects[0].image_idx
    switched = with_models(model, {row: "OPENCV"})
    assert_allclose(model_residuals(switched).residuals_px, model_residuals(model).residuals_px, atol=1e-9)
    refined, converged = refine(switched)
    assert converged
    assert refined.camera(row).model.name == "OPENCV"
    costs = [float((model_residuals(each).residuals_px ** 2).sum()) for each in (refined, model)]
    assert costs[0] < costs[1]


def test_biasedness():
    """A normal sample has little, one-sided residuals have much; the unit does not matter; too few cannot say."""
    rng = np.random.default_rng(2)
    share = rng.random((40_000, 2))
    normal = rng.standard_normal((40_000, 2))
    assert biasedness(normal, share, 4) < 0.05
    assert_allclose(biasedness(0.1 * normal, share, 4), biasedness(normal, share, 4), rtol=1e-12)
    assert biasedness(np.abs(normal), share, 4) > 1.0
    assert math.isnan(biasedness(normal[:300], share[:300], 50))


def test_the_best_threshold_separates():
    frame = pd.DataFrame({"kind": ["none"] * 3 + ["aspect"] * 3, "x": [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]})
    assert best_threshold(frame, "x") == 3.0


def test_the_ratio_of_error_and_deviation():
    sds = {"sd_focal_px": [1.0, 2.0], "sd_focal_px_conditional": [0.5, 1.0]}
    frame = pd.DataFrame({"focal_error_px": [1.0, -2.0], **sds})
    assert focal_ratios(frame) == {"joint": 1.0, "conditional": 2.0}


def test_counts_of_nought_are_never_shortened():
    """A share of the full study leaves out images of size and power, not of the verdicts' counts."""

    def counted(share):
        names = [task.args[0].name if task.part == "scenes" else task.part for task in full_plan(1, share)]
        return {name: names.count(name) for name in ("quarter", "poses and corners", "frozen", "singles", "size")}

    whole, part = counted(1.0), counted(0.25)
    assert (whole["quarter"], whole["poses and corners"]) == (84, 42)
    for name in ("quarter", "poses and corners", "frozen"):
        assert whole[name] == part[name]
    assert part["singles"] == whole["singles"] / 4
    assert part["size"] < whole["size"] / 2


def test_the_page_is_the_script_s():
    for name in ("validation.md", "validation_details.md"):
        page = Path(__file__).resolve().parents[2] / "docs" / name
        assert "Made by `scripts/validate_statistics.py`" in page.read_text(encoding="utf-8")
