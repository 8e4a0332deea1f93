"""A small healthy model, and where its cameras are, for tests of witnesses that look at poses."""

from __future__ import annotations

from functools import cache

import numpy as np
from scipy.spatial.transform import Rotation

from sfm_audit.audit.alignment.poses import Poses
from sfm_audit.audit.engine.model import ModelAuditor
from sfm_audit.audit.simulate.adjust import sparse_model, true_claim
from sfm_audit.audit.simulate.noise import NoiseSpec
from sfm_audit.audit.simulate.scene import SceneSpec, simulate_scene

TURN = Rotation.from_euler("zyx", [40, -70, 15], degrees=True).as_matrix()
"""Another world's turn against this one."""


@cache
def small_model():
    """Return 16 images of 120 points, cameras and points at their true places."""
    spec = SceneSpec(num_images=16, points_per_image=120, noise=NoiseSpec(sigma_px=0.5))
    scene = simulate_scene(spec, np.random.default_rng(4))
    return sparse_model(scene, true_claim(scene))


@cache
def small_auditor():
    """Return its auditor; what it measured is kept."""
    return ModelAuditor(small_model())


def poses_of(model):
    """Return the poses of a model's images."""
    return Poses.of(model.images.quat_cam_from_world_wxyz, model.images.translation_cam_from_world)
