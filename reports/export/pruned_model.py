"""A COLMAP model without some of its images: what goes with them, and how it is written.

With an image go its observations; a 3D point that fewer than two images still see goes too. What stays is not touched:
poses, cameras, rigs, points, colours and stored errors are those of the model (a stored error is then the mean over the
*former* track). Cameras and rigs that no image uses any more stay as well: ids, and the rigs that refer to them, hold.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import pycolmap

from sfm_audit.loaders import SparseModel, open_model
from sfm_audit.loaders.arrays import BoolArray
from sfm_audit.loaders.assembly.raw import offsets_of
from sfm_audit.loaders.errors import MalformedFileError
from sfm_audit.loaders.formats import format_named, writer_of, written_file_names
from sfm_audit.loaders.model import FindingCode, ObservationTable
from sfm_audit.loaders.model_format import ModelWriter
from sfm_audit.loaders.paths.files import exists

MODEL_FILES: Final = frozenset(written_file_names())
MIN_VIEWS: Final = 2
_CAMERA: Final = pycolmap.SensorType.CAMERA


@dataclass(frozen=True, slots=True, eq=False)
class Pruning:
    """What goes. keeps_image: (I,), keeps_point: (P,), keeps_observation: (M,), rows of the model's tables."""

    keeps_image: BoolArray
    keeps_point: BoolArray
    keeps_observation: BoolArray


def plan_pruning(model: SparseModel, removed_ids: AbstractSet[int]) -> Pruning:
    """Decide what goes with the images ``removed_ids``: a kept point is seen by at least two kept images.

    Two observations in one image are one view. A point that had fewer than two views before goes as well.
    """
    keeps_image = ~np.isin(model.images.image_id, sorted(removed_ids))
    observations = model.observations
    image_idx = np.repeat(np.arange(len(model.images)), np.diff(observations.offsets))
    is_view = keeps_image[image_idx] & (observations.point_idx >= 0)
    num_points = max(len(model.points), 1)
    views = np.unique(image_idx[is_view] * num_points + observations.point_idx[is_view]) % num_points
    keeps_point = np.bincount(views, minlength=num_points)[: len(model.points)] >= MIN_VIEWS
    keeps_observation = is_view.copy()
    keeps_observation[is_view] = keeps_point[observations.point_idx[is_view]]
    return Pruning(keeps_image, keeps_point, keeps_observation)


def write_pruned(model: SparseModel, pruning: Pruning, folder: Path) -> None:
    """Write the model without what goes into the existing, empty ``folder``: in its own format, by pycolmap.

    What was written is read again and compared with what should have been kept.

    Parameters
    ----------
    model : as `loaders.open_model` read it from ``model.location``

    Raises
    ------
    LoadError
        The model contradicts itself, its format is only read, or pycolmap refuses it or reads it as another one.
    OSError
        The files cannot be written.
    """
    findings = {finding.code: finding.text for finding in model.findings}
    for code in (FindingCode.TRACKS_DISAGREE, FindingCode.DANGLING_POINT_IDS):
        if code in findings:
            raise _refused(model, "a model whose images and tracks agree", findings[code])
    writer = writer_of(model)
    reconstruction = _read(model, writer)
    _remove_points(reconstruction, model, pruning)
    _remove_images(reconstruction, set(model.images.image_id[~pruning.keeps_image].tolist()))
    writer.write(reconstruction, folder)
    optional = format_named(model.file_format).optional
    if not all(exists(Path(model.location) / name) for name in optional):
        for name in optional:  # pycolmap writes what it made up for a model without
            (folder / name).unlink(missing_ok=True)
    _compare(model, pruning, open_model(folder))


def _read(model: SparseModel, writer: ModelWriter) -> pycolmap.Reconstruction:
    try:
        return writer.read(model)
    except (ValueError, RuntimeError, IndexError) as error:
        got = f"one that pycolmap refuses ({' '.join(str(error).split())[:200]})"
        raise _refused(model, "a model that pycolmap can read", got) from error


def _remove_points(reconstruction: pycolmap.Reconstruction, model: SparseModel, pruning: Pruning) -> None:
    """Remove points with too few views, then what removed images see of the others: always three or more elements."""
    for point3d_id in model.points.point3d_id[~pruning.keeps_point].tolist():
        reconstruction.delete_point3D(point3d_id)
    observations = model.observations
    for image_idx in np.flatnonzero(~pruning.keeps_image).tolist():
        first, last = observations.offsets[image_idx : image_idx + 2]
        rows = np.arange(first, last)[pruning.keeps_point[observations.point_idx[first:last]]]
        image_id = int(model.images.image_id[image_idx])
        for point2d_idx in observations.point2d_idx[rows].tolist():
            reconstruction.delete_observation(image_id, point2d_idx)


def _remove_images(reconstruction: pycolmap.Reconstruction, removed_ids: AbstractSet[int]) -> None:
    """Take images out of their frames; a frame that keeps no image goes, with what its other sensors saw."""
    frames = []
    for frame in reconstruction.frames.values():
        data = [one for one in frame.data_ids if one.sensor_id.type != _CAMERA or one.id not in removed_ids]
        if not any(one.sensor_id.type == _CAMERA for one in data):
            continue
        kept = pycolmap.Frame()
        kept.frame_id, kept.rig_id = frame.frame_id, frame.rig_id
        if frame.has_pose():
            kept.rig_from_world = frame.rig_from_world
        for one in data:
            kept.add_data_id(one)
        frames.append(kept)
    rigs = list(reconstruction.rigs.values())
    for image_id in removed_ids:
        if image_id in reconstruction.images:
            del reconstruction.images[image_id]
    reconstruction.set_rigs_and_frames(rigs, frames)


def _compare(model: SparseModel, pruning: Pruning, written: SparseModel) -> None:
    """Refuse a pruned model that is not equal to the model on what was kept."""
    wanted = kept_part(model, pruning)
    same = {
        "images": wanted.images.name == written.images.name
        and np.array_equal(wanted.images.image_id, written.images.image_id)
        and np.array_equal(wanted.images.camera_id, written.images.camera_id)
        and np.array_equal(wanted.images.num_points2d, written.images.num_points2d),
        "poses": _equal(wanted.images.quat_cam_from_world_wxyz, written.images.quat_cam_from_world_wxyz)
        and _equal(wanted.images.translation_cam_from_world, written.images.translation_cam_from_world),
        "cameras": np.array_equal(wanted.cameras.camera_id, written.cameras.camera_id)
        and _equal(wanted.cameras.params, written.cameras.params),
        "3D points": np.array_equal(wanted.points.point3d_id, written.points.point3d_id)
        and _equal(wanted.points.xyz_world, written.points.xyz_world),
        "observations": np.array_equal(wanted.observations.offsets, written.observations.offsets)
        and np.array_equal(wanted.observations.point2d_idx, written.observations.point2d_idx)
        and np.array_equal(wanted.observations.point_idx, written.observations.point_idx)
        and _equal(wanted.observations.xy_px, written.observations.xy_px),
    }
    different = [name for name, is_same in same.items() if not is_same]
    if different:
        got = f"one that pycolmap writes with other {' and '.join(different)}"
        raise _refused(model, "a model that pycolmap reads as it is", got)


def kept_part(model: SparseModel, pruning: Pruning) -> SparseModel:
    """Return what of ``model`` is kept, as a model: rows as they are, point_idx counted anew."""
    images, points, observations = model.images, model.points, model.observations
    number = np.cumsum(pruning.keeps_point) - 1
    rows = np.flatnonzero(pruning.keeps_observation)
    image_idx = np.repeat(np.arange(len(images)), np.diff(observations.offsets))
    counts = np.bincount(image_idx[rows], minlength=len(images))
    keeps = pruning.keeps_image
    names = tuple(name for name, is_kept in zip(images.name, keeps, strict=True) if is_kept)
    stored = {field.name: getattr(images, field.name) for field in dataclasses.fields(images) if field.name != "name"}
    columns = {name: values[keeps] for name, values in stored.items() if values is not None}
    return dataclasses.replace(
        model,
        images=dataclasses.replace(images, name=names, **columns),
        points=dataclasses.replace(
            points,
            point3d_id=points.point3d_id[pruning.keeps_point],
            xyz_world=points.xyz_world[pruning.keeps_point],
            stored_error_px=points.stored_error_px[pruning.keeps_point],
        ),
        observations=ObservationTable(
            offsets_of(counts[keeps]),
            observations.point2d_idx[rows],
            observations.xy_px[rows],
            number[observations.point_idx[rows]].astype(np.int32),
        ),
    )


def _equal(wanted: np.ndarray, got: np.ndarray) -> bool:
    """Equal to the last digits: text has 17 of them, and poses of rigs are multiplied in another order."""
    return wanted.shape == got.shape and np.allclose(wanted, got, rtol=1e-12, atol=1e-12, equal_nan=True)


def _refused(model: SparseModel, wanted: str, got: str) -> MalformedFileError:
    advice = "repair or export the reconstruction again; --list names the kept images all the same"
    return MalformedFileError(model.location, None, wanted, got, advice)
