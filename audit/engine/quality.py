"""What some images of a model say of their cameras, as the model stands."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial

from sfm_audit.audit.camera_quality.measure import (
    CameraQuality,
    CameraShape,
    camera_quality,
    camera_quality_in_parts,
)
from sfm_audit.audit.inliers.projected import image_inliers
from sfm_audit.audit.inliers.residuals import ModelResiduals
from sfm_audit.audit.misfit.in_parts import AT_ONCE
from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.loaders.model import SparseModel


def quality_of_images(
    model: SparseModel, residuals: ModelResiduals, sigma_px: FloatArray, image_idxs: Iterable[int], *, grid: int
) -> list[CameraQuality | None]:
    """Return what each of some images says of its camera, None without inliers.

    Parameters
    ----------
    sigma_px : (I,) sigma_constant_px        grid : of occupied_cells

    Notes
    -----
    What depends on a camera alone is computed once for all of these images.
    """
    shapes: dict[int, CameraShape | None] = {}
    out: list[CameraQuality | None] = []
    for image_idx in image_idxs:
        rows = residuals.rows(image_idx)
        if rows.start == rows.stop:
            out.append(None)
            continue
        camera_idx = int(model.images.camera_idx[image_idx])
        if camera_idx not in shapes:
            shapes[camera_idx] = CameraShape.of(model.camera(camera_idx))
        shape = shapes[camera_idx]
        if shape is None:
            out.append(None)
            continue
        sigma = float(sigma_px[image_idx])
        if rows.stop - rows.start > AT_ONCE:
            xy_px = model.observations.xy_px.take(residuals.observation_row[rows], axis=0)
            part = partial(image_inliers, model, residuals, image_idx)
            out.append(camera_quality_in_parts(shape, part, xy_px, sigma, grid=grid))
        else:
            out.append(camera_quality(shape, image_inliers(model, residuals, image_idx), sigma, grid=grid))
    return out
