"""Do the camera, the pose, the points and the 2D points of one image belong together? (method.md section 12)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from sfm_audit.audit.consistency.affine import MEDIAN_LENGTH, AffineFit, fit_affine, median_of, root_mean_square
from sfm_audit.audit.consistency.cause import CAUSE_MEANINGS, Cause, Explanation, affine_cause
from sfm_audit.audit.consistency.pose_step import lengths_after_pose_step
from sfm_audit.audit.consistency.readings import fitting_reading
from sfm_audit.audit.inliers.residuals import image_residuals
from sfm_audit.audit.inliers.sanity import is_sane, is_usable
from sfm_audit.loaders.arrays import FloatArray, IndexArray, IntArray
from sfm_audit.loaders.model import CameraRecord, ImageRecord


@dataclass(frozen=True, slots=True)
class ConsistencyLimits:
    """Limits of method.md section 12.

    max_rms_share: of the width.    max_rms_ratio, min_rms_px: RMS / RMS that the affine fit leaves, and px.
    max_share_wrong: of the observations that may lie behind the camera, or far from where they should, while the
    others fit.    min_observations: below which nothing is said.
    max_sds: sd within which the shift of the pixel convention has to be.
    """

    max_rms_share: float = 0.01
    max_rms_ratio: float = 20.0
    min_rms_px: float = 20.0
    max_share_wrong: float = 0.2
    min_observations: int = 20
    max_sds: float = 5.0


DEFAULT_LIMITS: Final = ConsistencyLimits()
_HALF_PIXEL: Final = 0.5
_NO_SD_PX: Final = 0.01  # sd of points that were not measured: residuals are roundings there
_MIN_BETTER: Final = 3.0  # a map that explains the residuals leaves less than a third of them
_MIN_TAIL: Final = 10.0  # RMS / median of residuals that are large in a minority only; smooth errors have less than 2


@dataclass(frozen=True, slots=True, eq=False)
class ImageConsistency:
    """What is known about one image; NaN and None where it cannot be known.

    num_linked: linked observations whose numbers are finite.    share_in_front: of them.
    stored_rms_px: RMS residual as the model stands.    rms_px: after one step of the image's own pose.
    affine: observed = A projected + b as the model stands.
    inconsistent: whether a limit is exceeded; None = unknown.    moved: whether only stored_rms_px exceeds it.
    explanation: the cause and the numbers, where inconsistent or moved.
    half_pixel: +1, -1 where all observations are shifted by +-(0.5, 0.5) px, else 0.
    """

    image_name: str
    camera_id: int
    num_linked: int
    share_in_front: float
    stored_rms_px: float = math.nan
    rms_px: float = math.nan
    affine: AffineFit | None = None
    inconsistent: bool | None = None
    moved: bool = False
    explanation: Explanation | None = None
    half_pixel: int = 0


def image_consistency(
    image: ImageRecord, xy_px: FloatArray, xyz_world: FloatArray, limits: ConsistencyLimits = DEFAULT_LIMITS
) -> ImageConsistency:
    """Ask whether the parts of an image without a model belong together; see `consistency_of_linked`.

    Parameters
    ----------
    image : pose and camera
    xy_px, xyz_world : (n, 2) px, (n, 3) model units: observations whose point exists, those behind the camera included
    """
    point_idx = np.arange(len(xyz_world))
    part = image_residuals(image, xy_px, xyz_world, point_idx)
    points = LinkedPoints(
        image, xy_px, xyz_world, point_idx, part.inlier_row, part.residuals_px, part.num_behind, part.num_unprojected
    )
    return consistency_of_linked(points, limits)


@dataclass(frozen=True, slots=True, eq=False)
class LinkedPoints:
    """The linked observations of an image, with what was left of them after projection.

    xy_px: (n, 2) observed.    point_idx: (n,) rows of points_xyz (P, 3), world frame; -1 = dangling.
    rows: (m,) those that are inliers (method.md section 1).    residuals_px: (2, m) of these.
    num_behind, num_unprojected: how many others lie behind the camera, or in front without a finite projection.
    """

    image: ImageRecord
    xy_px: FloatArray
    points_xyz: FloatArray
    point_idx: IndexArray
    rows: IntArray
    residuals_px: FloatArray
    num_behind: int
    num_unprojected: int

    @property
    def camera(self) -> CameraRecord:
        """The image's camera."""
        if self.image.camera is None:
            raise ValueError(f"image {self.image.image_id} has no camera")
        return self.image.camera

    @property
    def num_finite(self) -> int:
        """Observations whose numbers are finite, wherever their points lie."""
        return self.rows.size + self.num_behind + self.num_unprojected

    @property
    def seen_px(self) -> FloatArray:
        """(m, 2) observed."""
        return self.xy_px.take(self.rows, axis=0)

    @property
    def seen_cam(self) -> FloatArray:
        """(m, 3) points in the camera frame."""
        return self.image.cam_from_world(self.points_xyz.take(self.point_idx[self.rows], axis=0))

    def finite(self) -> tuple[FloatArray, FloatArray]:
        """Return observed (k, 2) and world points (k, 3) of the observations whose numbers are finite."""
        known = np.flatnonzero(self.point_idx >= 0)
        xy_px, xyz_world = self.xy_px[known], self.points_xyz[self.point_idx[known]]
        xyz_cam = self.image.cam_from_world(xyz_world)
        finite = is_sane(xyz_cam).all(axis=1) & is_sane(xy_px).all(axis=1)
        return xy_px[finite], xyz_world[finite]


def consistency_of_linked(points: LinkedPoints, limits: ConsistencyLimits = DEFAULT_LIMITS) -> ImageConsistency:
    """Ask whether the parts of an image belong together.

    Notes
    -----
    Inconsistent: after one step of the image's own pose the RMS residual exceeds 1 % of the width, or 20 px and 20
    times what the affine fit leaves; or more than 20 % of the observations lie behind the camera. A few wrong links
    among observations that fit make no image inconsistent, whatever the RMS: more than 20 % have to be wrong. A and b
    are those of the model as it stands: the pose step would bend them. The step is taken only where the RMS exceeds a
    limit without it; elsewhere it decides nothing, and rms_px is stored_rms_px.
    """
    image, camera = points.image, points.image.camera
    if camera is None or not is_usable(camera) or min(camera.width, camera.height) <= 0:
        return ImageConsistency(image.name, image.camera_id, 0, math.nan)
    with np.errstate(all="ignore"):
        return _judged(points, limits)


def _judged(points: LinkedPoints, limits: ConsistencyLimits) -> ImageConsistency:
    """Measure, compare with the limits, and ask for the cause where one is exceeded."""
    camera, num_linked = points.camera, points.num_finite
    share = (num_linked - points.num_behind) / num_linked if num_linked else math.nan
    known = ImageConsistency(points.image.name, points.image.camera_id, num_linked, share)
    if num_linked < limits.min_observations:
        return known
    if points.rows.size >= limits.min_observations:
        length: FloatArray = np.hypot(*points.residuals_px)
        projected = points.seen_px.T - points.residuals_px
        affine = None if camera.model.is_spherical else fit_affine(projected, points.residuals_px)
        after: FloatArray | None = None
        if suspect := _exceeds(length, affine, camera, limits):
            after = lengths_after_pose_step(camera, points.seen_px, points.seen_cam, points.residuals_px)
        inconsistent = suspect and _exceeds(length if after is None else after, affine, camera, limits)
        known = replace(
            known,
            stored_rms_px=root_mean_square(length),
            rms_px=root_mean_square(length if after is None else after),
            affine=affine,
            inconsistent=inconsistent,
            moved=suspect and not inconsistent,
            half_pixel=half_pixel(affine, limits),
        )
    if 1.0 - share > limits.max_share_wrong:
        known = replace(known, inconsistent=True, moved=False)
    if known.inconsistent or known.moved:
        return replace(known, explanation=_explained(known, points, limits))
    return known


def _exceeds(length_px: FloatArray, affine: AffineFit | None, camera: CameraRecord, limits: ConsistencyLimits) -> bool:
    """Whether the RMS of residuals is too large for parts that belong together, and not for a few wrong links alone."""
    rms_px = root_mean_square(length_px)
    limit_px = limits.max_rms_share * camera.width
    too_large = rms_px > limit_px or (
        affine is not None and rms_px > limits.min_rms_px and rms_px > limits.max_rms_ratio * affine.rest_rms_px
    )
    if not too_large:
        return False
    num_far = int(np.count_nonzero(length_px > limit_px))
    return num_far > limits.max_share_wrong * length_px.size or not _is_tail(median_of(length_px), rms_px)


def _is_tail(median_px: float, rms_px: float) -> bool:
    """Whether an RMS comes from a minority of the residuals."""
    return median_px * _MIN_TAIL < rms_px


def half_pixel(affine: AffineFit | None, limits: ConsistencyLimits) -> int:
    """+1 or -1 where A = 1 and the shift is +-(0.5, 0.5) px, within 5 sd, and is not 0 within 5 sd."""
    if affine is None:
        return 0
    sd_px = max(affine.sd_shift_px, _NO_SD_PX)
    tolerance = limits.max_sds * sd_px
    if not (np.abs(affine.linear - np.eye(2)) <= tolerance / affine.spread_px).all():
        return 0
    for sign in (1, -1):
        if (np.abs(affine.shift_px - sign * _HALF_PIXEL) <= tolerance).all() and tolerance < _HALF_PIXEL:
            return sign
    return 0


def _explained(known: ImageConsistency, points: LinkedPoints, limits: ConsistencyLimits) -> Explanation:
    """The cause, and the numbers that exceed their limits."""
    found = _cause(known, points, limits)
    share_limit, limit_px = limits.max_share_wrong, limits.max_rms_share * points.camera.width
    if 1.0 - known.share_in_front > share_limit:
        numbers = f"{1.0 - known.share_in_front:.0%} of the points behind the camera, limit {share_limit:.0%}"
    elif known.moved:
        numbers = (
            f"RMS {known.stored_rms_px:.4g} px, limit {limit_px:.4g} px; {known.rms_px:.3g} px after the pose's step"
        )
    elif known.rms_px > limit_px:
        numbers = f"RMS {known.rms_px:.4g} px after the pose's own step, limit {limit_px:.4g} px"
    else:
        rest = known.affine.rest_rms_px if known.affine else math.nan
        numbers = f"RMS {known.rms_px:.4g} px after the pose's own step, {rest:.3g} px after an affine map"
    return replace(found, numbers=numbers)


def _cause(known: ImageConsistency, points: LinkedPoints, limits: ConsistencyLimits) -> Explanation:
    """What explains the residuals: an affine map, wrong links, another reading of the pose, or a pose that moved."""
    affine, tolerance = known.affine, limits.max_rms_share * points.camera.width
    if affine is not None:
        typical = affine.noise_px * MEDIAN_LENGTH
        median = median_of(np.hypot(*points.residuals_px))
        better_than_pose = affine.rest_rms_px * _MIN_BETTER < known.rms_px or not known.moved
        if typical <= tolerance and typical * _MIN_BETTER < median and better_than_pose:
            found = affine_cause(affine, points.camera, tolerance)
            if found is not None:
                return found
        if median <= tolerance and _is_tail(median, known.stored_rms_px):
            return Explanation(Cause.LINKS, CAUSE_MEANINGS[Cause.LINKS])
    if known.moved:  # what explains it better than the pose's step has to leave much less
        tolerance = min(tolerance, known.rms_px / _MIN_BETTER)
    read = fitting_reading(points.image, points.camera, *points.finite(), tolerance)
    otherwise = Cause.POSES if known.moved else Cause.POSES_OR_POINTS
    return read or Explanation(otherwise, CAUSE_MEANINGS[otherwise])
