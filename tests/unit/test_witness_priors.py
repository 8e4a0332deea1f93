"""Position priors against SciPy: the law of the squared distances, the similarity, what a wrong prior does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import chi2, kstest
from witness_samples import TURN, poses_of, small_auditor, small_model

from sfm_audit.audit.alignment.positions import CHI2_3_MEDIAN, MIN_POSITIONS, align_positions
from sfm_audit.audit.config import AuditConfig
from sfm_audit.audit.decision.outside import disagrees
from sfm_audit.audit.engine.model import ModelAuditor
from sfm_audit.audit.table.thresholds import MAX_PRIOR_CHI2, MAX_PRIOR_SPREAD
from sfm_audit.audit.table.witnesses import Witness
from sfm_audit.audit.witnesses.evidence import Evidence
from sfm_audit.audit.witnesses.priors import _judged, ask_priors, prior_p
from sfm_audit.loaders.evidence import Given, NotAsked, PositionPriors
from sfm_audit.loaders.model import FindingCode

SETTINGS = AuditConfig()


@pytest.fixture(name="model")
def _model():
    return small_model()


@pytest.fixture(name="auditor")
def _auditor():
    return small_auditor()


def covariances(n, rng, size=1.0):
    sd = size * rng.uniform(0.5, 2.0, (n, 3))
    turns = Rotation.random(n, random_state=int(rng.integers(1 << 30))).as_matrix()
    return np.einsum("nij,nj,nkj->nik", turns, sd**2, turns)


def positions(centre, covariance, rng, scale=2.5):
    noise = np.einsum("nij,nj->ni", np.linalg.cholesky(covariance), rng.normal(size=centre.shape))
    return scale * centre @ TURN.T + [5.0, -2.0, 8.0] + noise


def priors_to(model, rng, size=0.05):
    centre = poses_of(model).centre
    covariance = covariances(len(centre), rng, size)
    return PositionPriors("p.csv", positions(centre, covariance, rng), covariance, is_metric=True)


def asked(auditor, model, priors):
    return ask_priors(Evidence(model, auditor.residuals, auditor.sigma_constant_px, priors=priors))


def test_the_numbers_are_scipy_s():
    """scipy.stats.chi2, 3 degrees of freedom."""
    values = np.array([0.0, 1.0, 7.8, 11.3, 40.0])
    assert_allclose(prior_p(values), chi2.sf(values, 3), rtol=1e-12)
    assert pytest.approx(chi2.ppf(0.99, 3)) == MAX_PRIOR_CHI2
    assert pytest.approx(chi2.ppf(0.5, 3)) == CHI2_3_MEDIAN


def test_the_fit_is_weighted_least_squares():
    rng = np.random.default_rng(1)
    centre = rng.normal(0, 10, (30, 3))
    covariance = covariances(30, rng)
    position = positions(centre, covariance, rng)
    found = align_positions(centre, position, covariance)
    root = np.linalg.inv(np.linalg.cholesky(covariance))

    def residuals(x):
        moved = np.exp(x[3]) * centre @ Rotation.from_rotvec(x[:3]).as_matrix().T + x[4:]
        return np.einsum("nij,nj->ni", root, position - moved).ravel()

    start = [*Rotation.from_matrix(TURN).as_rotvec(), np.log(2.5), 5.0, -2.0, 8.0]
    best = least_squares(residuals, start, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    assert found.fitted.all()
    assert found.similarity.scale == pytest.approx(np.exp(best.x[3]), rel=1e-7)
    assert_allclose(found.similarity.rotation, Rotation.from_rotvec(best.x[:3]).as_matrix(), atol=1e-7)
    assert_allclose(found.similarity.shift, best.x[4:], atol=1e-5)
    sd = np.sqrt(np.linalg.inv(best.jac.T @ best.jac)[3, 3]) * found.similarity.scale
    assert found.sd_scale == pytest.approx(sd, rel=1e-4)


def test_squared_distances_are_chi2_of_three():
    """The law, with 15 positions: without the fit's share, 7 of 45 degrees, they would be too small (mean 2.5)."""
    rng = np.random.default_rng(3)
    centre = rng.normal(0, 10, (15, 3))
    values = []
    for _ in range(60):
        covariance = covariances(15, rng)
        values.append(align_positions(centre, positions(centre, covariance, rng), covariance).chi2)
    assert kstest(np.concatenate(values), chi2(3).cdf).pvalue > 0.01
    assert np.mean(np.concatenate(values)) == pytest.approx(3.0, abs=0.15)


def test_wrong_positions_do_not_pull_the_rest():
    rng = np.random.default_rng(4)
    centre = rng.normal(0, 10, (20, 3))
    covariance = covariances(20, rng, 0.1)
    position = positions(centre, covariance, rng)
    position[:7] += rng.normal(0, 30, (7, 3))
    found = align_positions(centre, position, covariance)
    assert found.similarity.scale == pytest.approx(2.5, rel=0.01)
    assert not found.fitted[:7].any()
    assert found.chi2[7:].max() < 20 < found.chi2[:7].min()


def test_cameras_on_a_line_are_compared_along_and_across():
    rng = np.random.default_rng(5)
    centre = np.outer(np.arange(12.0), [1.0, 2.0, 0.5])
    covariance = covariances(12, rng, 0.05)
    position = positions(centre, covariance, rng)
    position[4] += [0.0, 0.0, 2.0]
    found = align_positions(centre, position, covariance)
    assert found.similarity.scale == pytest.approx(2.5, rel=0.02)
    assert np.argmax(found.chi2) == 4
    assert np.isfinite(found.chi2).all()


def test_too_few_or_in_one_place_is_nothing():
    rng = np.random.default_rng(6)
    centre = rng.normal(0, 10, (MIN_POSITIONS, 3))
    unit = np.tile(np.eye(3), (MIN_POSITIONS, 1, 1))
    assert align_positions(centre, centre, unit) is not None
    assert align_positions(centre[:-1], centre[:-1], unit[:-1]) is None
    assert align_positions(np.zeros_like(centre), centre, unit) is None
    assert align_positions(centre, np.zeros_like(centre), unit) is None
    assert align_positions(centre, centre, np.zeros_like(unit)) is None


def test_one_camera_far_from_its_prior_disagrees(model, auditor):
    priors = priors_to(model, np.random.default_rng(7))
    report = asked(auditor, model, priors)
    assert report.witness is Witness.PRIORS
    assert not any(disagrees(said, SETTINGS) for said in report.testimonies)
    assert [f.code for f in report.findings] == [FindingCode.PRIORS_SCALE]
    position = priors.position.copy()
    position[6] += 2.0
    report = asked(auditor, model, replace(priors, position=position))
    assert [i for i, said in enumerate(report.testimonies) if disagrees(said, SETTINGS)] == [6]
    assert report.testimonies[6].limit == MAX_PRIOR_CHI2
    assert report.testimonies[6].q == report.columns["prior_q"][6] < 1e-6
    assert report.columns["prior_distance"][6] == pytest.approx(np.sqrt(12), abs=0.4)


def test_covariances_that_are_too_small_are_a_finding_and_no_disagreement(model, auditor):
    priors = priors_to(model, np.random.default_rng(8))
    report = asked(auditor, model, replace(priors, covariance=priors.covariance / 100))
    assert not any(disagrees(said, SETTINGS) for said in report.testimonies)
    spread = next(f for f in report.findings if f.code == FindingCode.PRIORS_SPREAD)
    assert "times as widely" in spread.text
    large = asked(auditor, model, replace(priors, covariance=priors.covariance * 100))
    assert FindingCode.PRIORS_SPREAD not in [f.code for f in large.findings]
    assert large.columns["prior_chi2"].max() < 1  # what a careful sensor says is believed
    assert MAX_PRIOR_SPREAD > 1


def test_without_covariances_the_scatter_decides(model, auditor):
    priors = priors_to(model, np.random.default_rng(9))
    position = priors.position.copy()
    position[6] += 3.0
    nothing = np.full_like(priors.covariance, np.nan)
    report = asked(auditor, model, replace(priors, position=position, covariance=nothing))
    assert [i for i, said in enumerate(report.testimonies) if disagrees(said, SETTINGS)] == [6]
    assert FindingCode.PRIORS_SPREAD not in [f.code for f in report.findings]


def test_a_sensor_that_wanders_is_drift(model, auditor):
    priors = priors_to(model, np.random.default_rng(10))
    bow = 0.3 * np.sin(np.linspace(0, 3 * np.pi, len(model.images)))[:, None] * [1.0, 1.0, 0.0]
    report = asked(auditor, model, replace(priors, position=priors.position + bow))
    assert FindingCode.PRIORS_DRIFT in [f.code for f in report.findings]


def test_what_cannot_be_asked_is_said(model, auditor):
    assert asked(auditor, model, None) is None
    assert asked(auditor, model, NotAsked("none")).findings[0].code == FindingCode.PRIORS_NOT_USED
    priors = priors_to(model, np.random.default_rng(11))
    position = priors.position.copy()
    position[5:] = np.nan
    report = asked(auditor, model, replace(priors, position=position))
    assert "5 images have a prior" in report.findings[0].text
    assert np.isnan(report.columns["prior_chi2"]).all()
    copied = replace(priors, position=poses_of(model).centre, covariance=np.full_like(priors.covariance, np.nan))
    assert [f.code for f in asked(auditor, model, copied).findings] == [FindingCode.PRIORS_NOT_USED]


def test_columns_and_verdict(model):
    priors = priors_to(model, np.random.default_rng(12))
    position = priors.position.copy()
    position[6] += 2.0
    given = Given(priors=replace(priors, position=position))
    row = ModelAuditor(model, AuditConfig(priors="auto"), given=given).tables().images.to_pylist()[6]
    assert row["verdict_outside"] == "undetermined"
    assert any(each.startswith("priors_disagree: its centre is ") for each in row["reasons"])
    assert row["prior_chi2"] > MAX_PRIOR_CHI2


@pytest.mark.parametrize("said", [True, False])
def test_priors_of_other_images_are_no_pass(model, auditor, said):
    """Names that were mixed up: the scatter takes everything, and everything would agree."""
    rng = np.random.default_rng(8)
    priors = priors_to(model, rng)
    order = rng.permutation(len(model.images))
    covariance = priors.covariance if said else np.full_like(priors.covariance, np.nan)
    report = asked(auditor, model, replace(priors, position=priors.position[order], covariance=covariance))
    assert report.witness is None
    assert [finding.code for finding in report.findings] == [FindingCode.PRIORS_NOT_USED]
    assert "its columns, unit or names differ" in report.findings[0].text


@pytest.mark.parametrize(("size", "used"), [(0.05, True), (1e3, False)])
def test_a_sensor_that_would_let_everything_pass_is_not_asked(model, auditor, size, used):
    priors = priors_to(model, np.random.default_rng(9))
    covariance = np.tile(size**2 * np.eye(3), (len(model.images), 1, 1))
    report = asked(auditor, model, replace(priors, covariance=covariance))
    assert (report.witness is Witness.PRIORS) == used


def test_mixed_up_priors_of_a_street_are_no_pass_whoever_is_left_out_of_the_fit():
    """On a line some directions fit whatever the order is, and the fit may leave half of the positions out."""
    for seed in range(10):
        rng = np.random.default_rng(seed)
        centre = np.c_[np.arange(40.0), 0.05 * rng.normal(size=(40, 2))]
        position = positions(centre, np.tile(1e-4 * np.eye(3), (40, 1, 1)), rng)
        mixed = position[rng.permutation(40)]
        for size in (1e-4, np.nan):
            covariance = np.tile(size * np.eye(3), (40, 1, 1))
            assert _judged(centre, position, covariance).reach > 1e3
            found = _judged(centre, mixed, covariance)
            assert found is None or found.reach < MAX_PRIOR_CHI2
