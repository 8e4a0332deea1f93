"""Poses of two runs beside each other: what the tables hold is aligned, and reports are told who moved."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sfm_audit.audit.alignment import PoseComparison, Poses, compare_poses, natural_order, usable_poses
from sfm_audit.reports.compare.keys import ImageKey
from sfm_audit.reports.compare.motion import PoseChange, PoseFragment, StoredPose


def aligned(images: Sequence[ImageKey], before: Sequence[StoredPose], after: Sequence[StoredPose]) -> PoseChange | None:
    """Compare the poses of the same images in two models; None where they cannot be aligned."""
    arrays = [
        (np.array([p.quat_wxyz for p in poses], float), np.array([p.translation for p in poses], float))
        for poses in (before, after)
    ]
    usable = usable_poses(*arrays[0]) & usable_poses(*arrays[1])
    order = [i for i in natural_order([key.image_name for key in images]) if usable[i]]
    if not order:
        return None
    first, second = (Poses.of(quat[order], translation[order]) for quat, translation in arrays)
    depths = [depth for i in order if (depth := before[i].median_depth) is not None and depth > 0]
    unit = float(np.median(depths)) if depths else _spread(first)
    found = compare_poses(first, second, unit)
    return None if found is None else _told([images[i] for i in order], found)


def _spread(poses: Poses) -> float:
    """Median distance of the cameras from the middle: for images that see no points."""
    return float(np.median(np.linalg.norm(poses.centre - np.median(poses.centre, axis=0), axis=1)))


def _told(images: Sequence[ImageKey], found: PoseComparison) -> PoseChange:
    moved = [
        (images[i], f"{found.rotation_deg[i]:.2f} deg, {found.centre_error[i]:.3g} median depths")
        for i in np.flatnonzero(found.moved).tolist()
    ]
    return PoseChange(
        tuple(images),
        float(np.median(found.centre_error[found.main])),
        float(np.median(found.rotation_deg[found.main])),
        tuple(moved),
        tuple(
            PoseFragment(tuple(images[i] for i in one.image_idxs.tolist()), one.turn_deg, one.shift)
            for one in found.fragments
        ),
        found.bending,
    )
