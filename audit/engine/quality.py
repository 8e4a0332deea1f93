"""What some images of a model say of their cameras, as the model stands."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from typing import Final

from sfm_audit.audit.camera_quality.joined import qualities_of_joined
from sfm_audit.audit.camera_quality.measure import (
    CameraQuality,
    CameraShape,
    camera_quality,
    camera_quality_in_parts,
)
from sfm_audit.audit.inliers.joined import MAX_JOINED, joined_inliers
from sfm_audit.audit.inliers.projected import image_inliers
from sfm_audit.audit.inliers.residuals import ModelResiduals
from sfm_audit.audit.misfit.in_parts import AT_ONCE
from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.loaders.model import SparseModel

_MAX_POINTS_AT_ONCE: Final = 4096


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
    alike: dict[tuple[int, int], list[int]] = {}
    images = list(image_idxs)
    for place, image_idx in enumerate(images):
        out.append(None)
        rows = residuals.rows(image_idx)
        if rows.start == rows.stop:
            continue
        camera_idx = int(model.images.camera_idx[image_idx])
        if camera_idx not in shapes:
            shapes[camera_idx] = CameraShape.of(model.camera(camera_idx))
        shape = shapes[camera_idx]
        if shape is None:
            continue
        num_inliers = rows.stop - rows.start
        if num_inliers <= MAX_JOINED:
            alike.setdefault((camera_idx, num_inliers), []).append(place)
        else:
            out[place] = _quality_of(shape, model, residuals, image_idx, float(sigma_px[image_idx]), grid=grid)
    for (camera_idx, num_inliers), places in alike.items():
        shape = shapes[camera_idx]
        if shape is None:
            continue
        step = _MAX_POINTS_AT_ONCE // num_inliers
        for part in (places[start : start + step] for start in range(0, len(places), step)):
            own = [images[place] for place in part]
            joined = joined_inliers(model, residuals, own, num_inliers)
            for place, quality in zip(part, qualities_of_joined(shape, joined, sigma_px[own], grid=grid), strict=True):
                out[place] = quality
    return out


def _quality_of(
    shape: CameraShape, model: SparseModel, residuals: ModelResiduals, image_idx: int, sigma_px: float, *, grid: int
) -> CameraQuality | None:
    """What an image with many inliers says."""
    rows = residuals.rows(image_idx)
    if rows.stop - rows.start <= AT_ONCE:
        return camera_quality(shape, image_inliers(model, residuals, image_idx), sigma_px, grid=grid)
    xy_px = model.observations.xy_px.take(residuals.observation_row[rows], axis=0)
    part = partial(image_inliers, model, residuals, image_idx)
    return camera_quality_in_parts(shape, part, xy_px, sigma_px, grid=grid)
