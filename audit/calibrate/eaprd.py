"""EAPRD: pose, focal length and forward radial distortion from 2D-3D correspondences (Larsson et al., ICCV 2019)."""

from __future__ import annotations

import numpy as np

from sfm_audit.audit.calibrate.camera import CalibratedCamera, Distortion
from sfm_audit.audit.calibrate.consensus import estimate_radial_camera
from sfm_audit.audit.calibrate.estimate import Estimate
from sfm_audit.loaders.correspondences.records import Correspondences

_COEFFICIENTS = ("k1", "k2", "k3")


def eaprd(
    correspondences: Correspondences, rng: np.random.Generator, *, num_coefficients: int, threshold_px: float = 5.0
) -> Estimate:
    """Estimate pose, one focal length and D(n, 0): distorted = undistorted (1 + k1 r^2 + ..), centre in the middle.

    Parameters
    ----------
    correspondences : at least 7 + n different points
    rng : draws the samples
    num_coefficients : n, 1 to 3
    threshold_px : an inlier is nearer than that to its projection

    Raises
    ------
    ValueError
        for another number of coefficients.
    DegenerateInputError
        where the correspondences determine no camera. A plane *nearly* parallel to the image is no error: its
        ``sd_of("f")`` is large.

    Notes
    -----
    Radial pose from the directions, then depth and focal length linearly, then the lens linearly, then least squares
    over everything with the inliers selected again. The paper's solver starts the same way; it optimises the radial
    error first. Where more than 15 % are outliers, RANSAC scores whole cameras (the direction of an outlier fits by
    chance far more often than its position).
    """
    if not 1 <= num_coefficients <= len(_COEFFICIENTS):
        raise ValueError(f"{num_coefficients} coefficients: 1 to 3")
    estimated = ("f", *_COEFFICIENTS[:num_coefficients])
    camera = centred_camera(correspondences, Distortion.FORWARD, estimated)
    return estimate_radial_camera(f"D{num_coefficients}", camera, correspondences, threshold_px, rng)


def centred_camera(
    correspondences: Correspondences, distortion: Distortion, estimated: tuple[str, ...]
) -> CalibratedCamera:
    """Return a camera of the image's size, its centre in the middle, without values for what is estimated."""
    width, height = correspondences.width, correspondences.height
    unknown = np.zeros(3)
    return CalibratedCamera(width, height, distortion, (1.0, 1.0), (0.5 * width, 0.5 * height), unknown, estimated)
