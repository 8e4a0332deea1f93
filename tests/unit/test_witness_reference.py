"""What a reference says of an image and of a model: exact agreement, a camera that was moved, fragments, drift."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from pair_samples import moved_image
from scipy.spatial.transform import Rotation
from witness_samples import TURN, poses_of, small_auditor, small_model

from sfm_audit.audit.config import AuditConfig
from sfm_audit.audit.engine.model import ModelAuditor
from sfm_audit.audit.table.thresholds import MAX_REFERENCE_CENTRE, MAX_REFERENCE_ROTATION_DEG, MIN_DRIFT
from sfm_audit.audit.table.witnesses import Witness
from sfm_audit.audit.witnesses.evidence import Evidence
from sfm_audit.audit.witnesses.reference import LEVEL, ask_reference, statement
from sfm_audit.audit.witnesses.sequence import shared_rms, smoothness_p
from sfm_audit.loaders.evidence import Given, NotAsked, ReferencePoses
from sfm_audit.loaders.model import FindingCode


@pytest.fixture(name="model")
def _model():
    return small_model()


@pytest.fixture(name="auditor")
def _auditor():
    return small_auditor()


def reference_to(model, shift=0.0, *, is_metric=True):
    """The model's own poses in another world, 2.5 times as large; ``shift`` is added to the centres, its units."""
    own = poses_of(model)
    centre = 2.5 * own.centre @ TURN.T + np.array([5.0, -2.0, 8.0]) + shift
    return ReferencePoses("ref.txt", own.rotation @ TURN.T, centre, is_metric)


def asked(auditor, model, reference):
    return ask_reference(Evidence(model, auditor.residuals, auditor.sigma_constant_px, reference=reference))


def codes(report):
    return [finding.code for finding in report.findings]


def test_a_model_agrees_with_itself_in_another_world(model, auditor):
    report = asked(auditor, model, reference_to(model))
    assert report.witness is Witness.REFERENCE
    assert max(said.score for said in report.testimonies) < 1e-5
    assert codes(report) == [FindingCode.REFERENCE_SCALE]
    assert "a unit of the model is 2.5 m of ref.txt" in report.findings[0].text
    assert report.columns["reference_fragment"] == (0,) * len(model.images)


def test_without_metres_nothing_is_said_of_scale(model, auditor):
    report = asked(auditor, model, reference_to(model, is_metric=False))
    assert codes(report) == []
    assert "units of the reference" in report.testimonies[0].text


def test_one_camera_elsewhere_is_named_with_how_far(model, auditor):
    shift = np.zeros((len(model.images), 3))
    shift[5] = [0.0, 3.0, 4.0]
    report = asked(auditor, model, reference_to(model, shift))
    assert_allclose(report.columns["reference_centre_error"][5], 5.0, rtol=1e-6)
    depth = Evidence(model, auditor.residuals, auditor.sigma_constant_px).median_depth
    assert_allclose(report.columns["reference_centre_rel"][5], 2.0 / depth, rtol=1e-6)
    said = report.testimonies[5]
    assert said.score == pytest.approx(2.0 / depth / MAX_REFERENCE_CENTRE)
    assert "5 m" in said.text
    assert report.columns["reference_fragment"][5] is None
    assert max(each.score for i, each in enumerate(report.testimonies) if i != 5) < 1e-5


def test_one_camera_turned_is_named_with_degrees(model, auditor):
    turned = moved_image(model, 3, 5.0)
    report = asked(auditor, turned, reference_to(model))
    assert report.columns["reference_rotation_deg"][3] == pytest.approx(5.0, rel=1e-6)
    assert report.testimonies[3].score == pytest.approx(5.0 / MAX_REFERENCE_ROTATION_DEG, rel=1e-6)


@pytest.mark.parametrize(
    ("centre", "rotation", "score"),
    [(MAX_REFERENCE_CENTRE, 0.0, 1.0), (0.0, 2 * MAX_REFERENCE_ROTATION_DEG, 2.0), (MAX_REFERENCE_CENTRE, 4.0, 2.0)],
)
def test_the_larger_share_of_a_limit_counts(centre, rotation, score):
    assert statement(centre, rotation, "x").score == pytest.approx(score)
    assert statement(centre, rotation, "x").limit == 1.0


def test_images_that_moved_together_are_a_fragment(model, auditor):
    own = poses_of(model)
    turn = Rotation.from_euler("z", 30, degrees=True).as_matrix()
    reference = reference_to(model)
    rotation, centre = reference.rotation.copy(), reference.centre.copy()
    rotation[:5] = own.rotation[:5] @ turn.T
    centre[:5] = own.centre[:5] @ turn.T + [30.0, 0.0, 0.0]
    report = asked(auditor, model, replace(reference, rotation=rotation, centre=centre))
    assert FindingCode.REFERENCE_FRAGMENTS in codes(report)
    assert report.columns["reference_fragment"] == (1,) * 5 + (0,) * 11
    text = next(f.text for f in report.findings if f.code == FindingCode.REFERENCE_FRAGMENTS)
    assert text.startswith(f"moved together: 5 images ({model.images.name[0]}, ")
    assert all(said.score > 1 for said in report.testimonies[:5])


def test_a_bow_is_drift_and_noise_is_none(model, auditor):
    n = len(model.images)
    depth = Evidence(model, auditor.residuals, auditor.sigma_constant_px).median_depth
    bow = np.zeros((n, 3))
    bow[:, 0] = 0.06 * 2.5 * depth * np.sin(np.linspace(0, 2 * np.pi, n))
    assert FindingCode.REFERENCE_DRIFT in codes(asked(auditor, model, reference_to(model, bow)))
    noise = np.random.default_rng(0).normal(0, 0.01 * 2.5 * depth, (n, 3))
    assert FindingCode.REFERENCE_DRIFT not in codes(asked(auditor, model, reference_to(model, noise)))
    small = bow * (0.5 * MIN_DRIFT / 0.06)  # smooth, and no matter
    assert FindingCode.REFERENCE_DRIFT not in codes(asked(auditor, model, reference_to(model, small)))


def test_what_does_not_fit_is_said_and_no_pass(model, auditor):
    reason = "ref: expected poses of the model's images, found none of them"
    report = asked(auditor, model, NotAsked(reason))
    assert (report.witness, report.testimonies) == (None, ())
    assert [(f.code, f.text) for f in report.findings] == [(FindingCode.REFERENCE_NOT_USED, reason)]
    strange = reference_to(model)
    mixed = replace(strange, rotation=Rotation.random(16, random_state=1).as_matrix())
    report = asked(auditor, model, mixed)
    assert codes(report) == [FindingCode.REFERENCE_NOT_USED]
    assert "no 3 of 16" in report.findings[0].text
    centre = strange.centre.copy()
    centre[2:] = np.nan
    report = asked(auditor, model, replace(strange, centre=centre))
    assert "it has 2 images of the model" in report.findings[0].text
    assert asked(auditor, model, None) is None


def test_an_image_that_the_reference_lacks_is_not_spoken_of(model, auditor):
    centre = reference_to(model).centre.copy()
    centre[4] = np.nan
    report = asked(auditor, model, replace(reference_to(model), centre=centre))
    assert report.testimonies[4] is None
    assert np.isnan(report.columns["reference_centre_rel"][4])
    assert report.columns["reference_fragment"][4] is None


def test_columns_exist_only_where_a_reference_was_given(model):
    turned = moved_image(model, 3, 5.0)
    config = AuditConfig(reference="ref.txt")
    tables = ModelAuditor(turned, config, given=Given(reference=reference_to(model))).tables()
    row = tables.images.to_pylist()[3]
    assert row["verdict_outside"] == "undetermined"
    assert any(each.startswith("reference_disagrees: its centre is ") for each in row["reasons"])
    assert row["witnesses"] == ["reference"]
    assert tables.models["witnesses"][0].as_py() == ["reference"]
    assert tables.images.schema.field("reference_rotation_deg").metadata[b"unit"] == b"deg"
    silent = ModelAuditor(turned, config, given=Given(reference=NotAsked("none"))).tables()
    assert silent.images.schema == tables.images.schema
    assert silent.images["verdict_outside"].null_count == 16
    assert "reference_centre_rel" not in ModelAuditor(model).tables().images.column_names


def test_smoothness_is_von_neumann_s_ratio():
    """p is uniform for independent errors, and small for a walk; by hand for 5 values."""
    rng = np.random.default_rng(2)
    p = np.array([smoothness_p(rng.normal(size=(30, 3))) for _ in range(400)])
    assert 0.02 < (p < 0.05).mean() < 0.09
    assert smoothness_p(np.cumsum(rng.normal(size=(30, 3)), axis=0)) < 1e-6
    errors = np.array([[1.0], [2.0], [3.0], [4.0], [5.0]])
    assert shared_rms(errors) == pytest.approx(np.sqrt((10 - 2) / 5))
    assert smoothness_p(errors) == pytest.approx(0.0118258, rel=1e-4)  # ratio 0.4, sd sqrt(4 * 3 / 24): z = -2.2627
    assert smoothness_p(errors[:3]) == 1.0
    assert smoothness_p(errors[:4]) < 0.1
    assert smoothness_p(np.ones((6, 2))) == 1.0
    assert LEVEL < 0.05


def other_convention(reference, name):
    rotation, centre = reference.rotation, reference.centre
    back = rotation.transpose(0, 2, 1)
    if name == "inverted":
        return replace(reference, rotation=back, centre=-np.einsum("nij,nj->ni", rotation, centre))
    if name == "rotations":
        return replace(reference, rotation=back)
    return replace(reference, rotation=np.diag([1.0, -1.0, -1.0]) @ rotation)


@pytest.mark.parametrize(
    ("name", "words"),
    [("inverted", "if its poses were inverted"), ("rotations", "its rotations inverted"), ("axes", "OpenGL")],
)
def test_another_convention_is_named_and_blames_no_image(model, auditor, name, words):
    report = asked(auditor, model, other_convention(reference_to(model), name))
    assert report.witness is None
    assert codes(report) == [FindingCode.REFERENCE_NOT_USED]
    assert f"; {len(model.images)} would" in report.findings[0].text
    assert words in report.findings[0].text


@pytest.mark.parametrize(("right", "used"), [(0.5, True), (0.49, False)])
def test_a_reference_that_few_images_follow_blames_nobody(model, auditor, right, used):
    """Three images may follow any similarity by chance: less than half of all is no reference to these images."""
    rng = np.random.default_rng(2)
    n = len(model.images)
    shift = 1e3 * rng.normal(size=(n, 3))
    shift[: int(np.ceil(right * n)) if used else int(np.ceil(n / 2)) - 1] = 0.0
    report = asked(auditor, model, reference_to(model, shift))
    assert (report.witness is Witness.REFERENCE) == used
    if not used:
        assert codes(report) == [FindingCode.REFERENCE_NOT_USED]
        assert f" of {n} images lie to each other as there" in report.findings[0].text
        assert "would" not in report.findings[0].text
