"""What would adjusting everything do, and what is left that nothing could take up? (method.md sections 11 and 11b)."""

from sfm_audit.audit.inliers.frames import image_from_frame
from sfm_audit.audit.joint.audit import JointAudit, audit_jointly
from sfm_audit.audit.joint.blocks import covisible_blocks
from sfm_audit.audit.joint.implied import Implied, ImpliedParameter, implied_parameters
from sfm_audit.audit.joint.misfit import JointMisfit, JointTest, JointTests, included_from, joint_misfit
from sfm_audit.audit.joint.own import CameraStep, Gains, image_gains, own_parameters
from sfm_audit.audit.joint.poses import PoseCovariance, PoseGauge, pose_covariances, pose_gauge
from sfm_audit.audit.joint.system import JointSystem, joint_system
from sfm_audit.audit.joint.worth import Worth

__all__ = [
    "CameraStep",
    "Gains",
    "Implied",
    "ImpliedParameter",
    "JointAudit",
    "JointMisfit",
    "JointSystem",
    "JointTest",
    "JointTests",
    "PoseCovariance",
    "PoseGauge",
    "Worth",
    "audit_jointly",
    "covisible_blocks",
    "image_from_frame",
    "image_gains",
    "implied_parameters",
    "included_from",
    "joint_misfit",
    "joint_system",
    "own_parameters",
    "pose_covariances",
    "pose_gauge",
]
