"""Walk through docs/tutorials as a reader does: write the files that the pages show, run the commands that they print.

    scripts/run_tutorials.py [--write] [PAGE...]

A block ``console`` holds commands after ``$`` and what they print, a block with ``title="NAME"`` is a file; all pages
of a walk share one folder. --write puts into the pages what the commands print. Without, the exit code is 1 where a
command fails or prints something else (numbers apart).
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).resolve().parent.parent
FOLDER: Final = ROOT / "docs" / "tutorials"
WALKS: Final = (("audit.md", "filter.md", "nightly.md"), ("calibrate.md",))
_BLOCK: Final = re.compile(r"^```(\w+)(?: title=\"([^\"]+)\")?\n(.*?)^```$", re.DOTALL | re.MULTILINE)
_NUMBER: Final = re.compile(r"[-+]?\d[\d.,]*(?:e[-+]?\d+)?")


@dataclass(frozen=True, slots=True)
class Step:
    """One command of a page: what the page says that it prints, what it prints, and its exit code."""

    page: str
    command: str
    shown: str
    printed: str
    exit_code: int

    @property
    def share_found(self) -> float:
        """Return the share of the lines on the page that were printed, numbers and blanks apart."""
        shown, printed = (
            [masked(line) for line in text.splitlines() if line.strip()] for text in (self.shown, self.printed)
        )
        return sum(line in printed for line in shown) / len(shown) if shown else float(not printed)

    @property
    def is_as_shown(self) -> bool:
        """Whether it printed what the page says, numbers and blanks apart."""
        return [masked(x) for x in self.shown.splitlines()] == [masked(x) for x in self.printed.splitlines()]


def masked(line: str) -> str:
    """Return a line without what differs between machines: numbers, and blanks and rules that are as wide as them."""
    return " ".join(_NUMBER.sub("#", re.sub("[─-]{2,}", "-", line)).split())


def commands_of(block: str) -> list[tuple[str, str]]:
    """Return commands and what the page says that they print."""
    found: list[tuple[str, str]] = []
    for line in block.splitlines(keepends=True):
        if line.startswith("$ "):
            found.append((line[2:].rstrip("\n"), ""))
        elif found:
            found[-1] = (found[-1][0], found[-1][1] + line)
    return found


def walk(page: str, text: str, folder: Path) -> tuple[str, list[Step]]:
    """Do what a page says in a folder; return the page with what was printed, and the steps."""
    steps: list[Step] = []

    def done(match: re.Match[str]) -> str:
        language, name, content = match.groups()
        if name is not None:
            (folder / name).write_text(content, encoding="utf-8")
        if language != "console":
            return match[0]
        lines = []
        for command, shown in commands_of(content):
            steps.append(run(page, command, shown, folder))
            lines.append(f"$ {command}\n{steps[-1].printed}")
        return f"```console\n{''.join(lines)}```"

    return _BLOCK.sub(done, text), steps


def run(page: str, command: str, shown: str, folder: Path) -> Step:
    """Run a command as a reader's shell does; what it says on stderr is printed too, paths as seen from the folder."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    env = {**os.environ, "PATH": path, "COLUMNS": "80", "PYTHONWARNINGS": ""}
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "stdin": subprocess.DEVNULL}
    done = subprocess.run(["bash", "-c", command], cwd=folder, env=env, text=True, check=False, **streams)  # type: ignore[call-overload]
    lines = [line.rstrip() for line in done.stdout.replace(f"{folder}/", "").splitlines()]
    while lines and not lines[-1]:
        lines.pop()
    return Step(page, command, shown, "".join(f"{line}\n" for line in lines), done.returncode)


def walk_together(pages: Sequence[str], folder: Path, *, write: bool = False) -> list[Step]:
    """Walk through pages one after the other in one folder."""
    steps = []
    for page in pages:
        path = FOLDER / page
        text, done = walk(page, path.read_text(encoding="utf-8"), folder)
        steps += done
        if write:
            path.write_text(text, encoding="utf-8")
    return steps


def main() -> int:
    """Walk, and say what is not as the pages say."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", action="store_true", help="write what was printed into the pages")
    parser.add_argument("pages", nargs="*", help="pages of a walk  [default: all]")
    args = parser.parse_args()
    code = 0
    for pages in WALKS:
        if args.pages and not set(args.pages) & set(pages):
            continue
        with tempfile.TemporaryDirectory() as folder:
            for step in walk_together(pages, Path(folder), write=args.write):
                if step.exit_code != 0 or not (args.write or step.is_as_shown):
                    code = 1
                    print(f"{step.page}: $ {step.command}: exit code {step.exit_code}, printed\n{step.printed}")
    return code


if __name__ == "__main__":
    sys.exit(main())
