"""The noise of a shared camera is the median of its images'."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from joint_reference import SPEC, model_of

from sfm_audit.audit.engine.model import ModelAuditor
from sfm_audit.audit.joint.own import own_parameters
from sfm_audit.audit.joint.system import joint_system


def test_a_shared_camera_has_the_median_noise_of_its_images():
    model = model_of(replace(SPEC, shared_camera=True))
    sigma_px = np.linspace(0.3, 1.2, len(model.images)) ** 2
    (step,) = own_parameters(joint_system(model, ModelAuditor(model).residuals, sigma_px))
    assert step.sigma_px == pytest.approx(np.median(sigma_px))
    assert step.sigma_px < np.max(sigma_px)
