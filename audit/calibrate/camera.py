"""Cameras as extended PnP estimates them: a centre, one or two focal lengths, radial distortion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import numpy as np
from scipy.optimize.elementwise import find_root

from sfm_audit.audit.cameras import project_with_jacobians
from sfm_audit.audit.inliers.stationarity import pose_jacobian
from sfm_audit.audit.misfit import ProjectedImage
from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.loaders.camera_models import BY_NAME
from sfm_audit.loaders.model import CameraRecord

_REAL: Final = 1e-9  # imaginary share of a root that counts as real
_FIRST_REACH: Final = 2.0  # normalised radius, 63 degrees
_FARTHEST: Final = 1e6  # normalised radius that is 90 degrees for all purposes
_MAX_DOUBLINGS: Final = 40
_NEWTON_STEPS: Final = 7
_NEWTON_CHANGE: Final = 1e-14  # relative, of the last step

_Function = Callable[[FloatArray, FloatArray], FloatArray]


class Distortion(StrEnum):
    """Which way the polynomial 1 + k1 r^2 + k2 r^4 + k3 r^6 goes; r is a normalised radius, so k are of order 1.

    FORWARD: distorted = undistorted times the polynomial in the undistorted r (OpenCV's k1..k3, D(3,0)).
    DIVISION: undistorted = distorted divided by the polynomial in the distorted r.
    """

    FORWARD = "forward"
    DIVISION = "division"


@dataclass(frozen=True, slots=True, eq=False)
class CalibratedCamera:
    """A camera that was estimated, and which of its parameters were.

    width, height: px.          focal_px: (fx, fy), equal where one focal length was estimated.
    principal_point_px: (cx, cy), first pixel centre = (0.5, 0.5).          coefficients: (3,) k1, k2, k3.
    estimated: names of the estimated parameters: "f" (moves fx and fy alike) or "fx", "fy"; "cx", "cy"; "k1".. "k3".
    """

    width: int
    height: int
    distortion: Distortion
    focal_px: tuple[float, float]
    principal_point_px: tuple[float, float]
    coefficients: FloatArray
    estimated: tuple[str, ...]

    @property
    def pinhole(self) -> CameraRecord:
        """Focal lengths, centre and size alone: what `audit.misfit.candidate_fields` needs of a camera."""
        params = np.array([*self.focal_px, *self.principal_point_px])
        return CameraRecord(1, BY_NAME["PINHOLE"], self.width, self.height, params)

    @property
    def colmap(self) -> CameraRecord | None:
        """The same camera as a COLMAP model, FULL_OPENCV; None for a division model of more than one coefficient."""
        centre = self.principal_point_px
        if self.distortion is Distortion.FORWARD:
            k1, k2, k3 = self.coefficients
            params = np.array([*self.focal_px, *centre, k1, k2, 0.0, 0.0, k3, 0.0, 0.0, 0.0])
            return CameraRecord(1, BY_NAME["FULL_OPENCV"], self.width, self.height, params)
        if self.coefficients[1:].any():
            return None
        params = np.array([*self.focal_px, *centre, self.coefficients[0]])
        return CameraRecord(1, BY_NAME["DIVISION"], self.width, self.height, params)

    @property
    def fold_radius(self) -> float:
        """Undistorted normalised radius beyond which the image runs back, or that has no image; inf without one."""
        if self.distortion is Distortion.FORWARD:
            return _forward_fold(self.coefficients)
        k = self.coefficients
        fold = _first_root([1.0, -k[0], -3.0 * k[1], -5.0 * k[2]])
        if not fold < _first_root([1.0, *k]):  # the polynomial falls to 0 first: all of the half space has an image
            return float(np.inf)
        return float(fold / _polynomial(k, np.array(fold)))

    def project(self, xyz_cam: FloatArray) -> ProjectedImage:
        """Project points (n, 3) in the camera frame, with derivatives.

        Returns
        -------
        ProjectedImage
            ``d_params`` (p, 2, n) holds the *estimated* parameters, in their order. NaN for points behind the camera,
            and beyond the reach of a division model.
        """
        u = xyz_cam[:, :2] / np.where(xyz_cam[:, 2] > 0.0, xyz_cam[:, 2], np.nan)[:, None]
        if self.distortion is Distortion.FORWARD:
            camera = self.colmap
            if camera is None:  # pragma: no cover - a forward model is always one of COLMAP's
                raise ValueError("a forward model has no COLMAP camera")
            projection = project_with_jacobians(camera.model, camera.params, xyz_cam)
            xy, d_cam = projection.xy_px, projection.d_xy_d_cam
            all_params = projection.d_xy_d_params
            if all_params is None:  # pragma: no cover - asked for by default
                raise ValueError("no derivatives")
            columns = {"fx": all_params[..., 0], "fy": all_params[..., 1], "cx": all_params[..., 2]}
            columns |= {"cy": all_params[..., 3], "k1": all_params[..., 4], "k2": all_params[..., 5]}
            columns |= {"k3": all_params[..., 8]}
        else:
            xy, d_cam, columns = self._divide(u, xyz_cam[:, 2])
        columns["f"] = columns["fx"] + columns["fy"]
        d_params = np.stack([columns[name] for name in self.estimated], axis=-1)
        return ProjectedImage(
            np.ascontiguousarray(xy.T),
            np.ascontiguousarray(u.T),
            np.ascontiguousarray(pose_jacobian(d_cam, xyz_cam).transpose(2, 1, 0)),
            np.ascontiguousarray(d_params.transpose(2, 1, 0)),
        )

    def undistort(self, xy_px: FloatArray) -> FloatArray:
        """Return the undistorted normalised points (n, 2) of pixels (n, 2); NaN where no ray reaches the pixel."""
        v = (xy_px - np.array(self.principal_point_px)) / np.array(self.focal_px)
        r_distorted = np.hypot(v[:, 0], v[:, 1])
        if self.distortion is Distortion.DIVISION:
            polynomial = _polynomial(self.coefficients, r_distorted)
            rising = polynomial - r_distorted * _slope(self.coefficients, r_distorted) > 0.0
            return np.asarray(v / np.where((polynomial > 0.0) & rising, polynomial, np.nan)[:, None])
        r = _invert(self.coefficients, r_distorted)
        return np.asarray(v / _polynomial(self.coefficients, r)[:, None])

    def _divide(self, u: FloatArray, depth: FloatArray) -> tuple[FloatArray, FloatArray, dict[str, FloatArray]]:
        """Pixels (n, 2), d px / d point (n, 2, 3), and d px / d parameter (n, 2) by name, of the division model."""
        k = self.coefficients
        r_u = np.hypot(u[:, 0], u[:, 1])
        r = _invert_division(k, r_u)
        gain = _polynomial(k, r)  # r = r_u gain
        v = u * gain[:, None]
        # r = r_u p(r): dr = (p dr_u + r_u dp) / (1 - r_u p'), p' = dp/dr
        slack = 1.0 - r_u * _slope(k, r)
        d_r = gain / slack
        direction = np.divide(u, r_u[:, None], out=np.zeros_like(u), where=r_u[:, None] > 0.0)
        focal = np.array(self.focal_px)
        # v = gain u: along the radius d_r, across it gain
        along = direction[:, :, None] * direction[:, None, :]
        d_v_d_u = gain[:, None, None] * (np.eye(2) - along) + d_r[:, None, None] * along
        d_u_d_cam = np.zeros((len(u), 2, 3))
        d_u_d_cam[:, 0, 0] = d_u_d_cam[:, 1, 1] = 1.0 / depth
        d_u_d_cam[:, :, 2] = -u / depth[:, None]
        d_cam = focal[:, None] * (d_v_d_u @ d_u_d_cam)
        zero, one = np.zeros(len(u)), np.ones(len(u))
        columns = {
            "fx": np.column_stack([v[:, 0], zero]),
            "fy": np.column_stack([zero, v[:, 1]]),
            "cx": np.column_stack([one, zero]),
            "cy": np.column_stack([zero, one]),
        }
        for power, name in enumerate(("k1", "k2", "k3"), start=1):
            columns[name] = focal * u * (r ** (2 * power) / slack)[:, None]
        return v * focal + np.array(self.principal_point_px), d_cam, columns


def _polynomial(k: FloatArray, r: FloatArray) -> FloatArray:
    """1 + k1 r^2 + k2 r^4 + k3 r^6."""
    r2 = r * r
    return np.asarray(1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[2])))


def _slope(k: FloatArray, r: FloatArray) -> FloatArray:
    """Its derivative."""
    r2 = r * r
    return np.asarray(r * (2.0 * k[0] + r2 * (4.0 * k[1] + r2 * 6.0 * k[2])))


def _invert(k: FloatArray, r_distorted: FloatArray) -> FloatArray:
    """Solve r p(r) = r_distorted for r before the fold; NaN where there is none."""

    def g(r: FloatArray, target: FloatArray) -> FloatArray:
        return r * _polynomial(k, r) - target

    def slope(r: FloatArray, _: FloatArray) -> FloatArray:
        return _polynomial(k, r) + r * _slope(k, r)

    return _root_before(_forward_fold(k), g, slope, r_distorted)


def _invert_division(k: FloatArray, r_undistorted: FloatArray) -> FloatArray:
    """Solve r = r_undistorted p(r) for r before the fold; NaN where there is none."""

    def g(r: FloatArray, target: FloatArray) -> FloatArray:
        return r - target * _polynomial(k, r)

    def slope(r: FloatArray, target: FloatArray) -> FloatArray:
        return 1.0 - target * _slope(k, r)

    fold = _first_root([1.0, -k[0], -3.0 * k[1], -5.0 * k[2]])  # of d/dr (r / p) = (p - r p') / p^2
    pole = _first_root([1.0, *k])
    return _root_before(min(fold, pole), g, slope, r_undistorted)


def _forward_fold(k: FloatArray) -> float:
    """Radius where d/dr (r p) = 0."""
    return _first_root([1.0, 3.0 * k[0], 5.0 * k[1], 7.0 * k[2]])


def _first_root(coefficients: list[float]) -> float:
    """Smallest r > 0 where a polynomial in r^2, 1 first, lowest power first, is zero; inf without one below 1e6."""
    roots = np.polynomial.polynomial.polyroots(coefficients[::-1])  # in 1 / r^2: the leading coefficient is 1
    real = roots.real[(np.abs(roots.imag) < _REAL * np.abs(roots)) & (roots.real > _FARTHEST**-2)]
    return float(1.0 / np.sqrt(real.max())) if real.size else float(np.inf)


def _root_before(end: float, g: _Function, slope: _Function, target: FloatArray) -> FloatArray:
    """Solve g(r, target) = 0, rising from g <= 0 at 0, for 0 <= r <= end; NaN where it stays below 0."""
    out = target.copy()
    with np.errstate(all="ignore"):  # Newton may leave the domain: such points are bracketed below
        for _ in range(_NEWTON_STEPS):
            out -= g(out, target) / slope(out, target)
        step = g(out, target) / slope(out, target)
        found = (np.abs(step) <= _NEWTON_CHANGE * out) & (out >= 0.0) & (out < end)
    if not found.all():
        out[~found] = _bracketed_root_before(end, g, target[~found])
    return out


def _bracketed_root_before(end: float, g: _Function, target: FloatArray) -> FloatArray:
    """`_root_before` where Newton does not get there: slower, but safe."""
    upper = np.full_like(target, min(end, _FIRST_REACH))
    for _ in range(_MAX_DOUBLINGS):
        short = (g(upper, target) < 0.0) & (upper < end)
        if not short.any():
            break
        upper = np.where(short, np.minimum(2.0 * upper, end), upper)
    reached = g(upper, target) >= 0.0
    if not reached.any():
        return np.full_like(target, np.nan)
    found = find_root(g, (np.zeros_like(target[reached]), upper[reached]), args=(target[reached],))
    out = np.full_like(target, np.nan)
    out[reached] = found.x
    return out
