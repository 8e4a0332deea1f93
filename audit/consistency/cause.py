"""What an affine map from projected to observed points says about the cause."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import numpy as np

from sfm_audit.audit.cameras.projection import scale_and_shift
from sfm_audit.audit.consistency.affine import AffineFit
from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.loaders.model import CameraRecord

_MAX_FOCAL_FACTOR: Final = 1.5
_CENTRE_TOLERANCE: Final = 0.1  # of the image size: where principal points lie around the centre


class Cause(StrEnum):
    """Why the parts of an image do not belong together. A closed list; `CAUSE_MEANINGS` says what each means."""

    RESOLUTION = "resolution"
    FOCAL_LENGTH = "focal_length"
    PRINCIPAL_POINT_ZERO = "principal_point_zero"
    SHIFT = "shift"
    MIRRORED = "mirrored"
    TURNED = "turned"
    CAMERA_AXES = "camera_axes"
    INVERTED_POSES = "inverted_poses"
    QUATERNION_ORDER = "quaternion_order"
    POINT_SCALE = "point_scale"
    LINKS = "links"
    POSES = "poses"
    POSES_OR_POINTS = "poses_or_points"


CAUSE_MEANINGS: Final[dict[Cause, str]] = {
    Cause.RESOLUTION: "2D points and cameras are of different resolutions",
    Cause.FOCAL_LENGTH: "the focal length is wrong, the poses are right",
    Cause.PRINCIPAL_POINT_ZERO: "the principal point is stored as 0, or as an offset from the centre",
    Cause.SHIFT: "2D points are shifted against the camera: a crop, or another principal point",
    Cause.MIRRORED: "2D points are mirrored against the camera",
    Cause.TURNED: "2D points are turned against the camera",
    Cause.CAMERA_AXES: "y and z of the camera axes are flipped (OpenGL, Blender)",
    Cause.INVERTED_POSES: "poses are stored inverted, as world_from_cam",
    Cause.QUATERNION_ORDER: "quaternions are stored as x, y, z, w",
    Cause.POINT_SCALE: "3D points and poses are of different scales",
    Cause.LINKS: "most 2D points fit, the others are linked to points that they do not show",
    Cause.POSES: "poses are off; one step of each image's own pose brings its residuals home",
    Cause.POSES_OR_POINTS: "poses or points do not belong to the 2D points",
}


@dataclass(frozen=True, slots=True)
class Explanation:
    """A cause, in words what was found, and the numbers that exceed their limits."""

    cause: Cause
    found: str
    numbers: str = ""

    @property
    def text(self) -> str:
        """One line for people."""
        return f"{self.found} ({self.numbers})" if self.numbers else self.found


def affine_cause(fit: AffineFit, camera: CameraRecord, tolerance_px: float) -> Explanation | None:
    """Read A and b; None where they follow no pattern, A = 1 and b = 0 included.

    Parameters
    ----------
    tolerance_px : how far a pattern's points may lie from the fit's, anywhere in the image
    """
    size = np.array([camera.width, camera.height], dtype=np.float64)
    exchanged = abs(fit.linear[0, 1]) + abs(fit.linear[1, 0]) > abs(fit.linear[0, 0]) + abs(fit.linear[1, 1])
    axes = np.array([1, 0]) if exchanged else np.array([0, 1])  # which projected axis becomes x, which y
    factors = fit.linear[[0, 1], axes]
    other = np.abs(fit.linear[[1, 0], axes]) * size[axes]  # px at the far edge that the pattern leaves unexplained
    if not (other <= tolerance_px).all():
        return None
    if exchanged or (factors < 0).any():
        return _turned_or_mirrored(fit.offset_px, factors, exchanged=exchanged)
    return _upright(fit, factors, camera, tolerance_px)


def _turned_or_mirrored(offset_px: FloatArray, factors: FloatArray, *, exchanged: bool) -> Explanation:
    """One sign per axis, axes exchanged or not."""
    x, y = ("y", "x") if exchanged else ("x", "y")
    map_text = f"x_observed = {_line(offset_px[0], factors[0], x)}, y_observed = {_line(offset_px[1], factors[1], y)}"
    negative = int(np.count_nonzero(factors < 0))
    if exchanged and negative == 1:
        degrees = 90 if factors[0] < 0 else 270
        return Explanation(Cause.TURNED, f"2D points are turned by {degrees} degrees against the camera: {map_text}")
    if not exchanged and negative == 2:
        return Explanation(Cause.TURNED, f"2D points are turned by 180 degrees against the camera: {map_text}")
    if exchanged:
        return Explanation(Cause.MIRRORED, f"x and y of the 2D points are exchanged: {map_text}")
    axis = "x" if factors[0] < 0 else "y"
    return Explanation(Cause.MIRRORED, f"2D points are mirrored in {axis}: {map_text}")


def _upright(fit: AffineFit, factors: FloatArray, camera: CameraRecord, tolerance_px: float) -> Explanation | None:
    """A = diag(s_x, s_y) > 0: a shift, another resolution or another focal length."""
    size = np.array([camera.width, camera.height], dtype=np.float64)
    principal_point = np.array(scale_and_shift(camera.model, camera.params)[2:])
    offset = fit.offset_px

    def close(px: FloatArray) -> bool:
        return bool((np.abs(px) <= tolerance_px).all())

    if close((factors - 1.0) * size):
        if close(offset):
            return None
        shift = f"2D points are shifted by ({_px(fit.shift_px[0])}, {_px(fit.shift_px[1])}) px against the camera"
        at_corner = close(principal_point) and bool((np.abs(offset - 0.5 * size) <= _CENTRE_TOLERANCE * size).all())
        if at_corner:
            x, y = principal_point
            return Explanation(
                Cause.PRINCIPAL_POINT_ZERO, f"{shift}, whose principal point is stored as ({x:g}, {y:g})"
            )
        return Explanation(Cause.SHIFT, shift)
    factor = (
        f"{factors[0]:.3f}" if close((factors - factors.mean()) * size) else f"({factors[0]:.3f}, {factors[1]:.3f})"
    )
    if close(offset):
        return Explanation(Cause.RESOLUTION, f"2D points are {factor} x what the camera says: one resolution is wrong")
    about = (1.0 - factors) * principal_point
    near_one = bool((factors <= _MAX_FOCAL_FACTOR).all() and (factors >= 1.0 / _MAX_FOCAL_FACTOR).all())
    if close(offset - about) and near_one:
        wrong = f"{1.0 / factors.mean():.3f}"
        text = f"2D points are {factor} x projected about the principal point: focal length wrong by a factor {wrong}"
        return Explanation(Cause.FOCAL_LENGTH, text)
    where = f"{factor} x projected + ({_px(offset[0])}, {_px(offset[1])}) px"
    return Explanation(Cause.RESOLUTION, f"2D points are {where}: resized, or resized and cropped")


def _px(value: float) -> str:
    """One decimal; no minus before zero."""
    return f"{round(float(value), 1) + 0.0:.1f}"


def _line(offset: float, factor: float, axis: str) -> str:
    """``offset - factor axis_projected`` in words."""
    size = "" if abs(abs(factor) - 1.0) < 5e-3 else f"{abs(factor):.4g} "
    term = f"{size}{axis}_projected"
    if factor < 0:
        return f"{offset:.1f} - {term}"
    return term if abs(offset) < 0.5 else f"{term} + {offset:.1f}"
