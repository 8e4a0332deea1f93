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
from sfm_audit.audit.joint.design import _inputs, _Rows
from sfm_audit.audit.joint.observations import _Candidates
from sfm_audit.audit.kernels import kernels_in_use, numpy_only
from sfm_audit.audit.kernels.checked import aligned_zeros
from sfm_audit.audit.kernels.joint_parts import fill_design


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


@pytest.mark.skipif(not kernels_in_use(), reason="no compiled kernels")
@pytest.mark.parametrize(("name", "value"), [("point_idx", -1), ("point_idx", 2**30), ("observation_row", 2**30)])
def test_rows_that_lead_outside_never_reach_the_derivatives(name, value):
    """The last inlier of the last image: who looks it up is told to take the numpy path, which says what is wrong."""
    model = model_of(SPEC, seed=2)
    residuals, sigma_px = ModelAuditor(model).residuals, ModelAuditor(model).sigma_constant_px
    observations = joint_system(model, residuals, sigma_px).observations
    rows = _Rows(np.array([len(model.images) - 1]), np.array([0, 1]), np.array([len(residuals.point_idx) - 1]))
    inputs, done = _inputs(model, residuals, observations.layout, rows)
    out = np.full((1, 2, observations.layout.width), np.nan)
    assert done.all()
    assert fill_design(out, inputs)
    last = observations.source[observations.rows(len(model.images) - 1)].argmax()
    assert_allclose(out[0], observations.design.of(len(model.images) - 1)[last])
    wrong = getattr(inputs, name).copy()
    wrong[-1] = value
    out[:] = np.nan
    assert not fill_design(out, inputs._replace(**{name: wrong}))
    assert np.isnan(out).all()


@pytest.mark.parametrize("shape", [(0, 2, 8), (1, 2, 8), (1001, 2, 8), (7, 3)])
def test_zeros_begin_with_a_line_of_the_cache(shape):
    zeros = aligned_zeros(shape)
    assert zeros.shape == shape
    assert zeros.flags.c_contiguous
    assert not zeros.size or zeros.ctypes.data % 64 == 0  # an empty array lies anywhere
    assert not zeros.any()
