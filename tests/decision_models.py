"""Simulated models with images that are decided in many ways."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from joint_reference import with_param

from sfm_audit.audit.simulate.adjust import adjust_scene, sparse_model, true_claim
from sfm_audit.audit.simulate.defects import DefectKind, DefectSpec
from sfm_audit.audit.simulate.noise import NoiseSpec
from sfm_audit.audit.simulate.scene import SceneSpec, simulate_scene

SPEC = SceneSpec(num_images=12, points_per_image=150, noise=NoiseSpec(sigma_px=0.5))
NUM_DEFECTIVE = 3


def model_with(*defects: DefectSpec, spec=SPEC, adjusted=False):
    scene = simulate_scene(replace(spec, defects=defects), np.random.default_rng(5))
    return sparse_model(scene, adjust_scene(scene) if adjusted else true_claim(scene))


def defective(kind: DefectKind):
    values = {DefectKind.FEW_POINTS: (15.0, 1.0)}.get(kind)
    return model_with(*(DefectSpec(i, kind, 1.5, values) for i in range(NUM_DEFECTIVE)), adjusted=True)


def broken():
    """Images that cannot be projected, parts that do not fit, a frozen focal length, a pose that moved."""
    model = with_param(model_with(adjusted=True), 5, 0, 1200.0)
    images = model.images
    quat, translation = images.quat_cam_from_world_wxyz.copy(), images.translation_cam_from_world.copy()
    translation[2] = np.nan
    quat[3] = [0.5, 0.5, 0.5, 0.5]
    translation[4] += 0.02
    camera_idx = images.camera_idx.copy()
    camera_idx[7] = -1
    changed = replace(
        images, quat_cam_from_world_wxyz=quat, translation_cam_from_world=translation, camera_idx=camera_idx
    )
    return with_param(with_param(replace(model, images=changed), 6, 0, np.nan), 8, 0, 1e13)
