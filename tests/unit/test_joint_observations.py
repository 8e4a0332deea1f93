"""Which observations take part in the joint system."""

from __future__ import annotations

import dataclasses
from contextlib import nullcontext

import numpy as np
import pytest
from joint_reference import SPEC, model_of
from numpy.testing import assert_allclose

from sfm_audit.audit.engine.model import ModelAuditor
from sfm_audit.audit.joint import joint_system
from sfm_audit.audit.joint.observations import _Candidates
from sfm_audit.audit.kernels import numpy_only


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_an_image_with_derivatives_that_are_not_finite_has_no_columns(value):
    model = model_of(SPEC, seed=2)
    auditor = ModelAuditor(model)
    residuals = auditor.residuals
    jacobian = residuals.point_jacobian.copy()
    jacobian[1, 2, residuals.rows(2).start + 5] = value
    with np.errstate(all="ignore"):  # as an audit asks
        system = joint_system(model, dataclasses.replace(residuals, point_jacobian=jacobian), auditor.sigma_constant_px)
    without = joint_system(model, residuals, auditor.sigma_constant_px, left_out=np.arange(len(model.images)) == 2)
    assert np.flatnonzero(~system.observations.layout.has_columns).tolist() == [2]
    assert_allclose(system.base.step, without.base.step, rtol=1e-12)


@pytest.mark.parametrize("path", [nullcontext, numpy_only])
def test_points_of_one_view_or_of_parallel_rays_are_no_part(path):
    """Of four points: two rays, the same one twice, one view, a view with weight and one without."""
    rng = np.random.default_rng(0)
    views = rng.normal(size=(5, 2, 3))
    shown = views[[0, 1, 2, 2, 3, 4, 0]]
    point_idx, weight = np.array([7, 7, 2, 2, 5, 4, 4]), np.array([1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 0.0])
    jacobian = np.ascontiguousarray(shown.transpose(1, 2, 0))
    of = _Candidates(None, np.arange(7, dtype=np.int32), point_idx, jacobian, np.ones((2, 7)), np.ones(7, dtype=int))
    with path():
        assert of.have_regular_points(weight, 9).tolist() == [True, True, *[False] * 5]
