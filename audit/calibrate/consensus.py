"""The camera that most correspondences agree with: radial starts, RANSAC on whole cameras, refinement."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from sfm_audit.audit.calibrate.camera import CalibratedCamera, Distortion
from sfm_audit.audit.calibrate.degenerate import check_camera, check_consensus, check_points, extents_of
from sfm_audit.audit.calibrate.estimate import Degeneracy, DegenerateInputError, Estimate, estimate_of
from sfm_audit.audit.calibrate.radial_pose import (
    SAMPLE_SIZE,
    Starts,
    complete,
    minimal_radial_poses,
    robust_radial_pose,
)
from sfm_audit.audit.calibrate.refine import Fit, fit_at, refine
from sfm_audit.loaders.arrays import BoolArray, FloatArray
from sfm_audit.loaders.correspondences.records import Correspondences

_FEW_OUTLIERS: Final = 0.15  # share up to which the radial consensus is a good enough start
_SHALLOW: Final = 0.1  # third / second extent below which the mirrored plane has the same directions
_BATCH: Final = 200  # samples
_MOST_BATCHES: Final = 6
_NUM_REFINED: Final = 4  # of the best cameras of a batch
_WIDE: Final = 3.0  # thresholds: five noisy points hold a camera that loosely
_MISSED: Final = 1e-6  # chance that no sample was free of outliers


@dataclass(frozen=True, slots=True, eq=False)
class CentredPoints:
    """Correspondences in coordinates whose numbers are of order 1.

    xy_px: (n, 2) observed, from the image centre.      xyz: (n, 3) from the centroid, in units of their RMS distance.
    centroid: (3,), scale: both in model units.         normal: (3,) of the plane they are near to; None if to none.
    """

    xy_px: FloatArray
    xyz: FloatArray
    centroid: FloatArray
    scale: float
    normal: FloatArray | None

    @classmethod
    def of(cls, correspondences: Correspondences) -> CentredPoints:
        """Centre and scale."""
        centroid = correspondences.xyz_world.mean(axis=0)
        xyz = correspondences.xyz_world - centroid
        scale = float(np.sqrt(np.square(xyz).sum(axis=1).mean()))
        extents = extents_of(xyz / scale)
        normal = np.linalg.svd(xyz / scale, full_matrices=False)[2][2] if extents[2] < _SHALLOW * extents[1] else None
        xy_px = correspondences.xy_px - 0.5 * np.array([correspondences.width, correspondences.height])
        return cls(xy_px, xyz / scale, centroid, scale, normal)


def estimate_radial_camera(
    name: str, camera: CalibratedCamera, correspondences: Correspondences, threshold_px: float, rng: np.random.Generator
) -> Estimate:
    """Estimate pose, focal length and the radial coefficients that ``camera.estimated`` names.

    Parameters
    ----------
    name : of the estimator
    camera : its distortion, size, centre and names are used; focal lengths and coefficients are not
    threshold_px : an inlier is nearer than that to its projection

    Raises
    ------
    DegenerateInputError
        where the correspondences determine no such camera.
    """
    num_parameters = 6 + len(camera.estimated)
    check_points(correspondences, num_parameters, threshold_px)
    search = _Search(camera, CentredPoints.of(correspondences), threshold_px)
    fit, is_mirrored = search.from_directions(rng)
    if fit is None or np.mean(fit.inliers) < 1.0 - _FEW_OUTLIERS:
        fit = search.from_samples(rng, fit)
    if fit is None and is_mirrored:
        raise DegenerateInputError(Degeneracy.NOT_A_CAMERA, "only behind the camera do the points fit their directions")
    if fit is None:
        raise DegenerateInputError(Degeneracy.NO_CONSENSUS, f"fewer than {num_parameters} correspondences agree")
    check_consensus(fit.inliers, num_parameters)
    points = search.points
    translation = points.scale * fit.translation - fit.rotation @ points.centroid
    estimate = estimate_of(
        name, search.in_image(fit.camera), fit.rotation, translation, correspondences, inliers=fit.inliers
    )
    return check_camera(estimate, correspondences.xyz_world)


class _Search:
    """Starts, and what becomes of them."""

    def __init__(self, camera: CalibratedCamera, points: CentredPoints, threshold_px: float) -> None:
        self._camera = replace(camera, principal_point_px=(0.0, 0.0))
        self._centre_px = camera.principal_point_px
        self.points = points
        self._threshold_px = threshold_px

    def in_image(self, camera: CalibratedCamera) -> CalibratedCamera:
        """Return the camera with its centre where it belongs."""
        return replace(camera, principal_point_px=self._centre_px)

    def from_directions(self, rng: np.random.Generator) -> tuple[Fit | None, bool]:
        """Start from the radial pose of most directions.

        Returns
        -------
        (Fit or None, whether nearly all points agree in direction with a pose that has them behind the camera)
        """
        points = self.points
        poses, agree = robust_radial_pose(points.xy_px, points.xyz, self._threshold_px, rng)
        if not len(poses) or np.count_nonzero(agree) < SAMPLE_SIZE:
            return None, False
        chosen = points.xy_px[None, agree], points.xyz[None, agree]
        starts, _ = complete(poses, *chosen, 3, points.normal)
        if not len(starts):
            return None, bool(np.mean(agree) >= 1.0 - _FEW_OUTLIERS)
        return self._refined(starts, agree), False

    def from_samples(self, rng: np.random.Generator, best: Fit | None) -> Fit | None:
        """Full-model RANSAC with local optimisation; at least as good as ``best``."""
        num_points = len(self.points.xyz)
        for batch in range(1, _MOST_BATCHES + 1):
            for starts, near in self._sampled(rng):
                best = self._best([best, self._refined(starts, near)])
            share = 0.0 if best is None else float(np.count_nonzero(best.inliers)) / num_points
            if batch * _BATCH >= _num_samples(share):
                break
        return best

    def _sampled(self, rng: np.random.Generator) -> Iterator[tuple[Starts, BoolArray]]:
        """Yield the best cameras of one batch of samples, one by one, and the points near to each."""
        points = self.points
        samples = np.argpartition(rng.random((_BATCH, len(points.xyz))), SAMPLE_SIZE - 1)[:, :SAMPLE_SIZE]
        poses, rows = minimal_radial_poses(points.xy_px, points.xyz, samples)
        chosen = samples[rows]
        starts, _ = complete(poses, points.xy_px[chosen], points.xyz[chosen], 1, points.normal)
        wide_px2 = (_WIDE * self._threshold_px) ** 2
        sq_errors_px2 = _sq_errors(starts, points)
        order = np.argsort(np.minimum(sq_errors_px2, wide_px2).sum(axis=1), kind="stable")
        for idx in order[:_NUM_REFINED]:
            yield starts.take(np.array([idx])), sq_errors_px2[idx] < wide_px2

    def _refined(self, start: Starts, agree: BoolArray) -> Fit | None:
        """Refine the only one of the starts on the points that agree with it."""
        rotation, translation = start.rotations[0], start.translations[0]
        focal_px, coefficients = float(start.focals_px[0]), self._lens(start, agree)
        camera = replace(self._camera, focal_px=(focal_px, focal_px), coefficients=coefficients)
        fit = fit_at(camera, rotation, translation, self.points.xy_px, self.points.xyz)
        fit = replace(fit, inliers=fit.inliers & agree)
        return refine(fit, self.points.xy_px, self.points.xyz, self._threshold_px)

    def _lens(self, start: Starts, agree: BoolArray) -> FloatArray:
        """Coefficients (3,) of the camera's own model at the start's pose and focal length."""
        num_coefficients = len(self._camera.estimated) - 1
        coefficients = np.zeros(3)
        if self._camera.distortion is Distortion.DIVISION:
            coefficients[: start.divisions.shape[1]] = start.divisions[0]
            return coefficients
        xyz_cam = self.points.xyz[agree] @ start.rotations[0].T + start.translations[0]
        seen = xyz_cam[:, 2] > 0.0
        r = np.hypot(xyz_cam[seen, 0], xyz_cam[seen, 1]) / xyz_cam[seen, 2]
        r_distorted = np.linalg.norm(self.points.xy_px[agree][seen], axis=1) / start.focals_px[0]
        columns = r[:, None] ** (2 * np.arange(1, num_coefficients + 1) + 1)
        coefficients[:num_coefficients] = np.linalg.lstsq(columns, r_distorted - r, rcond=None)[0]
        return coefficients

    def _best(self, fits: list[Fit | None]) -> Fit | None:
        """Return the fit of the smallest truncated error; the first of equals."""
        found = [fit for fit in fits if fit is not None]
        return min(found, key=lambda fit: fit.cost(self._threshold_px), default=None)


def _num_samples(share_inliers: float) -> float:
    """Samples after which one of five inliers was drawn, but for a chance of 1e-6."""
    good = share_inliers**SAMPLE_SIZE
    if good <= 0.0:
        return math.inf
    return 0.0 if good >= 1.0 else math.log(_MISSED) / math.log1p(-good)


def _sq_errors(starts: Starts, points: CentredPoints) -> FloatArray:
    """Squared errors, (m, n) px^2, of cameras with one division coefficient; inf where a point has no image."""
    xyz_cam = points.xyz @ starts.rotations.transpose(0, 2, 1) + starts.translations[:, None, :]
    with np.errstate(divide="ignore", invalid="ignore"):
        u = xyz_cam[..., :2] / xyz_cam[..., 2:]
        # r = r_u (1 + c r^2), the root that is r_u at c = 0
        gain = 2.0 / (1.0 + np.sqrt(1.0 - 4.0 * starts.divisions[:, :1] * np.square(u).sum(axis=-1)))
        errors = np.square(starts.focals_px[:, None, None] * u * gain[..., None] - points.xy_px).sum(axis=-1)
    return np.where((xyz_cam[..., 2] > 0.0) & np.isfinite(errors), errors, np.inf)
