"""From the verdicts of a model's images to diagnoses: every branch, the order, and that no image is told twice."""

import pytest

from sfm_audit.audit.decision.triage import triage
from sfm_audit.audit.table.diagnoses import DIAGNOSES, DiagnosisCode


def image(
    name="a.jpg", *reasons: str, verdict="rejected", severity="medium", advice=None, px=None, camera_id=1, group=None
):
    return {
        "image_name": name,
        "camera_id": camera_id,
        "verdict": verdict,
        "severity": severity,
        "reasons": list(reasons),
        "misfit_group": group,
        "misfit_px": px,
        "advised_camera_model": advice,
    }


def camera(camera_id=1, num_images=8, *, material=False, advice=None, px=0.67, group="radial"):
    return {
        "camera_id": camera_id,
        "camera_model": "SIMPLE_RADIAL",
        "num_images": num_images,
        "misfit_material": material,
        "misfit_group": group,
        "misfit_px": px,
        "advised_camera_model": advice,
    }


RADIAL = "misfit_radial: 0.4 px"
ONE = camera(num_images=1)
BRANCHES = [
    ([], "accepted", None, ONE, "sound"),
    (["low_coverage: 8 %"], "accepted", None, ONE, "sound"),
    (["inconsistent: half size", RADIAL], "rejected", None, ONE, "parts_disagree"),
    (["points_behind: all"], "undetermined", None, ONE, "parts_disagree"),
    (["inconsistent: half size"], "accepted", None, ONE, "sound"),
    (["focal_out_of_range: 12", "pairs_disagree: 3"], "rejected", None, ONE, "witnesses_disagree"),
    (["fold_disagrees: 0.2"], "undetermined", None, ONE, "witnesses_disagree"),
    (["pose_not_optimal: 1", "focal_out_of_range: 12"], "rejected", None, ONE, "implausible_cameras"),
    (["distortion_folds: x"], "rejected", None, ONE, "implausible_cameras"),
    (["principal_point_outside: x"], "rejected", None, ONE, "implausible_cameras"),
    (["pose_not_optimal: 1", "camera_not_optimal: f"], "rejected", None, ONE, "poses_moved"),
    (["camera_not_optimal: f", "pose_not_optimal: 1"], "rejected", None, ONE, "camera_frozen"),
    ([RADIAL], "rejected", "RADIAL", camera(material=True, advice="RADIAL"), "shared_lens"),
    (["shared_camera: radial"], "rejected", None, camera(material=True, advice="RADIAL"), "shared_lens"),
    ([RADIAL], "rejected", "RADIAL", camera(material=True, advice="none: smooth"), "shared_field"),
    ([RADIAL], "rejected", "RADIAL", camera(material=True, advice=None), "shared_field"),
    ([RADIAL], "rejected", "RADIAL", camera(material=True, advice="RADIAL", num_images=1), "own_lenses"),
    ([RADIAL], "rejected", "RADIAL", camera(material=False), "own_lenses"),
    (["misfit_smooth: 1"], "rejected", "none: smooth", ONE, "own_fields"),
    (["misfit_smooth: 1"], "rejected", None, ONE, "own_fields"),
    (["noise_differs: 0.4", "focal_not_identified: 1"], "rejected", None, ONE, "noise_only"),
    (["ks_rejected: 0.01"], "rejected", None, ONE, "noise_only"),
    (["exact_projections: 0", "focal_not_identified: 1"], "undetermined", None, ONE, "not_measured"),
    (["focal_not_identified: 1", "low_coverage: 1"], "undetermined", None, ONE, "focal_unknown"),
    (["low_coverage: 1"], "undetermined", None, ONE, "too_little"),
    (None, "undetermined", None, ONE, "too_little"),
]


@pytest.mark.parametrize(("reasons", "verdict", "advice", "of", "code"), BRANCHES, ids=str)
def test_an_image_belongs_to_the_most_urgent_diagnosis(reasons, verdict, advice, of, code):
    row = {**image(verdict=verdict, advice=advice, px=0.4, group="radial"), "reasons": reasons}
    (found,) = triage([row], [of], "m")
    assert found.code == code
    assert found.num_images == 1


def test_every_diagnosis_is_reached_and_has_words():
    assert {code for *_, code in BRANCHES} == set(DiagnosisCode) == set(DIAGNOSES)


def test_where_parts_disagree_every_rejection_is_about_that_and_nothing_else_is():
    rows = [
        image("a", "pose_not_optimal: 300"),
        image("b", RADIAL),
        image("c", "low_coverage: 1", verdict="undetermined"),
        image("d", verdict="accepted"),
    ]
    found = triage(rows, [ONE], "m", parts_disagree=True)
    assert [(each.code, each.num_images) for each in found] == [("parts_disagree", 2), ("too_little", 1)]
    assert "parts_disagree" not in {each.code for each in triage(rows, [ONE], "m")}
    assert [each.code for each in triage(rows[3:], [ONE], "m", parts_disagree=True)] == ["sound"]


def test_a_rejection_that_does_not_count_has_no_diagnosis():
    assert triage([image("a", RADIAL, verdict="undetermined")], [ONE], "m") == []
    assert triage([], [], "m") == []


def test_the_most_urgent_comes_first_and_alone_has_examples():
    rows = [
        image("noise", "noise_differs: 1", severity="weak"),
        image("small", "pose_not_optimal: 1", severity="hard", px=None),
        image("b", "pose_not_optimal: 2", severity="hard", px=float("nan")),
        image("large", "pose_not_optimal: 2", severity="hard", px=2.0),
        image("weak", "pose_not_optimal: 2", severity="weak", px=9.0),
        image("fine", verdict="accepted", severity=None),
    ]
    first, second = triage(rows, [ONE], "m")
    assert (first.code, first.num_images, first.severity, first.examples) == ("poses_moved", 4, "hard", ("large", "b"))
    assert (second.code, second.num_images, second.severity, second.examples) == ("noise_only", 1, "weak", ())


def test_a_sound_model_has_no_examples_and_no_severity():
    (found,) = triage([image("a", verdict="accepted", severity=None)], [ONE], "m")
    assert (found.examples, found.severity, found.camera_id) == ((), None, None)


def test_cameras_at_fault_are_told_one_by_one():
    of = [camera(1, material=True, advice="RADIAL"), camera(2, material=True, advice="OPENCV"), camera(3)]
    rows = [
        *(image(f"{i}", RADIAL, camera_id=i) for i in (1, 2, 2)),
        *(image("f", "camera_not_optimal: f stored 1, implied 2", camera_id=i) for i in (3, 3, 4)),
    ]
    found = triage(rows, of, "it's here")
    assert [(each.code, each.camera_id, each.num_images) for each in found] == [
        ("camera_frozen", 3, 2),
        ("camera_frozen", None, 1),
        ("shared_lens", 2, 2),
        ("shared_lens", 1, 1),
    ]
    assert found[0].text == "cameras were frozen at a wrong value: f stored 1, implied 2"
    assert found[2].action.startswith("refit camera 2 as OPENCV;")
    assert "(camera 2, SIMPLE_RADIAL, 8 images): radial distortion beyond r^2 0.67 px" in found[2].text
    assert found[2].command == "sfm-audit diagnose RUN 'it'\"'\"'s here'"


def test_single_images_are_told_by_advice():
    rows = [
        *(image(f"{i}", RADIAL, advice="RADIAL", group="radial", camera_id=i) for i in range(3)),
        image("x", "misfit_affine: 1", advice="OPENCV", group="affine", camera_id=9),
    ]
    first, second = triage(rows, [], "m")
    assert (first.num_images, first.text) == (3, "lenses of single images lack a term (radial 3)")
    assert "refit them as RADIAL" in first.action
    assert "refit them as OPENCV" in second.action
    (field,) = triage([image("x", "misfit_smooth: 1")], [], "m")
    assert field.text == DIAGNOSES[DiagnosisCode.OWN_FIELDS].meaning


def test_a_shared_field_without_a_name_is_told_as_that():
    (found,) = triage([image("x", RADIAL)], [camera(material=True, group=None, px=None)], "m")
    assert "no named field 0.00 px" in found.text


def test_equally_urgent_ones_stand_by_camera_and_by_advice():
    of = [camera(1, 2, material=True, advice="RADIAL"), camera(2, 2, material=True, advice="OPENCV")]
    found = triage([image("b", RADIAL, camera_id=2), image("a", RADIAL, camera_id=1)], of, "m")
    assert [(each.code, each.camera_id) for each in found] == [("shared_lens", 1), ("shared_lens", 2)]
    rows = [image("b", RADIAL, advice="RADIAL", camera_id=8), image("a", RADIAL, advice="OPENCV", camera_id=9)]
    first, second = triage(rows, [], "m")
    assert ("OPENCV" in first.action, "RADIAL" in second.action) == (True, True)


def test_two_images_are_enough_for_a_shared_camera():
    (found,) = triage([image("a", "camera_not_optimal: f", camera_id=1)], [camera(1, 2)], "m")
    assert (found.code, found.camera_id) == ("camera_frozen", 1)


def test_what_is_no_matter_of_the_camera_is_told_once_whatever_camera_and_advice():
    of = [camera(1), camera(2)]
    rows = [image("a", "pose_not_optimal: 1", camera_id=1), image("b", "pose_not_optimal: 1", camera_id=2)]
    assert [(each.code, each.camera_id, each.num_images) for each in triage(rows, of, "m")] == [
        ("poses_moved", None, 2)
    ]
    rows = [image("a", "noise_differs: 1", advice="RADIAL", group="radial"), image("b", "noise_differs: 1")]
    (found,) = triage(rows, of, "m")
    assert (found.num_images, found.text) == (2, DIAGNOSES[DiagnosisCode.NOISE_ONLY].meaning)


def test_details_are_those_of_the_diagnosis():
    (field,) = triage([image("x", "misfit_smooth: 1", group="smooth")], [], "m")
    assert field.text.endswith(" (smooth 1)")
    reasons = ("k1_not_identified: 0.1", "camera_not_optimal: f stored 1, implied 2")
    (frozen,) = triage([image("x", *reasons)], [], "m")
    assert frozen.text.endswith(": f stored 1, implied 2")


def test_the_witnesses_that_disagree_are_named_with_how_many_images():
    rows = [
        image("a", "reference_disagrees: 3 m", "priors_disagree: 4 m", verdict="undetermined"),
        image("b", "reference_disagrees: 2 m", RADIAL),
        image("c", verdict="accepted"),
    ]
    (found,) = triage(rows, [ONE], "m")
    assert found.text == f"{DIAGNOSES[DiagnosisCode.WITNESSES_DISAGREE].meaning} (reference 2, priors 1)"
