"""A second opinion: COLMAP's own absolute pose and refinement, through pycolmap."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, Final

import numpy as np
import pycolmap

from sfm_audit.audit.calibrate.camera import CalibratedCamera, Distortion
from sfm_audit.audit.calibrate.consensus import CentredPoints
from sfm_audit.audit.calibrate.degenerate import check_camera, check_consensus, check_points
from sfm_audit.audit.calibrate.eaprd import centred_camera
from sfm_audit.audit.calibrate.estimate import Degeneracy, DegenerateInputError, Estimate, estimate_of
from sfm_audit.audit.calibrate.refine import Fit, fit_at
from sfm_audit.loaders.arrays import BoolArray
from sfm_audit.loaders.correspondences.records import Correspondences

_MODELS: Final = {1: "SIMPLE_RADIAL", 2: "RADIAL"}
_FOCAL_OVER_SIZE: Final = (1.2, 0.6, 2.4)  # COLMAP's first guess without EXIF, half and twice of it
_RANSAC_PX: Final = 12.0  # COLMAP's own; its RANSAC knows no distortion
_NO_LOSS_PX: Final = 1e4  # scale of COLMAP's Cauchy loss from which on it is least squares
_GRADIENT: Final = 1e-10
_MAX_SELECTIONS: Final = 20
_SEEDS: Final = 2**31 - 1


def absolute_pose(
    correspondences: Correspondences, rng: np.random.Generator, *, num_coefficients: int = 2, threshold_px: float = 5.0
) -> Estimate:
    """Estimate pose, one focal length and D(n, 0) with COLMAP's solvers, centre in the middle.

    Parameters
    ----------
    correspondences : at least 7 + n different points
    rng : seeds the samples
    num_coefficients : n; 1: COLMAP's SIMPLE_RADIAL, 2: RADIAL
    threshold_px : an inlier is nearer than that to its projection

    Raises
    ------
    DegenerateInputError
        where the correspondences determine no camera. A plane *nearly* parallel to the image is no error: its
        ``sd_of("f")`` is large.

    Notes
    -----
    COLMAP's RANSAC assumes no distortion and drops what disagrees: 25 to 90 % of good points are left on a strong lens.
    So its inliers are only where refinement starts; they are selected again with the refined camera, and refined again,
    until they stay. Of four starts, focal length estimated or guessed, the smallest truncated error wins.
    """
    estimated = ("f", "k1", "k2")[: 1 + num_coefficients]
    num_parameters = 6 + len(estimated)
    check_points(correspondences, num_parameters, threshold_px)
    search = _Search(centred_camera(correspondences, Distortion.FORWARD, estimated), correspondences, threshold_px)
    fits = [fit for start in search.starts(rng) if (fit := search.refined(start)) is not None]
    if not fits:
        raise DegenerateInputError(Degeneracy.NO_CONSENSUS, f"fewer than {num_parameters} correspondences agree")
    fit = min(fits, key=lambda fit: fit.cost(threshold_px))
    check_consensus(fit.inliers, num_parameters)
    translation = search.points.scale * fit.translation - fit.rotation @ search.points.centroid
    estimate = estimate_of("colmap", fit.camera, fit.rotation, translation, correspondences, inliers=fit.inliers)
    return check_camera(estimate, correspondences.xyz_world)


class _Search:
    """COLMAP's answers, as fits."""

    def __init__(self, camera: CalibratedCamera, correspondences: Correspondences, threshold_px: float) -> None:
        self._camera, self._xy_px, self._threshold_px = camera, correspondences.xy_px, threshold_px
        self.points = CentredPoints.of(correspondences)
        self._num_coefficients = len(camera.estimated) - 1

    def starts(self, rng: np.random.Generator) -> Iterator[Fit]:
        """Yield what COLMAP estimates with the focal length unknown, then at guesses."""
        guesses = [size * max(self._camera.width, self._camera.height) for size in _FOCAL_OVER_SIZE]
        for focal_px, is_unknown in [(guesses[0], True), *((focal_px, False) for focal_px in guesses)]:
            options = pycolmap.AbsolutePoseEstimationOptions()
            options.estimate_focal_length = is_unknown
            options.ransac.max_error = _RANSAC_PX
            options.ransac.random_seed = int(rng.integers(_SEEDS))
            camera = self._to_colmap(replace(self._camera, focal_px=(focal_px, focal_px)))
            answer = pycolmap.estimate_absolute_pose(self._xy_px, self.points.xyz, camera, options)
            if answer is not None:  # the camera was changed in place
                yield self._fit(camera, answer["cam_from_world"], answer["inlier_mask"])

    def refined(self, fit: Fit) -> Fit | None:
        """Refine on the inliers, select them again, until they stay; None where too few are left."""
        num_parameters = 6 + len(self._camera.estimated)
        for _ in range(_MAX_SELECTIONS):
            if np.count_nonzero(fit.inliers) < num_parameters:
                return None
            camera = self._to_colmap(fit.camera)
            options = pycolmap.AbsolutePoseRefinementOptions()
            options.refine_focal_length = options.refine_extra_params = True
            options.loss_function_scale, options.gradient_tolerance = _NO_LOSS_PX, _GRADIENT
            pose = pycolmap.Rigid3d(np.column_stack([fit.rotation, fit.translation]))
            answer = pycolmap.refine_absolute_pose(pose, self._xy_px, self.points.xyz, fit.inliers, camera, options)
            if answer is None:
                return None
            fit = self._fit(camera, answer["cam_from_world"], fit.inliers)
            inliers = fit.sq_errors_px2 < self._threshold_px**2
            if (inliers == fit.inliers).all():
                break
            fit = replace(fit, inliers=inliers)
        return fit

    def _to_colmap(self, camera: CalibratedCamera) -> Any:
        params = [camera.focal_px[0], *camera.principal_point_px, *camera.coefficients[: self._num_coefficients]]
        model = _MODELS[self._num_coefficients]
        return pycolmap.Camera(model=model, width=camera.width, height=camera.height, params=params)

    def _fit(self, camera: Any, cam_from_points: Any, inliers: BoolArray) -> Fit:
        coefficients = np.zeros(3)
        coefficients[: self._num_coefficients] = camera.params[3:]
        focal_px = float(camera.params[0])
        found = replace(self._camera, focal_px=(focal_px, focal_px), coefficients=coefficients)
        rotation = cam_from_points.rotation.matrix()
        fit = fit_at(found, rotation, cam_from_points.translation, self._xy_px, self.points.xyz)
        return replace(fit, inliers=np.array(inliers, dtype=bool))
