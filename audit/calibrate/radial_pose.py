"""Cameras to start from: what the *direction* from the image centre to a point says, whatever the radial lens.

A radial lens moves an image point along its direction, so rotation and sideways translation are found first (Tsai's
radial alignment constraint, five points), then depth, focal length and a division model by one linear least squares.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import poselib

from sfm_audit.loaders.arrays import BoolArray, FloatArray, IntArray

SAMPLE_SIZE: Final = 5
_SEEDS: Final = 2**31 - 1
_MOST_TRIALS: Final = 10_000


@dataclass(frozen=True, slots=True, eq=False)
class RadialPoses:
    """m poses whose translation along the optical axis is unknown, each up to a half turn about that axis.

    rotations: (m, 3, 3) camera from points.          shifts: (m, 2) translation across the axis, model units.
    """

    rotations: FloatArray
    shifts: FloatArray

    def __len__(self) -> int:
        """Poses."""
        return len(self.rotations)

    def mirrored(self, normal: FloatArray) -> RadialPoses:
        """Return the poses that see a plane through the origin in the same directions, tilted the other way.

        normal: (3,) of the plane, unit length. Depths on the plane change their sign.
        """
        reflection = np.eye(3) - 2.0 * np.outer(normal, normal)
        return RadialPoses(np.diag([1.0, 1.0, -1.0]) @ self.rotations @ reflection, self.shifts)


@dataclass(frozen=True, slots=True, eq=False)
class Starts:
    """m cameras to start from, with a division model.

    rotations: (m, 3, 3) camera from points.          translations: (m, 3) model units.
    focals_px: (m,) positive.                         divisions: (m, c) coefficients at normalised radii.
    """

    rotations: FloatArray
    translations: FloatArray
    focals_px: FloatArray
    divisions: FloatArray

    def __len__(self) -> int:
        """Cameras."""
        return len(self.rotations)

    def take(self, idxs: IntArray | BoolArray) -> Starts:
        """Return the cameras at idxs, in that order."""
        return Starts(self.rotations[idxs], self.translations[idxs], self.focals_px[idxs], self.divisions[idxs])


def robust_radial_pose(
    xy_px: FloatArray, xyz: FloatArray, threshold_px: float, rng: np.random.Generator
) -> tuple[RadialPoses, BoolArray]:
    """Find the radial pose that most directions agree with, and which (n,) do: PoseLib's RANSAC.

    xy_px: (n, 2) from the image centre.        xyz: (n, 3).        The result has one pose, or none.
    """
    options = {"max_reproj_error": threshold_px, "seed": int(rng.integers(_SEEDS)), "max_iterations": _MOST_TRIALS}
    pose, info = poselib.estimate_1D_radial_absolute_pose(xy_px, xyz, options, {})
    return _finite(pose.R[None], pose.t[None, :2]), np.array(info["inliers"], dtype=bool)


def minimal_radial_poses(xy_px: FloatArray, xyz: FloatArray, samples: IntArray) -> tuple[RadialPoses, IntArray]:
    """Return all radial poses of samples (s, 5) of the points, and the sample (m,) that each is of.

    xy_px: (n, 2) from the image centre.        xyz: (n, 3).
    """
    lines = np.column_stack([-xy_px[:, 1], xy_px[:, 0], np.zeros(len(xy_px))])
    length = np.linalg.norm(lines, axis=1)
    lines = np.divide(lines, length[:, None], out=lines, where=length[:, None] > 0.0)
    found = [poselib.p5lp_radial(lines[sample], xyz[sample]) for sample in samples]
    rows = np.repeat(np.arange(len(samples)), [len(poses) for poses in found])
    rotations = np.array([pose.R for poses in found for pose in poses]).reshape(-1, 3, 3)
    shifts = np.array([pose.t[:2] for poses in found for pose in poses]).reshape(-1, 2)
    finite = np.isfinite(rotations).all(axis=(1, 2)) & np.isfinite(shifts).all(axis=1)
    return _finite(rotations, shifts), rows[finite]


def _finite(rotations: FloatArray, shifts: FloatArray) -> RadialPoses:
    finite = np.isfinite(rotations).all(axis=(1, 2)) & np.isfinite(shifts).all(axis=1)
    return RadialPoses(rotations[finite], shifts[finite])


def complete(
    poses: RadialPoses, xy_px: FloatArray, xyz: FloatArray, num_coefficients: int, normal: FloatArray | None
) -> tuple[Starts, BoolArray]:
    """Find depth, focal length and division of every pose.

    Parameters
    ----------
    poses : m radial poses
    xy_px : (m, k, 2) from the image centre, or (1, k, 2)
    xyz : (m, k, 3) or (1, k, 3)
    num_coefficients : of the division model; k >= 2 + num_coefficients
    normal : (3,) of the plane through the origin in which the points are (nearly); None where they have depth

    Returns
    -------
    (Starts, (m,) whether the pose has one)
        A pose without one puts the points behind the camera, or needs a negative focal length.

    Notes
    -----
    With rho the length of the points' transverse coordinates, signed along the observed direction, z their depth up to
    t_z and s = r / r_0 the observed radius in units of the largest, a division model says
    r (z + t_z) = f rho (1 + c_1 s^2 + ...): linear in t_z, f, f c_1, ... (Nakano, ECCV 2016). Half a turn about the
    axis changes the sign of rho; the mirrored plane those of z, t_z and f. So one of the four has all positive;
    refining its mirror image as well has not found a better optimum on 600 small, noisy boards of 3 to 50 degrees.
    """
    in_front = _signed_radius(poses, xy_px, xyz) > 0.0
    turn = np.where(2 * np.count_nonzero(in_front, axis=1) >= in_front.shape[1], 1.0, -1.0)
    rotations = poses.rotations * np.column_stack([turn, turn, np.ones(len(turn))])[:, :, None]
    poses = RadialPoses(rotations, poses.shifts * turn[:, None])
    depth_shift, focal, coefficients = _solve(poses, xy_px, xyz, num_coefficients)
    if normal is not None:
        wrong = focal < 0.0
        rotations = np.where(wrong[:, None, None], poses.mirrored(normal).rotations, poses.rotations)
        depth_shift, focal = np.where(wrong, -depth_shift, depth_shift), np.abs(focal)
    usable = (focal > 0.0) & np.isfinite(coefficients).all(axis=1)
    starts = Starts(rotations, np.column_stack([poses.shifts, depth_shift]), focal, coefficients)
    return starts.take(usable), usable


def _signed_radius(poses: RadialPoses, xy_px: FloatArray, xyz: FloatArray) -> FloatArray:
    """Transverse coordinates along the observed directions, (m, k), model units; 0 for points at the centre."""
    transverse = xyz @ poses.rotations[:, :2].transpose(0, 2, 1) + poses.shifts[:, None, :]
    radius = np.linalg.norm(xy_px, axis=-1)
    along = np.einsum("mki,mki->mk", np.broadcast_to(xy_px, transverse.shape), transverse)
    return np.asarray(np.divide(along, radius, out=np.zeros_like(along), where=radius > 0.0))


def _solve(
    poses: RadialPoses, xy_px: FloatArray, xyz: FloatArray, num_coefficients: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Linear least squares of `complete`: t_z (m,), f (m,) and coefficients (m, c) at radii in units of f."""
    rho = _signed_radius(poses, xy_px, xyz)
    radius = np.broadcast_to(np.linalg.norm(xy_px, axis=-1), rho.shape)
    largest = radius.max(axis=1, keepdims=True)
    depth = np.einsum("mki,mi->mk", np.broadcast_to(xyz, (*rho.shape, 3)), poses.rotations[:, 2])
    s = radius / largest
    columns = np.stack([-s, *(rho * s ** (2 * power) for power in range(num_coefficients + 1))], axis=-1)
    solution = np.einsum("mck,mk->mc", np.linalg.pinv(columns), s * depth)  # f in units of the largest radius
    focal = solution[:, 1]
    with np.errstate(divide="ignore", invalid="ignore"):  # f = 0 leaves no coefficients: refused by the caller
        coefficients = solution[:, 2:] / focal[:, None] * focal[:, None] ** (2 * np.arange(1, num_coefficients + 1))
    return solution[:, 0], focal * largest[:, 0], coefficients
