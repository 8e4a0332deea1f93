"""Is the camera model wrong, in which way, by how many pixels? (method.md section 5)."""

from __future__ import annotations

from sfm_audit.audit.inliers.projected import ProjectedImage, project_image
from sfm_audit.audit.misfit.cause import (
    Retest,
    advised_camera_model,
    bic,
    extended_camera,
    image_retest,
    remaining_groups,
)
from sfm_audit.audit.misfit.clusters import coincident_keypoints
from sfm_audit.audit.misfit.design import ImageDesign, image_design, projected_design
from sfm_audit.audit.misfit.fields import candidate_fields
from sfm_audit.audit.misfit.nuisance import fitted_param_idxs, nuisance_columns
from sfm_audit.audit.misfit.outcome import MisfitTest, MisfitTests
from sfm_audit.audit.misfit.pooled import PooledTests, camera_tests
from sfm_audit.audit.misfit.score import PreparedImage, prepare, prepare_image
from sfm_audit.audit.table.words import GROUPS, MisfitGroup, MisfitStatus

__all__ = [
    "GROUPS",
    "ImageDesign",
    "MisfitGroup",
    "MisfitStatus",
    "MisfitTest",
    "MisfitTests",
    "PooledTests",
    "PreparedImage",
    "ProjectedImage",
    "Retest",
    "advised_camera_model",
    "bic",
    "camera_tests",
    "candidate_fields",
    "coincident_keypoints",
    "extended_camera",
    "fitted_param_idxs",
    "image_design",
    "image_retest",
    "nuisance_columns",
    "prepare",
    "prepare_image",
    "project_image",
    "projected_design",
    "remaining_groups",
]
