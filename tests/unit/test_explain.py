import math

import numpy as np
import pytest
from run_samples import sample_table

from sfm_audit.audit.table.concerns import findings_about
from sfm_audit.audit.table.words import ReasonCode
from sfm_audit.loaders.model import FindingCode
from sfm_audit.reports.text.explain import LIMITS, REASON_CODES, Story, plain_reason, render_story, strongest_where

SIZE = (1600.0, 1200.0)


def reason(code, text, **numbers):
    """A reason as the tables hold it; without numbers as tables of version 0.1.0 do."""
    return {**dict.fromkeys(("verdict", "value", "limit", "unit", "group")), "code": code, "text": text, **numbers}


def a_misfit():
    return reason("misfit_radial", "0.42 px, q = 1e-05", value=0.42, limit=0.2, unit="px", group="radial")


def row(**changes):
    table = sample_table(
        "images", 1, image_name=["IMG_1.jpg"], camera_model=["SIMPLE_RADIAL"], params=[[800.0, 320.0, 240.0, 0.1]]
    )
    base = {"advised_camera_model": None, "kurtosis_excess": 0.0, "scale_ratio": 1.0, "misfit_group": None}
    return {**table.to_pylist()[0], **base, **changes}


def test_every_reason_of_the_audit_has_words():
    assert {str(code) for code in ReasonCode} == REASON_CODES


def test_a_bent_lens_in_plain_words():
    said = plain_reason(a_misfit(), row(advised_camera_model="RADIAL", misfit_q=1e-5), where="strongest in the corners")
    size = "0.42 px RMS, strongest in the corners (q = 1e-05)"
    assert said == f"the lens bends more than k1 can say: {size}; RADIAL would hold it"


@pytest.mark.parametrize(
    ("model", "words"),
    [
        ("RADIAL", "more than k1 and k2 can say"),
        ("FULL_OPENCV", "more than k1, k2, k3, k4, k5 and k6 can say"),
        ("SIMPLE_PINHOLE", "and SIMPLE_PINHOLE has no word for it"),
        ("FOV", "more than omega can say"),
    ],
)
def test_the_camera_s_own_words_for_distortion(model, words):
    assert words in plain_reason(a_misfit(), row(camera_model=model))


@pytest.mark.parametrize("code", sorted(REASON_CODES))
def test_every_sentence_keeps_the_numbers(code):
    detail = "0.42 px, q = 1e-05 (also smooth 0.40 px)" if code.startswith("misfit_") else "17 of 42"
    said = plain_reason(reason(code, detail), row(camera_model=None))
    number = "0.42 px" if code.startswith("misfit_") else "17 of 42"
    assert number in said or code == "distortion_folds"
    assert "{" not in said


def test_an_unknown_code_stays_as_it_is():
    assert plain_reason(reason("of_a_later_version", "3 <b>\n"), row()) == "of_a_later_version: 3 <b>\\n"


def test_heavy_tails_are_named():
    said = plain_reason(reason("ks_rejected", "p = 0.01"), row(kurtosis_excess=2.5, scale_ratio=3.0))
    assert "excess kurtosis 2.5" in said
    assert "3 times the variance" in said


@pytest.mark.parametrize(
    ("weight", "expected"),
    [
        (lambda x, y: (x**2 + y**2) ** 2, "strongest in the corners"),
        (lambda x, y: np.exp(-8 * (x**2 + y**2)), "strongest in the centre"),
        (lambda x, y: np.where(np.abs(x) > 0.8, 1.0, 0.0) * (np.abs(y) < 0.5), "strongest at the left and right edges"),
        (lambda x, _: np.ones_like(x), None),
    ],
)
def test_where_a_field_is_strongest(weight, expected):
    share = np.random.default_rng(0).uniform(-1, 1, (4000, 2))
    field = weight(*share.T)[:, None] * [1.0, 0.0]
    assert strongest_where((share + 1) / 2 * SIZE, field, SIZE) == expected


def test_the_story_fits_its_width_and_ends_with_what_it_does_not_prove():
    reasons = ["misfit_radial: 0.42 px, q = 1e-05", "k1_not_identified: 0.1, sd = 0.2"]
    given = row(reasons=reasons, verdict="rejected", verdict_misfit="rejected", image_name="a\nb" + "x" * 300)
    text = render_story(
        Story(given, {"policy": "full", "min_effect": "0.2px"}, "/data/m", None, {"01.png": "What it shows."})
    )
    assert "REJECTED under the policy full" in text
    assert "a\\nbxxx" in text
    assert text.index("Why") < text.index("Remarks (decide nothing)") < text.index("What a verdict does not prove")
    assert all(len(line) <= 100 for line in text.splitlines() if "xxx" not in line)
    assert LIMITS[-1] in text


def found(code, count=1, text="what was found"):
    return {"code": str(code), "count": count, "text": text}


@pytest.mark.parametrize(
    ("code", "shown", "hidden"),
    [
        (FindingCode.DANGLING_POINT_IDS, {"num_dangling": 1}, {"num_dangling": 0}),
        (FindingCode.NON_FINITE_POINTS, {"num_nonfinite": 2}, {"num_nonfinite": 0}),
        (FindingCode.NON_FINITE_OBSERVATIONS, {"num_nonfinite": 2}, {"num_nonfinite": None}),
        (FindingCode.POINTS_BEHIND, {"num_behind": 1}, {"num_behind": 0}),
        (FindingCode.CONTRADICTED_PAIRS, {"num_pairs_contradicting": 1}, {"num_pairs_contradicting": None}),
        (FindingCode.MISSING_CAMERAS, {"camera_model": None}, {}),
        (FindingCode.NON_FINITE_POSES, {"reasons": ["non_finite_pose: nan"]}, {"reasons": ["ks_rejected: p = 0"]}),
        (FindingCode.NON_FINITE_CAMERAS, {"params": [math.nan, 1.0]}, {"params": None}),
        (FindingCode.IMPLAUSIBLE_CAMERAS, {"plausible": "rejected"}, {"plausible": "undetermined"}),
        (FindingCode.IMAGES_DISAGREE, {"reasons": ["inconsistent: 9 px"]}, {"reasons": None}),
        (FindingCode.IMAGES_DISAGREE, {"reasons": ["points_behind: 8 of 9"]}, {"reasons": []}),
        (FindingCode.EXACT_PROJECTIONS, {"reasons": ["exact_projections: 0 px"]}, {"reasons": []}),
        (FindingCode.REFERENCE_FRAGMENTS, {"reasons": ["reference_disagrees: 3 m"]}, {"reasons": []}),
        (FindingCode.POSSIBLE_FOLD, {"reasons": ["fold_disagrees: 0.9"]}, {"reasons": []}),
    ],
)
def test_a_finding_about_some_images_stands_at_those_whose_row_shows_it(code, shown, hidden):
    assert findings_about(row(**shown), [found(code)], 5) == [found(code)]
    assert findings_about(row(**hidden), [found(code)], 5) == []


@pytest.mark.parametrize("code", [FindingCode.IMPLIED_RADIAL, FindingCode.NON_UNIT_QUATERNIONS])
def test_a_finding_that_only_counts_concerns_an_image_where_it_counts_all(code):
    assert findings_about(row(), [found(code, 5)], 5) == [found(code, 5)]
    assert findings_about(row(), [found(code, 4)], 5) == []


def test_findings_of_the_model_and_of_a_later_version_concern_every_image_those_of_files_none():
    findings = [found("rounded_poses"), found("stored_errors_stale"), found("of_a_later_version")]
    findings.append(found("reference_scale"))
    assert findings_about(row(), findings, 5) == [findings[0], findings[2]]


def test_the_story_tells_findings_about_its_model():
    def told(findings):
        model = {"num_images": 5, "findings": findings}
        config = {"policy": "standard", "min_effect": "0.2px"}
        return render_story(Story(row(), config, "/data/m", None, {}, model=model))

    text = told([found("rounded_poses", text="rounded to\x1b 6 decimals"), found("orphan_cameras")])
    assert "\nFindings about its model" in text
    assert "- rounded_poses: rounded to\\x1b 6 decimals\n- 1 more finding about other images" in text
    assert "- 2 findings about other images" in told([found("orphan_cameras"), found("unseen_points")])
    assert "Findings" not in told([])


def test_the_story_says_how_well_the_pose_is_known_where_somebody_asked():
    known = {"sd_rotation_deg": 0.034, "sd_centre": 0.0012, "sd_rotation_rel_deg": 0.012, "sd_centre_rel": 0.0004}
    told, untold = (
        render_story(Story(row(**changes), {}, "m", None, {}), 80) for changes in (known, dict.fromkeys(known))
    )
    assert "0.034 deg, 0.0012" in told
    assert "0.012 deg, 0.0004" in told
    assert "sd of the rotation" not in untold
