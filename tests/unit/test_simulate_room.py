"""The room's images are where OpenCV projects its points; its boards are flat; its noise has the size asked for."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy import stats

from sfm_audit.audit.simulate.lidar_scan import LidarSpec
from sfm_audit.audit.simulate.room import ROOM_CAMERAS, RoomSpec, room_sets, zhang_views

CAMERAS = list(ROOM_CAMERAS)


def opencv_of(camera):
    (fx, fy), (cx, cy), (k1, k2, k3) = camera.focal_px, camera.principal_point_px, camera.coefficients
    return np.array([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1.0]]), np.array([k1, k2, 0.0, 0.0, k3])


@pytest.mark.parametrize("name", CAMERAS)
def test_true_pixels_are_where_opencv_projects_the_points(name):
    for room in room_sets(RoomSpec(name), 0, 5):
        turn, _ = cv2.Rodrigues(room.rotation_cam_from_world)
        xy, _ = cv2.projectPoints(
            room.true_xyz_world, turn, room.translation_cam_from_world, *opencv_of(ROOM_CAMERAS[name])
        )
        assert_allclose(room.true_xy_px, xy[:, 0] + 0.5, atol=1e-6)


@pytest.mark.parametrize("name", CAMERAS)
def test_24_points_all_over_the_image_in_front_of_the_camera_and_in_the_room(name):
    for room in room_sets(RoomSpec(name), 1, 20):
        size = np.array([room.correspondences.width, room.correspondences.height])
        assert room.correspondences.num == 24
        assert np.all((room.true_xy_px >= 7.99) & (room.true_xy_px <= size - 7.99))
        quadrant = (room.true_xy_px > 0.5 * size) @ [1, 2]
        assert np.bincount(quadrant, minlength=4).min() >= 3
        xyz_cam = room.true_xyz_world @ room.rotation_cam_from_world.T + room.translation_cam_from_world
        assert xyz_cam[:, 2].min() > 0.3
        assert np.all(room.true_xyz_world <= [3.0, 1.6, 7.0])
        assert np.all(room.true_xyz_world >= [-3.0, -1.4, -2.0])
        assert np.linalg.matrix_rank(room.true_xyz_world - room.true_xyz_world.mean(axis=0), tol=1.0) == 3  # not flat


def test_noise_of_annotation_and_lidar():
    spec = RoomSpec("wide", num_points=100, annotation_sd_px=0.9, lidar=LidarSpec(1e-3, 5e-4, 0.5))
    rooms = room_sets(spec, 2, 40)
    noise_px = np.concatenate([room.correspondences.xy_px - room.true_xy_px for room in rooms])
    assert noise_px.std() == pytest.approx(0.9, rel=0.03)
    assert stats.kstest(noise_px.ravel() / 0.9, "norm").pvalue > 0.001
    true, seen = (
        np.concatenate(list(xyz))
        for xyz in ((r.true_xyz_world for r in rooms), (r.correspondences.xyz_world for r in rooms))
    )
    assert_allclose(np.linalg.norm(true, axis=1), np.linalg.norm(seen, axis=1))
    pan_noise = np.arctan2(seen[:, 0], seen[:, 2]) - np.arctan2(true[:, 0], true[:, 2])
    assert (pan_noise + np.pi).std() == pytest.approx(5e-4, rel=0.05)


def test_without_noise_everything_is_the_truth():
    spec = RoomSpec("plain", annotation_sd_px=0.0, lidar=LidarSpec(5e-4, 5e-4, 0.0))
    for room in room_sets(spec, 3, 3):
        assert_array_equal(room.correspondences.xy_px, room.true_xy_px)
        assert_allclose(room.correspondences.xyz_world, room.true_xyz_world, atol=1e-12)


def test_a_longer_list_begins_like_a_shorter_one_and_seeds_differ():
    short, long = (room_sets(RoomSpec(), 4, num) for num in (2, 3))
    for one, other in zip(short, long, strict=False):
        assert_array_equal(one.correspondences.xy_px, other.correspondences.xy_px)
    assert not np.array_equal(long[0].true_xy_px, long[1].true_xy_px)
    assert not np.array_equal(long[0].true_xy_px, room_sets(RoomSpec(), 5, 1)[0].true_xy_px)
    views = [zhang_views("plain", 4, num) for num in (2, 3)]
    assert_array_equal(views[0][1].xy_px, views[1][1].xy_px)


@pytest.mark.parametrize("name", CAMERAS)
def test_views_are_of_a_flat_board_inside_the_image(name):
    """Undistorted by OpenCV, the corners are a homography of the board."""
    for view in zhang_views(name, 0, 6, corner_sd_px=0.0):
        matrix, distortion = opencv_of(ROOM_CAMERAS[name])
        criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 200, 1e-14)
        undistorted = cv2.undistortPointsIter(view.xy_px - 0.5, matrix, distortion, None, None, criteria)[:, 0]
        homography, _ = cv2.findHomography(view.xyz_world[:, :2], undistorted)
        mapped = cv2.perspectiveTransform(view.xyz_world[None, :, :2], homography)[0]
        assert_allclose(mapped, undistorted, atol=1e-6)
        assert view.num == 36
        assert np.all((view.xy_px >= 8.0) & (view.xy_px <= np.array([view.width, view.height]) - 8.0))


@pytest.mark.parametrize(("name", "sd_px"), [("plain", 0.19), ("wide", 0.81)])
def test_corners_of_views_have_the_papers_noise(name, sd_px):
    noisy, exact = zhang_views(name, 7, 20), zhang_views(name, 7, 20, corner_sd_px=0.0)
    noise_px = np.concatenate([a.xy_px - b.xy_px for a, b in zip(noisy, exact, strict=True)])
    assert noise_px.std() == pytest.approx(sd_px, rel=0.06)


def test_unknown_cameras_and_empty_rooms_are_refused():
    with pytest.raises(ValueError, match="unknown camera 'narrow'; there are plain, wide"):
        RoomSpec("narrow")
    with pytest.raises(ValueError, match="unknown camera 'narrow'"):
        zhang_views("narrow", 0)
    with pytest.raises(ValueError, match="need a point"):
        dataclasses.replace(RoomSpec(), num_points=0)


@pytest.mark.parametrize("name", CAMERAS)
def test_the_lenses_reach_every_corner_of_the_image(name):
    camera = ROOM_CAMERAS[name]
    corners = np.array([[0, 0], [camera.width, 0], [0, camera.height], [camera.width, camera.height]], dtype=float)
    assert np.isfinite(camera.undistort(corners)).all()
