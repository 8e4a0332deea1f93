"""What do the inliers of one image say about its camera, the points taken as given? (method.md sections 5 and 6)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

from sfm_audit.audit.camera_quality.coverage import coverage, occupied_cells
from sfm_audit.audit.camera_quality.expected_error import expected_error_px, grid_columns, grid_rays, median_depth
from sfm_audit.audit.camera_quality.identifiability import Identifiability, ParameterCovariance, identifiability
from sfm_audit.audit.camera_quality.plausibility import CameraPlausibility, camera_plausibility
from sfm_audit.audit.inliers.projected import ImageInliers
from sfm_audit.audit.inliers.sanity import is_usable
from sfm_audit.audit.misfit import (
    MisfitTests,
    candidate_fields,
    coincident_keypoints,
    nuisance_columns,
    prepare,
)
from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.loaders.model import CameraRecord


@dataclass(frozen=True, slots=True, eq=False)
class CameraShape:
    """What depends on the camera alone: compute it once where images share a camera.

    rays: (256, 3) unit rays of a 16 x 16 grid over the image, for the expected measurement error.
    """

    camera: CameraRecord
    plausibility: CameraPlausibility
    rays: FloatArray

    @classmethod
    def of(cls, camera: CameraRecord) -> CameraShape | None:
        """Measure a camera; None where nothing can be projected with its parameters."""
        if not is_usable(camera):
            return None
        return cls(camera, camera_plausibility(camera), grid_rays(camera))

    def expected_error_px(self, parameters: ParameterCovariance, sigma_px: float, depth: float) -> float:
        """Return the median over the image of the expected error of one measurement, see `expected_error_map`."""
        return expected_error_px(self.camera, parameters, sigma_px, depth, _columns_of(self))


@lru_cache(maxsize=8)
def _columns_of(shape: CameraShape) -> FloatArray:
    """Of the cameras asked last: 32 kB each, and twice as many milliseconds where images share one."""
    return grid_columns(shape.camera, rays=shape.rays)


@dataclass(frozen=True, slots=True, eq=False)
class CameraQuality:
    """What one image says of its camera, the points taken as given.

    misfit: as the model stands.    expected_error_px: median over the image.    median_depth: model units.
    """

    shape: CameraShape
    misfit: MisfitTests
    identifiability: Identifiability
    expected_error_px: float
    median_depth: float
    coverage: float
    occupied_cells: int


def camera_quality(shape: CameraShape, inliers: ImageInliers, sigma_px: float, *, grid: int) -> CameraQuality | None:
    """Ask everything that needs the Jacobian of the image's own parameters, which is built once.

    Parameters
    ----------
    shape : of the image's camera            inliers : of the image
    sigma_px : sigma_constant_px             grid : of occupied_cells

    Returns
    -------
    CameraQuality
        None without inliers.
    """
    if not len(inliers):
        return None
    camera, xy_px = shape.camera, inliers.xy_px
    projected = inliers.projected
    columns = nuisance_columns(camera.model, projected)
    known = identifiability(camera, columns, sigma_px)
    depth = median_depth(camera, inliers.xyz_cam)
    error = math.nan
    if math.isfinite(sigma_px) and not known.parameters.is_singular:
        error = shape.expected_error_px(known.parameters, sigma_px, depth)
    fields = candidate_fields(camera, projected)
    prepared = prepare(columns, fields, clusters=coincident_keypoints(xy_px), overwrite_fields=True)
    return CameraQuality(
        shape,
        prepared.test(inliers.residuals_px),
        known,
        error,
        depth,
        coverage(xy_px, camera.width, camera.height),
        occupied_cells(xy_px, camera.width, camera.height, grid),
    )
