"""Moves of the whole world that no observation sees: seven per connected component (method.md section 11)."""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from sfm_audit.audit.joint.layout import NUM_POSE
from sfm_audit.audit.joint.observations import JointObservations
from sfm_audit.audit.kernels.joint_parts import components
from sfm_audit.loaders.arrays import FloatArray, IntArray
from sfm_audit.loaders.model import SparseModel, rotation_from_quat

NUM_GAUGE = 7


def gauge_directions(model: SparseModel, observations: JointObservations) -> FloatArray:
    """Return (D, 7 c): world translations, rotations and scale of each of the c connected components.

    With left perturbations and points that follow: translation d: t_i = -R_i d; rotation w about the centre of the
    component: w_i = -R_i w, t_i = (R_i w) x t_i; scale: t_i. Independent points hold the world: no direction is free.
    A frame of several images takes them from its first image; whether a rig allows the direction (a known baseline
    leaves no scale) is for the caller to see from S.
    """
    layout = observations.layout
    if observations.points_independent:
        return np.zeros((layout.num_columns, 0))
    label = components_of(observations)
    out = []
    for component in np.unique(label[label >= 0]).tolist():
        images = np.flatnonzero(label == component)
        out.append(_of_component(model, observations, images))
    return np.hstack(out) if out else np.zeros((layout.num_columns, 0))


def components_of(observations: JointObservations) -> IntArray:
    """(I,) component of each image with columns, -1 for the others."""
    layout = observations.layout
    num_images, num_points = len(layout.camera_idx), observations.num_points
    used = np.flatnonzero(layout.has_columns)
    together = np.arange(num_images)
    together[used] = used[np.unique(layout.frame_idx[used], return_index=True)[1]][layout.frame_idx[used]]
    label = components(observations.index, together)
    if label is None:
        num_nodes = num_images + num_points
        first = np.concatenate([observations.image_idx, used])
        second = np.concatenate([num_images + observations.point_idx, together[used]])
        edges = sparse.coo_array((np.ones(first.size, dtype=np.int8), (first, second)), shape=(num_nodes, num_nodes))
        label = connected_components(edges.tocsr(), directed=False)[1][:num_images].astype(np.int64)
    return np.where(layout.has_columns, label, -1)


def _of_component(model: SparseModel, observations: JointObservations, images: IntArray) -> FloatArray:
    layout = observations.layout
    rotation = rotation_from_quat(model.images.quat_cam_from_world_wxyz[images])
    shift = model.images.translation_cam_from_world[images]
    centres = -np.einsum("iba,ib->ia", rotation, shift)
    shift = shift + rotation @ np.median(centres, axis=0)  # coordinates far from zero would cost digits
    out = np.zeros((layout.num_columns, NUM_GAUGE))
    _, first = np.unique(layout.frame_idx[images], return_index=True)
    rotation, shift, chosen = rotation[first], shift[first], images[first]
    own = np.zeros((first.size, NUM_POSE, NUM_GAUGE))
    own[:, 3:, :3] = own[:, :3, 3:6] = -rotation
    own[:, 3:, 3:6] = np.cross(rotation, shift[:, :, None], axis=1)
    own[:, 3:, 6] = shift
    out[layout.columns[chosen, :NUM_POSE]] = np.linalg.solve(layout.image_from_frame[chosen], own)
    return out
