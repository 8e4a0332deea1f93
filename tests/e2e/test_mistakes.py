"""Typical mistakes at the command line: each costs one line that says what to do, and the documented exit code.

All in one process: what differs between a mistake here and one in a shell is the start of Python.
"""

import contextlib
import importlib
import json
import os
import shutil
from pathlib import Path

import pytest
from gate_samples import scene, write_run
from run_samples import truncate, write_models

import sfm_audit
from sfm_audit.audit.cli.main import VERBS, main

MODEL = "data/a/sparse/0"
NOBODY = 65534

# what was typed, its exit code, and what the one line says
WRONG_PATH = [
    ("run dtaa -o NEW", 3, "dtaa: expected a folder, found nothing; check the path"),
    ("run empty -o NEW", 3, "empty: "),
    ("run photos -o NEW", 3, "photos: "),
    ("run notes.txt -o NEW", 3, "notes.txt: "),
    (f"run {MODEL}/images.bin -o NEW", 3, "images.bin: "),
    ("run http://host/models -o NEW", 2, "http://"),
    ("report RNU", 3, "RNU: holds no run (run.json); name the folder that run -o wrote"),
    ("report data", 3, "data: holds no run"),
    ("report RUN --images fotos", 2, "fotos: is no folder"),
    ("check data --policy-file limits.toml", 3, "data: holds no run"),
    ("check RUN --policy-file gate.tml", 2, "gate.tml: cannot be read"),
    ("check RUN --policy-file photos", 2, "photos: cannot be read"),
    ("check RUN --policy-file limits.toml --baseline RUN1", 3, "RUN1: holds no run"),
    ("diff RUN data", 3, "data: holds no run"),
    ("learn-band RUN RUN/images", 3, "RUN/images: holds no run"),
    ("filter data --list kept.txt", 3, "data: holds no run"),
    (f"filter RUN --model {MODEL}/images.bin --model-out OUT", 3, "images.bin: expected a model folder, found a file"),
    ("filter RUN --scene-info 0022.npz --scene-info-out out.npz", 3, "0022.npz: "),
    ("explain dtaa IMAGE -o STORY", 3, "dtaa: expected a folder, found nothing"),
    ("calibrate none.csv", 3, "none.csv: "),
    ("calibrate notes.txt", 3, "notes.txt: "),
    ("run data\\a\\sparse\\0 -o NEW", 3, "data\\a\\sparse\\0: expected a folder, found nothing; check the path"),
    ("run C:\\photos -o NEW", 3, "C:\\photos: expected a folder, found nothing"),
    ("run circle -o NEW", 3, "circle: expected a folder, found a circle of links"),
    (
        "run RUN -o NEW",
        3,
        "RUN: is the folder of a run and holds no models; report, diagnose, filter and",
    ),
    ("run data -o NEW --database lost.db", 3, "--database lost.db: there is no such file; check the path"),
    ("run data -o NEW --database photos", 3, "--database photos: is a folder; name the database.db in it, or auto"),
    ("report RUN/run.json", 3, "RUN/run.json: holds no run"),
    ("diagnose data", 3, "data: holds no run"),
    ("filter RUN --model data --model-out OUT", 2, "name one of its models (data/a/sparse/0)"),
    ("filter RUN --model dtaa --model-out OUT", 3, "dtaa: "),
    ("calibrate empty.csv", 3, "empty.csv: expected data, found an empty file; copy or export it again"),
    ("calibrate photos", 3, "photos: expected a file, found a folder; name a file"),
    ("explain RUN id:1 -o STORY --images fotos", 2, "fotos: is no folder"),
]
WRONG_WORD = [
    ("rnu data -o NEW", 2, "No such command 'rnu', did you mean run?"),
    ("audit data", 2, "No such command 'audit'; the commands are run, report,"),
    ("run data -o NEW --job 2", 2, "--job"),
    ("run data -o NEW --jobs two", 2, "two"),
    ("run data -o NEW --policy strict", 2, "strict"),
    ("run data -o NEW --noise loud", 2, "loud"),
    ("run data -o NEW --layout megadepht", 2, "megadepht"),
    ("run data -o NEW --min-effect 0.2", 2, "--min-effect: expected a number with its unit, such as 0.2px or 0.5sigma"),
    ("run data -o NEW --scene A", 3, "did you mean 'a'?"),
    ("run data -o NEW --component 00", 3, "--component '00'"),
    ("run data -o NEW --config typo.toml", 2, "typo.toml: unknown setting alhpa, did you mean alpha?"),
    ("run data -o NEW --config notes.txt", 2, "notes.txt: not a TOML file"),
    ("check RUN --policy-file typo.toml", 2, "typo.toml: unknown key alhpa"),
    ("check RUN --policy-file reason.toml", 2, "unknown reason misfit_radail, did you mean misfit_radial?"),
    ("filter RUN --list kept.txt --keep good", 2, "good"),
    (f"explain {MODEL} IMG_1.jpg -o STORY", 2, "has no image 'IMG_1.jpg'"),
    (f"explain {MODEL} id:12345 -o STORY", 2, "has no image 'id:12345'"),
    ("calibrate points.csv --models D9", 2, "expected some of D1, D3, pnprf, colmap, found D9"),
    ("simulate bord -o OUT", 2, "bord"),
    ("report RUN -o new.html --worst 1000", 2, "1000"),
    ("report RUN -o new.html --reason misfit_radail", 2, "did you mean misfit_radial?"),
    ("report RUN -o new.html --severity bad", 2, "'bad' is not one of"),
    ("report RUN -o new.html --min-effect 0.1px", 2, "smaller misfits were not admitted to the joint test, run again"),
    ("explain-code MISFIT_RADIAL", 2, "did you mean misfit_radial?"),
    ("explain-code zebra", 2, "zebra: no such reason or finding; without a code, explain-code lists all"),
    ("diagnose RUN nothere", 2, "RUN: holds no model 'nothere'; it holds a/0"),
    ("diagnose RUN a --as opencv", 2, "--as opencv: no camera model, did you mean OPENCV?"),
    ("diagnose RUN a --as SIMPLE_PINHOLE", 2, "cannot express the cameras"),
    ("explain RUN IMAGE -o STORY", 2, "name it as RUN/images does, or id:<image_id>"),
    (
        "run data -o NEW --config effect.toml",
        2,
        "a number with its unit, such as 0.2px or 0.5sigma, found 0.2",
    ),
    ("run data -o NEW --config latin.toml", 2, "latin.toml: not a TOML file: byte 5 is not UTF-8; save it as UTF-8"),
    ("check RUN --policy-file text.toml", 2, "limits.max_share_rejected: expected a valid number, found '10%'"),
    ("check RUN --policy-file section.toml", 2, "unknown key limit, did you mean limits?"),
    ("check RUN --policy limits.toml", 2, "'limits.toml' is not one of"),
    ("filter RUN -o kept.txt", 2, "No such option"),
]
MISSING_OR_CONTRADICTING = [
    ("run", 2, "Missing argument 'PATH...'"),
    ("run data", 2, "Missing option '-o'"),
    ("run data -o NEW --points independent", 2, "points = independent takes noise = constant"),
    ("run data -o NEW --max-model-gb 0", 2, "--max-model-gb"),
    ("run data --list --json", 2, "exclude each other"),
    ("run data -o NEW --scene-list names.txt", 2, "names.txt: "),
    ("run data -o NEW --log-file photos", 2, "photos: is a folder; name a file for --log-file"),
    ("report", 2, "Missing argument 'RUN'"),
    ("check RUN", 2, "Missing option '--policy-file'"),
    ("check RUN --policy-file empty.toml", 2, "empty.toml: checks nothing"),
    ("check RUN --policy-file lost.toml", 2, "limits.max_lost_images needs --baseline RUN0"),
    ("check RUN --policy-file limits.toml --json - --junit -", 2, "Only one output can be -"),
    ("diff RUN", 2, "Missing argument 'RUN1'"),
    ("learn-band RUN", 2, "A band takes two runs or more."),
    ("learn-band RUN OTHER", 2, "OTHER: "),
    ("filter RUN", 2, "Nothing to write"),
    (f"filter RUN --model {MODEL}", 2, "--model and --model-out belong together"),
    ("filter RUN --list same --scene-info x.npz --scene-info-out same", 2, "two outputs would be written there"),
    ("filter RUN --model data/b/sparse/0 --model-out OUT", 2, "data/b/sparse/0"),
    (f"filter RUN --model {MODEL} --model-out {MODEL}", 2, "is what is read; write somewhere else"),
    (f"explain {MODEL} -o STORY", 2, "Missing argument 'IMAGE'"),
    ("explain data IMAGE -o STORY", 2, "holds 2 models"),
    ("explain RUN IMAGE -o STORY --noise track", 2, "--noise changes what is measured, and a run was measured already"),
    (f"explain {MODEL} IMAGE -o STORY --severity hard", 2, "are about a RUN, not a model"),
    ("diagnose RUN a --no-refit --as RADIAL", 2, "--no-refit contradicts --as and --out"),
    ("diagnose RUN a --out OUT", 2, "--out takes one --as CAMERA_MODEL"),
    ("diff RUN RUN RUN", 2, "Got unexpected extra argument (RUN)"),
]
TAKEN = [
    ("run data -o README.md", 4, "README.md: cannot be written (it is a file, and a run is a folder)"),
    ("run data -o photos", 2, "photos: is not a run folder and not empty"),
    (f"run {MODEL} -o RUN --policy camera", 2, "RUN: holds a run with policy = standard, not camera"),
    ("run data/b -o RUN", 2, "which this command leaves out"),
    ("report RUN -o README.md", 2, "README.md: exists; choose another name, or replace it with --force"),
    ("report RUN -o photos", 2, "photos: is a folder; name a file"),
    ("filter RUN --list README.md", 2, "README.md: exists"),
    ("learn-band RUN RUN -o README.md", 2, "README.md: exists already"),
    (f"explain {MODEL} IMAGE -o photos", 2, "photos: is not an earlier story"),
    ("demo -o photos", 2, "photos: not empty and not an earlier demo"),
    ("demo -o README.md", 4, "README.md: is a file"),
    ("check RUN --policy-file limits.toml --json no/such/file", 4, "no/such/file: cannot be written"),
    ("calibrate points.csv -o photos", 2, "photos: is not an earlier calibration"),
    ("diagnose RUN a --as RADIAL --out photos", 2, "photos: exists; choose a new folder with --out"),
    ("diagnose RUN a --as RADIAL --out README.md", 2, "README.md: exists; choose a new folder with --out"),
    ("diagnose RUN a --no-refit --json photos", 2, "photos: is a folder; name a file for --json"),
    ("filter RUN --list photos", 2, "photos: is a folder; name a file"),
    ("diff RUN RUN --html photos", 2, "photos: is a folder; name a file"),
    ("run data -o data/a", 2, "data/a: is not a run folder and not empty ('sparse' is in it)"),
]
OLD_OR_DAMAGED = [
    ("run CUT -o NEW1 --quiet", 3, "CUT/images.bin: "),
    ("run POINTER -o NEW2 --quiet", 3, "POINTER/images.bin: "),
    ("report OLD -o new.html", 3, "OLD: "),
    ("check OLD --policy-file limits.toml", 3, "OLD: "),
    ("filter OLD --list kept.txt", 3, "OLD: "),
    ("diff RUN OLD", 3, "OLD: "),
    ("check UNFINISHED --policy-file limits.toml", 3, "UNFINISHED: the run was not finished"),
    ("filter UNFINISHED --list kept.txt", 2, "UNFINISHED: "),
    ("check CHANGED --policy-file limits.toml", 3, "CHANGED: "),
    ("report FOREIGN", 3, "FOREIGN: "),
    ("diagnose CHANGED a --no-refit", 3, "CHANGED: "),
    ("explain CHANGED id:1 -o STORY", 3, "CHANGED: "),
    ("run ZERO -o NEW3 --quiet", 3, "ZERO/images.bin: expected data, found an empty file; copy or export it again"),
]
NOT_PERMITTED = [
    ("run data -o locked/RUN", 4, "locked/RUN: cannot be written"),
    ("run sealed -o NEW4 --quiet", 3, "sealed"),
    ("report RUN -o locked/report.html", 4, "locked/report.html: cannot be written"),
    ("filter RUN --list locked/kept.txt", 4, "locked/kept.txt"),
    ("check RUN --policy-file secret.toml", 2, "secret.toml: cannot be read (Permission denied)"),
    ("check RUN --policy-file limits.toml --json locked/gate.json", 4, "locked/gate.json: cannot be written"),
    ("diff RUN SECRET", 3, "SECRET: "),
]


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A working folder with all that people have lying around."""
    folder = tmp_path_factory.mktemp("mistakes")
    write_models(folder / "data", ("a", "b"))
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr("os.fsync", lambda _: None)
        assert main(["run", MODEL, "-o", "RUN", "--quiet", "--jobs", "1"]) == 0
        write_run(Path("OTHER"), {"x": scene(5)}, config=json.loads(Path("RUN/run.json").read_bytes())["config"])
    for name in ("empty", "photos", "locked"):
        (folder / name).mkdir()
    (folder / "photos" / "IMG_1.jpg").write_bytes(b"\xff\xd8\xff")
    texts = {
        "notes.txt": "no table, no settings: only notes\n",
        "README.md": "# Photos\n",
        "empty.csv": "",
        "effect.toml": "min_effect = 0.2\n",
        "text.toml": "limits.max_share_rejected = '10%'\n",
        "section.toml": "[limit]\nmax_share_rejected = 0.1\n",
        "points.csv": "x,y,X,Y,Z\n1,2,3,4,5\n",
        "empty.toml": "",
        "typo.toml": "alhpa = 0.1\n",
        "reason.toml": "limits.max_share_rejected_by_reason = { misfit_radail = 0.1 }\n",
        "lost.toml": "limits.max_lost_images = 3\n",
        "limits.toml": "limits.max_share_rejected = 1.0\n",
        "secret.toml": "",
    }
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")
    (folder / "latin.toml").write_bytes(b"# caf\xe9\n")
    (folder / "circle").symlink_to("circle")
    _broken_models(folder)
    _broken_runs(folder)
    return folder


def _broken_models(folder: Path) -> None:
    for name in ("CUT", "POINTER", "ZERO", "sealed"):
        shutil.copytree(folder / MODEL, folder / name)
    truncate(folder / "CUT" / "images.bin")
    (folder / "ZERO" / "images.bin").write_bytes(b"")
    pointer = f"version https://git-lfs.github.com/spec/v1\noid sha256:{'0' * 64}\nsize 12345\n"
    (folder / "POINTER" / "images.bin").write_text(pointer, encoding="utf-8")


def _broken_runs(folder: Path) -> None:
    for name in ("OLD", "UNFINISHED", "CHANGED", "FOREIGN", "SECRET"):
        shutil.copytree(folder / "RUN", folder / name)
    info = json.loads((folder / "RUN" / "run.json").read_bytes())
    old = {key: value for key, value in info.items() if key != "manifest"} | {"inputs": [{"scene": "a"}]}
    (folder / "OLD" / "manifest.jsonl").unlink()
    for name, content in (("OLD", old), ("UNFINISHED", {**info, "status": "running"}), ("FOREIGN", {"tool": "ruff"})):
        (folder / name / "run.json").write_text(json.dumps(content), encoding="utf-8")
    part = next((folder / "CHANGED" / "images").glob("*.parquet"))
    part.write_bytes(part.read_bytes()[:-8] + b"\0" * 8)


@pytest.fixture(autouse=True)
def _here(place, monkeypatch):
    monkeypatch.chdir(place)


@contextlib.contextmanager
def as_somebody_else():
    """Without root's right to do everything; what is sealed belongs to nobody."""
    sealed = [Path("locked"), Path("sealed/images.bin"), Path("secret.toml"), Path("SECRET/run.json")]
    modes = [path.stat().st_mode for path in sealed]
    is_root = os.geteuid() == 0
    package = Path(sfm_audit.__file__).resolve().parent
    for path in sealed:
        path.chmod(0o000 if path.is_file() else 0o555)
    Path().chmod(0o777)
    if is_root:
        os.seteuid(NOBODY)
    try:
        if not os.access(package, os.R_OK | os.X_OK, effective_ids=True):
            pytest.skip("the package lies where nobody else may read it")
        yield
    finally:
        if is_root:
            os.seteuid(0)
        for path, mode in zip(sealed, modes, strict=True):
            path.chmod(mode)


def check_one_line(args: str, code: int, words: str, capsys) -> None:
    before = sorted(Path().rglob("*"))
    assert main(args.split()) == code, capsys.readouterr().err
    out, err = capsys.readouterr()
    assert out == "" or "--json" in args  # the page of a verb whose report cannot be written is printed all the same
    assert err.startswith("sfm-audit: ")
    assert err.count("\n") == 1
    assert words in err
    assert "Traceback" not in err
    if code == 2:
        assert sorted(Path().rglob("*")) == before  # and nothing was left behind


ALL = [*WRONG_PATH, *WRONG_WORD, *MISSING_OR_CONTRADICTING, *TAKEN, *OLD_OR_DAMAGED]


@pytest.mark.parametrize(("args", "code", "words"), ALL, ids=[args for args, *_ in ALL])
def test_a_mistake_costs_one_line(args, code, words, capsys):
    check_one_line(args, code, words, capsys)


@pytest.mark.skipif(not hasattr(os, "seteuid"), reason="this operating system has no users to change to")
@pytest.mark.parametrize(("args", "code", "words"), NOT_PERMITTED, ids=[args for args, *_ in NOT_PERMITTED])
def test_what_is_not_permitted_costs_one_line(args, code, words, capsys):
    for verb in VERBS:  # somebody else may not be able to read the folder that they are imported from
        importlib.import_module(f"sfm_audit.audit.cli.{verb.replace('-', '_')}")
    importlib.import_module("sfm_audit.audit.cli.report_page")
    with as_somebody_else():
        check_one_line(args, code, words, capsys)


def test_there_are_enough_of_them_and_of_every_exit_code():
    cases = [*ALL, *NOT_PERMITTED]
    assert len({args for args, *_ in cases}) == len(cases) >= 50
    assert {code for _, code, _ in cases} == {2, 3, 4}
