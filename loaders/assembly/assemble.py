"""From what the files say to one model: ids become rows, poses are composed, findings are collected."""

from __future__ import annotations

import numpy as np

from sfm_audit.loaders.assembly.consistency import find_inconsistencies
from sfm_audit.loaders.assembly.extremes import unused_nonfinite
from sfm_audit.loaders.assembly.lookup import rows_of
from sfm_audit.loaders.assembly.raw import RawModel
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
    order = raw.points.order
    points = PointTable(
        point3d_id=raw.points.point3d_id[order],
        xyz_world=raw.points.xyz_world[order],
        stored_error_px=raw.points.stored_error_px[order],
    )
    placed, rig_findings = compose_poses(raw)
    images = ImageTable(
        image_id=raw.images.image_id,
        name=raw.images.name,
        camera_id=raw.images.camera_id,
        camera_idx=rows_of(raw.cameras.camera_id.astype(np.uint64), raw.images.camera_id.astype(np.uint64)),
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
