"""The verbs check, diff and learn-band as scripts meet them: exit codes, what is printed where, report files."""

import json
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from gate_samples import but, rejected, scene, without, write_run
from rich.cells import cell_len

from sfm_audit.audit.cli.main import main

SOUND = {"a": scene(40), "b": scene(40)}


@pytest.fixture(autouse=True)
def _folder(tmp_path, monkeypatch):
    """A baseline RUN0, a run RUN that is worse, and an empty gate, in the working folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("os.fsync", lambda _: None)
    write_run(Path("RUN0"), SOUND)
    write_run(Path("RUN"), {"a": but(rejected(scene(40), 1, 2, 3), 7, camera_model="OPENCV")})
    Path("gate.toml").touch()


def check(*args: str) -> int:
    return main(["check", *args, "--policy-file", "gate.toml"])


def test_a_run_passes_against_itself(capsys):
    assert check("RUN", "--baseline", "RUN") == 0
    out, err = capsys.readouterr()
    assert out.startswith("PASSED  RUN against RUN: 12 checks passed")
    assert err == ""


def test_a_worse_run_fails_and_says_why(capsys):
    assert check("RUN", "--baseline", "RUN0") == 1
    out, err = capsys.readouterr()
    assert err == ""
    assert out.startswith("FAILED  RUN against RUN0: ")
    for words in ("band.lost_scenes: 1 scene lost: data/b", "data/a/IMG_0002.jpg", "SIMPLE_RADIAL -> OPENCV"):
        assert words in " ".join(out.split())
    assert max(cell_len(line) for line in out.splitlines()) <= 80


def test_all_reports_are_written_pass_or_fail():
    files = ("--junit", "j.xml", "--markdown", "m.md", "--json", "j.json")
    assert check("RUN", "--baseline", "RUN0", *files) == 1
    content = json.loads(Path("j.json").read_bytes())
    assert not content["passed"]
    assert content["changes"]["scenes_lost"] == ["data/b"]
    assert len(content["changes"]["newly_rejected"]) == 3
    root = ET.parse("j.xml").getroot()  # noqa: S314  # our own file
    assert root.findall(".//failure")
    assert "failed" in Path("m.md").read_text(encoding="utf-8")
    assert check("RUN0", "--baseline", "RUN0", *files) == 0
    assert json.loads(Path("j.json").read_bytes())["passed"]
    assert not ET.parse("j.xml").getroot().findall(".//failure")  # noqa: S314


@pytest.mark.parametrize("gate", ["", "band.lost_images = 0.5", 'scene = [{match = "a", band.noise_s0 = 1}]'])
def test_a_gate_without_limits_and_baseline_is_2_and_says_what_to_write(gate, capsys):
    Path("gate.toml").write_text(gate, encoding="utf-8")
    assert check("RUN", "--json", "j.json") == 2
    out, err = capsys.readouterr()
    assert (out, err.count("\n")) == ("", 1)
    assert err.startswith("sfm-audit: gate.toml: checks nothing")
    advice = err[err.index("limits.min_share_accepted") : err.index(" (docs/nightly.md)")]
    Path("gate.toml").write_text(advice.replace(" and ", "\n"), encoding="utf-8")  # what it says to write works
    assert check("RUN") == 0
    assert not Path("j.json").exists()


def test_a_model_that_a_bug_stopped_fails_the_gate_and_is_named(capsys):
    failures = [
        ("data/x", "data/x: ZeroDivisionError", "error", "errors/x.txt"),
        ("data/y", "data/y: took 9 s", "time"),
    ]
    write_run(Path("PART"), SOUND, failures=failures)
    assert check("PART", "--baseline", "RUN0", "--junit", "j.xml", "--markdown", "m.md", "--json", "j.json") == 1
    out = " ".join(capsys.readouterr().out.split())
    assert out.startswith("FAILED PART against RUN0: 2 of 38 checks failed")
    assert "run.stopped: data/x: ZeroDivisionError; tracebacks of bugs are in PART/errors" in out
    content = json.loads(Path("j.json").read_bytes())
    assert content["unread"] == []
    assert [check["check"] for check in content["checks"] if not check["passed"]] == ["run.stopped"] * 2
    assert len(ET.parse("j.xml").getroot().findall(".//failure")) == 2  # noqa: S314
    assert "data/y: took 9 s" in Path("m.md").read_text(encoding="utf-8").replace("\\", "")
    assert check("RUN0", "--baseline", "PART") == 0
    assert "2 inputs of the baseline could not be read or audited" in " ".join(capsys.readouterr().out.split())
    assert main(["learn-band", "PART", "RUN0"]) == 3
    assert "PART: has inputs that could not be read or audited (data/x)" in capsys.readouterr().err


def test_an_input_that_is_missing_comes_before_a_bug():
    write_run(Path("PART"), SOUND, failures=[("x", "x: a bug", "error"), ("y", "y: no such file")])
    assert check("PART", "--baseline", "RUN0") == 3


@pytest.mark.parametrize("option", ["--junit", "--markdown", "--json"])
def test_a_report_to_stdout_has_it_for_itself(option, capsys):
    assert check("RUN", "--baseline", "RUN0", option, "file") == 1
    page = capsys.readouterr().out
    assert check("RUN", "--baseline", "RUN0", option, "-") == 1
    out, err = capsys.readouterr()
    assert err == page
    assert out.splitlines()[-1] == Path("file").read_text(encoding="utf-8").splitlines()[-1]
    assert not Path("-").exists()


def test_two_reports_do_not_share_stdout(capsys):
    assert check("RUN", "--baseline", "RUN0", "--json", "-", "--markdown", "-") == 2
    assert "Only one output can be -" in capsys.readouterr().err


def test_a_section_that_fits_nothing_says_what_was_probably_meant(capsys):
    Path("gate.toml").write_text('scene = [{match = "data/A", limits.min_images = 1}]', encoding="utf-8")
    assert check("RUN") == 1
    assert "no scene is called 'data/A', did you mean 'data/a'?" in " ".join(capsys.readouterr().out.split())


def test_a_band_that_says_nothing_and_runs_of_other_photos_are_said(capsys):
    write_run(Path("BAD"), {"a": rejected(scene(40), *range(10)), "b": scene(40)})
    assert main(["learn-band", "RUN0", "BAD", "RUN0", "-o", "-"]) == 0
    out, err = capsys.readouterr()
    said = [line for line in err.splitlines() if "says nothing" in line]
    assert [line.split("sfm-audit: ")[1].split(" says")[0] for line in said] == [
        "scene data/a: newly_rejected = 0.75",
        "scene data/a: share_accepted = 0.75",
        "scene data/a: share_rejected = 0.75",
        "scene data/a: share_rejected_by_reason = 0.75",
    ]
    assert "newly_rejected = 0.375" in out
    write_run(Path("OTHER"), {"a": scene(image_name=[f"IMG_{i:04d}.jpg" for i in range(35, 75)])})
    assert main(["learn-band", "RUN0", "OTHER", "RUN0"]) == 0
    assert "OTHER and RUN0 share 5 of their 115 images" in capsys.readouterr().err
    assert main(["learn-band", "RUN0", "RUN0", "RUN0"]) == 0
    assert capsys.readouterr().err == ""


def test_absolute_limits_need_no_baseline(capsys):
    Path("gate.toml").write_text("limits.max_share_rejected = 0.05", encoding="utf-8")
    assert check("RUN0") == 0
    assert check("RUN") == 1
    assert "limits.max_share_rejected: 7.5 %; at most 5 % allowed" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("text", "words"),
    [("limit.x = 1", "gate.toml: unknown key limit"), ("limits.max_lost_images = 1", "needs --baseline")],
)
def test_a_wrong_gate_file_is_one_line_and_2(text, words, capsys):
    Path("gate.toml").write_text(text, encoding="utf-8")
    assert check("RUN") == 2
    out, err = capsys.readouterr()
    assert (out, err.count("\n")) == ("", 1)
    assert words in err


def test_runs_of_different_settings_are_2(capsys):
    write_run(Path("OTHER"), SOUND, config={"noise": "constant"})
    assert check("OTHER", "--baseline", "RUN0") == 2
    assert "OTHER was made with noise = constant, RUN0 with track" in capsys.readouterr().err
    assert main(["learn-band", "OTHER", "RUN0"]) == 2
    assert main(["diff", "OTHER", "RUN0"]) == 0
    assert "verdicts differ for that reason too" in capsys.readouterr().err


def _no_run(folder: Path) -> None:
    folder.mkdir()


def _foreign(folder: Path) -> None:
    folder.mkdir()
    (folder / "run.json").write_text("[1]", encoding="utf-8")


def _unfinished(folder: Path) -> None:
    write_run(folder, SOUND)
    info = json.loads((folder / "run.json").read_bytes())
    (folder / "run.json").write_text(json.dumps({**info, "status": "running"}), encoding="utf-8")


def _broken_table(folder: Path) -> None:
    write_run(folder, SOUND)
    next((folder / "images").glob("*.parquet")).write_bytes(b"PAR1 but not really PAR1")


@pytest.mark.parametrize("make", [_no_run, _foreign, _unfinished, _broken_table])
def test_what_is_no_run_is_one_line_and_3(make, capsys):
    make(Path("NONE"))
    for args in (
        ("check", "NONE", "--policy-file", "gate.toml"),
        ("check", "RUN", "--policy-file", "gate.toml", "--baseline", "NONE"),
        ("diff", "RUN", "NONE"),
        ("diff", "NONE", "RUN"),
        ("learn-band", "RUN", "NONE"),
    ):
        assert main(args) == 3
        out, err = capsys.readouterr()
        assert (out, err.count("\n")) == ("", 1)
        assert "NONE" in err


def test_inputs_that_were_not_read_are_reported_and_3(capsys):
    failure = ("data/x", "data/x/points3D.bin: byte 7: expected more\n<b>")
    write_run(Path("PART"), SOUND, failures=[failure])
    assert check("PART", "--baseline", "RUN0", "--junit", "j.xml", "--markdown", "m.md", "--json", "j.json") == 3
    assert "not read  data/x/points3D.bin: byte 7" in capsys.readouterr().out
    assert json.loads(Path("j.json").read_bytes())["unread"][0]["location"] == "data/x"
    assert len(ET.parse("j.xml").getroot().findall(".//error")) == 1  # noqa: S314
    assert "could not be read" in Path("m.md").read_text(encoding="utf-8")
    assert check("RUN0", "--baseline", "PART") == 0
    assert "of the baseline could not be read" in " ".join(capsys.readouterr().out.split())
    assert main(["learn-band", "PART", "RUN0"]) == 3


@pytest.mark.parametrize("option", ["--junit", "--markdown", "--json"])
def test_a_report_that_cannot_be_written_is_4(option, capsys):
    assert check("RUN", "--baseline", "RUN0", option, "no/such/folder") == 4
    out, err = capsys.readouterr()
    assert err.count("\n") == 1
    assert "no/such/folder: cannot be written" in err
    assert out.startswith("FAILED")


def test_other_reports_are_written_when_one_cannot_be():
    assert check("RUN0", "--baseline", "RUN0", "--junit", "no/such/folder", "--json", "j.json") == 4
    assert Path("j.json").exists()


def test_diff_shows_what_changed_in_80_columns(capsys):
    assert main(["diff", "RUN0", "RUN"]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    assert max(cell_len(line) for line in out.splitlines()) <= 80
    for words in ("Newly rejected: 3 images", "Lost: 40 images", "Another camera model: 1 image", "Scenes lost: 1"):
        assert words in out
    assert main(["diff", "RUN0", "RUN", "--exit-code"]) == 1


def test_diff_of_a_run_with_itself_is_nothing(capsys):
    assert main(["diff", "RUN0", "RUN0", "--exit-code"]) == 0
    assert "Nothing changed: 80 images." in capsys.readouterr().out


@pytest.mark.parametrize("change", [{"sigma_constant_px": np.full(40, 0.301)}, {"verdict": ["undetermined"] * 40}])
def test_diff_exits_with_1_on_any_change(change):
    write_run(Path("NEW"), {**SOUND, "a": scene(40, **change)})
    assert main(["diff", "RUN0", "NEW", "--exit-code"]) == 1


def test_a_learnt_gate_passes_its_runs_and_catches_a_lost_image(capsys):
    rng = np.random.default_rng(1)
    for i in range(3):
        sigma = 0.3 * (1 + 0.02 * rng.standard_normal(40))
        write_run(Path(f"R{i}"), {**SOUND, "a": rejected(scene(40, sigma_constant_px=sigma), i)})
    assert main(["learn-band", "R0", "R1", "R2", "-o", "learnt.toml"]) == 0
    assert capsys.readouterr() == ("", "")
    for i in range(3):
        assert main(["check", f"R{i}", "--policy-file", "learnt.toml", "--baseline", f"R{(i + 1) % 3}"]) == 0
    write_run(Path("BAD"), {**SOUND, "a": without(scene(40), 1, 2)})
    assert main(["check", "BAD", "--policy-file", "learnt.toml", "--baseline", "R0"]) == 1


def test_learn_band_prints_and_advises_and_overwrites_nothing(capsys):
    assert main(["learn-band", "RUN0", "RUN"]) == 0
    out, err = capsys.readouterr()
    assert "[band]" in out
    assert "3 or more are recommended" in err
    assert "data/b is not in every run" in err
    assert main(["learn-band", "RUN0"]) == 2
    assert main(["learn-band", "RUN0", "RUN", "-o", "gate.toml"]) == 2
    assert Path("gate.toml").read_bytes() == b""
    assert "--force" in capsys.readouterr().err
    assert main(["learn-band", "RUN0", "RUN", "-o", "gate.toml", "--force"]) == 0
    assert check("RUN", "--baseline", "RUN0") == 0
    assert main(["learn-band", "RUN0", "RUN", "-o", "no/such/gate.toml"]) == 4


def test_runs_of_other_photos_teach_nothing(capsys):
    write_run(Path("OTHER"), {"other/a/0": scene(3)})
    assert main(["learn-band", "RUN0", "OTHER"]) == 2
    assert "audit folders of the same name" in capsys.readouterr().err
    assert check("OTHER", "--baseline", "RUN0") == 1
    assert "base name of the PATH" in " ".join(capsys.readouterr().out.split())
