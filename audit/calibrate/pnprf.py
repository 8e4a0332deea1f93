"""PnPRf: pose, focal length and a division model from 2D-3D correspondences (Nakano, ECCV 2016)."""

from __future__ import annotations

import numpy as np

from sfm_audit.audit.calibrate.camera import Distortion
from sfm_audit.audit.calibrate.consensus import estimate_radial_camera
from sfm_audit.audit.calibrate.eaprd import centred_camera
from sfm_audit.audit.calibrate.estimate import Estimate
from sfm_audit.loaders.correspondences.records import Correspondences


def pnprf(correspondences: Correspondences, rng: np.random.Generator, *, threshold_px: float = 5.0) -> Estimate:
    """Estimate pose, one focal length and a division model of three coefficients, centre in the middle.

    Parameters
    ----------
    correspondences : at least 10 different points
    rng : draws the samples
    threshold_px : an inlier is nearer than that to its projection

    Raises
    ------
    DegenerateInputError
        where the correspondences determine no camera. A plane *nearly* parallel to the image is no error: its
        ``sd_of("f")`` is large.

    Notes
    -----
    Written from the published mathematics: Tsai's radial alignment constraint gives the pose up to depth, one linear
    least squares depth, focal length and division; here the former is PoseLib's. Least squares over everything in
    pixels follows, because the misfit test wants residuals that the estimated parameters cannot reduce.
    undistorted = distorted / (1 + k1 r^2 + k2 r^4 + k3 r^6), r the distorted normalised radius, so k are of order
    1. The paper's tables call this model D(3, 0), which it is not.
    """
    camera = centred_camera(correspondences, Distortion.DIVISION, ("f", "k1", "k2", "k3"))
    return estimate_radial_camera("pnprf", camera, correspondences, threshold_px, rng)
