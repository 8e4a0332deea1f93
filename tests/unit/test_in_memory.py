"""A reconstruction in memory, a notebook's three lines, and arrays of one's own."""

from __future__ import annotations

import dataclasses
import doctest
import subprocess
import sys

import matplotlib as mpl
import numpy as np
import pycolmap
import pytest
from corpus import REFUSED_BY_PYCOLMAP, parametrize_models
from model_writer import rig_model, tiny_model, write_binary
from numpy.testing import assert_array_equal

import sfm_audit
from sfm_audit import audit_correspondences, audit_inliers, audit_model, audit_reconstruction, from_pycolmap, open_model
from sfm_audit.audit.notebook import correspondences, reconstruction
from sfm_audit.audit.simulate.adjust import adjust_scene, write_model
from sfm_audit.audit.simulate.scene import SceneSpec, simulate_scene
from sfm_audit.loaders import FindingCode, LoadError
from sfm_audit.loaders.camera_models import BY_NAME
from sfm_audit.loaders.colmap import in_memory
from sfm_audit.loaders.model import CameraRecord

mpl.use("Agg")


def assert_same_model(one, other):
    for table in ("cameras", "images", "points", "observations"):
        for field in dataclasses.fields(getattr(one, table)):
            ours, theirs = (getattr(getattr(model, table), field.name) for model in (one, other))
            if isinstance(ours, np.ndarray):
                assert ours.dtype == theirs.dtype
                assert_array_equal(ours, theirs, err_msg=field.name)
            else:
                assert ours == theirs, field.name
    assert one.findings == other.findings


def as_written(reconstruction, folder):
    folder.mkdir()
    reconstruction.write_binary(folder)
    return open_model(folder)


@parametrize_models(excluded=REFUSED_BY_PYCOLMAP)
def test_in_memory_and_on_disk_are_one_model(tmp_path, model_dir):
    given = pycolmap.Reconstruction(model_dir)
    assert_same_model(from_pycolmap(given), as_written(given, tmp_path / "m"))


@pytest.mark.parametrize("model", [tiny_model(), rig_model()], ids=["tiny", "rig"])
def test_a_written_model_comes_back(tmp_path, model):
    given = pycolmap.Reconstruction(write_binary(tmp_path / "w", model))
    loaded = from_pycolmap(given)
    assert_same_model(loaded, as_written(given, tmp_path / "m"))
    assert loaded.file_format == "pycolmap"
    assert "memory" in loaded.location


def test_images_that_are_not_registered_are_left_out_as_on_disk(tmp_path):
    given = pycolmap.Reconstruction(write_binary(tmp_path / "w", tiny_model()))
    given.deregister_frame(given.reg_frame_ids()[0])
    assert_same_model(from_pycolmap(given), as_written(given, tmp_path / "m"))


def test_an_empty_reconstruction_is_an_empty_model():
    assert [finding.code for finding in from_pycolmap(pycolmap.Reconstruction()).findings] == [FindingCode.EMPTY_MODEL]


def test_tracks_that_disagree_are_found_as_on_disk(tmp_path):
    given = pycolmap.Reconstruction(write_binary(tmp_path / "w", tiny_model()))
    image = given.image(3)
    first, second = image.get_observation_point2D_idxs()[:2]
    image.points2D[first].point3D_id = image.points2D[second].point3D_id
    loaded = from_pycolmap(given)
    assert FindingCode.TRACKS_DISAGREE in {finding.code for finding in loaded.findings}
    assert_same_model(loaded, as_written(given, tmp_path / "m"))


@pytest.mark.parametrize("is_empty", [False, True])
def test_arrays_and_objects_say_the_same(tmp_path, monkeypatch, is_empty):
    image = pycolmap.Reconstruction(write_binary(tmp_path / "w", tiny_model())).image(3)
    if is_empty:
        image.points2D.clear()
    assert in_memory._layout() is not None, "arrays are not read on this version of pycolmap: it is only slower"
    fast = in_memory._linked(image)
    monkeypatch.setattr(in_memory, "_layout", lambda: None)
    for ours, theirs in zip(fast, in_memory._linked(image), strict=True):
        assert ours.dtype == theirs.dtype
        assert_array_equal(ours, theirs)


def test_elements_that_lie_elsewhere_are_not_read():
    points2d = pycolmap.Point2DList()
    for _ in range(3):
        points2d.append(pycolmap.Point2D(xy=np.zeros(2)))
    known = in_memory._layout()
    assert known.read(points2d) is not None
    spec = {"names": ["xy", "id"], "formats": ["(2,)<f8", "<u8"], "offsets": [0, 16]}
    other = in_memory._Layout(np.dtype({**spec, "itemsize": known.element.itemsize + 8}))
    assert other.read(points2d) is None


def test_a_size_that_no_table_holds_is_refused(tmp_path):
    given = pycolmap.Reconstruction(write_binary(tmp_path / "w", tiny_model()))
    next(iter(given.cameras.values())).width = 2**33
    with pytest.raises(
        LoadError, match=r"in memory: camera \d+: expected an image size below 2\^32 px, found 8589934592"
    ):
        from_pycolmap(given)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    scene = simulate_scene(SceneSpec(num_images=9, points_per_image=110), np.random.default_rng(8))
    path = tmp_path_factory.mktemp("photos") / "sparse" / "0"
    path.mkdir(parents=True)
    write_model(scene, adjust_scene(scene), path, text=False)
    return path


@pytest.fixture(scope="module")
def result(folder):
    return audit_reconstruction(folder.parents[1])


def test_path_model_and_reconstruction_give_the_same_rows(folder, result):
    identity = ["model_path", "file_format", "dataset", "scene", "component"]
    for source in (open_model(folder), pycolmap.Reconstruction(folder)):
        other = audit_reconstruction(source)
        for name in ("images", "cameras", "models"):
            one, two = (each.tables.tables[name] for each in (result, other))
            columns = [column for column in one.column_names if column not in identity]
            assert one.select(columns).to_pylist() == two.select(columns).to_pylist()
    row = result.images.iloc[0]
    assert (row.dataset, row.scene, row.component) == (folder.parents[1].name, folder.parents[1].name, "0")


def test_the_result_is_short_in_words_and_in_html(result):
    assert len(repr(result)) < 300
    assert "9 images, " in repr(result)
    assert " under standard; " in repr(result)
    assert result.images is result.images
    assert len(result.images) == 9
    assert len(result.cameras) == result.models.num_cameras.item()
    html = result._repr_html_()
    assert repr(result)[1:-1].replace("<", "&lt;") in html
    assert len(html) < 4000
    assert len(repr(result.tables)) < 100
    assert len(repr(result.model)) < 250


def test_names_are_escaped_in_html(folder):
    reconstruction = pycolmap.Reconstruction(folder)
    name = "<script>alert(1)</script>.jpg"
    next(iter(reconstruction.images.values())).name = name
    result = audit_reconstruction(reconstruction)
    pages = result._repr_html_() + result.image(name)._repr_html_()
    assert "<script" not in pages


def test_an_image_by_name_or_id_tells_its_story(result):
    row = result.images.iloc[2]
    image = result.image(row.image_name)
    assert result.image(f"id:{row.image_id}").row == image.row
    assert (image.name, image.verdict, len(image.reasons)) == (row.image_name, row.verdict, len(row.reasons))
    assert image.audit.verdict == image.verdict
    assert repr(image).startswith(f"<{row.image_name}: {row.verdict}")
    story = image.explain()
    assert repr(story) == str(story)
    assert f"{row.image_name} (id {row.image_id}): {row.verdict.upper()}" in story
    assert "What a verdict does not prove" in story
    assert max(map(len, image.explain(width=70).splitlines()[:3])) <= 70
    assert row.verdict in image._repr_html_()


def test_what_is_no_image_is_told_with_examples(result, folder):
    with pytest.raises(KeyError, match="no image 'nobody'; there are "):
        result.image("nobody")
    reconstruction = pycolmap.Reconstruction(folder)
    for image in list(reconstruction.images.values())[:2]:
        image.name = "same.jpg"
    with pytest.raises(KeyError, match=r"2 images are called 'same.jpg'; name one by its id \(id:"):
        audit_reconstruction(reconstruction).image("same.jpg")


def test_pictures_take_axes_and_give_them_back(result):
    from matplotlib import pyplot as plt  # noqa: PLC0415 - after the backend

    image = result.image(result.images.image_name[0])
    figure, ax = plt.subplots()
    try:
        assert image.plot(ax) is ax
        assert image.name in ax.get_title()
        assert ax.get_ylim() == (image.row["height"], 0.0)
        assert len(ax.collections) == 1
        new = image.plot(magnify=20.0)
        assert new is not ax
        assert "× 20" in new.get_title()
        plt.close(new.figure)
    finally:
        plt.close(figure)


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"policy": "strict"}, "^policy: expected 'standard', .*, found 'strict'$"),
        ({"min_effect": "3"}, "^min_effect: expected a number and px or sigma, as in 0.2px, found '3'$"),
        ({"points": "independent"}, "^settings: points = independent takes noise = constant, not track$"),
        ({"noise": "keypoint"}, "^noise: keypoint reads the database"),
    ],
)
def test_settings_that_are_none_are_told_in_one_line(folder, setting, message):
    with pytest.raises(ValueError, match=message):
        audit_reconstruction(pycolmap.Reconstruction(folder), **setting)


def test_sources_that_are_none(tmp_path):
    with pytest.raises(TypeError, match=r"source: expected a path, a SparseModel or a pycolmap.Reconstruction, found"):
        audit_reconstruction({"images": 3})
    with pytest.raises(LoadError, match="expected a model folder"):
        audit_reconstruction(tmp_path)
    for name in "ab":
        write_binary(tmp_path / name, tiny_model())
    with pytest.raises(LoadError, match=r"expected one model, found 2: .*/a, .*/b"):
        audit_reconstruction(tmp_path)


SIZE = 1280, 960
CAMERA = ("OPENCV", *SIZE, (800.0, 810.0, 640.0, 480.0, 0.02, -0.01, 1e-3, -2e-3))


@pytest.fixture(scope="module")
def arrays():
    rng = np.random.default_rng(4)
    rotation = pycolmap.Rotation3d(np.array([0.1, -0.2, 0.05, 1.0]) / np.linalg.norm([0.1, -0.2, 0.05, 1.0]))
    pose = pycolmap.Rigid3d(rotation, np.array([0.3, -0.1, 0.2]))
    camera = pycolmap.Camera(model=CAMERA[0], width=SIZE[0], height=SIZE[1], params=list(CAMERA[3]))
    cam = rng.uniform([-4, -3, 4], [4, 3, 12], (400, 3))
    xyz = (cam - pose.translation) @ rotation.matrix()
    exact = camera.img_from_cam(cam)
    inside = (exact > 0).all(axis=1) & (exact < SIZE).all(axis=1)
    return (exact + rng.normal(0, 0.5, exact.shape))[inside], xyz[inside], camera, pose


def test_own_arrays_are_audited_as_the_records_are(arrays):
    xy, xyz, camera, pose = arrays
    record = CameraRecord(1, BY_NAME["OPENCV"], *SIZE, np.array(CAMERA[3]))
    audits = [
        audit_correspondences(xy, xyz, camera, pose),
        audit_correspondences(xy.tolist(), xyz.tolist(), CAMERA, pose.matrix().tolist()),
        audit_correspondences(xy, xyz, record, np.vstack([pose.matrix(), [0, 0, 0, 1]])),
    ]
    residuals = xy - camera.img_from_cam(np.array([pose * point for point in xyz]))  # pycolmap's
    for audit in audits:
        np.testing.assert_allclose(audit.residuals_px, residuals, atol=1e-9)
        assert audit.verdict == audits[0].verdict
        assert audit_inliers(audit.inliers).tests.ks_p == pytest.approx(audit.tests.ks_p, rel=1e-9)
    assert audits[0].constant.sigma_constant_px == pytest.approx(0.5, rel=0.1)
    assert len(repr(audits[0])) < 200


WRONG = [
    ({"xy": np.zeros((5, 3))}, r"^xy: expected shape \(n, 2\), found \(5, 3\)$"),
    ({"xy": np.zeros(6)}, r"^xy: expected shape \(n, 2\), found \(6,\)$"),
    ({"xy": [[1, 2], [3]]}, "^xy: expected numbers in rows of one length"),
    ({"xyz": np.zeros((5, 3))}, r"^xyz: expected shape \(\d+, 3\), a row for each of xy, found \(5, 3\)$"),
    ({"xyz": "abc"}, "^xyz: expected numbers"),
    ({"pose": np.eye(3)}, r"^pose: expected shape \(3, 4\) or \(4, 4\), .*, found \(3, 3\)$"),
    ({"pose": 2 * np.eye(3, 4)}, "^pose: expected a rotation .* off 1 by 3$"),
    ({"pose": np.diag([1.0, 1.0, -1.0, 1.0])}, "^pose: expected a rotation"),
    ({"pose": np.full((3, 4), np.nan)}, "^pose: expected a rotation .* by nan$"),
    ({"pose": np.diag([1.0, 1.0, 1.0, 2.0])}, "^pose: expected 0 0 0 1 as its last row, found 0 0 0 2$"),
    ({"camera": ("PINHOLLE", 1, 1, (1,))}, r"^camera: expected a model of COLMAP's \(SIMPLE_PINHOLE, .* 'PINHOLLE'$"),
    ({"camera": ("PINHOLE", 1, 1, (1,))}, r"^camera: expected 4 parameters of PINHOLE \(fx fy cx cy\), found \(1,\)$"),
    ({"camera": 500.0}, "^camera: expected a CameraRecord, a pycolmap.Camera, or .*, found float$"),
    ({"camera": {"model": "PINHOLE"}}, "^camera: expected a CameraRecord, .*, found dict$"),
    ({"camera": np.eye(4)}, "^camera: expected a CameraRecord, .*, found ndarray$"),
    ({"camera": ("PINHOLE", np.nan, 960, (1.0,) * 4)}, "^camera: expected a width and a height in whole px, found nan"),
    (
        {"camera": ("PINHOLE", "wide", 960, (1.0,) * 4)},
        "^camera: expected a width and a height .* found 'wide' and 960",
    ),
    ({"camera": ("PINHOLE", 1280, -5, (1.0,) * 4)}, "^camera: expected a width and a height .* found 1280 and -5$"),
    ({"xy": np.zeros((5, 2), complex)}, "^xy: expected numbers .*, found an array of complex128$"),
    ({"xy": np.ones((5, 2), bool)}, "^xy: expected numbers .*, found an array of bool$"),
    ({"xy": [["1", "2"]]}, "^xy: expected numbers .*, found an array of text$"),
    ({"xy": None}, "^xy: expected numbers .*, found NoneType$"),
    ({"xyz": np.ma.masked_less(np.eye(3), 0.5)}, "^xyz: expected numbers without a mask, found masked ones; leave"),
    ({"pose": (np.eye(3), np.zeros(3))}, "^pose: expected numbers in rows of one length, found other lengths$"),
]


@pytest.mark.parametrize(("changed", "message"), WRONG)
def test_a_wrong_array_is_named(arrays, changed, message):
    given = dict(zip(("xy", "xyz", "camera", "pose"), arrays, strict=True)) | changed
    with pytest.raises(ValueError, match=message):
        audit_correspondences(**given)


def test_what_is_odd_and_still_an_array_is_audited(arrays):
    xy, xyz, camera, pose = arrays
    wanted = audit_correspondences(xy, xyz, camera, pose).residuals_px
    named = (pycolmap.CameraModelId.OPENCV, np.int32(SIZE[0]), float(SIZE[1]), CAMERA[3])
    odd = audit_correspondences(xy.astype(object), np.ma.asarray(np.asfortranarray(xyz)), named, pose)
    np.testing.assert_array_equal(odd.residuals_px, wanted)
    none = audit_correspondences(np.empty((0, 2)), np.empty((0, 3)), camera, pose)
    assert "undetermined" in repr(none)
    holes = np.where(np.arange(len(xy))[:, None] == 7, np.nan, xy)
    assert audit_correspondences(holes, xyz, camera, pose).inliers.xy_px.shape == (len(xy) - 1, 2)


def test_what_is_no_reconstruction_or_no_name_is_said(folder, monkeypatch):
    with pytest.raises(TypeError, match=r"reconstruction: expected a pycolmap.Reconstruction, found str; open_model"):
        from_pycolmap(str(folder))
    result = audit_reconstruction(folder)
    with pytest.raises(TypeError, match=r"name: expected an image's name or id:<image_id> as text, found 3$"):
        result.image(3)
    image = result.image(result.images.image_name[0])
    for module in [name for name in sys.modules if name.split(".")[0] == "matplotlib"]:
        monkeypatch.setitem(sys.modules, module, None)
    monkeypatch.delitem(sys.modules, "sfm_audit.audit.notebook.pictures", raising=False)
    monkeypatch.delattr("sfm_audit.audit.notebook.pictures", raising=False)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'sfm-audit\[report\]'"):
        image.plot()


@pytest.mark.parametrize("module", [reconstruction, correspondences])
def test_the_examples_of_the_docstrings_run(module):
    failed, tried = doctest.testmod(module)
    assert tried > 4
    assert failed == 0


def test_pictures_can_be_written_beside_pycolmap(tmp_path):
    """pycolmap 4.2 brings a zlib of its own that serves Pillow too where no other was loaded: it ends the process."""
    code = (
        "import sfm_audit, pycolmap; pycolmap.Reconstruction(); from matplotlib.figure import Figure;"
        f"f = Figure(); f.add_subplot().plot([1, 2]); f.savefig({str(tmp_path / 'a.png')!r})"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
    assert (tmp_path / "a.png").stat().st_size > 1000


def test_the_old_answer_has_a_name_of_its_own(folder):
    assert sfm_audit.audit_model is audit_model
    assert audit_model(open_model(folder)).images.num_rows == 9
