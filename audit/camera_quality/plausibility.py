"""Could this be a camera at all? Low residuals do not say so (method.md sections 6 and 7).

Measures of one camera, and the verdicts on pose and plausibility that use them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from sfm_audit.audit.camera_quality.identifiability import Identifiability
from sfm_audit.audit.cameras.columns import Want
from sfm_audit.audit.cameras.models import functions_of
from sfm_audit.audit.cameras.projection import extra_params, scale_and_shift
from sfm_audit.audit.cameras.warps import WarpFunction
from sfm_audit.audit.decision.verdict import Judgement, Reason, ReasonCode, Verdict
from sfm_audit.loaders.arrays import BoolArray, FloatArray
from sfm_audit.loaders.model import CameraRecord

_COARSE: Final = np.geomspace(1e-3, 1e2, 36)  # undistorted radii / distorted radius of the border point
_FINE: Final = np.arange(1, 49) / 48.0  # of the coarse radius at which something happened
_RIGHT_ANGLE: Final = math.pi / 2.0


@dataclass(frozen=True, slots=True)
class CameraPlausibility:
    """Measures of one camera; None and NaN where it has no focal length and no principal point (panoramas).

    focal_over_size: first focal length / max(width, height).    folds_over: the distortion folds inside the image.
    principal_point_px, size_px: where it is, and width and height.
    """

    focal_over_size: float
    folds_over: bool
    principal_point_px: tuple[float, float] | None
    size_px: tuple[int, int]

    @property
    def principal_point_outside(self) -> bool:
        """Whether the principal point lies outside the image."""
        if self.principal_point_px is None:
            return False
        return not all(0.0 <= at <= size for at, size in zip(self.principal_point_px, self.size_px, strict=True))


def camera_plausibility(camera: CameraRecord) -> CameraPlausibility:
    """Measure a camera whose parameters are finite; it depends on nothing else, so once per camera is enough."""
    size = camera.width, camera.height
    if camera.model.is_spherical:
        return CameraPlausibility(math.nan, folds_over=False, principal_point_px=None, size_px=size)
    focal, _, cx, cy = scale_and_shift(camera.model, camera.params)
    longer = max(size)
    return CameraPlausibility(focal / longer if longer else math.nan, folds_over(camera), (cx, cy), size)


def folds_over(camera: CameraRecord) -> bool:
    """Whether the distortion folds inside the image: two directions are mapped to one pixel, or to none.

    Parameters
    ----------
    camera : parameters finite, focal lengths not 0

    Notes
    -----
    Rays of undistorted points u leave the principal point towards the corners and twelve more points of the border.
    On each, the derivative D = d (x, y) / d u has to stay upright (det D > 0, trace D > 0, the condition under which
    `audit.cameras.unproject` accepts a solution) until the distorted radius has reached that of the border point. If D
    turns first, the border point has no preimage on the principal point's side of the fold, and some pixel has two.
    A first, geometric grid of radii finds the scale, a second, linear one decides; a fold that a lens reaches within
    0.1 % of the border's radius may be told either way.

    No fold: a ray that never reaches its border point and stays upright, such as the image circle of a fisheye lens
    (theta < 90 degrees) or of FOV, EUCM and the division models with k < 0. A division model with k > 0 ends where
    k r_d^2 = 1, where its derivative is infinite; beyond, COLMAP's way back folds, and that counts.
    """
    model, functions = camera.model, functions_of(camera.model)
    if functions.distort is None:
        return False
    fx, fy, _, _ = scale_and_shift(model, camera.params)
    if fx == 0.0 or fy == 0.0 or camera.width <= 0 or camera.height <= 0:
        return False  # no distorted plane to look at; the focal length is out of range anyway
    goal = _border_points(camera)
    reach = np.hypot(goal[:, 0], goal[:, 1])
    goal, reach = goal[reach > 0.0], reach[reach > 0.0]
    extra = extra_params(model, camera.params)
    if functions.folds is not None:
        return functions.folds(extra, float(reach.max()) ** 2)
    direction = goal / reach[:, None]
    coarse = reach[:, None] * _COARSE
    if functions.is_fisheye:
        coarse = np.minimum(coarse, _RIGHT_ANGLE)
    turned, arrived = _states(functions.distort, extra, direction, coarse, reach)
    ended = _first(turned | arrived, coarse)
    fine = ended[:, None] * _FINE
    turned, arrived = _states(functions.distort, extra, direction, fine, reach)
    first_turn = np.where(turned.any(axis=1), turned.argmax(axis=1), _FINE.size)
    first_arrival = np.where(arrived.any(axis=1), arrived.argmax(axis=1), _FINE.size)
    return bool((first_turn < first_arrival).any())


def _border_points(camera: CameraRecord) -> FloatArray:
    """Return (16, 2): corners and quarter points of the image border on the distorted normalised plane."""
    fx, fy, cx, cy = scale_and_shift(camera.model, camera.params)
    step = np.arange(4) / 4.0
    x = np.concatenate([step, np.ones(4), 1.0 - step, np.zeros(4)])
    y = np.concatenate([np.zeros(4), step, np.ones(4), 1.0 - step])
    return np.column_stack([(x * camera.width - cx) / fx, (y * camera.height - cy) / fy])


def _first(event: BoolArray, radius: FloatArray) -> FloatArray:
    """Radius (d,) of the first event along each row of (d, k), the last radius where there is none."""
    column = np.where(event.any(axis=1), event.argmax(axis=1), event.shape[1] - 1)
    return np.asarray(radius[np.arange(len(radius)), column])


def _states(
    distort: WarpFunction, extra: list[float], direction: FloatArray, radius: FloatArray, reach: FloatArray
) -> BoolArray:
    """Return (2, d, k): where the derivative is not upright, and where the border's radius has been reached.

    direction : (d, 2) unit        radius : (d, k) undistorted        reach : (d,) distorted radius of the border point
    """
    u, v = ((radius * direction[:, axis, None]).ravel() for axis in range(2))
    with np.errstate(all="ignore"):
        x, y, xu, xv, yu, yv, _ = distort(u, v, extra, Want.D_POINT)
        upright = np.broadcast_to((xu * yv - xv * yu > 0.0) & (np.add(xu, yv) > 0.0), u.shape)
        arrived = (x * x + y * y).reshape(radius.shape) >= (reach * reach)[:, None]
    return np.stack([~upright.reshape(radius.shape), arrived])


@dataclass(frozen=True, slots=True)
class PlausibilityLimits:
    """Thresholds of method.md sections 6 and 7.

    min_focal_over_size, max_focal_over_size: f / max(width, height) of a plausible camera.
    max_sd_focal_rel: sd_f / f above which the focal length is not identified.    min_k1_sds: |k1| / sd below which k1
    is not identified.    min_coverage, min_occupied_cells: of the image, and of 8 x 8 cells.
    min_observations: inliers below which nothing is said.    max_pose_offset_px: see `judge_pose`.
    """

    min_focal_over_size: float = 0.3
    max_focal_over_size: float = 10.0
    max_sd_focal_rel: float = 0.01
    min_k1_sds: float = 2.0
    min_coverage: float = 0.2
    min_occupied_cells: int = 16
    min_observations: int = 20
    max_pose_offset_px: float = 0.5


DEFAULT_LIMITS: Final = PlausibilityLimits()


def judge_pose(pose_offset_px: float, num_inliers: int, limits: PlausibilityLimits = DEFAULT_LIMITS) -> Judgement:
    """Judge whether the pose is at the optimum of the image's own residuals.

    Parameters
    ----------
    pose_offset_px : see `audit.inliers.stationarity.pose_offset_px`; NaN where derivatives are not finite
    num_inliers : observations behind it

    Notes
    -----
    method.md section 7's verdict_pose: rejected when pose_offset_px > 0.5; undetermined with fewer than 20 inliers.
    Blind to a wrong pose that was adjusted together with its residuals: it is at its optimum.
    """
    if num_inliers < limits.min_observations:
        return Judgement(Verdict.UNDETERMINED, (_too_few(num_inliers, limits),))
    if math.isnan(pose_offset_px):
        detail = f"pose offset unknown, {num_inliers} inliers"
        return Judgement(Verdict.UNDETERMINED, (Reason(ReasonCode.NON_FINITE_DERIVATIVES, detail),))
    if pose_offset_px > limits.max_pose_offset_px:
        detail = f"pose_offset_px = {pose_offset_px:.3g} > {limits.max_pose_offset_px:g}"
        return Judgement(Verdict.REJECTED, (Reason(ReasonCode.POSE_NOT_OPTIMAL, detail),))
    return Judgement(Verdict.ACCEPTED)


def judge_plausible(
    camera: CameraPlausibility,
    identifiability: Identifiability,
    *,
    coverage: float,
    occupied_cells: int,
    num_inliers: int,
    limits: PlausibilityLimits = DEFAULT_LIMITS,
) -> Judgement:
    """Judge whether this could be a camera, and whether the image says enough about it.

    Parameters
    ----------
    camera : measures of the camera           identifiability : of the image, conditional on the points
    coverage, occupied_cells : see `coverage`, 8 x 8 cells        num_inliers : observations behind all of it

    Notes
    -----
    method.md section 7's plausible. All reasons are listed, also the undetermined ones of a rejected image. That k1 is
    not identified is a reason only: an accepted image may carry it (the advice is a camera model without it).
    """
    rejections = _implausible(camera, limits)
    doubts = _too_little(identifiability, coverage, occupied_cells, num_inliers, limits)
    remarks = _remarks(identifiability, num_inliers, limits)
    verdict = Verdict.REJECTED if rejections else Verdict.UNDETERMINED if doubts else Verdict.ACCEPTED
    return Judgement(verdict, (*rejections, *doubts, *remarks))


def _too_few(num_inliers: int, limits: PlausibilityLimits) -> Reason:
    detail = f"{num_inliers} inliers, {limits.min_observations} needed"
    return Reason(ReasonCode.TOO_FEW_OBSERVATIONS, detail)


def _implausible(camera: CameraPlausibility, limits: PlausibilityLimits) -> list[Reason]:
    """Reasons to reject the camera as such."""
    reasons = []
    low, high = limits.min_focal_over_size, limits.max_focal_over_size
    if camera.principal_point_px is not None and not low <= camera.focal_over_size <= high:
        detail = f"f / max(w, h) = {camera.focal_over_size:.3g}, outside [{low:g}, {high:g}]"
        reasons.append(Reason(ReasonCode.FOCAL_OUT_OF_RANGE, detail))
    if camera.folds_over:
        detail = f"inside the image of {camera.size_px[0]} x {camera.size_px[1]} px"
        reasons.append(Reason(ReasonCode.DISTORTION_FOLDS, detail))
    if camera.principal_point_px is not None and camera.principal_point_outside:
        x, y = camera.principal_point_px
        detail = f"({x:.1f}, {y:.1f}) px, image of {camera.size_px[0]} x {camera.size_px[1]} px"
        reasons.append(Reason(ReasonCode.PRINCIPAL_POINT_OUTSIDE, detail))
    return reasons


def _too_little(
    found: Identifiability, coverage: float, occupied_cells: int, num_inliers: int, limits: PlausibilityLimits
) -> list[Reason]:
    """Reasons not to decide."""
    if num_inliers < limits.min_observations:
        return [_too_few(num_inliers, limits)]
    reasons = []
    if found.has_focal and not found.sd_focal_rel <= limits.max_sd_focal_rel:
        reasons.append(_focal_doubt(found, num_inliers, limits))
    if not coverage >= limits.min_coverage:
        reasons.append(Reason(ReasonCode.LOW_COVERAGE, f"{coverage:.1%} < {limits.min_coverage:.0%} of the image"))
    if occupied_cells < limits.min_occupied_cells:
        detail = f"{occupied_cells} < {limits.min_occupied_cells}"
        reasons.append(Reason(ReasonCode.FEW_OCCUPIED_CELLS, detail))
    return reasons


def _focal_doubt(found: Identifiability, num_inliers: int, limits: PlausibilityLimits) -> Reason:
    """Why nothing is known of the focal length: derivatives, noise, a singular N, or a large deviation."""
    share = found.parameters.singular_share
    if math.isnan(share):
        return Reason(ReasonCode.NON_FINITE_DERIVATIVES, f"covariance unknown, {num_inliers} inliers")
    if found.parameters.is_singular:
        return Reason(ReasonCode.FOCAL_NOT_IDENTIFIED, f"smallest / largest singular value = {share:.2g}")
    if math.isnan(found.sd_focal_rel):
        return Reason(ReasonCode.NOISE_NOT_FITTED, f"{num_inliers} observations")
    detail = f"sd_f / f = {found.sd_focal_rel:.2%} > {limits.max_sd_focal_rel:.0%}, conditional on the points"
    return Reason(ReasonCode.FOCAL_NOT_IDENTIFIED, detail)


def _remarks(found: Identifiability, num_inliers: int, limits: PlausibilityLimits) -> list[Reason]:
    """Reasons that decide nothing."""
    if num_inliers < limits.min_observations or found.k1_identified(limits.min_k1_sds) is not False:
        return []
    detail = f"{found.k1:.3g}, sd = {found.sd_k1:.2g}, conditional on the points"
    return [Reason(ReasonCode.K1_NOT_IDENTIFIED, detail)]
