"""That less would do is never said of a camera that is rejected: a k1 frozen at 0 is wrong, not superfluous."""

from __future__ import annotations

import numpy as np
import pytest

from sfm_audit.audit import AuditConfig
from sfm_audit.audit.decision.decide import decide
from sfm_audit.audit.decision.diagnostics import (
    CameraDiagnostics,
    ConsistencyDiagnostics,
    Diagnostics,
    NoiseDiagnostics,
    OwnDiagnostics,
    OwnStep,
)
from sfm_audit.audit.decision.misfit import MisfitDecision
from sfm_audit.audit.engine.camera import CameraAudit, settled
from sfm_audit.audit.misfit.significance import UNTESTED
from sfm_audit.audit.table.words import Member, MisfitGroup, ReasonCode, Verdict
from sfm_audit.loaders.camera_models import BY_NAME
from sfm_audit.loaders.model import CameraRecord

CAMERA = CameraDiagnostics(
    focal_over_size=0.8,
    folds_over=False,
    principal_point_px=(800.0, 600.0),
    size_px=(1600, 1200),
    coverage=0.5,
    occupied_cells=40,
    has_focal=True,
    sd_focal_rel=0.001,
    singular_share=0.1,
    is_singular=False,
    k1=0.0,
    sd_k1=0.001,
    is_joint=True,
)


def diagnostics(*, step=0.0, step_px=0.0, inconsistent=False):
    return Diagnostics(
        num_inliers=300,
        noise=NoiseDiagnostics(num_standardised=290, num_values=580, ks_stat=0.02, ks_p=0.5, is_fitted=True),
        pose_offset_px=0.01,
        camera=CAMERA,
        largest_residual_px=2.0,
        longer_side_px=1600,
        consistency=ConsistencyDiagnostics(inconsistent, "nothing fits", 0.5),
        own=OwnDiagnostics(step_px, 0.5, 20, (OwnStep("k", 0.0, step, step, 0.001),)),
        has_own=True,
    )


@pytest.mark.parametrize(
    ("given", "camera", "remarked"),
    [
        (diagnostics(), Verdict.ACCEPTED, True),
        (diagnostics(step=0.03, step_px=0.1), Verdict.ACCEPTED, True),
        (diagnostics(step=0.03, step_px=0.3), Verdict.REJECTED, False),
        (diagnostics(inconsistent=True), Verdict.REJECTED, False),
    ],
)
def test_k1_is_remarked_only_of_a_camera_that_is_not_rejected(given, camera, remarked):
    decision = decide(given, AuditConfig())
    assert decision.of(Member.CAMERA) is camera
    codes = {reason.code for reason in decision.members[Member.PLAUSIBLE].reasons}
    assert (ReasonCode.K1_NOT_IDENTIFIED in codes) is remarked
    assert decision.of(Member.PLAUSIBLE) is Verdict.ACCEPTED


def camera_audit(*, material=()):
    group = material[0] if material else None
    misfit = MisfitDecision(group, 0.3, 0.01, 0.2, material, (), ())
    record = CameraRecord(1, BY_NAME["SIMPLE_RADIAL"], 1600, 1200, np.array([1400.0, 800.0, 600.0, 0.0]))
    return CameraAudit(record, np.array([1, 2, 3, 4]), 100, 1000, UNTESTED, misfit, "SIMPLE_PINHOLE")


@pytest.mark.parametrize(("num_rejected", "advised"), [(0, "SIMPLE_PINHOLE"), (1, "SIMPLE_PINHOLE"), (2, None)])
def test_less_would_do_is_not_said_where_half_of_the_images_is_rejected(num_rejected, advised):
    rejected = np.arange(5) <= num_rejected  # image 0 has another camera
    assert settled(camera_audit(), rejected).advised_camera_model == advised


def test_a_larger_model_is_advised_whatever_else_is_wrong():
    assert settled(camera_audit(material=(MisfitGroup.RADIAL,)), np.ones(5, dtype=bool)).advised_camera_model
