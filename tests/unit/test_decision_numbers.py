"""What the engine hands to the decision: numbers of the joint system and of consistency, whom it excludes, taus."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from decision_samples import CAMERA, NAN
from hypothesis import given
from hypothesis import strategies as st
from joint_reference import SPEC, model_of, with_param

from sfm_audit.audit.cli import recompute
from sfm_audit.audit.config import AuditConfig
from sfm_audit.audit.consistency import Cause, Explanation, ImageConsistency
from sfm_audit.audit.decision.camera import material_step
from sfm_audit.audit.decision.diagnostics import Gains, SharedMisfit, Worth
from sfm_audit.audit.decision.judged import VERDICTS
from sfm_audit.audit.engine import jointly
from sfm_audit.audit.engine.camera import images_advice
from sfm_audit.audit.engine.model import ModelAuditor
from sfm_audit.audit.joint import CameraStep, Implied, JointTest
from sfm_audit.audit.joint import Worth as JointWorth
from sfm_audit.audit.table.thresholds import effect_px
from sfm_audit.audit.table.words import GROUPS, Member, MisfitGroup, MisfitStatus, Verdict
from sfm_audit.loaders.camera_models import BY_NAME
from sfm_audit.loaders.model import CameraRecord
from sfm_audit.reports.html import page


def camera_step(step=(10.0, 0.1), plain=(12.0, 0.2), sd=(1.0, 1.0), px=(0.3, 0.4), images=(0, 1)):
    stored = np.array([1000.0, 0.05])
    return CameraStep(
        camera_idx=0,
        image_idxs=np.array(images),
        num_observations=100,
        names=("f", "k"),
        stored=stored,
        step=np.array(step),
        sd=np.array(sd),
        plain_step=np.array(plain),
        own_step_px=px[0],
        plain_step_px=px[1],
        sd_focal_rel=0.001,
        focal_identified=True,
        implied=stored + np.array(step),
        correlation=np.eye(2),
        sigma_px=0.5,
    )


# the engine leaves out whom the decision rejects

NUMBERS = st.sampled_from([0.0, 0.2, 0.2000001, 4.9, 5.0, 5.0001, -5.0, -5.1, 30.0, NAN])


@given(
    step=st.tuples(NUMBERS, NUMBERS),
    plain=st.tuples(NUMBERS, NUMBERS),
    sd=st.tuples(*[st.sampled_from([0.0, 1.0, NAN])] * 2),
    px=st.tuples(NUMBERS, NUMBERS),
)
def test_the_joint_test_excludes_the_images_whose_camera_is_rejected(step, plain, sd, px):
    found = camera_step(step, plain, sd, px)
    own = jointly.own_diagnostics(found, 0.5)
    assert found.is_material(0.2) is (material_step(own, 0.2) is not None)


@pytest.mark.parametrize(
    ("changes", "material"),
    [
        ({}, True),
        ({"px": (0.2, 9.0)}, False),
        ({"px": (9.0, 0.2)}, False),
        ({"step": (5.0, 0.0)}, False),
        ({"plain": (5.0, 0.0)}, False),
        ({"step": (5.001, 0.0), "plain": (5.001, 0.0)}, True),
        ({"plain": (-12.0, 0.2)}, False),
        ({"sd": (0.0, 1.0)}, False),
        ({"sd": (NAN, 1.0)}, False),
        ({"step": (0.0, -6.0), "plain": (0.0, -7.0)}, True),
    ],
)
def test_both_steps_have_to_be_material(changes, material):
    found = camera_step(**changes)
    assert found.is_material(0.2) is material
    assert (material_step(jointly.own_diagnostics(found, 0.5), 0.2) is not None) is material


@pytest.mark.parametrize("settings", [AuditConfig(), AuditConfig(min_effect="0.6sigma")])
def test_excluded_images_are_those_whose_camera_or_pose_is_rejected(settings):
    model = model_of(replace(SPEC, num_images=10, points_per_image=120), seed=3, adjusted=True)
    auditor = ModelAuditor(
        with_param(model, 4, 0, 1.1 * model.cameras.params[model.cameras.param_offsets[4]]), settings
    )
    images = [auditor.image(i) for i in range(len(model.images))]
    rejected = [Verdict.REJECTED in {i.decision.of(Member.CAMERA), i.decision.of(Member.POSE)} for i in images]
    assert rejected[4]
    assert auditor.joint.excluded.tolist() == rejected


# numbers


def test_own_numbers_are_those_on_which_both_weights_agree():
    found = jointly.own_diagnostics(camera_step(), 0.5)
    assert (found.step_px, found.sigma_px, found.num_images) == (0.3, 0.5, 2)
    assert [(s.name, s.stored, s.implied, s.step, s.sd) for s in found.steps] == [
        ("f", 1000.0, 1010.0, 10.0, 1.0),
        ("k", 0.05, pytest.approx(0.15), 0.1, 1.0),
    ]
    assert jointly.own_diagnostics(camera_step(px=(0.4, 0.3)), 0.5).step_px == 0.3
    against = jointly.own_diagnostics(camera_step(plain=(-12.0, -0.05)), 0.5)
    assert [step.step for step in against.steps] == [0.0, 0.0]
    smaller = jointly.own_diagnostics(camera_step(step=(-10.0, 0.1), plain=(-7.0, 0.05)), 0.5)
    assert [step.step for step in smaller.steps] == [-7.0, 0.05]
    smaller = jointly.own_diagnostics(camera_step(step=(-7.0, 0.05), plain=(-10.0, 0.1)), 0.5)
    assert [step.step for step in smaller.steps] == [-7.0, 0.05]


def test_a_joint_test_keeps_its_numbers():
    worth = JointWorth(0.1, 0.2, 0.3)
    tested = JointTest(0.001, 0.002, 0.5, 4, MisfitStatus.TESTED, 70.0, worth)
    unknown = JointTest(NAN, NAN, NAN, None, MisfitStatus.NO_COLUMNS, NAN, worth)
    tests = {group: tested if group is MisfitGroup.RADIAL else unknown for group in GROUPS}
    joint = SimpleNamespace(num_observations=np.array([0, 50]), misfit=SimpleNamespace(tests=[None, tests]))
    shared = SharedMisfit(MisfitGroup.RADIAL, 0.5, "camera 7")
    found = jointly.misfit_diagnostics(joint, 1, 0.4, shared)
    assert (found.num_tested, found.sigma_px, found.shared) == (50, 0.4, shared)
    radial = found.groups[MisfitGroup.RADIAL]
    assert (radial.q, radial.px, radial.rank, radial.status) == (0.002, 0.5, 4, MisfitStatus.TESTED)
    assert radial.gain == pytest.approx(70.0 + 4 - 4 * math.log(100))
    assert radial.worth == Worth(0.1, 0.2, 0.3)
    assert found.groups[MisfitGroup.SMOOTH].gain == -math.inf
    nothing = jointly.untested_misfit(30, 0.4, MisfitStatus.EXCLUDED)
    assert (nothing.num_tested, nothing.sigma_px) == (30, 0.4)
    assert {group.status for group in nothing.groups.values()} == {MisfitStatus.EXCLUDED}
    assert all(math.isnan(group.q) and group.gain == -math.inf for group in nothing.groups.values())


def test_consistency_in_words():
    known = ImageConsistency("a.jpg", 1, 30, 1.0, rms_px=2.0, inconsistent=False)
    found = jointly.consistency_diagnostics(known, all_behind=False)
    assert (found.inconsistent, found.text, found.rms_px, found.all_behind) == (False, "", 2.0, False)
    odd = replace(known, inconsistent=True, explanation=Explanation(Cause.LINKS, "wrong links", "RMS 9 px"))
    found = jointly.consistency_diagnostics(odd, all_behind=False)
    assert (found.inconsistent, found.text) == (True, odd.explanation.text)
    found = jointly.consistency_diagnostics(odd, all_behind=True)
    assert found.all_behind
    assert found.text == "all 30 observations lie behind the camera: axes flipped, or poses inverted?"


@pytest.mark.parametrize(
    ("inconsistent", "num_linked", "share_in_front", "is_behind"),
    [
        (None, 1, 0.0, True),
        (None, 19, 0.0, True),
        (None, 0, 0.0, False),  # nothing is there to lie behind
        (None, 19, 0.05, False),
        (None, 19, 1.0, False),
        (False, 19, 0.0, False),  # the model's other images have an answer
        (True, 30, 0.0, False),
    ],
)
def test_an_image_with_too_few_points_to_be_inconsistent_says_that_all_lie_behind(
    inconsistent, num_linked, share_in_front, is_behind
):
    image = ImageConsistency("a.jpg", 1, num_linked, share_in_front, inconsistent=inconsistent)
    found = jointly.consistency_diagnostics(image, all_behind=False)
    assert found.all_behind is is_behind
    behind = f"all {num_linked} observations lie behind the camera: axes flipped, or poses inverted?"
    assert found.text == (behind if is_behind else "")
    assert jointly.consistency_diagnostics(image, all_behind=True).all_behind


def test_gains_are_those_of_the_image():
    joint = SimpleNamespace(gains=[Gains(1.0, 2.0, 3.0), Gains(4.0, 5.0, 6.0)])
    assert jointly.gains_of(joint, 1) == Gains(4.0, 5.0, 6.0)


def quality(model="SIMPLE_RADIAL"):
    return SimpleNamespace(shape=SimpleNamespace(camera=SimpleNamespace(model=BY_NAME[model])))


@pytest.mark.parametrize("is_singular", [False, True])
@pytest.mark.parametrize("has_focal", [False, True])
@pytest.mark.parametrize("identified", [False, True])
def test_deviations_of_the_joint_system_take_the_place_of_conditional_ones(is_singular, has_focal, identified):
    camera = replace(CAMERA, has_focal=has_focal, is_singular=is_singular, is_joint=False)
    step = replace(camera_step(sd=(1.0, 0.25)), sd_focal_rel=0.004, focal_identified=identified)
    found = jointly.joint_camera(camera, quality(), step)
    assert (found.sd_focal_rel, found.sd_k1, found.is_joint) == (0.004, 0.25, True)
    assert found.is_singular is (is_singular or (has_focal and not identified))


def test_a_first_distortion_parameter_that_is_no_unknown_has_no_deviation():
    assert math.isnan(jointly.joint_camera(CAMERA, quality("PINHOLE"), camera_step()).sd_k1)
    assert math.isnan(jointly.joint_camera(CAMERA, quality("OPENCV"), camera_step()).sd_k1)  # k1, and the step has k


def test_implied_parameters_by_column():
    def one(parameter, camera_idx, *step: float):
        return SimpleNamespace(parameter=parameter, camera_idx=camera_idx, step=np.array(step), sd=0.1 * np.array(step))

    found = [one(Implied.PRINCIPAL_POINT, 3, 1.0, 2.0), one(Implied.ASPECT, 3, 4.0), one(Implied.RADIAL, 2, 9.0)]
    assert jointly.implied_by_camera(found)[3] == pytest.approx(
        {
            "implied_cx": 1.0,
            "implied_cx_sd": 0.1,
            "implied_cy": 2.0,
            "implied_cy_sd": 0.2,
            "implied_aspect": 4.0,
            "implied_aspect_sd": 0.4,
        }
    )
    assert jointly.implied_by_camera([one(Implied.TANGENTIAL, 3, 5.0, 6.0)])[3] == pytest.approx(
        {"implied_p1": 5.0, "implied_p1_sd": 0.5, "implied_p2": 6.0, "implied_p2_sd": 0.6}
    )
    assert jointly.implied_by_camera([one(Implied.RADIAL, 2, 7.0)])[2] == pytest.approx(
        {"implied_radial": 7.0, "implied_radial_sd": 0.7}
    )
    assert jointly.implied_by_camera([one(Implied.RADIAL, None, 7.0)]) == {}  # of all cameras together


# a camera that several images share


def shared_of(num_images=2, material=(MisfitGroup.RADIAL,), group=MisfitGroup.RADIAL, camera_id=7):
    camera = SimpleNamespace(
        camera=SimpleNamespace(camera_id=camera_id),
        image_idxs=np.arange(num_images),
        misfit=SimpleNamespace(material=material, group=group, px=0.41, q=1e-9),
    )
    auditor = SimpleNamespace(
        model=SimpleNamespace(images=SimpleNamespace(camera_id=np.array([7, 7]))), cameras=[camera]
    )
    return ModelAuditor.shared_misfit(auditor, 0)


def test_a_shared_camera_has_several_images_and_a_material_misfit():
    found = shared_of()
    assert (found.group, found.px) == (MisfitGroup.RADIAL, 0.41)
    assert found.text == "camera 7, 2 images: radial 0.41 px, q = 1e-09"
    assert shared_of(num_images=1) is None
    assert shared_of(material=()) is None
    assert shared_of(group=None) is None
    assert shared_of(camera_id=8) is None


def test_noise_and_tau_of_a_shared_camera_are_medians_of_its_images():
    model = model_of(replace(SPEC, shared_camera=True), seed=4)
    auditor = ModelAuditor(model, AuditConfig(min_effect="0.5sigma"))
    sigma_px = np.array([0.4, 0.5, 0.6, 0.8, 0.9, 2.0, 3.0])
    auditor.constant_fits = auditor.constant_fits._replace(sigma_px=sigma_px)
    assert auditor.image(0).diagnostics.own.sigma_px == 0.8
    (camera,) = auditor.cameras
    assert camera.misfit.tau_px == 0.4


# what is advised


def advice_for(material, group, rejecting=(), misfit=None, *, is_measured=True, retest=None):
    """What is advised in place of a SIMPLE_RADIAL camera without a distortion that is known."""
    camera = CameraRecord(1, BY_NAME["SIMPLE_RADIAL"], 1600, 1200, np.array([1000.0, 800.0, 600.0, 0.0]))
    known = SimpleNamespace(parameters=SimpleNamespace(sd_of=lambda _: 1.0))
    seen = SimpleNamespace(shape=SimpleNamespace(camera=camera), identifiability=known)
    verdict = misfit or (Verdict.REJECTED if material else Verdict.ACCEPTED)
    decisions = SimpleNamespace(
        misfit=SimpleNamespace(
            material=np.array([[each in material for each in GROUPS]] * 2),
            measured=SimpleNamespace(known=np.array([True, False])),
            record=lambda _: SimpleNamespace(material=material, group=group),
            tau_px=np.full(2, 0.2),
        ),
        rejects=np.array([bool(rejecting) or verdict is Verdict.REJECTED] * 2),
        members={Member.MISFIT: SimpleNamespace(verdict=np.array([VERDICTS.index(verdict)] * 2))},
    )
    advice, of_nothing = images_advice([seen if is_measured else None, seen], decisions, retest, alpha=0.05)
    assert of_nothing is None  # nothing was tested
    return advice


def test_no_smaller_model_is_advised_beside_a_rejection():
    assert advice_for((), None) == "SIMPLE_PINHOLE"
    assert advice_for((), MisfitGroup.SMOOTH) == "SIMPLE_PINHOLE"  # significant, not material
    assert advice_for((), None, rejecting=(Member.POSE,)) is None
    assert advice_for((), None, misfit=Verdict.UNDETERMINED) is None
    assert advice_for((MisfitGroup.RADIAL,), MisfitGroup.RADIAL) == "RADIAL"
    assert advice_for((MisfitGroup.RADIAL,), MisfitGroup.RADIAL, rejecting=(Member.POSE,)) == "RADIAL"
    assert advice_for((MisfitGroup.RADIAL,), MisfitGroup.RADIAL, misfit=Verdict.ACCEPTED) is None  # not worth it


def test_the_advice_holds_every_material_group_and_needs_a_camera_that_was_measured():
    both = (MisfitGroup.RADIAL, MisfitGroup.TANGENTIAL)
    assert advice_for(both, MisfitGroup.RADIAL) == "OPENCV"
    assert advice_for(both, MisfitGroup.RADIAL, is_measured=False) is None


def test_the_advice_is_tried_on_the_image_that_asks():
    def retest(row, camera):
        left = 1.0 if row == 0 and camera.model.name == "RADIAL" else 1e-9
        return {each: SimpleNamespace(p=left, px=1.0) for each in GROUPS}

    assert advice_for((MisfitGroup.AFFINE,), MisfitGroup.AFFINE) == "OPENCV"
    assert advice_for((MisfitGroup.AFFINE,), MisfitGroup.AFFINE, retest=retest) == "RADIAL"  # nothing was left


# what matters, in px and in sigma


def test_tau_in_sigma_needs_the_image_s_noise():
    assert effect_px("0.2px", None) == 0.2
    assert effect_px("0.5sigma", 0.4) == 0.2
    assert effect_px("0.5sigma", None) is None
    assert AuditConfig(min_effect="0.5sigma").tau_px(0.4) == 0.2
    assert AuditConfig(min_effect="0.3px").tau_px(0.4) == 0.3
    assert math.isnan(AuditConfig(min_effect="0.5sigma").tau_px(math.nan))


@pytest.mark.parametrize("tau_px", [page._tau_px, recompute.tau_px], ids=["page", "explain"])
def test_the_page_and_explain_read_the_same_tau(tau_px):
    assert tau_px({"min_effect": "0.5sigma"}, 0.4) == 0.2
    assert tau_px({"min_effect": "0.3px"}, 0.4) == 0.3
    assert tau_px({"min_effect": "0.5sigma"}, None) is None
    assert tau_px({}, 0.4) is None
