import hashlib
import os
from pathlib import Path

import pytest
from corpus import needs_corpus

from sfm_audit.loaders import MissingFileError, UnreadableFileError, discover
from sfm_audit.loaders.datasets.discover import scene_and_component


def plant(root: Path, *folders: str, name: str = "images.bin") -> Path:
    for folder in folders:
        (root / folder).mkdir(parents=True, exist_ok=True)
        (root / folder / name).write_bytes(b"x")
    return root


def names(*paths: str | Path) -> list[tuple[str, str, str]]:
    found = discover(paths)
    assert found.errors == ()
    return [(ref.dataset, ref.scene, ref.component) for ref in found.refs]


@pytest.mark.parametrize(
    ("folder", "scene", "component"),
    [
        ("bare", "bare", "0"),
        ("s/sparse/3", "s", "3"),
        ("s/sparse", "s", "0"),
        ("s/colmap/sparse/1", "s", "1"),
        ("s/colmap/sparse", "s", "0"),
        ("s/sparse/manhattan/12", "s", "12"),
        ("s/dense/sparse", "s", "0"),
        ("s/dense/2/sparse", "s", "2"),
        ("collection/0022/sparse/0", "0022", "0"),
        ("a/b", "b", "0"),
    ],
)
def test_layouts(tmp_path: Path, folder: str, scene: str, component: str):
    root = plant(tmp_path / "data", folder)
    assert names(root) == [("data", scene, component)]
    base = Path(folder).name
    assert names(root / folder) == [(base, scene, component)], "the model folder itself"
    assert names((root / folder).parent) == [((root / folder).parent.name, scene, component)], "its parent"


@pytest.mark.parametrize(
    ("parts", "expected"),
    [((), ("", "0")), (("sparse",), ("sparse", "0")), (("sparse", "0"), ("0", "0")), (("x", "sparse"), ("x", "0"))],
)
def test_names_near_the_root_of_the_file_system(parts, expected):
    assert scene_and_component(parts) == expected


def test_a_dataset_root_finds_all_models_in_order(tmp_path: Path):
    plant(tmp_path / "d", "b/sparse/1", "b/sparse/0", "a/sparse/0", "c")
    assert names(tmp_path / "d") == [("d", "a", "0"), ("d", "b", "0"), ("d", "b", "1"), ("d", "c", "0")]


@pytest.mark.parametrize("name", ["cameras.bin", "cameras.txt", "images.txt", "points3D.bin", "points3D.txt"])
def test_any_model_file_makes_a_model(tmp_path: Path, name: str):
    assert len(discover([plant(tmp_path, "m", name=name)]).refs) == 1


@pytest.mark.parametrize("name", ["rigs.bin", "database.db", "cameras.json", "xcameras.bin"])
def test_other_files_do_not(tmp_path: Path, name: str):
    found = discover([plant(tmp_path, "m", name=name)])
    assert found.refs == ()
    assert isinstance(found.errors[0], MissingFileError)


def test_nothing_below_a_model_and_nothing_hidden(tmp_path: Path):
    plant(tmp_path / "d", "m", "m/sparse/0", ".git/sparse/0", "x/.cache")
    assert names(tmp_path / "d") == [("d", "m", "0")]


def test_the_path_as_given_stays_in_model_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    plant(tmp_path / "d", "s/sparse/0")
    monkeypatch.chdir(tmp_path / "d")
    for given, dataset, model_path in (
        (".", "d", "./s/sparse/0"),
        ("s/", "s", "s/sparse/0"),
        ("s/sparse/0", "0", "s/sparse/0"),
        ("s/../s/sparse", "sparse", "s/../s/sparse/0"),
        (Path("s"), "s", "s/sparse/0"),
    ):
        (ref,) = discover([given]).refs
        assert (ref.dataset, ref.scene, ref.component, ref.model_path) == (dataset, "s", "0", model_path)
        assert ref.location == os.path.realpath(tmp_path / "d" / "s" / "sparse" / "0")


def test_the_key_is_made_from_the_location_alone(tmp_path: Path):
    plant(tmp_path / "d", "s/sparse/0")
    (a,), (b,) = discover([tmp_path / "d"]).refs, discover([tmp_path / "d" / "s"]).refs
    assert a.key == b.key == hashlib.sha256(a.location.encode()).hexdigest()[:16]
    assert a != b


def test_several_paths_to_one_model_name_it_once(tmp_path: Path):
    plant(tmp_path / "d", "s/sparse/0", "t/sparse/0")
    (tmp_path / "link").symlink_to(tmp_path / "d" / "s")
    found = names(tmp_path / "link", tmp_path / "d", tmp_path / "d" / "s" / "sparse" / "0")
    assert found == [("d", "t", "0"), ("link", "link", "0")]


def test_a_model_that_one_path_names_as_its_layout_has_it_is_not_left_out_by_another(tmp_path: Path):
    plant(tmp_path / "d", "s/sparse/manhattan/0")
    (tmp_path / "x").symlink_to(tmp_path / "d" / "s" / "sparse" / "manhattan" / "0")
    found = discover([tmp_path / "d", tmp_path / "x"], layout="megadepth")
    assert [(ref.scene, ref.component) for ref in found.refs] == [("s", "0")]
    assert found.left_out == ()
    assert [ref.scene for ref in discover([tmp_path / "x"], layout="megadepth").left_out] == ["x"]


def test_links_are_followed_and_loops_end(tmp_path: Path):
    plant(tmp_path / "elsewhere", "sparse/0")
    (tmp_path / "d" / "s").mkdir(parents=True)
    (tmp_path / "d" / "s" / "sparse").symlink_to(tmp_path / "elsewhere" / "sparse")
    (tmp_path / "d" / "s" / "loop").symlink_to(tmp_path / "d")
    assert [ref.scene for ref in discover([tmp_path / "d"], follow_links=True).refs] == ["s"]


def test_a_bad_path_does_not_hide_the_others(tmp_path: Path):
    plant(tmp_path / "d", "m")
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").write_bytes(b"")
    found = discover([tmp_path / "nowhere", tmp_path / "d", tmp_path / "empty", tmp_path / "file"])
    assert [ref.scene for ref in found.refs] == ["m"]
    assert [type(error) for error in found.errors] == [MissingFileError, MissingFileError, UnreadableFileError]
    assert [error.path for error in found.errors] == [str(tmp_path / name) for name in ("nowhere", "empty", "file")]


def test_a_folder_that_cannot_be_searched_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    plant(tmp_path / "d", "m", "closed/n")
    scandir = os.scandir

    def refuse(path):
        if str(path).endswith("closed"):
            raise PermissionError(13, "Permission denied", str(path))
        return scandir(path)

    monkeypatch.setattr(os, "scandir", refuse)
    found = discover([tmp_path / "d"])
    assert [ref.scene for ref in found.refs] == ["m"]
    assert [error.path for error in found.errors] == [str(tmp_path / "d" / "closed")]
    assert "Permission denied" in str(found.errors[0])


def test_a_folder_in_a_file_s_place_still_counts(tmp_path: Path):
    (tmp_path / "m" / "cameras.bin").mkdir(parents=True)
    assert len(discover([tmp_path]).refs) == 1


@needs_corpus
@pytest.mark.corpus
def test_megadepth_s_layout(corpus: Path):
    assert names(corpus / "megadepth_like" / "MegaDepth_v1_SfM") == [
        ("MegaDepth_v1_SfM", scene, component)
        for scene, component in [("9001", "0"), ("9002", "0"), ("9002", "1"), ("9003", "0"), ("9003", "1")]
    ]
