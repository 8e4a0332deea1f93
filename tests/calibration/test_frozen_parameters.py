"""Parameters that were set wrong and never freed: named, with the value that bundle adjustment would give them."""

from __future__ import annotations

import numpy as np
import pytest

from scripts.validation.advice import refine
from scripts.validation.frozen import Frozen, audit_frozen, simulate_frozen
from sfm_audit.audit.engine.model import ModelAuditor
from sfm_audit.audit.joint import joint_system, own_parameters
from sfm_audit.audit.simulate.noise import NoiseKind


@pytest.mark.parametrize("case", [Frozen.TWO_K1, Frozen.SHARED_DISTORTION])
def test_the_implied_value_is_bundle_adjustment_s(case):
    """Poses and points followed the wrong value, so one linear step ends elsewhere."""
    model, _, wrong = simulate_frozen(case, NoiseKind.GAUSSIAN, 0, 2)
    released, converged = refine(model)
    assert converged
    auditor = ModelAuditor(model)
    linear = own_parameters(joint_system(model, auditor.residuals, auditor.sigma_constant_px))
    for row in wrong:
        free = [released.camera(row).model.param_names.index(name) for name in auditor.steps[row].names]
        truth = released.camera(row).params[free]
        off, off_linear = (np.abs(s.implied - truth) / s.sd for s in (auditor.steps[row], linear[row]))
        assert off.max() < 2.0
        assert off_linear.max() > 3.0


def test_two_wrong_focal_lengths_and_nobody_else():
    frame = audit_frozen(Frozen.TWO_FOCALS, NoiseKind.LAPLACE, 0, 3)
    assert frame["guilty"].sum() == 2
    assert ((frame["verdict_camera"] == "rejected") == frame["guilty"]).all()
    assert (frame["verdict_misfit"] != "rejected").all()
    assert set(frame.loc[frame["guilty"], "named"]) == {"f"}
    assert frame.loc[frame["guilty"], "implied_right"].all()


def test_a_healthy_twin_is_left_alone():
    frame = audit_frozen(Frozen.NOTHING, NoiseKind.LAPLACE, 0, 3)
    assert not frame["guilty"].any()
    assert (frame["policy_standard"] == "accepted").all()
    assert frame["own_step_px"].max() < 0.05
