"""Noise of correspondences whose 3D points a lidar measured: the paper's model (P5 to P12), method.md section 2."""

from __future__ import annotations

import math

import numpy as np

from sfm_audit.audit.calibrate.estimate import Estimate
from sfm_audit.audit.noise.fits import fit_constant_variance, fit_variance
from sfm_audit.audit.noise.standardise import ImageNoise
from sfm_audit.audit.noise.variants import fit_variance_likelihood
from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.loaders.correspondences.records import Correspondences


def lidar_predictors(estimate: Estimate, correspondences: Correspondences) -> FloatArray:
    """Return a_x and a_y (n, 2), px, of all correspondences: how large one step of the scanner is in the image.

    a_x = |proj(X_p) - proj(X)| with the neighbour in pan, a_y = |proj(X_t) - proj(X)| with that in tilt (P7, P8), both
    the lengths of 2-vectors. NaN where the point or its neighbour has no image.

    Raises
    ------
    ValueError
        The correspondences have no neighbours.

    Notes
    -----
    The model says that pan moves an image point along x and tilt along y, so the scanner and the camera must both
    stand about upright. A camera on its side needs its neighbours exchanged.
    """
    pan, tilt = correspondences.pan_xyz_world, correspondences.tilt_xyz_world
    if pan is None or tilt is None:
        raise ValueError("noise model lidar: the correspondences have no neighbours in pan and tilt")
    xy = estimate.project(correspondences.xyz_world).xy_px
    steps = [np.linalg.norm(estimate.project(neighbour).xy_px - xy, axis=0) for neighbour in (pan, tilt)]
    return np.stack(steps, axis=1)


def lidar_noise(estimate: Estimate, correspondences: Correspondences, *, robust: bool = True) -> ImageNoise:
    """Noise model ``lidar``: detector noise plus the scanner's, as far as the image shows it.

    Parameters
    ----------
    robust : the fit of method.md section 2; False: maximum likelihood, the plain scale to compare with, which a wrong
        camera model inflates until its residuals look normal

    Returns
    -------
    ImageNoise
        Of the estimate's inliers, in their order. z = eps / sqrt(theta_1 + a^2 theta_2) (P12), one theta for x and y,
        with a_x in x and a_y in y; NaN in rows whose neighbour has no image, which have no part in the fit.
        sigma_d_px of the detector, px; sigma_l of the lidar, in steps of the scan; sigma_predicted_px: median over
        both axes of sqrt(theta_1 + a^2 theta_2), px; sigma_constant_px: of the raw residuals, always the robust one.
        Where all residuals are 0 everything is NaN and ``converged`` False.

    Raises
    ------
    ValueError
        The correspondences have no neighbours.
    """
    predictor = lidar_predictors(estimate, correspondences)[estimate.inliers] ** 2
    residuals = estimate.residuals_px[estimate.inliers]
    known = np.isfinite(predictor).all(axis=1)
    fit_theta = fit_variance if robust else fit_variance_likelihood
    fit = fit_theta((residuals[known] ** 2).ravel(), predictor[known].ravel())
    sd = np.sqrt(fit.detector_px2 + fit.structure * predictor)
    return ImageNoise(
        z=residuals / sd,
        sigma_constant_px=math.sqrt(fit_constant_variance(residuals**2).detector_px2),
        sigma_d_px=math.sqrt(fit.detector_px2),
        sigma_l=math.sqrt(fit.structure),
        sigma_predicted_px=float(np.median(sd[known])) if known.any() else math.nan,
        scale_ratio=math.nan,
        converged=fit.converged,
    )
