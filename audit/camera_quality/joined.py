"""What do images of one camera and few inliers say about it? Asked of many at once, with the answers of `measure`."""

from __future__ import annotations

from functools import partial

import numpy as np

from sfm_audit.audit.camera_quality.coverage import spread_of
from sfm_audit.audit.camera_quality.expected_error import depths
from sfm_audit.audit.camera_quality.identifiability import unit_triangle
from sfm_audit.audit.camera_quality.measure import CameraQuality, CameraShape, PointSums, qualities_of
from sfm_audit.audit.inliers.joined import by_image, flat
from sfm_audit.audit.inliers.projected import ImageInliers
from sfm_audit.audit.misfit import MisfitTests, candidate_fields, coincident_keypoints, nuisance_columns, prepare
from sfm_audit.audit.misfit.untestable import untestable_tests
from sfm_audit.loaders.arrays import FloatArray, IntArray
from sfm_audit.loaders.model import CameraRecord


def qualities_of_joined(
    shape: CameraShape, joined: ImageInliers, sigma_px: FloatArray, *, grid: int
) -> list[CameraQuality]:
    """Return `camera_quality` of B images of one camera that have the same number of inliers.

    Parameters
    ----------
    shape : of the camera        joined : from `joined_inliers`
    sigma_px : (B,) sigma_constant_px of each        grid : of occupied_cells
    """
    num_images = len(sigma_px)
    misfits, sums = zip(*sums_of_joined(shape.camera, joined, num_images), strict=True)
    offsets = np.arange(num_images + 1) * (len(joined.xy_px) // num_images)
    seen = spread_of(joined.xy_px, offsets, [shape.camera] * num_images, grid)
    return qualities_of([shape] * num_images, misfits, sums, seen, sigma_px)


def sums_of_joined(camera: CameraRecord, joined: ImageInliers, num_images: int) -> list[tuple[MisfitTests, PointSums]]:
    """Return `measure.image_sums` of B images of one camera that have the same number of inliers."""
    projected = joined.projected
    nuisance = by_image(nuisance_columns(camera.model, projected), num_images)
    fields = by_image(candidate_fields(camera, projected), num_images)
    xy_px = joined.xy_px.reshape(num_images, -1, 2)
    residuals = joined.residuals_px.reshape(2, num_images, -1)
    columns = flat(nuisance)
    with np.errstate(over="ignore", invalid="ignore"):
        grams = columns @ columns.swapaxes(1, 2)
    depth = np.median(depths(camera, joined.xyz_cam).reshape(num_images, -1), axis=1).tolist()
    tests = untestable_tests(columns, flat(fields), _num_pixels(xy_px))
    out = []
    for b, refused in enumerate(tests):
        misfit = refused
        if misfit is None:
            clusters = coincident_keypoints(xy_px[b])
            misfit = prepare(nuisance[b], fields[b], clusters=clusters, overwrite_fields=True).test(residuals[:, b])
        out.append((misfit, PointSums(grams[b], columns.shape[2], depth[b], partial(unit_triangle, columns[b]))))
    return out


def _num_pixels(xy_px: FloatArray) -> IntArray:
    """(B,) distinct pixels of the keypoints (B, n, 2), see `coincident_keypoints`."""
    pixel = np.floor(xy_px).astype(np.int64)
    order = np.lexsort((pixel[:, :, 1], pixel[:, :, 0]), axis=1)
    ordered = np.take_along_axis(pixel, order[:, :, None], axis=1)
    return np.asarray(1 + (np.diff(ordered, axis=1) != 0).any(axis=2).sum(axis=1))
