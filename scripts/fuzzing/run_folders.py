"""Damaged and forged run folders: every reader says one line, and the run's own command makes it whole again.

Nothing is silent: a list that is written is that of the undamaged run, and so are the tables once the run is whole.
"""

from __future__ import annotations

import importlib
import os
import random
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from scripts.fuzzing.cases import PLACE, Case, writer
from scripts.fuzzing.edits import Edit
from scripts.fuzzing.outcomes import Outcome
from scripts.fuzzing.verbs import call_verb

damage: Any = importlib.import_module("run_damage")

BASES: Final = ("damaged run", "forged run")
_NAMES: Final = ("a", "b", "c")
_RUN: Final = ("run", "data", "-o", "BAD", "--quiet", "--jobs", "1")
_READERS: Final = (
    ("check", "BAD", "--policy-file", "gate.toml", "--baseline", "REF"),
    ("filter", "BAD", "--list", "list.txt", "--force"),
    ("filter", "BAD", "--keep", "accepted", "--list", "list.csv", "--force"),
    ("filter", "BAD", "--model", "data/a/sparse/0", "--model-out", "pruned", "--force"),
    ("diff", "REF", "BAD"),
    ("diff", "BAD", "REF", "--exit-code"),
    ("learn-band", "REF", "BAD"),
    ("report", "BAD", "-o", "page.html", "--force", "--worst", "1", "--quiet"),
)
_LEARN_LINES: Final = 20  # learn-band has a line per scene that is not in all runs, and per band that says nothing


def run_folder_case(seed: int, number: int) -> Case:
    """Draw what is done to a run folder: one to three damages, or forgeries; then two readers and the run itself."""
    rng = np.random.default_rng([seed, number])
    base = str(rng.choice(BASES))
    kinds = [each.__name__ for each in _kinds(base)]
    edits = [
        Edit("damage", kinds[int(rng.integers(len(kinds)))], int(rng.integers(2**31)))
        for _ in range(int(rng.choice([1, 1, 1, 2, 3])))
    ]
    readers = rng.choice(len(_READERS), 2, replace=False)
    return Case(number, base, "", (*edits, Edit("readers", ",".join(map(str, readers)))))


def _kinds(base: str) -> tuple[Any, ...]:
    kinds: tuple[Any, ...] = damage.DAMAGES if base == BASES[0] else damage.FORGERIES
    return kinds


@cache
def _sound() -> Path:
    """A folder with three models, their run REF and its list; gone when this process is."""
    folder = Path(tempfile.mkdtemp(prefix="fuzz-sound-", dir=PLACE))
    for i, name in enumerate(_NAMES):
        writer.write_binary(folder / "data" / name / "sparse" / "0", writer.noisy_model(seed=i))
    (folder / "gate.toml").write_bytes(b"")
    with _inside(folder):
        for words in (["run", "data", "-o", "REF", "--quiet", "--jobs", "1"], ["filter", "REF", "--list", "all.txt"]):
            made = call_verb(words, {0})
            if not made.is_good:
                raise RuntimeError(f"no sound run: {made.where}")
    return folder


@contextmanager
def _inside(folder: Path) -> Iterator[None]:
    before = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)


def write_run_folder(case: Case, folder: Path) -> None:
    """Write the damaged run into ``folder``/BAD, beside its models and the undamaged one."""
    sound = _sound()
    for name in ("data", "REF"):
        (folder / name).symlink_to(sound / name)
    for name in ("gate.toml", "all.txt"):
        shutil.copyfile(sound / name, folder / name)
    shutil.copytree(sound / "REF", folder / "BAD", ignore=shutil.ignore_patterns(".lock*"))
    by_name = {each.__name__: each for each in _kinds(case.base)}
    for edit in case.edits:
        if edit.what == "damage":
            try:
                by_name[edit.file](folder / "BAD", random.Random(edit.at))  # noqa: S311
            except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError):
                continue  # an earlier damage left nothing to do it to


def read_run_folder(case: Case, folder: Path) -> Outcome:
    """Call the readers, then the run again; return the first outcome that is wrong."""
    is_damaged = case.base == BASES[0]
    kinds = set()
    with _inside(folder):
        chosen = next((edit.file for edit in case.edits if edit.what == "readers"), "1")
        for words in (_READERS[int(number)] for number in chosen.split(",")):
            lines = _LEARN_LINES if words[0] == "learn-band" else 1
            found = call_verb(list(words), {0, 1, 2, 3}, max_lines=lines)
            if not found.is_good:
                return found
            kinds.add(found.kind)
            if is_damaged and found.kind == "ok" and _differs(words):
                return Outcome("SILENT", f"{words}: another list than that of the undamaged run")
        codes = {0, 2, 3, 4} if is_damaged else {0, 1, 2, 3, 4}
        found = call_verb(list(_RUN), codes, max_lines=1)
        if not found.is_good:
            return found
        if is_damaged and found.kind == "ok":
            different = _different_tables()
            if different:
                return Outcome("SILENT", f"tables differ after run: {', '.join(different)}")
    return Outcome("refused" if "refused" in kinds or found.kind == "refused" else "ok")


def _differs(words: tuple[str, ...]) -> bool:
    is_list = words[0] == "filter" and "list.txt" in words
    return is_list and Path("list.txt").read_bytes() != Path("all.txt").read_bytes()


def _different_tables() -> list[str]:
    """Return the tables of BAD whose rows are not those of REF."""
    import pyarrow.parquet as pq  # noqa: PLC0415 - in the worker only

    different = []
    for name in ("images", "cameras", "models"):
        ours, wanted = (sorted(Path(run, name).glob("part-*.parquet")) for run in ("BAD", "REF"))
        same = [path.name for path in ours] == [path.name for path in wanted] and all(
            pq.ParquetFile(a).read().equals(pq.ParquetFile(b).read()) for a, b in zip(ours, wanted, strict=True)
        )
        if not same:
            different.append(name)
    return different
