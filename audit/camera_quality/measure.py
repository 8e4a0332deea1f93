"""What do the inliers of one image say about its camera, the points taken as given? (method.md sections 5 and 6)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from sfm_audit.audit.camera_quality.coverage import coverage, occupied_cells
from sfm_audit.audit.camera_quality.expected_error import (
    depths,
    expected_error_px,
    grid_columns,
    grid_rays,
    median_depth,
)
from sfm_audit.audit.camera_quality.identifiability import (
    Identifiability,
    ParameterCovariance,
    covariance_of_sums,
    fitted_names,
    identifiability,
    identifiability_of,
)
from sfm_audit.audit.camera_quality.plausibility import CameraPlausibility, camera_plausibility
from sfm_audit.audit.inliers.projected import ImageInliers
from sfm_audit.audit.inliers.sanity import is_usable
from sfm_audit.audit.misfit import (
    ImageDesign,
    MisfitTests,
    candidate_fields,
    coincident_keypoints,
    nuisance_columns,
    prepare,
)
from sfm_audit.audit.misfit.in_parts import PartedImage, column_sums, column_triangle, image_tests_in_parts
from sfm_audit.loaders.arrays import FloatArray, IntArray
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
    camera, projected = shape.camera, inliers.projected
    columns = nuisance_columns(camera.model, projected)
    known = identifiability(camera, columns, sigma_px)
    depth = median_depth(camera, inliers.xyz_cam)
    fields = candidate_fields(camera, projected)
    prepared = prepare(columns, fields, clusters=coincident_keypoints(inliers.xy_px), overwrite_fields=True)
    misfit = prepared.test(inliers.residuals_px)
    return quality_from(shape, misfit, known, depth, inliers.xy_px, sigma_px=sigma_px, grid=grid)


def camera_quality_in_parts(
    shape: CameraShape, part: Callable[[IntArray], ImageInliers], xy_px: FloatArray, sigma_px: float, *, grid: int
) -> CameraQuality:
    """Ask the same of an image whose columns do not fit into memory at once.

    Parameters
    ----------
    part : gives chosen ones of the image's n inliers        xy_px : (n, 2) observed, of all of them
    """
    camera = shape.camera
    clusters = coincident_keypoints(xy_px)
    track = np.arange(len(xy_px)) if clusters is None else clusters

    def nuisance(chosen: IntArray) -> FloatArray:
        return nuisance_columns(camera.model, part(chosen).projected)

    def design(chosen: IntArray) -> ImageDesign:
        inliers = part(chosen)
        projected = inliers.projected
        fields = candidate_fields(camera, projected)
        columns = nuisance_columns(camera.model, projected)
        return ImageDesign(columns, columns[:0], fields, inliers.residuals_px, track[chosen])

    image = PartedImage(track, nuisance, design)
    sums = column_sums(image)
    names = fitted_names(camera.model)
    parameters = covariance_of_sums(names, sums, sigma_px, lambda: column_triangle(image, sums.norms))
    depth = float(np.median(np.concatenate([depths(camera, part(chosen).xyz_cam) for chosen in image.parts()])))
    misfit = image_tests_in_parts(image, int(track.max()) + 1)
    known = identifiability_of(camera, parameters)
    return quality_from(shape, misfit, known, depth, xy_px, sigma_px=sigma_px, grid=grid)


def quality_from(
    shape: CameraShape,
    misfit: MisfitTests,
    known: Identifiability,
    depth: float,
    xy_px: FloatArray,
    *,
    sigma_px: float,
    grid: int,
) -> CameraQuality:
    """Put together what is known of an image; depth: median, model units."""
    camera, error = shape.camera, math.nan
    if math.isfinite(sigma_px) and not known.parameters.is_singular:
        error = shape.expected_error_px(known.parameters, sigma_px, depth)
    seen = coverage(xy_px, camera.width, camera.height)
    cells = occupied_cells(xy_px, camera.width, camera.height, grid)
    return CameraQuality(shape, misfit, known, error, depth, seen, cells)
