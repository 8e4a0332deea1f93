"""The demo's photo collection has the planted defects that it promises, and says so in JSON."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
from scipy import stats

from sfm_audit.audit.simulate.adjust import adjust_scene, residuals_px
from sfm_audit.audit.simulate.demo import demo_scene, truth_records
from sfm_audit.audit.simulate.scene import simulate_scene


@pytest.fixture(scope="module", params=[0, 1])
def scene(request):
    return simulate_scene(demo_scene(request.param), np.random.default_rng(request.param))


def test_seven_images_are_defective(scene):
    records = truth_records(scene)
    sizes = {kind: sorted(r.size_px or 0 for r in records if r.defect == kind) for kind in {r.defect for r in records}}
    assert sizes["radial_k2"] == pytest.approx([0.3, 0.6, 1.0], rel=0.01)
    assert sizes["perturbed_pose"] == pytest.approx([1.5, 3.0], rel=0.01)
    assert sizes["few_points"] == [0, 0]
    assert len({r.image_name for r in records}) == 7
    assert all(r.image_name in scene.image_name for r in records)
    for defect in scene.defects:
        if defect.kind == "few_points":
            assert 10 <= np.diff(scene.offsets)[defect.image_idx] < 25


def test_truth_is_json(scene):
    records = [dataclasses.asdict(record) for record in truth_records(scene)]
    assert json.loads(json.dumps(records, allow_nan=False)) == records
    assert all(record["words"] for record in records)


def test_constant_noise_is_rejected_nearly_everywhere(scene):
    residuals = residuals_px(scene, adjust_scene(scene))
    p_values = []
    for i in np.flatnonzero(scene.sound):
        values = residuals[scene.offsets[i] : scene.offsets[i + 1]].ravel()
        robust = np.median(np.abs(values)) / stats.norm.ppf(0.75)
        p_values.append(min(stats.kstest(values / s, "norm").pvalue for s in (robust, values.std())))
    assert np.mean(np.array(p_values) < 0.05) > 0.9


def test_seeds_choose_other_images():
    chosen = {tuple(d.image_idx for d in demo_scene(seed).defects) for seed in range(5)}
    assert len(chosen) == 5
    assert demo_scene(3) == demo_scene(3)
    assert (demo_scene(0).num_images, demo_scene(0).points_per_image) == (40, 350)
