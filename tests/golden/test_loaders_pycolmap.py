"""What the loaders read is what pycolmap 4.2.1 reads, wherever pycolmap reads at all."""

from pathlib import Path

import numpy as np
import pycolmap
import pytest
from corpus import REFUSED_BY_PYCOLMAP, UNREADABLE, needs_corpus, parametrize_models
from numpy.testing import assert_allclose, assert_array_equal

from sfm_audit.loaders import FindingCode, LoadError, SparseModel, open_model
from sfm_audit.loaders.camera_models import COLMAP_MODELS

POSE_TOLERANCE = 1e-12
NUM_MODELS = 18


def assert_same_as_pycolmap(model: SparseModel, theirs: pycolmap.Reconstruction) -> None:
    _assert_same_cameras(model, theirs)
    _assert_same_points(model, theirs)
    assert_array_equal(model.images.image_id, sorted(theirs.images))
    for row, image_id in enumerate(model.images.image_id.tolist()):
        _assert_same_image(model, row, theirs.image(image_id))


def _assert_same_cameras(model: SparseModel, theirs: pycolmap.Reconstruction) -> None:
    assert_array_equal(model.cameras.camera_id, sorted(theirs.cameras))
    for row, camera_id in enumerate(model.cameras.camera_id.tolist()):
        ours, camera = model.camera(row), theirs.camera(camera_id)
        assert (ours.camera_id, ours.model.name) == (camera_id, camera.model.name)
        assert (ours.width, ours.height) == (camera.width, camera.height)
        assert_array_equal(ours.params, camera.params)


def _assert_same_points(model: SparseModel, theirs: pycolmap.Reconstruction) -> None:
    ids = sorted(theirs.points3D)
    assert_array_equal(model.points.point3d_id, np.array(ids, dtype=np.uint64))
    if ids:
        assert_array_equal(model.points.xyz_world, [theirs.point3D(i).xyz for i in ids])
        assert_array_equal(model.points.stored_error_px, [theirs.point3D(i).error for i in ids])


def _assert_same_image(model: SparseModel, row: int, image: pycolmap.Image) -> None:
    assert image.camera_id == model.images.camera_id[row]
    assert image.num_points2D() == model.images.num_points2d[row]
    pose = image.cam_from_world()
    x, y, z, w = pose.rotation.quat
    assert_allclose(model.images.quat_cam_from_world_wxyz[row], [w, x, y, z], rtol=0, atol=POSE_TOLERANCE)
    assert_allclose(model.images.translation_cam_from_world[row], pose.translation, rtol=POSE_TOLERANCE, atol=1e-12)
    first, last = model.observations.offsets[row : row + 2]
    assert_array_equal(model.observations.point2d_idx[first:last], image.get_observation_point2D_idxs())
    linked = image.get_observation_points2D()
    if linked:
        assert_array_equal(model.observations.xy_px[first:last], [p.xy for p in linked])
        ids = model.points.point3d_id[model.observations.point_idx[first:last]]
        assert_array_equal(ids, np.array([p.point3D_id for p in linked], dtype=np.uint64))


@parametrize_models(excluded=REFUSED_BY_PYCOLMAP | {"gtsfm_unsorted_txt"})
def test_every_readable_corpus_model_is_pycolmap_s(model_dir: Path):
    model, theirs = open_model(model_dir), pycolmap.Reconstruction(model_dir)
    assert_same_as_pycolmap(model, theirs)
    assert model.images.name == tuple(theirs.image(i).name for i in sorted(theirs.images))


@parametrize_models(excluded=UNREADABLE)
def test_the_rest_of_the_corpus_loads_too(model_dir: Path):
    model = open_model(model_dir)
    assert len(model.images) > 0
    assert len(model.observations) == model.observations.offsets[-1]


@needs_corpus
def test_models_that_cannot_be_read_are_refused(corpus: Path):
    for name in UNREADABLE:
        with pytest.raises(LoadError):
            open_model(corpus / "models" / name)


@needs_corpus
def test_a_truncated_points_file_is_refused_where_pycolmap_is_silent(corpus: Path, tmp_path: Path):
    source = corpus / "models" / "yifr"
    for path in source.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    whole = (source / "points3D.bin").read_bytes()
    (tmp_path / "points3D.bin").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(LoadError, match=r"points3D\.bin: byte \d+: expected .*, found"):
        open_model(tmp_path)


@needs_corpus
@pytest.mark.parametrize("scene", ["hsu_fox", "terteros"])
def test_binary_and_text_twins_hold_the_same(corpus: Path, scene: str):
    binary, text = (open_model(corpus / "models" / f"{scene}_{kind}") for kind in ("bin", "txt"))
    assert text.images.name == binary.images.name
    assert_array_equal(text.points.point3d_id, binary.points.point3d_id)
    assert_array_equal(text.observations.point_idx, binary.observations.point_idx)
    assert_allclose(text.points.xyz_world, binary.points.xyz_world, rtol=1e-5)


def synthesize(num_rigs=2, num_cameras=3, num_frames=3) -> pycolmap.Reconstruction:
    settings = pycolmap.SyntheticDatasetOptions()
    settings.num_rigs, settings.num_cameras_per_rig, settings.num_frames_per_rig = num_rigs, num_cameras, num_frames
    settings.num_points3D = 25
    settings.num_points2D_without_point3D = 7
    pycolmap.set_random_seed(1)
    return pycolmap.synthesize_dataset(settings)


@pytest.mark.parametrize("num_cameras", [1, 3])
@pytest.mark.parametrize("file_format", ["binary", "text"])
def test_rigs_of_several_sensors_are_composed_as_pycolmap_does(tmp_path: Path, file_format: str, num_cameras: int):
    theirs = synthesize(num_cameras=num_cameras)
    getattr(theirs, f"write_{file_format}")(tmp_path)
    model = open_model(tmp_path)
    assert model.file_format == file_format
    assert_same_as_pycolmap(model, pycolmap.Reconstruction(tmp_path))
    assert {finding.code for finding in model.findings} <= {FindingCode.STORED_ERRORS_ZERO}  # the data are exact


def test_text_and_binary_of_pycolmap_agree(tmp_path: Path):
    theirs = synthesize()
    models = []
    for file_format in ("binary", "text"):
        folder = tmp_path / file_format
        folder.mkdir()
        getattr(theirs, f"write_{file_format}")(folder)
        models.append(open_model(folder))
    assert_tables_close(*models, tolerance=1e-12)


def assert_tables_close(a: SparseModel, b: SparseModel, tolerance: float) -> None:
    for table in ("cameras", "images", "points", "observations"):
        ours, theirs = getattr(a, table), getattr(b, table)
        for name in ours.__slots__:
            x, y = getattr(ours, name), getattr(theirs, name)
            if name == "name":
                assert x == y
            elif x.dtype == np.float64:
                assert_allclose(x, y, rtol=tolerance, atol=tolerance, err_msg=f"{table}.{name}")
            else:
                assert_array_equal(x, y, err_msg=f"{table}.{name}")


def test_the_table_of_camera_models_is_pycolmap_s():
    theirs = {int(k): name for name, k in pycolmap.CameraModelId.__members__.items() if name != "INVALID"}
    assert {model.model_id: model.name for model in COLMAP_MODELS} == theirs
    assert len(theirs) == NUM_MODELS
    for model in COLMAP_MODELS:
        camera = pycolmap.Camera.create_from_model_name(1, model.name, 500.0, 640, 480)
        assert len(camera.params) == model.num_params
        assert list(model.focal_idxs) == list(camera.focal_length_idxs())
        assert list(model.principal_point_idxs) == list(camera.principal_point_idxs())


@pytest.mark.parametrize("file_format", ["binary", "text"])
@pytest.mark.parametrize("camera_model", COLMAP_MODELS, ids=lambda model: model.name)
def test_every_camera_model(tmp_path: Path, camera_model, file_format: str):
    camera = pycolmap.Camera.create_from_model_name(11, camera_model.name, 500.0, 640, 480)
    # as two cameras with other numbers, so that an offset into the parameters that is wrong shows
    theirs = synthesize(num_rigs=1, num_cameras=2, num_frames=2)
    for camera_id, existing in theirs.cameras.items():
        existing.model = camera.model
        existing.params = camera.params + (0.001 * camera_id if not camera_model.is_spherical else 0.0)
    getattr(theirs, f"write_{file_format}")(tmp_path)
    assert_same_as_pycolmap(open_model(tmp_path), pycolmap.Reconstruction(tmp_path))
