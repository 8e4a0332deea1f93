"""What mypy must infer of the public interface; scripts/lint checks this file, nothing runs it."""

from collections.abc import Callable
from typing import assert_type

import numpy as np
import pandas as pd
import pyarrow as pa
import pycolmap
from matplotlib.axes import Axes
from numpy.typing import NDArray

import sfm_audit
from sfm_audit import (
    AuditConfig,
    Decision,
    ImageAudit,
    ImageResult,
    LoadError,
    ModelAudit,
    ModelAuditor,
    ModelLabels,
    Reason,
    ReasonCode,
    ReconstructionAudit,
    SparseModel,
    Verdict,
    audit_correspondences,
    audit_inliers,
    audit_model,
    audit_reconstruction,
    from_pycolmap,
    open_model,
)
from sfm_audit.loaders import InlierSet, ModelRef, discover

model = open_model("sparse/0")
assert_type(model, SparseModel)
assert_type(sfm_audit.open_model("sparse/0"), SparseModel)  # the lazy module has the types too
assert_type(sfm_audit.__version__, str)

config = AuditConfig()
assert_type(config.alpha, float)
auditor = ModelAuditor(model)
assert_type(auditor, ModelAuditor)
assert_type(ModelAuditor(model, config), ModelAuditor)
inliers = auditor.inliers("IMG_0010.jpg")
assert_type(inliers, InlierSet)
assert_type(inliers.xy_px, NDArray[np.float64])

image = auditor.image("IMG_0010.jpg")
assert_type(image, ImageAudit)
assert_type(audit_inliers(inliers), ImageAudit)
assert_type(image.verdict, Verdict)
assert_type(image.decision, Decision)
assert_type(image.pose_offset_px, float)
assert_type(image.decision.reasons, tuple[Reason, ...])
assert_type(image.decision.reasons[0].code, ReasonCode)

tables = audit_model(model)
assert_type(tables, ModelAudit)
assert_type(tables.images, pa.Table)

audit = audit_reconstruction("sparse/0", policy="camera", noise="constant")
assert_type(audit, ReconstructionAudit)
assert_type(audit.images, pd.DataFrame)
assert_type(audit.tables, ModelAudit)
assert_type(audit.image("IMG_0010.jpg"), ImageResult)
assert_type(audit.image("IMG_0010.jpg").verdict, Verdict)
assert_type(audit.image("IMG_0010.jpg").plot(), Axes)
story: str = audit.image("IMG_0010.jpg").explain()
assert_type(from_pycolmap(pycolmap.Reconstruction()), SparseModel)
assert_type(audit_reconstruction(model), ReconstructionAudit)
assert_type(audit_correspondences([[1.0, 2.0]], np.zeros((1, 3)), ("FOV", 1, 1, (1.0,)), np.eye(4)), ImageAudit)
assert_type(discover(["data"]).refs, tuple[ModelRef, ...])

labels: ModelLabels
error: type[Exception] = LoadError
call: Callable[[SparseModel], ModelAudit] = audit_model
# What is wrong must be an error: mypy --strict refuses an ignore that ignores nothing.
open_model(3)  # type: ignore[arg-type]
audit_reconstruction(model, policy="strict")  # type: ignore[arg-type]
sfm_audit.audit_everything(model)  # type: ignore[attr-defined]
image.verdict = Verdict.ACCEPTED  # type: ignore[misc]
Verdict("accepted").no_such_verdict  # type: ignore[attr-defined]
