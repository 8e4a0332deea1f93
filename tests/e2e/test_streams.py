"""What goes to stdout, to stderr and into a log: ``-``, run --json, -v, --log-file, python -m, completion."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
from gate_samples import rejected, scene, write_run
from run_samples import run_cli, write_models

from sfm_audit.audit.cli.errors import LOGGER
from sfm_audit.audit.cli.main import VERBS, main


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("streams") / "data"
    write_models(folder, ("a", "b"))
    return folder


@pytest.fixture(autouse=True)
def _folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("os.fsync", lambda _: None)


def test_run_json_is_what_a_program_wants_to_know(data, tmp_path, capsys):
    (tmp_path / "empty").mkdir()
    assert main(["run", str(data), str(tmp_path / "empty"), "-o", "RUN", "--jobs", "1", "--json"]) == 3
    out, err = capsys.readouterr()
    content = json.loads(out)
    info = json.loads(Path("RUN/run.json").read_bytes())
    assert content["exit_code"] == 3
    assert content["run"] == "RUN"
    assert content["counts"] == info["counts"]
    assert content["counts"]["num_models"] == 2
    assert [failure["location"] for failure in content["failures"]] == [str(tmp_path / "empty")]
    assert err.count("\n") == 1


def test_run_json_is_json_too_where_nothing_was_found(capsys):
    assert main(["run", "nowhere", "-o", "RUN", "--json"]) == 3
    content = json.loads(capsys.readouterr().out)
    assert (content["exit_code"], content["counts"]) == (3, None)
    assert not Path("RUN").exists()


def test_list_and_json_exclude_each_other(data, capsys):
    assert main(["run", str(data), "--list", "--json"]) == 2
    assert "--list and --json exclude each other" in capsys.readouterr().err


def test_a_list_to_stdout_is_the_list_and_nothing_else(capsys):
    write_run(Path("RUN"), {"a": rejected(scene(5), 1)})
    assert main(["filter", "RUN", "--list", "kept.txt"]) == 0
    capsys.readouterr()
    assert main(["filter", "RUN", "--list", "-"]) == 0
    out, err = capsys.readouterr()
    assert out == Path("kept.txt").read_text(encoding="utf-8")
    assert err == "stdout: kept 4 of 5 images (not-rejected)\n"
    assert sorted(path.name for path in Path().iterdir()) == ["RUN", "kept.txt", "kept.txt.removed.csv"]


@pytest.mark.parametrize("pair", [("--model", "--model-out"), ("--scene-info", "--scene-info-out")])
def test_what_is_no_text_does_not_go_to_stdout(pair, capsys):
    assert main(["filter", "RUN", pair[0], "x", pair[1], "-"]) == 2
    assert f"{pair[1]} cannot be - (stdout)" in capsys.readouterr().err


def test_a_page_to_stdout_is_the_page(data, capsys):
    assert main(["run", str(data), "-o", "RUN", "--jobs", "1", "--quiet"]) == 0
    assert main(["report", "RUN", "-o", "-", "--worst", "0"]) == 0
    out, err = capsys.readouterr()
    assert out.lstrip().lower().startswith("<!doctype html>")
    assert err.startswith("stdout: 10 images")
    assert not Path("-").exists()


def test_a_folder_without_the_photos_is_said_on_the_terminal(data, capsys):
    pillow = pytest.importorskip("PIL.Image")
    assert main(["run", str(data), "-o", "RUN", "--jobs", "1", "--quiet"]) == 0
    Path("photos/deep").mkdir(parents=True)
    assert main(["report", "RUN", "-o", "report.html", "--images", "photos", "--worst", "1", "--quiet"]) == 0
    err = capsys.readouterr().err
    assert err.startswith("sfm-audit: photos: holds none of the 10 photos of the page; expected DIR/<name>")
    wanted = Path(err.split("such as ")[1].strip())
    assert wanted.parent == Path("photos")
    pillow.new("L", (8, 6)).save(wanted, format="PNG")
    assert main(["report", "RUN", "-o", "report.html", "--force", "--images", "photos", "--worst", "1", "--quiet"]) == 0
    assert capsys.readouterr().err == ""


def test_verbose_says_each_step_on_stderr_and_the_log_keeps_them_with_times(data, capsys):
    args = ["run", str(data), "-o", "RUN", "--jobs", "1"]
    assert main([*args, "-v", "--log-file", "audit.log"]) == 0
    err = capsys.readouterr().err
    steps = ["computing with ", "2 models, ", "audited ", "audited ", "exit code 0"]
    assert [step in line for step, line in zip(steps, err.splitlines(), strict=True)] == [True] * 5
    assert main([*args, "nowhere", "--log-file", "audit.log", "--quiet"]) == 3
    lines = Path("audit.log").read_text(encoding="utf-8").splitlines()
    assert all(re.match(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ (INFO|ERROR) ", line) for line in lines)
    assert [line.split(" ", 1)[1] for line in lines[6:]] == [
        f"INFO run {data} nowhere -o RUN: 2 models, {lines[1].rsplit(', ', 1)[1]}",
        f"INFO unchanged, kept {data}/a/sparse/0",
        f"INFO unchanged, kept {data}/b/sparse/0",
        "ERROR nowhere: expected a folder, found nothing; check the path",
        "INFO exit code 3",
    ]
    assert [type(handler).__name__ for handler in LOGGER.handlers] == ["NullHandler"]  # nobody listens any more


def test_a_bug_is_in_the_log_with_its_traceback(monkeypatch):
    monkeypatch.setattr("sfm_audit.audit.cli.diff.read_run", lambda _: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        main(["diff", "a", "b", "--log-file", "audit.log"])
    assert "ZeroDivisionError: division by zero" in Path("audit.log").read_text(encoding="utf-8")


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_takes_a_log_file_and_refuses_one_that_it_cannot_write(verb, capsys):
    assert main([verb, "--log-file", "no/such/folder.log"]) == 4
    assert capsys.readouterr().err.startswith("sfm-audit: no/such/folder.log: cannot be written")
    assert main([verb, "--log-file", "."]) == 2
    assert main([verb, "--help"]) == 0
    assert capsys.readouterr().out.count("--log-file") == 1


def test_python_m_is_the_command_line():
    done = subprocess.run([sys.executable, "-m", "sfm_audit", "rnu"], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "sfm-audit: No such command 'rnu', did you mean run? (see sfm-audit --help)\n"


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_as_documented(shell, monkeypatch):
    monkeypatch.setenv("_SFM_AUDIT_COMPLETE", f"{shell}_source")
    code, out, err = run_cli("--version")
    assert (code, err) == (0, "")
    assert "_SFM_AUDIT_COMPLETE=" in out


def test_completion_knows_verbs_and_options(monkeypatch):
    monkeypatch.setenv("_SFM_AUDIT_COMPLETE", "bash_complete")
    monkeypatch.setenv("COMP_WORDS", "sfm-audit learn-")
    monkeypatch.setenv("COMP_CWORD", "1")
    assert run_cli()[1] == "plain,learn-band\n"
    monkeypatch.setenv("COMP_WORDS", "sfm-audit run --log")
    monkeypatch.setenv("COMP_CWORD", "2")
    assert run_cli()[1] == "plain,--log-file\n"
