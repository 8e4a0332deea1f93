"""If some images were wrong, where would the points be without them? (method.md section 5, whose fault).

Points are triangulated again from the remaining images, and these images are refitted, in the linear model of the
Jacobians at hand: minimise |eps - J dX - Q c|^2 over point steps dX and image steps c. Eliminating the points leaves a
system in c whose product with a vector is one sweep over the observations (to the points and back); conjugate
gradients accelerate the alternation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sfm_audit.audit.inliers.residuals import ModelResiduals
from sfm_audit.audit.noise.tracks import inverse_information, sum_by_point, symmetric_times
from sfm_audit.loaders.arrays import BoolArray, FloatArray, IntArray

_RELATIVE_RESIDUAL = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class _System:
    """The observations that take part, sorted by image.

    jacobian: (2, 3, m).  point_row: (m,) rows of the points that move.  basis: (m, 2, q) rows of each image's
    orthonormal nuisance basis, zero-padded.  image_start: (k,) first observation of each image.  image_row: (m,).
    inverse: (6, p) inverse information of the points that move.
    """

    jacobian: FloatArray
    point_row: IntArray
    basis: FloatArray
    image_start: IntArray
    image_row: IntArray
    inverse: FloatArray

    def point_step(self, residuals: FloatArray) -> FloatArray:
        """A^-1 J^T r: (2, m) -> (3, p)."""
        gradient = np.empty((3, self.inverse.shape[1]))
        for axis in range(3):
            product = self.jacobian[0, axis] * residuals[0] + self.jacobian[1, axis] * residuals[1]
            gradient[axis] = sum_by_point(product, self.point_row, self.inverse.shape[1])
        return symmetric_times(self.inverse, gradient)

    def moved(self, point_step: FloatArray) -> FloatArray:
        """J dX: (3, p) -> (2, m)."""
        return displacement(self.jacobian, point_step.take(self.point_row, axis=1))

    def from_images(self, image_step: FloatArray) -> FloatArray:
        """Q c: (k, q) -> (2, m)."""
        return np.asarray(np.einsum("mkq,mq->km", self.basis, image_step[self.image_row]))

    def to_images(self, residuals: FloatArray) -> FloatArray:
        """Q^T r: (2, m) -> (k, q)."""
        product = self.basis[:, 0] * residuals[0][:, None] + self.basis[:, 1] * residuals[1][:, None]
        return np.add.reduceat(product, self.image_start, axis=0)

    def times(self, image_step: FloatArray) -> FloatArray:
        """(I - Q^T J A^-1 J^T Q) c: one sweep to the points and back."""
        return image_step - self.to_images(self.moved(self.point_step(self.from_images(image_step))))


def displacement(jacobian: FloatArray, step: FloatArray) -> FloatArray:
    """J dX per observation: (2, 3, m) and (3, m) -> (2, m) px."""
    return np.stack([(jacobian[row] * step).sum(axis=0) for row in range(2)])


def refit_points(
    residuals: ModelResiduals,
    kept: BoolArray,
    moving: BoolArray,
    basis_of: Callable[[int, IntArray], FloatArray],
    max_sweeps: int,
) -> FloatArray:
    """Return the residuals (2, n) of all inliers after the points that lost an image were triangulated again.

    Parameters
    ----------
    residuals : of the model as it stands, px
    kept : (I,) images that keep their say        moving : (P,) points that may move; all others stay
    basis_of : gives, for a kept image and the m of its n_i inliers that see moving points, these (q_i, 2, m) of an
        orthonormal basis (q_i, 2, n_i) of the columns of its own fitted parameters over all its inliers
    max_sweeps : bound on the sweeps over the observations

    Notes
    -----
    Images that are not kept are not refitted; their residuals change with the points alone. Only the change is solved
    for: a gradient that the images had before is left, the score test projects it out.
    """
    image_idx = np.repeat(np.arange(len(kept)), np.diff(residuals.offsets))
    touched = moving[residuals.point_idx]
    rows = np.flatnonzero(touched & kept[image_idx])
    if not rows.size:
        return residuals.residuals_px
    row_of_point = np.cumsum(moving) - 1
    system = _build(residuals, rows, image_idx[rows], row_of_point, basis_of)
    eps = residuals.residuals_px.take(rows, axis=1)
    first_step = system.point_step(eps)
    image_step = _conjugate_gradients(system, -system.to_images(system.moved(first_step)), max_sweeps)
    step = first_step - system.point_step(system.from_images(image_step))
    out = residuals.residuals_px.copy()
    affected = np.flatnonzero(touched)
    out[:, affected] -= displacement(
        residuals.point_jacobian.take(affected, axis=2), step.take(row_of_point[residuals.point_idx[affected]], axis=1)
    )
    return out


def _build(
    residuals: ModelResiduals,
    rows: IntArray,
    image_idx: IntArray,
    row_of_point: IntArray,
    basis_of: Callable[[int, IntArray], FloatArray],
) -> _System:
    images, image_start, image_row = np.unique(image_idx, return_index=True, return_inverse=True)
    parts = []
    for start, stop, i in zip(image_start, [*image_start[1:], rows.size], images, strict=True):
        parts.append(basis_of(int(i), rows[start:stop] - residuals.offsets[i]))
    basis = np.zeros((rows.size, 2, max(len(part) for part in parts)))
    for start, part in zip(image_start, parts, strict=True):
        basis[start : start + part.shape[2], :, : len(part)] = part.transpose(2, 1, 0)
    jacobian = residuals.point_jacobian.take(rows, axis=2)
    point_row = row_of_point[residuals.point_idx[rows]]
    inverse, _ = inverse_information(jacobian, point_row, int(row_of_point[-1]) + 1)
    return _System(jacobian, point_row, basis, image_start, image_row, inverse)


def _conjugate_gradients(system: _System, right: FloatArray, max_sweeps: int) -> FloatArray:
    """Solve S c = right; S is positive semi-definite, the gauge is in its null space and in no right side."""
    solution = np.zeros_like(right)
    residual = right.copy()
    direction = residual.copy()
    energy = first = float((residual * residual).sum())
    for _ in range(max_sweeps):
        if energy <= _RELATIVE_RESIDUAL**2 * first or energy == 0.0:
            break
        product = system.times(direction)
        curvature = float((direction * product).sum())
        if curvature <= 0.0:
            break
        rate = energy / curvature
        solution += rate * direction
        residual -= rate * product
        previous, energy = energy, float((residual * residual).sum())
        direction = residual + energy / previous * direction
    return solution
