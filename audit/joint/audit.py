"""All that the joint system says of a model, whatever its size: the door of this room (method.md sections 11, 11b)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from sfm_audit.audit.inliers.residuals import ModelResiduals
from sfm_audit.audit.joint.again import implied_again
from sfm_audit.audit.joint.blocks import Block, covisible_blocks
from sfm_audit.audit.joint.implied import ImpliedBeside, ImpliedParameter, implied_of_cameras, implied_of_sizes
from sfm_audit.audit.joint.layout import median_of
from sfm_audit.audit.joint.misfit import Beside, JointMisfit, joint_misfit
from sfm_audit.audit.joint.observations import usable_images
from sfm_audit.audit.joint.own import CameraStep, Gains, image_gains, own_parameters
from sfm_audit.audit.joint.poses import PoseCovariance, pose_covariances, unknown_pose
from sfm_audit.audit.joint.system import JointSystem, joint_system
from sfm_audit.audit.kernels.threads import over_ranges, together
from sfm_audit.loaders.arrays import BoolArray, FloatArray, IntArray
from sfm_audit.loaders.model import SparseModel

MAX_COLUMNS: Final = 10_000
"""Of one dense factor: 800 MB."""


@dataclass(frozen=True, slots=True, eq=False)
class JointAudit:
    """Steps, misfit, implied parameters and covariances of a model.

    steps: of every camera with images in the system.    misfit: of every image.    implied: see `ImpliedParameter`.
    gains: per image.    covariances: per image, see `JointSystem.image_covariances`.
    excluded: (I,) images whose misfit was not asked for.    num_observations: (I,) that took part.
    poses: (I,) what is known of each pose; empty where that was not asked for.
    num_blocks: more than one where the model was too large for one system; numbers are then those of blocks: a camera
    that several blocks share is told of by the block that has most of its observations, q is of the block's images.
    """

    steps: tuple[CameraStep, ...]
    misfit: JointMisfit
    implied: list[ImpliedParameter]
    gains: tuple[Gains, ...]
    covariances: tuple[FloatArray, ...]
    excluded: BoolArray
    num_observations: IntArray
    num_blocks: int
    poses: tuple[PoseCovariance, ...] = ()


def audit_jointly(
    model: SparseModel,
    residuals: ModelResiduals,
    sigma_px: FloatArray,
    *,
    alpha: float,
    tau_px: FloatArray,
    excluded: BoolArray | None = None,
    left_out: BoolArray | None = None,
    suspects: Callable[[], BoolArray] | None = None,
    frame_idx: IntArray | None = None,
    image_from_frame: FloatArray | None = None,
    points_independent: bool = False,
    max_columns: int = MAX_COLUMNS,
    with_poses: bool = False,
) -> JointAudit:
    """Ask the joint system everything.

    Parameters
    ----------
    sigma_px, tau_px : (I,) noise and materiality, px
    excluded : (I,) images that are wrong in another way (pose); they and the images of cameras with a material own
        step are not tested for misfit, see `joint_misfit`
    left_out : (I,) images that take no part at all (section 12)
    suspects : gives (I,) images that are tested first, see `joint_misfit`; asked when the system stands
    frame_idx, image_from_frame, points_independent : see `joint_system`
    max_columns : of one dense system
    with_poses : whether to say how well poses are known
    """
    tests = _Tests(alpha, tau_px, excluded, suspects)
    usable = usable_images(model, residuals, sigma_px) & (True if left_out is None else ~left_out)
    blocks = covisible_blocks(model, residuals, max_columns, frame_idx, usable)

    def answers(start: int, stop: int) -> list[tuple[Block, JointAudit]]:
        out = []
        for block in blocks[start:stop]:
            system = joint_system(
                model,
                residuals,
                sigma_px,
                frame_idx=frame_idx,
                image_from_frame=image_from_frame,
                left_out=~block.members if left_out is None else ~block.members | left_out,
                points_independent=points_independent,
            )
            out.append(_of_block(system, block, tests, with_poses=with_poses))
        return out

    parts = [part for some in over_ranges(answers, len(blocks), range_weight=1.0) for part in some]
    return parts[0][1] if len(parts) == 1 else _merged(parts, tau_px)


class _Tests(NamedTuple):
    """How images are tested, see `audit_jointly`."""

    alpha: float
    tau_px: FloatArray
    excluded: BoolArray | None
    suspects: Callable[[], BoolArray] | None

    def misfit(self, system: JointSystem, excluded: BoolArray, beside: Beside) -> JointMisfit:
        """Test the images of a system but those that are excluded."""
        suspects = None if self.suspects is None else self.suspects()
        return joint_misfit(
            system, alpha=self.alpha, tau_px=self.tau_px, excluded=excluded, suspects=suspects, beside=beside
        )


def _of_block(system: JointSystem, block: Block, tests: _Tests, *, with_poses: bool) -> tuple[Block, JointAudit]:
    core = np.flatnonzero(block.core).tolist()
    asked = np.flatnonzero(block.core | block.members).tolist()  # of all members: their cameras have steps, too
    covariances_of_members = dict(zip(asked, system.image_covariances(asked), strict=True))
    steps = own_parameters(system, covariances_of_members)
    covariance_of = {image: covariances_of_members[image] for image in core}
    out = np.zeros(len(block.core), dtype=bool) if tests.excluded is None else tests.excluded.copy()
    material = [step for step in steps if step.is_material(median_of(tests.tau_px, step.image_idxs))]
    for step in material:
        out[step.image_idxs] = True
    settled = {step.camera_idx: step for step in implied_again(system, material)}
    steps = tuple(settled.get(step.camera_idx, step) for step in steps)
    gains = [Gains(math.nan, math.nan, math.nan)] * len(block.core)
    covariances = [np.zeros((0, 0))] * len(block.core)
    for (image, covariance), own in zip(covariance_of.items(), image_gains(system, core), strict=True):
        gains[image], covariances[image] = own, covariance
    counts = np.diff(system.observations.offsets)
    beside = ImpliedBeside(system, steps)
    misfits: list[JointMisfit] = []
    of_sizes: list[ImpliedParameter] = []
    together(
        lambda: misfits.append(tests.misfit(system, out, beside)),
        lambda: of_sizes.extend(implied_of_sizes(system, steps)),
    )
    misfit, implied = misfits[0], [*implied_of_cameras(system, steps, beside.found()), *of_sizes]
    poses = [unknown_pose()] * len(block.core) if with_poses else []
    if with_poses:
        for image, pose in zip(core, pose_covariances(system, core, list(covariance_of.values())), strict=True):
            poses[image] = pose
    return block, JointAudit(steps, misfit, implied, tuple(gains), tuple(covariances), out, counts, 1, tuple(poses))


def _merged(parts: list[tuple[Block, JointAudit]], tau_px: FloatArray) -> JointAudit:
    """Each image as its core's block says, each camera as the block with most of its observations says."""
    num_images = len(parts[0][0].core)
    by_core = np.zeros(num_images, dtype=np.int64)
    steps: dict[int, CameraStep] = {}
    told_by: dict[int, int] = {}
    for number, (block, found) in enumerate(parts):
        by_core[block.core] = number
        for step in found.steps:
            best = steps.get(step.camera_idx)
            if best is None or step.num_observations > best.num_observations:
                steps[step.camera_idx], told_by[step.camera_idx] = step, number
    source = [parts[number][1] for number in by_core.tolist()]
    effect = np.array([found.misfit.effect_px[i] for i, found in enumerate(source)])
    tested = np.count_nonzero(~np.isnan(effect))
    misfit = JointMisfit(
        tuple(found.misfit.tests[i] for i, found in enumerate(source)),
        effect,
        np.array([found.misfit.included[i] for i, found in enumerate(source)]),
        tuple(found.misfit.round_included[i] for i, found in enumerate(source)),
        tuple(found.misfit.cause[i] for i, found in enumerate(source)),
        bool(2 * np.count_nonzero(effect > tau_px) > tested),
    )
    implied = [
        one
        for number, (_, found) in enumerate(parts)
        for one in found.implied
        if one.camera_idx is None or told_by[one.camera_idx] == number
    ]
    return JointAudit(
        tuple(steps[camera] for camera in sorted(steps)),
        misfit,
        implied,
        tuple(found.gains[i] for i, found in enumerate(source)),
        tuple(found.covariances[i] for i, found in enumerate(source)),
        np.array([found.excluded[i] for i, found in enumerate(source)]),
        np.array([found.num_observations[i] for i, found in enumerate(source)]),
        len(parts),
        tuple(found.poses[i] for i, found in enumerate(source)) if parts[0][1].poses else (),
    )
