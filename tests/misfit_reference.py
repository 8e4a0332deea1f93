"""method.md section 5 once more, slowly: dense matrices, numpy's SVD, scipy.stats; and images to try it on."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import stats

from sfm_audit.audit.cameras import project, project_with_jacobians
from sfm_audit.audit.inliers.stationarity import pose_jacobian
from sfm_audit.audit.misfit import candidate_fields, nuisance_columns, project_image
from sfm_audit.audit.misfit.fields import GROUP_COLUMNS
from sfm_audit.loaders.camera_models import BY_NAME
from sfm_audit.loaders.model import CameraRecord

WIDTH, HEIGHT, FOCAL = 1600, 1200, 1000.0
PARAMS = {
    "SIMPLE_PINHOLE": (),
    "PINHOLE": (),
    "SIMPLE_RADIAL": (-0.05,),
    "RADIAL": (-0.05, 0.01),
    "OPENCV": (-0.05, 0.01, 1e-3, -5e-4),
    "OPENCV_FISHEYE": (-0.02, 0.01, -0.004, 0.001),
    "FULL_OPENCV": (-0.05, 0.01, 1e-3, -5e-4, 0.002, 0.01, -0.003, 0.001),
    "FOV": (0.5,),
    "SIMPLE_RADIAL_FISHEYE": (-0.03,),
    "RADIAL_FISHEYE": (-0.03, 0.01),
    "THIN_PRISM_FISHEYE": (-0.03, 0.01, 1e-3, -5e-4, 0.002, -0.001, 5e-4, -3e-4),
    "RAD_TAN_THIN_PRISM_FISHEYE": (-0.03, 0.01, 0.002, -0.001, 5e-4, -1e-4, 1e-3, -5e-4, 5e-4, 1e-4, -3e-4, 1e-4),
    "SIMPLE_DIVISION": (-0.05,),
    "DIVISION": (-0.05,),
    "SIMPLE_FISHEYE": (),
    "FISHEYE": (),
    "EUCM": (0.6, 1.1),
    "BROWN": (-0.05, 0.01, 1e-3, -5e-4, 0.002),
    "SIMPLE_BROWN": (-0.05, 0.01, 1e-3, -5e-4, 0.002),
    "RADIAL_3": (-0.05, 0.01, 0.002),
    "SIMPLE_OPENCV_FISHEYE": (-0.02, 0.01, -0.004, 0.001),
    "DUAL": (-0.05, 0.01, 0.7),
    "FRAME": (-0.05, 0.01, 1e-3, -5e-4, 0.002, -0.001, 0.003, -0.002),
    "INVERSE_RADIAL": (-0.05,),
}
NOISE = {
    "gaussian": lambda rng, n: rng.standard_normal((2, n)),
    "laplace": lambda rng, n: rng.laplace(scale=np.sqrt(0.5), size=(2, n)),
    "t5": lambda rng, n: rng.standard_t(5, size=(2, n)) / np.sqrt(5 / 3),
    "mixture": lambda rng, n: rng.standard_normal((2, n)) * np.exp(0.5 * rng.standard_normal(n) - 0.25),
}


def camera(name="SIMPLE_RADIAL", extra=None, focal=FOCAL):
    """A camera of a model, its principal point at the image centre."""
    model = BY_NAME[name]
    if model.is_spherical:
        return CameraRecord(1, model, WIDTH, HEIGHT, np.array([WIDTH, HEIGHT], dtype=float))
    focals = [focal] * len(model.focal_idxs)
    extra = PARAMS[name] if extra is None else extra
    return CameraRecord(1, model, WIDTH, HEIGHT, np.array([*focals, WIDTH / 2, HEIGHT / 2, *extra]))


def points(rng, n, *, depths=(4.0, 10.0), centre=(0.0, 0.0), spread=1.0):
    """(n, 3) in the camera frame, uniform over (a part of) the image of a pinhole camera."""
    z = rng.uniform(*depths, n)
    half = np.array([WIDTH, HEIGHT]) / (2 * FOCAL)
    xy = half * (np.array(centre) + spread * rng.uniform(-1.0, 1.0, (n, 2)))
    return np.column_stack([xy * z[:, None], z])


def planar_points(rng, n):
    """(n, 3) in the camera frame, on one plane."""
    rays = points(rng, n, depths=(1.0, 1.0))
    return rays * (6.0 / (rays @ np.array([0.2, -0.1, 1.0])))[:, None]


def columns_of(cam, xyz_cam):
    """N and E."""
    projected = project_image(cam, xyz_cam)
    return nuisance_columns(cam.model, projected), candidate_fields(cam, projected)


class Reference(NamedTuple):
    p: float
    px: float
    rank: int


def interleaved(columns):
    """(c, 2, n) -> (2n, c), x and y of a point in neighbouring rows."""
    return columns.transpose(2, 1, 0).reshape(-1, len(columns))


def slow_tests(nuisance, fields, residuals, cluster=None, law="f"):
    """Steps 1 to 4 for (2n, q), (2n, 42), (2n,) matrices; cluster (2n,) of each value."""
    num_values = len(residuals)
    cluster = np.arange(num_values) // 2 if cluster is None else cluster
    _, cluster = np.unique(cluster, return_inverse=True)
    num_clusters = cluster.max() + 1
    norms = np.linalg.norm(nuisance, axis=0)
    left, singular, _ = np.linalg.svd(nuisance[:, norms > 0] / norms[norms > 0], full_matrices=False)
    q = left[:, singular > 1e-9 * singular[0]]
    h = np.minimum((q**2).sum(axis=1), 1 - 1e-9)
    y = residuals - q @ (q.T @ residuals)
    found = {}
    for group, columns in GROUP_COLUMNS.items():
        norms = np.linalg.norm(fields[:, columns], axis=0)
        e = fields[:, columns] / np.where(norms > 0, norms, 1.0)
        largest = np.linalg.svd(e, compute_uv=False)[0]
        e = e - q @ (q.T @ e)
        e = e - q @ (q.T @ e)
        left, singular, _ = np.linalg.svd(e, full_matrices=False)
        u = left[:, singular > 1e-6 * largest]
        rank = u.shape[1]
        s = u.T @ y
        g = np.zeros((num_clusters, rank))
        np.add.at(g, cluster, u * (y / np.sqrt(1 - h))[:, None])
        meat = g.T @ g
        if rank == 0 or num_clusters < 4 * rank:
            found[group] = Reference(np.nan, np.nan, rank)
            continue
        t = s @ np.linalg.solve(meat, s)
        n = num_clusters
        if law == "f":
            p = 0.0 if t >= n else stats.f.sf(t / rank * (n - rank) / n / (1 - t / n), rank, n - rank)
        else:
            p = stats.chi2.sf(t, rank)
        found[group] = Reference(p, np.sqrt(max(0.0, s @ s - np.trace(meat)) / (num_values / 2)), rank)
    return found


def refit(cam, xyz, xy_px, steps=8):
    """Pose and all intrinsics but the principal point fitted to points held fixed; camera, points in its frame."""
    params = cam.params.copy()
    free = [i for i in range(len(params)) if i not in cam.model.principal_point_idxs]
    rotation, translation = np.eye(3), np.zeros(3)
    for _ in range(steps):
        xyz_cam = xyz @ rotation.T + translation
        projection = project_with_jacobians(cam.model, params, xyz_cam)
        pose = pose_jacobian(projection.d_xy_d_cam, xyz_cam)
        jacobian = np.concatenate([pose, projection.d_xy_d_params[:, :, free]], axis=2).reshape(2 * len(xyz), -1)
        norms = np.linalg.norm(jacobian, axis=0)
        step = np.linalg.lstsq(jacobian / norms, (xy_px - projection.xy_px).ravel(), rcond=None)[0] / norms
        turn = np.array([[0, -step[2], step[1]], [step[2], 0, -step[0]], [-step[1], step[0], 0]])
        left, _, right = np.linalg.svd(np.eye(3) + turn)
        rotation, translation = left @ right @ rotation, left @ right @ translation + step[3:6]
        params[free] += step[6:]
    fitted = CameraRecord(cam.camera_id, cam.model, cam.width, cam.height, params)
    return fitted, xyz @ rotation.T + translation


def residuals_of(cam, xyz_cam, xy_px):
    """(2, n) observed minus projected."""
    return (xy_px - project(cam.model, cam.params, xyz_cam)).T
