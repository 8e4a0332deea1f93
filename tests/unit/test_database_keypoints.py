"""Keypoint scales from databases that pycolmap wrote, and what is said of databases that cannot be read."""

from __future__ import annotations

import sqlite3

import numpy as np
import pycolmap
import pytest
from corpus import CORPUS, needs_corpus
from hypothesis import given
from hypothesis import strategies as st
from model_writer import Camera, Image, Model, Point, write_binary
from numpy.testing import assert_allclose

from sfm_audit.loaders import (
    LfsPointerError,
    LoadError,
    MalformedFileError,
    MissingFileError,
    TruncatedFileError,
    UnreadableFileError,
    open_model,
)
from sfm_audit.loaders.colmap.database import find_database, read_keypoint_shapes
from sfm_audit.loaders.model import SparseModel

UNLINKED = 2**64 - 1
NAMES = ("b.jpg", "a b/é 1.png", "no keypoints.jpg")


@pytest.fixture
def model(tmp_path) -> SparseModel:
    """Two images with linked and unlinked 2D points; ids that no database would give them."""
    first = tuple((float(i), 2.0 * i, 7 if i in {0, 3} else UNLINKED) for i in range(5))
    second = tuple((3.0 * i, float(i), 7 if i == 2 else UNLINKED) for i in range(4))
    images = (Image(40, NAMES[0], first), Image(3, NAMES[1], second), Image(77, NAMES[2]))
    point = Point(7, ((40, 0), (40, 3), (3, 2)))
    return open_model(write_binary(tmp_path / "scene" / "sparse" / "0", Model((Camera(),), images, (point,))))


def make_database(path, keypoints, names=NAMES):
    """Write a database by pycolmap; ``keypoints``: one (n, 2 | 4 | 6) array per name, None for none."""
    with pycolmap.Database.open(path) as database:
        camera = pycolmap.Camera(model="SIMPLE_PINHOLE", width=640, height=480, params=[500, 320, 240])
        camera_id = database.write_camera(camera)
        for name, rows in zip(names, keypoints, strict=True):
            image_id = database.write_image(pycolmap.Image(name=name, camera_id=camera_id))
            if rows is not None:
                database.write_keypoints(image_id, np.asarray(rows, dtype=np.float32))
    return path


def affine(rng, n):
    return np.column_stack([rng.uniform(0, 400, (n, 2)), rng.normal(size=(n, 4))]).astype(np.float32)


def keypoints_of(rows):
    """pycolmap's own objects, whose compute_scale and compute_orientation are the outside numbers."""
    keypoints = []
    for row in rows:
        keypoint = pycolmap.FeatureKeypoint()
        keypoint.x, keypoint.y, keypoint.a11, keypoint.a12, keypoint.a21, keypoint.a22 = map(float, row)
        keypoints.append(keypoint)
    return keypoints


def test_scales_are_colmap_s_and_belong_to_names_not_ids(tmp_path, model):
    rng = np.random.default_rng(0)
    first, second = affine(rng, 5), affine(rng, 4)
    path = make_database(tmp_path / "database.db", [first, second, None])
    found = read_keypoint_shapes(path, model)
    assert found.location == str(path)
    by_name = {NAMES[0]: keypoints_of(first), NAMES[1]: keypoints_of(second)}
    offsets = model.observations.offsets
    for image_idx, name in enumerate(model.images.name):
        for row in range(offsets[image_idx], offsets[image_idx + 1]):
            theirs = by_name[name][model.observations.point2d_idx[row]]
            assert found.scale_px[row] == pytest.approx(theirs.compute_scale(), rel=1e-6)
            assert found.orientation_rad[row] == pytest.approx(theirs.compute_orientation(), rel=1e-6)
    assert found.scale_px.shape == (3,)


def test_four_columns_hold_scale_and_orientation(tmp_path, model):
    rng = np.random.default_rng(1)
    rows = [np.column_stack([rng.uniform(0, 9, (n, 2)), rng.uniform(1, 9, n), rng.uniform(-3, 3, n)]) for n in (5, 4)]
    path = make_database(tmp_path / "database.db", [np.zeros((5, 4)), np.zeros((4, 4)), None])
    write_raw(path, [(row.astype("<f4").tobytes(), *row.shape) for row in rows])
    found = read_keypoint_shapes(path, model)
    assert_allclose(found.scale_px, [rows[1][2, 2], *rows[0][[0, 3], 2]], rtol=1e-6)  # images by id: 3, then 40
    assert_allclose(found.orientation_rad, [rows[1][2, 3], *rows[0][[0, 3], 3]], rtol=1e-6)


def test_two_columns_leave_the_scale_unknown(tmp_path, model):
    path = make_database(tmp_path / "database.db", [affine(np.random.default_rng(0), 5), np.zeros((4, 4)), None])
    write_raw(path, [None, (np.zeros((4, 2), dtype="<f4").tobytes(), 4, 2)])
    found = read_keypoint_shapes(path, model)
    assert np.isnan(found.scale_px[0])
    assert np.isfinite(found.scale_px[1:]).all()


def write_raw(path, blobs):
    """Replace the keypoints of database images 1, 2, .. by (bytes, rows, columns), past COLMAP's checks."""
    database = sqlite3.connect(path)
    for image_id, blob in enumerate(blobs, start=1):
        if blob is not None:
            database.execute("UPDATE keypoints SET data = ?, rows = ?, cols = ? WHERE image_id = ?", (*blob, image_id))
    database.commit()
    database.close()


@given(seed=st.integers(0, 1000), turn=st.floats(-3.0, 3.0), size=st.floats(0.1, 50.0))
def test_scale_and_orientation_of_similarities(seed, turn, size):
    rows = np.random.default_rng(seed).uniform(0, 9, (1, 2))
    cosine, sine = size * np.cos(turn), size * np.sin(turn)
    (keypoint,) = keypoints_of(np.column_stack([rows, [[cosine, -sine, sine, cosine]]]))
    assert keypoint.compute_scale() == pytest.approx(size, rel=1e-5)
    assert keypoint.compute_orientation() == pytest.approx(turn, abs=1e-5)


BLOB = b"\0" * (5 * 6 * 4)


@pytest.mark.parametrize(
    ("blob", "error", "text"),
    [
        ((BLOB[:-1], 5, 6), MalformedFileError, "120 bytes (5 x 6 float32), found 119 bytes"),
        ((BLOB, 5, 3), MalformedFileError, "2, 4 or 6 columns, found 5 rows and 3 columns"),
        ((BLOB, -5, 6), MalformedFileError, "found -5 rows"),
        ((BLOB, "many", 6), MalformedFileError, "found 'many' rows"),
        (("text", 5, 6), MalformedFileError, "found str"),
        ((None, 5, 6), MalformedFileError, "found 0 bytes"),
        ((BLOB[:96], 4, 6), LoadError, "5 keypoints of image 1 ('b.jpg'), as in the model, found 4"),
    ],
)
def test_blobs_that_cannot_be(tmp_path, model, blob, error, text):
    rng = np.random.default_rng(0)
    path = make_database(tmp_path / "database.db", [affine(rng, 5), affine(rng, 4), None])
    write_raw(path, [blob])
    with pytest.raises(error) as caught:
        read_keypoint_shapes(path, model)
    assert text in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_image_that_the_database_does_not_have(tmp_path, model):
    rng = np.random.default_rng(0)
    path = make_database(tmp_path / "database.db", [affine(rng, 5), affine(rng, 4)], ("b.jpg", "c.jpg"))
    with pytest.raises(LoadError, match="no image of that name"):
        read_keypoint_shapes(path, model)


def test_an_image_without_keypoints(tmp_path, model):
    path = make_database(tmp_path / "database.db", [affine(np.random.default_rng(0), 5), None, None])
    with pytest.raises(LoadError, match=r"4 keypoints of image 2 .* found 0"):
        read_keypoint_shapes(path, model)


def test_files_that_are_no_database(tmp_path, model):
    path = tmp_path / "database.db"
    with pytest.raises(MissingFileError):
        read_keypoint_shapes(path, model)
    path.write_bytes(b"")
    with pytest.raises(TruncatedFileError):
        read_keypoint_shapes(path, model)
    path.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 5\n")
    with pytest.raises(LfsPointerError):
        read_keypoint_shapes(path, model)
    path.write_bytes(b"\x89PNG" + b"\0" * 200)
    with pytest.raises(MalformedFileError, match="SQLite database, found a file that starts with"):
        read_keypoint_shapes(path, model)
    path.unlink()
    path.mkdir()
    with pytest.raises(UnreadableFileError):
        read_keypoint_shapes(path, model)


def test_another_program_s_database(tmp_path, model):
    path = tmp_path / "database.db"
    database = sqlite3.connect(path)
    database.execute("CREATE TABLE songs (title TEXT)")
    database.commit()
    database.close()
    with pytest.raises(MalformedFileError, match="no such table"):
        read_keypoint_shapes(path, model)


def test_a_database_cut_anywhere(tmp_path, model):
    rng = np.random.default_rng(0)
    path = make_database(tmp_path / "database.db", [affine(rng, 5), affine(rng, 4), None])
    content = path.read_bytes()
    for size in [*range(0, 120, 7), *range(120, len(content), 997), len(content) - 1]:
        path.write_bytes(content[:size])
        with pytest.raises(LoadError):
            read_keypoint_shapes(path, model)


def test_scrambled_pages_raise_nothing_but_load_errors(tmp_path, model):
    rng = np.random.default_rng(0)
    path = make_database(tmp_path / "database.db", [affine(rng, 5), affine(rng, 4), None])
    content = np.frombuffer(path.read_bytes(), dtype=np.uint8)
    refused = 0
    for _ in range(60):
        damaged = content.copy()
        damaged[rng.integers(100, content.size, 400)] = rng.integers(0, 256, 400)
        path.write_bytes(damaged.tobytes())
        try:
            read_keypoint_shapes(path, model)
        except LoadError:
            refused += 1
    assert refused > 0


def test_unwritten_changes_are_not_overlooked(tmp_path, model):
    rng = np.random.default_rng(0)
    path = make_database(tmp_path / "database.db", [affine(rng, 5), affine(rng, 4), None])
    (tmp_path / "database.db-wal").write_bytes(b"changes")
    with pytest.raises(UnreadableFileError, match=r"database\.db-wal"):
        read_keypoint_shapes(path, model)


def test_nothing_is_written(tmp_path, model):
    rng = np.random.default_rng(0)
    folder = tmp_path / "read only ?#%"
    folder.mkdir()
    path = make_database(folder / "database.db", [affine(rng, 5), affine(rng, 4), None])
    before = path.read_bytes(), sorted(folder.iterdir())
    path.chmod(0o400)
    folder.chmod(0o500)
    try:
        read_keypoint_shapes(path, model)
    finally:
        folder.chmod(0o700)
    assert (path.read_bytes(), sorted(folder.iterdir())) == before


def test_the_nearest_database_at_most_three_folders_up(tmp_path):
    model_dir = tmp_path / "top" / "scene" / "sparse" / "manhattan" / "0"
    model_dir.mkdir(parents=True)
    (tmp_path / "top" / "database.db").touch()
    assert find_database(model_dir) is None
    for folder in (model_dir.parents[2], model_dir.parents[1], model_dir):
        (folder / "database.db").touch()
        assert find_database(str(model_dir)) == folder / "database.db"


def test_relative_locations(tmp_path, monkeypatch):
    (tmp_path / "database.db").touch()
    (tmp_path / "sparse").mkdir()
    monkeypatch.chdir(tmp_path / "sparse")
    assert find_database(".") == tmp_path / "database.db"


@needs_corpus
@pytest.mark.corpus
def test_corpus_scales_lie_at_the_observed_points():
    location = CORPUS / "megadepth_like" / "MegaDepth_v1_SfM" / "9002" / "sparse" / "manhattan" / "1"
    model = open_model(location)
    path = find_database(location)
    assert path == location.parents[2] / "database.db"
    found = read_keypoint_shapes(path, model)
    assert found.scale_px.shape == (1250,)
    # SIFT of COLMAP: smallest scale 1.6 * 2^(-1/3) of an image enlarged twice, 0.8 px; measured median 1.62
    assert found.scale_px.min() > 0.8
    assert np.median(found.scale_px) == pytest.approx(1.62, abs=0.01)
