"""Models without some of their images: against the definition, and against pycolmap's own reading of them."""

import itertools
import tempfile
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from corpus import REFUSED_BY_PYCOLMAP, parametrize_models
from hypothesis import given, settings
from hypothesis import strategies as st
from model_writer import Image, Point, rig_model, tiny_model, write_binary, write_text

from sfm_audit.loaders import LoadError, open_model
from sfm_audit.reports.export.pruned_model import MODEL_FILES, plan_pruning, write_pruned

FORMATS = {"binary": write_binary, "text": write_text}


def prune(source: Path, removed, target: Path) -> Path:
    model = open_model(source)
    target.mkdir()
    write_pruned(model, plan_pruning(model, set(removed)), target)
    return target


def read(folder: Path) -> pycolmap.Reconstruction:
    """Read the files that this package reads; pycolmap would prefer binary ones."""
    reconstruction = pycolmap.Reconstruction()
    if (folder / "images.bin").exists():
        reconstruction.read_binary(str(folder))
    else:
        reconstruction.read_text(str(folder))
    return reconstruction


def tracks(reconstruction, without=frozenset()):
    return {
        point_id: sorted((e.image_id, e.point2D_idx) for e in point.track.elements if e.image_id not in without)
        for point_id, point in reconstruction.points3D.items()
    }


def assert_equal_on_what_was_kept(source: Path, pruned: Path, removed) -> None:
    """Compare with pycolmap only; the definition of what is kept is written down again here."""
    before, after = read(source), read(pruned)
    kept = {
        point_id: track
        for point_id, track in tracks(before, set(removed)).items()
        if len({image_id for image_id, _ in track}) >= 2
    }
    assert tracks(after) == kept
    assert sorted(after.images) == sorted(set(before.images) - set(removed))
    for point_id in kept:
        old, new = before.points3D[point_id], after.points3D[point_id]
        np.testing.assert_array_equal(old.xyz, new.xyz)
        np.testing.assert_array_equal(old.color, new.color)
        assert old.error == new.error or (np.isnan(old.error) and np.isnan(new.error))
    linked = {image_id: {} for image_id in after.images}
    for point_id, track in kept.items():
        for image_id, point2d_idx in track:
            linked[image_id][point2d_idx] = point_id
    for image_id, new in after.images.items():
        old = before.images[image_id]
        assert old.camera_id == new.camera_id
        np.testing.assert_allclose(old.cam_from_world().matrix(), new.cam_from_world().matrix(), rtol=1e-13, atol=1e-13)
        assert len(old.points2D) == len(new.points2D)
        points2d = list(new.points2D)
        np.testing.assert_array_equal([p.xy for p in old.points2D], [p.xy for p in points2d])
        assert {i: p.point3D_id for i, p in enumerate(points2d) if p.has_point3D()} == linked[image_id]
    assert sorted(after.cameras) == sorted(before.cameras)
    for camera_id, camera in after.cameras.items():
        np.testing.assert_array_equal(camera.params, before.cameras[camera_id].params)
    assert after.is_valid()


@pytest.fixture(scope="module")
def rigs(tmp_path_factory):
    """A model of two rigs with three cameras each, four frames per rig, binary and text."""
    pycolmap.set_random_seed(1)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 2, 3, 4
    options.num_points3D, options.track_length = 60, 5
    reconstruction = pycolmap.synthesize_dataset(options)
    folder = tmp_path_factory.mktemp("rigs")
    for name in FORMATS:
        (folder / name).mkdir()
    reconstruction.write_binary(str(folder / "binary"))
    reconstruction.write_text(str(folder / "text"))
    return folder


@pytest.mark.parametrize("file_format", FORMATS)
@pytest.mark.parametrize("removed", [(), (2,), (1,), (1, 2, 3), (1, 5, 9, 13, 17, 22)])
def test_multi_sensor_rigs_are_cut_by_image(rigs, file_format, removed, tmp_path):
    source = rigs / file_format
    before = read(source)
    pruned = prune(source, removed, tmp_path / "out")
    assert_equal_on_what_was_kept(source, pruned, removed)
    assert {path.suffix for path in pruned.iterdir()} == {".bin" if file_format == "binary" else ".txt"}
    assert {path.name for path in pruned.iterdir()} == {path.name for path in source.iterdir()}
    after = read(pruned)
    assert sorted(after.rigs) == sorted(before.rigs)
    for frame_id, frame in before.frames.items():
        ids = {data.id for data in frame.data_ids} - set(removed)
        assert (frame_id in after.frames) == bool(ids)
        if ids:
            assert {data.id for data in after.frames[frame_id].data_ids} == ids
            np.testing.assert_array_equal(frame.rig_from_world.matrix(), after.frames[frame_id].rig_from_world.matrix())


def test_the_sensors_of_a_cut_frame_that_are_no_cameras_stay(tmp_path):
    source = write_binary(tmp_path / "in", rig_model())
    after = read(prune(source, {4}, tmp_path / "out"))
    frame = after.frames[8]
    assert sorted((int(d.sensor_id.type.value), d.id) for d in frame.data_ids) == [(0, 3), (1, 77)]
    assert 9 in after.frames
    assert 9 not in read(prune(source, {90}, tmp_path / "out2")).frames


@pytest.mark.parametrize("file_format", FORMATS)
def test_every_subset_of_a_small_model(file_format, tmp_path):
    source = FORMATS[file_format](tmp_path / "in", tiny_model())
    for size in range(4):
        for removed in itertools.combinations((3, 4, 90), size):
            pruned = prune(source, removed, tmp_path / f"out{removed}")
            assert {path.name for path in pruned.iterdir()} == {path.name for path in source.iterdir()}, (
                "no rigs made up"
            )
            written = open_model(pruned)
            assert set(written.images.image_id.tolist()) == {3, 4, 90} - set(removed)
            assert len(written.points) == (0 if {3, 4} & set(removed) else 3)


def test_names_with_blanks_survive_in_text(tmp_path):
    source = write_text(tmp_path / "in", tiny_model())
    assert "b c/é.png" in open_model(prune(source, {3}, tmp_path / "out")).images.name


def test_bytes_that_are_no_utf8_survive_in_binary(tmp_path):
    images = (Image(3, b"caf\xe9.jpg", tiny_model().images[0].points2d), *tiny_model().images[1:])
    source = write_binary(tmp_path / "in", tiny_model().but(images=images))
    pruned = prune(source, {90}, tmp_path / "out")
    assert b"caf\xe9.jpg\0" in (pruned / "images.bin").read_bytes()


def test_points_that_had_fewer_than_two_views_go_too(tmp_path):
    model = tiny_model()
    images = (
        Image(3, "a.jpg", ((1.0, 2.0, 5), (3.0, 4.0, 5), (5.0, 6.0, 12))),
        Image(4, "b.jpg", ((1.0, 2.0, 12),)),
    )
    points = (Point(5, ((3, 0), (3, 1))), Point(12, ((3, 2), (4, 0))))
    source = write_binary(tmp_path / "in", model.but(images=images, points=points))
    written = open_model(prune(source, (), tmp_path / "out"))
    assert written.points.point3d_id.tolist() == [12], "two observations in one image are one view"


def test_models_that_contradict_themselves_are_refused_in_one_line(tmp_path):
    model = tiny_model()
    source = write_binary(tmp_path / "in", model.but(points=(Point(5, ((3, 2), (4, 1))), *model.points[1:])))
    with pytest.raises(LoadError, match="images and tracks agree") as caught:
        prune(source, {3}, tmp_path / "out")
    assert "\n" not in str(caught.value)
    assert str(source) in str(caught.value)


def test_links_to_points_that_do_not_exist_are_refused(tmp_path):
    first, *others = tiny_model().images
    images = (Image(first.image_id, first.name, (*first.points2d, (7.0, 8.0, 999))), *others)
    source = write_binary(tmp_path / "in", tiny_model().but(images=images))
    with pytest.raises(LoadError, match="images and tracks agree"):
        prune(source, {90}, tmp_path / "out")


def test_what_pycolmap_refuses_is_one_line(tmp_path):
    images = (*tiny_model().images[:2], Image(90, "x.jpg", camera_id=55))
    source = write_binary(tmp_path / "in", tiny_model().but(images=images))
    with pytest.raises(LoadError, match="pycolmap") as caught:
        prune(source, {3}, tmp_path / "out")
    assert "\n" not in str(caught.value)


@settings(max_examples=25, deadline=None)
@given(data=st.data())
def test_pruning_twice_is_pruning_once(rigs, data):
    ids = open_model(rigs / "binary").images.image_id.tolist()
    first = data.draw(st.sets(st.sampled_from(ids), max_size=len(ids) - 2))
    second = data.draw(st.sets(st.sampled_from(sorted(set(ids) - first)), max_size=2))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        prune(rigs / "binary", first | second, folder / "once")
        prune(prune(rigs / "binary", first, folder / "half"), second, folder / "twice")
        one, two = open_model(folder / "once"), open_model(folder / "twice")
        assert one.images.name == two.images.name
        np.testing.assert_array_equal(one.points.point3d_id, two.points.point3d_id)
        np.testing.assert_array_equal(one.points.xyz_world, two.points.xyz_world)
        np.testing.assert_array_equal(one.observations.xy_px, two.observations.xy_px)
        np.testing.assert_array_equal(one.observations.point_idx, two.observations.point_idx)


@parametrize_models(excluded=REFUSED_BY_PYCOLMAP | {"gtsfm_unsorted_txt"})
def test_models_of_other_people(model_dir, tmp_path):
    model = open_model(model_dir)
    removed = set(model.images.image_id[::3].tolist())
    assert_equal_on_what_was_kept(model_dir, prune(model_dir, removed, tmp_path / "out"), removed)
    assert {path.name for path in (tmp_path / "out").iterdir()} <= MODEL_FILES
