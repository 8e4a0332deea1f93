"""Which unknown of the joint system stands in which column? (method.md section 11, (6))."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from sfm_audit.audit.misfit.nuisance import fitted_param_idxs
from sfm_audit.loaders.arrays import BoolArray, FloatArray, IntArray
from sfm_audit.loaders.model import SparseModel

NUM_POSE: Final = 6


def median_of(values: FloatArray, images: IntArray) -> float:
    """Return the median over some images of values (I,); most cameras have one image, and numpy's median is slow."""
    return float(values[images[0]] if images.size == 1 else np.median(values[images]))


@dataclass(frozen=True, slots=True, eq=False)
class Layout:
    """Columns of the joint system: six per frame, and the own parameters of each camera.

    frame_idx: (I,) images of equal number move together, -1 where an image has no columns.
    image_from_frame: (I, 6, 6) what a perturbation of the frame (rotation, translation, in the frame's axes) does to
    the image's own pose, both as left perturbations.
    camera_idx: (I,) rows of CameraTable, -1 where an image has no columns.
    own_param_idxs: per camera, which of its parameters are unknowns: all but the principal point.
    columns: (I, 6 + Q) of each image, the pose first; ``num_columns`` where a camera has fewer than Q own parameters.
    own_columns: (C,) first own column of each camera.    num_columns: D, unknowns without points.
    has_rigs: whether image_from_frame says anything.
    """

    frame_idx: IntArray
    image_from_frame: FloatArray
    camera_idx: IntArray
    own_param_idxs: tuple[tuple[int, ...], ...]
    columns: IntArray
    own_columns: IntArray
    num_columns: int
    has_rigs: bool

    @property
    def width(self) -> int:
        """Columns of an image, padding included."""
        return int(self.columns.shape[1])

    @property
    def has_columns(self) -> BoolArray:
        """(I,) images that take part."""
        return np.asarray(self.camera_idx >= 0)

    def takes_part(self, image_idx: int) -> bool:
        """Whether an image does, without a look at all the others."""
        return bool(self.camera_idx[image_idx] >= 0)

    def own_of_camera(self, camera_idx: int) -> IntArray:
        """Columns of a camera's own parameters."""
        return np.asarray(self.own_columns[camera_idx] + np.arange(len(self.own_param_idxs[camera_idx])))

    def own_of_image(self, image_idx: int) -> IntArray:
        """Columns of the own parameters of an image's camera."""
        return self.own_of_camera(int(self.camera_idx[image_idx]))

    def pose_of_image(self, image_idx: int) -> IntArray:
        """Columns of the pose of an image (of its frame)."""
        return np.asarray(self.columns[image_idx, :NUM_POSE])

    def images_of_camera(self, camera_idx: int) -> IntArray:
        """Images with columns that belong to a camera."""
        return np.flatnonzero(self.camera_idx == camera_idx)

    def group_of_column(self) -> IntArray:
        """(D,) number of what each column is of: a frame, or a camera."""
        starts = np.concatenate([self.columns[self.has_columns, 0], self.own_columns])
        starts = np.unique(starts[starts < self.num_columns])
        return np.asarray(np.searchsorted(starts, np.arange(self.num_columns), side="right") - 1)


def make_layout(
    model: SparseModel, used: BoolArray, frame_idx: IntArray | None, image_from_frame: FloatArray | None
) -> Layout:
    """Number the columns of the images that are ``used`` (I,).

    Parameters
    ----------
    frame_idx : (I,) images of equal number >= 0 move together; one frame per image when None
    image_from_frame : (I, 6, 6), see `Layout`; identities when None
    """
    num_images, num_cameras = len(model.images), len(model.cameras)
    frames = np.arange(num_images) if frame_idx is None else np.asarray(frame_idx, dtype=np.int64)
    camera_idx = np.where(used, model.images.camera_idx, -1)
    seen = np.bincount(camera_idx[camera_idx >= 0], minlength=num_cameras) > 0
    own = [fitted_param_idxs(model.camera(k).model) if is_seen else () for k, is_seen in enumerate(seen.tolist())]
    first, dense = np.unique(frames[used], return_index=True, return_inverse=True)[1:]
    frame = np.full(num_images, -1, dtype=np.int64)
    frame[used] = dense
    counts = np.array([len(params) for params in own], dtype=np.int64)
    pose_columns, own_columns, num_columns = _numbered(np.flatnonzero(used)[first], camera_idx, counts)
    extra = int(counts.max(initial=0))
    columns = np.full((num_images, NUM_POSE + extra), num_columns, dtype=np.int64)
    columns[used, :NUM_POSE] = pose_columns[frame[used], None] + np.arange(NUM_POSE)
    offset = np.arange(extra)
    wanted = own_columns[camera_idx[used], None] + offset
    columns[used, NUM_POSE:] = np.where(offset < counts[camera_idx[used], None], wanted, num_columns)
    transforms = np.tile(np.eye(NUM_POSE), (num_images, 1, 1)) if image_from_frame is None else image_from_frame
    return Layout(
        frame, transforms, camera_idx, tuple(own), columns, own_columns, num_columns, image_from_frame is not None
    )


def _numbered(first_of_frame: IntArray, camera_idx: IntArray, counts: IntArray) -> tuple[IntArray, IntArray, int]:
    """First column of each frame and of each camera, and their number.

    A camera follows the first frame that it was seen in: what is used together lies together in memory.
    """
    num_frames = len(first_of_frame)
    last = len(camera_idx)
    first_of_camera = np.full(len(counts), last, dtype=np.int64)
    images = np.flatnonzero(camera_idx >= 0)
    np.minimum.at(first_of_camera, camera_idx[images], images)
    order = np.argsort(np.concatenate([2 * first_of_frame, 2 * first_of_camera + 1]), kind="stable")
    widths = np.concatenate([np.full(num_frames, NUM_POSE), counts])
    starts = np.empty(len(widths), dtype=np.int64)
    starts[order] = np.cumsum(widths[order]) - widths[order]
    return starts[:num_frames], starts[num_frames:], int(widths.sum())
