"""Least squares over pose, focal length and radial distortion, on inliers that are selected again until they stay."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from sfm_audit.audit.calibrate.camera import CalibratedCamera
from sfm_audit.audit.misfit import ProjectedImage
from sfm_audit.loaders.arrays import BoolArray, FloatArray

_CHANGE: Final = 1e-10  # relative, of cost and parameters, below which the optimum is reached
_ROUGH_CHANGE: Final = 1e-4  # before the inliers are selected again
_MAX_EVALUATIONS: Final = 100
_MOST_ZOOM: Final = 10.0  # of log(f / f_0): a step beyond is refused before numbers overflow
_MAX_SELECTIONS: Final = 20
_SMALL_ANGLE: Final = 1e-4  # rad; below it the series is exact to rounding


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A camera with its pose, fitted to some of the points.

    camera: one focal length, centre fixed.          rotation: (3, 3) camera from points.
    translation: (3,) units of the points.           inliers: (n,) the points that it was fitted to.
    sq_errors_px2: (n,) of all points; inf behind the camera.
    """

    camera: CalibratedCamera
    rotation: FloatArray
    translation: FloatArray
    inliers: BoolArray
    sq_errors_px2: FloatArray

    def cost(self, threshold_px: float) -> float:
        """Sum of squared errors, each at most the threshold's square, px^2 (MSAC)."""
        return float(np.minimum(self.sq_errors_px2, threshold_px**2).sum())


def fit_at(
    camera: CalibratedCamera, rotation: FloatArray, translation: FloatArray, xy_px: FloatArray, xyz: FloatArray
) -> Fit:
    """Return a camera as it stands, with all points that it sees as its inliers."""
    projected = camera.project(xyz @ rotation.T + translation).xy_px.T
    errors = np.square(xy_px - projected).sum(axis=1)
    seen = np.isfinite(errors)
    return Fit(camera, rotation, translation, seen, np.where(seen, errors, np.inf))


def refine(start: Fit, xy_px: FloatArray, xyz: FloatArray, threshold_px: float) -> Fit | None:
    """Fit to the inliers, select the inliers again, until they stay.

    Parameters
    ----------
    start : where to start; its own inliers are fitted first, robustly
    xy_px, xyz : (n, 2) observed and (n, 3) world points, centred
    threshold_px : an inlier is nearer than that to its projection

    Returns
    -------
    Fit or None
        at the least squares optimum of its inliers; None where fewer inliers than parameters are left. A set of
        inliers that does not settle ends after 20 rounds with the last one.
    """
    num_parameters = 6 + len(start.camera.estimated)
    if np.count_nonzero(start.inliers) < num_parameters:
        return None
    fit, is_first = start, True
    for _ in range(_MAX_SELECTIONS):
        fit = _minimise(fit, xy_px, xyz, threshold_px if is_first else None)
        inliers = fit.sq_errors_px2 < threshold_px**2
        if np.count_nonzero(inliers) < num_parameters:
            return None
        if not is_first and (inliers == fit.inliers).all():
            return fit
        fit, is_first = replace(fit, inliers=inliers), False
    return _minimise(fit, xy_px, xyz, None)


class _Problem:
    """Residuals and Jacobian of one set of inliers about a start, at the parameters that `_minimise` explains."""

    def __init__(self, start: Fit, xy_px: FloatArray, xyz: FloatArray) -> None:
        self._start, self._xy_px, self._xyz = start, xy_px, xyz
        self._names = start.camera.estimated[1:]
        self._powers = np.array([2 * int(name[1]) for name in self._names])
        self._seen_at: tuple[FloatArray, ProjectedImage] | None = None

    @property
    def at_start(self) -> FloatArray:
        coefficients = [self._start.camera.coefficients[power // 2 - 1] for power in self._powers]
        return np.array([0.0, 0.0, 0.0, *self._start.translation, 0.0, *coefficients])

    def camera_at(self, x: FloatArray) -> tuple[CalibratedCamera, FloatArray, FloatArray]:
        gain = float(np.exp(x[6]))
        focal = self._start.camera.focal_px[0] * gain
        coefficients = np.zeros(3)
        coefficients[self._powers // 2 - 1] = x[7:] * gain**self._powers
        camera = replace(self._start.camera, focal_px=(focal, focal), coefficients=coefficients)
        return camera, Rotation.from_rotvec(x[:3]).as_matrix() @ self._start.rotation, x[3:6] * gain

    def residuals(self, x: FloatArray) -> FloatArray:
        if abs(x[6]) > _MOST_ZOOM:
            return np.full(self._xy_px.size, np.nan)
        camera, rotation, translation = self.camera_at(x)
        projected = camera.project(self._xyz @ rotation.T + translation)
        self._seen_at = x.copy(), projected
        return (projected.xy_px - self._xy_px.T).ravel()

    def jacobian(self, x: FloatArray) -> FloatArray:
        if self._seen_at is None or not np.array_equal(self._seen_at[0], x):
            self.residuals(x)
        if self._seen_at is None:  # pragma: no cover - set by residuals
            raise ValueError("no projection")
        projected = self._seen_at[1]
        camera, _, translation = self.camera_at(x)
        gain = float(np.exp(x[6]))
        pose, params = projected.pose, projected.d_params
        turn = pose[:3] + np.tensordot(_cross_matrix(translation).T, pose[3:], axes=1)  # about the points' origin
        turn = np.tensordot(_left_jacobian(x[:3]).T, turn, axes=1)
        coefficients = x[7:] * gain**self._powers
        weights = np.array([camera.focal_px[0], *(self._powers * coefficients)])
        zoom = np.tensordot(translation, pose[3:], axes=1) + np.tensordot(weights, params, axes=1)
        scaled = params[1:] * (gain**self._powers)[:, None, None]
        columns = np.concatenate([turn, gain * pose[3:], zoom[None], scaled])
        return np.ascontiguousarray(columns.reshape(len(columns), -1).T)


def _minimise(fit: Fit, xy_px: FloatArray, xyz: FloatArray, loss_scale_px: float | None) -> Fit:
    """Least squares on the fit's inliers, robust where a scale is given.

    Parameters are a rotation vector about the origin of the points, t f_0 / f, log(f / f_0) and k_i (f_0 / f)^2i: a
    longer focal length at a larger distance with the same curve in pixels is then one straight line, which is the long
    valley of a plane nearly parallel to the image.
    """
    problem = _Problem(fit, xy_px[fit.inliers], xyz[fit.inliers])
    is_final = loss_scale_px is None
    change = _CHANGE if is_final else _ROUGH_CHANGE
    found = least_squares(
        problem.residuals,
        problem.at_start,
        jac=problem.jacobian,
        x_scale="jac",
        loss="linear" if is_final else "soft_l1",
        f_scale=1.0 if loss_scale_px is None else loss_scale_px,
        ftol=change,
        xtol=change,
        gtol=None,
        max_nfev=_MAX_EVALUATIONS,
    )
    return replace(fit_at(*problem.camera_at(found.x), xy_px, xyz), inliers=fit.inliers)


def _cross_matrix(v: FloatArray) -> FloatArray:
    """Return [v] with [v] w = v x w."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def _left_jacobian(rotvec: FloatArray) -> FloatArray:
    """Return J with exp(w + dw) = exp(J dw) exp(w), (3, 3)."""
    angle = float(np.linalg.norm(rotvec))
    cross = _cross_matrix(rotvec)
    first = 0.5 * np.sinc(0.5 * angle / np.pi) ** 2
    second = (1.0 - np.sinc(angle / np.pi)) / angle**2 if angle > _SMALL_ANGLE else 1.0 / 6.0
    return np.asarray(np.eye(3) + first * cross + second * (cross @ cross))
