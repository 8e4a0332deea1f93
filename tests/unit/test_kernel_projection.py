"""The compiled projection of a whole model is that of numpy, image by image: every camera model, odd numbers, gaps."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest
from kernel_samples import assert_same_on_both_paths, model_with
from numpy.testing import assert_allclose, assert_array_equal
from scipy.special import hyp2f1

from sfm_audit.audit.inliers import kept
from sfm_audit.audit.inliers.distortion import Projectable
from sfm_audit.audit.inliers.residuals import image_residuals, model_residuals
from sfm_audit.audit.inliers.stationarity import offset_px, offsets_of_sums
from sfm_audit.audit.kernels import kernels_in_use, numpy_only
from sfm_audit.audit.kernels.projection import LENSES, distortion_derivatives, project_scene
from sfm_audit.loaders.camera_models import CAMERA_MODELS
from sfm_audit.loaders.model import PointTable

pytestmark = pytest.mark.skipif(not kernels_in_use(), reason="no compiled kernels here")
NAMES = [model.name for model in CAMERA_MODELS]


@pytest.mark.parametrize("name", NAMES)
def test_every_camera_model(name):
    model = model_with(name)
    assert_same_on_both_paths(model)
    done = project_scene(kept.scene_of(model)).done
    assert_array_equal(done, name in LENSES)


def test_all_perspective_and_fisheye_models_of_colmap_are_compiled():
    spherical = {model.name for model in CAMERA_MODELS if model.is_spherical}
    assert {model.name for model in CAMERA_MODELS if model.is_colmap} - spherical <= set(LENSES)


@pytest.mark.parametrize("omega", [1e-3, 0.02, -0.8, 1.4])
def test_each_branch_of_fov(omega):
    assert_same_on_both_paths(model_with("FOV", omega=omega))


@pytest.mark.parametrize("name", ["SIMPLE_RADIAL", "OPENCV_FISHEYE", "DIVISION", "EUCM"])
def test_observations_that_are_no_inliers_leave_no_gap(name):
    model = model_with(name, sizes=(20, 300, 0, 140, 33))
    xyz, point_idx, xy = (
        model.points.xyz_world.copy(),
        model.observations.point_idx.copy(),
        model.observations.xy_px.copy(),
    )
    point_idx[[0, 21, 22, 200, 492]] = -1
    xyz[point_idx[[3, 150, 400]]] *= -1.0  # behind
    xyz[point_idx[[40, 401]]] = [[np.nan, 0.0, 1.0], [1e13, 0.0, 1.0]]
    xy[[41, 402]] = [[np.inf, 0.0], [0.0, np.nan]]
    model = replace(
        model,
        points=replace(model.points, xyz_world=xyz),
        observations=replace(model.observations, point_idx=point_idx, xy_px=xy),
    )
    found = assert_same_on_both_paths(model)
    assert found.num_dangling.sum() == 5
    assert found.num_behind.sum() == 3
    assert found.num_nonfinite.sum() == 4
    assert project_scene(kept.scene_of(model)).done.all()


@pytest.mark.parametrize(
    ("z", "xy"), [(1e-17, 1.0), (1e-12, 1e-12), (1.0, 1e11), (1e12, 1e-3), (1e-9, 1e12), (5e-324, 0.0)]
)
@pytest.mark.parametrize("name", ["SIMPLE_RADIAL", "FULL_OPENCV", "RAD_TAN_THIN_PRISM_FISHEYE", "DIVISION", "EUCM"])
def test_extreme_points_are_numpy_s(name, z, xy):
    model = model_with(name, sizes=(9, 9, 140))
    xyz = model.points.xyz_world.copy()
    images = replace(
        model.images,
        quat_cam_from_world_wxyz=np.tile([1.0, 0.0, 0.0, 0.0], (3, 1)),
        translation_cam_from_world=np.zeros((3, 3)),
    )
    xyz[model.observations.point_idx[[4, 20]]] = xy, -xy, z
    assert_same_on_both_paths(replace(model, images=images, points=replace(model.points, xyz_world=xyz)))


@pytest.mark.parametrize("value", [np.nan, np.inf, 0.0, 1e100, -900.0])
def test_odd_cameras_and_poses_are_numpy_s(value):
    model = model_with("OPENCV", sizes=(30, 30, 30))
    params, translation = model.cameras.params.copy(), model.images.translation_cam_from_world.copy()
    params[0], translation[1, 0] = value, value
    model = replace(
        model,
        cameras=replace(model.cameras, params=params),
        images=replace(model.images, translation_cam_from_world=translation, camera_idx=np.array([0, 1, -1])),
    )
    assert_same_on_both_paths(model)


def test_a_model_of_nothing():
    model = model_with("PINHOLE", sizes=(0, 0))
    assert_same_on_both_paths(model)
    assert_same_on_both_paths(replace(model, points=PointTable(np.empty(0, np.uint64), np.empty((0, 3)), np.empty(0))))


def test_a_pose_that_few_points_do_not_fix_is_asked_in_numpy():
    model = model_with("RADIAL", sizes=(1, 2, 2, 50))
    found = assert_same_on_both_paths(model)
    assert np.isfinite(found.pose_offset_px).all()


@pytest.mark.parametrize(
    ("table", "field", "value"),
    [
        ("observations", "point_idx", 10**6),
        ("images", "camera_idx", 7),
        ("observations", "offsets", 10**6),
        ("observations", "offsets", -1),
    ],
)
def test_indices_that_point_outside_are_refused(table, field, value):
    model = model_with("PINHOLE", sizes=(5, 5))
    array = getattr(getattr(model, table), field).copy()
    array[1] = value
    scene = kept.scene_of(replace(model, **{table: replace(getattr(model, table), **{field: array})}))
    with pytest.raises(IndexError):
        project_scene(scene)


@pytest.mark.parametrize("name", sorted(set(LENSES) & set(NAMES)))
def test_derivatives_in_the_distortion_are_made_again_by_either_path(name):
    model = model_with(name, sizes=(20, 300, 0, 140, 33, 1))
    point_idx = model.observations.point_idx.copy()
    point_idx[[0, 21, 400]] = -1
    residuals = model_residuals(replace(model, observations=replace(model.observations, point_idx=point_idx)))
    made = residuals.d_extra
    found = [made[image] for image in (5, 3, 0, 2, 1)]
    together = made.of([5, 3, 0, 2, 1])
    unpickled = pickle.loads(pickle.dumps(residuals)).d_extra  # noqa: S301 - its own
    with numpy_only():
        by_numpy = unpickled.of([5, 3, 0, 2, 1])
    for image, one, other, expected in zip((5, 3, 0, 2, 1), found, together, by_numpy, strict=True):
        rows = residuals.rows(image)
        num_extra = len(model.camera(int(model.images.camera_idx[image])).model.extra_idxs)
        assert one.shape == (num_extra if rows.stop > rows.start else 0, 2, rows.stop - rows.start)
        assert_array_equal(one, other)
        assert one.shape == expected.shape
        assert_allclose(one, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max(initial=1.0))


def test_derivatives_in_the_distortion_of_images_that_numpy_projected_are_kept():
    model = model_with("OPENCV", sizes=(20, 30, 10))
    images = replace(model.images, camera_idx=np.array([0, -1, 2]))
    made = model_residuals(replace(model, images=images)).d_extra
    assert [each.shape for each in made] == [(4, 2, 20), (0, 2, 0), (4, 2, 10)]
    assert [each.shape for each in made.of([1, 2])] == [(0, 2, 0), (4, 2, 10)]
    for image in (-1, 3):
        with pytest.raises(IndexError, match="no image in row"):
            made[image]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"image_idxs": np.array([2])}, "not there"),
        ({"image_idxs": np.array([-1])}, "not there"),
        ({"image_idxs": np.array([], dtype=np.int64)}, "expected images"),
        ({"offsets": np.array([0, 5])}, "expected images"),
        ({"offsets": np.array([0, 5, 11])}, "offset"),
        ({"offsets": np.array([6, 5, 10])}, "offset"),
        ({"point_idx": np.full(10, 11, dtype=np.int32)}, "a point that is not there"),
        ({"point_idx": np.full(10, -1, dtype=np.int32)}, "a point that is not there"),
    ],
)
def test_inliers_that_are_not_there_are_no_memory(change, message):
    model = model_with("OPENCV", sizes=(5, 5))
    residuals = model_residuals(model)
    given = {"offsets": residuals.offsets, "point_idx": residuals.point_idx, "image_idxs": np.array([0, 1])}
    scene = kept.scene_of(model)
    assert [each.shape for each in distortion_derivatives(scene, *given.values())] == [(4, 2, 5)] * 2
    with pytest.raises(IndexError, match=message):
        distortion_derivatives(scene, *{**given, **change}.values())
    for odd in (replace(scene, camera_idx=np.array([0, -1])), replace(scene, lenses=scene.lenses - [[0], [99]])):
        with pytest.raises(IndexError, match=r"no camera|no lens"):
            distortion_derivatives(odd, *given.values())


def test_the_arctangent_of_the_kernel_is_that_of_a_series_of_gauss():
    """theta of a fisheye camera: x = f theta; the outside number is r 2F1(1/2, 1; 3/2; -r^2)."""
    tangent = np.concatenate([np.geomspace(1e-8, 1e8, 300), np.linspace(0.15, 8.0, 300)])
    model = model_with("SIMPLE_FISHEYE", sizes=(len(tangent),), f=1.0, cx=0.0, cy=0.0)
    xyz = np.column_stack([tangent, np.zeros_like(tangent), np.ones_like(tangent)])
    xyz = np.concatenate([xyz, xyz[:1]])
    observations = replace(model.observations, xy_px=np.zeros((len(tangent), 2)), point_idx=np.arange(len(tangent)))
    images = replace(model.images, translation_cam_from_world=np.zeros((1, 3)))
    images.quat_cam_from_world_wxyz[:] = 1.0, 0.0, 0.0, 0.0
    scene = kept.scene_of(
        replace(model, images=images, observations=observations, points=replace(model.points, xyz_world=xyz))
    )
    found = project_scene(scene)
    theta = tangent * hyp2f1(0.5, 1.0, 1.5, -(tangent**2))
    assert_allclose(-found.residuals_px[0], theta * scene.params[0, 0], rtol=1e-14)


def test_offsets_of_sums_are_those_of_columns():
    rng = np.random.default_rng(4)
    columns, residuals = rng.normal(size=(5, 6, 2, 20)), rng.normal(size=(5, 2, 20))
    columns[3, 1] = columns[3, 2] * (1.0 + 1e-9)  # not sure
    columns[4, 5] = 0.0
    flat = columns.reshape(5, 6, 40)
    offsets, is_sure = offsets_of_sums(
        flat @ flat.swapaxes(1, 2), np.einsum("icn,in->ic", flat, residuals.reshape(5, 40)), np.full(5, 20)
    )
    assert is_sure.tolist() == [True, True, True, False, False]
    wanted = [offset_px(own, rest) for own, rest in zip(columns[:3], residuals[:3], strict=True)]
    assert_allclose(offsets[:3], wanted, rtol=1e-12)


def test_one_image_of_a_model_is_what_it_is_alone():
    model = model_with("THIN_PRISM_FISHEYE")
    found, linked = model_residuals(model), slice(*model.observations.offsets[4:6])
    point_idx = model.observations.point_idx[linked]
    part = image_residuals(
        model.image(4), model.observations.xy_px[linked], model.points.xyz_world[point_idx], point_idx
    )
    assert_allclose(found.residuals_px[:, found.rows(4)], part.residuals_px, rtol=1e-11)


def test_derivatives_in_the_distortion_are_held_for_those_who_ask_in_turns(monkeypatch):
    model = model_with("OPENCV", sizes=(3,) * 100)
    made, calls = model_residuals(model).d_extra, []
    derivatives = Projectable.derivatives
    monkeypatch.setattr(Projectable, "derivatives", lambda self, i: calls.append(tuple(i)) or derivatives(self, i))
    for step in range(16):  # four that go through blocks of their own, at the same time
        for start in (0, 16, 32, 96):
            if start + step < 100:
                assert made[start + step].shape == (4, 2, 3)
    assert calls == [tuple(range(start, min(start + 16, 100))) for start in (0, 16, 32, 96)]
    made[64]
    assert (made[20].shape, len(calls)) == ((4, 2, 3), 5)  # the oldest block went, the others are there
    made[0]
    assert (calls[5], len(calls)) == (tuple(range(16)), 6)


def test_an_image_with_many_inliers_is_made_alone(monkeypatch):
    model, calls = model_with("SIMPLE_RADIAL", sizes=(3, 4096, 4097, 3)), []
    made, derivatives = model_residuals(model).d_extra, Projectable.derivatives
    monkeypatch.setattr(Projectable, "derivatives", lambda self, i: calls.append(tuple(i)) or derivatives(self, i))
    assert [made[image].shape for image in (2, 3, 2, 1, 0)] == [(1, 2, n) for n in (4097, 3, 4097, 4096, 3)]
    assert calls == [(2,), (0, 1, 3), (2,)]
