"""Shared points, parts, bridges and articulation images; by brute force on small graphs, and on models."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from model_writer import Camera, Image, Model, Point, write_binary

from sfm_audit.audit.engine.model import ModelAuditor
from sfm_audit.audit.kernels import numpy_only
from sfm_audit.audit.witnesses import covisibility as covisibility_of
from sfm_audit.audit.witnesses.connectivity import ask_connectivity
from sfm_audit.audit.witnesses.covisibility import Covisibility, cuts_of
from sfm_audit.audit.witnesses.evidence import Evidence
from sfm_audit.loaders import open_model

EDGES = st.sets(st.tuples(st.integers(0, 7), st.integers(0, 7)).filter(lambda e: e[0] < e[1]), max_size=14)


def graph_of(edges, num=8, shared=20):
    ends = np.array(sorted(edges), dtype=np.int64).reshape(-1, 2)
    return Covisibility(ends[:, 0], ends[:, 1], np.full(len(ends), shared), num)


def parts_of(edges, nodes):
    label = {i: i for i in nodes}
    for _ in nodes:
        for a, b in edges:
            if a in label and b in label:
                label[a] = label[b] = min(label[a], label[b])
    return len(set(label.values()))


@given(EDGES)
def test_bridges_and_articulation_are_what_taking_one_away_shows(edges):
    cuts, nodes = cuts_of(graph_of(edges)), set(range(8))
    bridges = {tuple(edge) for edge in cuts.bridges.tolist()}
    assert bridges == {edge for edge in edges if parts_of(edges - {edge}, nodes) > parts_of(edges, nodes)}
    wanted = [parts_of(edges, nodes - {i}) > parts_of(edges, nodes) for i in range(8)]
    assert cuts.articulation.tolist() == wanted


@given(EDGES)
def test_parts_are_numbered_by_size(edges):
    parts = graph_of(edges).components()
    sizes = np.bincount(parts)
    assert len(sizes) == parts_of(edges, set(range(8)))
    assert (np.diff(sizes) <= 0).all()
    assert all(parts[a] == parts[b] for a, b in edges)


def test_a_long_chain_is_no_matter_of_recursion():
    cuts = cuts_of(graph_of({(i, i + 1) for i in range(4999)}, 5000))
    assert len(cuts.bridges) == 4999
    assert cuts.articulation.sum() == 4998


def chain(tmp_path, shared):
    """Images in a row; image i and i + 1 share shared[i] points, nobody else any."""
    num = len(shared) + 1
    tracks, points2d = [], [[] for _ in range(num)]
    for i, count in enumerate(shared):
        for _ in range(count):
            tracks.append((i, i + 1))
            for k in (i, i + 1):
                points2d[k].append((100.0 + len(tracks), 90.0, len(tracks)))
    images = tuple(Image(i + 1, f"{i}.jpg", tuple(points2d[i]), (1.0, 0, 0, 0, 0.1 * i, 0, 0)) for i in range(num))
    points = tuple(
        Point(k + 1, tuple((i + 1, next(n for n, p in enumerate(points2d[i]) if p[2] == k + 1)) for i in pair))
        for k, pair in enumerate(tracks)
    )
    return open_model(write_binary(tmp_path / "m", Model((Camera(),), images, points)))


def asked(model):
    auditor = ModelAuditor(model)
    return ask_connectivity(Evidence(model, auditor.residuals, auditor.sigma_constant_px))


def test_a_model_in_two_parts_that_hang_by_single_images(tmp_path):
    report = asked(chain(tmp_path, [40, 29, 14, 15]))
    columns = {name: values.tolist() for name, values in report.columns.items()}
    assert columns["num_neighbours"] == [1, 2, 1, 1, 1]
    assert columns["num_shared_strongest"] == [40, 40, 29, 15, 15]
    assert columns["covisible_part"] == [0, 0, 0, 1, 1]
    assert columns["is_articulation"] == [False, True, False, False, False]
    texts = {finding.code.value: finding.text for finding in report.findings}
    assert texts["disconnected"].startswith("2 parts of 3, 2 images that share fewer than 15 points")
    assert "nothing holds 3.jpg, 4.jpg where" in texts["disconnected"]
    weak = texts["weakly_connected"]
    assert "2 more parts at 30 shared points (2.jpg, 4.jpg)" in weak
    assert "3 pairs without which it falls apart (0.jpg - 1.jpg, 1.jpg - 2.jpg, 3.jpg - 4.jpg)" in weak
    assert "1 images without which it falls apart (1.jpg)" in weak


def test_a_point_seen_twice_in_an_image_counts_once(tmp_path):
    points2d = tuple((10.0 * k, 20.0, 1 + k % 7) for k in range(14))
    images = tuple(Image(i, f"{i}.jpg", points2d) for i in (1, 2))
    points = tuple(Point(k + 1, ((1, k), (1, k + 7), (2, k), (2, k + 7))) for k in range(7))
    report = asked(open_model(write_binary(tmp_path / "m", Model((Camera(),), images, points))))
    assert report.columns["num_shared_strongest"].tolist() == [7, 7]


@pytest.mark.parametrize("frames", [None, [0, 0, 1, 1, 2]])
def test_images_of_one_frame_hang_together(tmp_path, frames):
    model = chain(tmp_path, [0, 40, 40, 40])
    poses = np.tile([1.0, 0, 0, 0, 0, 0, 0], (5, 1))
    placed = replace(model.images, frame_idx=np.array(frames) if frames else None, pose_cam_from_rig=poses)
    report = asked(replace(model, images=placed))
    assert ("disconnected" in {finding.code for finding in report.findings}) is (frames is None)


def test_a_model_without_images(tmp_path):
    report = asked(open_model(write_binary(tmp_path / "m", Model((Camera(),), (), ()))))
    assert report.findings == ()


@pytest.mark.parametrize("max_pairs", [1, 1 << 20])
@pytest.mark.parametrize("max_images", [0, 1500])
def test_shared_points_are_counted_in_full_and_by_a_product(monkeypatch, max_images, max_pairs):
    monkeypatch.setattr(covisibility_of, "_MAX_IMAGES_IN_FULL", max_images)
    monkeypatch.setattr(covisibility_of, "_MAX_PAIRS", max_pairs)
    rng = np.random.default_rng(3)
    sees = rng.random((12, 70)) < rng.uniform(0.0, 1.0, 70)
    sees[4] = False
    image, point = np.nonzero(np.concatenate([sees, sees[:, :9]], axis=1))  # points 0 .. 8 are seen twice by an image
    offsets = np.concatenate([[0], np.cumsum(np.bincount(image, minlength=12))])
    with numpy_only():
        seen, pairs = covisibility_of.covisibility(SimpleNamespace(offsets=offsets, point_idx=point % 70), 70)
    assert [seen.image_idx[slice(*seen.offsets[p : p + 2])].tolist() for p in range(70)] == [
        np.flatnonzero(sees[:, p]).tolist() for p in range(70)
    ]
    shared = np.zeros((12, 12), dtype=np.int64)
    shared[pairs.first, pairs.second] = pairs.num_shared
    number = sees.astype(np.int64)
    np.testing.assert_array_equal(shared, np.triu(number @ number.T, 1))
    assert (pairs.num_shared > 0).all()
    assert pairs.num_images == 12
