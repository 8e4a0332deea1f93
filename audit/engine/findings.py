"""What do the residuals of a model say against it as a whole? Findings beside those of the loaders."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from sfm_audit.audit.consistency import ModelConsistency, rounded_decimals
from sfm_audit.audit.inliers.stored_errors import StoredErrors, stale_finding
from sfm_audit.audit.joint import JointAudit
from sfm_audit.audit.noise.standardise import ModelTracks
from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.loaders.model import Finding, FindingCode, SparseModel

_REMOVABLE_SHARE: Final = 0.05  # of the squared residuals: above it the 3D points are not at their optimum


def residual_findings(stored: StoredErrors, tracks: ModelTracks, num_points: int, num_exact: int) -> list[Finding]:
    """Return the findings that need residuals.

    Parameters
    ----------
    stored : stored point errors beside recomputed ones          tracks : of all inliers of the model
    num_points : 3D points          num_exact : images whose 2D points are no measurements
    """
    statistics = tracks.statistics
    found = [stale_finding(stored)]
    if num_exact:
        text = (
            f"the 2D points of {num_exact} images are projections of the 3D points, not measurements: ask whether "
            "cameras are plausible and points lie in front of them; to ask whether cameras and poses are right, match "
            "the photos and triangulate (colmap point_triangulator)"
        )
        found.append(Finding(FindingCode.EXACT_PROJECTIONS, num_exact, text))
    elif statistics.removable_sq_px2 > _REMOVABLE_SHARE * statistics.total_sq_px2:
        share = statistics.removable_sq_px2 / statistics.total_sq_px2
        text = f"3D points are not at their optimum: moving them alone removes {share:.1%} of the squared residuals"
        found.append(Finding(FindingCode.POINTS_NOT_OPTIMAL, num_points, text))
    if tracks.too_many_nonstationary:
        count = int(np.count_nonzero(tracks.nonstationary))
        text = f"{count} images are not at the optimum of their poses, too many to leave out of the track statistics"
        found.append(Finding(FindingCode.TRACK_STATISTICS_FROM_ALL_IMAGES, count, text))
    if not tracks.prior.converged and tracks.standardiser is not None:
        text = f"the fit of the noise prior stopped at nu0 = {tracks.prior.nu0:.3g}, s0 = {tracks.prior.s0_px:.3g} px"
        found.append(Finding(FindingCode.NOISE_PRIOR_NOT_CONVERGED, 1, text))
    return [finding for finding in found if finding is not None]


def parts_disagree(findings: Sequence[Finding]) -> bool:
    """Whether one of the findings says that the parts of the model do not belong together."""
    return any(finding.code is FindingCode.PARTS_DISAGREE for finding in findings)


def pose_findings(model: SparseModel) -> list[Finding]:
    """Return that the stored poses are rounded, and what that is worth in px."""
    quaternions, translations = model.images.quat_cam_from_world_wxyz, model.images.translation_cam_from_world
    decimals = rounded_decimals(quaternions, translations)
    if decimals is None:
        return []
    focals = [model.camera(i).params[k] for i in range(len(model.cameras)) for k in model.camera(i).model.focal_idxs]
    turned = f": half a step turns projections by up to {np.median(focals) * 10.0**-decimals:.2g} px" if focals else ""
    text = f"quaternions and translations of all {len(model.images)} images are rounded to {decimals} decimals{turned}"
    return [Finding(FindingCode.ROUNDED_POSES, len(model.images), text)]


def consistency_findings(consistency: ModelConsistency) -> list[Finding]:
    """Return what the images say together about cameras, poses, points and 2D points."""
    return [Finding(FindingCode(found.code.value), found.count, found.text) for found in consistency.findings]


def joint_findings(model: SparseModel, joint: JointAudit | None, tau_px: FloatArray) -> list[Finding]:
    """Return parameters that nobody freed and that the joint system implies, and how it was solved.

    tau_px : (I,) materiality, px
    """
    if joint is None:
        return []
    out = []
    wrong = joint.misfit.effect_px > tau_px  # what such an image implies for its neighbours' cameras is its own error
    for one in joint.implied:
        if one.found and not wrong[one.image_idxs].any():
            images = len(one.image_idxs)
            whose = "all cameras of one size"
            if one.camera_idx is not None:
                whose = f"camera {int(model.cameras.camera_id[one.camera_idx])}"
            values = ", ".join(
                f"{name} {step:+.3g} +- {sd:.1g}" for name, step, sd in zip(one.names, one.step, one.sd, strict=True)
            )
            unit = f" {one.unit}" if one.unit != "1" else ""
            text = f"{whose} ({images} images): freed, it would change by {values}{unit}"
            out.append(Finding(FindingCode(f"implied_{one.parameter}"), images, text))
    if joint.num_blocks > 1:
        text = f"{joint.num_blocks} blocks of covisible images, each by itself"
        out.append(Finding(FindingCode.JOINT_IN_BLOCKS, joint.num_blocks, text))
    return out
