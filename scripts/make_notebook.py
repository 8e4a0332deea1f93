"""Run docs/notebook.ipynb and write it with what its cells say; with --check, fail where they say something else.

Needs nbclient and ipykernel (extra dev). Pictures are drawn anew and not compared: their bytes depend on the fonts.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path
from typing import Any, Final

import nbformat
from nbclient import NotebookClient

NOTEBOOK: Final = Path(__file__).resolve().parents[1] / "docs" / "notebook.ipynb"
_TEXTS: Final = ("text/plain", "text/html")
_SECONDS: Final = 300


def run(notebook: Any) -> Any:
    """Return a copy with its cells executed in order, by a new kernel; an exception in a cell ends it."""
    executed = nbformat.from_dict(notebook)
    for cell in executed.cells:
        if cell.cell_type == "code":
            cell.outputs, cell.execution_count = [], None
    NotebookClient(executed, timeout=_SECONDS, kernel_name="python3").execute()
    for cell in executed.cells:
        cell.metadata = nbformat.from_dict({})  # when it ran is nothing to keep
    executed.metadata = nbformat.from_dict(
        {"kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"}}
    )
    return executed


def said(notebook: Any) -> list[tuple[int, str]]:
    """Return every text that a cell says, with the number of its cell."""
    texts = []
    for number, cell in enumerate(notebook.cells):
        for output in cell.get("outputs", ()):
            has_picture = "image/png" in output.get("data", {})
            content = [output["text"]] if "text" in output else [output["data"].get(kind) for kind in _TEXTS]
            texts += [(number, str(text)) for text in content if text is not None and not has_picture]
    return texts


def main() -> int:
    """Run, then write or compare; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing, fail where the cells say something else")
    parser.add_argument("--quick", action="store_true", help="the same as --check, as studies have it")
    arguments = parser.parse_args()
    os.environ.setdefault("PYDEVD_DISABLE_FILE_VALIDATION", "1")
    known = nbformat.read(NOTEBOOK, as_version=4)
    executed = run(known)
    if not (arguments.check or arguments.quick):
        nbformat.write(executed, NOTEBOOK)
        return 0
    different = [
        (cell, one, two) for (cell, one), (_, two) in zip(said(known), said(executed), strict=False) if one != two
    ]
    for cell, one, two in different:
        print(f"docs/notebook.ipynb: cell {cell} says another thing now:\n{one}\n--- now ---\n{two}")
    if len(said(known)) != len(said(executed)):
        print(f"docs/notebook.ipynb: {len(said(known))} outputs, {len(said(executed))} now")
    is_same = not different and len(said(known)) == len(said(executed))
    print(
        "docs/notebook.ipynb: run, and as it was" if is_same else "run scripts/make_notebook.py and look at the change"
    )
    return 0 if is_same else 1


if __name__ == "__main__":
    sys.exit(main())
