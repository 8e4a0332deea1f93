"""The list of survivors in docs/mutants.md: a table with a reason each, kept by scripts/mutate_decision.py."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

from scripts.mutation.mutants import Mutant

LIST: Final = "docs/mutants.md"
_BEGIN: Final = "<!-- survivors, kept by scripts/mutate_decision.py --write; reasons are written by hand -->\n"
_OPEN: Final = "?"


def read(root: Path) -> dict[str, str]:
    """Return the written survivors and their reasons."""
    _, _, table = (root / LIST).read_text().partition(_BEGIN)
    out = {}
    for line in table.splitlines():
        if line.startswith("- "):
            key, _, reason = line.removeprefix("- ").rpartition(" — ")
            out[key] = reason.strip()
    return out


def faults(root: Path, mutants: Sequence[Mutant], survived: Sequence[Mutant], *, complete: bool) -> list[str]:
    """Say which survivors have no reason, and which written ones die or, if all mutants were run, are gone."""
    reasons = read(root)
    keys = {mutant.key for mutant in mutants}
    alive = {mutant.key for mutant in survived}
    out = [f"a named mutant survived: {mutant}" for mutant in survived if mutant.named]
    out += [
        f"survived without a reason in {LIST}: {mutant}"
        for mutant in survived
        if not mutant.named and reasons.get(mutant.key, _OPEN) == _OPEN
    ]
    out += [f"dies, and stands in {LIST}: {key}" for key in reasons if key in keys and key not in alive]
    files = {mutant.file for mutant in mutants}
    if complete:
        out += [
            f"is gone, and stands in {LIST}: {key}" for key in reasons if key.split(" ")[0] in files and key not in keys
        ]
    return out


def update(root: Path, mutants: Sequence[Mutant], survived: Sequence[Mutant]) -> None:
    """Write the survivors of the files that were run, old reasons kept, those of other files left alone."""
    path = root / LIST
    head, _, _ = path.read_text().partition(_BEGIN)
    files = {mutant.file for mutant in mutants}
    reasons = read(root)
    kept = {key: reason for key, reason in reasons.items() if key.split(" ")[0] not in files}
    alive = {mutant.key: reasons.get(mutant.key, _OPEN) for mutant in survived if not mutant.named}
    lines = [f"- {key} — {reason}\n" for key, reason in sorted({**kept, **alive}.items())]
    path.write_text(head + _BEGIN + "\n" + "".join(lines))
