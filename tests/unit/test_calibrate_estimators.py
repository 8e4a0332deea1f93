"""The estimators against OpenCV, pycolmap and SciPy, and the steps they are made of."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from calibrate_samples import DIVISION, FOCAL, FORWARD, LENS, ONE_TERM, TWO_TERMS, board, room, seen, with_outliers
from numpy.testing import assert_allclose
from scipy.linalg import expm
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from sfm_audit.audit.calibrate.absolute_pose import absolute_pose
from sfm_audit.audit.calibrate.consensus import CentredPoints
from sfm_audit.audit.calibrate.eaprd import eaprd
from sfm_audit.audit.calibrate.estimators import ESTIMATORS, estimator
from sfm_audit.audit.calibrate.radial_pose import RadialPoses, complete, minimal_radial_poses, robust_radial_pose
from sfm_audit.audit.calibrate.refine import _cross_matrix, _left_jacobian, _Problem, fit_at, refine

NAMES = sorted(ESTIMATORS)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("make", [lambda lens, rng: board(lens, rng, 12.0, half=0.8, noise_px=0.0), None])
def test_without_noise_the_truth_comes_back(name, make):
    rng = np.random.default_rng(1)
    correspondences, rotation, translation = make(LENS[name], rng) if make else room(LENS[name], rng, noise_px=0.0)
    estimate = ESTIMATORS[name](correspondences, rng)
    assert estimate.name == name
    assert estimate.inliers.all()
    assert_allclose(estimate.camera.focal_px, FOCAL, rtol=1e-5)
    assert_allclose(estimate.camera.coefficients, LENS[name].coefficients, atol=1e-4)
    assert_allclose(estimate.rotation_cam_from_world, rotation, atol=1e-5)
    assert_allclose(estimate.translation_cam_from_world, translation, atol=1e-4)
    assert_allclose(estimate.residuals_px, 0.0, atol=1e-3)
    assert estimate.camera.estimated == LENS[name].estimated
    assert estimate.covariance.names[6:] == LENS[name].estimated


def opencv_optimum(correspondences, estimate, num_coefficients):
    """f, k of the least squares optimum of cv2.projectPoints over everything, by MINPACK without our derivatives."""

    def lens(k):
        return (
            np.array([*k[:2], *np.zeros(4 - min(len(k), 2)), *k[2:]])[:5] if len(k) > 1 else np.array([k[0], 0, 0, 0])
        )

    def residuals(x):
        matrix = np.array([[x[6], 0.0, 800.0], [0.0, x[6], 800.0], [0.0, 0.0, 1.0]])
        found = cv2.projectPoints(correspondences.xyz_world, x[:3], x[3:6], matrix, lens(x[7:]))[0][:, 0]
        return (found - correspondences.xy_px).ravel()

    rotvec = Rotation.from_matrix(estimate.rotation_cam_from_world).as_rotvec()
    k = estimate.camera.coefficients[:num_coefficients]
    start = np.array([*rotvec, *estimate.translation_cam_from_world, estimate.camera.focal_px[0], *k])
    scale = np.array([1e-2] * 3 + [1e-2] * 3 + [10.0] + [1e-2] * num_coefficients)
    start += 0.1 * scale
    return least_squares(residuals, start, x_scale=scale, method="lm", xtol=1e-14, ftol=1e-14).x[6:]


@pytest.mark.parametrize(("name", "num_coefficients"), [("D1", 1), ("D3", 3)])
def test_the_optimum_is_opencv_s(name, num_coefficients):
    rng = np.random.default_rng(2)
    correspondences, *_ = room(LENS[name], rng, num_points=40)
    estimate = ESTIMATORS[name](correspondences, rng)
    assert estimate.inliers.all()
    focal_px, *k = opencv_optimum(correspondences, estimate, num_coefficients)
    assert_allclose(estimate.camera.focal_px[0], focal_px, atol=1e-3)
    assert_allclose(estimate.camera.coefficients[:num_coefficients], k, atol=1e-5)


@pytest.mark.parametrize(("num_coefficients", "lens"), [(1, ONE_TERM), (2, TWO_TERMS)])
@pytest.mark.parametrize("seed", range(3))
def test_colmap_agrees(num_coefficients, lens, seed):
    """pycolmap 4.2.1: other starts, another optimiser, the same optimum, on boards and rooms."""
    rng = np.random.default_rng(seed)
    for correspondences, *_ in (room(lens, rng), board(lens, rng, 10.0)):
        ours = eaprd(correspondences, rng, num_coefficients=num_coefficients)
        theirs = absolute_pose(correspondences, rng, num_coefficients=num_coefficients)
        assert_allclose(ours.camera.focal_px, theirs.camera.focal_px, atol=0.02 * ours.covariance.sd_of("f"))
        assert (ours.inliers == theirs.inliers).all()


def test_colmap_s_own_inliers_are_not_ours():
    """A strong lens: its RANSAC keeps part of the good points, the estimate all of them."""
    strong = replace(TWO_TERMS, coefficients=np.array([-0.2, 0.03, 0.0]))
    correspondences, *_ = room(strong, np.random.default_rng(3), num_points=60)
    estimate = absolute_pose(correspondences, np.random.default_rng(3))
    assert estimate.inliers.all()
    assert abs(estimate.camera.focal_px[0] - FOCAL) < 4.0 * estimate.covariance.sd_of("f")


@pytest.mark.parametrize("name", NAMES)
def test_outliers_are_left_out(name):
    rng = np.random.default_rng(4)
    for num_outliers in (2, 8):
        correspondences, good = with_outliers(room(LENS[name], rng)[0], num_outliers, rng)
        estimate = ESTIMATORS[name](correspondences, rng)
        assert (estimate.inliers == good).all()
        assert abs(estimate.camera.focal_px[0] - FOCAL) < 4.0 * estimate.covariance.sd_of("f")
        observed = correspondences.xy_px - estimate.project(correspondences.xyz_world).xy_px.T
        assert_allclose(estimate.residuals_px, observed, atol=1e-9)


@pytest.mark.parametrize("name", NAMES)
def test_the_threshold_is_the_caller_s(name):
    rng = np.random.default_rng(5)
    correspondences, *_ = room(LENS[name], rng, num_points=60)
    narrow = estimator(name, threshold_px=1.0)(correspondences, rng)
    assert not narrow.inliers.all()
    assert (np.linalg.norm(narrow.residuals_px[narrow.inliers], axis=1) < 1.0).all()
    with pytest.raises(KeyError):
        estimator("D2")


@pytest.mark.parametrize("num_coefficients", [0, 4])
def test_a_lens_has_one_to_three_coefficients(num_coefficients):
    with pytest.raises(ValueError, match="1 to 3"):
        eaprd(room(FORWARD, np.random.default_rng(0))[0], np.random.default_rng(0), num_coefficients=num_coefficients)


@pytest.mark.parametrize("is_board", [False, True])
@pytest.mark.parametrize("seed", range(4))  # PoseLib answers some boards with the pose that is tilted the other way
def test_the_linear_solution_of_a_division_model_is_exact(is_board, seed):
    rng = np.random.default_rng(seed)
    made = board(DIVISION, rng, 10.0, half=0.8, noise_px=0.0) if is_board else room(DIVISION, rng, noise_px=0.0)
    correspondences, rotation, translation = made
    points = CentredPoints.of(correspondences)
    poses, agree = robust_radial_pose(points.xy_px, points.xyz, 5.0, rng)
    assert np.count_nonzero(~agree) <= 1  # the middle of the board is at the centre: no direction
    starts, usable = complete(poses, points.xy_px[None], points.xyz[None], 3, points.normal)
    assert usable.all()
    assert_allclose(starts.focals_px, FOCAL, rtol=1e-5)
    assert_allclose(starts.divisions[0], DIVISION.coefficients, atol=1e-4)
    assert_allclose(starts.rotations[0], rotation, atol=1e-5)
    found = points.scale * starts.translations[0] - starts.rotations[0] @ points.centroid
    assert_allclose(found, translation, atol=1e-4)


@pytest.mark.parametrize("is_mirrored", [False, True])
@pytest.mark.parametrize("is_turned", [False, True])
def test_four_poses_of_a_plane_have_one_camera(is_mirrored, is_turned):
    """Tilted the other way, or turned by half a turn about the axis, a board is seen in the same directions."""
    correspondences, rotation, translation = board(DIVISION, np.random.default_rng(10), 10.0, half=0.8, noise_px=0.0)
    xy_px, xyz, normal = correspondences.xy_px - 800.0, correspondences.xyz_world, np.array([0.0, 0.0, 1.0])
    poses = RadialPoses(rotation[None], translation[None, :2])
    if is_mirrored:
        poses = poses.mirrored(normal)
        assert_allclose(poses.rotations[0] @ poses.rotations[0].T, np.eye(3), atol=1e-12)
    if is_turned:
        poses = RadialPoses(np.diag([-1.0, -1.0, 1.0]) @ poses.rotations, -poses.shifts)
    starts, usable = complete(poses, xy_px[None], xyz[None], 3, normal)
    assert usable.all()
    assert_allclose(starts.rotations[0], rotation, atol=1e-9)
    assert_allclose(starts.translations[0], translation, atol=1e-5)
    assert_allclose(starts.focals_px, FOCAL, rtol=1e-5)


@pytest.mark.parametrize("seed", range(8))
def test_a_search_from_the_truth_finds_nothing_better(seed):
    """A small, noisy board turned by 3 degrees, whose tilt could be the other way as well."""
    rng = np.random.default_rng(seed)
    correspondences, rotation, translation = board(FORWARD, rng, 3.0, half=0.2, noise_px=0.3)
    estimate = ESTIMATORS["D3"](correspondences, rng)
    start = fit_at(FORWARD, rotation, translation, correspondences.xy_px, correspondences.xyz_world)
    from_truth = refine(start, correspondences.xy_px, correspondences.xyz_world, 5.0)
    assert np.square(estimate.residuals_px).sum() < (1.0 + 1e-4) * from_truth.cost(5.0)


@pytest.mark.parametrize("is_board", [False, True])
def test_five_directions_have_the_true_pose_among_their_answers(is_board):
    rng = np.random.default_rng(7)
    make = (
        (lambda: board(DIVISION, rng, 10.0, noise_px=0.0)) if is_board else (lambda: room(DIVISION, rng, noise_px=0.0))
    )
    correspondences, rotation, _ = make()
    points = CentredPoints.of(correspondences)
    samples = np.array([rng.permutation(correspondences.num)[:5] for _ in range(20)])
    poses, rows = minimal_radial_poses(points.xy_px, points.xyz, samples)
    starts, usable = complete(poses, points.xy_px[samples[rows]], points.xyz[samples[rows]], 3, points.normal)
    right = np.abs(starts.rotations - rotation).max(axis=(1, 2)) < 1e-4
    assert len(set(rows[usable][right])) >= 18
    assert_allclose(starts.focals_px[right], FOCAL, rtol=0.3 if is_board else 1e-3)


@pytest.mark.parametrize("camera", [FORWARD, DIVISION])
def test_derivatives_of_the_refinement(camera):
    rng = np.random.default_rng(8)
    correspondences, rotation, translation = room(camera, rng)
    problem = _Problem(
        fit_at(camera, rotation, translation, correspondences.xy_px, correspondences.xyz_world),
        correspondences.xy_px,
        correspondences.xyz_world,
    )
    x, step = problem.at_start + 0.02 * rng.standard_normal(10), 1e-6
    moves = step * np.eye(10)
    numeric = np.column_stack([(problem.residuals(x + m) - problem.residuals(x - m)) / (2.0 * step) for m in moves])
    assert_allclose(problem.jacobian(x), numeric, rtol=1e-5, atol=1e-5 * np.abs(numeric).max())


@pytest.mark.parametrize("angle", [0.0, 1e-7, 9e-5, 1.1e-4, 0.3, 2.0])
def test_left_jacobian_of_a_rotation(angle):
    """SciPy's matrix exponential of [[W, I], [0, 0]] has it in its upper right corner."""
    rotvec = angle * np.array([0.6, -0.48, 0.64])
    block = np.zeros((6, 6))
    block[:3, :3], block[:3, 3:] = _cross_matrix(rotvec), np.eye(3)
    assert_allclose(_left_jacobian(rotvec), expm(block)[:3, 3:], atol=1e-12 if angle != 1.1e-4 else 1e-11)


def test_a_plane_far_from_the_origin_of_the_world():
    """Georeferenced coordinates: metres, half a million away."""
    rng = np.random.default_rng(9)
    correspondences, rotation, translation = room(FORWARD, rng, noise_px=0.0)
    away = np.array([5e5, 5.4e6, 300.0])
    moved, *_ = seen(FORWARD, rotation, translation, correspondences.xyz_world, 0.0, rng)
    estimate = ESTIMATORS["D3"](replace(moved, xyz_world=moved.xyz_world + away), rng)
    assert_allclose(estimate.camera.focal_px, FOCAL, rtol=1e-5)
    assert_allclose(estimate.xyz_cam(away), translation + rotation @ np.zeros(3), atol=1e-3)
