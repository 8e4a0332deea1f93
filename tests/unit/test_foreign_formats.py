"""Formats of other programs: residuals are their own, and the table is that of the same scene in COLMAP's files."""

import foreign_scene as fs
import numpy as np
import pyarrow as pa
import pytest
from numpy.testing import assert_allclose

from sfm_audit.audit.engine.model import ModelAuditor
from sfm_audit.loaders import FindingCode, LoadError, discover, open_model
from sfm_audit.loaders.datasets.image_counts import count_images

IDENTITY = {"dataset", "scene", "component", "model_path", "image_id", "camera_id", "image_name"}
IDENTITY |= {"file_format", "findings"}
PLAIN = {"k1": 0.0, "k2": 0.0}
FORMATS = {
    # file format: (writer, lens of the scene, kind, COLMAP's model, a camera per image)
    "bundler": (fs.bundler_files, {}, "perspective", "RADIAL", True),
    "bal": (fs.bal_files, {"k2": 0.0}, "perspective", "SIMPLE_RADIAL", True),
    "nvm": (fs.nvm_files, PLAIN, "perspective", "SIMPLE_PINHOLE", True),
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
    write, lens, kind, twin_model, camera_per_image = FORMATS[name]
    made = fs.scene(lens, kind=kind)
    folder = fs.write(tmp_path / "ours", write(made))
    ours = open_model(folder)
    fs.write_colmap(tmp_path / "twin", made, twin_model, camera_per_image=camera_per_image)
    twin = open_model(tmp_path / "twin")
    assert ours.file_format == name
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
    assert ref.num_bytes == sum(len(content) for content in write(made).values())


def test_bundler_and_bal_residuals_are_their_own(tmp_path):
    made = fs.scene()
    own = by_image(made, fs.bundler_residuals(made))
    for name in ("bundler", "bal"):
        _, residuals = residuals_of(open_model(fs.write(tmp_path / name, FORMATS[name][0](made))))
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
