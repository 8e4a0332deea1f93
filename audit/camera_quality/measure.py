"""What do the inliers of one image say about its camera, the points taken as given? (method.md sections 5 and 6)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np

from sfm_audit.audit.camera_quality.coverage import Spread, spread_of
from sfm_audit.audit.camera_quality.expected_error import (
    depths,
    expected_error_px,
    grid_columns,
    median_depth,
    stack_errors_px,
)
from sfm_audit.audit.camera_quality.identifiability import (
    Identifiability,
    ParameterCovariance,
    covariances_of_grams,
    fitted_names,
    identifiability_of,
    unit_triangle,
)
from sfm_audit.audit.camera_quality.plausibility import CameraPlausibility, camera_plausibilities
from sfm_audit.audit.camera_quality.shapes import AT_ONCE, columns_of_grids, in_stacks, rays_of_grids
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
from sfm_audit.audit.misfit.in_parts import ColumnSums, PartedImage, column_sums, column_triangle, image_tests_in_parts
from sfm_audit.loaders.arrays import FloatArray, IntArray
from sfm_audit.loaders.camera_models import CameraModel
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
        return cls.of_all([camera])[0]

    @classmethod
    def of_all(cls, cameras: Sequence[CameraRecord]) -> list[CameraShape | None]:
        """Measure cameras; those of one model together."""
        out: list[CameraShape | None] = [None] * len(cameras)
        usable = [place for place, camera in enumerate(cameras) if is_usable(camera)]
        for places in in_stacks([cameras[place] for place in usable]):
            alike = [usable[k] for k in places]
            stack = [cameras[place] for place in alike]
            for place, plausible, rays in zip(alike, camera_plausibilities(stack), rays_of_grids(stack), strict=True):
                out[place] = cls(cameras[place], plausible, rays)
        return out

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
    sums: what the misfit was made of (`audit.misfit.features.packed`), where it may be asked for again.
    """

    shape: CameraShape
    misfit: MisfitTests
    identifiability: Identifiability
    expected_error_px: float
    median_depth: float
    coverage: float
    occupied_cells: int
    sums: FloatArray | None = None


@dataclass(frozen=True, slots=True, eq=False)
class PointSums:
    """What the inliers of an image add up to, for what they say of its camera beside the misfit.

    gram: (q, q) of the columns of `fitted_names`.    num_values: of each column.    median_depth: model units.
    triangle: gives `unit_triangle` of the columns, given their lengths.    misfit: as `CameraQuality.sums`.
    """

    gram: FloatArray
    num_values: int
    median_depth: float
    triangle: Callable[[FloatArray], FloatArray]
    misfit: FloatArray | None = None


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
    misfit, sums = image_sums(shape.camera, inliers)
    seen = spread_of(inliers.xy_px, np.array([0, len(inliers)]), [shape.camera], grid)
    return qualities_of([shape], [misfit], [sums], seen, np.array([sigma_px]))[0]


def image_sums(camera: CameraRecord, inliers: ImageInliers) -> tuple[MisfitTests, PointSums]:
    """Return the misfit tests of an image with inliers, and what else its columns add up to."""
    projected = inliers.projected
    columns = nuisance_columns(camera.model, projected)
    sums = sums_of_columns(columns, median_depth(camera, inliers.xyz_cam))
    fields = candidate_fields(camera, projected)
    prepared = prepare(columns, fields, clusters=coincident_keypoints(inliers.xy_px), overwrite_fields=True)
    return prepared.test(inliers.residuals_px), sums


def sums_of_columns(columns: FloatArray, depth: float) -> PointSums:
    """Sum up the columns (q, 2, n) of `fitted_names` of an image whose median depth is known."""
    flat = columns.reshape(len(columns), -1)
    with np.errstate(over="ignore", invalid="ignore"):
        return PointSums(flat @ flat.T, flat.shape[1], depth, partial(unit_triangle, flat))


def image_sums_in_parts(
    camera: CameraRecord, part: Callable[[IntArray], ImageInliers], xy_px: FloatArray
) -> tuple[MisfitTests, PointSums]:
    """Do what `image_sums` does for an image whose columns do not fit into memory at once.

    Parameters
    ----------
    part : gives chosen ones of the image's n inliers        xy_px : (n, 2) observed, of all of them
    """
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
    depth = float(np.median(np.concatenate([depths(camera, part(chosen).xyz_cam) for chosen in image.parts()])))
    sums = PointSums(_gram_of(column_sums(image)), 2 * len(track), depth, partial(column_triangle, image))
    return image_tests_in_parts(image, int(track.max()) + 1), sums


def _gram_of(sums: ColumnSums) -> FloatArray:
    """The Gram matrix of the columns as they are."""
    used = np.flatnonzero(sums.norms != 0.0)
    gram = np.zeros((len(sums.norms),) * 2)
    gram[np.ix_(used, used)] = sums.gram * sums.norms[used] * sums.norms[used, None]
    return gram


def qualities_of(
    shapes: Sequence[CameraShape],
    misfits: Sequence[MisfitTests],
    sums: Sequence[PointSums],
    seen: Spread,
    sigma_px: FloatArray,
) -> list[CameraQuality]:
    """Put together what is known of B images, of any cameras.

    Parameters
    ----------
    shapes : of the images' cameras        misfits, sums : from `image_sums`
    seen : from `spread_of`                sigma_px : (B,) sigma_constant_px
    """
    parameters = _covariances(shapes, sums, sigma_px)
    depth = np.array([each.median_depth for each in sums], dtype=np.float64)
    errors = expected_errors_px(shapes, parameters, sigma_px, depth)
    known = [identifiability_of(shape.camera, own) for shape, own in zip(shapes, parameters, strict=True)]
    columns = (
        errors.tolist(),
        depth.tolist(),
        seen.coverage.tolist(),
        seen.occupied_cells.tolist(),
        [each.misfit for each in sums],
    )
    return list(map(CameraQuality, shapes, misfits, known, *columns))


def _covariances(
    shapes: Sequence[CameraShape], sums: Sequence[PointSums], sigma_px: FloatArray
) -> list[ParameterCovariance]:
    """Covariances of the fitted parameters; of images whose cameras have one model together."""
    places: dict[CameraModel, list[int]] = {}
    for place, shape in enumerate(shapes):
        places.setdefault(shape.camera.model, []).append(place)
    out: dict[int, ParameterCovariance] = {}
    for model, alike in places.items():
        own = [sums[place] for place in alike]
        grams, num_values = np.array([each.gram for each in own]), np.array([each.num_values for each in own])

        def triangle(b: int, norms: FloatArray, own: list[PointSums] = own) -> FloatArray:
            return own[b].triangle(norms)

        found = covariances_of_grams(grams, fitted_names(model), sigma_px[alike], num_values, triangle)
        out.update(zip(alike, found, strict=True))
    return [out[place] for place in range(len(shapes))]


def expected_errors_px(
    shapes: Sequence[CameraShape],
    parameters: Sequence[ParameterCovariance],
    sigma_px: FloatArray,
    depth: FloatArray,
) -> FloatArray:
    """Return `CameraShape.expected_error_px` of B images (B,); NaN where the noise is unknown or nothing is identified.

    Parameters
    ----------
    shapes, parameters : of the images        sigma_px, depth : (B,) px, model units
    """
    out = np.full(len(shapes), np.nan)
    by_shape: dict[int, list[int]] = {}
    for place, (shape, own, sigma) in enumerate(zip(shapes, parameters, sigma_px.tolist(), strict=True)):
        if not math.isfinite(sigma) or own.is_singular or not own.names:
            continue
        if own.names == fitted_names(shape.camera.model):
            by_shape.setdefault(id(shape), []).append(place)
        else:
            out[place] = shape.expected_error_px(own, sigma, float(depth[place]))
    single = [places[0] for places in by_shape.values() if len(places) == 1]
    stacks = [[single[k] for k in stack] for stack in in_stacks([shapes[place].camera for place in single])]
    for places in by_shape.values():
        if len(places) > 1:
            stacks += [places[first : first + AT_ONCE] for first in range(0, len(places), AT_ONCE)]
    for stack in stacks:
        first = shapes[stack[0]]
        shared = len(stack) > 1 and shapes[stack[1]] is first
        columns = _columns_of(first)[None] if shared else _columns_of_all([shapes[place] for place in stack])
        covariance = np.array([parameters[place].covariance for place in stack])
        out[stack] = stack_errors_px(first.camera.model, columns, covariance, sigma_px[stack], depth[stack])
    return out


def _columns_of_all(shapes: Sequence[CameraShape]) -> FloatArray:
    """Columns of the grids of cameras of one model."""
    return columns_of_grids([shape.camera for shape in shapes], np.stack([shape.rays for shape in shapes]))
