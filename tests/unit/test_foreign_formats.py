"""Formats of other programs: residuals are their own, and the table is that of the same scene in COLMAP's files."""

import json
import re

import foreign_openmvg_binary as mvg
import foreign_scene as fs
import numpy as np
import pyarrow as pa
import pytest
from numpy.testing import assert_allclose

from sfm_audit.audit.engine.model import ModelAuditor
from sfm_audit.loaders import FindingCode, LoadError, discover, open_model
from sfm_audit.loaders.datasets.image_counts import count_images
from sfm_audit.loaders.foreign import json_file

IDENTITY = {"dataset", "scene", "component", "model_path", "image_id", "camera_id", "image_name"}
IDENTITY |= {"file_format", "findings"}
PLAIN = {"k1": 0.0, "k2": 0.0}
BROWN = {"fx": 620.0, "fy": 640.0, "cx": 3.0, "cy": -2.0, "p1": 1e-3, "p2": -2e-3, "k3": 0.004}
"""cx, cy: from the image's centre."""


def openmvg(kind: str, *, wrapped: bool = False):
    return lambda made: fs.openmvg_files(made, kind, wrapped=wrapped)


def openmvg_binary(kind: str, order: str = "<"):
    return lambda made: mvg.openmvg_binary_files(made, kind, order)


FORMATS = {
    # (file format, writer, lens of the scene, kind, COLMAP's model, a camera per image)
    "bundler": ("bundler", fs.bundler_files, {}, "perspective", "RADIAL", True),
    "bal": ("bal", fs.bal_files, {"k2": 0.0}, "perspective", "SIMPLE_RADIAL", True),
    "nvm": ("nvm", fs.nvm_files, PLAIN, "perspective", "SIMPLE_PINHOLE", True),
    "opensfm": ("opensfm", fs.opensfm_files, {}, "perspective", "RADIAL", False),
    "opensfm opencv": ("opensfm", fs.opensfm_files, BROWN | {"k3": 0.0}, "perspective", "OPENCV", False),
    "opensfm fisheye": ("opensfm", fs.opensfm_files, {}, "fisheye", "RADIAL_FISHEYE", False),
    "opensfm panorama": ("opensfm", fs.opensfm_files, {}, "spherical", "EQUIRECTANGULAR", False),
    "blocks": ("blocks_exchange", fs.blocks_exchange_files, {"cx": 4.0}, "perspective", "RADIAL", False),
    "kapture": ("kapture", fs.kapture_files, {}, "perspective", "RADIAL", False),
    "kapture rig": ("kapture", lambda made: fs.kapture_files(made, with_rig=True), {}, "perspective", "RADIAL", False),
    "openmvg pinhole": ("openmvg", openmvg("pinhole"), PLAIN, "perspective", "SIMPLE_PINHOLE", False),
    "openmvg k1": ("openmvg", openmvg("pinhole_radial_k1"), {"k2": 0.0}, "perspective", "SIMPLE_RADIAL", False),
    "openmvg k3": ("openmvg", openmvg("pinhole_radial_k3", wrapped=True), {"cx": 4.0}, "perspective", "RADIAL", False),
    "openmvg fisheye": ("openmvg", openmvg("fisheye"), {}, "fisheye", "RADIAL_FISHEYE", False),
    "openmvg bin": ("openmvg_binary", openmvg_binary("pinhole"), PLAIN, "perspective", "SIMPLE_PINHOLE", False),
    "openmvg bin k3": ("openmvg_binary", openmvg_binary("pinhole_radial_k3", ">"), {}, "perspective", "RADIAL", False),
}


def residuals_of(model) -> tuple[ModelAuditor, np.ndarray]:
    auditor = ModelAuditor(model)
    return auditor, auditor.residuals.residuals_px.T


def by_image(made: fs.Scene, rows: np.ndarray) -> np.ndarray:
    """Order rows of the scene's observations like the audit's: by image."""
    return rows[np.argsort(made.image_idx, kind="stable")]


def assert_same_rows(ours: pa.Table, theirs: pa.Table) -> None:
    assert ours.num_rows == theirs.num_rows > 0
    for name in ours.column_names:
        if name in IDENTITY:
            continue
        for x, y in zip(ours[name].to_pylist(), theirs[name].to_pylist(), strict=True):
            if (isinstance(x, float) and isinstance(y, float)) or (
                isinstance(x, list) and x and isinstance(x[0], float)
            ):
                assert x == pytest.approx(y, rel=1e-6, abs=1e-9, nan_ok=True), name
            elif not (isinstance(x, list) and x and isinstance(x[0], dict)):
                assert x == y, name


@pytest.mark.parametrize("name", FORMATS)
def test_the_table_is_that_of_the_same_scene_from_colmap(tmp_path, name):
    file_format, write, lens, kind, twin_model, camera_per_image = FORMATS[name]
    made = fs.scene(lens, kind=kind)
    folder = fs.write(tmp_path / "ours", write(made)) / ("reconstruction" if file_format == "kapture" else "")
    ours = open_model(folder)
    fs.write_colmap(tmp_path / "twin", made, twin_model, camera_per_image=camera_per_image)
    twin = open_model(tmp_path / "twin")
    assert ours.file_format == file_format
    assert ours.images.name == twin.images.name or name == "bal"  # which has none
    assert np.array_equal(ours.observations.point_idx, twin.observations.point_idx)
    assert_allclose(ours.observations.xy_px, twin.observations.xy_px, rtol=1e-13)
    auditor, residuals = residuals_of(ours)
    assert_allclose(residuals, by_image(made, fs.residuals(made)), atol=1e-9 * np.abs(residuals).max())
    tables, others = auditor.tables(), ModelAuditor(twin).tables()
    assert_same_rows(tables.images, others.images)
    assert_same_rows(tables.cameras, others.cameras)
    assert_same_rows(tables.models, others.models)

    assert count_images(str(folder)) == len(made.rotations)
    (ref,) = discover([tmp_path / "ours"]).refs
    assert ref.num_bytes == sum(map(len, write(made).values()))


def test_bundler_and_bal_residuals_are_their_own(tmp_path):
    made = fs.scene()
    own = by_image(made, fs.bundler_residuals(made))
    for name in ("bundler", "bal"):
        _, residuals = residuals_of(open_model(fs.write(tmp_path / name, FORMATS[name][1](made))))
        assert_allclose(residuals * (1, -1), own, atol=1e-9 * np.abs(own).max())


@pytest.mark.parametrize("distortion", [-0.09, 0.12])
def test_nvm_residuals_are_zero_where_visualsfm_s_are_and_differ_by_the_lens(tmp_path, distortion):
    """Observations that VisualSFM calls exact are exact; others are as far off as from those."""
    made = fs.scene(PLAIN)
    own = fs.nvm_residuals(made, distortion)
    model = open_model(fs.write(tmp_path / "noisy", fs.nvm_files(made, distortion)))
    assert model.image(0).camera.model.name == "INVERSE_RADIAL"
    half = np.array([made.width / 2, made.height / 2])
    measured = made.xy - half
    for _ in range(100):  # move the measurements until VisualSFM's residual is 0
        norm2 = (measured**2).sum(axis=1, keepdims=True) / made.lens["fx"] ** 2
        slope = 1 + 3 * distortion * norm2
        measured = measured - fs.nvm_residuals(made.but(xy=measured + half), distortion) / slope.clip(0.5, 2)
    exact = made.but(xy=measured + half)
    assert np.abs(fs.nvm_residuals(exact, distortion)).max() < 1e-9
    _, residuals = residuals_of(open_model(fs.write(tmp_path / "exact", fs.nvm_files(exact, distortion))))
    assert np.abs(residuals).max() < 1e-8
    _, residuals = residuals_of(model)
    assert_allclose(residuals, by_image(made, made.xy - exact.xy), atol=1e-8)
    assert np.abs(own).max() > 0.5


def test_several_models_of_one_nvm_file_are_one_table_with_a_finding(tmp_path):
    one, two = fs.scene(PLAIN), fs.scene(PLAIN, num_images=4, num_points=50)
    text = f"NVM_V3 \n\n{fs.nvm_part(one)}{fs.nvm_part(two)}0\n"
    folder = fs.write(tmp_path, {"a.nvm": text.encode()})
    model = open_model(folder)
    assert (len(model.images), len(model.points), len(model.observations)) == (10, 130, len(one.xy) + len(two.xy))
    assert FindingCode.SEVERAL_RECONSTRUCTIONS in {finding.code for finding in model.findings}
    assert count_images(str(folder)) == 10
    last = model.observations.point_idx[model.observations.offsets[-2] :]
    assert last.min() >= 80


def test_px_that_count_from_the_corner_are_suspected_where_none_is_left_of_the_centre(tmp_path):
    made = fs.scene(PLAIN)
    shifted = made.but(xy=made.xy + np.array([made.width / 2, made.height / 2]))
    for name, scene, is_suspected in (("centre", made, False), ("corner", shifted, True)):
        model = open_model(fs.write(tmp_path / name, fs.nvm_files(scene)))
        (text,) = [each.text for each in model.findings if each.code is FindingCode.IMAGE_SIZE_ASSUMED]
        assert ("px from the corner" in text) is is_suspected


def test_two_nvm_files_in_a_folder_are_refused_in_one_line(tmp_path):
    content = fs.nvm_files(fs.scene(PLAIN))["scene.nvm"]
    folder = fs.write(tmp_path, {"a.nvm": content, "b.nvm": content})
    with pytest.raises(LoadError, match=r"expected one file \*.nvm, found 2: a.nvm, b.nvm; give each a folder"):
        open_model(folder)


def test_a_bundler_camera_of_zeros_is_no_image(tmp_path):
    made = fs.scene()
    files = fs.bundler_files(made)
    lines = files["bundle.out"].split(b"\n")
    lines[2:7] = [b"0 0 0"] * 5
    folder = fs.write(tmp_path, files | {"bundle.out": b"\n".join(lines)})
    model = open_model(folder)
    assert model.images.name == tuple(f"{row}.jpg" for row in range(1, 6))
    lost = {finding.code: finding.count for finding in model.findings}[FindingCode.OBSERVATIONS_WITHOUT_IMAGE]
    assert lost == np.count_nonzero(made.image_idx == 0)


@pytest.mark.parametrize(
    ("name", "old", "new", "message"),
    [
        ("bundle.out", b"# Bundle file v0.3", b"# Bundle file v0.2", "line 1: expected # Bundle file v0.3"),
        ("bundle.out", b"\n6 80\n", b"\n6 -1\n", "line 2: expected a number of points"),
        ("bundle.out", b"\n6 80\n", b"\n6000000 80\n", "expected 6000000 cameras, found the end"),
        ("bundle.out", b"10 20 30\n", b"10 20 3o\n", "expected numbers, found '3o'"),
        ("bundle.out", b"10 20 30\n6 0 ", b"10 20 30\n6 9 ", "expected the position of a camera below 6, found 9"),
        ("list.txt", b"2.jpg", b"2.jpg\n3.jpg", "expected 6 names, as many as bundle.out has cameras, found 7"),
    ],
)
def test_what_is_wrong_with_a_bundler_file_is_said_in_one_line(tmp_path, name, old, new, message):
    files = fs.bundler_files(fs.scene(num_points=80))
    assert old in files[name]
    folder = fs.write(tmp_path, files | {name: files[name].replace(old, new, 1)})
    with pytest.raises(LoadError, match=message) as error:
        open_model(folder)
    assert "\n" not in str(error.value)


OTHER_LENSES = {
    "opensfm brown": (fs.opensfm_files, BROWN, "BROWN", "FULL_OPENCV"),
    "blocks brown": (fs.blocks_exchange_files, BROWN, "BROWN", "FULL_OPENCV"),
    "openmvg brown": (
        openmvg("pinhole_brown_t2"),
        {"p1": 1e-3, "p2": -2e-3, "k3": 0.004},
        "SIMPLE_BROWN",
        "FULL_OPENCV",
    ),
    "openmvg brown wrapped": (openmvg("pinhole_brown_t2", wrapped=True), {"p1": 1e-3}, "SIMPLE_BROWN", "FULL_OPENCV"),
    "openmvg radial": (openmvg("pinhole_radial_k3"), {"k3": 0.004}, "RADIAL_3", "FULL_OPENCV"),
    "openmvg brown binary": (openmvg_binary("pinhole_brown_t2"), {"p1": 1e-3}, "SIMPLE_BROWN", "FULL_OPENCV"),
}


@pytest.mark.parametrize("name", OTHER_LENSES)
def test_lenses_that_colmap_lacks_have_the_residuals_of_the_model_that_holds_them(tmp_path, name):
    write, lens, model_name, twin_model = OTHER_LENSES[name]
    made = fs.scene(lens)
    ours = open_model(fs.write(tmp_path / "ours", write(made)))
    twin = open_model(fs.write_colmap(tmp_path / "twin", made, twin_model, camera_per_image=False))
    assert {ours.image(row).camera.model.name for row in range(6)} == {model_name}
    auditor, residuals = residuals_of(ours)
    assert_allclose(residuals, by_image(made, fs.residuals(made)), atol=1e-9 * np.abs(residuals).max())
    assert_allclose(residuals, residuals_of(twin)[1], atol=1e-9)
    assert auditor.tables().images.num_rows == 6


def test_opensfm_fisheye_opencv_and_dual_and_what_is_refused(tmp_path):
    made = fs.scene({}, kind="fisheye")
    part, size = fs.opensfm_part(made), max(made.width, made.height)
    camera = {"projection_type": "fisheye_opencv", "focal_x": 0.9, "focal_y": 0.8, "c_x": 0.01, "c_y": -0.02, "k3": 0.5}
    sized = {"width": made.width, "height": made.height}
    dual = {"projection_type": "dual", "focal": 0.7, "k1": 0.01, "transition": 0.25} | sized
    for new, name, params in (
        (camera | sized, "OPENCV_FISHEYE", [0.9 * size, 0.8 * size, None, None, 0.0, 0.0, 0.5, 0.0]),
        (dual, "DUAL", [0.7 * size, made.width / 2, made.height / 2, 0.01, 0.0, 0.25]),
    ):
        files = fs.opensfm_files(made) | {
            "reconstruction.json": json.dumps([part | {"cameras": {"one": new}}]).encode()
        }
        found = open_model(fs.write(tmp_path / name, files)).image(0).camera
        assert found.model.name == name
        for ours, wanted in zip(found.params, params, strict=True):
            assert wanted is None or ours == pytest.approx(wanted, rel=1e-12)
    refused = part | {"cameras": {"one": {"projection_type": "fisheye62", "focal_x": 1, "focal_y": 1} | sized}}
    folder = fs.write(tmp_path / "no", fs.opensfm_files(made) | {"reconstruction.json": json.dumps([refused]).encode()})
    with pytest.raises(LoadError, match=r"a projection_type that is read .* at 0.cameras.one, found 'fisheye62'"):
        open_model(folder)


def test_several_opensfm_reconstructions_keep_the_points_of_one_track_apart(tmp_path):
    one, two = fs.scene(), fs.scene(num_images=4, num_points=50)
    parts = [fs.opensfm_part(one), fs.opensfm_part(two, "b")]
    tracks = (
        f"OPENSFM_TRACKS_VERSION_v2\n{fs.opensfm_tracks(one)}{fs.opensfm_tracks(two, 'b')}not there.jpg\t100\t0\t0\t0"
    )
    tracks += "\t0\t0\t0\t0\t-1\t-1\n0.jpg\t99999\t0\t0\t0\t0\t0\t0\t0\t-1\t-1\n"
    files = {"reconstruction.json": json.dumps(parts).encode(), "tracks.csv": tracks.encode()}
    folder = fs.write(tmp_path, files)
    model = open_model(folder)
    assert (len(model.images), len(model.points), len(model.observations)) == (10, 130, len(one.xy) + len(two.xy))
    assert {FindingCode.SEVERAL_RECONSTRUCTIONS} <= {finding.code for finding in model.findings}
    assert model.images.num_points2d[0] == np.count_nonzero(one.image_idx == 0) + 1  # the track without a point
    _, residuals = residuals_of(model)
    wanted = np.concatenate([by_image(made, fs.residuals(made)) for made in (one, two)])
    assert_allclose(residuals, wanted, atol=1e-8)
    assert count_images(str(folder)) == 10


@pytest.mark.parametrize("version", [0, 1])
def test_older_tracks_have_fewer_columns(tmp_path, version):
    made = fs.scene()
    lines = [line.split("\t") for line in fs.opensfm_tracks(made).splitlines()]
    rows = [[*row[:5], *row[5 + (version == 0) : 9]] for row in lines]
    head = "" if version == 0 else "OPENSFM_TRACKS_VERSION_v1\n"
    text = head + "".join("\t".join(row) + "\n" for row in rows)
    model = open_model(fs.write(tmp_path, fs.opensfm_files(made) | {"tracks.csv": text.encode()}))
    assert_allclose(residuals_of(model)[1], by_image(made, fs.residuals(made)), atol=1e-8)


def test_openmvg_views_without_a_pose_are_no_images_and_their_observations_are_counted(tmp_path):
    made = fs.scene()
    data = fs.openmvg_data(made, "pinhole_radial_k3")
    del data["extrinsics"][2]
    model = open_model(fs.write(tmp_path, {"sfm_data.json": json.dumps(data).encode()}))
    assert model.images.image_id.tolist() == [0, 1, 3, 4, 5]
    lost = {finding.code: finding.count for finding in model.findings}[FindingCode.OBSERVATIONS_WITHOUT_IMAGE]
    assert lost == np.count_nonzero(made.image_idx == 2)


def test_openmvg_kinds_of_cameras_are_named_once_and_numbered_later(tmp_path):
    made = fs.scene()
    data = fs.openmvg_data(made, "pinhole_radial_k3")
    first = data["intrinsics"][0]["value"]
    again = {"polymorphic_id": 1, "ptr_wrapper": {"id": 2147483701, "data": first["ptr_wrapper"]["data"]}}
    shared = {"polymorphic_id": 1, "ptr_wrapper": {"id": 53}}  # 2147483701 without its highest bit
    data["intrinsics"] += [{"key": 1, "value": again}, {"key": 2, "value": shared}]
    data["views"][1]["value"]["ptr_wrapper"]["data"]["id_intrinsic"] = 2
    model = open_model(fs.write(tmp_path, {"sfm_data.json": json.dumps(data).encode()}))
    assert model.images.camera_id.tolist() == [0, 2, 0, 0, 0, 0]
    assert np.array_equal(model.image(0).camera.params, model.image(1).camera.params)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"[" * 100_000, "values nested too deeply"),
        (b'{"a": 1, "a": 2}', "the key 'a' twice in one object"),
        (b'{"intrinsics": 1e999}', "an array at intrinsics, found inf"),
        (b"[1" + b"0" * 5000 + b"]", "expected JSON in UTF-8"),
        (
            b'{"intrinsics": [], "extrinsics": [], "views": [], "structure": {}}',
            "an array at structure, found an object",
        ),
        (b"\xff\xfe{}", "expected JSON in UTF-8"),
    ],
)
def test_json_that_is_none_or_hostile_is_refused_in_one_line(tmp_path, content, message):
    with pytest.raises(LoadError, match=re.escape(message)):
        open_model(fs.write(tmp_path, {"sfm_data.json": content}))


def test_a_json_file_with_too_many_values_is_refused_before_it_is_parsed(tmp_path, monkeypatch):
    monkeypatch.setattr(json_file, "MAX_VALUES", 100)
    with pytest.raises(LoadError, match="at most 100 values"):
        open_model(fs.write(tmp_path, fs.openmvg_files(fs.scene())))
    monkeypatch.setattr(json_file, "MAX_BYTES", 1000)
    with pytest.raises(LoadError, match="at most 1000 bytes of JSON"):
        open_model(fs.write(tmp_path, fs.openmvg_files(fs.scene())))
