"""Projection and unprojection against pycolmap (outside number), and where the answer is NaN."""

import numpy as np
import pycolmap
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from sfm_audit.audit.cameras import (
    distorted_normalised,
    is_fisheye,
    normalised,
    project,
    project_with_jacobians,
    unproject,
)
from sfm_audit.loaders.camera_models import BY_NAME, CAMERA_MODELS, COLMAP_MODELS, CameraModel

WIDTH, HEIGHT = 1600, 1200
NAMES = [model.name for model in CAMERA_MODELS]
COLMAP_NAMES = [model.name for model in COLMAP_MODELS]
RANGES = {
    **dict.fromkeys(("f", "fx", "fy"), (700.0, 1500.0)),
    **dict.fromkeys(("cx", "cy"), (500.0, 800.0)),
    **dict.fromkeys(("p1", "p2", "p0", "s0", "s1", "s2", "s3", "sx1", "sy1"), (-0.01, 0.01)),
    "omega": (0.3, 1.2),
    "alpha": (0.3, 0.8),
    "beta": (0.7, 1.5),
    "transition": (0.2, 0.9),
    **dict.fromkeys(("b1", "b2"), (-0.01, 0.01)),
    "w": (WIDTH, WIDTH),
    "h": (HEIGHT, HEIGHT),
}
HIGH_ORDER = {"k2": 0.02, "k3": 0.01, "k4": 0.01, "k5": 0.005, "k6": 0.005}
DIVISION = ("SIMPLE_DIVISION", "DIVISION")

ODD_POINTS = np.array(
    [
        *([0, 0, 1.0], [0, 0, -1], [0, 0, 0], [0, 0, 1e-300], [0, 0, np.inf]),
        *([0.3, 0.2, z] for z in (-1, -1e-17, 0, 1e-17, 2.2e-16, 2.220446049250313e-16, 2.3e-16, 1e-3)),
        *([np.nan, 0, 1], [0, np.nan, 1], [0, 0, np.nan], [np.inf, 0, 1], [0, -np.inf, 1], [np.inf, np.inf, np.inf]),
        *([5, 5, 1], [-50, 50, 1], [2, 2, -1], [1e-17, 0, 0], [1e-17, 1e-17, 1e-17], [0, 1, 0], [0, -1, 0]),
        *([1, 0, 0], [-1, 0, 0], [0, 1, -1e-9], [-1e-9, 0, -1], [1e-9, 0, -1]),
    ]
)


def random_params(model: CameraModel, rng: np.random.Generator) -> np.ndarray:
    bounds = [RANGES.get(name, (-HIGH_ORDER.get(name, 0.1), HIGH_ORDER.get(name, 0.1))) for name in model.param_names]
    return np.array([rng.uniform(*bound) for bound in bounds])


def random_points(rng: np.random.Generator, count: int) -> np.ndarray:
    xyz = rng.uniform([-0.7, -0.6, 1.0], [0.7, 0.6, 1.0], (count, 3))
    return xyz * rng.uniform(0.5, 30.0, (count, 1))


def colmap_camera(model: CameraModel, params: np.ndarray) -> pycolmap.Camera:
    return pycolmap.Camera(model=model.name, width=WIDTH, height=HEIGHT, params=params.tolist())


@pytest.mark.parametrize("name", COLMAP_NAMES)
@pytest.mark.parametrize("seed", range(5))
def test_pixels_are_pycolmaps(name, seed):
    rng, model = np.random.default_rng(seed), BY_NAME[name]
    params, xyz = random_params(model, rng), random_points(rng, 500)
    theirs = colmap_camera(model, params).img_from_cam(xyz)
    assert np.isfinite(theirs).mean() > 0.95
    assert_allclose(project(model, params, xyz), theirs, rtol=0, atol=1e-9)
    assert_array_equal(project_with_jacobians(model, params, xyz).xy_px, project(model, params, xyz))


@pytest.mark.parametrize("name", COLMAP_NAMES)
@pytest.mark.parametrize("seed", range(5))
def test_points_without_a_pixel_are_pycolmaps(name, seed):
    rng, model = np.random.default_rng(seed), BY_NAME[name]
    params = random_params(model, rng)
    xyz = np.concatenate([ODD_POINTS, rng.normal(size=(2000, 3))])
    theirs = colmap_camera(model, params).img_from_cam(xyz)
    theirs[~np.isfinite(theirs).all(axis=1)] = np.nan
    ours = project_with_jacobians(model, params, xyz)
    sensible = ~(np.abs(theirs).max(axis=1) > 1e6)
    assert_array_equal(np.isnan(ours.xy_px), np.isnan(theirs))
    assert_allclose(ours.xy_px[sensible], theirs[sensible], rtol=1e-12, atol=1e-9)
    lost = np.isnan(theirs[:, 0])
    assert np.isnan(ours.d_xy_d_cam[lost]).all()
    assert np.isnan(ours.d_xy_d_params[lost]).all()
    at_pole = model.is_spherical & (xyz[:, 0] == 0) & (xyz[:, 2] == 0)
    ordinary = ~lost & sensible & ~at_pole & (np.abs(xyz[:, 2]) > 1e-9) & np.isfinite(xyz).all(axis=1)
    assert np.isfinite(ours.d_xy_d_cam[ordinary]).all()
    assert np.isfinite(ours.d_xy_d_params[ordinary]).all()


@pytest.mark.parametrize("name", DIVISION)
@pytest.mark.parametrize("k", [-0.5, -0.1, 0.0, 0.1, 0.5])
def test_division_projects_behind_the_camera_where_pycolmap_does(name, k):
    model, rng = BY_NAME[name], np.random.default_rng(1)
    params = np.array([1000.0] * (model.num_params - 3) + [800.0, 600.0, k])
    xyz = np.concatenate([ODD_POINTS, rng.normal(size=(2000, 3)) * [1, 1, -1]])
    theirs = colmap_camera(model, params).img_from_cam(xyz)
    theirs[~np.isfinite(theirs).all(axis=1)] = np.nan
    ours = project(model, params, xyz)
    assert_array_equal(np.isnan(ours), np.isnan(theirs))
    away = np.abs(theirs).max(axis=1) < 1e5
    assert_allclose(ours[away], theirs[away], rtol=1e-11)


@pytest.mark.parametrize(("alpha", "beta"), [(0.6, -1.0), (2.0, -1.0), (-0.5, 1.0), (0.0, 1.0), (1.0, 0.0)])
def test_eucm_outside_its_sensible_parameters_sees_what_pycolmap_sees(alpha, beta):
    model, rng = BY_NAME["EUCM"], np.random.default_rng(1)
    params = np.array([1000.0, 900.0, 800.0, 600.0, alpha, beta])
    xyz = np.concatenate([ODD_POINTS, rng.normal(size=(2000, 3))])
    theirs = colmap_camera(model, params).img_from_cam(xyz)
    theirs[~np.isfinite(theirs).all(axis=1)] = np.nan
    ours = project(model, params, xyz)
    assert_array_equal(np.isnan(ours), np.isnan(theirs))
    away = np.abs(theirs).max(axis=1) < 1e5
    assert_allclose(ours[away], theirs[away], rtol=1e-11)


@pytest.mark.parametrize("omega", [0.0, 1e-9, 1e-3, -1e-3, 0.0099, 0.0101, -0.3, 0.9])
def test_fov_is_pycolmaps_on_both_sides_of_its_thresholds(omega):
    model, params = BY_NAME["FOV"], np.array([1000.0, 1100.0, 800.0, 600.0, omega])
    radius = np.concatenate([[0.0], np.geomspace(1e-12, 1.5, 200), [0.00999, 0.01001]])
    xyz = np.column_stack([radius * 0.6, radius * 0.8, np.ones_like(radius)])
    assert_allclose(project(model, params, xyz), colmap_camera(model, params).img_from_cam(xyz), rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", NAMES)
def test_no_points_give_no_rows(name):
    model, rng = BY_NAME[name], np.random.default_rng(0)
    params = random_params(model, rng)
    ours = project_with_jacobians(model, params, np.empty((0, 3)))
    assert ours.xy_px.shape == (0, 2)
    assert ours.d_xy_d_cam.shape == (0, 2, 3)
    assert ours.d_xy_d_params.shape == (0, 2, model.num_params)
    assert unproject(model, params, np.empty((0, 2))).shape == (0, 3)


@pytest.mark.parametrize("name", NAMES)
def test_arguments_are_left_alone_and_layout_does_not_matter(name):
    model, rng = BY_NAME[name], np.random.default_rng(0)
    params = random_params(model, rng)
    xyz = np.concatenate([random_points(rng, 20), ODD_POINTS])
    before = xyz.copy(), params.copy()
    pixels = project(model, params, xyz)
    assert_array_equal(project(model, params, np.asfortranarray(xyz)), pixels)
    xy_before = pixels.copy()
    unproject(model, params, pixels)
    normalised(model, params, xyz)
    distorted_normalised(model, params, xyz)
    assert_array_equal(xyz, before[0])
    assert_array_equal(params, before[1])
    assert_array_equal(pixels, xy_before)


def test_wrong_shapes_are_refused():
    model = BY_NAME["PINHOLE"]
    with pytest.raises(ValueError, match="PINHOLE has 4 parameters"):
        project(model, np.ones(3), np.ones((5, 3)))
    with pytest.raises(ValueError, match=r"shape \(n, 3\), got \(3,\)"):
        project_with_jacobians(model, np.ones(4), np.ones(3))
    with pytest.raises(ValueError, match=r"shape \(n, 2\), got \(5, 3\)"):
        unproject(model, np.ones(4), np.ones((5, 3)))


@pytest.mark.parametrize("name", NAMES)
def test_normalised_points_before_and_after_the_distortion(name):
    model, rng = BY_NAME[name], np.random.default_rng(2)
    params, xyz = random_params(model, rng), np.concatenate([random_points(rng, 50), [[0, 0, 1], [1, 1, -1]]])
    u, v = normalised(model, params, xyz), distorted_normalised(model, params, xyz)
    if model.is_spherical:
        assert np.isnan(u).all()
        assert np.isnan(v).all()
        return
    rho = np.hypot(xyz[:, 0], xyz[:, 1])
    wanted = xyz[:, :2] / xyz[:, 2:]
    if is_fisheye(model):
        wanted[rho > 0] = (xyz[:, :2] * (np.arctan2(rho, xyz[:, 2])[:, None]))[rho > 0] / rho[rho > 0, None]
    assert_allclose(u[:-1], wanted[:-1], rtol=1e-13)
    assert np.isnan(u[-1]).all()
    focals, centre = params[[*model.focal_idxs] * (2 // len(model.focal_idxs))], params[[*model.principal_point_idxs]]
    assert_allclose(v * focals + centre, project(model, params, xyz), rtol=1e-13)


def test_fisheye_models_are_the_seven_of_colmap():
    fisheye = {model.name for model in COLMAP_MODELS if is_fisheye(model)}
    radial = {"SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE", "SIMPLE_FISHEYE", "FISHEYE"}
    assert fisheye == radial | {"THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE"}


@pytest.mark.parametrize("name", COLMAP_NAMES)
@pytest.mark.parametrize("seed", range(3))
def test_rays_of_pixels_are_pycolmaps_and_project_back(name, seed):
    rng, model = np.random.default_rng(seed), BY_NAME[name]
    params = random_params(model, rng)
    xy_px = np.concatenate([rng.uniform([0, 0], [WIDTH, HEIGHT], (300, 2)), project(model, params, np.eye(3)[2:])])
    rays = unproject(model, params, xy_px)
    found = np.isfinite(rays).all(axis=1)
    assert found.mean() > 0.9
    assert_array_equal(found, ~np.isnan(rays).any(axis=1))
    assert_allclose(np.linalg.norm(rays[found], axis=1), 1.0, rtol=1e-14)
    assert_allclose(project(model, params, rays[found]), xy_px[found], rtol=0, atol=1e-8)
    camera = colmap_camera(model, params)
    theirs = np.array([ray if (ray := camera.cam_ray_from_img(xy)) is not None else [np.nan] * 3 for xy in xy_px])
    both = found & np.isfinite(theirs).all(axis=1)
    assert both.mean() > 0.9
    assert_allclose(rays[both], theirs[both], atol=2e-8)


NO_RAY = [
    ("SIMPLE_RADIAL", [1000, 0, 0, -0.3], [710.0, 0.0], [700.0, 0.0]),  # folds at r = 1.054, 702.7 px
    ("SIMPLE_RADIAL", [1000, 0, 0, -0.3], [-5000.0, 100.0], [0.0, -700.0]),
    ("RADIAL_FISHEYE", [1000, 0, 0, -0.3, 0.0], [710.0, 0.0], [700.0, 0.0]),
    ("SIMPLE_FISHEYE", [1000, 0, 0], [1571.0, 0.0], [1570.0, 0.0]),  # theta = 90 degrees
    ("RADIAL", [1000, 0, 0, -0.5, 0.05], [580.0, 0.0], [565.0, 0.0]),  # folds at 566 px, and unfolds farther out
    ("RADIAL", [1000, 0, 0, 0.5, -0.2], [1700.0, 0.0], [1690.0, 0.0]),  # folds at 1697 px, at r = 1.414
    ("RADIAL", [1000, 0, 0, 0.5, -0.2], [-1800.0, 0.0], [0.0, -1420.0]),
    ("SIMPLE_FISHEYE", [1000, 0, 0], [5000.0, 0.0], [0.0, -1500.0]),
    ("FOV", [1000, 1000, 0, 0, 1.0], [1571.0, 0.0], [1570.0, 0.0]),  # reaches pi / (2 omega)
    ("SIMPLE_DIVISION", [1000, 0, 0, 1.0], [1001.0, 0.0], [999.0, 0.0]),  # rim at 1 / sqrt(k)
    ("SIMPLE_DIVISION", [1000, 0, 0, -1.0], [1001.0, 0.0], [999.0, 0.0]),  # 90 degrees at 1 / sqrt(-k)
    ("EUCM", [1000, 1000, 0, 0, 0.5, 1.0], [2001.0, 0.0], [1999.0, 0.0]),  # 90 degrees at 1 / (alpha sqrt(beta))
    ("EQUIRECTANGULAR", [1600, 800], [1600.5, 400.0], [1599.5, 400.0]),
    ("EQUIRECTANGULAR", [1600, 800], [800.0, -0.5], [800.0, 0.5]),
    ("PINHOLE", [1000, 1000, 0, 0], [np.inf, 0.0], [1e9, 0.0]),
]


@pytest.mark.parametrize(("name", "params", "lost", "kept"), NO_RAY)
def test_pixels_that_no_point_projects_to_have_no_ray(name, params, lost, kept):
    model = BY_NAME[name]
    rays = unproject(model, np.array(params, dtype=float), np.array([lost, kept, [np.nan, 0.0]]))
    assert np.isnan(rays[[0, 2]]).all()
    assert_allclose(project(model, np.array(params, dtype=float), rays[1:2]), [kept], rtol=1e-8)


@pytest.mark.parametrize(("k1", "k2"), [(-0.3, 0.0), (-0.97, 0.4155), (-0.4, 0.05), (0.5, -0.2), (-0.9, 0.3)])
def test_rays_stay_on_the_axis_side_of_a_fold(k1, k2):
    turning = np.roots([5 * k2, 3 * k1, 1.0])
    fold = np.sqrt(min(turning.real[(turning.imag == 0) & (turning.real > 0)]))
    radius = np.linspace(0.0, 0.999, 300) * fold
    reached = radius * (1 + k1 * radius**2 + k2 * radius**4)
    beyond = fold * (1 + k1 * fold**2 + k2 * fold**4) * np.linspace(1.001, 4.0, 300)
    xy_px = np.outer(np.concatenate([reached, beyond]), [600.0, 800.0])
    rays = unproject(BY_NAME["RADIAL"], np.array([1000.0, 0.0, 0.0, k1, k2]), xy_px)
    assert_allclose(np.hypot(rays[:300, 0], rays[:300, 1]) / rays[:300, 2], radius, rtol=1e-8, atol=1e-12)
    assert np.isnan(rays[300:]).all()
