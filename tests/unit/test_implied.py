"""When what a camera lacks is a finding: the rule of method.md section 11, each of its conditions by itself."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from sfm_audit.audit.joint.implied import _COLUMNS, Implied, _alone, _Asked, _implied
from sfm_audit.loaders.camera_models import BY_NAME
from sfm_audit.loaders.model import CameraRecord

NUM = 1000
CAMERA = CameraRecord(1, BY_NAME["SIMPLE_RADIAL"], 1000, 750, np.array([900.0, 500.0, 375.0, 0.0]))


def scores_of(step, sd, gram):
    """Scores of six columns, each by itself: what makes these steps with these standard deviations."""
    step, sd, gram = (np.broadcast_to(np.asarray(each, float), (6,)) for each in (step, sd, gram))
    return SimpleNamespace(
        gram=np.diag(gram),
        meat=np.diag((sd * gram) ** 2),
        score=gram * step,
        sq_length=gram * 2.0,
        num_observations=NUM,
    )


def found(parameter, *, step, sd, px, sd_focal_rel=0.002, share=1.0):
    """Whether it is a finding, its step and px: of a parameter whose release would gain so many px."""
    gram = px**2 * NUM / max(step**2, 1e-300)
    first = _COLUMNS[parameter].start
    steps = np.where(np.arange(6) == first, step, 0.0)
    scores = scores_of(steps, sd, gram)
    scores.sq_length = scores.sq_length / share
    asked = _Asked(np.array([0]), CAMERA, 0, sd_focal_rel)
    system = SimpleNamespace(observations=SimpleNamespace(sigma_px=np.array([1.0])))
    [[*parameters]] = _implied(system, [asked], [scores])
    return next(each for each in parameters if each.parameter is parameter)


@pytest.mark.parametrize("parameter", [Implied.RADIAL, Implied.ASPECT, Implied.TANGENTIAL])
@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, True),
        ({"sd": 0.0021}, False),  # fewer than five standard deviations
        ({"sd": 0.0019}, True),
        ({"px": 0.099}, False),
        ({"px": 0.101}, True),
        ({"sd_focal_rel": 0.0031}, False),
        ({"sd_focal_rel": 0.003}, True),
        ({"sd_focal_rel": np.nan}, False),
    ],
)
def test_a_missing_parameter_is_a_finding_when_it_is_known_large_and_gains(parameter, changes, expected):
    given = {"step": 0.01, "sd": 0.001, "px": 0.2} | changes
    one = found(parameter, **given)
    assert one.found is expected
    assert one.px == pytest.approx(given["px"])
    assert one.step[0] == pytest.approx(0.01)
    assert_allclose(one.sd, given["sd"])


@pytest.mark.parametrize(
    ("step", "sd", "expected"), [(4.1, 0.5, True), (3.9, 0.5, False), (-4.1, 0.5, True), (4.1, 0.83, False)]
)
def test_a_principal_point_must_move_by_four_thousandths_of_the_width_whatever_it_gains(step, sd, expected):
    one = found(Implied.PRINCIPAL_POINT, step=step, sd=sd, px=0.01)
    assert one.found is expected


def test_what_base_and_points_absorb_is_unknown():
    for share, is_known in ((1e-8, True), (1e-11, False)):
        one = found(Implied.ASPECT, step=0.01, sd=0.001, px=0.2, share=share)
        assert one.found is is_known
        assert np.isfinite([*one.step, *one.sd, one.px]).all() == is_known


def test_two_columns_are_solved_together():
    """Against numpy, with columns that lean on each other; and of no others beside."""
    rng = np.random.default_rng(0)
    roots = rng.normal(size=(5, 2, 6))
    gram, meat = roots @ roots.swapaxes(1, 2), np.eye(2) + np.ones((2, 2))
    scores = [
        SimpleNamespace(gram=each, meat=meat, score=np.array([1.0, -2.0]), sq_length=each.diagonal()) for each in gram
    ]
    step, sd, gain = _alone(scores, slice(0, 2))
    inverse = np.linalg.inv(gram)
    assert_allclose(step, inverse @ [1.0, -2.0], rtol=1e-9)
    assert_allclose(sd, np.sqrt(np.einsum("bii->bi", inverse @ meat @ inverse)), rtol=1e-9)
    assert_allclose(gain, step @ [1.0, -2.0], rtol=1e-9)
    for k, each in enumerate(scores):
        alone = _alone([each], slice(0, 2))
        assert [values[0].tobytes() for values in alone] == [values[k].tobytes() for values in (step, sd, gain)]


def test_a_camera_lacks_what_its_model_has_not():
    asked = [
        _Asked(np.array([0]), dataclasses.replace(CAMERA, model=BY_NAME[name]), 0, 0.001)
        for name in ("OPENCV", "PINHOLE")
    ]
    system = SimpleNamespace(observations=SimpleNamespace(sigma_px=np.array([1.0])))
    opencv, pinhole = _implied(system, asked, [scores_of(0.0, 1.0, 1.0)] * 2)
    assert [each.parameter for each in opencv] == [Implied.PRINCIPAL_POINT, Implied.RADIAL]
    assert opencv[1].names == ("k3",)
    assert [each.parameter for each in pinhole] == [Implied.PRINCIPAL_POINT, Implied.RADIAL, Implied.TANGENTIAL]
    assert pinhole[1].names == ("k1",)
    [of_size] = _implied(system, [asked[1]._replace(camera_idx=None)], [scores_of(0.0, 1.0, 1.0)])
    assert [each.parameter for each in of_size] == [Implied.PRINCIPAL_POINT]
