"""From the joint system and the consistency of a model to the numbers that decide about one image."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any, Final

import numpy as np

from sfm_audit.audit.camera_quality.identifiability import ParameterCovariance, fitted_names
from sfm_audit.audit.camera_quality.measure import CameraQuality
from sfm_audit.audit.consistency import ImageConsistency
from sfm_audit.audit.decision.diagnostics import (
    CameraDiagnostics,
    ConsistencyDiagnostics,
    Gains,
    GroupDiagnostics,
    MisfitDiagnostics,
    OwnDiagnostics,
    OwnStep,
    SharedMisfit,
    Worth,
)
from sfm_audit.audit.joint import CameraStep, Implied, ImpliedParameter, JointAudit, JointTest
from sfm_audit.audit.table.words import GROUPS, MisfitStatus
from sfm_audit.loaders.arrays import FloatArray, IntArray

NO_TEST = GroupDiagnostics(math.nan, math.nan, -math.inf, MisfitStatus.NO_COLUMNS)
"""A group of an image that takes no part in the joint system."""


def misfit_diagnostics(
    joint: JointAudit, image_idx: int, sigma_px: float, shared: SharedMisfit | None
) -> MisfitDiagnostics:
    """Return the joint tests of an image; ``shared``: what its camera's images say together."""
    num = int(joint.num_observations[image_idx])
    groups = {group: _group(joint.misfit.tests[image_idx][group], num) for group in GROUPS}
    return MisfitDiagnostics(groups, num, sigma_px, shared)


def untested_misfit(num_inliers: int, sigma_px: float, status: MisfitStatus) -> MisfitDiagnostics:
    """Return that no group was tested, and why."""
    return MisfitDiagnostics(dict.fromkeys(GROUPS, replace(NO_TEST, status=status)), num_inliers, sigma_px)


def _group(test: JointTest, num_observations: int) -> GroupDiagnostics:
    worth = Worth(test.worth.rotation_deg, test.worth.centre_rel, test.worth.focal_rel)
    return GroupDiagnostics(test.q, test.px, test.bic(num_observations), test.status, test.rank, worth)


def consistency_diagnostics(image: ImageConsistency, *, all_behind: bool) -> ConsistencyDiagnostics:
    """Return what is known of the parts of an image; ``all_behind``: all observations of the model are.

    An image with too few observations to be called inconsistent, all of them behind it, says so by itself.
    """
    text = "" if image.explanation is None else image.explanation.text
    all_behind = all_behind or (image.inconsistent is None and image.num_linked > 0 and image.share_in_front == 0.0)
    if all_behind:
        text = f"all {image.num_linked} observations lie behind the camera: axes flipped, or poses inverted?"
    return ConsistencyDiagnostics(image.inconsistent, text, image.rms_px, all_behind)


def own_diagnostics(step: CameraStep, sigma_px: float) -> OwnDiagnostics:
    """Return the own parameters of a camera in the joint system; sigma_px of its images."""
    agreed = step.agreed
    steps = tuple(
        OwnStep(name, float(step.stored[k]), float(step.implied[k]), float(agreed[k]), float(step.sd[k]))
        for k, name in enumerate(step.names)
    )
    return OwnDiagnostics(min(step.own_step_px, step.plain_step_px), sigma_px, len(step.image_idxs), steps)


def gains_of(joint: JointAudit, image_idx: int) -> Gains:
    """Return what freeing pose, camera, both would gain."""
    gains = joint.gains[image_idx]
    return Gains(gains.pose, gains.camera, gains.both)


def joint_camera(camera: CameraDiagnostics, quality: CameraQuality, step: CameraStep) -> CameraDiagnostics:
    """Return the numbers of a camera with the deviations of the joint system in place of the conditional ones."""
    model = quality.shape.camera.model
    k1 = model.param_names[model.extra_idxs[0]] if model.extra_idxs else ""
    sd_k1 = float(step.sd[step.names.index(k1)]) if k1 in step.names else math.nan
    lost = camera.has_focal and not step.focal_identified
    return replace(
        camera, sd_focal_rel=step.sd_focal_rel, sd_k1=sd_k1, is_singular=camera.is_singular or lost, is_joint=True
    )


def expected_error_px(quality: CameraQuality, covariance: FloatArray, sigma_px: float) -> float:
    """Return the expected error of a measurement from the joint covariance of pose and own parameters, px."""
    camera = quality.shape.camera
    if not math.isfinite(sigma_px) or not covariance.size or not math.isfinite(covariance.sum()):
        return math.nan
    parameters = ParameterCovariance(fitted_names(camera.model), covariance, 1.0)
    return quality.shape.expected_error_px(parameters, sigma_px, quality.median_depth)


def pose_columns(joint: JointAudit, image_idx: int, names: Sequence[str]) -> dict[str, object]:
    """Return the columns of how well the pose of an image is known; none where nobody asked."""
    if not joint.poses:
        return {}
    pose = joint.poses[image_idx]
    known = math.isfinite(pose.sd_rotation_deg)
    return {
        "sd_rotation_deg": pose.sd_rotation_deg,
        "sd_centre": pose.sd_centre,
        "pose_sds": pose.sds if known else None,
        "pose_correlations": below_diagonal(pose.correlation) if known else None,
        "sd_neighbour": None if pose.neighbour_idx is None else names[pose.neighbour_idx],
        "sd_rotation_rel_deg": pose.sd_rotation_rel_deg,
        "sd_centre_rel": pose.sd_centre_rel,
    }


def below_diagonal(correlation: FloatArray) -> np.ma.MaskedArray[Any, np.dtype[np.float64]]:
    """Return the values below the diagonal of (q, q), row by row; masked where they are not known."""
    values = correlation[below_diagonal_of(len(correlation))]
    return np.ma.masked_array(values, ~np.isfinite(values))


@lru_cache(maxsize=64)
def below_diagonal_of(size: int) -> tuple[IntArray, IntArray]:
    """Return the places below the diagonal of (q, q), row by row."""
    return np.tril_indices(size, -1)


_IMPLIED_COLUMNS: Final[dict[Implied, tuple[str, ...]]] = {
    Implied.PRINCIPAL_POINT: ("implied_cx", "implied_cy"),
    Implied.RADIAL: ("implied_radial",),
    Implied.ASPECT: ("implied_aspect",),
    Implied.TANGENTIAL: ("implied_p1", "implied_p2"),
}


def implied_by_camera(found: Sequence[ImpliedParameter]) -> dict[int, dict[str, float]]:
    """Return by camera and column by how much parameters that nobody freed would change, each alone, and the sd."""
    out: dict[int, dict[str, float]] = {}
    for one in found:
        if one.camera_idx is None:
            continue
        own = out.setdefault(one.camera_idx, {})
        for k, name in enumerate(_IMPLIED_COLUMNS[one.parameter]):
            own[name], own[f"{name}_sd"] = float(one.step[k]), float(one.sd[k])
    return out
