"""Whose fault: what leaks into neighbours is peeled off, and where everybody is wrong nobody is."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from sfm_audit.audit import AuditConfig, ModelAuditor, audit_model
from sfm_audit.audit.misfit import GROUPS, MisfitGroup, MisfitStatus, MisfitTest
from sfm_audit.audit.misfit.basis import nuisance_basis, nuisance_transform, unit_columns
from sfm_audit.audit.misfit.outcome import not_tested
from sfm_audit.audit.misfit.peeling import Peeling
from sfm_audit.audit.simulate.adjust import adjust_scene, sparse_model
from sfm_audit.audit.simulate.defects import DefectKind, DefectSpec
from sfm_audit.audit.simulate.noise import NoiseKind, NoiseSpec
from sfm_audit.audit.simulate.scene import SceneSpec, simulate_scene

WRONG = (1, 5, 8, 13)


def model_of(defects=(), **spec):
    scene = simulate_scene(
        SceneSpec(
            num_images=20, points_per_image=300, noise=NoiseSpec(NoiseKind.GAUSSIAN, 0.5), defects=defects, **spec
        ),
        np.random.default_rng(11),
    )
    return sparse_model(scene, adjust_scene(scene)), scene


@pytest.fixture(scope="module")
def quarter():
    kinds = (DefectKind.RADIAL_K2, DefectKind.TANGENTIAL, DefectKind.ASPECT, DefectKind.ROLLING_SHUTTER)
    return model_of(tuple(DefectSpec(i, kind, 0.8) for i, kind in zip(WRONG, kinds, strict=True)))


def test_defective_images_are_found_and_their_neighbours_are_not_blamed(quarter):
    model, _ = quarter
    auditor = ModelAuditor(model)
    blame = auditor.blame
    leaked = np.delete(blame.significance.effect_px(0.05), WRONG) > 0
    assert leaked.mean() > 0.2  # significant as the model stands: what peeling is for
    images = auditor.tables().images.to_pandas()
    assert set(np.flatnonzero(images.verdict_misfit == "rejected")) == set(WRONG)
    assert set(np.flatnonzero(blame.flagged)) >= set(WRONG)
    assert list(images.misfit_group[list(WRONG)]) == ["radial", "tangential", "affine", "rolling_shutter"]
    assert images.reasons[5][0].startswith("misfit_tangential: 0.")


def test_testing_suspects_ends_where_testing_all_images_in_every_round_ends(monkeypatch):
    sizes = zip(WRONG, (1.6, 0.7, 0.3, 0.3), strict=True)
    model, _ = model_of(tuple(DefectSpec(i, DefectKind.RADIAL_K2, px) for i, px in sizes))
    few, num_tests = ModelAuditor(model).blame, []
    one_test, some = Peeling._test, Peeling._test_some
    monkeypatch.setattr(Peeling, "_test", lambda *args: num_tests.append(args[1]) or one_test(*args))
    again = ModelAuditor(model).blame
    num_few = len(num_tests)
    monkeypatch.setattr(Peeling, "_test_some", lambda self, state, _: some(self, state, np.ones_like(state.flagged)))
    every = ModelAuditor(model).blame
    assert num_few < 0.8 * (len(num_tests) - num_few)
    assert (few.flagged == every.flagged).all()
    for one, other in ((few, again), (few, every)):
        assert_allclose(one.final.q, other.final.q, rtol=1e-12)
        assert_allclose(one.final.px, other.final.px, rtol=1e-12)
        assert (one.residuals_px == other.residuals_px).all()


class Masked(Peeling):
    """Image 7 looks sound until image 3 is out; all others always do. Every point moves."""

    def _without(self, flagged):
        self.out = set(np.flatnonzero(flagged).tolist())
        everything = np.ones(self._residuals.point_idx.size, dtype=bool)
        return self._residuals.residuals_px, np.ones(len(self._model.points), dtype=bool), everything

    def _test(self, image_idx, _residuals_px, _clean):
        return radial(0.5) if image_idx == 3 or (image_idx == 7 and 3 in self.out) else radial(0.0)


def radial(px):
    untested = dict.fromkeys(GROUPS, not_tested(MisfitStatus.ABSORBED, 0))
    return untested | {MisfitGroup.RADIAL: MisfitTest(1e-12 if px else 0.5, px, 2, MisfitStatus.TESTED)}


def test_an_image_that_was_never_suspected_is_taken_out_when_it_shows_at_last():
    auditor = ModelAuditor(model_of()[0])
    peeling = Masked(auditor.model, auditor.residuals, np.zeros(20, dtype=bool), alpha=0.05, tau_px=auditor.tau_px)
    blame = peeling.run([radial(0.5 if i == 3 else 0.0) for i in range(20)])
    assert set(np.flatnonzero(blame.flagged)) == {3, 7}


def test_what_peeling_leaves_unflagged_is_tested_against_the_final_points(quarter):
    auditor = ModelAuditor(quarter[0])
    blame = auditor.blame
    peeling = Peeling(auditor.model, auditor.residuals, np.zeros(20, dtype=bool), alpha=0.05, tau_px=auditor.tau_px)
    for i in range(20):
        assert peeling._test(i, blame.residuals_px, blame.clean) == blame.final_tests[i]
    assert (blame.final.effect_px(0.05)[~blame.flagged] <= 0.05).all()


@pytest.mark.parametrize("shift", [1.0, 1e-3, 1e-7, 0.0])
def test_transform_gives_the_nuisance_basis_also_of_nearly_and_of_fully_dependent_columns(shift):
    """The same span as NumPy's and orthonormal; a column of zeros adds nothing."""
    rng = np.random.default_rng(3)
    columns = rng.normal(size=(5, 80)) * np.geomspace(1e-3, 1e4, 5)[:, None]
    columns[2] = 0.0
    columns[4] = 7.0 * columns[1] + shift * rng.normal(size=80)
    basis = nuisance_transform(columns) @ columns
    expected = nuisance_basis(unit_columns(columns))
    assert basis.shape == expected.shape == (np.linalg.matrix_rank(unit_columns(columns), tol=1e-9), 80)
    assert_allclose(basis @ basis.T, np.eye(len(basis)), atol=1e-5 if shift == 1e-7 else 1e-9)
    assert_allclose(np.abs(np.linalg.svd(basis @ expected.T, compute_uv=False)), 1.0, atol=1e-5)


def test_peeling_recovers_the_size_of_the_effect(quarter):
    model, scene = quarter
    images = audit_model(model).images.to_pandas()
    before = images[[f"misfit_{g}_px" for g in ("radial", "tangential", "affine", "rolling_shutter")]].to_numpy()
    truth = {d.image_idx: d.systematic_px for d in scene.defects}
    for k, i in enumerate(WRONG):
        assert before[i, k] < 0.85 * truth[i]  # the points absorbed a part of it
        assert images.misfit_px[i] == pytest.approx(truth[i], rel=0.15)


def test_advice_holds_the_defect(quarter):
    images = audit_model(quarter[0]).images.to_pandas()
    assert list(images.advised_camera_model[list(WRONG)]) == ["RADIAL", "OPENCV", "OPENCV", "none: rolling shutter"]


def test_without_defects_nobody_is_flagged():
    model, _ = model_of()
    auditor = ModelAuditor(model)
    assert not auditor.blame.flagged.any()
    assert not auditor.blame.most_are_wrong
    images = auditor.tables().images.to_pandas()
    assert (images.verdict_misfit == "accepted").all()
    assert (images.verdict_pose == "accepted").all()
    assert (images.plausible == "accepted").all()
    assert images.misfit_group.isna().all() or images.misfit_px.max() < 0.2


def test_where_all_share_one_wrong_camera_the_camera_is_blamed():
    """One lens, missing k2: nobody is peeled, the pooled test speaks, and the images say whose fault it is."""
    defects = tuple(DefectSpec(i, DefectKind.RADIAL_K2, values=(0.05,)) for i in range(20))
    model, _ = model_of(defects, shared_camera=True)
    auditor = ModelAuditor(model)
    assert auditor.blame.most_are_wrong
    assert not auditor.blame.flagged.any()
    result = auditor.tables()
    camera = result.cameras.to_pylist()[0]
    assert camera["misfit_group"] == "radial"
    assert camera["misfit_radial_p"] < 1e-50
    assert camera["advised_camera_model"] in {"RADIAL", "OPENCV", "FULL_OPENCV"}
    assert camera["num_images"] == 20
    rejected = [row for row in result.images.to_pylist() if row["verdict_misfit"] == "rejected"]
    assert len(rejected) > 10
    assert all(row["reasons"][0].startswith("shared_camera: camera 1, 20 images: radial") for row in rejected)


def test_a_sound_shared_camera_is_sound():
    model, _ = model_of(shared_camera=True)
    camera = audit_model(model).cameras.to_pylist()[0]
    assert all(camera[f"misfit_{group}_p"] > 1e-3 for group in ("radial", "tangential", "affine", "rolling_shutter"))
    assert camera["advised_camera_model"] is None


def test_independent_points_have_nobody_to_blame(quarter):
    model, _ = quarter
    auditor = ModelAuditor(model, AuditConfig(points="independent", noise="constant"))
    assert not auditor.blame.flagged.any()
    assert auditor.blame.final is auditor.blame.significance


def test_materiality_can_be_asked_in_pixels_or_in_sigma(quarter):
    model, _ = quarter
    rejected = {
        effect: int(
            (audit_model(model, AuditConfig(min_effect=effect)).images.to_pandas().verdict_misfit == "rejected").sum()
        )
        for effect in ("0.2px", "5px", "0.4sigma", "10sigma")
    }
    assert rejected == {"0.2px": 4, "5px": 0, "0.4sigma": 4, "10sigma": 0}


@pytest.mark.parametrize(("policy", "expected"), [("paper", "verdict_ks"), ("camera", "verdict_misfit")])
def test_policies_take_their_members(quarter, policy, expected):
    images = audit_model(quarter[0], AuditConfig(policy=policy)).images.to_pandas()
    assert (images.verdict == images[expected]).all()
