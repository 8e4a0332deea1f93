"""What the image's own fit could have absorbed (method.md section 5's N)."""

from __future__ import annotations

from functools import cache

import numpy as np

from sfm_audit.audit.inliers.projected import ProjectedImage
from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.loaders.camera_models import CameraModel


@cache
def fitted_param_idxs(model: CameraModel) -> tuple[int, ...]:
    """Return the parameters that COLMAP refines by default: all but the principal point (spherical models: none)."""
    if model.is_spherical:
        return ()
    return tuple(i for i in range(model.num_params) if i not in model.principal_point_idxs)


def nuisance_columns(
    model: CameraModel, projected: ProjectedImage, param_idxs: tuple[int, ...] | None = None
) -> FloatArray:
    """Return N, (6 + k, 2, n): the Jacobian in what was fitted to this image, 6 columns of the pose first.

    Parameters
    ----------
    param_idxs : the k parameters that were fitted; `fitted_param_idxs` by default. An estimator that fitted others
        must say so: a parameter fitted but left out makes the test liberal, one put in but never fitted hides misfit.

    Notes
    -----
    Columns that are zero (skewless models have none, a parameter without effect has) stay in; the test drops them.
    """
    chosen = fitted_param_idxs(model) if param_idxs is None else param_idxs
    return np.concatenate([projected.pose, projected.d_params[list(chosen)]])
