"""Which group is named, and which camera model is advised."""

from __future__ import annotations

import math

import numpy as np
import pytest
from misfit_reference import PARAMS, camera, points, refit, residuals_of
from numpy.testing import assert_allclose

from sfm_audit.audit.cameras import project
from sfm_audit.audit.cameras.models import functions_of
from sfm_audit.audit.decision import misfit as decision
from sfm_audit.audit.decision.diagnostics import misfit_groups
from sfm_audit.audit.misfit import (
    GROUPS,
    MisfitGroup,
    MisfitStatus,
    MisfitTest,
    advised_camera_model,
    bic,
    image_retest,
    prepare_image,
    remaining_groups,
)
from sfm_audit.audit.misfit.capabilities import extended_params, larger_models, undistorted_model
from sfm_audit.loaders.camera_models import BY_NAME, CAMERA_MODELS

G = MisfitGroup
NOT_RUN = MisfitTest(math.nan, math.nan, None, MisfitStatus.NOT_ENOUGH_EVIDENCE)


def named_cause(tests, candidates, num_observations, sigma_px):
    """The cause among ``candidates``, by the decision that runs make."""
    q = np.zeros(len(GROUPS))
    return decision.named_cause(
        misfit_groups(tests, q, num_observations=num_observations, sigma_px=sigma_px), candidates
    )


def outcomes(**px: float):
    """All groups insignificant but those with a size, px."""
    rank = dict(zip(GROUPS, (2, 2, 2, 2, 6, 26), strict=True))
    return {
        group: MisfitTest(1e-9 if group in px else 0.5, px.get(group, 0.0), rank[group], MisfitStatus.TESTED)
        for group in GROUPS
    }


def test_bic_charges_for_parameters():
    test = MisfitTest(1e-9, 0.3, 6, MisfitStatus.TESTED)
    assert_allclose(bic(test, 500, 0.5), 500 * 0.36 + 6 - 6 * math.log(1000))
    assert bic(NOT_RUN, 500, 0.5) == -math.inf
    assert bic(test, 500, 0.0) == math.inf


def test_the_cause_is_the_cheapest_explanation():
    tests = outcomes(radial=0.50, rolling_shutter=0.51, smooth=0.52)
    assert named_cause(tests, {G.RADIAL, G.ROLLING_SHUTTER, G.SMOOTH}, 500, 0.5) is G.RADIAL
    assert named_cause(tests, {G.ROLLING_SHUTTER, G.SMOOTH}, 500, 0.5) is G.ROLLING_SHUTTER
    assert named_cause(tests, (), 500, 0.5) is None
    assert named_cause(dict.fromkeys(GROUPS, NOT_RUN), {G.RADIAL}, 500, 0.5) is None


def test_remaining_groups_are_significant_and_material():
    tests = outcomes(radial=0.5, affine=0.1)
    assert remaining_groups(tests, GROUPS, alpha=0.05, tau_px=0.2) == (G.RADIAL,)
    assert remaining_groups(tests, GROUPS, alpha=0.05, tau_px=0.05) == (G.RADIAL, G.AFFINE)
    assert remaining_groups(tests, {G.AFFINE}, alpha=0.05, tau_px=0.2) == ()
    assert remaining_groups(dict.fromkeys(GROUPS, NOT_RUN), GROUPS, alpha=0.05, tau_px=0.2) == ()


TABLE = [
    ("SIMPLE_PINHOLE", {G.RADIAL}, "RADIAL"),
    ("SIMPLE_RADIAL", {G.RADIAL, G.SMOOTH}, "RADIAL"),
    ("RADIAL", {G.RADIAL}, "FULL_OPENCV"),
    ("OPENCV", {G.RADIAL}, "FULL_OPENCV"),
    ("FULL_OPENCV", {G.RADIAL}, "none: radial"),
    ("SIMPLE_PINHOLE", {G.AFFINE}, "PINHOLE"),
    ("SIMPLE_RADIAL", {G.AFFINE}, "OPENCV"),
    ("OPENCV", {G.AFFINE}, "none: affine"),
    ("SIMPLE_RADIAL", {G.TANGENTIAL, G.PRINCIPAL_POINT}, "OPENCV"),
    ("RADIAL", {G.TANGENTIAL, G.RADIAL}, "FULL_OPENCV"),
    ("SIMPLE_RADIAL", {G.PRINCIPAL_POINT}, "none: refine the principal point"),
    ("SIMPLE_RADIAL", {G.SMOOTH}, "none: smooth"),
    ("SIMPLE_RADIAL", {G.ROLLING_SHUTTER}, "none: rolling shutter"),
    ("FOV", {G.RADIAL}, "OPENCV"),
    ("EUCM", {G.RADIAL}, "FULL_OPENCV"),
    ("SIMPLE_DIVISION", {G.RADIAL}, "RADIAL"),
    ("SIMPLE_FISHEYE", {G.RADIAL}, "RADIAL_FISHEYE"),
    ("SIMPLE_RADIAL_FISHEYE", {G.RADIAL}, "RADIAL_FISHEYE"),
    ("RADIAL_FISHEYE", {G.RADIAL}, "OPENCV_FISHEYE"),
    ("SIMPLE_RADIAL_FISHEYE", {G.AFFINE}, "OPENCV_FISHEYE"),
    ("OPENCV_FISHEYE", {G.TANGENTIAL}, "THIN_PRISM_FISHEYE"),
]


@pytest.mark.parametrize(("name", "material", "advice"), TABLE)
def test_advice_by_table(name, material, advice):
    cause = min(material, key=GROUPS.index)
    assert advised_camera_model(camera(name), cause, material) == advice


def test_advice_in_the_other_direction():
    assert advised_camera_model(camera(), None, ()) is None
    for name, simpler in [
        ("SIMPLE_RADIAL", "SIMPLE_PINHOLE"),
        ("RADIAL", "SIMPLE_PINHOLE"),
        ("OPENCV", "PINHOLE"),
        ("FOV", "PINHOLE"),
        ("OPENCV_FISHEYE", "FISHEYE"),
        ("RADIAL_FISHEYE", "SIMPLE_FISHEYE"),
        ("PINHOLE", None),
        ("SIMPLE_FISHEYE", None),
    ]:
        assert advised_camera_model(camera(name), None, (), distortion_identified=False) == simpler
    for model in CAMERA_MODELS:
        simpler = undistorted_model(model)
        assert (simpler is None) == (not model.extra_idxs)
        assert simpler is None or not simpler.extra_idxs


@pytest.mark.parametrize("name", [*sorted(PARAMS), "EQUIRECTANGULAR"])
def test_a_larger_model_with_the_extended_parameters_is_the_same_camera(name):
    cam = camera(name)
    xyz = points(np.random.default_rng(1), 50)
    for model in larger_models(cam.model):
        assert functions_of(model).terms >= functions_of(BY_NAME[name]).terms
        params = extended_params(cam.model, cam.params, model)
        if params is not None:
            assert_allclose(project(model, params, xyz), project(cam.model, cam.params, xyz), rtol=1e-12)
        else:
            assert name in {
                *("FOV", "SIMPLE_DIVISION", "DIVISION", "EUCM", "THIN_PRISM_FISHEYE"),
                *("DUAL", "FRAME", "INVERSE_RADIAL"),
            }
    assert model_that_cannot_hold(cam) is None


def model_that_cannot_hold(cam):
    """A smaller model, or another family."""
    name = "SIMPLE_FISHEYE" if not cam.model.name.endswith("FISHEYE") else "SIMPLE_PINHOLE"
    return extended_params(cam.model, cam.params, BY_NAME[name])


def test_parameters_are_not_lost_in_silence():
    cam = camera("OPENCV")
    assert extended_params(cam.model, cam.params, BY_NAME["RADIAL"]) is None
    unequal = cam.params.copy()
    unequal[1] *= 1.1
    unequal[6:] = 0.0
    assert extended_params(cam.model, unequal, BY_NAME["RADIAL"]) is None


TRUTH = [
    ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", (-0.1,), "SIMPLE_RADIAL"),
    ("SIMPLE_PINHOLE", "RADIAL", (-0.1, 0.1), "RADIAL"),
    ("SIMPLE_RADIAL", "RADIAL", (-0.05, 0.05), "RADIAL"),
    ("SIMPLE_RADIAL", "OPENCV", (-0.05, 0.0, 2e-3, 1e-3), "OPENCV"),
    ("RADIAL", "FULL_OPENCV", (-0.05, 0.01, 0, 0, 0.1, 0, 0, 0), "FULL_OPENCV"),
    ("SIMPLE_FISHEYE", "SIMPLE_RADIAL_FISHEYE", (-0.1,), "SIMPLE_RADIAL_FISHEYE"),
    ("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", (-0.05, 0.1), "RADIAL_FISHEYE"),
]


@pytest.mark.parametrize(("claimed", "true", "extra", "advice"), TRUTH)
def test_advice_by_trying_it(claimed, true, extra, advice):
    """Fit the wrong model, ask, fit the advised one: it passes."""
    rng = np.random.default_rng(2)
    xyz = points(rng, 500)
    sound = camera(true, extra)
    xy = project(sound.model, sound.params, xyz) + 0.3 * rng.standard_normal((500, 2))
    start = camera(claimed, tuple(extra[: len(PARAMS[claimed])]))
    fitted, xyz_cam = refit(start, xyz, xy)
    y = residuals_of(fitted, xyz_cam, xy)
    tests = prepare_image(fitted, xyz_cam).test(y)
    material = remaining_groups(tests, GROUPS, alpha=0.05, tau_px=0.2)
    cause = named_cause(tests, material, 500, 0.3)
    assert cause in {G.RADIAL, G.TANGENTIAL, G.PRINCIPAL_POINT}
    assert advised_camera_model(fitted, cause, material, retest=image_retest(xyz_cam, y)) == advice
    larger = BY_NAME[advice]
    again, xyz_cam = refit(camera(advice, extra[: len(larger.extra_idxs)]), xyz, xy)
    tests = prepare_image(again, xyz_cam).test(residuals_of(again, xyz_cam, xy))
    assert remaining_groups(tests, GROUPS, alpha=0.05, tau_px=0.2) == ()


def test_unequal_focal_lengths_need_another_model():
    rng = np.random.default_rng(3)
    xyz = points(rng, 500)
    sound = camera("PINHOLE")
    sound.params[1] *= 1.01
    xy = project(sound.model, sound.params, xyz) + 0.3 * rng.standard_normal((500, 2))
    for claimed, advice in (("SIMPLE_PINHOLE", "PINHOLE"), ("SIMPLE_RADIAL", "OPENCV")):
        fitted, xyz_cam = refit(camera(claimed, (0.0,) * len(PARAMS[claimed])), xyz, xy)
        y = residuals_of(fitted, xyz_cam, xy)
        tests = prepare_image(fitted, xyz_cam).test(y)
        material = remaining_groups(tests, GROUPS, alpha=0.05, tau_px=0.2)
        assert named_cause(tests, material, 500, 0.3) is G.AFFINE
        assert advised_camera_model(fitted, G.AFFINE, material, retest=image_retest(xyz_cam, y)) == advice


def test_a_shifted_principal_point_needs_no_other_model():
    """Tangential is material too, but p1 and p2 do not explain enough of it."""
    rng = np.random.default_rng(4)
    xyz = points(rng, 500)
    sound = camera()
    sound.params[1:3] += (30.0, -20.0)
    xy = project(sound.model, sound.params, xyz) + 0.3 * rng.standard_normal((500, 2))
    fitted, xyz_cam = refit(camera(), xyz, xy)
    y = residuals_of(fitted, xyz_cam, xy)
    tests = prepare_image(fitted, xyz_cam).test(y)
    material = remaining_groups(tests, GROUPS, alpha=0.05, tau_px=0.2)
    assert G.TANGENTIAL in material
    assert named_cause(tests, material, 500, 0.3) is G.PRINCIPAL_POINT
    advice = advised_camera_model(fitted, G.PRINCIPAL_POINT, material, retest=image_retest(xyz_cam, y))
    assert advice == "none: refine the principal point"
