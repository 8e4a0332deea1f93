"""Two groups of images at one place that see different points (method.md section 13)."""

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from fold_samples import ring_model, sides
from gate_samples import scene, write_run

from sfm_audit.audit.cli.main import main
from sfm_audit.audit.inliers.residuals import model_residuals
from sfm_audit.audit.kernels import numpy_only
from sfm_audit.audit.witnesses import fold, looks_together
from sfm_audit.audit.witnesses import should_see as looking
from sfm_audit.audit.witnesses.evidence import Evidence
from sfm_audit.audit.witnesses.fold import MIN_SCORE, ask_fold, find_fold
from sfm_audit.audit.witnesses.should_see import ShouldSee, should_see
from sfm_audit.loaders.model import FindingCode, SparseModel


def evidence(model: SparseModel) -> Evidence:
    return Evidence(model, model_residuals(model), np.full(len(model.images), 0.3))


def test_a_fold_has_its_sides_as_groups_and_is_remarked_on():
    report = ask_fold(evidence(ring_model(0.5)))
    groups = np.array(report.columns["fold_group"])
    assert max(np.mean(groups - 1 == sides()), np.mean(2 - groups == sides())) > 0.9
    [finding] = report.findings
    assert finding.code is FindingCode.POSSIBLE_FOLD
    assert finding.text.startswith("two groups of 3")
    assert report.columns["fold_score"][0] > MIN_SCORE
    assert report.witness is None  # a remark: it speaks in no verdict


@pytest.mark.parametrize("detected", [0.4, 0.8])
def test_a_right_model_is_not_remarked_on(detected):
    report = ask_fold(evidence(ring_model(0.0, detected=detected)))
    assert report is None or (report.findings == () and report.columns["fold_score"][0] < MIN_SCORE / 2)


def test_the_score_is_the_share_of_points_of_one_side():
    found = find_fold(should_see(*_given(ring_model(0.6, detected=1.0, num_points=4000))))
    # of the points that either of two images sees: 0.4 + 0.3 within a side, 0.4 of 0.4 + 0.6 across
    assert found.score == pytest.approx(1 - 0.4, abs=0.05)
    assert found.mixed == pytest.approx(1.0, abs=0.15)


def test_who_should_see_a_point_stands_close_to_one_that_does():
    model = ring_model(0.0, detected=1.0)
    seen = should_see(*_given(model))
    pairs = set(zip(seen.point[seen.sees].tolist(), seen.image[seen.sees].tolist(), strict=True))
    views = np.bincount(model.observations.point_idx)
    assert len(pairs) == views[views > 2].sum()
    others = ~seen.sees
    assert 0 < others.sum() < 0.5 * len(pairs)  # one image further at either end
    np.testing.assert_allclose(np.linalg.norm(seen.ray, axis=0), 1.0)


def test_no_point_is_left_out_because_of_who_stands_close(monkeypatch):
    given = _given(ring_model(0.2, num_points=900))
    with numpy_only():
        expected = should_see(*given)
        monkeypatch.setattr(looking, "_ALL", np.inf)  # never ask all points
        found = should_see(*given)
        assert len(found.sees) == len(expected.sees) > 1000
        for name in ("point", "image", "sees", "ray"):
            np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
        monkeypatch.setattr(looking, "_REACH", 0.05)  # where the law of cosines is not kept, some are missing
        assert len(should_see(*given).sees) < len(expected.sees)


NUM_STRIP = 160


def strip(order=None, *, seed: int = 0) -> ShouldSee:
    """A strip of images beside each other; the first fifteen are of two sides, each with points of its own."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(0, NUM_STRIP, 3000)
    point, image = np.nonzero(np.abs(np.arange(NUM_STRIP) - x[:, None]) < 2.5)
    of_side = rng.integers(0, 2, len(x))[point] == rng.integers(0, 2, NUM_STRIP)[image]
    sees = rng.random(len(point)) < np.where(x[point] > 15, 0.8, np.where(of_side, 0.95, 0.2))
    ray = np.stack([(x[point] - image) / 10, np.zeros(len(point)), np.ones(len(point))])
    if order is not None:
        image = np.argsort(order)[image]
        rows = np.lexsort((image, point))
        point, image, sees, ray = point[rows], image[rows], sees[rows], ray[:, rows]
    return ShouldSee(
        len(x), NUM_STRIP, point, image, sees, ray / np.linalg.norm(ray, axis=0), np.full(len(point), 10.0)
    )


@pytest.mark.both_paths
def test_far_from_where_an_eigenvector_lies_no_side_is_made_of_rounding():
    """The first vector of this strip falls off to rounding errors, whose signs depend on the order of the images."""
    expected = find_fold(strip())
    assert 8 <= np.count_nonzero(expected.group) < NUM_STRIP / 2
    assert not expected.group[NUM_STRIP // 2 :].any()
    for seed in range(5):
        order = np.random.default_rng(seed).permutation(NUM_STRIP)
        found = find_fold(strip(order))
        assert found.score == pytest.approx(expected.score, rel=1e-9)
        assert found.mixed == pytest.approx(expected.mixed, rel=1e-9)
        np.testing.assert_array_equal(found.group > 0, expected.group[order] > 0)
        assert {*zip(found.group.tolist(), expected.group[order].tolist(), strict=True)} <= {(0, 0), (1, 1), (2, 2)}


def test_vectors_of_one_eigenvalue_are_not_used():
    vectors = np.linalg.qr(np.random.default_rng(0).normal(size=(20, 4)))[0]
    for values, used in (
        ([4.0, 3.0, 2.0, 1.0], [0, 1, 2]),
        ([4.0, 4.0 - 1e-7, 2.0, 1.0], [2]),
        ([4.0, 3.0, 2.0, 2.0 - 1e-7], [0, 1]),
        ([0.0, 0.0, 0.0, 0.0], []),
        ([4.0, 3.0, -1.0, -2.0], [0, 1, 2]),
    ):
        found = np.array([*fold.sides(np.array(values), vectors)]).reshape(-1, 20)
        np.testing.assert_array_equal(found, np.sign(vectors[:, used].T))


def test_the_first_group_is_the_larger_one_or_that_of_the_first_image():
    first, second = np.nonzero(np.triu(np.ones((12, 12)), 1))
    nothing = np.zeros(len(first))
    pairs = fold.ClosePairs(first, second, nothing + 8, nothing + 10, nothing.astype(np.int64))
    for num, larger in ((5, -1), (6, 1), (7, 1)):
        side = np.where(np.arange(12) < num, 1, -1)
        for sign in (1, -1):
            group = fold.judged(sign * side, pairs).group
            np.testing.assert_array_equal(group, np.where(side == larger, 1, 2))


def test_small_models_are_not_asked():
    assert find_fold(should_see(*_given(ring_model(0.5, num_points=300)))) is None


def _given(model: SparseModel):
    return model, model_residuals(model)


def test_filter_keeps_one_side(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("os.fsync", lambda _: None)
    group = np.ma.masked_equal([1, 1, 2, 0], 0)
    write_run(Path("RUN"), {"a": scene(4, fold_group=group)})
    assert main(["filter", "RUN", "--keep-group", "1", "--list", "kept.txt"]) == 0
    assert Path("kept.txt").read_text().split() == ["IMG_0000.jpg", "IMG_0001.jpg", "IMG_0003.jpg"]
    assert "fold_group: 2" in Path("kept.txt.removed.csv").read_text()
    write_run(Path("NONE"), {"a": scene(4, fold_group=np.ma.masked_all(4, np.int64))})
    capsys.readouterr()
    assert main(["filter", "NONE", "--keep-group", "1", "--list", "none.txt"]) == 2
    assert "holds no fold_group" in capsys.readouterr().err


def test_pairs_one_by_one_and_products_of_full_matrices_are_the_same(monkeypatch):
    rng = np.random.default_rng(0)
    point, image = np.nonzero(rng.random((300, 40)) < rng.uniform(0.0, 0.5, 300)[:, None])
    order = np.lexsort((point, image))
    ray, distance = rng.normal(size=(3, len(point))), rng.uniform(1.0, 2.0, len(point))
    seen = ShouldSee(300, 40, point[order], image[order], rng.random(len(point)) < 0.6, ray, distance)
    num, log_distance = np.bincount(seen.point, minlength=300), np.log(distance)
    monkeypatch.setattr(fold, "_FULL_AT_ONCE", 4000)  # several parts
    expected = fold._sums_in_full(seen, log_distance, num)
    for at_once in (1, 500, 1 << 20):
        monkeypatch.setattr(looks_together, "_AT_ONCE", at_once)
        found = fold.PairSums(*looks_together.sums_of_pairs(seen, log_distance, num))
        for field in fields(expected):
            here, there = getattr(found, field.name), getattr(expected, field.name)
            np.testing.assert_allclose(here, there, rtol=1e-12, atol=1e-12, err_msg=field.name)
