"""Position priors of databases that pycolmap wrote and of CSV files: numbers of pycolmap, damage."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from model_writer import Camera, Image, Model, Point, write_binary
from numpy.testing import assert_allclose

from sfm_audit.loaders import LoadError, open_model
from sfm_audit.loaders.evidence import NotAsked
from sfm_audit.loaders.references.geodesy import ecef_of, enu_of
from sfm_audit.loaders.references.positions import priors_of, read_priors

NAMES = ("b.jpg", "a.jpg", "c.jpg")
PLACES = np.array([[47.37, 8.54, 408.0], [47.3701, 8.5402, 410.0], [47.3703, 8.5401, 409.0]])
COVARIANCE = np.array([[4.0, 1.0, 0.0], [1.0, 9.0, 0.5], [0.0, 0.5, 25.0]])
SYSTEMS = pycolmap.PosePriorCoordinateSystem


def write_database(path, system=SYSTEMS.WGS84, positions=PLACES, covariance=COVARIANCE):
    with pycolmap.Database.open(path) as database:
        camera = pycolmap.Camera(model="SIMPLE_PINHOLE", width=640, height=480, params=[500, 320, 240])
        camera_id = database.write_camera(camera)
        for name, position in zip(NAMES, positions, strict=True):
            image_id = database.write_image(pycolmap.Image(name=name, camera_id=camera_id))
            prior = pycolmap.PosePrior(position=position, coordinate_system=system)
            prior.position_covariance = covariance
            prior.corr_data_id = pycolmap.data_t(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_id), image_id)
            database.write_pose_prior(prior)
    return path


@pytest.fixture
def model(tmp_path):
    images = tuple(Image(9 - i, name, ((1.0, 2.0, 7),)) for i, name in enumerate((*NAMES, "stranger.jpg")))
    tracks = tuple((image.image_id, 0) for image in images)
    return open_model(write_binary(tmp_path / "sparse" / "0", Model((Camera(),), images, (Point(7, tracks),))))


def pycolmap_s_earth():
    """GPSTransform of WGS84; 4.1 misspells the name of the ellipsoids."""
    ellipsoids = getattr(pycolmap, "GPSTransformEllipsoid", None) or pycolmap.GPSTransfromEllipsoid
    return pycolmap.GPSTransform(ellipsoids.WGS84)


@pytest.mark.parametrize("place", [(0.0, 0.0, 0.0), (90.0, 0.0, 10.0), (-33.9, 151.2, 58.0), (47.0, -179.9, 8848.0)])
def test_the_earth_is_pycolmap_s(place):
    """pycolmap 4.2.1, GPSTransform of WGS84 (its default ellipsoid is GRS80, 0.1 mm away)."""
    near = np.array(place) + np.random.default_rng(1).normal(0, 0.01, (20, 3)) * [1, 1, 1000]
    earth = pycolmap_s_earth()
    assert_allclose(ecef_of(near), earth.ellipsoid_to_ecef(near), rtol=1e-13, atol=1e-6)
    assert_allclose(enu_of(near, np.array(place)), earth.ellipsoid_to_enu(near, *place), atol=1e-6)


def test_priors_of_a_database_are_metres_about_their_middle(tmp_path, model):
    path = write_database(tmp_path / "database.db")
    found = priors_of(model, "auto", "shown")
    assert not Path(found.location).is_absolute()
    order = [NAMES.index(name) for name in model.images.name if name in NAMES]
    known = [i for i, name in enumerate(model.images.name) if name in NAMES]
    wanted = pycolmap_s_earth().ellipsoid_to_enu(PLACES, *PLACES[order[1]])
    assert_allclose(found.position[known], wanted[order], atol=1e-6)
    assert_allclose(found.covariance[known], np.tile(COVARIANCE, (3, 1, 1)))
    assert np.isnan(found.position[model.image_idx("stranger.jpg")]).all()
    assert found.is_metric
    assert priors_of(model, str(path), "").location == str(path)


@pytest.mark.parametrize(
    ("below", "up", "shown"),
    [
        ("", 0, "database.db"),
        ("", 2, "../../database.db"),
        ("town/sparse/0", 2, "town/database.db"),
        ("sparse/0", 2, "database.db"),
        ("0", 2, "../database.db"),
    ],
)
def test_findings_call_a_model_s_database_by_its_place_in_the_data_set(tmp_path, model, below, up, shown):
    folder = tmp_path / "town" / "sparse" / "0"
    folder.mkdir(parents=True)
    write_database((folder, *folder.parents)[up] / "database.db")
    assert priors_of(replace(model, location=str(folder)), "auto", "", below).location == shown


def test_cartesian_and_unsaid_systems_are_taken_as_they_are(tmp_path, model):
    for system, is_metric in ((SYSTEMS.CARTESIAN, True), (SYSTEMS.UNDEFINED, False)):
        path = write_database(tmp_path / f"{system}.db", system, covariance=np.full((3, 3), np.nan))
        found = priors_of(model, str(path), "")
        assert_allclose(found.position[model.image_idx("a.jpg")], PLACES[1])
        assert np.isnan(found.covariance).all()
        assert found.is_metric == is_metric


def test_the_table_before_rigs_is_read(tmp_path, model):
    path = write_database(tmp_path / "d.db", SYSTEMS.CARTESIAN)
    with closing(sqlite3.connect(path)) as db:
        db.execute("DROP INDEX pose_prior_data_assignment")
        db.execute("ALTER TABLE pose_priors RENAME COLUMN corr_data_id TO image_id")
        db.execute("ALTER TABLE pose_priors DROP COLUMN corr_sensor_type")
        db.commit()
    assert_allclose(priors_of(model, str(path), "").position[model.image_idx("c.jpg")], PLACES[2])


@pytest.mark.parametrize(
    ("statement", "value", "what"),
    [
        ("UPDATE pose_priors SET position = ?", b"\0" * 23, "24 bytes"),
        ("UPDATE pose_priors SET position_covariance = ?", "text", "72 bytes"),
        ("UPDATE pose_priors SET coordinate_system = ? WHERE pose_prior_id = 1", 1, "one coordinate system"),
        ("UPDATE pose_priors SET coordinate_system = ?", 7, "one coordinate system"),
        ("UPDATE pose_priors SET corr_data_id = ?, corr_sensor_id = pose_prior_id", 1, "one prior"),
        ("UPDATE pose_priors SET position = ?", np.array([91.0, 0, 0]).tobytes(), "latitude"),
        ("UPDATE pose_priors SET position_covariance = ?", (-np.eye(3)).tobytes(), "symmetric and positive"),
        ("UPDATE pose_priors SET position_covariance = ?", np.diag([1, 1, np.nan]).tobytes(), "symmetric and"),
    ],
)
def test_a_damaged_database_is_refused_and_auto_says_so(tmp_path, model, statement, value, what):
    path = write_database(tmp_path / "database.db")
    with closing(sqlite3.connect(path)) as db:
        db.execute(statement, (value if isinstance(value, (bytes, str, int)) else bytes(value),))
        db.commit()
    with pytest.raises(LoadError, match=what):
        priors_of(model, str(path), "")
    silent = priors_of(model, "auto", "shown")
    assert isinstance(silent, NotAsked)
    assert what in silent.reason


def test_what_is_no_table_is_not_run(tmp_path, model):
    path = write_database(tmp_path / "d.db")
    with closing(sqlite3.connect(path)) as db:
        db.execute("ALTER TABLE pose_priors RENAME TO p")
        db.execute("CREATE VIEW pose_priors AS SELECT * FROM p")
        db.commit()
    with pytest.raises(LoadError, match="no plain table"):
        priors_of(model, str(path), "")


def test_priors_of_nobody_are_not_asked(tmp_path, model):
    silent = priors_of(model, "auto", "shown")
    assert isinstance(silent, NotAsked)
    assert "a database.db beside the model" in silent.reason
    with pycolmap.Database.open(tmp_path / "database.db"):
        pass
    assert isinstance(priors_of(model, "auto", ""), NotAsked)
    path = tmp_path / "p.csv"
    path.write_text("name,x,y,z\nq.jpg,1,2,3\n")
    assert isinstance(priors_of(model, str(path), ""), NotAsked)


def csv(folder, text):
    path = folder / "priors.csv"
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("comment", "in_metres"),
    [("# unit = m", True), ("#unit= m, ENU", True), ("# ENU unit =m", True), ("# unit=mm", False)],
)
def test_a_comment_says_that_a_csv_is_in_metres(tmp_path, comment, in_metres):
    assert read_priors(csv(tmp_path, f"{comment}\nname,x,y,z\na,1,2,3\nb,4,5,6\n"))[1] is in_metres


def test_columns_of_a_csv(tmp_path):
    stored, is_metric = read_priors(csv(tmp_path, "# unit=m\nname,x,y,z,sd\na,1,2,3,2\nb,4,5,6,3\nc,,,,\n"))
    assert stored.names == ("a", "b")
    assert_allclose(stored.position, [[1, 2, 3], [4, 5, 6]])
    assert_allclose(stored.covariance, [4 * np.eye(3), 9 * np.eye(3)])
    assert is_metric
    stored, is_metric = read_priors(csv(tmp_path, "z,name,x,y,sd_x,sd_y,sd_z\n3,a,1,2,1,2,3\n"))
    assert_allclose(stored.position, [[1, 2, 3]])
    assert_allclose(stored.covariance, [np.diag([1, 4, 9])])
    assert not is_metric
    head = "name,lat,lon,alt,cov_xx,cov_xy,cov_xz,cov_yy,cov_yz,cov_zz"
    stored, is_metric = read_priors(csv(tmp_path, f"{head}\na,47,8,400,4,1,0,9,0.5,25\n"))
    assert_allclose(stored.covariance[0], COVARIANCE)
    assert is_metric
    stored, _ = read_priors(csv(tmp_path, "name,x,y,z\na,1,2,3\n"))
    assert np.isnan(stored.covariance).all()


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("", "an empty file"),
        ("name,x,y\na,1,2\n", "columns name and x, y, z"),
        ("name,x,y,z\na,1,2\n", "4 cells"),
        ("name,x,y,z\na,1,2,3\na,1,2,3\n", "each name once"),
        ("name,x,y,z\na,1,2,3", "line end"),
        ("name,x,y,z\na,1,2,1_0\n", "numbers"),
        ("name,x,y,z\na,1,2,1e300\n", "a position"),
        ("name,lat,lon,alt\na,91,2,3\n", "latitude"),
        ("name,x,y,z,sd\na,1,2,3,0\n", "symmetric and positive"),
        ("name,x,y,z,sd\na,1,2,3,-1\n", "symmetric and positive"),
        ("name,x,y,z,sd\na,1,2,3,1e200\n", "symmetric and positive"),
        ("name,x,y,z,x\na,1,2,3,1\n", "columns"),
        ('name,x,y,z\n"a,1,2,3\n', "CSV"),
        ("name,x,y,z\n\xff,1,2,\0\n", "NUL"),
    ],
)
def test_what_is_wrong_with_a_csv_is_said(tmp_path, text, what):
    with pytest.raises(LoadError, match=what):
        read_priors(csv(tmp_path, text))


@pytest.mark.parametrize("text", ["name" + ",x" * 100_000 + "\n", "[" * 100_000 + "\n"])
def test_a_head_of_many_columns_or_one_long_one_is_a_short_line(tmp_path, text):
    with pytest.raises(LoadError, match=r"found (100001|1): '") as caught:
        read_priors(csv(tmp_path, text))
    assert len(str(caught.value).removeprefix(str(tmp_path))) < 400


def test_cut_anywhere_a_database_is_refused_or_whole(tmp_path, model):
    content = write_database(tmp_path / "d.db").read_bytes()
    path = tmp_path / "cut.db"
    for size in range(0, len(content), len(content) // 40):
        path.write_bytes(content[:size])
        with pytest.raises(LoadError):
            priors_of(model, str(path), "")


def test_priors_from_before_they_had_covariances(tmp_path):
    path = write_database(tmp_path / "database.db")
    with closing(sqlite3.connect(path)) as db, db:
        db.execute("ALTER TABLE pose_priors RENAME TO newer")
        db.execute("CREATE TABLE pose_priors (image_id INTEGER PRIMARY KEY, position BLOB, coordinate_system INTEGER)")
        db.execute("INSERT INTO pose_priors SELECT corr_data_id, position, coordinate_system FROM newer")
    stored, is_metric = read_priors(path)
    assert_allclose(stored.position, PLACES)
    assert np.isnan(stored.covariance).all()
    assert is_metric


def test_a_database_without_priors_says_which_table_it_lacks(tmp_path):
    path = write_database(tmp_path / "database.db")
    with closing(sqlite3.connect(path)) as db, db:
        db.execute("DROP TABLE pose_priors")
    with pytest.raises(LoadError, match=r"tables of images and pose_priors, found no such table: pose_priors"):
        read_priors(path)
