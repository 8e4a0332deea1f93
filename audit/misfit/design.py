"""One image's part of the pooled test of its camera: its columns, and what its pose leaves of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from sfm_audit.audit.inliers.projected import ProjectedImage, project_image
from sfm_audit.audit.misfit import basis
from sfm_audit.audit.misfit.fields import candidate_fields
from sfm_audit.audit.misfit.nuisance import fitted_param_idxs
from sfm_audit.loaders.arrays import BoolArray, FloatArray, IntArray
from sfm_audit.loaders.model import CameraRecord

_MAX_KEPT_BYTES: Final = 1 << 25  # 45,000 observations


@dataclass(frozen=True, slots=True, eq=False)
class ImageDesign:
    """One image of the camera.

    pose: (6, 2, n) px per unit.    intrinsics: (k, 2, n) px per unit of the parameters that were fitted.
    fields: (42, 2, n) px per unit. residuals_px: (2, n) observed minus projected.    track: (n,) 0 .. num_tracks - 1.
    """

    pose: FloatArray
    intrinsics: FloatArray
    fields: FloatArray
    residuals_px: FloatArray
    track: IntArray


def image_design(
    camera: CameraRecord,
    xyz_cam: FloatArray,
    residuals_px: FloatArray,
    track: IntArray,
    *,
    param_idxs: tuple[int, ...] | None = None,
) -> ImageDesign:
    """Return an image's part of the pooled test, from its points (n, 3) in the camera frame and residuals (2, n)."""
    return projected_design(camera, project_image(camera, xyz_cam), residuals_px, track, param_idxs=param_idxs)


def projected_design(
    camera: CameraRecord,
    projected: ProjectedImage,
    residuals_px: FloatArray,
    track: IntArray,
    *,
    param_idxs: tuple[int, ...] | None = None,
) -> ImageDesign:
    """Return an image's part of the pooled test, from what ``camera`` predicts for its points and residuals (2, n)."""
    chosen = fitted_param_idxs(camera.model) if param_idxs is None else param_idxs
    fields = candidate_fields(camera, projected)
    return ImageDesign(projected.pose, projected.d_params[list(chosen)], fields, residuals_px, track)


@dataclass(frozen=True, slots=True, eq=False)
class OffPose:
    """One image with its pose profiled: columns (k + 42, 2n), coordinates on the pose before (k + 42, q), y (2n,)."""

    columns: FloatArray
    coordinates: FloatArray
    y: FloatArray
    pose_leverage: FloatArray
    finite: BoolArray


@dataclass(frozen=True, slots=True, eq=False)
class Piece:
    """One image of the camera, its pose profiled; ``part`` is None without observations and where that cannot be done.

    num_intrinsics: columns in front of the fields, of which spherical cameras have none.
    """

    track: IntArray
    num_intrinsics: int
    has_fields: bool
    part: OffPose | None


def piece_of(design: ImageDesign) -> Piece:
    """Profile the pose of an image."""
    part = _off_pose(design) if len(design.track) and len(design.fields) else None
    return Piece(design.track, len(design.intrinsics), bool(len(design.fields)), part)


def remembered(pieces: Callable[[int], Piece]) -> Callable[[int], Piece]:
    """Keep the first images for the next pass, as many as there is memory for; the last pass may use them up."""
    kept: dict[int, Piece] = {}
    num_bytes = 0

    def piece(i: int) -> Piece:
        nonlocal num_bytes
        if i in kept:
            return kept[i]
        found = pieces(i)
        size = 0 if found.part is None else found.part.columns.nbytes
        if num_bytes + size <= _MAX_KEPT_BYTES:
            num_bytes += size
            kept[i] = found
        return found

    return piece


def _off_pose(design: ImageDesign) -> OffPose | None:
    """None where the pose's derivatives are not finite; other columns that are not are zeroed, and said so."""
    pose = basis.unit_columns(design.pose.reshape(len(design.pose), -1))
    if not np.isfinite(pose).all():
        return None
    q = basis.nuisance_basis(pose)
    columns = np.concatenate([design.intrinsics, design.fields]).reshape(-1, q.shape[1])
    finite = np.isfinite(basis.column_norms(columns))
    columns[~finite] = 0.0
    coordinates = basis.project_off_in_place(q, columns)
    basis.project_off_in_place(q, columns)
    y = basis.project_off(q, design.residuals_px.reshape(-1))
    return OffPose(columns, coordinates, y, np.einsum("qm,qm->m", q, q), finite)
