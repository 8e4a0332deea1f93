"""Verified pairs from databases that pycolmap wrote, and what is said of databases that do not fit the model."""

from __future__ import annotations

import re
import sqlite3
from contextlib import closing

import numpy as np
import pyarrow.parquet as pq
import pycolmap
import pytest
from model_writer import Camera, Image, Model, Point, write_binary

from sfm_audit.audit.cli.main import main
from sfm_audit.loaders import LoadError, MalformedFileError, open_model
from sfm_audit.loaders.colmap.pairs import DatabasePairs, RefusedPairs, database_pairs

NAMES = ("c.jpg", "a.jpg", "b.jpg")
XY = {name: np.arange(12, dtype=np.float32).reshape(6, 2) + 10 * i for i, name in enumerate(NAMES)}
MATCHES = np.array([[0, 5], [1, 4], [2, 2]], dtype=np.uint32)
LINKS = {0: 7, 3: 7}
G = pycolmap.TwoViewGeometryConfiguration


@pytest.fixture
def model(tmp_path):
    """Ids in another order than the database's; image b has a 2D point less than none."""
    points = [tuple((*map(float, xy), LINKS.get(i, 2**64 - 1)) for i, xy in enumerate(XY[name])) for name in NAMES]
    images = tuple(Image(90 - 7 * i, name, points[i]) for i, name in enumerate(NAMES))
    tracks = tuple((image.image_id, i) for image in images for i in LINKS)
    return open_model(
        write_binary(tmp_path / "scene" / "sparse" / "0", Model((Camera(),), images, (Point(7, tracks),)))
    )


@pytest.fixture
def path(tmp_path):
    return write_database(tmp_path / "scene" / "database.db")


def write_database(path, pairs=((0, 1, G.CALIBRATED), (1, 2, G.PLANAR)), extra="stranger.jpg"):
    with pycolmap.Database.open(path) as database:
        camera_id = database.write_camera(
            pycolmap.Camera(model="SIMPLE_PINHOLE", width=640, height=480, params=[500, 320, 240])
        )
        ids = []
        for name in (*NAMES, extra):
            ids.append(database.write_image(pycolmap.Image(name=name, camera_id=camera_id)))
            database.write_keypoints(ids[-1], XY.get(name, XY["a.jpg"]))
        for first, second, config in (*pairs, (0, 3, G.CALIBRATED)):
            geometry = pycolmap.TwoViewGeometry(config=config, inlier_matches=MATCHES)
            database.write_two_view_geometry(ids[first], ids[second], geometry)
    return path


def changed(path, *statements):  # noqa: ANN002
    with closing(sqlite3.connect(path)) as db:
        for statement, values in statements:
            db.execute(statement, values)
        db.commit()
    return path


def read(path, model):
    return [
        (model.images.name[p.first_idx], model.images.name[p.second_idx], p.keypoint_idx.tolist())
        for p in DatabasePairs(path, model).pairs()
    ]


def test_pairs_are_those_of_the_images_names(model, path):
    """The pair with an image that the model lacks is left out, ids are the database's."""
    assert read(path, model) == [("c.jpg", "a.jpg", MATCHES.tolist()), ("a.jpg", "b.jpg", MATCHES.tolist())]


def test_keypoints_are_the_databases(model, path):
    source = DatabasePairs(path, model)
    for image_idx, name in enumerate(model.images.name):
        np.testing.assert_array_equal(source.keypoints_px(image_idx), XY[name])
    for _ in source.pairs():  # by the connection that reads pairs
        np.testing.assert_array_equal(source.keypoints_px(0), XY[model.images.name[0]])


@pytest.mark.parametrize("config", list(G.__members__.values()), ids=str)
def test_one_motion_between_the_images(tmp_path, model, config):
    one = {G.CALIBRATED, G.UNCALIBRATED, G.PLANAR, G.PANORAMIC, G.PLANAR_OR_PANORAMIC, G.CALIBRATED_RIG}
    found = read(write_database(tmp_path / "db", ((0, 1, config),)), model)
    assert len(found) == (config in one)


def test_the_old_schema_is_read(model, path):
    """Before rigs: no such tables, pair ids as now."""
    for table in ("rigs", "rig_sensors", "frames", "frame_data", "pose_priors"):
        changed(path, (f"DROP TABLE {table}", ()))
    assert len(read(path, model)) == 2


UPDATE = "UPDATE two_view_geometries SET {} WHERE pair_id = (SELECT min(pair_id) FROM two_view_geometries)"


@pytest.mark.parametrize(
    ("change", "values", "found"),
    [
        ("data = ?", (b"1234",), "found 4 bytes"),
        ("cols = 3", (), "found 3 rows and 3 columns"),
        ("rows = -1", (), "found -1 rows"),
        ("data = 'text'", (), "found str"),
        ("data = ?", (np.array([[0, 5], [1, 4], [2, 6]], dtype=np.uint32).tobytes(),), "found 6"),
    ],
)
def test_a_damaged_blob_is_named(model, path, change, values, found):
    changed(path, (UPDATE.format(change), values))
    with pytest.raises(MalformedFileError, match=found):
        read(path, model)


def test_pairs_out_of_order_are_refused(model, path):
    """A table whose pair_id is no key could hold a pair a thousand times."""
    copy = "CREATE TABLE copy AS SELECT * FROM two_view_geometries UNION ALL SELECT * FROM two_view_geometries"
    changed(path, (copy, ()), ("DROP TABLE two_view_geometries", ()))
    changed(path, ("ALTER TABLE copy RENAME TO two_view_geometries", ()))
    with pytest.raises(MalformedFileError, match="ascending order"):
        read(path, model)


def test_a_view_is_no_table(model, path):
    changed(path, ("ALTER TABLE two_view_geometries RENAME TO hidden", ()))
    changed(path, ("CREATE VIEW two_view_geometries AS SELECT * FROM hidden", ()))
    with pytest.raises(MalformedFileError, match="no plain table"):
        DatabasePairs(path, model).keypoints_px(0)


def test_a_database_without_an_image_of_the_model_is_refused(model, path):
    changed(path, ("UPDATE images SET name = 'other.jpg' WHERE name = 'a.jpg'", ()))
    with pytest.raises(LoadError, match=r"expected the image 'a.jpg' of the model, found no image of that name"):
        DatabasePairs(path, model)


def test_2d_points_elsewhere_are_refused(model, path):
    """An undistorted copy of the model, or a database that was made again."""
    changed(path, ("UPDATE keypoints SET data = ?", ((XY["a.jpg"] + 7).tobytes(),)))
    at = model.images.name.index("a.jpg")
    with pytest.raises(LoadError, match=r"7 px away.*undistorted"):
        DatabasePairs(path, model).keypoints_px(at)


def test_another_number_of_2d_points_is_refused(model, path):
    changed(path, ("UPDATE keypoints SET data = ?, rows = 5", (XY["a.jpg"][:5].tobytes(),)))
    with pytest.raises(LoadError, match="expected 6 keypoints"):
        DatabasePairs(path, model).keypoints_px(0)


def test_auto_finds_the_database_of_the_scene(model, path):
    assert len(list(database_pairs(model, "auto", "scene").pairs())) == 2
    assert len(list(database_pairs(model, str(path), "scene").pairs())) == 2


def test_auto_without_a_database_says_so_when_it_is_asked(model):
    refused = database_pairs(model, "auto", "the scene")
    assert isinstance(refused, RefusedPairs)
    for question in (refused.pairs, lambda: refused.keypoints_px(0)):
        with pytest.raises(LoadError, match=r"the scene: expected a database\.db beside the model"):
            question()


def test_errors_call_a_model_s_own_database_by_its_place_and_a_named_one_as_it_was_given(model, path):
    changed(path, ("UPDATE keypoints SET data = ?", ((XY["a.jpg"] + 7).tobytes(),)))
    at = model.images.name.index("a.jpg")
    below = "sparse/0"
    shown = {"": "../../database.db", below: "database.db", f"photos/{below}": "photos/database.db"}
    for given, name in shown.items():
        with pytest.raises(LoadError, match=f"^{name}: expected the 2D points of 'a.jpg'"):
            database_pairs(model, "auto", "scene", given).keypoints_px(at)
    with pytest.raises(LoadError, match=f"^{re.escape(str(path))}: expected the 2D points"):
        database_pairs(model, str(path), "scene", below).keypoints_px(at)
    changed(path, ("UPDATE two_view_geometries SET cols = 3", ()))
    with pytest.raises(LoadError, match=r"^database\.db: expected matches of pair"):
        list(database_pairs(model, "auto", "scene", below).pairs())
    changed(path, ("UPDATE images SET name = 'other.jpg' WHERE name = 'a.jpg'", ()))
    with pytest.raises(LoadError, match=r"^database\.db: expected the image 'a.jpg'"):
        database_pairs(model, "auto", "scene", below).keypoints_px(at)


def test_a_named_database_has_to_be_there(model, tmp_path):
    with pytest.raises(LoadError, match=r"nothing\.db"):
        database_pairs(model, str(tmp_path / "nothing.db"), "scene")


def test_the_command_line_asks_the_database_beside_the_model(tmp_path, model, path):
    del path
    assert main(["run", model.location, "-o", str(tmp_path / "run"), "--database", "auto", "--quiet"]) == 0
    rows = pq.read_table(tmp_path / "run" / "models").to_pylist()
    assert rows[0]["witnesses"] == ["pairs"]
    assert pq.read_table(tmp_path / "run" / "images")["num_pairs_strong"].to_pylist() == [0, 0, 0]


def test_the_command_line_says_where_there_is_no_database(tmp_path, model, capsys):
    assert main(["run", model.location, "-o", str(tmp_path / "run"), "--database", "auto", "--quiet"]) == 0
    rows = pq.read_table(tmp_path / "run" / "models").to_pylist()
    assert rows[0]["witnesses"] is None
    assert [each["code"] for each in rows[0]["findings"]].count("database_not_used") == 1
    named = ["--database", str(tmp_path / "nothing.db"), "--quiet"]
    assert main(["run", model.location, "-o", str(tmp_path / "other"), *named]) == 3
    assert "nothing.db" in capsys.readouterr().err
