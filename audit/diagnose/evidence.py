"""What tells lens, motion and noise apart, beyond the tables? Measured on residuals as the model stands."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from scipy.spatial import cKDTree

from sfm_audit.audit.engine.model import ModelAuditor
from sfm_audit.audit.misfit import (
    GROUPS,
    MisfitGroup,
    camera_tests,
    candidate_fields,
    image_design,
    nuisance_columns,
    prepare,
    project_image,
)
from sfm_audit.audit.misfit.design import ImageDesign
from sfm_audit.audit.misfit.fields import GROUP_COLUMNS
from sfm_audit.loaders.arrays import FloatArray, IntArray

SIGNIFICANT: Final = 0.01
MIN_INLIERS: Final = 50
CELLS_PER_SIDE: Final = 24
NEIGHBOURS_PER_SIDE: Final = 40
SAME_KEYPOINT_PX: Final = 0.5
SMOOTH: Final = MisfitGroup.SMOOTH


def evidence(auditor: ModelAuditor) -> dict[str, float]:
    """Return numbers that tell a lens from motion, and both from errors that neighbours share.

    Returns
    -------
    dict
        ``common_<group>_px``: of the fields that all images have in common.    ``beyond_rs_px``: smooth field that a
        pose linear in the row leaves (median).    ``by_observations``, ``by_cells``, ``beyond_rs``: share of images
        whose smooth field is significant.    ``neighbours``, ``persistence``: correlations of residuals.    NaN where
        nothing says.
    """
    found = [each for i in range(len(auditor.model.images)) if (each := _image_evidence(auditor, i))]
    numbers = {"num_evident": float(len(found)), "persistence": _persistence(auditor), **_common(auditor)}
    for name in ("beyond_rs_px", "by_observations", "by_cells", "beyond_rs", "neighbours"):
        known = [each[name] for each in found if not math.isnan(each[name])]
        pooled = np.median(known) if name.endswith("_px") and known else np.mean(known) if known else math.nan
        numbers[name] = float(pooled)
    return numbers


def _image_evidence(auditor: ModelAuditor, image_idx: int) -> dict[str, float] | None:
    fact, columns = auditor.quality[image_idx], auditor.residuals.rows(image_idx)
    if fact is None or columns.stop - columns.start < MIN_INLIERS:
        return None
    camera, y = fact.shape.camera, auditor.residuals.residuals_px[:, columns]
    inliers = auditor.inliers(image_idx)
    projected = project_image(camera, inliers.image.cam_from_world(inliers.xyz_world))
    nuisance, fields = nuisance_columns(camera.model, projected), candidate_fields(camera, projected)
    shutter = fields[GROUP_COLUMNS[MisfitGroup.ROLLING_SHUTTER]]
    longer = max(camera.width, camera.height)
    cells = _cells(inliers.xy_px, longer / CELLS_PER_SIDE)
    beyond = prepare(np.concatenate([nuisance, shutter]), fields).test(y)[SMOOTH]
    by_observations = prepare(nuisance, fields).test(y)[SMOOTH]
    by_cells = prepare(nuisance, fields, clusters=cells).test(y)[SMOOTH]
    return {
        "beyond_rs_px": beyond.px,
        "beyond_rs": _significant(beyond.p),
        "by_observations": _significant(by_observations.p),
        "by_cells": _significant(by_cells.p),
        "neighbours": _neighbours(inliers.xy_px, y, longer / NEIGHBOURS_PER_SIDE),
    }


def _significant(p: float) -> float:
    return math.nan if math.isnan(p) else float(p < SIGNIFICANT)


def _cells(xy_px: FloatArray, side_px: float) -> IntArray:
    """Number the cells of a grid; equal numbers are in one cell."""
    _, number = np.unique(np.floor(xy_px / side_px), axis=0, return_inverse=True)
    return number.ravel().astype(np.int64)


def _neighbours(xy_px: FloatArray, residuals_px: FloatArray, radius_px: float) -> float:
    """Correlation of residuals (2, n) of points closer than the radius, pairs on one keypoint left out."""
    pairs = cKDTree(xy_px).query_pairs(radius_px, output_type="ndarray")
    apart = np.linalg.norm(xy_px[pairs[:, 0]] - xy_px[pairs[:, 1]], axis=1) > SAME_KEYPOINT_PX
    first, second = pairs[apart].T
    if not first.size:
        return math.nan
    return float(
        (residuals_px[:, first] * residuals_px[:, second]).sum() / first.size / (residuals_px**2).sum(axis=0).mean()
    )


def _persistence(auditor: ModelAuditor) -> float:
    """Correlation of a point's residuals in an image and the next one by name."""
    residuals, order = auditor.residuals, np.argsort(auditor.model.images.name)
    both, squares = 0.0, 0.0
    for i, j in zip(order[:-1].tolist(), order[1:].tolist(), strict=True):
        first, second = residuals.rows(i), residuals.rows(j)
        _, a, b = np.intersect1d(residuals.point_idx[first], residuals.point_idx[second], return_indices=True)
        x, y = residuals.residuals_px[:, first][:, a], residuals.residuals_px[:, second][:, b]
        both += float((x * y).sum())
        squares += 0.5 * float((x**2).sum() + (y**2).sum())
    return both / squares if squares else math.nan


def _common(auditor: ModelAuditor) -> dict[str, float]:
    """Return px of the fields that all images have in common, each image's own pose and intrinsics profiled."""
    used = [
        i for i, fact in enumerate(auditor.quality) if fact is not None and not fact.shape.camera.model.is_spherical
    ]

    def design(k: int) -> ImageDesign:
        fact, columns = auditor.quality[used[k]], auditor.residuals.rows(used[k])
        if fact is None:
            raise ValueError("an image without inliers")
        inliers = auditor.inliers(used[k])
        xyz_cam = inliers.image.cam_from_world(inliers.xyz_world)
        own = image_design(fact.shape.camera, xyz_cam, auditor.residuals.residuals_px[:, columns], inliers.point_idx)
        nuisance = np.concatenate([own.pose, own.intrinsics])
        return ImageDesign(nuisance, own.intrinsics[:0], own.fields, own.residuals_px, own.track)

    tests = camera_tests(design, len(used), len(auditor.model.points)).tests
    return {f"common_{group}_px": tests[group].px for group in GROUPS}
