"""What pairs say of an image and of a model: numbers against SciPy, a camera that was moved, the sides of a seam."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from pair_samples import moved_image
from scipy.stats import binom

from sfm_audit.audit.engine.model import ModelAuditor
from sfm_audit.audit.simulate.adjust import sparse_model, true_claim
from sfm_audit.audit.simulate.matches import OwnPairs
from sfm_audit.audit.simulate.noise import NoiseSpec
from sfm_audit.audit.simulate.scene import SceneSpec, simulate_scene
from sfm_audit.audit.table.witnesses import Witness
from sfm_audit.audit.witnesses.epipolar import PairCounts
from sfm_audit.audit.witnesses.evidence import Evidence
from sfm_audit.audit.witnesses.pairs import ask_pairs, contradiction_p, pairs_report
from sfm_audit.audit.witnesses.seam import seam_of
from sfm_audit.loaders.colmap.pairs import RefusedPairs
from sfm_audit.loaders.errors import MissingFileError
from sfm_audit.loaders.evidence import Given
from sfm_audit.loaders.model import FindingCode

SPEC = SceneSpec(num_images=10, points_per_image=500, noise=NoiseSpec(sigma_px=0.5))


@pytest.fixture(scope="module")
def model():
    scene = simulate_scene(SPEC, np.random.default_rng(4))
    return sparse_model(scene, true_claim(scene))


def evidence_of(model, pairs=None):
    auditor = ModelAuditor(model)
    return Evidence(model, auditor.residuals, auditor.sigma_constant_px, pairs)


def counts_of(image_idx, num=100, far=()):
    far_of = [num if i in far else 0 for i in range(len(image_idx))]
    return PairCounts(np.array(image_idx), np.full(len(image_idx), num), np.array(far_of))


def test_p_is_binomial_with_the_rate_of_the_other_pairs():
    """Eight images in a ring of neighbours; image 0 has 3 of 4 pairs against it, its partners one of 4."""
    num, against = np.array([4, 4, 4, 4, 4, 4, 4, 0]), np.array([3, 1, 1, 1, 0, 0, 0, 0])
    p = contradiction_p(num, against)
    wanted = [binom.sf(2, 4, 0.01), binom.sf(0, 4, 2 / 10), binom.sf(0, 4, 2 / 10), binom.sf(0, 4, 2 / 10), 1, 1, 1]
    assert_allclose(p[:7], wanted, rtol=1e-12)
    assert np.isnan(p[7])


def test_no_rate_below_one_percent_and_no_model_of_one_pair():
    p = contradiction_p(np.array([1, 1]), np.array([1, 1]))
    assert_allclose(p, 0.01)


def test_without_a_database_nobody_is_asked(model):
    assert ask_pairs(evidence_of(model)) is None
    assert ModelAuditor(model).outside.witnesses == ()


def test_a_database_that_cannot_be_used_is_a_finding_and_no_pass(model):
    reason = MissingFileError("scene", None, "a database.db", "none", "name it")
    report = ask_pairs(evidence_of(model, RefusedPairs(reason)))
    assert (report.witness, report.testimonies) == (None, ())
    assert [(f.code, f.text) for f in report.findings] == [(FindingCode.DATABASE_NOT_USED, str(reason))]
    tables = ModelAuditor(model, given=Given(RefusedPairs(reason))).tables()
    assert tables.images["verdict_outside"].null_count == tables.images["witnesses"].null_count == 10


def test_a_sound_model_agrees_with_its_pairs(model):
    tables = ModelAuditor(model, given=Given(OwnPairs(model))).tables()
    images, models = tables.images.to_pylist(), tables.models.to_pylist()
    assert {row["verdict_outside"] for row in images} == {"accepted"}
    assert models[0]["witnesses"] == ["pairs"]
    assert all(row["witnesses"] == ["pairs"] and row["num_pairs_strong"] > 3 for row in images)
    assert all(row["num_pairs_contradicting"] == 0 and row["pairs_q"] == 1.0 for row in images)
    assert "contradicted_pairs" not in {finding["code"] for finding in models[0]["findings"]}


def test_a_moved_camera_is_named_and_its_neighbours_are_not(model):
    moved = moved_image(model, 3, 1.0)
    tables = ModelAuditor(moved, given=Given(OwnPairs(moved))).tables()
    verdicts = tables.images["verdict_outside"].to_pylist()
    assert verdicts[3] in {"undetermined", "rejected"}
    assert set(verdicts[:3] + verdicts[4:]) == {"accepted"}
    row = tables.images.to_pylist()[3]
    assert row["num_pairs_covisible_contradicting"] == row["num_pairs_covisible"] >= 4
    assert any(reason.startswith("pairs_disagree") for reason in row["reasons"])
    (text,) = [f["text"] for f in tables.models.to_pylist()[0]["findings"] if f["code"] == "contradicted_pairs"]
    assert moved.images.name[3] in text


def test_pairs_of_images_that_see_nothing_together_speak_of_the_model_alone(model):
    """The trap: a right model of a symmetric building contradicts the false matches that the mapper left out."""
    half = 2 * len(model.points) // 4
    table = model.observations
    image_idx = np.repeat(np.arange(10), np.diff(table.offsets))
    kept = (table.point_idx < half) == (image_idx < 5)  # two halves that share no point
    offsets = np.concatenate([[0], np.cumsum(np.bincount(image_idx[kept], minlength=10))])
    apart = replace(
        table,
        offsets=offsets,
        point2d_idx=table.point2d_idx[kept],
        xy_px=table.xy_px[kept],
        point_idx=table.point_idx[kept],
    )
    evidence = evidence_of(replace(model, observations=apart))
    across = [(i, j) for i in range(5) for j in range(5, 10)]
    inside = [(i, j) for k in (0, 5) for i in range(k, k + 5) for j in range(i + 1, k + 5)]
    report = pairs_report(evidence, counts_of(across + inside, far=range(len(across))), 4.0)
    assert (report.columns["num_pairs_contradicting"] == 5).all()
    assert (report.columns["num_pairs_covisible_contradicting"] == 0).all()
    assert all(said is None or said.score == 0.0 for said in report.testimonies)
    (finding,) = report.findings
    assert (finding.code, finding.count) == (FindingCode.CONTRADICTED_PAIRS, 25)
    sides = finding.text.rsplit(": ", 1)[1].split(" | ")
    assert {name for side in sides for name in side.split(" (")[0].split(", ")} <= set(model.images.name)


@pytest.mark.parametrize(("num_far", "num", "against"), [(51, 100, 1), (50, 100, 0), (60, 60, 1), (59, 59, 0)])
def test_a_pair_contradicts_where_most_of_at_least_60_matches_do(model, num_far, num, against):
    counts = PairCounts(np.array([[0, 1]]), np.array([num]), np.array([num_far]))
    columns = pairs_report(evidence_of(model), counts, 4.0).columns
    assert columns["num_pairs_strong"][:3].tolist() == ([1, 1, 0] if num >= 60 else [0, 0, 0])
    assert columns["num_pairs_contradicting"][:3].tolist() == [against, against, 0]


def test_images_with_fewer_than_three_strong_pairs_are_not_spoken_of(model):
    """Of two images that contradict each other nobody knows which one is wrong."""
    report = pairs_report(evidence_of(model), counts_of([(0, 1), (0, 2), (1, 2), (0, 3)], far=[0]), 4.0)
    assert [each is None for each in report.testimonies] == [False, *[True] * 9]
    assert (report.testimonies[0].witness, report.testimonies[0].score) == (Witness.PAIRS, 1 / 3)
    assert [np.isnan(value) for value in report.columns["pairs_p"]] == [False, *[True] * 9]
    assert report.columns["num_pairs_covisible"][:4].tolist() == [3, 2, 2, 1]


@pytest.mark.parametrize(("num_far", "found"), [(0, 0), (1, 0), (3, 1)])
def test_a_single_contradicted_pair_is_no_finding(model, num_far, found):
    pairs = [(i, j) for i in range(10) for j in range(i + 1, 10)][:30]
    assert len(pairs_report(evidence_of(model), counts_of(pairs, far=range(num_far)), 4.0).findings) == found


def test_the_sides_of_a_seam():
    """Two groups, satisfied pairs within, contradicted ones across; an image that is in none does not matter."""
    within = [(0, 1), (1, 2), (0, 2), (3, 4), (5, 3), (6, 0), (6, 3)]
    across = [(0, 3), (1, 4), (2, 5), (0, 4)]
    against = np.array([False] * len(within) + [True] * len(across))
    one, other = seam_of(np.array(within + across), against)
    assert {frozenset(one.tolist()), frozenset(other.tolist())} == {frozenset({0, 1, 2}), frozenset({3, 4, 5})}
    assert one[0] == 0  # with most contradicted pairs
    assert [len(side) for side in seam_of(np.array(within), np.zeros(len(within), bool))] == [0, 0]
