"""The board is the paper's: its corners are where OpenCV projects them, its noise has the size that was asked for."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy import stats
from scipy.spatial.transform import Rotation

from sfm_audit.audit.simulate.board import BoardSpec, board_sets
from sfm_audit.audit.simulate.lidar_scan import LidarSpec, scan

SPEC = BoardSpec()


@pytest.fixture(scope="module")
def boards():
    return board_sets(SPEC, 0, rendered=False)


def seen(board, xyz_world):
    xyz_cam = xyz_world @ board.rotation_cam_from_world.T + board.translation_cam_from_world
    return board.true_camera.project(xyz_cam).xy_px.T


def test_true_corners_are_where_opencv_projects_them(boards):
    matrix = np.array([[800.0, 0.0, 799.5], [0.0, 800.0, 799.5], [0.0, 0.0, 1.0]])
    for board in boards[::11]:
        turn, _ = cv2.Rodrigues(board.rotation_cam_from_world)
        xy, _ = cv2.projectPoints(
            board.true_xyz_world,
            turn,
            board.translation_cam_from_world,
            matrix,
            np.array([-0.0684, 0.0100, 0.0, 0.0, 0.0006]),
        )
        assert_allclose(board.true_xy_px, xy[:, 0] + 0.5, atol=1e-9)


def test_56_boards_of_225_corners_come_closer_and_stay_inside(boards):
    assert len(boards) == 56
    assert {board.correspondences.num for board in boards} == {225}
    asked = np.linspace(0.12, 0.97, 56)
    extents = np.array([board.extent for board in boards])
    assert_allclose(extents[:30], asked[:30])
    assert np.all(extents <= asked + 1e-12)
    assert extents[-10:].min() > 0.7
    for board in boards:
        assert board.true_xy_px.min() >= 8.0
        assert board.true_xy_px.max() <= 1592.0
    coverage = [board.coverage for board in boards]
    assert coverage[0] < 0.02
    assert max(coverage) > 0.6
    assert stats.spearmanr(coverage, np.arange(56)).statistic > 0.97


def test_coverage_is_the_area_of_the_corners_hull(boards):
    for board in boards[::20]:
        hull = cv2.convexHull(board.correspondences.xy_px.astype(np.float32))
        assert board.coverage == pytest.approx(cv2.contourArea(hull) / 1600**2, rel=1e-5)


def test_rotations_are_uniform_within_15_degrees():
    spec = dataclasses.replace(SPEC, num_corners=2, num_sets=400)
    rotations = [board.rotation_cam_from_world for board in board_sets(spec, 1, rendered=False)]
    angles_deg = Rotation.from_matrix(np.array(rotations)).as_euler("xyz", degrees=True)
    assert stats.kstest(angles_deg.ravel(), stats.uniform(-15.0, 30.0).cdf).pvalue > 0.001


def test_corners_have_the_detectors_noise(boards):
    errors_px = np.concatenate([board.correspondences.xy_px - board.true_xy_px for board in boards])
    assert errors_px.std() == pytest.approx(0.03, rel=0.02)
    assert stats.kstest(errors_px.ravel() / 0.03, "norm").pvalue > 0.001


def test_standardised_by_the_papers_model_residuals_of_the_true_camera_are_normal():
    """method.md (1), a from the neighbours and the true sigma_l of one step: about 5 % are rejected."""
    p_values, squares = [], []
    for seed in range(4):
        for board in board_sets(SPEC, seed, rendered=False):
            given = board.correspondences
            at = seen(board, given.xyz_world)
            steps = [given.pan_xyz_world, given.tilt_xyz_world]
            a = np.column_stack([np.linalg.norm(seen(board, xyz) - at, axis=1) for xyz in steps])
            z = (given.xy_px - at) / np.sqrt(0.03**2 + a**2)
            p_values.append(stats.kstest(z.ravel(), "norm").pvalue)
            squares.append((z**2).mean(axis=0))
    assert np.mean(np.array(p_values) < 0.05) < 0.1
    assert_allclose(np.mean(squares, axis=0), [0.97, 1.0], atol=0.04)


def test_a_scan_errs_by_its_steps_and_not_in_range():
    rng = np.random.default_rng(3)
    xyz = np.tile([0.3, -0.2, 4.0], (20000, 1))
    scanned = scan(xyz, LidarSpec(2e-4, 2e-5, 1.5), rng)
    assert_allclose(np.linalg.norm(scanned.xyz, axis=1), np.linalg.norm(xyz, axis=1), rtol=1e-12)
    pan = np.arctan2(scanned.xyz[:, 0], scanned.xyz[:, 2]) - np.arctan2(0.3, 4.0)
    tilt = np.arcsin(scanned.xyz[:, 1] / np.linalg.norm(xyz[0])) - np.arcsin(-0.2 / np.linalg.norm(xyz[0]))
    assert_allclose([pan.std(), tilt.std()], [3e-4, 3e-5], rtol=0.02)
    assert abs(np.corrcoef(pan, tilt)[0, 1]) < 0.03


def test_neighbours_lie_one_step_further():
    rng = np.random.default_rng(4)
    xyz = rng.uniform([-2, -1, 1], [2, 1, 6], (50, 3))
    scanned = scan(xyz, LidarSpec(1e-3, 2e-3, 0.5), rng)
    turned = Rotation.from_rotvec([0.0, 1e-3, 0.0]).apply(scanned.xyz)  # pan is about the vertical
    assert_allclose(scanned.pan_xyz, turned, atol=1e-12)
    cosine = (scanned.xyz * scanned.tilt_xyz).sum(axis=1) / (xyz**2).sum(axis=1)
    assert_allclose(np.arccos(cosine), 2e-3, rtol=1e-6)
    assert np.all(scanned.tilt_xyz[:, 1] > scanned.xyz[:, 1])  # down, as y


def test_in_the_middle_of_the_image_a_step_is_003_px_across_and_a_tenth_of_that_down():
    scanned = scan(np.array([[0.0, 0.0, 3.0]]), SPEC.lidar, np.random.default_rng(0))
    at, pan, tilt = (SPEC.camera.project(xyz).xy_px[:, 0] for xyz in (scanned.xyz, scanned.pan_xyz, scanned.tilt_xyz))
    assert_allclose(pan - at, [0.03, 0.0], atol=1e-6)
    assert_allclose(tilt - at, [0.0, 0.003], atol=1e-6)


def test_the_same_seed_gives_the_same_boards_whatever_is_rendered(boards):
    spec = dataclasses.replace(SPEC, num_sets=2)
    plain, rendered = (board_sets(spec, 5, rendered=flag) for flag in (False, True))
    for one, other in zip(plain, rendered, strict=True):
        assert_array_equal(one.true_xy_px, other.true_xy_px)
        assert_array_equal(one.correspondences.xyz_world, other.correspondences.xyz_world)
        assert np.all(one.correspondences.xy_px != other.correspondences.xy_px)
    again = board_sets(SPEC, 0, rendered=False)
    assert all(
        np.array_equal(a.correspondences.xy_px, b.correspondences.xy_px) for a, b in zip(boards, again, strict=True)
    )
    assert not np.array_equal(plain[0].true_xy_px, boards[0].true_xy_px)


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        ({"num_corners": 1}, "need 2 corners"),
        ({"num_sets": 0}, "1 set"),
        ({"min_extent": 0.0}, "extents"),
        ({"min_extent": 0.98}, "extents"),
    ],
)
def test_impossible_specs_are_refused(bad, words):
    with pytest.raises(ValueError, match=words):
        dataclasses.replace(SPEC, **bad)


def test_impossible_boards_and_scanners_are_refused():
    with pytest.raises(ValueError, match="does not fit into 16 x 16 px"):
        board_sets(dataclasses.replace(SPEC, width=16, height=16, num_sets=1), 0, rendered=False)
    with pytest.raises(ValueError, match="steps must be positive"):
        LidarSpec(0.0, 1e-3, 1.0)
