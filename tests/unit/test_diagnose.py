"""Evidence and refits: what the sentences rest on, and that a refit finds what was taken away."""

import dataclasses
import math

import numpy as np
import pycolmap
import pytest

from sfm_audit.audit import AuditConfig, ModelAuditor
from sfm_audit.audit.cli.diagnose_json import model_as_json
from sfm_audit.audit.diagnose.model import ModelEvidence, advised, diagnose_model
from sfm_audit.audit.diagnose.reading import conclusion, helps, readings, refit_reading
from sfm_audit.audit.diagnose.refit import Refit, candidates, refit, with_cameras
from sfm_audit.audit.diagnose.summary import summary_numbers
from sfm_audit.audit.simulate.adjust import adjust_scene, sparse_model
from sfm_audit.audit.simulate.defects import DefectKind, DefectSpec
from sfm_audit.audit.simulate.noise import NoiseSpec
from sfm_audit.audit.simulate.scene import SceneSpec, simulate_scene

DEFECTS = (DefectSpec(2, DefectKind.RADIAL_K2, 1.5), DefectSpec(5, DefectKind.RADIAL_K2, 1.5))
SPEC = SceneSpec(num_images=10, points_per_image=150, noise=NoiseSpec(sigma_px=0.3), defects=DEFECTS)


@pytest.fixture(scope="module")
def bent():
    """A model of which two lenses lack r^4."""
    scene = simulate_scene(SPEC, np.random.default_rng(5))
    return sparse_model(scene, adjust_scene(scene))


@pytest.fixture(scope="module")
def audited(bent):
    auditor = ModelAuditor(bent, AuditConfig())
    return auditor, auditor.tables()


def test_the_refit_as_advised_holds_what_the_control_does_not(audited, tmp_path, capfd):
    auditor, tables = audited
    images, cameras = tables.images.to_pylist(), tables.cameras.to_pylist()
    (diagnosis,) = tables.models.to_pylist()[0]["diagnoses"]
    assert (diagnosis["code"], diagnosis["num_images"]) == ("own_lenses", 2)
    assert advised(images, cameras) == ["RADIAL"]
    found = diagnose_model(auditor, images, cameras, ["own_lenses"], wanted=["RADIAL"], out=tmp_path)
    control, radial = found.refits
    assert (control.camera_model, control.numbers["rejected_misfit"]) == (None, 2)
    assert (radial.camera_model, radial.numbers["rejected_misfit"]) == ("RADIAL", 0)
    assert found.conclusion == "Refit as RADIAL."
    assert found.refit_readings[1].startswith("RADIAL: helps; misfit rejects 0 of 10 (was 2)")
    written = pycolmap.Reconstruction(tmp_path)
    assert {camera.model_name for camera in written.cameras.values()} == {"RADIAL"}
    assert capfd.readouterr().err == ""


def test_nothing_is_refitted_where_it_would_say_nothing(audited):
    auditor, tables = audited
    images, cameras = tables.images.to_pylist(), tables.cameras.to_pylist()
    for codes, refitted in ((["parts_disagree"], True), (["own_lenses"], False)):
        found = diagnose_model(auditor, images, cameras, codes, refitted=refitted)
        assert (len(found.refits), found.conclusion[:12]) == (0, "Not refitted")
        assert any(sentence.startswith("Not read") for sentence in found.readings) == (codes == ["parts_disagree"])
    assert found.numbers["rejected_misfit"] == 2


def test_no_lens_is_sought_where_most_cameras_are_like_none_or_nothing_was_measured(audited):
    auditor, tables = audited
    images, cameras = tables.images.to_pylist(), tables.cameras.to_pylist()
    odd = [{**row, "plausible": "rejected"} for row in images]
    found = diagnose_model(auditor, [*odd[:6], *images[6:]], cameras, ["implausible_cameras"])
    assert (found.refits, found.conclusion[:32]) == ((), "Not refitted: most cameras are l")
    exact = [{**row, "sigma_constant_px": 1e-6} for row in images]
    found = diagnose_model(auditor, exact, cameras, ["own_lenses"], refitted=False)
    assert found.readings == [
        "Not read: where poses or parts do not hold, or nothing was measured, residuals tell nothing of a lens."
    ]


def test_a_larger_camera_predicts_the_same(bent):
    larger = with_cameras(bent, "OPENCV")
    assert larger is not None
    assert {larger.camera(i).model.name for i in range(len(larger.cameras))} == {"OPENCV"}
    assert larger.camera(0).params[:4] == pytest.approx(bent.camera(0).params[[0, 0, 1, 2]])
    assert with_cameras(bent, "SIMPLE_PINHOLE") is None
    assert with_cameras(bent, "OPENCV_FISHEYE") is None
    assert candidates(bent, ["RADIAL", "none: smooth"]) == ["RADIAL"]
    assert candidates(bent, []) == ["RADIAL", "OPENCV", "FULL_OPENCV"]


def test_a_model_that_nobody_sees_is_not_adjusted(bent):
    blind = dataclasses.replace(
        bent,
        observations=dataclasses.replace(
            bent.observations,
            xy_px=bent.observations.xy_px[:0],
            point2d_idx=bent.observations.point2d_idx[:0],
            point_idx=bent.observations.point_idx[:0],
            offsets=np.zeros_like(bent.observations.offsets),
        ),
    )
    auditor = ModelAuditor(blind, AuditConfig())
    tables = auditor.tables()
    found = diagnose_model(auditor, tables.images.to_pylist(), tables.cameras.to_pylist(), ["too_little"])
    assert (found.refits, found.conclusion) == ((), "Not refitted: no image has an observation to adjust.")


def test_what_cannot_be_refitted_is_said(bent):
    assert refit(bent, "SIMPLE_PINHOLE", AuditConfig()).problem == "cannot express the present cameras"


def done(name, rejected, images=10, smooth=0.1):
    return Refit(name, {"rejected": rejected, "rejected_misfit": rejected, "images": images, "smooth_px": smooth})


def before(rejected, misfit):
    return {"rejected": rejected, "rejected_misfit": misfit, "images": 10}


FAILED = Refit("OPENCV", {}, "it is odd")


def test_a_refit_helps_where_it_leaves_half_of_the_control():
    assert helps(done(None, 10), done("RADIAL", 5))
    assert not helps(done(None, 10), done("RADIAL", 6))
    assert not helps(done(None, 0), done("RADIAL", 0))
    assert not helps(done(None, 10), FAILED)
    assert not helps(FAILED, done("RADIAL", 0))


def test_the_smallest_model_that_helps_is_the_conclusion():
    control = done(None, 10)
    tables, tried = before(10, 10), [done("RADIAL", 9), done("OPENCV", 1), done("FULL_OPENCV", 0)]
    assert conclusion(tables, control, tried) == "Refit as OPENCV."
    assert conclusion(tables, control, [done("RADIAL", 9), FAILED]).startswith("No refit helps")
    assert conclusion(tables, control, [FAILED]).startswith("No refit helps")
    part = [done("RADIAL", 8), done("OPENCV", 7)]
    assert (
        conclusion(tables, control, part)
        == "OPENCV holds a part: misfit rejects 7 instead of 10. What is left is not a lens of COLMAP's."
    )
    assert conclusion(tables, control, part[:1]).startswith("No refit helps")
    assert conclusion(tables, done(None, 0), [done("RADIAL", 0)]).startswith("Adjusting the model as it is")
    assert conclusion(tables, control, []).startswith("No larger camera model")
    assert conclusion(tables, FAILED, []) == "It cannot be adjusted (it is odd); repair that first."


def test_without_a_misfit_there_is_no_lens_to_refit():
    nothing = "Misfit rejects no image, so there is no lens to refit."
    assert conclusion(before(4, 0), done(None, 4), []) == nothing
    assert (
        conclusion(before(4, 0), done(None, 1), [])
        == f"{nothing} Adjusting the model as it is leaves 1 of 10 rejected (was 4)."
    )


def test_refits_are_read_against_the_control():
    tables = {"rejected_misfit": 8.0, "smooth_px": 0.4}
    control = done(None, 8)
    assert (
        refit_reading(tables, control, control)
        == "as it is: misfit rejects 8 of 10 (was 8), smooth 0.10 px (was 0.40)."
    )
    assert "helps;" in refit_reading(tables, control, done("RADIAL", 1))
    assert "does not help beyond adjusting;" in refit_reading(tables, control, done("RADIAL", 7))
    assert refit_reading(tables, control, FAILED) == "OPENCV: could not be refitted (it is odd)."
    assert "helps" not in refit_reading(tables, FAILED, done("RADIAL", 1))
    assert refit_reading(tables, control, done(None, 8, smooth=math.nan)) == "as it is: misfit rejects 8 of 10 (was 8)."


FOUND = {
    "common_smooth_px": 0.05,
    "common_radial_px": 0.02,
    "beyond_rs_px": 0.3,
    "by_observations": 0.9,
    "by_cells": 0.8,
    "neighbours": 0.1,
    "persistence": 0.2,
}


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({}, ("Different from image", "Rolling shutter alone does not")),
        ({"common_smooth_px": 0.2}, ("Common to all images, so the lens", "Rolling shutter alone does not")),
        ({"common_radial_px": 0.21}, ("A common part", "Rolling shutter alone does not")),
        ({"common_smooth_px": math.nan, "beyond_rs_px": 0.2}, ("Rolling shutter explains most",)),
        ({"by_cells": 0.5}, ("Different", "Rolling", "Part of the significance")),
        ({"beyond_rs_px": 0.5}, ("Different", "Rolling shutter does not explain it: the smooth field stays")),
        ({"neighbours": 0.2}, ("Different", "Rolling", "Neighbouring points")),
        ({"persistence": 0.5}, ("Different", "Rolling", "A point keeps its error")),
        ({"neighbours": math.nan, "persistence": math.nan, "by_cells": math.nan}, ("Different", "Rolling")),
    ],
)
def test_every_sentence_has_its_numbers(changed, said):
    sentences = readings({"smooth_px": 0.4}, {**FOUND, **changed})
    assert len(sentences) == len(said)
    assert all(sentence.startswith(begin) for sentence, begin in zip(sentences, said, strict=True))


def test_fields_too_small_for_a_sentence_are_left_out():
    assert readings({"smooth_px": 0.05}, FOUND) == []
    assert readings({"smooth_px": math.nan}, {}) == []


def test_json_knows_no_nan():
    row = dict.fromkeys(("dataset", "scene", "component", "model_path", "diagnoses"), "x")
    failed = Refit("RADIAL", {"a": math.inf}, "it is odd")
    found = ModelEvidence({"a": math.nan, "b": 1.0}, ("said",), (failed,), ("RADIAL: said",), "So.")
    told = model_as_json(row, found, None)
    assert told["numbers"] == {"a": None, "b": 1.0}
    assert told["refits"][0]["numbers"] == {"a": None}
    assert told["refits"][0]["reading"] == "RADIAL: said"
    assert (told["scene"], told["readings"], told["conclusion"]) == ("x", ["said"], "So.")


def test_a_summary_counts_and_takes_medians(audited):
    numbers = summary_numbers(audited[1].images.to_pylist())
    images = audited[1].images.to_pandas()
    assert numbers["rejected"] == (images.verdict == "rejected").sum()
    assert numbers["sigma_px"] == images.sigma_constant_px.median()
    assert numbers["joint_radial_px"] == images.misfit_radial_px_joint.median()
    assert numbers["worth_deg"] == images.misfit_worth_deg.abs().median()
    assert summary_numbers([])["images"] == 0
    assert math.isnan(summary_numbers([])["sigma_px"])
