"""Installing occupies one import name: what a wheel and an sdist hold, and every verb among a user's own modules."""

import importlib.util
import os
import re
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest
from packaging.tags import sys_tags
from packaging.utils import parse_wheel_filename

import sfm_audit
from sfm_audit.audit.cli.main import VERBS
from sfm_audit.audit.kernels.library import LIBRARY as LIBRARY_PATH
from sfm_audit.audit.kernels.library import sources_hash

ROOT = Path(__file__).resolve().parents[2]
HAS_BUILDER = importlib.util.find_spec("hatchling") is not None
needs_builder = pytest.mark.skipif(not HAS_BUILDER, reason="hatchling is not installed: the extra dev has it")


needs_compiler = pytest.mark.skipif(not any(map(shutil.which, ("cc", "gcc", "clang"))), reason="no C compiler")
LIBRARY = f"sfm_audit/audit/kernels/{LIBRARY_PATH.name}"


def build(source: Path, out: Path, target=(), **variables: str) -> tuple[list[Path], str]:
    """Build with the hatchling that is installed, as pip does it, without a network; the files, and what was said."""
    command = [sys.executable, "-m", "hatchling", "build", "--directory", str(out), *target]
    env = {**os.environ, "SFM_AUDIT_KERNELS": "", **variables}
    done = subprocess.run(command, cwd=source, env=env, check=True, capture_output=True, text=True)
    return sorted(out.iterdir()), done.stdout + done.stderr


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """A wheel without compiled kernels, and an sdist."""
    (wheel, sdist), _ = build(ROOT, tmp_path_factory.mktemp("dist"), SFM_AUDIT_KERNELS="0")
    return wheel, sdist


@pytest.fixture(scope="module")
def compiled(tmp_path_factory, quick_compiler):
    """A wheel with compiled kernels."""
    out = tmp_path_factory.mktemp("compiled")
    (wheel,), _ = build(ROOT, out, ("--target", "wheel"), SFM_AUDIT_KERNELS="1", CC=quick_compiler)
    return wheel


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
    # as on a machine without a compiler: neither a variable nor a failure, the same pure wheel and one warning
    (again, sdist_again), said = build(source, tmp_path / "dist", PATH=str(tmp_path / "nothing"), CC="")
    assert said.count("sfm-audit is installed without compiled kernels (slower): no C compiler") == 1
    with zipfile.ZipFile(wheel) as one, zipfile.ZipFile(again) as two:
        first = {name: one.read(name) for name in one.namelist() if not name.endswith("/RECORD")}
        second = {name: two.read(name) for name in two.namelist() if not name.endswith("/RECORD")}
    assert first.keys() == second.keys()
    assert [name for name in first if first[name] != second[name]] == []
    with tarfile.open(sdist) as one, tarfile.open(sdist_again) as two:
        assert sorted(one.getnames()) == sorted(two.getnames())


@needs_builder
@needs_compiler
def test_a_wheel_with_kernels_says_where_it_runs_and_uses_them(built, compiled, tmp_path):
    pure = built[0]
    assert pure.name.endswith("-py3-none-any.whl")
    (tag,) = parse_wheel_filename(compiled.name)[3]
    assert tag in set(sys_tags())
    with zipfile.ZipFile(pure) as one, zipfile.ZipFile(compiled) as other:
        assert set(other.namelist()) - set(one.namelist()) == {LIBRARY}
        other.extractall(tmp_path)  # noqa: S202 - built here
    check = [sys.executable, str(ROOT / "scripts" / "check_wheel.py"), str(compiled)]
    assert subprocess.run(check, capture_output=True, check=False).returncode == 0
    code = "from sfm_audit.audit.kernels import path_taken; print(path_taken().name)"
    env = {**os.environ, "PYTHONPATH": str(tmp_path), "SFM_AUDIT_KERNELS": "1"}
    said = subprocess.check_output([sys.executable, "-c", code], cwd=tmp_path, env=env, text=True)
    assert said == "compiled\n"


@needs_builder
@needs_compiler
def test_the_check_sees_a_library_of_other_sources_and_a_name_that_promises_too_much(compiled, tmp_path):
    wrong = tmp_path / re.sub(r"none-.*", "none-manylinux_2_5_x86_64.whl", compiled.name)
    with zipfile.ZipFile(compiled) as good, zipfile.ZipFile(wrong, "w") as bad:
        for name in good.namelist():
            data = good.read(name)
            bad.writestr(name, data.replace(sources_hash().encode(), b"0" * 64) if name == LIBRARY else data)
    command = [sys.executable, str(ROOT / "scripts" / "check_wheel.py"), str(wrong)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    one, two = done.stderr.splitlines()
    assert one == f"{wrong.name}: {LIBRARY} is of other sources"
    assert two.startswith(f"{wrong.name}: its library is one for py3-none-")


@needs_builder
def test_a_compiler_that_fails_is_a_warning_unless_kernels_are_insisted_on(tmp_path):
    (wheel,), said = build(ROOT, tmp_path / "tried", ("--target", "wheel"), CC="false")
    assert wheel.name.endswith("-py3-none-any.whl")
    assert said.count("without compiled kernels (slower): false failed") == 1
    with pytest.raises(subprocess.CalledProcessError) as error:
        build(ROOT, tmp_path / "insisted", ("--target", "wheel"), CC="false", SFM_AUDIT_KERNELS="1")
    assert "SFM_AUDIT_KERNELS=1, but there are no compiled kernels: false failed" in error.value.stderr


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
