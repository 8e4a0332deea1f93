"""Which layout knows a folder, what the model in it is called, and what is said when a layout is forced."""

from pathlib import Path

import pytest
from model_writer import tiny_model, write_binary, write_text

from sfm_audit.loaders import Discovery, MissingFileError, discover
from sfm_audit.loaders.datasets.layouts import LAYOUTS

# layout, folder below the root, scene, component: as the data sets have them
KNOWN = [
    ("megadepth", "0022/sparse/manhattan/0", "0022", "0"),
    ("megadepth", "5015/sparse/manhattan/12", "5015", "12"),
    ("megascenes", "reconstruct/001/234/sparses/2", "001/234", "2"),
    ("megascenes", "reconstruct/001/234/colmap/0", "001/234", "0"),
    ("megascenes", "eiffel/sparses/1", "eiffel", "1"),
    ("phototourism", "brandenburg_gate/dense/sparse", "brandenburg_gate", "0"),
    ("nerfstudio", "garden/colmap/sparse/0", "garden", "0"),
    ("nerfstudio", "garden/sparse/0", "garden", "0"),
    ("d2net", "0001/sparse", "0001", "0"),
    ("d2net", "0001/sparse-txt", "0001", "0"),
    ("hloc", "outputs/aachen/sfm_superpoint+superglue", "aachen", "sfm_superpoint+superglue"),
    ("hloc", "outputs/aachen/sfm_superpoint+superglue/models/1", "aachen", "sfm_superpoint+superglue/1"),
    ("hloc", "outputs/demo/sfm", "demo", "sfm"),
    ("eth3d", "courtyard/dslr_calibration_undistorted", "courtyard", "dslr_calibration_undistorted"),
    ("eth3d", "courtyard/dslr_calibration_jpg", "courtyard", "dslr_calibration_jpg"),
    ("eth3d", "pipes/dslr_calibration_raw", "pipes", "dslr_calibration_raw"),
    ("eth3d", "delivery_area/rig_calibration", "delivery_area", "rig_calibration"),
    ("scannetpp", "data/0a5c013435/dslr/colmap", "0a5c013435", "dslr"),
    ("scannetpp", "data/0a5c013435/iphone/colmap", "0a5c013435", "iphone"),
    ("imc", "train/church/sfm", "church", "0"),
    ("imc", "train/heritage/cyprus/sfm", "heritage/cyprus", "0"),
    ("phototourism", "phototourism/taj_mahal/dense/sparse", "taj_mahal", "0"),
    ("visloc", "aachen_v1_1/3D-models/aachen_v_1_1", "aachen_v1_1", "aachen_v_1_1"),
    ("visloc", "7scenes_sfm_triangulated/chess/triangulated", "chess", "triangulated"),
    (
        "visloc",
        "CambridgeLandmarks_Colmap_Retriangulated_1024px/KingsCollege/model_train",
        "KingsCollege",
        "model_train",
    ),
    ("nerfstudio", "360_v2/bicycle/sparse/0", "bicycle", "0"),
    ("nerfstudio", "tandt/truck/sparse/0", "truck", "0"),
    ("colmap", "house/dense/2/sparse", "house", "2"),
    ("colmap", "collection/house", "house", "0"),
]


def plant(root: Path, *folders: str) -> Path:
    for folder in folders:
        write_binary(root / folder, tiny_model())
    return root


def names(found: Discovery) -> list[tuple[str, str]]:
    assert found.errors == ()
    return [(ref.scene, ref.component) for ref in found.refs]


@pytest.mark.parametrize(("layout", "folder", "scene", "component"), KNOWN)
def test_a_layout_is_recognised_and_can_be_forced(tmp_path: Path, layout, folder, scene, component):
    plant(tmp_path / "data", folder)
    parts = ("data", *Path(folder).parts)
    assert next(name for name, each in LAYOUTS.items() if each.place(parts)) == layout
    for root in (tmp_path / "data", tmp_path / "data" / folder):
        assert names(discover([root])) == [(scene, component)]
        assert names(discover([root], layout)) == [(scene, component)]
        plain = layout == "nerfstudio" and "colmap" not in folder  # nerfstudio reads it, COLMAP wrote it
        assert [ref.layout for ref in discover([root]).refs] == ["colmap" if plain else layout]


def test_a_mixed_root_takes_each_model_by_its_own_layout(tmp_path: Path):
    plant(
        tmp_path, *(folder for _, folder, _, _ in KNOWN if "sparse-txt" not in folder and folder != "garden/sparse/0")
    )
    expected = {(scene, component) for _, folder, scene, component in KNOWN if folder != "garden/sparse/0"}
    assert set(names(discover([tmp_path]))) == expected


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_forced_layout_takes_its_own_and_leaves_out_the_others(tmp_path: Path, layout):
    folders = {folder: name for name, folder, _, _ in KNOWN if "sparse-txt" not in folder and "models" not in folder}
    root = plant(tmp_path / "data", *folders)
    found = discover([root], layout)
    taken = {Path(ref.model_path).relative_to(root).as_posix() for ref in found.refs}
    left_out = {Path(ref.model_path).relative_to(root).as_posix() for ref in found.left_out}
    assert taken | left_out == set(folders)
    assert not taken & left_out
    assert taken >= {folder for folder, name in folders.items() if name == layout}
    assert bool(left_out) == (layout != "colmap"), "any folder is one of COLMAP's"


@pytest.mark.parametrize("layout", sorted(set(LAYOUTS) - {"colmap"}))
def test_a_wrong_layout_is_told_with_an_example(tmp_path: Path, layout):
    plant(tmp_path / "data", "b", "a", "c", "d")
    found = discover([tmp_path / "data"], layout)
    assert found.refs == ()
    (error,) = found.errors
    assert isinstance(error, MissingFileError)
    assert error.path == str(tmp_path / "data")
    assert LAYOUTS[layout].pattern in str(error)
    assert f"found 4 elsewhere: {tmp_path}/data/a, {tmp_path}/data/b" in str(error)
    assert "leave out --layout" in str(error)
    assert "\n" not in str(error)


def test_of_two_copies_of_one_model_the_binary_one_is_taken(tmp_path: Path):
    write_binary(tmp_path / "0001" / "sparse", tiny_model())
    write_text(tmp_path / "0001" / "sparse-txt", tiny_model())
    write_text(tmp_path / "0002" / "sparse-txt", tiny_model())
    found = discover([tmp_path])
    assert [Path(ref.model_path).relative_to(tmp_path).as_posix() for ref in found.refs] == [
        "0001/sparse",
        "0002/sparse-txt",
    ]
    assert names(found) == [("0001", "0"), ("0002", "0")]
    assert names(discover([tmp_path / "0001/sparse-txt"])) == [("0001", "0")], "unless it is what was asked for"
    assert len(discover([tmp_path], "colmap").refs) == 3, "COLMAP knows no copies"


def test_below_a_model_only_hloc_s_other_components_are_searched(tmp_path: Path):
    plant(tmp_path / "out", "sfm_a", "sfm_a/models/0", "sfm_a/models/3", "sfm_a/other/0", "plain", "plain/models/0")
    assert names(discover([tmp_path])) == [
        ("out", "sfm_a"),
        ("out", "sfm_a/0"),
        ("out", "sfm_a/3"),
        ("plain", "0"),
    ]
    assert len(discover([tmp_path], "colmap").refs) == 2


def test_names_that_collide_get_longer_until_they_do_not(tmp_path: Path):
    plant(tmp_path / "d", "a/colmap/0", "b/colmap/0", "p/s/sparse/0", "q/s/sparse/0", "t/sparse/0", "t/dense/0/sparse")
    plant(tmp_path / "d", "alone/sparse/0")
    assert names(discover([tmp_path / "d"])) == [
        ("a/colmap/0", "0"),
        ("alone", "0"),
        ("b/colmap/0", "0"),
        ("p/s", "0"),
        ("q/s", "0"),
        ("t", "dense/0/sparse"),
        ("t", "sparse/0"),
    ]
    assert names(discover([tmp_path / "d/t"])) == [("t", "dense/0/sparse"), ("t", "sparse/0")]
    keys = {ref.key for ref in discover([tmp_path / "d"]).refs}
    assert len(keys) == 7


def test_loops_and_broken_models_among_the_others(tmp_path: Path):
    plant(tmp_path / "d", "0001/sparse/manhattan/0", "0001/sparse/manhattan/1", "0002/dense/sparse")
    (tmp_path / "d/0001/sparse/manhattan/1/images.bin").write_bytes(b"")
    (tmp_path / "d/0001/sparse/manhattan/2").mkdir()
    (tmp_path / "d/0003/sparse/manhattan/0").mkdir(parents=True)
    (tmp_path / "d/0003/sparse/manhattan/0/cameras.bin").touch()
    (tmp_path / "d/0002/again").symlink_to(tmp_path / "d")
    (tmp_path / "d/0001/nowhere").symlink_to(tmp_path / "gone")
    assert names(discover([tmp_path / "d"])) == [("0001", "0"), ("0001", "1"), ("0002", "0"), ("0003", "0")]


def test_the_size_is_that_of_the_files_that_are_read(tmp_path: Path):
    folder = write_binary(tmp_path / "m", tiny_model())
    size = sum(path.stat().st_size for path in folder.iterdir())
    write_text(folder, tiny_model())
    (ref,) = discover([folder]).refs
    assert ref.num_bytes == size
    (folder / "points3D.bin").unlink()
    (ref,) = discover([folder]).refs
    assert ref.num_bytes == sum(path.stat().st_size for path in folder.glob("*.txt"))
