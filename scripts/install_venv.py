"""Install this checkout into .venv: the slow half of scripts/bootstrap, which calls it only when the stamp is stale.

What is inside .venv besides a virtual environment:

``.installed-base``, ``.installed-dev``
    Stamps: Python version, root folder and pyproject.toml as they were when that extra was last installed.
``.installing``
    There while an installation runs. Found by the next one, it says that one was killed half-way: build anew.
``.lock``
    Held while an installation runs, by pip as well, so that a pip that outlives us is waited for.
"""

import argparse
import contextlib
import fcntl
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
VENV = ROOT / ".venv"
INTERPRETER = VENV / "bin" / "python"
MARKER = VENV / ".installing"
LOCK = VENV / ".lock"
ROOMS = ("audit", "loaders", "reports", "sfm_audit")
EXTRAS = ["report", "calibrate", "cluster"]
REQUIREMENTS = {  # what pip is told, what is then installed
    "base": (".", ["base"]),
    **{extra: (f".[{extra}]", ["base", extra]) for extra in EXTRAS},
    "dev": (".[dev]", ["base", *EXTRAS, "dev"]),
}
EXIT_UNAVAILABLE = 69
EXIT_INTERRUPTED = 130


class InstallError(Exception):
    """The installation is impossible; the message is for the user."""


def say(text: str) -> None:
    """Progress and errors go to stderr: stdout belongs to the command that follows."""
    print(text, file=sys.stderr, flush=True)


def version_of(python: str | Path) -> str | None:
    """Major and minor version of an interpreter; None if it does not run."""
    code = "import sys; print('%d.%d' % sys.version_info[:2])"
    try:
        done = subprocess.run([python, "-I", "-S", "-c", code], capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    return done.stdout.strip()


def stamp_path(extra: str) -> Path:
    """Where the stamp of an extra is."""
    return VENV / f".installed-{extra}"


def stamp(version: str, pyproject: bytes) -> bytes:
    """Byte for byte what stamp() in scripts/bootstrap prints."""
    return f"python {version}\nroot ".encode() + os.fsencode(ROOT) + b"\n" + pyproject


def is_installed(extra: str, version: str, pyproject: bytes) -> bool:
    """Whether another process has done the work while this one waited for the lock."""
    path = stamp_path(extra)
    usable = not MARKER.exists() and path.exists() and version_of(INTERPRETER) == version
    return usable and path.read_bytes() == stamp(version, pyproject)


@contextlib.contextmanager
def locked() -> Iterator[int]:
    """Hold the lock; yields its descriptor, for child processes to hold it too."""
    VENV.mkdir(exist_ok=True)
    with LOCK.open("a") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            say("Waiting for another installation into .venv ...")
            fcntl.flock(file, fcntl.LOCK_EX)
        yield file.fileno()


def is_reusable(version: str) -> bool:
    """Whether pip can go on in the .venv that is there, instead of starting from nothing."""
    config = VENV / "pyvenv.cfg"
    has_pip = (VENV / "lib" / f"python{version}" / "site-packages" / "pip").exists()
    if MARKER.exists() or not has_pip or not config.exists() or version_of(INTERPRETER) != version:
        return False
    # Scripts carry the path of their interpreter: a copied or moved .venv runs another one's programs.
    lines = config.read_text(encoding="utf-8", errors="surrogateescape").splitlines()
    return any(line.startswith("command =") and line.endswith(f" {VENV}") for line in lines)


def empty_venv() -> None:
    """Remove everything but the lock, which others may be waiting on, and the marker."""
    for path in VENV.iterdir():
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        elif path not in (LOCK, MARKER):
            path.unlink()


def attempt(command: list[str | Path], lock: int) -> tuple[bool, str]:
    """Run a command in the root folder; whether it succeeded, and what it wrote."""
    done = subprocess.run(
        command,
        cwd=ROOT,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        pass_fds=[lock],
        text=True,
        errors="replace",
        check=False,
    )
    if done.returncode < 0:
        raise KeyboardInterrupt  # killed: the marker stays, and the next start builds anew
    return done.returncode == 0, done.stdout


def create_venv(python: str, lock: int) -> None:
    """Make .venv from nothing, also where Debian's Python lacks ensurepip (python3-venv) but has a pip of its own."""
    created, output = attempt([python, "-I", "-m", "venv", VENV], lock)
    if created:
        return
    empty_venv()
    bare, _ = attempt([python, "-I", "-m", "venv", "--without-pip", VENV], lock)
    options = ["--quiet", "--disable-pip-version-check", "--no-input", "--no-user"]
    pip: list[str | Path] = [python, "-I", "-m", "pip", "--python", INTERPRETER, "install", *options, "pip"]
    if not (bare and attempt(pip, lock)[0]):
        raise InstallError(
            f"{output.rstrip()}\nbootstrap: {python} cannot make a virtual environment; "
            "install its venv module (Debian, Ubuntu: python3-venv) or set PYTHON=/path/to/another/python"
        )


def install(extra: str, python: str, lock: int) -> None:
    """Bring .venv up to date and leave a stamp; on failure, no stamp for the present pyproject.toml."""
    version = version_of(python)
    if version is None:
        raise InstallError(f"bootstrap: {python} does not run")
    pyproject = (ROOT / "pyproject.toml").read_bytes()  # before pip reads it: an edit meanwhile makes the stamp stale
    if is_installed(extra, version, pyproject):
        return
    reusable = is_reusable(version)
    MARKER.touch()
    if extra in EXTRAS:
        say(f"Installing what this needs into .venv (extra {extra}, first use) ...")
    elif reusable:
        say("Updating .venv ...")
    else:
        say("Installing into .venv (first use, about a minute) ...")
    if not reusable:
        empty_venv()
        create_venv(python, lock)
    requirement, stamped = REQUIREMENTS[extra]
    options = ["--quiet", "--disable-pip-version-check", "--no-input", "--no-user", "--prefer-binary"]
    installed, output = attempt([INTERPRETER, "-I", "-m", "pip", "install", *options, "-e", requirement], lock)
    if installed:
        # pip compiles what it copies, and this checkout it does not copy. Machines that keep no bytecode of their own
        # accord (PYTHONDONTWRITEBYTECODE) would compile 280 modules at every start: half a second.
        attempt([INTERPRETER, "-I", "-m", "compileall", "-q", *ROOMS], lock)
        for name in stamped:
            partial = VENV / f".installed-{name}.partial"
            partial.write_bytes(stamp(version, pyproject))
            partial.replace(stamp_path(name))
    MARKER.unlink()  # pip puts back what it had replaced when it fails by itself
    if not installed:
        raise InstallError(
            f"{output.rstrip()}\nbootstrap: pip could not install sfm-audit (its reasons are above); "
            "behind a proxy or a mirror, set HTTPS_PROXY or PIP_INDEX_URL; then run the same command again"
        )


def main() -> int:
    """Install, or say in one line why not."""
    parser = argparse.ArgumentParser(description="Install this checkout into .venv.")
    parser.add_argument("extra", choices=sorted(REQUIREMENTS))
    parser.add_argument("--python", default=sys.executable, help="the interpreter that .venv is made with")
    args = parser.parse_args()
    python = args.python
    if Path(sys.executable).parent.resolve() == INTERPRETER.parent.resolve():
        # .venv cannot be rebuilt by an interpreter that lies in it.
        python = os.path.realpath(getattr(sys, "_base_executable", sys.executable))
    try:
        with locked() as lock:
            install(args.extra, python, lock)
    except InstallError as error:
        say(str(error))
        return EXIT_UNAVAILABLE
    except OSError as error:
        say(f"bootstrap: cannot install into {VENV}: {error}")
        return EXIT_UNAVAILABLE
    except KeyboardInterrupt:
        say("bootstrap: interrupted; the next start builds .venv anew")
        return EXIT_INTERRUPTED
    return 0


if __name__ == "__main__":
    sys.exit(main())
