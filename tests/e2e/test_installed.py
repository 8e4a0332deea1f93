"""Installing occupies one import name: what a wheel and an sdist hold, and every verb among a user's own modules."""

import importlib.util
import os
import re
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

import sfm_audit
from sfm_audit.audit.cli.main import VERBS

ROOT = Path(__file__).resolve().parents[2]
HAS_BUILDER = importlib.util.find_spec("hatchling") is not None
needs_builder = pytest.mark.skipif(not HAS_BUILDER, reason="hatchling is not installed: the extra dev has it")


def build(source: Path, out: Path) -> tuple[Path, Path]:
    """Build a wheel and an sdist with the hatchling that is installed, as pip does it, without a network."""
    command = [sys.executable, "-m", "hatchling", "build", "--directory", str(out)]
    subprocess.run(command, cwd=source, check=True, capture_output=True)
    (wheel,), (sdist,) = out.glob("*.whl"), out.glob("*.tar.gz")
    return wheel, sdist


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    return build(ROOT, tmp_path_factory.mktemp("dist"))


def top_names(names):
    return {name.partition("/")[0] for name in names}


@needs_builder
def test_a_wheel_takes_one_name(built):
    wheel, sdist = built
    with zipfile.ZipFile(wheel) as archive:
        names, contents = archive.namelist(), {name: archive.read(name) for name in archive.namelist()}
    metadata = {name for name in top_names(names) if name.endswith(".dist-info")}
    assert len(metadata) == 1
    assert top_names(names) - metadata == {"sfm_audit"}
    for name in ("sfm_audit/py.typed", "sfm_audit/__main__.py", "sfm_audit/reports/html/vendor/dataTables.min.js"):
        assert name in names
    check = [sys.executable, str(ROOT / "scripts" / "check_wheel.py")]
    done = subprocess.run([*check, str(wheel), str(sdist)], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.count("\n") == 2
    for name, data in contents.items():  # links became the files that they name
        room = name.removeprefix("sfm_audit/")
        if (ROOT / room).is_file() and room != name:
            assert data == (ROOT / room).read_bytes(), name


@needs_builder
def test_the_check_sees_what_is_missing_and_what_is_too_much(built, tmp_path):
    wheel, _ = built
    wrong = tmp_path / wheel.name
    with zipfile.ZipFile(wheel) as good, zipfile.ZipFile(wrong, "w") as bad:
        for name in good.namelist():
            if name != "sfm_audit/audit/normality/null_ks_norm.csv":
                bad.writestr(name, good.read(name))
        bad.writestr("audit/__init__.py", "")
    command = [sys.executable, str(ROOT / "scripts" / "check_wheel.py"), str(wrong)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr.splitlines() == [
        f"{wheel.name}: lacks sfm_audit/audit/normality/null_ks_norm.csv",
        f"{wheel.name}: should not hold audit/__init__.py",
    ]


@needs_builder
def test_an_sdist_builds_the_same_wheel(built, tmp_path):
    wheel, sdist = built
    with tarfile.open(sdist) as archive:
        assert all(member.isfile() for member in archive)  # no links: not every system unpacks them
        archive.extractall(tmp_path, filter="data")
    (source,) = tmp_path.iterdir()
    again, sdist_again = build(source, tmp_path / "dist")
    with zipfile.ZipFile(wheel) as one, zipfile.ZipFile(again) as two:
        first = {name: one.read(name) for name in one.namelist() if not name.endswith("/RECORD")}
        second = {name: two.read(name) for name in two.namelist() if not name.endswith("/RECORD")}
    assert first.keys() == second.keys()
    assert [name for name in first if first[name] != second[name]] == []
    with tarfile.open(sdist) as one, tarfile.open(sdist_again) as two:
        assert sorted(one.getnames()) == sorted(two.getnames())


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A user's folder with modules of the names that ours once took; importing one of them fails."""
    here = tmp_path_factory.mktemp("user")
    for name in ("audit.py", "loaders.py", "reports/__init__.py"):
        path = here / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(f"raise ImportError('this is the {name} of the user')\n")
    (here / "gate.toml").write_text("")
    for arguments in PREPARED:
        done = python(here, *arguments)
        assert done.returncode == 0, done.stderr
    return here


def python(here, *arguments: str, code=None):
    """Run ``python -m sfm_audit``, or code, with the user's folder first on the path, which -m and -c put there."""
    package = str(Path(sfm_audit.__file__).parents[1])
    variables = {**os.environ, "PYTHONPATH": package, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    variables.pop("PYTHONSAFEPATH", None)
    command = ["-c", code] if code else ["-m", "sfm_audit", *arguments]
    return subprocess.run(
        [sys.executable, *command], cwd=here, env=variables, capture_output=True, text=True, check=False
    )


def test_the_user_s_modules_come_first(folder):
    done = python(folder, code="__import__('loaders')")
    assert "this is the loaders.py of the user" in done.stderr


RUN = "audit-demo/run"
PREPARED = (["demo", "--quiet"], ["simulate", "board", "-o", "boards", "--sets", "1", "--points-only", "--quiet"])
ASKED = (
    ["run", "audit-demo/photos", "-o", "RUN", "--jobs", "2", "--quiet"],
    ["report", RUN, "-o", "report.html"],
    ["explain", "audit-demo/photos/sparse/0", "IMG_0010.jpg", "-o", "explained"],
    ["check", RUN, "--policy-file", "gate.toml", "--baseline", RUN],
    ["diff", RUN, RUN],
    ["learn-band", RUN, RUN, "-o", "learned.toml"],
    ["filter", RUN, "--list", "kept.txt"],
    ["diagnose", RUN, "--no-refit"],
    ["explain-code", "misfit_radial"],
    ["calibrate", "boards/set_000.csv", "--models", "D1", "-o", "calibration", "--quiet"],
)


def test_every_verb_is_tried():
    assert sorted(arguments[0] for arguments in (*PREPARED, *ASKED)) == sorted(VERBS)


@pytest.mark.parametrize("arguments", [["--version"], *ASKED], ids=lambda arguments: arguments[0])
def test_every_verb_works_among_them(folder, arguments):
    done = python(folder, *arguments)
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr


def test_without_arguments_it_helps(folder):
    done = python(folder)
    assert done.stdout.startswith("Usage: sfm-audit [OPTIONS] COMMAND")


def test_the_documented_snippet_works_among_them(folder):
    page = (ROOT / "docs" / "python.md").read_text(encoding="utf-8")
    done = python(folder, code="\n".join(re.findall(r"```python\n(.*?)```", page, flags=re.DOTALL)))
    assert (done.returncode, done.stderr) == (0, "")
    assert "IMG_0010.jpg" in done.stdout
