"""From what the files say to one model: ids become rows, poses are composed, findings are collected."""

from __future__ import annotations

import numpy as np

from sfm_audit.loaders.arrays import FloatArray, UInt64Array
from sfm_audit.loaders.assembly.consistency import find_inconsistencies
from sfm_audit.loaders.assembly.extremes import unused_nonfinite
from sfm_audit.loaders.assembly.lookup import rows_of
from sfm_audit.loaders.assembly.raw import RawModel, RawPoints
from sfm_audit.loaders.assembly.rigs import compose_poses
from sfm_audit.loaders.model import ImageTable, ObservationTable, PointTable, SparseModel


def assemble(raw: RawModel, location: str, file_format: str) -> SparseModel:
    """Return the model that ``raw`` describes; links are those of the images' own point ids.

    Parameters
    ----------
    raw : what the files say
    location : where they lie, as the user gave it
    file_format : name of the format they were read from
    """
    points = PointTable(*_sorted(raw.points))
    placed, rig_findings = compose_poses(raw)
    images = ImageTable(
        image_id=raw.images.image_id,
        name=raw.images.name,
        camera_id=raw.images.camera_id,
        camera_idx=rows_of(raw.cameras.camera_id.astype(np.uint64), raw.images.camera_id).astype(np.int64),
        quat_cam_from_world_wxyz=placed.poses[:, :4].copy(),
        translation_cam_from_world=placed.poses[:, 4:].copy(),
        num_points2d=raw.images.num_points2d,
        frame_idx=placed.frame_idx,
        pose_cam_from_rig=placed.pose_cam_from_rig,
    )
    observations = ObservationTable(
        offsets=raw.images.offsets,
        point2d_idx=raw.images.point2d_idx,
        xy_px=raw.images.xy_px,
        point_idx=rows_of(points.point3d_id, raw.images.point3d_id),
    )
    known = raw.findings + rig_findings + unused_nonfinite(raw, placed.poses)
    model = SparseModel(location, file_format, raw.cameras, images, points, observations, known)
    return SparseModel(
        location,
        file_format,
        raw.cameras,
        images,
        points,
        observations,
        known + find_inconsistencies(model, raw),
    )


def _sorted(points: RawPoints) -> tuple[UInt64Array, FloatArray, FloatArray]:
    """Return ids, xyz and stored errors in the order of the ids; as they are where that is the order of the file."""
    ids, order = points.point3d_id, points.order
    if (ids[1:] > ids[:-1]).all():
        return ids, points.xyz_world, points.stored_error_px
    return ids[order], points.xyz_world[order], points.stored_error_px[order]
