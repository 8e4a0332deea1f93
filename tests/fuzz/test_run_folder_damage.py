"""Damaged and forged run folders: every verb says one line and ends with 2, 3 or 4; nothing is a traceback.

SFM_AUDIT_RUN_DAMAGES sets how many (28 by default; 700 take a quarter of an hour).
"""

import os
import random
import shutil
from pathlib import Path

import pytest
from run_damage import DAMAGES, FORGERIES, add_stranger
from run_samples import read_run, write_models

from sfm_audit.audit.cli.main import main

COUNT = int(os.environ.get("SFM_AUDIT_RUN_DAMAGES", "28"))
READERS = (
    ("check", "BAD", "--policy-file", "/dev/null", "--baseline", "REF"),
    ("filter", "BAD", "--list", "list.txt", "--force"),
    ("filter", "BAD", "--model", "data/a/sparse/0", "--model-out", "pruned", "--force"),
    ("diff", "REF", "BAD"),
    ("learn-band", "REF", "BAD"),
    ("report", "BAD", "-o", "page.html", "--force", "--worst", "1", "--quiet"),
)


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    folder = tmp_path_factory.mktemp("source")
    write_models(folder / "data", ["a", "b", "c"], num_points=40)
    before = Path.cwd()
    os.chdir(folder)
    try:
        assert main(["run", "data", "-o", "REF", "--quiet", "--jobs", "1"]) == 0
        assert main(["filter", "REF", "--list", "all.txt"]) == 0
    finally:
        os.chdir(before)
    return folder


@pytest.fixture(autouse=True)
def _here(source, monkeypatch):
    monkeypatch.chdir(source)


def damaged(kinds, seed: int):
    """Make the run folder BAD; return what was done to it."""
    rng = random.Random(seed)  # noqa: S311
    shutil.rmtree("BAD", ignore_errors=True)
    shutil.copytree("REF", "BAD", ignore=shutil.ignore_patterns(".lock*"))
    damage = kinds[seed % len(kinds)]
    damage(Path("BAD"), rng)
    return damage


def content() -> dict[str, bytes | None]:
    files = [path for path in sorted(Path("BAD").rglob("*")) if path.name != ".lock"]
    return {str(path): path.read_bytes() if path.is_file() and path.stat().st_size < 10**7 else None for path in files}


def one_line(capsys, code: int, args) -> None:
    err = capsys.readouterr().err
    assert err.count("\n") <= 1 or args[0] == "learn-band", (
        err
    )  # learn-band has a line per scene that is not in all runs
    assert "Traceback" not in err
    assert "\x1b" not in err
    assert len(err) < 1000
    assert code in {0, 1} or err.startswith("sfm-audit: "), err


@pytest.mark.parametrize("seed", range(COUNT))
def test_a_damaged_run_folder_is_refused_and_made_whole_by_its_run_command(seed, capsys):
    damage = damaged(DAMAGES, seed)
    before = content()
    for args in READERS:
        code = main(list(args))
        one_line(capsys, code, args)
        assert code in {0, 2, 3}, (damage, args)
        if code == 0 and args[0] == "filter" and "--list" in args:
            assert Path("list.txt").read_text() == Path("all.txt").read_text(), damage  # all or nothing
    assert content() == before, "reading changes nothing"
    code = main(["run", "data", "-o", "BAD", "--quiet", "--jobs", "1"])
    one_line(capsys, code, ("run",))
    if code == 0:
        whole, expected = read_run(Path("BAD")), read_run(Path("REF"))
        assert all(whole[name].equals(table) for name, table in expected.items()), damage
        assert main(["diff", "REF", "BAD", "--exit-code"]) == 0
    else:
        assert code in {2, 4}, damage
        assert not _is_sound(Path("BAD/run.json")), damage  # with run.json whole, everything else is made again


def _is_sound(path: Path) -> bool:
    wanted = Path("REF/run.json")
    if path.is_symlink() or not path.is_file() or path.stat().st_size != wanted.stat().st_size:
        return False
    return path.read_bytes() == wanted.read_bytes()


@pytest.mark.parametrize("seed", range(COUNT))
def test_a_forged_run_folder_is_read_or_refused(seed, capsys):
    damaged(FORGERIES, seed)
    for args in (*READERS, ("run", "data", "-o", "BAD", "--quiet", "--jobs", "1")):
        code = main(list(args))
        one_line(capsys, code, args)
        assert code in {0, 1, 2, 3}


def test_a_part_that_no_manifest_names_is_not_read_and_goes_with_the_next_run(capsys):
    damaged((add_stranger,), 0)
    named = {path.relative_to("REF") for path in Path("REF").glob("*/part-*")}
    (stranger,) = [path for path in Path("BAD").glob("*/part-*") if path.relative_to("BAD") not in named]
    assert main(["diff", "REF", "BAD", "--exit-code"]) == 0
    assert main(["run", "data", "-o", "BAD", "--quiet", "--jobs", "1"]) == 0
    assert not stranger.exists()
    assert capsys.readouterr().err == ""
