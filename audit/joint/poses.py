"""How well is every pose known, and beside which others? From the joint system (method.md section 10).

Poses of a reconstruction are known up to a similarity of the whole, so that a standard deviation needs a gauge. It is
the one of an evaluation: the errors that are left after a similarity was fitted to all poses of the connected part,
least squares of rotations (rad) and of centres (units of the image's median depth), weighed alike.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy import sparse

from sfm_audit.audit.inliers.frames import cross_matrix
from sfm_audit.audit.joint.gauge import components_of
from sfm_audit.audit.joint.layout import NUM_POSE
from sfm_audit.audit.joint.normal import score_meat
from sfm_audit.audit.joint.system import JointSystem
from sfm_audit.loaders.arrays import BoolArray, FloatArray

_SINGULAR: Final = 1e-12  # of G^T N G with unit diagonal: a direction that no pose shows


@dataclass(frozen=True, slots=True, eq=False)
class PoseCovariance:
    """What is known of one image's pose; NaN where it is not known.

    covariance: (6 + q, 6 + q) of rotation about and centre along the axes of the camera (rad, median depths of the
    image), then of the camera's own parameters in their units.
    neighbour_idx: the image of another frame that shares most points with it; None without.
    relative: (6, 6) of the rotation against the neighbour and of its centre seen from this image, same units.
    """

    covariance: FloatArray
    neighbour_idx: int | None
    relative: FloatArray

    @property
    def sd_rotation_deg(self) -> float:
        """Root of the expected square of the angle of the error of the rotation, degrees."""
        return math.degrees(_length(self.covariance[:3, :3]))

    @property
    def sd_centre(self) -> float:
        """Root of the expected square of the length of the error of the centre, median depths."""
        return _length(self.covariance[3:NUM_POSE, 3:NUM_POSE])

    @property
    def sd_rotation_rel_deg(self) -> float:
        """The same of the rotation against the neighbour, degrees."""
        return math.degrees(_length(self.relative[:3, :3]))

    @property
    def sd_centre_rel(self) -> float:
        """The same of the neighbour's centre, seen from this image, median depths of this image."""
        return _length(self.relative[3:, 3:])

    @property
    def sds(self) -> FloatArray:
        """(6,) rotation about x, y, z, degrees; centre along x, y, z, median depths."""
        sd = np.sqrt(np.maximum(self.covariance.diagonal()[:NUM_POSE], 0.0))
        return np.concatenate([np.degrees(sd[:3]), sd[3:]])

    @property
    def correlation(self) -> FloatArray:
        """(6 + q, 6 + q), NaN where a standard deviation is not known or zero."""
        sd = np.sqrt(np.maximum(self.covariance.diagonal(), 0.0))
        with np.errstate(invalid="ignore", divide="ignore"):
            scaled = self.covariance / sd / sd[:, None]
        known = np.isfinite(sd) & (sd > 0)
        return np.where(known & known[:, None], scaled, np.nan)


def unknown_pose() -> PoseCovariance:
    """Return what is known of an image that takes no part."""
    nothing = np.full((NUM_POSE, NUM_POSE), np.nan)
    return PoseCovariance(nothing, None, nothing)


def _length(covariance: FloatArray) -> float:
    """Root of the trace; NaN where the gauge took all digits of it away, which would look like an exact pose."""
    trace = float(np.trace(covariance))
    return math.sqrt(trace) if math.isfinite(trace) and trace > 0 else math.nan


@dataclass(frozen=True, slots=True, eq=False)
class PoseGauge:
    """What turns a covariance C of the columns into T C T^T, T = 1 - G B^T, B = N G (G^T N G)^+.

    free: (D, g) G.    fixing: (D, g) B.    mixed: (D, g) C B.    fixed: (g, g) B^T C B.
    """

    free: FloatArray
    fixing: FloatArray
    mixed: FloatArray
    fixed: FloatArray

    @classmethod
    def of(cls, free: FloatArray, fixing: FloatArray, spread: Callable[[FloatArray], FloatArray]) -> PoseGauge:
        """Make the gauge of a covariance C; ``spread`` returns C times columns (D, g)."""
        mixed = spread(fixing)
        return cls(free, fixing, mixed, fixing.T @ mixed)

    def removed(self, errors: FloatArray) -> FloatArray:
        """Return errors of the columns (D,) without what a similarity of the whole explains: T errors."""
        return np.asarray(errors - self.free @ (self.fixing.T @ errors))

    def applied(self, covariance: FloatArray, columns: FloatArray, mixed: FloatArray) -> FloatArray:
        """Return the covariance (k, k) in the gauge; ``columns``, ``mixed``: (k, g) rows of G and of C B."""
        across = mixed @ columns.T
        return np.asarray(covariance - across - across.T + columns @ self.fixed @ columns.T)


def pose_covariances(
    system: JointSystem, image_idxs: Sequence[int], covariances: Sequence[FloatArray]
) -> list[PoseCovariance]:
    """Return what is known of the poses of some images.

    Parameters
    ----------
    covariances : `JointSystem.image_covariances` of ``image_idxs``

    Notes
    -----
    Sandwich covariances, clustered by track. With left perturbations (w, t) of camera from world an image turns by w
    about the axes of its camera, and its centre moves by -t along them (method.md (6a)).
    An image that hangs on no other, and one without columns, has NaN.
    """
    layout = system.observations.layout
    gauge = pose_gauge(system)
    alone = _alone(system)
    neighbours = _strongest(system)
    depths = {i: system.median_depth(i) for i in range(len(layout.camera_idx)) if layout.has_columns[i]}
    told = [i for i in image_idxs if layout.has_columns[i] and not alone[i]]
    beside = dict(zip(told, _relative(system, gauge, told, neighbours, depths), strict=True))
    out = []
    for image, covariance in zip(image_idxs, covariances, strict=True):
        if image not in beside:
            out.append(unknown_pose())
            continue
        columns = layout.columns[image][layout.columns[image] < layout.num_columns]
        own = np.eye(len(columns))
        own[:NUM_POSE, :NUM_POSE] = layout.image_from_frame[image]
        known = gauge.applied(covariance, own @ gauge.free[columns], own @ gauge.mixed[columns])
        unit = _units(depths[image], len(columns))
        out.append(PoseCovariance(known * unit * unit[:, None], neighbours.get(image), beside[image]))
    return out


def _units(depth: float, size: int) -> FloatArray:
    """(size,) from (w, t, own parameters) to rad, median depths of the centre, and parameters."""
    out = np.ones(size)
    out[3:NUM_POSE] = -1.0 / depth
    return out


def pose_gauge(system: JointSystem) -> PoseGauge:
    """Choose the gauge in which rotations and centres together move least."""
    layout, inverse = system.observations.layout, system.base.inverse
    free = inverse.free
    weighed = np.zeros_like(free)
    for image in np.flatnonzero(layout.has_columns).tolist():
        columns = layout.pose_of_image(image)
        unit = _units(system.median_depth(image), NUM_POSE)
        shown = unit[:, None] * (layout.image_from_frame[image] @ free[columns])
        weighed[columns] += layout.image_from_frame[image].T @ (unit[:, None] * shown)
    gram = free.T @ weighed
    scale = np.sqrt(np.maximum(gram.diagonal(), np.finfo(float).tiny))
    inner = np.linalg.pinv(gram / scale / scale[:, None], rcond=_SINGULAR, hermitian=True) / scale / scale[:, None]
    fixing = weighed @ inner
    meat = score_meat(system.observations, system.base.left_px)
    return PoseGauge.of(free, fixing, lambda columns: inverse.main.apply(meat @ inverse.main.apply(columns)))


def _seen(system: JointSystem) -> sparse.csr_array:
    """(I, P) 1 where an image sees a point in the system."""
    observations = system.observations
    shape = (len(observations.layout.camera_idx), observations.num_points)
    entry = (observations.image_idx, observations.point_idx)
    seen = sparse.coo_array((np.ones(len(observations.image_idx)), entry), shape=shape).tocsr()
    seen.data[:] = 1.0
    return seen


def _alone(system: JointSystem) -> BoolArray:
    """(I,) whether nothing but the gauge holds an image: no other frame shares a point with its part."""
    observations = system.observations
    num = len(observations.layout.camera_idx)
    if observations.points_independent:
        return np.zeros(num, dtype=bool)
    frame, label = observations.layout.frame_idx, components_of(observations)
    used = np.flatnonzero(frame >= 0)
    pairs = np.unique(np.c_[label[used], frame[used]], axis=0)
    frames = np.bincount(pairs[:, 0], minlength=1)
    return np.asarray((label < 0) | (frames[label] < 2))


def _strongest(system: JointSystem) -> dict[int, int]:
    """By image: the image of another frame that shares most points with it."""
    layout = system.observations.layout
    seen = _seen(system)
    shared = sparse.csr_array(seen @ seen.T)
    out = {}
    for image in np.flatnonzero(layout.has_columns).tolist():
        row = slice(int(shared.indptr[image]), int(shared.indptr[image + 1]))
        others, counts = shared.indices[row], shared.data[row]
        apart = (layout.frame_idx[others] != layout.frame_idx[image]) & layout.has_columns[others]
        if apart.any():
            best = counts[apart].max()
            out[image] = int(others[apart][counts[apart] == best].min())
    return out


def _relative(
    system: JointSystem, gauge: PoseGauge, image_idxs: list[int], neighbours: dict[int, int], depths: dict[int, float]
) -> list[FloatArray]:
    """(6, 6) each: of an image's strongest neighbour as the image sees it."""
    layout = system.observations.layout
    asked = [i for i in image_idxs if i in neighbours]
    blocks = [np.concatenate([layout.pose_of_image(k) for k in (i, neighbours[i])]) for i in asked]
    found = dict(zip(asked, zip(blocks, system.covariances(blocks), strict=True), strict=True))
    out = []
    for i in image_idxs:
        if i not in found:
            out.append(np.full((NUM_POSE, NUM_POSE), np.nan))
            continue
        columns, covariance = found[i]
        moves = _seen_from(system, i, neighbours[i], depths[i])
        known = gauge.applied(covariance, gauge.free[columns], gauge.mixed[columns])
        out.append(moves @ known @ moves.T)
    return out


def _seen_from(system: JointSystem, image_idx: int, other_idx: int, depth: float) -> FloatArray:
    """(6, 12) how another camera turns and moves, seen from an image, when the frames of both are perturbed.

    The rotation in the axes of the other camera, rad; its centre in those of the image, median depths.
    """
    layout = system.observations.layout
    first, second = (system.model.image(i) for i in (image_idx, other_idx))
    turn = second.rotation_cam_from_world @ first.rotation_cam_from_world.T
    centre = first.translation_cam_from_world - turn.T @ second.translation_cam_from_world
    out = np.zeros((NUM_POSE, 2 * NUM_POSE))
    out[:3, :3], out[:3, NUM_POSE : NUM_POSE + 3] = -turn, np.eye(3)
    out[3:, :3], out[3:, 3:NUM_POSE] = -cross_matrix(centre) / depth, np.eye(3) / depth
    out[3:, NUM_POSE + 3 :] = -turn.T / depth
    out[:, :NUM_POSE] = out[:, :NUM_POSE] @ layout.image_from_frame[image_idx]
    out[:, NUM_POSE:] = out[:, NUM_POSE:] @ layout.image_from_frame[other_idx]
    return out
