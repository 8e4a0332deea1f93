"""Models of one camera model each, and their residuals on both paths."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal

from sfm_audit.audit.inliers.residuals import model_residuals
from sfm_audit.audit.kernels import numpy_only
from sfm_audit.loaders.camera_models import BY_NAME
from sfm_audit.loaders.model import CameraTable, ImageTable, ObservationTable, PointTable, SparseModel

PARAMS = (
    {"f": 900.0, "fx": 900.0, "fy": 950.0, "cx": 800.0, "cy": 600.0, "w": 1600.0, "h": 1200.0}
    | {"k": -0.11, "k0": 0.08, "k1": -0.09, "k2": 0.03, "k3": -0.02, "k4": 0.014, "k5": 0.01, "k6": -0.006}
    | {"p0": -0.006, "p1": 0.008, "p2": -0.005, "s0": 0.006, "s1": -0.008, "s2": 0.004, "s3": 0.009, "sx1": 0.007}
    | {"sy1": -0.009, "omega": 0.8, "alpha": 0.6, "beta": 1.2, "transition": 0.6, "b1": 0.01, "b2": -0.02}
)
SIZES = (0, 1, 3, 40, 129, 300)


def model_with(name, seed=0, sizes=SIZES, **changed):
    """Images of one camera model with so many observations each, their points in front of all of them."""
    rng = np.random.default_rng(seed)
    camera, num_images, num = BY_NAME[name], len(sizes), sum(sizes)
    params = np.array([{**PARAMS, **changed}[each] for each in camera.param_names])
    quats = np.column_stack([np.ones(num_images), rng.normal(0.0, 0.05, (num_images, 3))])
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    quats[-1] *= 1.1  # COLMAP does not normalise either
    depth = rng.uniform(2.0, 9.0, num + 1)
    xyz = np.column_stack([rng.uniform(-0.6, 0.6, num + 1) * depth, rng.uniform(-0.5, 0.5, num + 1) * depth, depth])
    xyz[:1] = 0.0, 0.0, 5.0  # on the axis of an image without rotation
    quats[0], offsets = (1.0, 0.0, 0.0, 0.0), np.concatenate([[0], np.cumsum(sizes)])
    cameras = CameraTable(
        np.arange(num_images, dtype=np.uint32),
        np.full(num_images, camera.model_id),
        np.full(num_images, 1600),
        np.full(num_images, 1200),
        np.concatenate([params * (1.0 + 0.001 * i) for i in range(num_images)]),
        np.arange(num_images + 1) * camera.num_params,
    )
    images = ImageTable(
        np.arange(num_images, dtype=np.uint32),
        tuple(f"{i}.jpg" for i in range(num_images)),
        np.arange(num_images, dtype=np.uint32),
        np.arange(num_images),
        quats,
        rng.normal(0.0, 0.1, (num_images, 3)) * np.array([[i > 0] for i in range(num_images)]),
        np.array(sizes),
    )
    points = PointTable(np.arange(num + 1, dtype=np.uint64), xyz, np.full(num + 1, 1.0))
    xy = rng.uniform(0.0, 1.0, (num, 2)) * (1600.0, 1200.0)
    observations = ObservationTable(offsets, np.arange(num), xy, rng.permutation(num + 1)[:num])
    return SparseModel("simulated", "binary", cameras, images, points, observations, ())


def assert_same_on_both_paths(model):
    """Return the residuals of the compiled path."""
    found = model_residuals(model)
    with numpy_only():
        wanted = model_residuals(model)
    for field in ("offsets", "observation_row", "point_idx", "num_dangling", "num_behind", "num_nonfinite"):
        assert_array_equal(getattr(found, field), getattr(wanted, field), err_msg=field)
    assert_array_equal(found.num_unprojected, wanted.num_unprojected)
    assert_allclose(found.residuals_px, wanted.residuals_px, rtol=1e-11, atol=1e-11)
    for image_idx, (ours, theirs) in enumerate(zip(found.d_extra, wanted.d_extra, strict=True)):
        assert ours.shape == theirs.shape
        assert_allclose(ours, theirs, rtol=1e-9, atol=1e-9 * np.abs(theirs).max(initial=1.0))
        rows = found.rows(image_idx)
        scale = np.abs(wanted.point_jacobian[:, :, rows]).max(initial=0.0)
        assert_allclose(
            found.point_jacobian[:, :, rows], wanted.point_jacobian[:, :, rows], rtol=1e-9, atol=1e-9 * scale
        )
    assert_allclose(found.pose_offset_px, wanted.pose_offset_px, rtol=1e-9)
    assert found.residuals_px.flags.c_contiguous
    assert found.point_jacobian.flags.c_contiguous
    return found
