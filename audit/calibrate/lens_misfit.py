"""Is the lens of an estimate wrong? The score test for 3D points that were measured, with noise of their own."""

from __future__ import annotations

from typing import Final

import numpy as np

from sfm_audit.audit.calibrate.estimate import Estimate
from sfm_audit.audit.calibrate.lidar import lidar_predictors
from sfm_audit.audit.misfit import MisfitTests, candidate_fields, coincident_keypoints, prepare
from sfm_audit.audit.misfit.fields import GROUP_COLUMNS
from sfm_audit.audit.noise.standardise import ImageNoise
from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.loaders.correspondences.records import Correspondences

_SHORTEST: Final = 0.03  # of a field's length: what must be left of it off N where the noise of the points is unknown
_SPAN: Final = 1e-9  # of the largest singular value of unit columns, as in method.md section 5, step 1


def misfit_tests(estimate: Estimate, correspondences: Correspondences, lidar: ImageNoise | None = None) -> MisfitTests:
    """Run the score tests of method.md section 5 on the inliers, N being what the estimator estimated.

    Parameters
    ----------
    lidar : the noise model of that name, where the points have it

    Notes
    -----
    H0, assumptions and blind spots: `audit.misfit.prepare`. The noise of a measured point is in the columns of N and E
    and in the residual, and correlates them as if the fields were functions of the observed point. That does not matter
    where a field is far from the span of N; on a plane many are in it but for the noise. *Measured* with correct
    cameras (boards, lidar noise 0.03 px): smooth rejects 67 % at 5 %, affine 11 %.

    With the noise model lidar the columns are therefore those of the points that one expects, given the residual
    (`expected_points`): what is left of their noise does not depend on the residual. *Measured:* 4.4 .. 5.6 % in all
    groups. Where sd_f / f > 1 % (boards tilted by less than 2 to 4 degrees) N itself is mostly noise, and affine still
    rejects 31 %: there the focal length is not identified, and the estimate undetermined. Without lidar the points may
    be exact or not, and directions of a group of which N leaves less than 3 % are taken as absorbed: 3.5 .. 5.6 %.
    """
    kept = estimate.inliers
    points = estimate.xyz_cam(correspondences.xyz_world[kept])
    known = lidar if lidar is not None and lidar.converged else None
    if known is not None:
        points = expected_points(estimate, correspondences, known)
    projected = estimate.camera.project(points)
    nuisance = np.concatenate([projected.pose, projected.d_params])
    fields = candidate_fields(estimate.camera.pinhole, projected)
    prepared = prepare(
        nuisance,
        fields if known is not None else _far_from_nuisance(nuisance, fields),
        clusters=coincident_keypoints(correspondences.xy_px[kept]),
    )
    return prepared.test(np.ascontiguousarray(estimate.residuals_px[kept].T))


def expected_points(estimate: Estimate, correspondences: Correspondences, lidar: ImageNoise) -> FloatArray:
    """Return where the inliers' points (n, 3) are expected, camera frame, given their residuals.

    Notes
    -----
    Of a residual with variance theta_1 + a^2 theta_2 (method.md section 2, (1)) the share w = a^2 theta_2 / variance is
    the lidar's, so the point's image is expected at predicted + w eps, by axis. If (1) holds, its error there is
    independent of eps. The point is moved at right angles to the ray, as far as that takes; a point whose neighbour has
    no image stays.
    """
    kept = estimate.inliers
    variance_of_lidar = lidar.sigma_l**2 * lidar_predictors(estimate, correspondences)[kept] ** 2
    share = variance_of_lidar / (lidar.sigma_d_px**2 + variance_of_lidar)
    shift_px = np.where(np.isfinite(share), share * estimate.residuals_px[kept], 0.0)
    points = estimate.xyz_cam(correspondences.xyz_world[kept])
    jacobian = estimate.camera.project(points).pose[3:].transpose(2, 1, 0)  # d px / d point, (n, 2, 3)
    transposed = jacobian.transpose(0, 2, 1)
    return np.asarray(points + (transposed @ np.linalg.solve(jacobian @ transposed, shift_px[:, :, None]))[:, :, 0])


def _far_from_nuisance(nuisance: FloatArray, fields: FloatArray) -> FloatArray:
    """Keep of every group of fields (c, 2, n) the directions of which N leaves enough; the rest is 0."""
    n = fields.shape[2]
    columns = nuisance.reshape(len(nuisance), -1)
    length = np.linalg.norm(columns, axis=1)
    if not np.isfinite(length).all() or not np.isfinite(fields).all():
        return fields  # the test says why it refuses
    used = length > 0.0
    span, singular, _ = np.linalg.svd((columns[used] / length[used, None]).T, full_matrices=False)
    basis = span[:, singular > _SPAN * singular[0]]
    out = np.zeros_like(fields)
    for group in GROUP_COLUMNS.values():
        own = fields[group].reshape(group.stop - group.start, -1)
        own_length = np.linalg.norm(own, axis=1)
        unit = own / np.where(own_length > 0.0, own_length, 1.0)[:, None]
        weights, off, _ = np.linalg.svd(unit - (unit @ basis) @ basis.T, full_matrices=False)
        kept = weights[:, off > _SHORTEST].T @ unit
        out[group.start : group.start + len(kept)] = kept.reshape(-1, 2, n)
    return out
