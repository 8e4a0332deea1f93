"""A rendered board is the mean of its squares under the blur, and the detector errs by the paper's 0.03 px."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose

from sfm_audit.audit.calibrate.camera import Distortion
from sfm_audit.audit.simulate.board import BoardSpec, _place
from sfm_audit.audit.simulate.board_pose import BoardPose
from sfm_audit.audit.simulate.render import BoardPainter, DetectorError, PhotoSpec, detect_corners

SPEC = BoardSpec()
NO_NOISE = PhotoSpec(noise_grey=0.0)
SMALL = dataclasses.replace(SPEC, num_corners=4, width=200, height=160, focal_px=150.0)


def pose_of(spec, extent, seed=0):
    return _place(spec, extent, np.random.default_rng(seed))


@pytest.fixture(scope="module")
def painter():
    return BoardPainter.of(SPEC.camera, SPEC.num_corners)


def brute_force(spec, pose, xy_px, photo):
    """Grey value of one pixel: ten thousand rays about its centre, each through the camera to the board."""
    offsets = np.linspace(-4.5, 4.5, 151) * photo.blur_px
    x, y = np.meshgrid(offsets, offsets)
    weight = np.exp(-0.5 * (x**2 + y**2) / photo.blur_px**2).ravel()
    rays = spec.camera.undistort(np.column_stack([x.ravel(), y.ravel()]) + xy_px)
    rays = np.column_stack([rays, np.ones(len(rays))])
    normal, point = pose.rotation_cam_from_world[:, 2], pose.translation_cam_from_world
    on_plane = rays * ((normal @ point) / (rays @ normal))[:, None]
    board = (on_plane - point) @ pose.rotation_cam_from_world
    squares = (board[:, :2] + 0.5) * (spec.num_corners - 1) + 1.0
    inside = np.all((squares >= 0) & (squares < spec.num_corners + 1), axis=1)
    white = np.floor(squares).sum(axis=1) % 2 == 1
    grey = np.where(inside, np.where(white, photo.white, photo.black), photo.ground)
    return weight @ grey / weight.sum()


@pytest.mark.parametrize("seed", [0, 2, 5])
def test_pixels_are_means_of_the_board_under_the_blur(seed):
    pose = pose_of(SMALL, 0.6, seed)
    photograph = BoardPainter.of(SMALL.camera, 4, NO_NOISE).photograph(pose, np.random.default_rng(0))
    corner = np.floor(pose.xy_px[5]).astype(int)
    pixels = [corner + np.array([dx, dy]) for dx in (-2, -1, 0, 1, 3) for dy in (-1, 0, 1)]
    pixels += [np.floor(pose.xy_px[0]).astype(int) - 3, corner + np.array([15, 0]), np.array([1, 1])]
    for column, row in pixels:
        expected = brute_force(SMALL, pose, np.array([column, row]) + 0.5, NO_NOISE)
        assert photograph[row, column] == pytest.approx(expected, abs=1.2)  # rounding, and 151 steps across an edge


def test_rays_are_the_cameras(painter):
    rows, columns = np.random.default_rng(0).integers(0, 1600, (2, 500))
    rays = SPEC.camera.undistort(np.column_stack([columns, rows]) + 0.5)
    assert_allclose(painter.rays[:, rows, columns].T, rays, atol=2e-7)


@pytest.mark.parametrize(("extent", "seed"), [(0.12, 0), (0.5, 5), (0.97, 2)])
def test_the_detector_errs_by_003_px_at_all_distances(painter, extent, seed):
    pose, rng = pose_of(SPEC, extent, seed), np.random.default_rng(1)
    errors_px = detect_corners(painter.photograph(pose, rng), pose.xy_px, 15, rng) - pose.xy_px
    assert errors_px.std() == pytest.approx(0.03, abs=0.003)
    assert np.abs(errors_px.mean(axis=0)).max() < 0.006  # no shift by a pixel's half


def test_without_noise_only_the_detectors_own_error_is_left(painter):
    """OpenCV's detector on a perfect, blurred saddle point: about 0.01 px, by where in its pixel it lies."""
    quiet = dataclasses.replace(painter, photo=NO_NOISE)
    pose, rng = pose_of(SPEC, 0.4, 5), np.random.default_rng(1)
    errors_px = detect_corners(quiet.photograph(pose, rng), pose.xy_px, 15, rng) - pose.xy_px
    assert errors_px.std() < 0.0125
    assert np.abs(errors_px).max() < 0.03


def test_noise_has_the_size_that_was_asked_for():
    photograph = BoardPainter.of(SMALL.camera, 4, PhotoSpec(noise_grey=6.0)).photograph(
        pose_of(SMALL, 0.2), np.random.default_rng(2)
    )
    assert photograph[:30].std() == pytest.approx(6.0, rel=0.05)
    assert photograph[:30].mean() == pytest.approx(125.0, abs=0.5)


def test_lost_corners_are_refused_not_dropped(painter):
    pose, rng = pose_of(SPEC, 0.3), np.random.default_rng(0)
    photograph = painter.photograph(pose, rng)
    with pytest.raises(DetectorError, match=r"of 225 corners found more than 0\.5 px off"):
        detect_corners(photograph, pose.xy_px + 1.5, 15, rng)
    with pytest.raises(DetectorError, match=r"3\.0 px apart are too close"):
        detect_corners(photograph, np.stack(np.meshgrid(*[3.0 * np.arange(15)] * 2), axis=-1).reshape(-1, 2), 15, rng)


def test_a_lens_that_folds_inside_the_image_is_refused():
    camera = dataclasses.replace(SPEC.camera, distortion=Distortion.FORWARD, coefficients=np.array([-0.5, 0.0, 0.0]))
    with pytest.raises(ValueError, match="folds inside the image"):
        BoardPainter.of(camera, 15)


def test_the_first_square_is_black_and_rows_go_down():
    pose = BoardPose(np.eye(3), np.array([0.0, 0.0, 2.0]), np.zeros((16, 2)))
    xy_px = SMALL.camera.project(SMALL.xyz_world + np.array([0.0, 0.0, 2.0])).xy_px.T
    pose = dataclasses.replace(pose, xy_px=xy_px)
    photograph = BoardPainter.of(SMALL.camera, 4, NO_NOISE).photograph(pose, np.random.default_rng(0))
    first, second, below = xy_px[0] - 8, xy_px[0] + [8, -8], xy_px[0] + [-8, 8]
    grey = [photograph[int(y), int(x)] for x, y in (first, second, below)]
    assert grey == [40, 210, 210]
