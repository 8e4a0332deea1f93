import json
import re
from pathlib import Path

import pandas as pd
import pytest

from audit.cli.main import main


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    """The demo's folder and what it printed."""
    folder = tmp_path_factory.mktemp("demo")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        printed: list[str] = []
        patch.setattr("audit.cli.auditing.print_page", printed.append)
        patch.setattr("audit.cli.demo.print_page", printed.append)
        assert main(["demo"]) == 0
    return folder / "audit-demo", "\n".join(printed)


def planted_rows(text: str) -> list[re.Match[str]]:
    found = re.finditer(r"^(IMG_\d+\.jpg) (.*?) +(accepted|rejected|undetermined) +(yes|NO)$", text, re.MULTILINE)
    return list(found)


def test_the_demo_leaves_a_model_its_truth_and_a_run(demo):
    folder, _ = demo
    assert len(pd.read_parquet(folder / "run" / "images")) == 40
    assert (folder / "photos/sparse/0/images.bin").exists()
    truth = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
    assert truth["seed"] == 0
    assert {defect["defect"] for defect in truth["defects"]} == {"radial_k2", "perturbed_pose", "few_points"}


def test_every_planted_defect_is_printed_with_what_the_tables_say(demo):
    folder, text = demo
    truth = json.loads((folder / "truth.json").read_text(encoding="utf-8"))["defects"]
    images = pd.read_parquet(folder / "run" / "images").set_index("image_name")
    rows = planted_rows(text)
    assert sorted(row[1] for row in rows) == sorted(defect["image_name"] for defect in truth)
    for row in rows:
        verdict, reasons = images.loc[row[1], ["verdict", "reasons"]]
        assert row[3] == verdict
        few = verdict == "undetermined" and any(reason.startswith("too_few_observations") for reason in reasons)
        assert (row[4] == "yes") == (verdict == "rejected" or few)
    num_found = sum(row[4] == "yes" for row in rows)
    assert f"{num_found} of {len(truth)} planted defects found." in text
    assert 0 < num_found < len(truth), "the demo shows what is found and what is not"


def test_false_alarms_are_counted_among_the_sound_images(demo):
    folder, text = demo
    truth = {d["image_name"] for d in json.loads((folder / "truth.json").read_text(encoding="utf-8"))["defects"]}
    images = pd.read_parquet(folder / "run" / "images")
    sound = images[~images["image_name"].isin(truth)]
    alarms = (sound["verdict"] == "rejected").sum()
    assert f"{alarms} of {len(sound)} sound images rejected (false alarms)." in text


def test_every_printed_line_fits_80_columns(demo):
    folder, text = demo
    assert max(len(line) for line in text.splitlines() if str(folder.parent) not in line) <= 80


def test_again_with_another_seed_into_the_same_folder(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["demo", "-o", "d", "--seed", "1", "--quiet"]) == 0
    first = pd.read_parquet("d/run/images")
    assert main(["demo", "-o", "d", "--seed", "1", "--quiet"]) == 0
    pd.testing.assert_frame_equal(pd.read_parquet("d/run/images"), first)
    assert main(["demo", "-o", "d", "--seed", "2", "--quiet"]) == 0
    assert not pd.read_parquet("d/run/images")["rms_px"].equals(first["rms_px"])
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize("file", ["thesis.tex", "truth.json"])
def test_a_folder_that_is_no_demo_is_left_alone(tmp_path, file, capsys):
    (tmp_path / file).write_text("[]", encoding="utf-8")
    assert main(["demo", "-o", str(tmp_path)]) == 2
    assert "not an earlier demo" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == [file]


def test_a_demo_that_cannot_be_written_is_4(tmp_path, capsys):
    (tmp_path / "file").touch()
    for out in (tmp_path / "file", Path("/proc/demo")):
        assert main(["demo", "-o", str(out)]) == 4
        assert capsys.readouterr().err.count("\n") == 1
