"""Models too large for one dense factor: blocks of covisible images (method.md section 11, size)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import reverse_cuthill_mckee

from sfm_audit.audit.inliers.residuals import ModelResiduals
from sfm_audit.audit.joint.layout import NUM_POSE
from sfm_audit.audit.misfit.nuisance import fitted_param_idxs
from sfm_audit.loaders.arrays import BoolArray, FloatArray, IntArray
from sfm_audit.loaders.model import SparseModel

_CORE_SHARE = 0.5  # of a block's columns; the rest are the neighbours that its images hang on


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """core: (I,) images that the block answers for.    members: (I,) images with columns, the core included."""

    core: BoolArray
    members: BoolArray


def covisible_blocks(
    model: SparseModel,
    residuals: ModelResiduals,
    max_columns: int,
    frame_idx: IntArray | None = None,
    usable: BoolArray | None = None,
) -> list[Block]:
    """Split a model into blocks of at most ``max_columns`` columns each; one block of all images where that is enough.

    ``usable`` (I,): images that may have columns; the others cost nothing and go with their neighbours. All when None.

    Cores are runs of the reverse Cuthill-McKee order of the covisibility graph; the images that share most points with
    a core join it. Images of one frame stay together. What lies outside of a block is dropped with its observations:
    the block's own gauge, and standard deviations as if there were nothing else (too large rather than too small).
    """
    num_images = len(model.images)
    frames = np.arange(num_images) if frame_idx is None else np.unique(frame_idx, return_inverse=True)[1]
    width = _widths(model, frames, np.ones(num_images, dtype=bool) if usable is None else usable)
    if width.sum() <= max_columns:
        everything = np.ones(num_images, dtype=bool)
        return [Block(everything, everything)]
    shared = _covisibility(residuals, frames, len(model.points))
    order = reverse_cuthill_mckee(shared, symmetric_mode=True)
    run = (np.cumsum(width[order]) - width[order]) // max(1.0, _CORE_SHARE * max_columns)
    blocks = []
    for number in np.unique(run).tolist():
        core = np.zeros(len(width), dtype=bool)
        core[order[run == number]] = True
        links = np.asarray(shared[core].sum(axis=0)).ravel()
        links[core] = 0
        nearest = np.argsort(-links, kind="stable")
        room = np.cumsum(width[nearest]) <= max_columns - width[core].sum()
        members = core.copy()
        members[nearest[room & (links[nearest] > 0)]] = True
        blocks.append(Block(core[frames], members[frames]))
    return blocks


def _widths(model: SparseModel, frames: IntArray, usable: BoolArray) -> FloatArray:
    """(F,) columns of each frame; a camera's are shared out among its frames."""
    count = np.array([len(fitted_param_idxs(model.camera(c).model)) for c in range(len(model.cameras))], dtype=float)
    camera = model.images.camera_idx
    per_image = np.zeros(len(camera))
    known = (camera >= 0) & usable
    per_image[known] = count[camera[known]] / np.bincount(camera[known], minlength=len(count))[camera[known]]
    own = np.bincount(frames, per_image)
    return np.asarray(own + NUM_POSE * (np.bincount(frames, usable) > 0))


def _covisibility(residuals: ModelResiduals, frames: IntArray, num_points: int) -> sparse.csr_array:
    """(F, F) how many points two frames share."""
    frame = np.repeat(frames, np.diff(residuals.offsets))
    shape = (int(frames.max()) + 1, num_points)
    seen = sparse.coo_array((np.ones(frame.size), (frame, residuals.point_idx)), shape=shape).tocsr()
    seen.data[:] = 1.0
    return sparse.csr_array(seen @ seen.T)
