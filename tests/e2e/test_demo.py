import json
import re
from pathlib import Path

import pandas as pd
import pytest

from sfm_audit.audit.cli.demo import NOT_REGISTERED, _compared, _why_not_found
from sfm_audit.audit.cli.main import main
from sfm_audit.audit.simulate.demo import TruthRecord
from sfm_audit.audit.table.words import POLICIES, Member


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    """The demo's folder and what it printed."""
    folder = tmp_path_factory.mktemp("demo")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        printed: list[str] = []
        patch.setattr("sfm_audit.audit.cli.auditing.print_page", printed.append)
        patch.setattr("sfm_audit.audit.cli.demo.print_page", printed.append)
        assert main(["demo"]) == 0
    return folder / "audit-demo", "\n".join(printed)


ROW = re.compile(
    r"^(?P<name>IMG_\d+\.jpg) (?P<planted>.*?) +(?P<verdict>accepted|rejected|undetermined) +(?P<found>yes|NO) "
    r"(?P<because>.*?) +(?P<advice>\S+)$",
    re.MULTILINE,
)
TOO_LITTLE = {"too_few_observations", "low_coverage", "few_occupied_cells"}


def planted_rows(text: str) -> list[re.Match[str]]:
    return list(ROW.finditer(text[text.index("Planted defects against verdicts") :]))


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
    assert sorted(row["name"] for row in rows) == sorted(defect["image_name"] for defect in truth)
    defects = {defect["image_name"]: defect["defect"] for defect in truth}
    for row in rows:
        image = images.loc[row["name"]]
        codes = {reason.split(":")[0] for reason in image["reasons"]}
        assert row["verdict"] == image["verdict"]
        few = image["verdict"] == "undetermined" and defects[row["name"]] == "few_points" and codes & TOO_LITTLE
        assert (row["found"] == "yes") == bool(image["verdict"] == "rejected" or few)
        if isinstance(image["misfit_group"], str):
            assert row["because"] == f"{image['misfit_group']} {image['misfit_px']:.2f} px"
            assert row["advice"] == image["advised_camera_model"]
        else:
            assert row["because"] in codes
            assert row["advice"] == "-"
    num_found = sum(row["found"] == "yes" for row in rows)
    assert f"{num_found} of {len(truth)} planted defects found." in text


def test_the_planted_defects_are_found_for_what_they_are(demo):
    folder, text = demo
    truth = json.loads((folder / "truth.json").read_text(encoding="utf-8"))["defects"]
    rows = {row["name"]: row for row in planted_rows(text)}
    for defect in truth:
        row = rows[defect["image_name"]]
        assert row["found"] == "yes"
        match defect["defect"]:
            case "radial_k2":
                assert row["because"].startswith("radial ")
                assert row["advice"] == "RADIAL"
            case "perturbed_pose":
                assert row["because"] == "pose_not_optimal"
            case _:
                assert row["because"] in TOO_LITTLE


def test_false_alarms_are_counted_among_the_sound_images(demo):
    folder, text = demo
    truth = {d["image_name"] for d in json.loads((folder / "truth.json").read_text(encoding="utf-8"))["defects"]}
    images = pd.read_parquet(folder / "run" / "images")
    sound = images[~images["image_name"].isin(truth)]
    rejected = sound[[str(member) for member in Member]] == "rejected"
    by_policy = {name: rejected[list(map(str, members))].any(axis=1).sum() for name, members in POLICIES.items()}
    said = ", ".join(f"{count} {name}" for name, count in by_policy.items())
    assert f"Of {len(sound)} sound images rejected (false alarms), by policy: {said}." in " ".join(text.split())
    assert by_policy["standard"] == by_policy["camera"] == 0


def record(defect: str, size_px: float | None = 0.3) -> TruthRecord:
    return TruthRecord("a.jpg", defect, size_px, "only 22 points, all in a corner")


def image(verdict: str, *reasons: str, **changes: object) -> dict:
    row = {"image_name": "a.jpg", "num_inliers": 350, "verdict": verdict, "reasons": list(reasons)}
    judged = dict.fromkeys(("verdict_ks", "verdict_misfit", "verdict_pose", "plausible"), verdict)
    return {**row, **judged, "misfit_group": None, "misfit_px": None, "advised_camera_model": None, **changes}


@pytest.mark.parametrize(
    ("defect", "row", "found", "why"),
    [
        ("radial_k2", image("rejected", "misfit_radial: 0.3 px", misfit_group="radial", misfit_px=0.3), True, ""),
        ("radial_k2", image("undetermined", "low_coverage: 2 %"), False, "undetermined for another reason (low_cov"),
        ("few_points", image("undetermined", "low_coverage: 2 %"), True, ""),
        ("few_points", image("undetermined", "few_occupied_cells: 9 < 16"), True, ""),
        ("few_points", image("undetermined", "noise_not_fitted: 22"), False, "(noise_not_fitted)"),
        ("perturbed_pose", image("accepted", "k1_not_identified: 0.1"), False, "not significant in 350 inliers"),
        (
            "radial_k2",
            image("accepted", misfit_group="radial", misfit_px=0.12),
            False,
            "radial 0.12 px is there, but below what matters (0.2px, --min-effect)",
        ),
        ("radial_k2", NOT_REGISTERED, False, "not registered"),
    ],
)
def test_what_is_not_found_is_said_with_its_cause(defect, row, found, why):
    compared = _compared(record(defect), row)
    assert compared["found"] is found
    if not found:
        assert why in _why_not_found(compared, "0.2px")


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
