"""The derivatives of the joint system's observations, kept where they are small and made again where they are not."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Final, NamedTuple

import numpy as np

from sfm_audit.audit.inliers.projected import image_inliers
from sfm_audit.audit.inliers.residuals import ModelResiduals
from sfm_audit.audit.joint.layout import NUM_POSE, Layout
from sfm_audit.audit.kernels import kernels_in_use
from sfm_audit.audit.kernels.checked import aligned_zeros
from sfm_audit.audit.kernels.joint_parts import DesignInputs, fill_design
from sfm_audit.audit.kernels.threads import over_ranges
from sfm_audit.loaders.arrays import BoolArray, FloatArray, IntArray
from sfm_audit.loaders.camera_models import CameraModel
from sfm_audit.loaders.model import CameraRecord, SparseModel, rotation_from_quat

AT_ONCE: Final = 2**15
"""Observations of an image up to which its derivatives are kept, and all its fields in memory at the same time."""
PART: Final = 2**13
"""Observations of a larger image, or points, of which derivatives and fields are in memory at the same time."""
EVERY: Final = slice(None)
POINT: Final = slice(3, 6)
"""Columns of J in the design."""


@dataclass(frozen=True, slots=True, eq=False)
class Design:
    """(n, 2, C) rotation columns of N, J in place of translation columns, own columns; zero in padding.

    model, residuals, layout: what it is made from.
    source: (n,) columns of ModelResiduals.    offsets: (I + 1,) image i owns rows offsets[i]:offsets[i + 1].
    kept: (m, 2, C) of the images that have 32,768 observations or fewer.    first: (I,) their first row in it, else -1.
    """

    model: SparseModel
    residuals: ModelResiduals
    layout: Layout
    source: IntArray
    offsets: IntArray
    kept: FloatArray
    first: IntArray

    def of(self, image_idx: int, chosen: slice | IntArray = EVERY) -> FloatArray:
        """(n_i, 2, C) of an image, or of some of its observations."""
        start, stop = self.offsets[image_idx : image_idx + 2].tolist()
        if self.first[image_idx] < 0:
            return self._made(image_idx, chosen)
        first = int(self.first[image_idx])
        return self.kept[first : first + stop - start][chosen]

    def at(self, views: IntArray | slice) -> FloatArray:
        """(v, 2, C) of some observations, those of an image one after the other."""
        if (self.first >= 0).all():
            return self.kept[views]
        rows = np.arange(self.source.size)[views] if isinstance(views, slice) else views
        out = np.empty((len(rows), 2, self.layout.width))
        image_idx = np.searchsorted(self.offsets, rows, side="right") - 1
        starts = np.flatnonzero(np.diff(image_idx, prepend=-1))
        for start, stop in zip(starts.tolist(), [*starts[1:].tolist(), len(rows)], strict=True):
            image = int(image_idx[start])
            out[start:stop] = self.of(image, rows[start:stop] - int(self.offsets[image]))
        return out

    def jacobian(self, image_idx: int, chosen: slice | IntArray = EVERY) -> FloatArray:
        """J (n_i, 2, 3) of an image, px per model unit, world frame."""
        if self.first[image_idx] >= 0:
            return self.of(image_idx, chosen)[:, :, POINT]
        return _point_columns(self.residuals, self.source[self._rows(image_idx)][chosen])

    def _rows(self, image_idx: int) -> slice:
        return slice(int(self.offsets[image_idx]), int(self.offsets[image_idx + 1]))

    def _made(self, image_idx: int, chosen: slice | IntArray) -> FloatArray:
        source = self.source[self._rows(image_idx)][chosen]
        out = np.zeros((source.size, 2, self.layout.width))
        ends = np.array([0, source.size], dtype=np.int64)
        _fill(out, self.model, self.residuals, self.layout, _Rows(np.array([image_idx]), ends, source))
        return out


def make_design(
    model: SparseModel, residuals: ModelResiduals, layout: Layout, source: IntArray, offsets: IntArray
) -> Design:
    """Differentiate, some images at a time."""
    counts = np.diff(offsets)
    is_kept = counts <= AT_ONCE
    ends = np.cumsum(np.where(is_kept, counts, 0))
    first = np.where(is_kept, ends - counts, -1).astype(np.int64)
    kept = aligned_zeros((int(ends[-1]) if ends.size else 0, 2, layout.width))
    images = np.flatnonzero(is_kept & (counts > 0))
    of_kept = source if is_kept.all() else source[np.repeat(is_kept, counts)]

    def fill(start: int, stop: int) -> None:
        some = images[start:stop]
        rows = slice(int(first[some[0]]), int(ends[some[-1]]))
        starts = np.append(first[some], rows.stop) - rows.start
        _fill(kept[rows], model, residuals, layout, _Rows(some, starts, of_kept[rows]))

    over_ranges(fill, images.size, counts[images])
    return Design(model, residuals, layout, source, offsets, kept, first)


class _Rows(NamedTuple):
    """Chosen observations (n,) of images (k,), columns of ModelResiduals; where each image's begin, (k + 1,)."""

    images: IntArray
    offsets: IntArray
    source: IntArray

    def of(self, k: int) -> _Rows:
        """Return those of one of the images."""
        start, stop = self.offsets[k : k + 2].tolist()
        return _Rows(self.images[k : k + 1], np.array([0, stop - start]), self.source[start:stop])


def _fill(own: FloatArray, model: SparseModel, residuals: ModelResiduals, layout: Layout, rows: _Rows) -> None:
    """Write the rows of chosen observations, which are zero."""
    done = np.zeros(len(rows.images), dtype=bool)
    if kernels_in_use():
        inputs, done = _inputs(model, residuals, layout, rows)
        done &= fill_design(own, inputs)
    for k in np.flatnonzero(~done).tolist():
        part = slice(int(rows.offsets[k]), int(rows.offsets[k + 1]))
        _fill_image(own[part], model, residuals, layout, rows.of(k))


def _fill_image(own: FloatArray, model: SparseModel, residuals: ModelResiduals, layout: Layout, rows: _Rows) -> None:
    """The same of one image, by numpy."""
    image, source = int(rows.images[0]), rows.source
    projected = image_inliers(model, residuals, image, source - residuals.offsets[image]).projected
    own[:, :, : POINT.start] = projected.pose[: POINT.start].transpose(2, 1, 0)
    own[:, :, POINT] = _point_columns(residuals, source)
    params = list(layout.own_param_idxs[int(layout.camera_idx[image])])
    if params:
        own[:, :, NUM_POSE : NUM_POSE + len(params)] = projected.d_params[params].transpose(2, 1, 0)
    else:  # at the poles of a panorama a column may not be finite: no effect there
        own[~np.isfinite(own)] = 0.0


def _inputs(
    model: SparseModel, residuals: ModelResiduals, layout: Layout, rows: _Rows
) -> tuple[DesignInputs, BoolArray]:
    """What the compiled design is made of, and (k,) for whom it holds; panoramas have columns that are not finite."""
    images, source = rows.images, rows.source
    rotation = rotation_from_quat(model.images.quat_cam_from_world_wxyz[images])
    lens = np.ones((images.size, 4))
    kinds = np.full((images.size, layout.width - NUM_POSE), -1, dtype=np.int64)
    holds = np.zeros(images.size, dtype=bool)
    for k, camera_idx in enumerate(model.images.camera_idx[images].tolist()):
        camera = model.camera(camera_idx) if camera_idx >= 0 else None
        if camera is not None and not camera.model.is_spherical:
            lens[k], holds[k] = _lens(camera), True
            params = layout.own_param_idxs[int(layout.camera_idx[images[k]])]
            kinds[k, : len(params)] = [_kinds(camera.model)[param] for param in params]
    flat = rotation.reshape(-1, 9), np.linalg.pinv(rotation).reshape(-1, 9)
    inputs = DesignInputs(
        rows.offsets,
        np.hstack([*flat, model.images.translation_cam_from_world[images], lens]),
        kinds,
        residuals.point_jacobian,
        residuals.residuals_px,
        source,
        residuals.offsets[images],
        residuals.point_idx,
        residuals.observation_row,
        model.points.xyz_world,
        model.observations.xy_px,
        residuals.d_extra.of(images.tolist()),
    )
    return inputs, holds


def _lens(camera: CameraRecord) -> FloatArray:
    """(4,) fx, fy, cx, cy."""
    focals, centre = camera.model.focal_idxs, camera.model.principal_point_idxs
    return camera.params[[focals[0], focals[-1], centre[0], centre[-1]]]


@cache
def _kinds(model: CameraModel) -> dict[int, int]:
    """Which derivative each parameter has: see `DesignInputs`."""
    focals = model.focal_idxs
    kinds = {focals[0]: 0} if len(focals) == 1 else {focals[0]: 1, focals[-1]: 2}
    return kinds | {param: 3 + e for e, param in enumerate(model.extra_idxs)}


def _point_columns(residuals: ModelResiduals, source: IntArray) -> FloatArray:
    return residuals.point_jacobian.take(source, axis=2).transpose(2, 0, 1)
