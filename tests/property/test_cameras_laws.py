"""Laws that hold for every camera model, whatever its parameters and wherever the points are."""

import numpy as np
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from sfm_audit.audit.cameras import normalised, project, project_with_jacobians, unproject
from sfm_audit.loaders.camera_models import CAMERA_MODELS, CameraModel

SPHERICAL = tuple(model for model in CAMERA_MODELS if model.is_spherical)
PERSPECTIVE = tuple(model for model in CAMERA_MODELS if not model.is_spherical)
LAW = settings(deadline=None)  # shared machines stall
BOUNDS = {
    **dict.fromkeys(("f", "fx", "fy", "w", "h"), (100.0, 4000.0)),
    **dict.fromkeys(("cx", "cy"), (0.0, 2000.0)),
    "omega": (-1.5, 1.5),
    "alpha": (0.0, 1.0),
    "beta": (0.1, 3.0),
}


@st.composite
def cameras(draw, models=CAMERA_MODELS, strength=0.1) -> tuple[CameraModel, np.ndarray]:
    model = draw(st.sampled_from(models))
    bounds = [BOUNDS.get(name, (-strength, strength)) for name in model.param_names]
    return model, np.array([draw(st.floats(*bound, allow_subnormal=False)) for bound in bounds])


def points(low: float = -1.0) -> st.SearchStrategy[np.ndarray]:
    across = st.floats(-1.0, 1.0, allow_subnormal=False)
    return st.lists(st.tuples(across, across, st.floats(low, 1.0)), min_size=1, max_size=8).map(np.array)


@LAW
@given(camera=cameras(), xyz=points(0.1), gain=st.floats(1e-3, 1e3))
def test_depth_does_not_matter(camera, xyz, gain):
    near, far = (project_with_jacobians(*camera, s * xyz) for s in (1.0, gain))
    scale = 1.0 + np.nanmax(np.abs(near.xy_px), initial=0.0)
    assume(scale < 1e7)
    slack = 1e-9 * scale
    assert_allclose(far.xy_px, near.xy_px, rtol=0, atol=slack)


@LAW
@given(camera=cameras(), xyz=points(0.1))
def test_moving_along_the_ray_moves_nothing(camera, xyz):
    ours = project_with_jacobians(*camera, xyz)
    d_cam = ours.d_xy_d_cam[np.isfinite(ours.d_xy_d_cam).all(axis=(1, 2))]
    along = np.einsum("nij,nj->ni", d_cam, xyz[np.isfinite(ours.d_xy_d_cam).all(axis=(1, 2))])
    assert_allclose(along, 0.0, atol=1e-11 * (1.0 + np.abs(d_cam).max(initial=0.0)))


@LAW
@given(camera=cameras(), xyz=points(), gain=st.sampled_from([0.25, 2.0, 8.0]))
def test_resolution_scales_pixels_and_their_derivatives(camera, xyz, gain):
    model, params = camera
    scaled = params.copy()
    pixel_idxs = [*range(model.num_params)] if model.is_spherical else [*model.focal_idxs, *model.principal_point_idxs]
    scaled[pixel_idxs] *= gain
    small, large = project_with_jacobians(model, params, xyz), project_with_jacobians(model, scaled, xyz)
    assert_allclose(large.xy_px, gain * small.xy_px, rtol=1e-12, atol=1e-250)
    assert_allclose(large.d_xy_d_cam, gain * small.d_xy_d_cam, rtol=1e-12, atol=1e-250)
    extra = [*model.extra_idxs]
    assert_allclose(large.d_xy_d_params[..., extra], gain * small.d_xy_d_params[..., extra], rtol=1e-12, atol=1e-250)


@LAW
@given(camera=cameras(), xyz=points(), more=points())
def test_a_point_does_not_see_its_neighbours(camera, xyz, more):
    alone, together = (project_with_jacobians(*camera, rows) for rows in (xyz, np.concatenate([xyz, more])))
    for name in ("xy_px", "d_xy_d_cam", "d_xy_d_params"):
        assert_allclose(getattr(together, name)[: len(xyz)], getattr(alone, name), rtol=1e-12, atol=1e-250)


@LAW
@given(camera=cameras(strength=0.01), xyz=points(0.9))
def test_there_and_back(camera, xyz):
    model, params = camera
    pixels = project(model, params, xyz)
    rays = unproject(model, params, pixels)
    found = np.isfinite(rays).all(axis=1)
    assert_allclose(project(model, params, rays[found]), pixels[found], rtol=1e-8, atol=1e-7)
    if model.name not in {"FULL_OPENCV", "FOV", "EUCM", "RAD_TAN_THIN_PRISM_FISHEYE"}:  # these fold within reach
        assert found.all()
        assert_allclose(rays, xyz / np.linalg.norm(xyz, axis=1, keepdims=True), atol=1e-6)


@LAW
@given(camera=cameras(SPHERICAL), xyz=points())
def test_a_panorama_sees_everything(camera, xyz):
    assume((np.linalg.norm(xyz, axis=1) > 1e-9).all())
    assert_allclose(unproject(*camera, project(*camera, xyz)), xyz / np.linalg.norm(xyz, axis=1)[:, None], atol=1e-7)


@LAW
@given(camera=cameras(PERSPECTIVE), xyz=points())
def test_normalised_points_exist_in_front_of_the_camera(camera, xyz):
    front = xyz[:, 2] >= np.finfo(float).eps
    assert_allclose(np.isnan(normalised(*camera, xyz)).any(axis=1), ~front)
