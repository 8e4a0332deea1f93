"""method.md sections 11 and 11b once more, slowly: every column stacked, NumPy's least squares; and models for it."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from sfm_audit.audit.engine.model import ModelAuditor
from sfm_audit.audit.inliers.projected import project_image
from sfm_audit.audit.joint import joint_system
from sfm_audit.audit.misfit.nuisance import fitted_param_idxs
from sfm_audit.audit.simulate.adjust import adjust_scene, sparse_model, true_claim
from sfm_audit.audit.simulate.noise import NoiseSpec
from sfm_audit.audit.simulate.scene import SceneSpec, simulate_scene
from sfm_audit.loaders.model import SparseModel

SPEC = SceneSpec(
    num_images=7, points_per_image=90, noise=NoiseSpec(sigma_px=0.5), min_track_length=3, max_track_length=6
)


def model_of(spec=SPEC, seed=0, *, adjusted=False):
    scene = simulate_scene(spec, np.random.default_rng(seed))
    return sparse_model(scene, adjust_scene(scene) if adjusted else true_claim(scene))


def system_of(model, **options):
    auditor = ModelAuditor(model)
    return joint_system(model, auditor.residuals, auditor.sigma_constant_px, **options)


def with_param(model: SparseModel, camera_idx, param_idx, value):
    params = model.cameras.params.copy()
    params[model.cameras.param_offsets[camera_idx] + param_idx] = value
    return dataclasses.replace(model, cameras=dataclasses.replace(model.cameras, params=params))


def with_poses(model: SparseModel, quat, translation):
    images = dataclasses.replace(model.images, quat_cam_from_world_wxyz=quat, translation_cam_from_world=translation)
    return dataclasses.replace(model, images=images)


class Stacked(NamedTuple):
    """columns: (2 n, D + 3 P) sqrt(w) [N J].    own: per camera, which columns.    y: (2 n,).    root: (2 n,) sqrt(w).

    rows: per image, of the stacked values.    point: (n,).
    """

    columns: np.ndarray
    own: list[np.ndarray]
    y: np.ndarray
    root: np.ndarray
    rows: list[slice]
    point: np.ndarray


def stacked(model: SparseModel, *, robust=True):
    auditor = ModelAuditor(model)
    residuals, sigma = auditor.residuals, auditor.sigma_constant_px
    num_images, num_points = len(model.images), len(model.points)
    y = residuals.residuals_px.T.reshape(-1)
    s = np.repeat(np.repeat(sigma, np.diff(residuals.offsets)), 2)
    length = np.repeat(np.linalg.norm(residuals.residuals_px, axis=0), 2)
    root = np.sqrt(np.minimum(1.0, 2.5 * s / length)) / s if robust else 1.0 / s
    own, start = [], 6 * num_images
    for camera in range(len(model.cameras)):
        count = len(fitted_param_idxs(model.camera(camera).model))
        own.append(np.arange(start, start + count))
        start += count
    columns = np.zeros((len(y), start + 3 * num_points))
    rows = []
    for i in range(num_images):
        image, part = model.image(i), residuals.rows(i)
        at = slice(2 * part.start, 2 * part.stop)
        rows.append(at)
        points = residuals.point_idx[part]
        projected = project_image(image.camera, image.cam_from_world(model.points.xyz_world[points]))
        columns[at, 6 * i : 6 * i + 6] = projected.pose.transpose(2, 1, 0).reshape(-1, 6)
        params = list(fitted_param_idxs(image.camera.model))
        camera = int(model.images.camera_idx[i])
        columns[at, own[camera]] = projected.d_params[params].transpose(2, 1, 0).reshape(-1, len(params))
        jacobian = residuals.point_jacobian[:, :, part].transpose(2, 0, 1).reshape(-1, 3)
        where = start + 3 * np.repeat(points, 2)[:, None] + np.arange(3)
        columns[np.arange(at.start, at.stop)[:, None], where] = jacobian
    return Stacked(columns * root[:, None], own, y * root, root, rows, residuals.point_idx)


def in_order_of(reference, observations):
    """The same with the rows of each image, and the points' numbers, as a system has them that all of them are in."""
    two = (2 * observations.source[:, None] + np.arange(2)).ravel()
    columns, y, root = reference.columns[two], reference.y[two], reference.root[two]
    return reference._replace(columns=columns, y=y, root=root, point=observations.point_idx)


def projector(columns):
    """Orthonormal basis of the columns' span; the gauge is not in it."""
    scale = np.linalg.norm(columns, axis=0)
    left, singular, _ = np.linalg.svd(columns[:, scale > 0] / scale[scale > 0], full_matrices=False)
    return left[:, singular > 1e-7]


def solved(columns, y):
    """Least-squares solution and pseudo-inverse of the normal matrix, by columns of unit length."""
    scale = np.linalg.norm(columns, axis=0)
    scale[scale == 0] = 1.0
    pinv = np.linalg.pinv(columns / scale, rcond=1e-7)
    return (pinv @ y) / scale, (pinv @ pinv.T) / scale / scale[:, None]


def with_rig(model):
    """Images 2k and 2k + 1 as one frame, the first of them at the rig's origin."""
    quat, shift = model.images.quat_cam_from_world_wxyz, model.images.translation_cam_from_world
    poses = np.tile([1.0, 0, 0, 0, 0, 0, 0], (len(quat), 1))
    turned = Rotation.from_quat(np.roll(quat, -1, axis=1))
    second = turned[1::2] * turned[::2].inv()
    poses[1::2, :4] = np.roll(second.as_quat(), 1, axis=1)
    poses[1::2, 4:] = shift[1::2] - second.apply(shift[::2])
    frame_idx = np.arange(len(quat)) // 2
    images = dataclasses.replace(model.images, frame_idx=frame_idx, pose_cam_from_rig=poses)
    return dataclasses.replace(model, images=images)
