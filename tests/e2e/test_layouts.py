"""sfm-audit run over trees as data sets lay them out: --list, --layout, --scene, --component, --scene-list, limits."""

from pathlib import Path

import pandas as pd
import pytest
from corpus import needs_corpus
from run_samples import part_times, truncate, write_models

from sfm_audit.audit.cli.main import main
from sfm_audit.loaders.datasets.layouts import LAYOUTS

FOLDERS = {
    "MegaDepth/0001/sparse/manhattan/0": ("0001", "0"),
    "MegaDepth/0001/sparse/manhattan/1": ("0001", "1"),
    "MegaScenes/reconstruct/001/234/sparses/0": ("001/234", "0"),
    "hloc/outputs/aachen/sfm_sp+sg": ("aachen", "sfm_sp+sg"),
    "hloc/outputs/aachen/sfm_sp+sg/models/1": ("aachen", "sfm_sp+sg/1"),
    "phototourism/gate/dense/sparse": ("gate", "0"),
    "splats/garden/colmap/sparse/0": ("garden", "0"),
}


@pytest.fixture(scope="session")
def model(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("layouts")
    write_models(folder, ["m"])
    return folder / "m/sparse/0"


@pytest.fixture(autouse=True)
def tree(model, tmp_path, monkeypatch) -> Path:
    """All layouts below data/, in the working folder."""
    monkeypatch.chdir(tmp_path)
    for folder in FOLDERS:
        target = tmp_path / "data" / folder
        target.mkdir(parents=True)
        for file in model.iterdir():
            (target / file.name).write_bytes(file.read_bytes())
    return tmp_path / "data"


def listed(capsys, *args: str, code: int = 0) -> list[list[str]]:
    assert main(["run", *args, "--list"]) == code
    return [line.split("\t") for line in capsys.readouterr().out.splitlines() if line]


def scenes(run: str = "RUN") -> set[tuple[str, str]]:
    models = pd.read_parquet(Path(run, "models"))
    return set(zip(models["scene"], models["component"], strict=True))


def layout_of(folder: str) -> str:
    return next(name for name, layout in LAYOUTS.items() if layout.place(("data", *Path(folder).parts)))


def test_list_says_what_there_is(capsys, model):
    num_bytes = sum(file.stat().st_size for file in model.glob("*.bin"))
    rows = listed(capsys, "data")
    assert sorted(rows) == sorted(
        ["data", scene, component, "5", str(num_bytes), f"data/{folder}", layout_of(folder)]
        for folder, (scene, component) in FOLDERS.items()
    )
    assert not Path("RUN").exists()


def test_list_says_what_is_broken_and_lists_the_others(capsys, tree):
    (tree / "phototourism/gate/dense/sparse/images.bin").write_bytes(b"123")
    assert main(["run", "data", "--list"]) == 3
    out, err = capsys.readouterr()
    assert len(out.splitlines()) == len(FOLDERS)
    assert "data\tgate\t0\t-\t" in out
    assert err.count("\n") == 1
    assert "phototourism/gate/dense/sparse/images.bin" in err


def test_a_run_takes_all_and_names_them():
    assert main(["run", "data", "-o", "RUN", "--quiet", "--jobs", "1"]) == 0
    assert scenes() == set(FOLDERS.values())
    assert set(pd.read_parquet("RUN/images")["model_path"]) == {f"data/{folder}" for folder in FOLDERS}


def test_broken_models_in_a_mixed_tree_cost_a_line_each(tree, capsys):
    broken = ["MegaDepth/0001/sparse/manhattan/1", "hloc/outputs/aachen/sfm_sp+sg"]
    for folder in broken:
        truncate(tree / folder / "points3D.bin")
    assert main(["run", "data", "-o", "RUN", "--jobs", "1"]) == 3
    err = capsys.readouterr().err
    assert err.count("\n") == 2
    assert all(folder in err for folder in broken)
    assert scenes() == set(FOLDERS.values()) - {FOLDERS[folder] for folder in broken}


def test_a_layout_can_be_forced(capsys):
    assert [row[1] for row in listed(capsys, "data", "--layout", "megascenes")] == ["001/234"]
    assert main(["run", "data/splats", "-o", "RUN", "--layout", "megadepth"]) == 3
    out, err = capsys.readouterr()
    assert (out, err.count("\n")) == ("", 1)
    assert "data/splats: expected models laid out as megadepth" in err
    assert "data/splats/garden/colmap/sparse/0; leave out --layout" in err
    assert not Path("RUN").exists()
    assert main(["run", "data", "-o", "RUN", "--layout", "mega"]) == 2
    assert "nerfstudio" in capsys.readouterr().err


def test_scenes_and_components_can_be_chosen(capsys):
    assert [row[2] for row in listed(capsys, "data", "--scene", "0001")] == ["0", "1"]
    assert [row[1] for row in listed(capsys, "data", "--scene", "g*")] == ["garden", "gate"]
    assert [row[1:3] for row in listed(capsys, "data", "--component", "[1-9]")] == [["0001", "1"]]
    Path("train.txt").write_text("# scenes to train on\n0001/1\n001/234\n", encoding="utf-8")
    rows = listed(capsys, "data", "--scene-list", "train.txt", "--scene", "gate")
    assert [row[1:3] for row in rows] == [["0001", "1"], ["001/234", "0"], ["gate", "0"]]
    assert main(["run", "data", "--scene-list", "train.txt", "--quiet", "-o", "RUN"]) == 0
    assert scenes() == {("0001", "1"), ("001/234", "0")}


def test_names_that_fit_nothing_cost_a_line_and_3(capsys):
    Path("train.txt").write_text("gate\n9999\n", encoding="utf-8")
    assert main(["run", "data", "--scene-list", "train.txt", "--scene", "nowhere", "-o", "RUN"]) == 3
    err = capsys.readouterr().err
    assert err.count("\n") == 2
    assert "train.txt: line 2" in err
    assert "--scene 'nowhere'" in err
    assert scenes() == {("gate", "0")}
    assert main(["run", "data", "--scene-list", "gone.txt", "-o", "RUN"]) == 2
    assert "gone.txt: expected a file, found nothing" in capsys.readouterr().err


def test_a_narrower_command_does_not_delete_what_was_done(capsys):
    assert main(["run", "data", "-o", "RUN", "--scene", "g*", "--quiet"]) == 0
    before = part_times(Path("RUN"))
    assert main(["run", "data", "-o", "RUN", "--scene", "gate", "--quiet"]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert "holds garden/0" in err
    assert "this command leaves out" in err
    assert part_times(Path("RUN")) == before
    assert main(["run", "data", "-o", "RUN", "--scene", "g*", "--scene", "0001", "--quiet"]) == 0, "a wider one goes on"
    assert len(scenes()) == 4
    assert before.items() <= part_times(Path("RUN")).items()


def test_a_model_beyond_the_limit_is_told_and_not_loaded(tree, capsys):
    large = tree / "phototourism/gate/dense/sparse/points3D.bin"
    with large.open("ab") as file:
        file.truncate(3_000_000_000)  # takes no room on the disk
    assert main(["run", "data", "-o", "RUN", "--jobs", "1", "--max-model-gb", "0.5"]) == 3
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert (
        "data/phototourism/gate/dense/sparse: expected at most 0.5 GB, found 3 GB of files; raise --max-model-gb" in err
    )
    assert scenes() == set(FOLDERS.values()) - {("gate", "0")}
    assert main(["run", "data", "-o", "RUN", "--max-model-gb", "0"]) == 2


def test_a_secret_in_a_path_is_refused_and_written_nowhere(capsys):
    assert main(["run", "data", "s3://KEY:SECRET@bucket/x", "-o", "RUN"]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert "KEY:SECRET" not in err
    assert not Path("RUN").exists()


@needs_corpus
@pytest.mark.corpus
def test_real_models_in_megadepth_s_layout(capsys, corpus):
    root = str(corpus / "megadepth_like/MegaDepth_v1_SfM")
    rows = listed(capsys, root, "--layout", "megadepth")
    assert [row[:4] for row in rows] == [
        ["MegaDepth_v1_SfM", *row]
        for row in (
            ["9001", "0", "10"],
            ["9002", "0", "17"],
            ["9002", "1", "11"],
            ["9003", "0", "2"],
            ["9003", "1", "10"],
        )
    ]
    assert main(["run", root, "-o", "RUN", "--quiet", "--scene", "9003"]) == 0
    assert scenes() == {("9003", "0"), ("9003", "1")}
