"""Boards with a known camera, and estimates by SciPy's least squares: no estimator of ours is asked."""

from __future__ import annotations

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from sfm_audit.audit.calibrate.camera import CalibratedCamera, Distortion
from sfm_audit.audit.calibrate.estimate import Estimate, estimate_of
from sfm_audit.loaders.correspondences.records import Correspondences

D1 = ("f", "k1")
D3 = ("f", "k1", "k2", "k3")
THETA = np.array([-0.0684, 0.0100, 0.0006])
SIZE = 1600


def true_camera(coefficients=THETA, focal_px=800.0, distortion=Distortion.FORWARD, estimated=D3):
    centre = (SIZE / 2, SIZE / 2)
    return CalibratedCamera(
        SIZE, SIZE, distortion, (focal_px, focal_px), centre, np.asarray(coefficients, dtype=float), estimated
    )


def board(rng, *, noise_px=0.03, tilt_deg=(12.0, -9.0), extent=0.8, camera=None, num_corners=15, depth=0.0):
    """A board (or, with ``depth``, a cloud) seen by a camera: correspondences, rotation, translation."""
    camera = camera or true_camera()
    grid = np.linspace(-1.0, 1.0, num_corners)
    xyz = np.column_stack([*(a.ravel() for a in np.meshgrid(grid, grid)), depth * rng.uniform(-1, 1, num_corners**2)])
    rotation = Rotation.from_euler("xy", tilt_deg, degrees=True).as_matrix()
    translation = np.array([0.0, 0.0, 1.0 / extent])
    xy = camera.project(xyz @ rotation.T + translation).xy_px.T
    return (
        Correspondences(SIZE, SIZE, xy + noise_px * rng.standard_normal(xy.shape), xyz),
        rotation,
        translation,
    )


def fitted(name, estimated, correspondences, rotation, translation, *, distortion=Distortion.FORWARD, inliers=None):
    """The least squares estimate of the parameters named, started at the truth."""
    kept = np.ones(correspondences.num, dtype=bool) if inliers is None else inliers

    def unpack(x):
        k = np.zeros(3)
        values = dict(zip(estimated, x[6:], strict=True))
        for i in range(3):
            k[i] = values.get(f"k{i + 1}", 0.0)
        camera = CalibratedCamera(SIZE, SIZE, distortion, (values["f"],) * 2, (SIZE / 2,) * 2, k, estimated)
        return camera, Rotation.from_rotvec(x[:3]).as_matrix() @ rotation, x[3:6] + translation

    def residuals(x):
        camera, r, t = unpack(x)
        left = correspondences.xy_px - camera.project(correspondences.xyz_world @ r.T + t).xy_px.T
        return left[kept].ravel()

    start = np.concatenate([np.zeros(6), [800.0], np.zeros(len(estimated) - 1)])
    x = least_squares(residuals, start, x_scale="jac", xtol=1e-13, ftol=1e-13, gtol=1e-13).x
    camera, r, t = unpack(x)
    return estimate_of(name, camera, r, t, correspondences, inliers=kept)


def moved(estimate: Estimate, correspondences, shift):
    """The same estimate with its pose translated."""
    return estimate_of(
        estimate.name,
        estimate.camera,
        estimate.rotation_cam_from_world,
        estimate.translation_cam_from_world + shift,
        correspondences,
        inliers=estimate.inliers,
    )
