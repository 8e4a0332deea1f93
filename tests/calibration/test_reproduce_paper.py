"""The reproduction of the paper: do its words follow from the numbers, and its numbers from the seed?"""

import math
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose
from scipy import stats

from scripts.paper import claims
from scripts.paper.board_study import POINTS, RENDERED, RIGHT, WRONG, BoardDesign, board_rows, protection_rows
from scripts.paper.claims import Word, judge_claims, misfit_checks, of_model, upper_thirds, word_of
from scripts.paper.figures import density_of, draw_figures
from scripts.paper.megadepth import EDGES, histogram_columns, megadepth_folder, megadepth_images, model_locations
from scripts.paper.motivating import SIGMAS, SIZES, motivating_trials, sample, scale_of
from scripts.paper.page import document
from scripts.paper.rates import THIRDS, olsson_accepts, rejects, thirds_of
from scripts.paper.tables import room_rows, zhang_rows
from scripts.validation.scenes import Design, simulate
from scripts.validation.study import HOLDS, VIOLATED, Task, run_tasks
from sfm_audit.audit.simulate.board import BoardSpec
from sfm_audit.audit.simulate.colmap_files import write_colmap_binary
from sfm_audit.audit.simulate.noise import NoiseKind
from sfm_audit.audit.simulate.scene import SceneSpec

FEW = BoardDesign(POINTS, BoardSpec(num_sets=9))
RENDERED_FEW = BoardDesign(RENDERED, BoardSpec(num_sets=3))
YES, NO, NOBODY_KNOWS = Word.REPRODUCED, Word.NOT_REPRODUCED, Word.CANNOT


def words(tables, source=POINTS):
    return {claim.number: claim.word for claim in judge_claims(tables, source)}


@pytest.fixture(scope="module")
def boards():
    return pd.concat([board_rows(FEW, seed) for seed in (1, 2)], ignore_index=True)


@pytest.fixture(scope="module")
def megadepth_tree(tmp_path_factory):
    """A simulated scene in MegaDepth's layout, with noise that differs from track to track."""
    corpus = tmp_path_factory.mktemp("corpus")
    location = corpus / "megadepth_like" / "MegaDepth_v1_SfM" / "0001" / "sparse" / "manhattan" / "0"
    _, model, _ = simulate(Design("none", 2, NoiseKind.PER_TRACK_LOGNORMAL, 150, scene=SceneSpec(num_images=10)), 0, 1)
    write_colmap_binary(model, location, np.random.default_rng(0))
    return corpus


@pytest.mark.parametrize(
    ("holds", "word"),
    [
        (claims.rises_to_most(0.01, 0.76, 1.0), YES),
        (claims.rises_to_most(0.0, 0.3, 0.1), NO),
        (claims.rises_to_most(0.01, 0.2, 0.4), NO),
        (claims.rises_to_most(1.0, 1.0, 1.0), NO),
        (claims.rises_to_most(math.nan, 0.2, 1.0), NOBODY_KNOWS),
        (claims.within_level(20, 448), YES),
        (claims.within_level(50, 448), NO),
        (claims.within_level(0, 0), NOBODY_KNOWS),
        (claims.too_strict(30, 448), NO),
        (claims.too_strict(90, 448), YES),
        (claims.too_permissive(0.95, 0.9), NO),
        (claims.too_permissive(0.6, 0.9), YES),
        (claims.too_permissive(0.3, 0.0), YES),
        (claims.follows((0.99, 1.0, 1.04)), YES),
        (claims.follows((0.99, 1.0, 0.87)), NO),
        (claims.low_sd_proves_nothing(pd.Series([0.1, 0.5, 2.0])), YES),
        (claims.low_sd_proves_nothing(pd.Series([1.1, 0.5, 2.0])), NO),
        (claims.low_sd_proves_nothing(pd.Series(dtype=float)), NOBODY_KNOWS),
        (claims.only_third_plausible(0.9, 0.1), YES),
        (claims.only_third_plausible(0.1, 0.1), NO),
        (claims.only_third_plausible(0.9, 0.9), NO),
        (claims.shows_tails(0.05, 0.01), YES),
        (claims.shows_tails(0.015, 0.01), NO),
        (claims.finds_more(0.7, 0.6), YES),
        (claims.finds_more(0.6, 0.6), NO),
        (claims.mostly(0.7), YES),
        (claims.mostly(0.1), NO),
        (claims.mostly(math.nan), NOBODY_KNOWS),
    ],
)
def test_words_follow_from_numbers(holds, word):
    assert word_of(holds) is word


def test_without_numbers_nothing_can_be_tested():
    assert set(words({}).values()) == {NOBODY_KNOWS}


def test_the_words_change_with_the_simulated_lens(boards):
    """With k2 = k3 = 0 the camera D(1,0) is right, and what exposed it has nothing to say."""
    sound = pd.concat([board_rows(FEW.with_truth(-0.0684, 0.0, 0.0), seed) for seed in (1, 2)], ignore_index=True)
    before, after = words({"boards": boards}), words({"boards": sound})
    assert (before["1c"], after["1c"]) == (YES, NO)
    assert (before["4"], after["4"]) == (NO, YES)
    assert (before["6"], after["6"]) == (YES, NOBODY_KNOWS)
    found, alarms = (rejects(upper_thirds(of_model(b, WRONG)), "verdict_misfit").mean() for b in (boards, sound))
    assert found >= 0.9
    assert alarms <= 0.1
    assert rejects(of_model(boards, RIGHT), "verdict_misfit").mean() <= 0.12
    assert not any(check.outcome == VIOLATED for check in misfit_checks(boards))
    assert any(check.outcome == VIOLATED for check in misfit_checks(sound))


def test_the_words_change_with_the_noise_of_the_motivating_example():
    wrong = motivating_trials(225, 0.05, 15, 1)
    other = motivating_trials(225, 0.05, 15, 1, wrong=0.01)
    assert words({"motivating": wrong})["8"] is YES
    assert words({"motivating": other})["8"] is NO
    assert words({"motivating": wrong})["8b"] is NO


def test_the_words_change_with_the_images_of_megadepth():
    """Invented p-values: rejections that stay when tracks differ mean something else than those that vanish."""
    frame = pd.DataFrame({"ks_constant_p": [0.001] * 7 + [0.5] * 3, "verdict_misfit": "accepted"})
    stay, vanish = frame.assign(ks_p=0.001), frame.assign(ks_p=0.5)
    assert [words({"megadepth": part})[n] for part in (stay, vanish) for n in ("10", "10b")] == [YES, YES, YES, NO]
    assert words({"megadepth": frame.assign(ks_p=0.5, ks_constant_p=0.5)})["10"] is NO


def test_misfit_of_scanned_points_needs_their_noise():
    frame = protection_rows(FEW, 3)
    share = frame[frame["model"] == RIGHT].groupby("points")["significant"].mean()
    assert share["taken as exact"] > 0.3
    assert share["taken as measured"] < 0.25


def test_tests_and_scales_are_scipy_s():
    """SciPy 1.17: kstest, normaltest, shapiro, median_abs_deviation on the same residuals."""
    row = motivating_trials(100, 0.1, 1, 5)
    for wrong, claimed in ((True, 0.5), (False, 0.0)):
        rng = np.random.default_rng([5, 100, 100, 0])
        if not wrong:
            sample(100, 0.1, 0.5, rng)  # both hypotheses draw from one stream
        _, residuals = sample(100, 0.1, claimed, rng)
        both_signs = np.concatenate([residuals, -residuals])  # about 0, not about the median
        assert_allclose(scale_of(residuals, "MAD"), stats.median_abs_deviation(both_signs, scale="normal"), rtol=1e-9)
        z = residuals / np.sqrt((residuals**2).mean())
        own = row[(row["wrong"] == wrong) & (row["scale"] == "plain")].iloc[0]
        p = [stats.kstest(z, "norm").pvalue, stats.normaltest(z).pvalue, stats.shapiro(z).pvalue]
        assert [own[f"{name}_rejects"] for name in ("ks", "dap", "sw")] == [value < 0.05 for value in p]


def test_robust_scale_keeps_to_the_bulk():
    rng = np.random.default_rng(1)
    _, residuals = sample(4000, 0.05, 0.5, rng)
    assert 0.05 < scale_of(residuals, "MAD") < scale_of(residuals, "winsorised") < scale_of(residuals, "plain")
    _, residuals = sample(4000, 0.05, 0.0, rng)
    assert_allclose([scale_of(residuals, name) for name in ("winsorised", "MAD", "plain")], 0.05, rtol=0.05)


def test_thirds_are_numpy_s():
    coverage = pd.Series(np.random.default_rng(2).permutation(56) / 56.0)
    parts = np.array_split(np.sort(coverage), 3)
    for third, part in zip(THIRDS, parts, strict=True):
        assert_allclose(np.sort(coverage[thirds_of(coverage) == third]), part)


def test_olsson_s_rule():
    assert olsson_accepts(np.abs(np.random.default_rng(3).standard_normal(500)))
    assert not olsson_accepts(np.concatenate([np.ones(90), np.full(10, 100.0)]))


def test_stand_ins_have_the_noise_of_m5():
    """The simulated corners have 0.19 and 0.81 px, the paper's M5; only M5 can describe the cameras."""
    for camera, sd_px in (("plain", 0.19), ("wide", 0.81)):
        sd = zhang_rows(camera, 1).set_index("model")["sd"]
        assert_allclose(sd["M5"], sd_px, rtol=0.1)
        assert sd["M1"] > 1.5 * sd["M5"]


def test_megadepth_images(megadepth_tree, monkeypatch):
    monkeypatch.setenv("SFM_AUDIT_CORPUS", str(megadepth_tree))
    (model,) = model_locations(megadepth_folder())
    images = megadepth_images(*model)
    assert model[:2] == ("0001", "0")
    assert len(images) == 10
    counted = images[histogram_columns("constant")].sum(axis=1)
    assert_allclose(counted, 2 * images["num_inliers"])
    assert_allclose(density_of(images, "track").sum() * (EDGES[1] - EDGES[0]), 1.0)
    assert rejects(images, "ks_p").mean() <= 0.3
    monkeypatch.setenv("SFM_AUDIT_CORPUS", str(megadepth_tree / "elsewhere"))
    assert megadepth_folder() is None


def tiny(megadepth_tree):
    tree = megadepth_tree / "megadepth_like" / "MegaDepth_v1_SfM"
    tasks = [Task("boards", board_rows, (design, 1)) for design in (FEW, RENDERED_FEW)]
    tasks += [Task("protection", protection_rows, (BoardDesign(POINTS, BoardSpec(num_sets=3)), 1))]
    tasks += [Task("motivating", motivating_trials, (n, sigma, 1, 1)) for n in SIZES for sigma in SIGMAS]
    tasks += [Task("zhang", zhang_rows, (camera, 1)) for camera in ("plain", "wide")]
    tasks += [Task("rooms", room_rows, (camera, 0, 2, 1)) for camera in ("plain", "wide")]
    return tasks + [Task("megadepth", megadepth_images, model) for model in model_locations(tree)]


def test_the_same_seed_gives_the_same_page_on_two_processes_and_from_kept_pieces(megadepth_tree, tmp_path):
    one = run_tasks(tiny(megadepth_tree), 1, tmp_path / "kept")
    two, kept = run_tasks(tiny(megadepth_tree), 2), run_tasks(tiny(megadepth_tree), 1, tmp_path / "kept")
    pages = [document(tables, misfit_checks(tables["boards"]), 1) for tables in (one, two, kept)]
    assert pages[0] == pages[1] == pages[2]
    assert "nan" not in pages[0]
    assert pages[0].count("\n## ") == 9
    paths = draw_figures(one, tmp_path)
    assert [path.name for path in paths] == [f"paper_{n}.svg" for n in ("motivating", "figure3", "sd", "megadepth")]
    assert all(10_000 < path.stat().st_size < 300_000 for path in paths)
    del one["megadepth"]
    assert "Not run: no corpus" in document(one, misfit_checks(one["boards"]), 1)


def test_a_band_that_a_number_leaves_is_violated(boards):
    worse = boards.assign(verdict_misfit="rejected")
    outcomes = {check.claim: check.outcome for check in misfit_checks(worse)}
    assert outcomes["verdict_misfit rejects D(1,0), upper two thirds"] == HOLDS
    assert outcomes["verdict_misfit rejects D(3,0)"] == VIOLATED


def test_the_page_is_the_script_s():
    page = Path(__file__).resolve().parents[2] / "docs" / "paper.md"
    assert "Made by `scripts/reproduce_paper.py`" in page.read_text(encoding="utf-8")
