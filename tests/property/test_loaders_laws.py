"""Laws of loading: the order of records, the format and the choice of ids change nothing but what they must."""

import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from model_writer import UNLINKED, Camera, Frame, Image, Model, Point, Rig, write_binary, write_text
from numpy.testing import assert_array_equal

from sfm_audit.loaders import SparseModel, open_model
from sfm_audit.loaders.assembly.lookup import rows_of
from sfm_audit.loaders.assembly.track_consistency import compare_tracks

LAW = settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
)
NUMBERS = st.floats(-1e6, 1e6)
NAMES = st.text(st.characters(codec="utf-8", exclude_categories=["Cc", "Cs", "Zl", "Zp", "Zs"]), min_size=1, max_size=9)
POSES = st.tuples(*[NUMBERS] * 7)


@st.composite
def models(draw) -> Model:
    """Models of up to four images with any ids, names, poses and links, tracks that need not agree, rigs or none."""
    camera_ids = draw(st.lists(st.integers(0, 2**32 - 1), min_size=1, max_size=3, unique=True))
    image_ids = draw(st.lists(st.integers(0, 2**32 - 1), min_size=1, max_size=4, unique=True))
    point_ids = draw(st.lists(st.integers(0, 2**64 - 2), min_size=1, max_size=5, unique=True))
    links = st.lists(st.tuples(NUMBERS, NUMBERS, st.sampled_from([*point_ids, UNLINKED])), max_size=6).map(tuple)
    cameras = st.sampled_from(camera_ids)
    images = tuple(Image(i, draw(NAMES), draw(links), draw(POSES), draw(cameras)) for i in image_ids)
    elements = st.lists(st.tuples(st.sampled_from(image_ids), st.integers(0, 6)), max_size=6).map(tuple)
    points = tuple(Point(i, draw(elements), draw(st.tuples(*[NUMBERS] * 3)), draw(NUMBERS)) for i in point_ids)
    model = Model(tuple(Camera(i) for i in camera_ids), images, points)
    if draw(st.booleans()):
        sensors = tuple((0, i, draw(POSES)) for i in camera_ids)
        frames = tuple(
            Frame(k, 1, draw(POSES), ((0, image.camera_id, image.image_id),)) for k, image in enumerate(images)
        )
        model = model.but(rigs=(Rig(1, sensors),), frames=frames)
    return model


def assert_same(a: SparseModel, b: SparseModel) -> None:
    for table in ("cameras", "images", "points", "observations"):
        ours, theirs = getattr(a, table), getattr(b, table)
        for name in ours.__slots__:
            assert_array_equal(getattr(ours, name), getattr(theirs, name), err_msg=f"{table}.{name}")
    assert a.findings == b.findings


@LAW
@given(model=models(), data=st.data())
def test_the_order_of_records_does_not_matter(tmp_path_factory, model: Model, data: st.DataObject):
    kinds = ("cameras", "images", "points", "frames")
    shuffled = model.but(
        **{kind: tuple(data.draw(st.permutations(records))) for kind in kinds if (records := getattr(model, kind))}
    )
    for write in (write_binary, write_text):
        a, b = (open_model(write(tmp_path_factory.mktemp("m"), each)) for each in (model, shuffled))
        assert_same(a, b)


@LAW
@given(model=models())
def test_text_and_binary_say_the_same(tmp_path_factory, model: Model):
    a, b = (open_model(write(tmp_path_factory.mktemp("m"), model)) for write in (write_binary, write_text))
    assert (a.file_format, b.file_format) == ("binary", "text")
    assert_same(a, b)


@LAW
@given(model=models())
def test_tracks_are_compared_as_sets(tmp_path_factory, model: Model):
    """The columnar comparison against the definition: two Python sets and their differences."""
    loaded = open_model(write_binary(tmp_path_factory.mktemp("m"), model))
    in_images = {
        (image.image_id, k, point_id)
        for image in model.images
        for k, (_, _, point_id) in enumerate(image.points2d)
        if point_id != UNLINKED
    }
    in_tracks = {(i, k, point.point_id) for point in model.points for i, k in point.track}
    difference = compare_tracks(loaded, _raw_points(model))
    observations = loaded.observations
    image_idx = np.repeat(np.arange(len(loaded.images)), np.diff(observations.offsets))
    ours = {
        (
            int(loaded.images.image_id[image_idx[row]]),
            int(observations.point2d_idx[row]),
            int(loaded.points.point3d_id[observations.point_idx[row]]),
        )
        for row in difference.only_in_images
    }
    assert ours == in_images - in_tracks
    assert {tuple(row) for row in difference.only_in_tracks.tolist()} == in_tracks - in_images


def _raw_points(model: Model):
    from pathlib import Path  # noqa: PLC0415
    from tempfile import TemporaryDirectory  # noqa: PLC0415

    from sfm_audit.loaders.colmap.binary_points import read_points  # noqa: PLC0415

    with TemporaryDirectory() as folder:
        return read_points(write_binary(Path(folder), model) / "points3D.bin")


@given(
    known=st.lists(st.integers(0, 2**64 - 1) | st.integers(0, 40), max_size=30, unique=True),
    asked=st.lists(st.integers(0, 2**64 - 1) | st.integers(0, 40), max_size=30),
)
def test_rows_of_is_a_dictionary(known: list[int], asked: list[int]):
    ids = np.array(sorted(known), dtype=np.uint64)
    expected = [{k: row for row, k in enumerate(sorted(known))}.get(k, -1) for k in asked]
    assert rows_of(ids, np.array(asked, dtype=np.uint64)).tolist() == expected
