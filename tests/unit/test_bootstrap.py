"""scripts/bootstrap with a stand-in for Python: `-m venv` and `-m pip` only leave traces, all else is the real one."""

import os
import shutil
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

import pytest

SCRIPTS = Path(__file__).resolve().parents[2] / "scripts"
VERSION = f"{sys.version_info.major}.{sys.version_info.minor}"
UNAVAILABLE = 69

STAND_IN = f"""#!/bin/sh
for last; do :; done
case "$*" in
*"-m venv --without-pip "*) ;;
*"-m venv "*) [ -z "${{FAKE_NO_ENSUREPIP-}}" ] || {{ echo "ensurepip is not available"; exit 1; }} ;;
*"-m pip "*)
    echo "$*" >>"$FAKE_LOG"
    sleep "${{FAKE_PIP_SECONDS:-0}}"
    [ -z "${{FAKE_PIP_KILLED-}}" ] || kill -9 "$PPID"
    [ -z "${{FAKE_PIP_FAILS-}}" ] || {{ echo "no index within reach"; exit 1; }}
    printf '#!/bin/sh\\necho "$PWD $*"\\nexit 3\\n' >"${{FAKE_ROOT}}/.venv/bin/tool"
    chmod +x "${{FAKE_ROOT}}/.venv/bin/tool"
    exit ;;
*) exec "{sys.executable}" "$@" ;;
esac
mkdir -p "$last/bin" "$last/lib/python{VERSION}/site-packages/pip"
echo "command = python -m venv $last" >"$last/pyvenv.cfg"
echo "venv $last" >>"$FAKE_LOG"
cp "$0" "$last/bin/python"
"""


@dataclass
class Checkout:
    """A checkout with nothing in it but the scripts and a pyproject.toml."""

    root: Path
    env: dict[str, str] = field(default_factory=dict)

    def start(self, *args: str, script="bootstrap", cwd="/", **env: str):
        base = {"PATH": os.environ["PATH"], "FAKE_LOG": f"{self.root}/log", "FAKE_ROOT": str(self.root), **self.env}
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        return subprocess.Popen([self.root / "scripts" / script, *args], cwd=cwd, env=base | env, **pipes)

    def run(self, *args: str, **options: str | Path):
        process = self.start(*args, **options)
        out, err = process.communicate(timeout=60)
        return subprocess.CompletedProcess(args, process.returncode, out, err)

    def log(self):
        """What was asked of venv and pip since the last call: 'venv' and pip's last argument."""
        path = self.root / "log"
        lines = path.read_text().splitlines() if path.exists() else []
        path.write_text("")
        return ["venv" if line.startswith("venv ") else line.split()[-1] for line in lines]

    def stamps(self):
        return sorted(path.name for path in (self.root / ".venv").glob(".installed-*"))


def executable(path, text):
    path.write_text(text)
    path.chmod(0o755)
    return path


@pytest.fixture
def checkout(tmp_path):
    root = tmp_path / "a check-out (1)"
    (root / "scripts").mkdir(parents=True)
    for name in ("bootstrap", "install_venv.py", "demo", "sfm-audit", "test"):
        shutil.copy(SCRIPTS / name, root / "scripts" / name)
    (root / "pyproject.toml").write_text("[project]\nname = 'x'\n")
    return Checkout(root, {"PYTHON": str(executable(tmp_path / "python stand-in", STAND_IN))})


def test_first_use_installs_and_hands_arguments_folder_and_exit_code_on(checkout, tmp_path):
    done = checkout.run("base", "tool", "two words", "--flag", cwd=tmp_path)
    assert done.stderr == "Installing into .venv (first use, about a minute) ...\n"
    assert (done.stdout, done.returncode) == (f"{tmp_path} two words --flag\n", 3)
    assert checkout.log() == ["venv", "."]


def test_second_use_installs_nothing_and_is_quick(checkout):
    checkout.run("dev")
    assert checkout.log() == ["venv", ".[dev]"]
    started = time.perf_counter()
    done = checkout.run("base", "tool")
    assert time.perf_counter() - started < 1.0
    assert done.stderr == ""
    assert checkout.log() == []


def test_the_extra_for_tests_is_added_to_the_same_environment(checkout):
    checkout.run("base")
    assert checkout.stamps() == [".installed-base"]
    assert checkout.run("dev").stderr == "Updating .venv ...\n"
    assert checkout.log() == ["venv", ".", ".[dev]"]
    extras = ["base", "calibrate", "cluster", "dev", "report"]
    assert checkout.stamps() == [f".installed-{extra}" for extra in extras]


def test_a_changed_pyproject_is_installed_again_without_a_rebuild(checkout):
    checkout.run("base")
    with (checkout.root / "pyproject.toml").open("a") as file:
        file.write("\n")
    assert checkout.run("base", PYTHON="").stderr == "Updating .venv ...\n"
    assert checkout.run("base").stderr == ""
    assert checkout.log() == ["venv", ".", "."]


def test_a_killed_installation_does_not_count_and_is_built_anew(checkout):
    assert checkout.run("base", "tool", FAKE_PIP_KILLED="1").returncode not in (0, 3)
    assert checkout.stamps() == []
    checkout.log()
    assert checkout.run("base", "tool").returncode == 3
    assert checkout.log() == ["venv", "."]


def test_a_killed_update_is_built_anew_even_when_the_old_stamp_fits_again(checkout):
    checkout.run("base")
    pyproject = checkout.root / "pyproject.toml"
    before = pyproject.read_text()
    pyproject.write_text(before + "\n")
    checkout.run("base", FAKE_PIP_KILLED="1")
    pyproject.write_text(before)
    checkout.log()
    checkout.run("base")
    assert checkout.log() == ["venv", "."]


def test_a_failing_pip_is_heard_and_tried_again(checkout):
    done = checkout.run("base", "tool", FAKE_PIP_FAILS="1")
    assert (done.returncode, done.stdout) == (UNAVAILABLE, "")
    _, pip_says, ours = done.stderr.splitlines()
    assert pip_says == "no index within reach"
    assert ours.startswith("bootstrap: pip could not install sfm-audit")
    assert checkout.run("base", "tool").returncode == 3
    assert checkout.log() == ["venv", ".", "."]


def test_two_starts_at_once_install_once(checkout):
    starts = [checkout.start("base", "tool", FAKE_PIP_SECONDS="0.5") for _ in range(3)]
    errors = sorted(process.communicate(timeout=60)[1] for process in starts)
    assert [process.returncode for process in starts] == [3, 3, 3]
    assert errors[0].startswith("Installing")
    assert errors[1:] == ["Waiting for another installation into .venv ...\n"] * 2
    assert checkout.log() == ["venv", "."]


def test_a_moved_checkout_is_built_anew(checkout):
    checkout.run("base")
    moved = checkout.root.rename(checkout.root.with_name("moved"))
    moved_checkout = Checkout(moved, checkout.env)
    moved_checkout.log()
    moved_checkout.run("base")
    assert moved_checkout.log() == ["venv", "."]


@pytest.mark.parametrize("script", ["demo", "sfm-audit", "test"])
def test_commands_work_through_links(checkout, tmp_path, script):
    checkout.run("dev")
    command = "pytest" if script == "test" else "sfm-audit"
    (checkout.root / ".venv" / "bin" / "tool").rename(checkout.root / ".venv" / "bin" / command)
    link = tmp_path / "link"
    link.symlink_to(checkout.root / "scripts" / script)
    done = subprocess.run(
        [link, "x"], cwd=tmp_path, env=os.environ | checkout.env, stdout=subprocess.PIPE, text=True, check=False
    )
    folder = checkout.root if script == "test" else tmp_path
    assert done.stdout == f"{folder} {'demo ' if script == 'demo' else ''}x\n"


def test_python_without_ensurepip_gets_pip_from_its_own(checkout):
    checkout.run("base", FAKE_NO_ENSUREPIP="1")
    assert checkout.log() == ["venv", "pip", "."]
    assert checkout.stamps() == [".installed-base"]


def test_python_without_ensurepip_and_pip_is_told_what_to_install(checkout):
    done = checkout.run("base", FAKE_NO_ENSUREPIP="1", FAKE_PIP_FAILS="1")
    assert done.returncode == UNAVAILABLE
    assert "cannot make a virtual environment; install its venv module" in done.stderr.splitlines()[-1]
    assert checkout.run("base").returncode == 0


def test_too_old_or_absent_python_is_one_line(checkout, tmp_path):
    old = executable(tmp_path / "old", "#!/bin/sh\necho 3.9\n")
    for python, said in [(old, "is Python 3.9"), (tmp_path / "none", "does not run")]:
        done = checkout.run("base", PYTHON=str(python))
        assert done.returncode == UNAVAILABLE
        assert done.stderr.count("\n") == 1
        assert said in done.stderr
        assert "Python 3.11 or newer" in done.stderr


def test_a_path_without_a_new_enough_python_is_one_line(checkout, tmp_path):
    tools = tmp_path / "bin"
    tools.mkdir()
    for name in ("readlink", "cat", "cmp"):
        (tools / name).symlink_to(shutil.which(name))
    env = {"PATH": str(tools), "PYTHON": ""}
    assert checkout.run("base", **env).stderr.startswith("bootstrap: this needs Python 3.11 or newer; install one")
    executable(tools / "python3", "#!/bin/sh\necho 3.8\n")
    assert "newer (python3 is 3.8); install" in checkout.run("base", **env).stderr
    for shim in ("python3.14", "python3.13"):  # as pyenv leaves them for versions that are not there
        executable(tools / shim, "#!/bin/sh\nexit 127\n")
    shutil.copy(checkout.env["PYTHON"], tools / "python3.12")
    tools_and_shell = f"{tools}:{os.environ['PATH']}"
    assert checkout.run("base", PATH=tools_and_shell, PYTHON="").returncode == 0


def test_the_users_python_path_stays_outside(checkout):
    checkout.run("base")
    executable(checkout.root / ".venv" / "bin" / "tool", '#!/bin/sh\necho "${PYTHONPATH-unset} ${PYTHONHOME-unset}"\n')
    assert checkout.run("base", "tool", PYTHONPATH="/opt/ros", PYTHONHOME="/opt").stdout == "unset unset\n"


@pytest.mark.parametrize(
    ("words", "extra"),
    [
        (["report", "RUN"], "report"),
        (["explain", "--help"], "report"),
        (["calibrate", "run"], "calibrate"),
        (["simulate", "board"], "calibrate"),
        (["run", "report", "-o", "RUN"], "base"),
        (["run", "PATH", "--dask", "local"], "cluster"),
        (["run", "PATH", "--dask=local"], "cluster"),
        (["--version"], "base"),
        ([], "base"),
    ],
)
def test_the_command_line_installs_the_extra_that_its_verb_needs_and_says_so(checkout, words, extra):
    checkout.run("base")
    executable(checkout.root / ".venv" / "bin" / "sfm-audit", '#!/bin/sh\necho "verb $*"\n')
    checkout.log()
    done = checkout.run(*words, script="sfm-audit")
    said = f"Installing what this needs into .venv (extra {extra}, first use) ...\n"
    assert (done.stdout, done.stderr) == (f"verb {' '.join(words)}\n", "" if extra == "base" else said)
    assert checkout.log() == ([] if extra == "base" else [f".[{extra}]"])
    assert checkout.run(*words, script="sfm-audit").stderr == ""


def test_the_extra_for_tests_holds_all_others(checkout):
    checkout.run("dev")
    executable(checkout.root / ".venv" / "bin" / "sfm-audit", "#!/bin/sh\n")
    checkout.log()
    assert checkout.run("report", "RUN", script="sfm-audit").stderr == ""
    assert checkout.log() == []


COMPILER = """#!/bin/sh
[ -z "${FAKE_CC_FAILS-}" ] || { echo "no such header" >&2; exit 1; }
while [ "$1" != -o ]; do case $1 in -DSFM_SOURCES=*) hash=$1 ;; esac; shift; done
out=$2
[ -z "${hash-}" ] || { printf '%s' "$hash" >"$out"; exit; }
shift 2
echo built >>"$FAKE_LOG"
cat "$1" >"$out"
"""


@pytest.fixture
def with_kernels(checkout, tmp_path):
    """A checkout with C sources, and a stand-in for the compiler."""
    shutil.copy(SCRIPTS / "build_kernels.py", checkout.root / "scripts")
    (checkout.root / "audit/kernels/source").mkdir(parents=True)
    (checkout.root / "audit/kernels/source/version.c").write_text("/* one */\n")
    (checkout.root / "sfm_audit").mkdir()
    (checkout.root / "sfm_audit/audit").symlink_to("../audit")
    checkout.env["CC"] = str(executable(tmp_path / "compile", COMPILER)).replace(" ", "\\ ")
    return checkout


def later(path, library):
    """Give a file a time of change after that of the library."""
    os.utime(path, ns=(library.stat().st_mtime_ns + 10**9,) * 2)


def library_of(checkout):
    return next(path for path in (checkout.root / "audit/kernels").glob("compiled.*"))


def test_compiled_kernels_follow_their_sources(with_kernels):
    source = with_kernels.root / "audit/kernels/source/version.c"
    assert with_kernels.run("dev").returncode == 0
    assert with_kernels.log() == ["venv", ".[dev]", "built"]
    library = library_of(with_kernels)
    later(source, library)
    assert with_kernels.run("dev").stderr == ""  # newer, but what it was
    assert with_kernels.log() == []
    os.utime(library)
    source.write_text("/* two */\n")
    later(source, library)
    for extra in ("base", "base", "dev"):  # whoever has a library has one of these sources
        assert with_kernels.run(extra, "tool").returncode == 3
    assert with_kernels.log() == ["built"]


def test_a_compiler_that_fails_stops_a_developer_and_nobody_else(with_kernels):
    done = with_kernels.run("dev", FAKE_CC_FAILS="1")
    assert done.returncode == UNAVAILABLE
    assert "no such header" in done.stderr
    assert "SFM_AUDIT_KERNELS=0" in done.stderr
    assert with_kernels.run("dev", FAKE_CC_FAILS="1", SFM_AUDIT_KERNELS="0").returncode == 0
    assert with_kernels.run("dev").returncode == 0
    source = with_kernels.root / "audit/kernels/source/version.c"
    source.write_text("/* two */\n")
    later(source, library_of(with_kernels))
    with_kernels.log()
    done = with_kernels.run("base", "tool", FAKE_CC_FAILS="1")
    assert (done.returncode, done.stderr.count("\n")) == (3, 1)
    done = with_kernels.run("base", "tool", FAKE_CC_FAILS="1")  # and it is not tried again
    assert (done.returncode, done.stderr) == (3, "")


def test_without_a_compiler_nothing_is_said(with_kernels, tmp_path):
    tools = tmp_path / "tools"
    tools.mkdir()
    for name in ("cat", "cmp", "cp", "env", "find", "mkdir", "readlink", "rm", "sh", "sleep", "chmod"):
        (tools / name).symlink_to(shutil.which(name))
    done = with_kernels.run("dev", "tool", PATH=str(tools), CC="")
    assert (done.returncode, done.stderr) == (3, "Installing into .venv (first use, about a minute) ...\n")
    assert with_kernels.log() == ["venv", ".[dev]"]
