import struct
from pathlib import Path

import numpy as np
import pytest
from model_writer import UNLINKED, Camera, Image, Model, Point, binary_files, rig_model, tiny_model, write_binary
from numpy.testing import assert_array_equal

from sfm_audit.loaders import LoadError, MalformedFileError, TruncatedFileError, open_model
from sfm_audit.loaders.errors import Position


def load(folder: Path, model: Model):
    return open_model(write_binary(folder, model))


def test_a_tiny_model_is_read_field_by_field(tmp_path: Path):
    model = load(tmp_path, tiny_model())
    assert (model.location, model.file_format, model.findings) == (str(tmp_path), "binary", ())
    assert_array_equal(model.cameras.camera_id, [1, 7])
    assert_array_equal(model.camera(1).params, [700.0, 400.0, 300.0, 0.01])
    assert model.images.name == ("a.jpg", "b c/é.png", "no observations.jpg")
    assert_array_equal(model.images.camera_idx, [0, 1, 0])
    assert_array_equal(model.images.num_points2d, [4, 3, 0])
    assert_array_equal(model.images.translation_cam_from_world[0], [0.125, -0.25, 2.0])
    assert_array_equal(model.points.point3d_id, np.array([5, 12, 10**9], dtype=np.uint64))
    assert_array_equal(model.points.stored_error_px, [0.75, 0.5, 1.5])
    assert_array_equal(model.points.xyz_world[1], [1.0, 2.0, 30.0])
    assert_array_equal(model.observations.offsets, [0, 3, 6, 6])
    assert_array_equal(model.observations.point2d_idx, [0, 2, 3, 0, 1, 2])
    assert_array_equal(model.observations.point_idx, [1, 0, 2, 0, 1, 2])
    assert_array_equal(model.observations.xy_px[1], [50.0, 60.0])


def test_ids_up_to_the_largest(tmp_path: Path):
    last_image, last_point = 2**32 - 1, UNLINKED - 1
    ids = (0, 2**53, 2**53 + 1, last_point)
    model = load(
        tmp_path,
        Model(
            cameras=(Camera(0), Camera(2**32 - 2)),
            images=(
                Image(last_image, "z", tuple((float(k), 1.0, i) for k, i in enumerate(ids)), camera_id=2**32 - 2),
                Image(0, "a", tuple((float(k), 2.0, i) for k, i in enumerate(ids)), camera_id=0),
            ),
            points=tuple(Point(i, ((0, k), (last_image, k))) for k, i in enumerate(ids)),
        ),
    )
    assert_array_equal(model.images.image_id, [0, last_image])
    assert_array_equal(model.points.point3d_id, np.array(ids, dtype=np.uint64))
    assert_array_equal(model.observations.point_idx, [0, 1, 2, 3] * 2)
    assert model.findings == ()


@pytest.mark.parametrize("length", [0, 1, 254, 255, 256, 257, 600])
def test_names_of_any_length(tmp_path: Path, length: int):
    model = load(tmp_path, tiny_model().but(images=(Image(1, "n" * length, ((1.0, 2.0, 5),)), Image(2, "next"))))
    assert model.images.name == ("n" * length, "next")
    assert_array_equal(model.observations.xy_px, [[1.0, 2.0]])


def test_bytes_of_a_name_that_are_not_utf8_are_spelled_out(tmp_path: Path):
    model = load(tmp_path, tiny_model().but(images=(Image(1, b"caf\xe9.jpg"),)))
    assert model.images.name == (r"caf\xe9.jpg",)
    assert model.images.name[0].encode("utf-8")


@pytest.mark.parametrize("kind", ["cameras", "images", "points", "rigs", "frames"])
def test_an_id_that_occurs_twice_is_refused(tmp_path: Path, kind: str):
    source = rig_model()
    records = getattr(source, kind)
    with pytest.raises(MalformedFileError, match=r"\.bin: byte \d+: expected a [\w3 ]+ id .* again") as error:
        load(tmp_path, source.but(**{kind: (*records, records[0])}))
    assert error.value.position.number > 8


def test_the_second_of_two_equal_point_ids_is_the_one_named(tmp_path: Path):
    points = (Point(9), Point(7, ((3, 0),)), Point(3), Point(7))
    with pytest.raises(MalformedFileError) as error:
        load(tmp_path, tiny_model().but(points=points))
    assert error.value.position == Position("byte", 8 + 3 * 51 + 8)


def test_a_sensor_that_a_rig_has_twice_is_refused(tmp_path: Path):
    source = rig_model()
    rig = source.rigs[0]
    broken = type(rig)(rig.rig_id, (*rig.sensors, rig.sensors[1]))
    with pytest.raises(MalformedFileError, match="sensor of rig 2"):
        load(tmp_path, source.but(rigs=(broken,)))


@pytest.mark.parametrize("model_id", [-1, 18, 2**31 - 1])
def test_an_unknown_camera_model_is_refused(tmp_path: Path, model_id: int):
    with pytest.raises(MalformedFileError, match=f"from 0 to 17, found model {model_id} of camera 1") as error:
        load(tmp_path, tiny_model().but(cameras=(Camera(1, model_id),)))
    assert error.value.position == Position("byte", 12)


def test_an_image_size_beyond_32_bits_is_refused(tmp_path: Path):
    with pytest.raises(MalformedFileError, match="size below"):
        load(tmp_path, tiny_model().but(cameras=(Camera(1, width=2**32),)))


def test_an_image_without_pixels_is_read(tmp_path: Path):
    assert load(tmp_path, tiny_model().but(cameras=(Camera(1, width=0, height=0),))).camera(0).width == 0


@pytest.mark.parametrize("name", binary_files(rig_model()))
def test_trailing_bytes_are_refused(tmp_path: Path, name: str):
    write_binary(tmp_path, rig_model())
    content = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(content + b"\0")
    with pytest.raises(MalformedFileError, match=r"1 more bytes") as error:
        open_model(tmp_path)
    assert error.value.position == Position("byte", len(content))
    assert error.value.path == str(tmp_path / name)


@pytest.mark.parametrize("count", [1000, 2**40, 2**64 - 1])
@pytest.mark.parametrize("name", binary_files(rig_model()))
def test_counts_that_cannot_fit_are_refused_before_anything_is_allocated(tmp_path: Path, name: str, count: int):
    write_binary(tmp_path, rig_model())
    content = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(struct.pack("<Q", count) + content[8:])
    with pytest.raises(TruncatedFileError, match=f"byte 0: expected {count} "):
        open_model(tmp_path)


@pytest.mark.parametrize("count", [3, 2**40, 2**64 - 1])
def test_a_track_length_that_cannot_fit_names_its_point(tmp_path: Path, count: int):
    points = (Point(1), Point(2, ((3, 0), (3, 1))))
    files = binary_files(tiny_model().but(points=points))
    at = 8 + 51 + 43
    content = bytearray(files["points3D.bin"])
    content[at : at + 8] = struct.pack("<Q", count)
    write_binary(tmp_path, tiny_model())
    (tmp_path / "points3D.bin").write_bytes(content)
    with pytest.raises(
        TruncatedFileError, match=f"byte {at}: expected {count} elements of the track of 3D point 2 of 2"
    ):
        open_model(tmp_path)


def test_a_number_of_2d_points_that_cannot_fit_names_its_image(tmp_path: Path):
    write_binary(tmp_path, tiny_model())
    content = bytearray((tmp_path / "images.bin").read_bytes())
    at = 8 + 64 + len(b"a.jpg\0")
    content[at : at + 8] = struct.pack("<Q", 2**61)
    (tmp_path / "images.bin").write_bytes(content)
    with pytest.raises(TruncatedFileError, match=f"images.bin: byte {at}: expected {2**61} 2D points of image 3"):
        open_model(tmp_path)


def test_a_track_ending_too_late_swallows_no_point(tmp_path: Path):
    """One element too many makes the next record begin in the wrong place: an error, never other points."""
    write_binary(tmp_path, tiny_model())
    content = bytearray((tmp_path / "points3D.bin").read_bytes())
    content[8 + 43] += 1
    (tmp_path / "points3D.bin").write_bytes(content)
    with pytest.raises(LoadError):
        open_model(tmp_path)


def test_a_model_without_anything_is_read(tmp_path: Path):
    model = load(tmp_path, Model())
    assert len(model.cameras) == len(model.images) == len(model.points) == len(model.observations) == 0
    assert_array_equal(model.observations.offsets, [0])
    assert model.observations.xy_px.shape == (0, 2)
