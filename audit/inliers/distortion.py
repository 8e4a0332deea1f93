"""How does a projection change with the distortion? 16 bytes per parameter and inlier, made when they are asked for."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from sfm_audit.audit.cameras import project_columns
from sfm_audit.audit.kernels.projection import Scene, distortion_derivatives
from sfm_audit.loaders.arrays import FloatArray, Int32Array, IntArray
from sfm_audit.loaders.model import SparseModel

_AT_ONCE: Final = 16  # images: who asks for one mostly asks for the next one then
_HELD: Final = 4  # such blocks, for threads that ask at the same time
_FEW: Final = 1 << 12  # inliers; an image with more is made alone, and not held


@dataclass(frozen=True, slots=True, eq=False)
class Projectable:
    """Inliers that can be projected again.

    scene: the model as `audit.kernels.projection` takes it.
    offsets, point_idx: as in `audit.inliers.residuals.ModelResiduals`.
    """

    model: SparseModel
    scene: Scene
    offsets: IntArray
    point_idx: Int32Array

    def has_few(self, image_idx: int) -> bool:
        """Whether the image is made with others."""
        return bool(self.offsets[image_idx + 1] - self.offsets[image_idx] <= _FEW)

    def derivatives(self, image_idxs: Sequence[int]) -> list[FloatArray]:
        """Return what `DistortionDerivatives` holds of some images; none of them without a camera."""
        found = distortion_derivatives(self.scene, self.offsets, self.point_idx, np.array(image_idxs, dtype=np.int64))
        return found if found is not None else [self._by_numpy(image_idx) for image_idx in image_idxs]

    def _by_numpy(self, image_idx: int) -> FloatArray:
        own, image = slice(*self.offsets[image_idx : image_idx + 2].tolist()), self.model.image(image_idx)
        if image.camera is None or not image.camera.model.extra_idxs or own.start == own.stop:
            return np.empty((0, 2, own.stop - own.start))
        xyz_cam = image.cam_from_world(self.model.points.xyz_world.take(self.point_idx[own], axis=0))
        with np.errstate(all="ignore"):
            d_params = project_columns(image.camera.model, image.camera.params, xyz_cam).d_xy_d_params
        return np.empty((0, 2, len(xyz_cam))) if d_params is None else d_params[list(image.camera.model.extra_idxs)]


class DistortionDerivatives:
    """By row of the image table: (e, 2, n) d projection / d distortion parameters of its inliers, px per unit.

    Kept of images that numpy projected, made when asked for of those that the kernel did: it needs a fifth of its time
    for them alone, and no other array of a model is as large and read as seldom.

    Parameters
    ----------
    kept : by row of the image table
    made : gives those that are not kept
    num_images : how many images there are
    """

    def __init__(self, kept: Mapping[int, FloatArray], made: Projectable | None = None, num_images: int = 0) -> None:
        self._kept, self._made, self._num_images = kept, made, num_images
        self._last: Mapping[int, Mapping[int, FloatArray]] = {}

    def __len__(self) -> int:
        """How many images there are."""
        return self._num_images

    def __iter__(self) -> Iterator[FloatArray]:
        """Those of all images, one after the other."""
        return (self[image_idx] for image_idx in range(len(self)))

    def __getitem__(self, image_idx: int, /) -> FloatArray:
        """Those of an image."""
        if image_idx in self._kept:
            return self._kept[image_idx]
        if self._made is None or not 0 <= image_idx < len(self):
            raise IndexError(f"there is no image in row {image_idx}")
        if not self._made.has_few(image_idx):
            return self._made.derivatives([image_idx])[0]
        start, last = image_idx - image_idx % _AT_ONCE, self._last  # another thread may put its own in its place
        block = last.get(start)
        if block is None:
            near = (each for each in range(start, min(start + _AT_ONCE, len(self))) if each not in self._kept)
            images = [each for each in near if self._made.has_few(each)]
            block = dict(zip(images, self._made.derivatives(images), strict=True))
            self._last = {**dict(list(last.items())[1 - _HELD :]), start: block}
        return block[image_idx]

    def of(self, image_idxs: Sequence[int]) -> tuple[FloatArray, ...]:
        """Return those of some images, beside each other in memory where none of them is kept."""
        if self._made is not None and image_idxs and self._kept.keys().isdisjoint(image_idxs):
            return tuple(self._made.derivatives(image_idxs))
        return tuple(self[image_idx] for image_idx in image_idxs)
