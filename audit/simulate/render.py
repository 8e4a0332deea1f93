"""Photographs of a checkerboard, and the corners that OpenCV finds in them. Needs the extra ``calibrate``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from scipy.interpolate import RectBivariateSpline
from scipy.special import erf, ndtr

from sfm_audit.audit.calibrate.camera import CalibratedCamera
from sfm_audit.audit.simulate.board_pose import BoardPose
from sfm_audit.loaders.arrays import BoolArray, Float32Array, FloatArray, IntArray, UInt8Array

_KNOT_PX: Final = 16.0  # of the spline through the rays of pixels: exact to 1e-7
_REACH_SD: Final = 5.0  # of the blur: further from an edge a pixel sees one side only
_HALF: Final = np.sqrt(0.5)
_HALF_WINDOW_PX: Final = 5
_MIN_HALF_WINDOW_PX: Final = 2
_WINDOW_SHARE: Final = 0.45  # of the distance to the next corner
_SMOOTHING_PX: Final = 1.0  # before the detector, which takes differences of neighbouring pixels
_START_PX: Final = 0.5  # the detector starts that far off, uniformly
_LOST_PX: Final = 0.5
_CRITERIA: Final = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-4)


class DetectorError(Exception):
    """Corners that the detector did not find; the message is one line with their number."""


@dataclass(frozen=True, slots=True)
class PhotoSpec:
    """How a photograph is taken; with the defaults the detector errs by 0.03 px, the paper's figure.

    black, white, ground: grey values, 0..255, of the squares and around the board.
    blur_px: sd of what a point becomes, optics and the pixel's area together.    noise_grey: sd of a pixel's noise.
    """

    black: float = 40.0
    white: float = 210.0
    ground: float = 125.0
    blur_px: float = 0.8
    noise_grey: float = 3.75


@dataclass(frozen=True, slots=True, eq=False)
class BoardPainter:
    """Photographs boards through one camera.

    rays: (2, height, width) undistorted normalised point of each pixel's centre; does not depend on the board.
    """

    rays: Float32Array
    num_corners: int
    photo: PhotoSpec

    @classmethod
    def of(cls, camera: CalibratedCamera, num_corners: int, photo: PhotoSpec | None = None) -> BoardPainter:
        """Undistort the pixels of a camera, once for all boards; ValueError where a pixel has no ray."""
        x, y = (np.arange(0.0, size + _KNOT_PX, _KNOT_PX) for size in (camera.width, camera.height))
        knots = np.stack(np.meshgrid(x, y), axis=-1)
        undistorted = camera.undistort(knots.reshape(-1, 2)).reshape(knots.shape)
        if not np.isfinite(undistorted).all():
            raise ValueError(f"the distortion {camera.coefficients} folds inside the image")
        columns, rows = np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5
        rays = np.stack([RectBivariateSpline(y, x, undistorted[..., axis])(rows, columns) for axis in (0, 1)])
        return cls(rays.astype(np.float32), num_corners, photo or PhotoSpec())

    def photograph(self, pose: BoardPose, rng: np.random.Generator) -> UInt8Array:
        """Render one board.

        Returns
        -------
        UInt8Array
            (height, width) grey values: the board under a Gaussian blur, exact for straight edges, with noise, rounded.
        """
        photo = self.photo
        squares = _apply(self._squares_from_ray(pose), self.rays)
        reach = photo.blur_px * _REACH_SD / corner_distance_px(pose.xy_px, self.num_corners)
        grey = self._sharp(squares)
        rows, columns = np.nonzero(self._is_near_edge(squares, reach))
        grey[rows, columns] = self._blurred(squares, rows, columns)
        grey += np.float32(photo.noise_grey) * rng.standard_normal(grey.shape, dtype=np.float32)
        return np.asarray(np.clip(np.rint(grey), 0, 255), dtype=np.uint8)  # a sensor saturates

    def _squares_from_ray(self, pose: BoardPose) -> Float32Array:
        """(3, 3): from (u, v, 1) to the board's plane, in squares from the outer corner of the first."""
        rotation = pose.rotation_cam_from_world
        ray_from_board = np.column_stack([rotation[:, 0], rotation[:, 1], pose.translation_cam_from_world])
        per_unit, middle = self.num_corners - 1, 0.5 * (self.num_corners + 1)
        squares_from_board = np.array([[per_unit, 0.0, middle], [0.0, per_unit, middle], [0.0, 0.0, 1.0]])
        return (squares_from_board @ np.linalg.inv(ray_from_board)).astype(np.float32)

    def _sharp(self, squares: Float32Array) -> Float32Array:
        """Grey values of points (2, ...) of the board's plane, in squares; the first square is black."""
        inside = np.all((squares >= 0.0) & (squares < self.num_corners + 1), axis=0)
        is_white = np.floor(squares).astype(np.int32).sum(axis=0) % 2 == 1
        black, white, ground = np.array([self.photo.black, self.photo.white, self.photo.ground], dtype=np.float32)
        return np.asarray(np.where(inside, np.where(is_white, white, black), ground))

    def _is_near_edge(self, squares: Float32Array, reach: float) -> BoolArray:
        """Whether an edge of a square is within ``reach``, in squares."""
        near = np.any(np.abs(squares - np.rint(squares)) < reach, axis=0)
        return np.asarray(near & np.all((squares > -reach) & (squares < self.num_corners + 1 + reach), axis=0))

    def _blurred(self, squares: Float32Array, rows: IntArray, columns: IntArray) -> FloatArray:
        """Grey values of pixels near edges: means under a Gaussian of sd ``blur_px`` about the pixel's centre.

        The board is a product of two square waves, s_u s_v. Around a saddle point its mean is
        E s_u E s_v + 4 (Phi_2(a, b; rho) - Phi(a) Phi(b)), with a, b the distances from the two edges in sd and rho the
        cosine of the angle between their normals; Phi_2 by the tetrachoric series to rho^2.
        """
        _, height, width = squares.shape
        left, above = np.minimum(columns, width - 2), np.minimum(rows, height - 2)
        here = squares[:, rows, columns].astype(np.float64)
        slopes = np.stack(  # (2 axes of the board, 2 of the image, m): squares per px
            [
                squares[:, rows, left + 1] - squares[:, rows, left],
                squares[:, above + 1, columns] - squares[:, above, columns],
            ],
            axis=1,
        ).astype(np.float64)
        steepness = np.linalg.norm(slopes, axis=1)
        rho = (slopes[0] * slopes[1]).sum(axis=0) / steepness.prod(axis=0)
        num = self.num_corners + 1
        line = np.clip(np.rint(here), 1, num - 1)  # the outline is no edge between squares
        sd = steepness * self.photo.blur_px
        a, b = (here - line) / sd
        sign = 1.0 - 2.0 * (line.sum(axis=0) % 2.0)
        density = np.exp(-0.5 * (a * a + b * b)) / (2.0 * np.pi)
        wave = sign * (erf(a * _HALF) * erf(b * _HALF) + 4.0 * density * (rho + 0.5 * rho * rho * a * b))
        inside = (ndtr(here / sd) * ndtr((num - here) / sd)).prod(axis=0)
        black, white, ground = self.photo.black, self.photo.white, self.photo.ground
        board = 0.5 * (white + black) - 0.5 * (white - black) * wave
        return np.asarray(ground + inside * (board - ground))


def detect_corners(
    photograph: UInt8Array, true_xy_px: FloatArray, num_corners: int, rng: np.random.Generator
) -> FloatArray:
    """Find the corners of a board whose corners are roughly known.

    Parameters
    ----------
    true_xy_px : (n, 2) row by row, n = num_corners^2; the detector starts up to half a pixel off in x and in y

    Returns
    -------
    FloatArray
        (n, 2) px, first pixel centre = (0.5, 0.5). The window is 11 px wide, less where corners are close.

    Raises
    ------
    DetectorError
        Corners found more than half a pixel off, or too close to each other for a window. None is dropped: what a
        study says of noise would depend on which.
    """
    half_window = min(_HALF_WINDOW_PX, int(_WINDOW_SHARE * corner_distance_px(true_xy_px, num_corners)))
    if half_window < _MIN_HALF_WINDOW_PX:
        raise DetectorError(
            f"corners {corner_distance_px(true_xy_px, num_corners):.1f} px apart are too close to detect"
        )
    smooth = cv2.GaussianBlur(photograph, (0, 0), _SMOOTHING_PX)
    # OpenCV's first pixel centre is (0, 0)
    start = true_xy_px - 0.5 + rng.uniform(-_START_PX, _START_PX, true_xy_px.shape)
    corners = np.ascontiguousarray(start, dtype=np.float32).reshape(-1, 1, 2)
    cv2.cornerSubPix(smooth, corners, (half_window, half_window), (-1, -1), _CRITERIA)
    found = corners.reshape(-1, 2).astype(np.float64) + 0.5
    error_px = np.linalg.norm(found - true_xy_px, axis=1)
    num_lost = int(np.count_nonzero(~(error_px <= _LOST_PX)))
    if num_lost:
        raise DetectorError(
            f"{num_lost} of {len(found)} corners found more than {_LOST_PX} px off (up to {error_px.max():.2f} px)"
        )
    return found


def corner_distance_px(xy_px: FloatArray, num_corners: int) -> float:
    """Smallest distance between neighbouring corners (n, 2) of a board, px."""
    grid = xy_px.reshape(num_corners, num_corners, 2)
    return float(min(np.linalg.norm(np.diff(grid, axis=axis), axis=-1).min() for axis in (0, 1)))


def _apply(homography: Float32Array, points: Float32Array) -> Float32Array:
    """Map points (2, ...) by a homography (3, 3)."""
    mapped = [row[0] * points[0] + row[1] * points[1] + row[2] for row in homography]
    return np.asarray(np.stack([mapped[0], mapped[1]]) / mapped[2])
