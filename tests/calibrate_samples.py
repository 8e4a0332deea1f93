"""Boards and rooms seen by a lens that is known, for the tests of audit/calibrate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from sfm_audit.audit.calibrate.camera import CalibratedCamera, Distortion
from sfm_audit.audit.calibrate.degenerate import before_fold
from sfm_audit.loaders.correspondences.records import Correspondences

SIZE = 1600
FOCAL = 800.0
MARGIN_PX = 8.0
FORWARD = CalibratedCamera(
    SIZE,
    SIZE,
    Distortion.FORWARD,
    (FOCAL, FOCAL),
    (SIZE / 2, SIZE / 2),
    np.array([-0.0684, 0.0100, 0.0006]),  # the paper's lens
    ("f", "k1", "k2", "k3"),
)
ONE_TERM = replace(FORWARD, coefficients=np.array([-0.06, 0.0, 0.0]), estimated=("f", "k1"))
TWO_TERMS = replace(FORWARD, coefficients=np.array([-0.06, 0.01, 0.0]), estimated=("f", "k1", "k2"))
DIVISION = replace(FORWARD, distortion=Distortion.DIVISION, coefficients=np.array([-0.06, 0.004, 0.001]))
LENS = {"D1": ONE_TERM, "D3": FORWARD, "pnprf": DIVISION, "colmap": TWO_TERMS}


def seen(camera, rotation, translation, xyz, noise_px, rng):
    """What the camera sees of points; the pose with it."""
    xy = camera.project(xyz @ rotation.T + translation).xy_px.T
    noisy = xy + noise_px * rng.standard_normal(xy.shape)
    return Correspondences(SIZE, SIZE, noisy, xyz), rotation, translation


def board(camera, rng, tilt_deg, half=None, noise_px=0.03, num_per_side=15):
    """A board turned by ``tilt_deg`` about an axis in its plane, or by up to 15 degrees about all where that is None.

    half: of the board over that of the image, in normalised units; drawn as the paper's where None.
    """
    side = np.linspace(-1.0, 1.0, num_per_side)
    xyz = np.stack([*np.meshgrid(side, side), np.zeros((num_per_side, num_per_side))], axis=-1).reshape(-1, 3)
    rotation = Rotation.from_euler("xyz", rng.uniform(-15.0, 15.0, 3), degrees=True)
    if tilt_deg is not None:
        axis = rng.uniform(0.0, 2.0 * np.pi)
        tilt = np.radians(tilt_deg) * np.array([np.cos(axis), np.sin(axis), 0.0])
        rotation = Rotation.from_rotvec(tilt) * Rotation.from_euler("z", rng.uniform(-15.0, 15.0), degrees=True)
    depth = 1.0 / (rng.uniform(0.12, 0.97) if half is None else half)
    while True:
        xyz_cam = rotation.apply(xyz) + np.array([0.0, 0.0, depth])
        xy = camera.project(xyz_cam).xy_px
        if ((xy > MARGIN_PX) & (xy < SIZE - MARGIN_PX)).all():
            return seen(camera, rotation.as_matrix(), np.array([0.0, 0.0, depth]), xyz, noise_px, rng)
        depth *= 1.01


def room(camera, rng, num_points=24, noise_px=0.5):
    """Points in front of a camera, 4 to 10 m deep, the world turned and shifted."""
    depth = rng.uniform(4.0, 10.0, 40 * num_points)
    xyz_cam = np.column_stack([rng.uniform(-1.0, 1.0, (len(depth), 2)) * depth[:, None], depth])
    xyz_cam = xyz_cam[before_fold(camera, xyz_cam)]
    xy = camera.project(xyz_cam).xy_px
    xyz_cam = xyz_cam[((xy > MARGIN_PX) & (xy < SIZE - MARGIN_PX)).all(axis=0)][:num_points]
    rotation, translation = Rotation.random(rng=rng).as_matrix(), 3.0 * rng.standard_normal(3)
    return seen(camera, rotation, translation, (xyz_cam - translation) @ rotation, noise_px, rng)


def with_outliers(correspondences, num_outliers, rng):
    """The same, some anywhere in the image; and which are not."""
    good = np.ones(correspondences.num, dtype=bool)
    good[rng.permutation(correspondences.num)[:num_outliers]] = False
    xy = correspondences.xy_px.copy()
    xy[~good] = rng.uniform(0.0, SIZE, (num_outliers, 2))
    return replace(correspondences, xy_px=xy), good
