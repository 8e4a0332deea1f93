"""What is a misfit worth? The pose and focal length of the image if the group were admitted (section 11)."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np

from sfm_audit.audit.joint.candidates import CandidateScores
from sfm_audit.audit.joint.layout import NUM_POSE
from sfm_audit.audit.joint.system import JointSystem
from sfm_audit.loaders.arrays import FloatArray, IntArray


class Worth(NamedTuple):
    """Changes of one image: rotation (degrees), centre (share of the median depth), focal length (share of f).

    rotation_deg, centre_rel >= 0; focal_rel is the largest relative change, with its sign. NaN where unknown.
    """

    rotation_deg: float
    centre_rel: float
    focal_rel: float


_AS_LARGE: Final = (
    1.0 - 1e-6
)  # of two focal lengths that change alike, in opposite directions, the first one is told of
NO_WORTH = Worth(math.nan, math.nan, math.nan)


def worth_of(
    system: JointSystem, image_idx: int, scores: CandidateScores, own: slice, root: FloatArray, *, depth: float
) -> Worth:
    """Return by how much the base moves an image when a group of its fields is admitted.

    Parameters
    ----------
    root : L of `sfm_audit.audit.joint.group_test.group_root`
    depth : of the image, `JointSystem.median_depth`

    Notes
    -----
    theta = K^+ u; the base moves by -B theta, the gauge projected out, so that a change is one against the rest of
    the model. C = -R^T t, and a left perturbation (w, t) moves it by -R^T t: |dC| = |t|.
    """
    layout = system.observations.layout
    theta = root.T @ (root @ scores.score[own])
    columns = layout.columns[image_idx]
    has_column = columns < layout.num_columns
    columns = columns[has_column]
    at = np.searchsorted(scores.support, columns)
    present = (at < scores.support.size) & (scores.support[np.minimum(at, scores.support.size - 1)] == columns)
    if not present.all():
        return NO_WORTH
    change = np.zeros((1, layout.width))
    change[0, has_column] = -scores.solution[at, own] @ theta
    return worths_of(system, np.array([image_idx]), change, np.array([depth]))[0]


def worths_of(system: JointSystem, image_idxs: IntArray, change: FloatArray, depth: FloatArray) -> list[Worth]:
    """Return the same of m images whose columns the base moves.

    Parameters
    ----------
    change : (m, C) of each image's columns        depth : (m,)
    """
    pose = (system.observations.layout.image_from_frame[image_idxs] * change[:, None, :NUM_POSE]).sum(axis=2)
    angle, shift = (np.sqrt((pose[:, part] ** 2).sum(axis=1)) for part in (slice(3), slice(3, None)))
    focal = [_focal_change(system, i, own) for i, own in zip(image_idxs.tolist(), change[:, NUM_POSE:], strict=True)]
    return [Worth(*each) for each in zip(np.degrees(angle).tolist(), (shift / depth).tolist(), focal, strict=True)]


def _focal_change(system: JointSystem, image_idx: int, change: FloatArray) -> float:
    camera_idx = int(system.observations.layout.camera_idx[image_idx])
    camera = system.model.camera(camera_idx)
    own = system.observations.layout.own_param_idxs[camera_idx]
    relative = [float(change[own.index(i)] / camera.params[i]) for i in camera.model.focal_idxs]
    largest = max(map(abs, relative), default=math.nan)
    return next((change for change in relative if abs(change) >= _AS_LARGE * largest), math.nan)
