"""Many images at once say what each says alone: what is known before deciding, what is decided, what is written."""

from __future__ import annotations

from dataclasses import fields, is_dataclass, replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pyarrow as pa
import pytest
from decision_models import broken, defective, model_with
from decision_samples import (
    ABSORBED,
    EXACT_PX,
    EXCLUDED,
    LENS,
    MATERIAL,
    NAN,
    NOT_TESTED,
    SOUND,
    camera,
    misfit,
    noise,
    own,
    parts,
    sound,
    with_misfit,
    worth_misfit,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from sfm_audit.audit.config import AuditConfig
from sfm_audit.audit.decision.columns import _policy_reasons
from sfm_audit.audit.decision.decide import decide, decide_all
from sfm_audit.audit.decision.decisions import Reasons
from sfm_audit.audit.decision.diagnostics import Gains, SharedMisfit
from sfm_audit.audit.decision.judged import Said as Kind
from sfm_audit.audit.decision.measured import Measured
from sfm_audit.audit.engine import error_summary as errors
from sfm_audit.audit.engine.error_summary import error_summary
from sfm_audit.audit.engine.images import audit_images
from sfm_audit.audit.engine.known import measured_of
from sfm_audit.audit.engine.model import ModelAuditor
from sfm_audit.audit.engine.noise_columns import noise_columns
from sfm_audit.audit.engine.tables import Said
from sfm_audit.audit.inliers.residuals import longest_px
from sfm_audit.audit.kernels import kernels_in_use, numpy_only
from sfm_audit.audit.kernels.errors import error_summaries
from sfm_audit.audit.simulate.defects import DefectKind
from sfm_audit.audit.table import ModelLabels
from sfm_audit.audit.table.witnesses import Witness, WitnessStatement
from sfm_audit.audit.table.words import GROUPS, POLICIES, Member, MisfitGroup, Reason, ReasonCode

SHARED = SharedMisfit.of(7, 12, MisfitGroup.TANGENTIAL, 0.41, 1e-9)
AGAINST = WitnessStatement(Witness.PAIRS, 0.6, 0.5, "6 of 8 pairs")
ALL = [
    *(SOUND, noise(ks_p=0.01), noise(ks_stat=0.2), noise(num_standardised=3), noise(is_fitted=False)),
    *(with_misfit(radial=MATERIAL, smooth=NOT_TESTED), with_misfit(affine=MATERIAL, radial=MATERIAL, shared=SHARED)),
    *(with_misfit(**dict.fromkeys(LENS, ABSORBED)), with_misfit(**dict.fromkeys(GROUPS, EXCLUDED))),
    *(worth_misfit(deg=0.001, focal=NAN), sound(misfit=misfit(num_tested=3)), sound(misfit=None, camera=None)),
    *(own(), own(step_px=NAN), replace(own(), num_inliers=5), sound(own=None), sound(consistency=None)),
    *(parts(inconsistent=True, text="turned by 90 degrees"), parts(all_behind=True, text="all 300 lie behind")),
    *(camera(folds_over=True, k1=0.0), camera(coverage=0.01, sd_focal_rel=0.5), camera(principal_point_px=(-9.0, 1.0))),
    *(sound(pose_offset_px=2.0, gains=Gains(9.0, 1.0, 9.0)), sound(pose_offset_px=0.8, half_pixel=True)),
    *(sound(largest_residual_px=EXACT_PX), sound(testimonies=(AGAINST,)), sound(testimonies=())),
    sound(unusable=Reason(ReasonCode.MISSING_CAMERA, Member.MISFIT, "camera 3")),
    sound(remarks=(Reason(ReasonCode.FRONTO_PARALLEL, Member.PLAUSIBLE, "tilt 1 degree", 1.0, 5.0, "deg"),)),
]


@given(st.lists(st.sampled_from(ALL), min_size=1, max_size=12), st.sampled_from(list(POLICIES)), st.booleans())
@settings(max_examples=25)
def test_a_decision_does_not_depend_on_the_images_beside(images, policy, strict):
    config = AuditConfig(policy=policy, **({"min_effect": "0.1px", "alpha": 0.2} if strict else {}))
    together = decide_all(Measured.of(images), config)
    for i, diagnostics in enumerate(images):
        alone, found = decide(diagnostics, config), together.decision(i)
        assert (found.judgement, found.severity, found.pose_first) == (
            alone.judgement,
            alone.severity,
            alone.pose_first,
        )
        assert found.members == alone.members
        assert repr(found.misfit) == repr(alone.misfit)  # NaN
        assert together.rejects[i] == (alone.severity is not None)
        for other in POLICIES:
            assert together.under(other)[i] == decide_all(Measured.of([diagnostics]), config).under(other)[0]


def test_nobody_and_nothing():
    nobody = decide_all(Measured.of([]), AuditConfig())
    assert len(nobody) == 0
    assert not nobody.reasons.row.size
    assert decide(sound(remarks=()), AuditConfig()).all_reasons == decide(SOUND, AuditConfig()).all_reasons


def few_points():
    """An image without points, some with too few for a test."""
    model = model_with()
    observations = model.observations
    counts = np.diff(observations.offsets)
    counts[:6] = [0, 5, 5, 5, 19, 5]
    kept = np.concatenate([start + np.arange(n) for start, n in zip(observations.offsets, counts, strict=False)])
    columns = {name: getattr(observations, name)[kept] for name in ("point2d_idx", "point_idx", "xy_px")}
    return replace(model, observations=replace(observations, offsets=np.cumsum([0, *counts]), **columns))


MODELS = {
    "few": few_points,
    "lens": lambda: defective(DefectKind.RADIAL_K2),
    "pose": lambda: defective(DefectKind.PERTURBED_POSE),
    "broken": broken,
}


@pytest.fixture(scope="module", params=MODELS)
def auditor(request):
    with np.errstate(all="ignore"):
        auditor = ModelAuditor(MODELS[request.param]())
        _ = auditor.cameras, auditor.outside
        yield auditor


def test_what_decides_is_that_of_each_image(auditor):
    every = range(len(auditor.model.images))
    audits = [auditor.image(i) for i in every]
    wanted = Measured.of([each.diagnostics for each in audits])
    tested = noise_columns(auditor.residuals, auditor.tracks, every, auditor.constant_fits, auditor.noise)
    found = measured_of(auditor, every, tested.measured, error_summary(auditor.residuals, every).longest_px)
    assert_same(found, wanted)
    part = range(3, 7)
    tested = noise_columns(auditor.residuals, auditor.tracks, part, auditor.constant_fits, auditor.noise)
    found = measured_of(auditor, part, tested.measured, error_summary(auditor.residuals, part).longest_px)
    assert_same(found, Measured.of([audits[i].diagnostics for i in part]))


def assert_same(found, wanted):
    for field in fields(wanted):
        here, there = getattr(found, field.name), getattr(wanted, field.name)
        if is_dataclass(there):
            assert_same(here, there)
        elif isinstance(there, np.ndarray):
            assert here.shape == there.shape, field.name
            assert_allclose(here, there, rtol=1e-9, err_msg=field.name)
        else:
            assert repr(here) == repr(there), field.name  # NaN


def test_the_table_says_what_each_image_says(auditor):
    audits = [auditor.image(i) for i in range(len(auditor.model.images))]
    rows = auditor.tables().images.to_pylist()
    for audit, row in zip(audits, rows, strict=True):
        quality, camera = audit.quality, audit.image.camera
        assert (row["image_name"], row["camera_id"]) == (audit.image.name, audit.image.camera_id)
        assert row["params"] == (None if camera is None else pytest.approx(camera.params.tolist(), nan_ok=True))
        assert (row["width"], row["camera_model"]) == ((camera.width, camera.model.name) if camera else (None, None))
        assert row["verdict"] == audit.verdict
        assert row["reasons"] == [str(reason) for reason in audit.reasons]
        assert [(item["code"], item["text"]) for item in row["reason_details"]] == [
            (reason.code, reason.text) for reason in audit.decision.all_reasons
        ]
        assert row["severity"] == audit.decision.severity
        assert row["advised_camera_model"] == audit.advised_camera_model
        assert row["misfit_group"] == (audit.misfit.group if audit.misfit else None)
        assert row["num_inliers"] == len(audit.residuals_px)
        assert row["num_unverifiable"] == len(audit.residuals_px) - len(audit.noise.z)
        assert_allclose(row["sd_k1_conditional"] or np.nan, quality.identifiability.sd_k1 if quality else np.nan)
        assert_allclose(
            [row[name] or 0.0 for name in ("tx", "implied_cx", "sigma_d_px", "ks_constant_stat")],
            np.nan_to_num(
                [
                    audit.image.translation_cam_from_world[0],
                    audit.implied.get("implied_cx", 0.0),
                    audit.noise.sigma_d_px,
                    audit.constant_tests.ks_stat,
                ]
            ),
            rtol=1e-9,
        )
        for member in Member:
            assert row[member] == audit.decision.of(member)


def test_parts_of_the_images_make_the_same_table(auditor):
    labels, every = ModelLabels("d", "s", "0", "m"), range(len(auditor.model.images))
    (whole,) = audit_images(auditor, every, labels)
    parts = [audit_images(auditor, part, labels)[0] for part in (every[:1], every[1:5], every[5:])]
    assert_same_values(pa.concat_tables([part.table for part in parts]), whole.table)
    assert repr([row for part in parts for row in part.triage_rows]) == repr(whole.triage_rows)
    together = Said.together([part.said for part in parts])
    assert together.counts == whole.said.counts
    assert together.num_exact == whole.said.num_exact
    assert_array_equal(together.camera_rejected, whole.said.camera_rejected)


def assert_same_values(found, wanted):
    for name, kind in zip(wanted.column_names, wanted.schema.types, strict=True):
        here, there = found.column(name).to_pylist(), wanted.column(name).to_pylist()
        if kind == pa.float64():  # sums over images of one size are added in another order
            assert_allclose(*(np.array(column, dtype=float) for column in (here, there)), rtol=1e-9, err_msg=name)
        else:
            assert repr(here) == repr(there), name  # NaN in lists


@given(
    st.lists(st.integers(0, 70), min_size=1, max_size=6),
    st.integers(0, 2**32 - 1),
    st.sampled_from([1e-200, 1e-3, 1.0, 1e150]),
)
@settings(max_examples=30)
def test_errors_are_numpy_s(counts, seed, scale):
    residuals_px = scale * np.random.default_rng(seed).normal(size=(2, sum(counts)))
    residuals = SimpleNamespace(offsets=np.cumsum([0, *counts]), residuals_px=residuals_px)
    found = error_summary(residuals, range(len(counts)))
    for row, mine in zip(found.px, np.split(residuals_px, residuals.offsets[1:-1], axis=1), strict=True):
        length = np.hypot(*mine) if mine.size else np.full(1, np.nan)
        wanted = np.sqrt((length**2).mean()), length.mean(), *np.quantile(length, [0.5, 0.95, 1.0])
        assert_allclose(row, wanted, rtol=1e-12, atol=1e-160)
    assert_allclose(found.longest_px, [longest_px(residuals_px[:, a:b]) for a, b in pairwise(residuals.offsets)])


@pytest.mark.both_paths
def test_errors_of_some_images_are_those_of_all():
    counts, rng = [5, 0, 2000, 64, 65, 1, 0, 2, 300], np.random.default_rng(4)
    residuals_px = np.round(rng.normal(size=(2, sum(counts))), 1)  # many are equal
    residuals_px[:, 5:1300] = 0.0
    residuals = SimpleNamespace(offsets=np.cumsum([0, *counts]), residuals_px=residuals_px)
    every = error_summary(residuals, range(len(counts))).px
    for start, stop in ((0, 1), (1, 2), (2, 5), (4, 9), (3, 3)):
        assert_array_equal(error_summary(residuals, range(start, stop)).px, every[start:stop])
    with numpy_only():
        assert_allclose(every, error_summary(residuals, range(len(counts))).px, rtol=1e-12)
    assert np.isnan(every[[1, 6]]).all()
    assert (every[0] > 0).all()


@pytest.mark.skipif(not kernels_in_use(), reason="no compiled kernels")
@pytest.mark.parametrize("odd", [np.nan, np.inf, -np.inf, 1e300])
def test_errors_without_an_order_are_left_to_numpy(odd):
    residuals_px = np.random.default_rng(4).normal(size=(2, 40))
    residuals_px[1, 17] = odd
    out = np.zeros((4, 5))
    assert error_summaries(residuals_px, np.array([0, 10, 10, 30, 40]), out).tolist() == [True, False, False, True]
    assert (out[[1, 2]] == 0).all()
    for wrong in ([0, 41], [-1, 3], [5, 3]):
        with pytest.raises(IndexError, match="images beyond the 40 columns"):
            error_summaries(residuals_px, np.array(wrong), np.zeros((1, 5)))
    with pytest.raises(ValueError, match="room for"):
        error_summaries(residuals_px, np.array([0, 40]), np.zeros((1, 4)))


def test_images_that_are_left_need_not_follow_each_other(monkeypatch):
    counts = [70, 3, 0, 100, 2]
    residuals_px = np.random.default_rng(4).normal(size=(2, sum(counts)))
    residuals = SimpleNamespace(offsets=np.cumsum([0, *counts]), residuals_px=residuals_px)
    expected = error_summary(residuals, range(5)).px
    told = np.array([True, False, False, True, False])

    def some(_, __, out):
        out[told] = expected[told]
        return told

    monkeypatch.setattr(errors, "error_summaries", some)
    assert_allclose(error_summary(residuals, range(5)).px, expected, rtol=1e-12)


def test_each_sentence_is_told_once_of_each_image():
    about, nan = (ReasonCode.MISSING_CAMERA, Member.MISFIT, "", None), np.full(4, NAN)
    one = Kind(*about, np.arange(4), ["a", "b", "c", "a"], nan, nan)
    two = Kind(*about, np.array([0, 3]), ["b", "a"], nan[:2], nan[:2])
    told = _policy_reasons(Reasons.of((one, two)), "standard", np.zeros(4, dtype=bool))
    assert told.offsets.tolist() == [0, 2, 3, 4, 5]
