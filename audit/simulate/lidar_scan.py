"""What a lidar measures of a point: noise and steps on the sphere about the scanner (the paper's P6 to P8)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm_audit.loaders.arrays import FloatArray


@dataclass(frozen=True, slots=True)
class LidarSpec:
    """A scanner that steps in pan (horizontal angle) and in tilt (elevation).

    pan_step_rad, tilt_step_rad: angle between neighbouring points of the scan, rad, > 0.
    sd_steps: standard deviation of a point's pan and tilt, in steps of each: the true sigma_l of method.md (1), whose
    unit is the step.
    """

    pan_step_rad: float
    tilt_step_rad: float
    sd_steps: float

    def __post_init__(self) -> None:
        if not (self.pan_step_rad > 0.0 and self.tilt_step_rad > 0.0 and self.sd_steps >= 0.0):
            raise ValueError(f"steps must be positive and the noise not negative, got {self}")


@dataclass(frozen=True, slots=True, eq=False)
class LidarScan:
    """Points as a scanner has them; row i of every array is the same point, in the frame of the true points.

    xyz: (n, 3) with noise.    pan_xyz, tilt_xyz: (n, 3) the next points of the scan, at the same range.
    """

    xyz: FloatArray
    pan_xyz: FloatArray
    tilt_xyz: FloatArray


def scan(xyz_scanner: FloatArray, spec: LidarSpec, rng: np.random.Generator) -> LidarScan:
    """Scan true points.

    Parameters
    ----------
    xyz_scanner : (n, 3) true points, any unit, in the scanner's frame: x right, y down, z ahead; none on the y axis

    Notes
    -----
    pan = atan2(x, z), tilt = atan2(y, hypot(x, z)). Both are measured with independent Gaussian noise, the range
    exactly: across a ray of the camera beside the scanner, range is not seen. A neighbour lies one step further, so
    that the image distance to it is the projected size of one step: a_x, a_y of method.md (1).
    """
    x, y, z = xyz_scanner.T
    distance = np.linalg.norm(xyz_scanner, axis=1)
    noise = spec.sd_steps * rng.standard_normal((2, len(xyz_scanner)))
    pan = np.arctan2(x, z) + spec.pan_step_rad * noise[0]
    tilt = np.arctan2(y, np.hypot(x, z)) + spec.tilt_step_rad * noise[1]
    return LidarScan(
        _on_sphere(pan, tilt, distance),
        _on_sphere(pan + spec.pan_step_rad, tilt, distance),
        _on_sphere(pan, tilt + spec.tilt_step_rad, distance),
    )


def _on_sphere(pan: FloatArray, tilt: FloatArray, distance: FloatArray) -> FloatArray:
    """(n, 3): points in the scanner's frame."""
    level = np.cos(tilt)
    return np.asarray(distance[:, None] * np.column_stack([level * np.sin(pan), np.sin(tilt), level * np.cos(pan)]))
