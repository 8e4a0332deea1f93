"""What do images of one camera and few inliers say about it? Asked of many at once, with `camera_quality`'s answers."""

from __future__ import annotations

import numpy as np

from sfm_audit.audit.camera_quality.expected_error import depths
from sfm_audit.audit.camera_quality.identifiability import fitted_names, identifiability_of, parameter_covariances
from sfm_audit.audit.camera_quality.measure import CameraQuality, CameraShape, quality_from
from sfm_audit.audit.inliers.joined import by_image, flat
from sfm_audit.audit.inliers.projected import ImageInliers
from sfm_audit.audit.misfit import candidate_fields, coincident_keypoints, nuisance_columns, prepare
from sfm_audit.audit.misfit.untestable import untestable_tests
from sfm_audit.loaders.arrays import FloatArray, IntArray


def qualities_of_joined(
    shape: CameraShape, joined: ImageInliers, sigma_px: FloatArray, *, grid: int
) -> list[CameraQuality]:
    """Return `camera_quality` of B images of one camera that have the same number of inliers.

    Parameters
    ----------
    shape : of the camera        joined : from `joined_inliers`
    sigma_px : (B,) sigma_constant_px of each        grid : of occupied_cells
    """
    camera, num_images = shape.camera, len(sigma_px)
    projected = joined.projected
    nuisance = by_image(nuisance_columns(camera.model, projected), num_images)
    fields = by_image(candidate_fields(camera, projected), num_images)
    xy_px = joined.xy_px.reshape(num_images, -1, 2)
    residuals = joined.residuals_px.reshape(2, num_images, -1)
    known = parameter_covariances(flat(nuisance), fitted_names(camera.model), sigma_px)
    depth = np.median(depths(camera, joined.xyz_cam).reshape(num_images, -1), axis=1).tolist()
    tests = untestable_tests(flat(nuisance), flat(fields), _num_pixels(xy_px))
    out = []
    for b, sigma in enumerate(sigma_px.tolist()):
        misfit = tests[b]
        if misfit is None:
            clusters = coincident_keypoints(xy_px[b])
            misfit = prepare(nuisance[b], fields[b], clusters=clusters, overwrite_fields=True).test(residuals[:, b])
        own = identifiability_of(camera, known[b])
        out.append(quality_from(shape, misfit, own, depth[b], xy_px[b], sigma_px=sigma, grid=grid))
    return out


def _num_pixels(xy_px: FloatArray) -> IntArray:
    """(B,) distinct pixels of the keypoints (B, n, 2), see `coincident_keypoints`."""
    pixel = np.floor(xy_px).astype(np.int64)
    order = np.lexsort((pixel[:, :, 1], pixel[:, :, 0]), axis=1)
    ordered = np.take_along_axis(pixel, order[:, :, None], axis=1)
    return np.asarray(1 + (np.diff(ordered, axis=1) != 0).any(axis=2).sum(axis=1))
