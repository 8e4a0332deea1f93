from pathlib import Path

import numpy as np
import pycolmap
import pytest
from model_writer import UNLINKED, Camera, Image, Point, rig_model, text_files, tiny_model, write_text
from numpy.testing import assert_array_equal

from sfm_audit.loaders import FindingCode, LoadError, MalformedFileError, TruncatedFileError, open_model
from sfm_audit.loaders.errors import Position


def rewrite(folder: Path, name: str, change) -> Path:
    path = folder / name
    path.write_bytes(change(path.read_bytes()))
    return folder


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_text(tmp_path, tiny_model())


def assert_tiny(folder: Path) -> None:
    model = open_model(folder)
    assert model.images.name == ("a.jpg", "b c/é.png", "no observations.jpg")
    assert_array_equal(model.observations.point_idx, [1, 0, 2, 0, 1, 2])
    assert_array_equal(model.observations.point2d_idx, [0, 2, 3, 0, 1, 2])
    assert_array_equal(model.observations.xy_px[1], [50.0, 60.0])
    assert_array_equal(model.points.xyz_world[1], [1.0, 2.0, 30.0])
    assert model.findings == ()


def test_a_tiny_model(folder: Path):
    assert_tiny(folder)


@pytest.mark.parametrize("name", text_files(tiny_model()))
@pytest.mark.parametrize(
    "change",
    [
        lambda text: text.replace(b"\n", b"\r\n"),
        lambda text: b"\xef\xbb\xbf" + text,
        lambda text: b"\n  \n# another comment\n" + text + b"\n\n# the end\n",
        lambda text: text.replace(b" ", b"  ") if b"b c" not in text else text,
        lambda text: text.replace(b" ", b"\t") if b"b c" not in text else text,
    ],
    ids=["crlf", "byte order mark", "blank lines and comments", "two blanks", "tabs"],
)
def test_layouts_that_mean_the_same(folder: Path, name: str, change):
    assert_tiny(rewrite(folder, name, change))


@pytest.mark.parametrize("name", text_files(tiny_model()))
def test_the_comments_may_be_missing_and_the_last_line_unended(tmp_path: Path, name: str):
    with_observations = tiny_model().but(images=tiny_model().images[:2])
    write_text(tmp_path, with_observations, header=False)
    assert open_model(tmp_path).findings == ()
    model = open_model(rewrite(tmp_path, name, lambda text: text.removesuffix(b"\n")))
    assert [finding.code for finding in model.findings] == [FindingCode.UNTERMINATED_TEXT]
    assert_array_equal(model.observations.point_idx, [1, 0, 2, 0, 1, 2])


@pytest.mark.parametrize("name", ["cameras.txt", "images.txt", "points3D.txt"])
def test_an_unended_last_line_in_a_file_that_states_its_count_is_told(tmp_path: Path, name: str):
    """Public models have such files: editors write them."""
    write_text(tmp_path, tiny_model().but(images=tiny_model().images[:2]))
    rewrite(tmp_path, name, lambda text: text.removesuffix(b"\n"))
    model = open_model(tmp_path)
    assert [finding.code for finding in model.findings] == [FindingCode.UNTERMINATED_TEXT]
    assert_array_equal(model.observations.point_idx, [1, 0, 2, 0, 1, 2])


@pytest.mark.parametrize("header", [True, False])
@pytest.mark.parametrize(
    ("name", "record"), [("images.txt", "image 4"), ("points3D.txt", "3D point 13")], ids=["images", "points"]
)
def test_the_last_number_of_an_unended_line_is_checked_against_the_tracks(tmp_path, name, record, header):
    """A cut of a last number leaves a shorter, valid one; each link is written twice."""
    points2d = ((1.0, 2.0, 12), (3.0, 4.0, 13))
    tracks = (Point(12, ((3, 0), (4, 0))), Point(1, ()), Point(13, ((3, 1), (4, 1))))
    images = (Image(3, "a", points2d), Image(4, "b", points2d))
    write_text(tmp_path, tiny_model().but(images=images, points=tracks), header=header)
    rewrite(tmp_path, name, lambda text: text.removesuffix(b"\n"))
    assert FindingCode.UNTERMINATED_TEXT in {finding.code for finding in open_model(tmp_path).findings}
    cut = (lambda text: text[:-1]) if name == "images.txt" else (lambda text: text[:-1] + b"0")
    with pytest.raises(
        TruncatedFileError, match=rf"expected a line end .* tracks confirm, found neither: {record} has 2 "
    ):
        open_model(rewrite(tmp_path, name, cut))


@pytest.mark.parametrize("header", [True, False])
def test_without_any_track_an_unended_line_is_refused_where_a_count_is_stated(tmp_path, header):
    points = (Point(12), Point(13))
    images = (Image(3, "a", ((1.0, 2.0, 12), (3.0, 4.0, 13))),)
    write_text(tmp_path, tiny_model().but(images=images, points=points), header=header)
    rewrite(tmp_path, "images.txt", lambda text: text.removesuffix(b"\n"))
    if header:
        with pytest.raises(TruncatedFileError, match="no 3D point has a track"):
            open_model(tmp_path)
    else:
        assert FindingCode.UNTERMINATED_TEXT in {finding.code for finding in open_model(tmp_path).findings}


@pytest.mark.parametrize("tail", [b"# the end", b"  "], ids=["comment", "blanks"])
@pytest.mark.parametrize("name", ["images.txt", "points3D.txt"])
def test_an_unended_comment_cuts_no_record(tmp_path, name, tail):
    write_text(tmp_path, tiny_model().but(images=tiny_model().images[:2]))
    (tmp_path / name).write_bytes((tmp_path / name).read_bytes() + tail)
    assert [finding.code for finding in open_model(tmp_path).findings] == [FindingCode.UNTERMINATED_TEXT]


def test_fewer_records_than_stated_and_no_line_end_are_a_cut(folder):
    rewrite(folder, "points3D.txt", lambda text: text.replace(b"points: 3", b"points: 4").removesuffix(b"\n"))
    with pytest.raises(TruncatedFileError, match="expected 4 3D points, as its own comment says, found 3"):
        open_model(folder)


@pytest.mark.parametrize("line", [3, 4])
def test_commas_are_refused_as_they_may_be_decimal_commas(folder: Path, line: int):
    lines = (folder / "images.txt").read_bytes().split(b"\n")
    lines[line] = lines[line].replace(b" ", b", ")
    (folder / "images.txt").write_bytes(b"\n".join(lines))
    with pytest.raises(MalformedFileError, match=rf"images.txt: line {line + 1}: expected .*, found .*,"):
        open_model(folder)


def test_ids_never_pass_through_a_float(tmp_path: Path):
    ids = (2**53, 2**53 + 1, UNLINKED - 1, 3)
    points2d = tuple((float(k), 1.0, i) for k, i in enumerate(ids))
    model = tiny_model().but(
        images=(Image(1, "a", points2d), Image(2, "b", points2d)),
        points=tuple(Point(i, ((1, k), (2, k))) for k, i in enumerate(ids)),
    )
    loaded = open_model(write_text(tmp_path, model))
    assert_array_equal(loaded.points.point3d_id, np.array(sorted(ids), dtype=np.uint64))
    assert_array_equal(loaded.observations.point_idx, [1, 2, 3, 0] * 2)
    assert FindingCode.TRACKS_DISAGREE not in {finding.code for finding in loaded.findings}


def test_the_largest_id_means_unlinked_as_minus_one_does(folder: Path):
    rewrite(folder, "images.txt", lambda text: text.replace(b" -1 ", b" 18446744073709551615 "))
    assert_tiny(folder)


def test_numbers_that_are_not_finite_are_read(folder: Path):
    rewrite(folder, "points3D.txt", lambda text: text.replace(b"30.0", b"-nan").replace(b"0.125", b"inf"))
    model = open_model(folder)
    assert np.isnan(model.points.xyz_world[1, 2])
    assert model.points.xyz_world[2, 1] == np.inf


@pytest.mark.parametrize(
    ("name", "old", "new", "line", "message"),
    [
        ("cameras.txt", b"PINHOLE", b"PINHOLLE", 4, r"camera model .*'SIMPLE_PINHOLLE'"),
        ("cameras.txt", b" 240.0", b"", 4, r"3 parameters of SIMPLE_PINHOLE, found 2"),
        ("cameras.txt", b" 240.0", b" 240.0 1", 4, r"3 parameters of SIMPLE_PINHOLE, found 4"),
        ("cameras.txt", b"640", b"6_40", 4, r"an image width .*'6_40'"),
        ("cameras.txt", b"240.0", b"2_40.0", 4, r"'2_40.0'"),
        ("cameras.txt", b"7 SIMPLE", b"1 SIMPLE", 5, r"camera id .*id 1 again"),
        ("images.txt", b"3 1.0", b"-3 1.0", 4, r"an image id .*'-3'"),
        ("images.txt", b"3 1.0", b"4294967296 1.0", 4, r"an image id .*'4294967296'"),
        ("images.txt", b"3 1.0", b"3 one", 4, r"the pose of image 3, numbers, found 'one'"),
        ("images.txt", b"1 a.jpg", b"1", 4, r"IMAGE_ID .* found 9 values"),
        ("images.txt", b"20.25 12", b"20.25", 5, r"X Y POINT3D_ID .* 11 values"),
        ("images.txt", b"20.25 12", b"20.25 12.5", 5, r"a 3D point id or -1 .*'12.5'"),
        ("images.txt", b"20.25 12", b"20.25 -2", 5, r"a 3D point id or -1 .*'-2'"),
        ("images.txt", b"20.25 12", b"20.25 18446744073709551616", 5, r"3D point id"),
        ("images.txt", b"20.25 12", b"20.25-1 12", 5, r"'20.25-1'"),
        ("images.txt", b"4 1.0", b"3 1.0", 6, r"image id .*id 3 again"),
        ("points3D.txt", b"5 0.5", b"5 x", 4, r"all numbers, found 'x'"),
        ("points3D.txt", b"5 0.5", b"-5 0.5", 4, r"a 3D point id .*'-5'"),
        ("points3D.txt", b"5 0.5", b"5.5 0.5", 4, r"a 3D point id .*'5.5'"),
        ("points3D.txt", b"12 1.0", b"5 1.0", 5, r"3D point id .*id 5 again"),
        ("points3D.txt", b"0.75 3 2", b"0.75 3", 4, r"POINT3D_ID .* 11 values"),
        ("points3D.txt", b"0.75 3 2", b"0.75 3 -1", 4, r"POINT2D_IDX .*'-1'"),
        ("points3D.txt", b"0.75 3 2", b"0.75 3.5 2", 4, r"IMAGE_ID .*'3.5'"),
        ("points3D.txt", b"0.75 3 2", b"0.75 3 1_0", 4, r"all numbers, found '1_0'"),
        ("points3D.txt", b" 1 2 3 0.75 3 2 4 0", b"", 4, r"POINT3D_ID .* 4 values"),
    ],
)
def test_wrong_text_is_refused_with_its_line(folder: Path, name, old, new, line, message):
    before = (folder / name).read_bytes()
    assert old in before
    rewrite(folder, name, lambda text: text.replace(old, new, 1))
    with pytest.raises(MalformedFileError, match=message) as error:
        open_model(folder)
    assert error.value.position == Position("line", line)
    assert error.value.path == str(folder / name)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", text_files(tiny_model()))
def test_a_binary_file_under_a_text_name_is_refused(folder: Path, name: str):
    rewrite(folder, name, lambda _: b"\x01\0\0\0\0\0\0\0")
    with pytest.raises(MalformedFileError, match="expected text, found a NUL byte"):
        open_model(folder)


@pytest.mark.parametrize("name", text_files(tiny_model()))
def test_a_web_page_under_a_text_name_is_refused(folder: Path, name: str):
    rewrite(folder, name, lambda _: b"<!DOCTYPE html>\n<html><body>404: not found</body></html>\n")
    with pytest.raises(LoadError):
        open_model(folder)


def test_rigs_of_another_kind_of_sensor(tmp_path: Path):
    write_text(tmp_path, rig_model())
    rewrite(tmp_path, "rigs.txt", lambda text: text.replace(b"CAMERA 7", b"KAMERA 7"))
    with pytest.raises(MalformedFileError, match=r"rigs.txt: line 4: expected a sensor type .*'KAMERA'"):
        open_model(tmp_path)


@pytest.mark.parametrize(("name", "record"), [("rigs.txt", b"2 3"), ("frames.txt", b"8 2")])
def test_rig_lines_that_end_too_early_or_too_late(tmp_path: Path, name: str, record: bytes):
    write_text(tmp_path, rig_model())
    whole = (tmp_path / name).read_bytes()
    first = next(line for line in whole.split(b"\n") if line.startswith(record))
    for wrong in (first + b" 5", first.rsplit(b" ", 1)[0]):
        rewrite(tmp_path, name, lambda _, wrong=wrong: whole.replace(first, wrong))
        with pytest.raises(MalformedFileError, match=rf"{name}: line 4"):
            open_model(tmp_path)


def test_a_wrong_comment_about_the_count_is_a_finding(folder: Path):
    rewrite(folder, "images.txt", lambda text: text.replace(b"images: 3", b"images: 12"))
    rewrite(folder, "points3D.txt", lambda text: text.replace(b"points: 3", b"points: 2"))
    findings = open_model(folder).findings
    assert [(f.code, f.count) for f in findings] == [(FindingCode.STATED_COUNT_DIFFERS, n) for n in (9, 1)]
    assert "says that it holds 12 images, and holds 3" in findings[0].text


@pytest.mark.parametrize(
    ("name", "keep", "kind"),
    [("cameras.txt", 4, "cameras"), ("images.txt", 5, "images"), ("points3D.txt", 4, "3D points")],
)
def test_fewer_records_than_stated_are_a_cut_where_others_refer_to_them(folder: Path, name: str, keep: int, kind: str):
    rewrite(folder, name, lambda text: b"\n".join(text.split(b"\n")[:keep]) + b"\n")
    with pytest.raises(TruncatedFileError, match=rf"{name}: line {keep}: expected \d {kind}, as its own comment says"):
        open_model(folder)


@pytest.mark.parametrize("name", ["images.txt", "points3D.txt"])
def test_none_of_the_stated_records_is_a_cut_even_where_nothing_refers_to_them(tmp_path: Path, name: str):
    unlinked = tuple(Image(i, f"{i}", ((1.0, 2.0, UNLINKED),)) for i in (1, 2, 3))
    write_text(tmp_path, tiny_model().but(images=unlinked, points=(Point(1), Point(2))))
    rewrite(tmp_path, name, lambda text: b"\n".join(text.split(b"\n")[:3]) + b"\n")
    with pytest.raises(TruncatedFileError, match=r"as its own comment says, found 0"):
        open_model(tmp_path)


def test_points_that_are_all_missing_are_a_cut(tmp_path: Path):
    write_text(tmp_path, tiny_model(), header=False)
    (tmp_path / "points3D.txt").write_bytes(b"# 3D point list\n")
    with pytest.raises(TruncatedFileError, match="the 3D points that other files refer to, found 0"):
        open_model(tmp_path)


@pytest.mark.parametrize("name", ["cameras.txt", "images.txt"])
def test_a_file_of_comments_is_no_model(tmp_path: Path, name: str):
    write_text(tmp_path, tiny_model(), header=False)
    (tmp_path / name).write_bytes(b"# nothing here\n")
    with pytest.raises(TruncatedFileError, match="no comment that says there are none"):
        open_model(tmp_path)


def test_the_points2d_line_may_be_empty_but_not_missing(folder: Path):
    rewrite(folder, "images.txt", lambda text: text.removesuffix(b"\n"))
    with pytest.raises(TruncatedFileError, match="a line of POINTS2D"):
        open_model(folder)


def test_known_poses_may_have_an_empty_points_file(tmp_path: Path):
    """As COLMAP's FAQ makes them, and pycolmap reads them."""
    write_text(
        tmp_path,
        tiny_model().but(cameras=(Camera(1),), images=(Image(1, "a.jpg"), Image(2, "b.jpg")), points=()),
        header=False,
    )
    (tmp_path / "points3D.txt").write_bytes(b"")
    model = open_model(tmp_path)
    assert len(model.images) == pycolmap.Reconstruction(str(tmp_path)).num_images() == 2
    assert len(model.points) == 0
    assert [finding.code for finding in model.findings] == [FindingCode.EMPTY_MODEL]


@pytest.mark.parametrize("name", text_files(tiny_model()))
def test_an_empty_file_that_something_is_missing_from_is_refused(folder: Path, name: str):
    (folder / name).write_bytes(b"")
    with pytest.raises(TruncatedFileError):
        open_model(folder)


def test_many_points_are_numbered_by_their_lines(tmp_path: Path):
    """More points than are parsed at once, the wrong one in the second batch."""
    points = tuple(Point(k + 1) for k in range(5000))
    write_text(tmp_path, tiny_model().but(cameras=(Camera(1),), images=(Image(1, "a"),), points=points))
    assert len(open_model(tmp_path).points) == 5000
    rewrite(tmp_path, "points3D.txt", lambda text: text.replace(b"\n4500 0.5", b"\n4500 half"))
    with pytest.raises(MalformedFileError, match=r"line 4503: .*'half'"):
        open_model(tmp_path)
