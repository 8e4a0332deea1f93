"""What a model is measured in and where its origin lies is nobody's fault: verdicts do not change with either.

The demo's scene, smaller: sound images, a missing distortion term, moved poses, points in a corner.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sfm_audit.audit.engine.model import audit_model
from sfm_audit.audit.simulate.adjust import adjust_scene, sparse_model
from sfm_audit.audit.simulate.demo import demo_scene
from sfm_audit.audit.simulate.scene import simulate_scene

pytestmark = pytest.mark.both_paths
WORDS = ("verdict", "reasons", "severity", "misfit_group", "num_inliers", "num_behind", "num_nonfinite")


@pytest.fixture(scope="module")
def model():
    spec = demo_scene(0)
    kept = 14
    defects = [replace(defect, image_idx=i) for i, defect in enumerate(spec.defects[:2] + spec.defects[3:6])]
    spec = replace(spec, num_images=kept, points_per_image=150, defects=tuple(defects))
    scene = simulate_scene(spec, np.random.default_rng(0))
    return sparse_model(scene, adjust_scene(scene))


@pytest.fixture(scope="module")
def expected(model):
    words = words_of(model)
    assert {"accepted", "rejected"} <= set(words["verdict"])
    return words


def words_of(model):
    images = audit_model(model).images
    return {name: images[name].to_pylist() for name in images.column_names if name.startswith(WORDS)}


def moved(model, scale, shift):
    """The world times ``scale``, then its origin ``shift`` units away: X' = s X + d, t' = s t - R d."""
    images, points = model.images, model.points
    rotation = np.array([model.image(i).rotation_cam_from_world for i in range(len(images))])
    translation = scale * images.translation_cam_from_world - rotation @ np.full(3, shift)
    return replace(
        model,
        images=replace(images, translation_cam_from_world=translation),
        points=replace(points, xyz_world=scale * points.xyz_world + shift),
    )


@pytest.mark.parametrize(("scale", "shift"), [(1e-12, 0.0), (1e-6, 0.0), (1e6, 0.0), (1e9, 0.0), (1.0, 1e6)])
def test_verdicts_do_not_depend_on_unit_and_origin(model, expected, scale, shift):
    assert words_of(moved(model, scale, shift)) == expected
