"""Points triangulated again without some images: against one dense least-squares problem."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from sfm_audit.audit.inliers.residuals import ModelResiduals
from sfm_audit.audit.misfit.basis import nuisance_basis, unit_columns
from sfm_audit.audit.misfit.refit import refit_points


def random_problem(rng, num_images=6, num_points=40, share=0.7):
    """Images that see random points through random Jacobians; residuals at the joint optimum of points and images."""
    seen = [np.flatnonzero(rng.random(num_points) < share) for _ in range(num_images)]
    offsets = np.concatenate([[0], np.cumsum([s.size for s in seen])]).astype(np.int64)
    point_idx = np.concatenate(seen).astype(np.int64)
    n = point_idx.size
    jacobian = rng.normal(size=(2, 3, n)) * 50
    nuisance = [rng.normal(size=(4, 2, s.size)) for s in seen]
    eps = rng.normal(size=(2, n))
    columns = dense_columns(jacobian, point_idx, num_points, nuisance, offsets, np.ones(num_images, dtype=bool))
    eps = (eps.reshape(-1) - columns @ np.linalg.lstsq(columns, eps.reshape(-1), rcond=None)[0]).reshape(2, n)
    zero = np.zeros(num_images, dtype=np.int64)
    residuals = ModelResiduals(offsets, np.arange(n), point_idx, eps, jacobian, np.zeros(num_images), zero, zero, zero)
    return residuals, nuisance, num_points


def dense_columns(jacobian, point_idx, num_points, nuisance, offsets, kept):
    """All columns of points and kept images, (2 n, ...)."""
    n = point_idx.size
    points = np.zeros((2, n, 3 * num_points))
    for axis in range(3):
        points[:, np.arange(n), 3 * point_idx + axis] = jacobian[:, axis]
    blocks = [points.reshape(2 * n, -1)]
    for i in np.flatnonzero(kept):
        block = np.zeros((2, n, len(nuisance[i])))
        block[:, offsets[i] : offsets[i + 1]] = nuisance[i].transpose(1, 2, 0)
        blocks.append(block.reshape(2 * n, -1))
    return np.hstack(blocks)


@pytest.mark.parametrize("seed", range(4))
def test_equals_one_dense_least_squares_problem(seed):
    rng = np.random.default_rng(seed)
    residuals, nuisance, num_points = random_problem(rng)
    kept = np.array([True, False, True, True, True, False])
    has_say = kept[np.repeat(np.arange(6), np.diff(residuals.offsets))]

    def basis_of(i, rows):
        basis = nuisance_basis(unit_columns(nuisance[i].reshape(4, -1)))
        return basis.reshape(len(basis), 2, -1)[:, :, rows]

    found = refit_points(residuals, kept, np.ones(num_points, dtype=bool), basis_of, 500)
    columns = dense_columns(
        residuals.point_jacobian, residuals.point_idx, num_points, nuisance, residuals.offsets, kept
    )
    rows = np.tile(has_say, 2)
    solution = np.linalg.lstsq(columns[rows], residuals.residuals_px.reshape(-1)[rows], rcond=None)[0]
    views = np.bincount(residuals.point_idx[has_say], minlength=num_points)
    fixed = (views >= 2)[residuals.point_idx]  # points of fewer views are not determined, and not tested
    moved = columns[:, : 3 * num_points] @ solution[: 3 * num_points]
    expected = residuals.residuals_px - moved.reshape(2, -1)
    for i in np.flatnonzero(kept):  # equal up to what the image's own parameters explain
        own = residuals.rows(int(i))
        basis = basis_of(int(i), slice(None)).reshape(-1, 2 * (own.stop - own.start))
        both = [(r[:, own]).reshape(-1) for r in (found, expected)]
        one, other = ((r - basis.T @ (basis @ r)).reshape(2, -1)[:, fixed[own]] for r in both)
        assert_allclose(one, other, atol=2e-4)
    assert np.abs(found - residuals.residuals_px).max() > 0.1


def test_points_that_lost_no_image_stay():
    residuals, nuisance, num_points = random_problem(np.random.default_rng(9))
    moving = np.zeros(num_points, dtype=bool)
    moving[3] = True
    kept = np.array([True, True, False, True, True, True])

    def basis_of(i, rows):
        return nuisance_basis(unit_columns(nuisance[i].reshape(4, -1))).reshape(4, 2, -1)[:, :, rows]

    found = refit_points(residuals, kept, moving, basis_of, 40)
    changed = (found != residuals.residuals_px).any(axis=0)
    assert (residuals.point_idx[changed] == 3).all()
    assert changed.any()
