"""The derivatives of the joint system's observations, kept where they are small and made again where they are not."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from sfm_audit.audit.inliers.projected import image_inliers
from sfm_audit.audit.inliers.residuals import ModelResiduals
from sfm_audit.audit.joint.layout import NUM_POSE, Layout
from sfm_audit.audit.kernels import kernels_in_use
from sfm_audit.audit.kernels.joint_parts import DesignInputs, fill_design
from sfm_audit.audit.kernels.threads import over_ranges
from sfm_audit.loaders.arrays import FloatArray, IntArray
from sfm_audit.loaders.model import SparseModel, rotation_from_quat

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
        _fill(out, self.model, self.residuals, self.layout, _Rows(image_idx, source, None))
        return out


def make_design(
    model: SparseModel, residuals: ModelResiduals, layout: Layout, source: IntArray, offsets: IntArray
) -> Design:
    """Differentiate image by image."""
    counts = np.diff(offsets)
    is_kept = counts <= AT_ONCE
    ends = np.cumsum(np.where(is_kept, counts, 0))
    first = np.where(is_kept, ends - counts, -1).astype(np.int64)
    kept = np.zeros((int(ends[-1]) if ends.size else 0, 2, layout.width))
    images = np.flatnonzero(is_kept & (counts > 0))
    inverses = np.linalg.pinv(rotation_from_quat(model.images.quat_cam_from_world_wxyz[images]))  # all at once

    def fill(start: int, stop: int) -> None:
        for image, inverse in zip(images[start:stop].tolist(), inverses[start:stop], strict=True):
            own = source[int(offsets[image]) : int(offsets[image + 1])]
            _fill(kept[first[image] : first[image] + own.size], model, residuals, layout, _Rows(image, own, inverse))

    over_ranges(fill, images.size, counts[images])
    return Design(model, residuals, layout, source, offsets, kept, first)


class _Rows(NamedTuple):
    """Chosen observations (n,) of an image, columns of ModelResiduals; (3, 3) inverse of its rotation if at hand."""

    image_idx: int
    source: IntArray
    world_from_cam: FloatArray | None


def _fill(own: FloatArray, model: SparseModel, residuals: ModelResiduals, layout: Layout, rows: _Rows) -> None:
    """Write the rows of an image's chosen observations."""
    image, source, _ = rows
    inputs = _inputs(model, residuals, layout, rows)
    if inputs is not None and fill_design(own, inputs):
        return
    projected = image_inliers(model, residuals, image, source - residuals.offsets[image]).projected
    own[:, :, : POINT.start] = projected.pose[: POINT.start].transpose(2, 1, 0)
    own[:, :, POINT] = _point_columns(residuals, source)
    params = list(layout.own_param_idxs[int(layout.camera_idx[image])])
    if params:
        own[:, :, NUM_POSE : NUM_POSE + len(params)] = projected.d_params[params].transpose(2, 1, 0)
    else:  # at the poles of a panorama a column may not be finite: no effect there
        own[~np.isfinite(own)] = 0.0


def _inputs(model: SparseModel, residuals: ModelResiduals, layout: Layout, rows: _Rows) -> DesignInputs | None:
    """What the compiled design is made of; None for numpy: panoramas have columns that are not finite."""
    image_idx, source, world_from_cam = rows
    image = model.image(image_idx)
    camera = image.camera
    if not kernels_in_use() or camera is None or camera.model.is_spherical:
        return None
    rotation = image.rotation_cam_from_world
    focals, centre, extras = camera.model.focal_idxs, camera.model.principal_point_idxs, camera.model.extra_idxs
    kinds = {focals[0]: 0} if len(focals) == 1 else {focals[0]: 1, focals[-1]: 2}
    kinds |= {param: 3 + e for e, param in enumerate(extras)}
    params = layout.own_param_idxs[int(layout.camera_idx[image_idx])]
    lens = camera.params[[focals[0], focals[-1], centre[0], centre[-1]]]
    inverse = np.linalg.pinv(rotation) if world_from_cam is None else world_from_cam
    facts = [rotation.ravel(), inverse.ravel(), image.translation_cam_from_world, lens]
    observed = model.observations.xy_px.take(residuals.observation_row[source], axis=0)
    return DesignInputs(
        np.concatenate(facts),
        np.array([kinds[param] for param in params], dtype=np.int64),
        residuals.point_jacobian,
        source,
        int(residuals.offsets[image_idx]),
        model.points.xyz_world.take(residuals.point_idx[source], axis=0),
        observed - residuals.residuals_px.take(source, axis=1).T,
        residuals.d_extra[image_idx],
    )


def _point_columns(residuals: ModelResiduals, source: IntArray) -> FloatArray:
    return residuals.point_jacobian.take(source, axis=2).transpose(2, 0, 1)
