"""The generators of hostile inputs that lie beside the corpus, each run as its author wrote it.

Instead of the command line they call a stand-in, which answers from a process with limits of memory and time.
The folder is found as the corpus is, and may be absent. Counterparts that need no folder are in tests/unit.
"""

import csv
import io
import runpy
import shutil
import subprocess
import sys
import unicodedata
import xml.etree.ElementTree as ET
from pathlib import Path

import pandas as pd
import pytest
from corpus import CORPUS
from run_samples import read_run

CASES = CORPUS.parent / "cases" / "reliability"
GOOD = CASES / "models" / "zz_good"
pytestmark = [
    pytest.mark.skipif(not CASES.is_dir(), reason=f"no cases at {CASES} (set SFM_AUDIT_CORPUS)"),
    pytest.mark.skipif(sys.platform != "linux", reason="needs fork and limits that hold"),
]
MORE_MB = 300.0  # what a refusal, or the audit of a tiny model, may take beyond the libraries


@pytest.fixture(scope="module")
def cli():
    from cli_server import CliServer  # noqa: PLC0415 - it imports resource, which Windows lacks

    with CliServer() as server:
        yield server


def is_one_line(answer, *, lines: int = 1) -> None:
    """Ended in time and by itself, within memory; at most one line, no traceback, nothing that a terminal obeys."""
    assert answer.code is not None, "it hung"
    assert answer.code in range(6), answer
    assert answer.more_mb < MORE_MB, answer
    assert answer.err.count("\n") <= lines, answer.err
    assert "Traceback" not in answer.err
    assert "Warning" not in answer.err
    assert "\x1b" not in answer.err
    assert max(map(len, answer.err.splitlines()), default=0) < 700, answer.err
    assert not answer.code or answer.code == 1 or answer.err.startswith("sfm-audit: "), answer


@pytest.fixture
def generate(cli, monkeypatch, capsys):
    """Run a generator in Python; return what the command line answered to each call that it made."""

    def run(name: str, *args: Path, after=lambda *_: None):
        answers = []

        def answer(words, **options):
            assert words[0] == "sfm-audit"
            if words[1] == "report" and name == "damage_run.py":  # slow, and its reader is that of the others
                return subprocess.CompletedProcess(words, 0, "", "")
            said = cli(*words[1:], cwd=options.get("cwd", "."), env=options.get("env"), seconds=60)
            answers.append((words[1:], said))
            after(words[1:], said)
            if said.code is None:
                raise subprocess.TimeoutExpired(words, 60)
            if options.get("check"):
                assert said.code == 0, said
            return subprocess.CompletedProcess(words, said.code, said.out, said.err)

        with monkeypatch.context() as patch:
            patch.setattr(sys, "argv", [name, *map(str, args)])
            patch.setattr(sys, "path", list(sys.path))
            patch.setattr(subprocess, "run", answer)
            runpy.run_path(str(CASES / name), run_name="__main__")
        return answers, capsys.readouterr().out

    return run


def recorded(script: str, tmp_path: Path, *args: Path) -> list[list[str]]:
    """Run a generator in bash, which leaves its files; return the calls of the command line that it made."""
    recorder, log = tmp_path / "recorder", tmp_path / "calls"
    recorder.write_text(f"#!/bin/sh\nprintf '%s\\037' \"$@\" >> '{log}'\necho >> '{log}'\n")
    recorder.chmod(0o755)
    text = (CASES / script).read_text()
    text = text.replace("seq 1500", "seq 200")  # bash takes half a minute for as many folders
    subprocess.run(["bash", "-c", text, script, *args, recorder], check=True, stdout=subprocess.DEVNULL)
    return [line.split("\037")[:-1] for line in log.read_text().splitlines()]


def test_config_and_gate_files(generate, tmp_path):
    answers, _ = generate("toml_bombs.py", tmp_path)
    assert len(answers) == 13
    for words, answer in answers[1:]:
        is_one_line(answer)
        assert answer.code == 2, words
        assert words[-1] in answer.err
    assert not list(tmp_path.glob("run_*"))


NOT_NEEDED = {"inputs_null", "version_older"}  # run.json as an older version wrote it; parts that are made again
BY_RUN = {"images_part_truncated", "images_part_empty", "images_part_deleted", "images_part_of_other_model"}


def test_damaged_run_folders(generate, tmp_path):
    """Whatever `run` ends with 0 on has the rows of the undamaged run afterwards."""
    same = []

    def compare(words, answer):
        if words[0] == "run" and answer.code == 0 and (tmp_path / "w/again").is_dir():
            whole, expected = read_run(tmp_path / "w/again"), read_run(tmp_path / "w/ref")
            same.append(all(whole[name].equals(table) for name, table in expected.items()))

    answers, out = generate("damage_run.py", tmp_path / "w", after=compare)
    assert len(answers) == 1 + 13 * 4
    for words, answer in answers[1:]:
        is_one_line(answer)
        assert answer.code in {0, 2, 3}, words
    said = [line.split()[:4] for line in out.splitlines()]
    made_again = {name for name, verb, _, code in said if (verb, code) == ("run", "0")}
    assert made_again == BY_RUN | NOT_NEEDED
    assert same == [True] * len(made_again)
    assert {name for name, verb, _, code in said if verb in {"check", "filter", "diff"} and code == "0"} == {
        "inputs_null"
    }


TRICKS = {
    "fifo": (3, "m/points3D.bin: expected a file, found a named pipe"),
    "zero": (3, "found links to the outside: points3D.bin"),
    "dir": (3, "m/images.bin: expected a file, found a folder"),
    "sparse": (3, "expected the end of the file after the last of its 3D points"),
    "loop": (0, ""),
    "rootl": (3, "links to folders outside of it are not followed"),
    "dang": (3, "m/rigs.bin: expected a file, found a link to nothing"),
    "fifodb": (3, "m/database.db: expected a file, found a named pipe"),
    "case": (3, "rename IMAGES.BIN to images.bin"),
    "cfg": (2, "no plain file"),
    "/dev/zero": (2, "no plain file"),
    "rj": (3, "no plain file"),
    "fc": (3, "expected a file, found a named pipe"),
    "deep": (3, "more than 64 folders deep"),
}


def test_tricks_of_file_systems(cli, tmp_path):
    work = tmp_path / "w"
    try:
        good, *calls = recorded("fs_tricks.sh", tmp_path, work, GOOD)
        assert cli(*good).code == 0
        assert len(calls) == len(TRICKS)
        for (trick, (code, found)), words in zip(TRICKS.items(), calls, strict=True):
            assert trick in {word.removeprefix(f"{work}/") for word in words}
            shutil.rmtree(work / "out", ignore_errors=True)
            jobs = ["--jobs", "1"] if words[0] == "run" else []
            answer = cli(*words, *jobs)
            is_one_line(answer, lines=2 if trick == "rootl" else 1)
            assert (answer.code, found in answer.err) == (code, True), (trick, answer)
            if trick in {"loop", "deep"}:
                assert len(pd.read_parquet(work / "out/models")) == 1
    finally:
        subprocess.run(["rm", "-rf", work], check=True)


def test_one_model_too_large_for_the_memory(cli, tmp_path):
    (words,) = recorded("memory_abort.sh", tmp_path, tmp_path / "w", GOOD)
    answer = cli(*words, address_space=2.5)
    is_one_line(answer)
    assert answer.code == 3
    assert "aa_big" in answer.err
    assert list(pd.read_parquet(tmp_path / "w/o/models")["scene"]) == ["zz_good"]


def test_a_parquet_table_that_grows(cli, tmp_path):
    file = tmp_path / "bomb.parquet"
    subprocess.run([sys.executable, CASES / "parquet_bomb.py", file, "1e7"], check=True)
    answer = cli("calibrate", file)
    is_one_line(answer)
    assert answer.code == 3
    assert str(file) in answer.err


def test_a_stranger_s_run_folder(generate, tmp_path):
    answers, out = generate("s3_from_run.py", tmp_path / "w")
    for _, answer in answers:
        is_one_line(answer)
    assert "the stranger's host received: 0" in out


def test_scene_info_files(cli, tmp_path):
    kinds = runpy.run_path(str(CASES / "pickle_bombs.py"))["KINDS"]
    assert cli("run", GOOD, "-o", tmp_path / "RUN", "--quiet", "--jobs", "1").code == 0
    del kinds["npz_bomb_2G"]  # takes six seconds to make; tests/unit/test_scene_info_bombs.py has smaller ones
    for name, make in kinds.items():
        file = tmp_path / name
        file.write_bytes(make())
        answer = cli("filter", tmp_path / "RUN", "--scene-info", file, "--scene-info-out", tmp_path / "out", seconds=20)
        is_one_line(answer)
        assert answer.code == 3, name
        assert f"{file}: expected a scene_info file" in answer.err
        assert not (tmp_path / "out").exists()


def is_plain(text: str) -> bool:
    """Nothing in it that a terminal obeys or that turns its reading direction."""
    return not any(unicodedata.category(char) in {"Cc", "Cf", "Cs", "Zl", "Zp"} for char in text if char != "\n")


def test_names_in_all_that_is_written(generate, cli, tmp_path):
    generate("names_model.py", tmp_path / "m")
    (tmp_path / "gate.toml").write_text("limits.min_share_accepted = 0.8\n")
    for code, words in (
        (0, ("run", "m", "-o", "RUN", "--jobs", "1")),
        (0, ("report", "RUN", "-o", "page.html", "--worst", "3")),
        (0, ("filter", "RUN", "--list", "list.txt")),
        (1, ("check", "RUN", "--policy-file", "gate.toml", "--junit", "j.xml", "--markdown", "m.md")),
        (0, ("explain", "RUN", "id:5", "-o", "story")),
        (0, ("diff", "RUN", "RUN")),
    ):
        answer = cli(*words, cwd=tmp_path)
        assert answer.code == code, answer
        is_one_line(answer)
        assert is_plain(answer.out), ascii(answer.out)
        assert is_plain(answer.err)
        assert len(answer.out) < 20_000
    page = (tmp_path / "page.html").read_text()
    live = ("<script>alert", "<img src=x", "<script>window", 'href="javascript:')
    assert not [text for text in live if text in page]
    assert "<" not in (tmp_path / "m.md").read_text().replace("<br>", "").replace("&lt;", "")
    ET.parse(tmp_path / "j.xml")  # noqa: S314 - we wrote it
    lines = (tmp_path / "list.txt").read_text().split("\n")
    assert not {"a", "b.jpg", "injected.jpg", "rejected.jpg"} & set(lines)
    cells = [cell for row in csv.reader(io.StringIO((tmp_path / "list.txt.removed.csv").read_text())) for cell in row]
    assert not [cell for cell in cells if cell[:1] in {"=", "+", "-", "@", "\t", "\r"}]
    assert {path.name for path in tmp_path.iterdir()} == {
        *("m", "RUN", "page.html", "gate.toml", "list.txt", "list.txt.removed.csv", "j.xml", "m.md", "story")
    }
