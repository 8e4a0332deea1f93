"""Printing: as wide as the terminal, in its own encoding, and no error where nobody reads on (``| head``)."""

from __future__ import annotations

import os
import shutil
import sys

from sfm_audit.reports.text.drawing import Page


def print_page(text: str) -> None:
    """Print to stdout in its own encoding; a reader that left, as ``head`` does, is no error."""
    encoding = sys.stdout.encoding or "utf-8"
    try:
        print(text.encode(encoding, "backslashreplace").decode(encoding), flush=True)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # or the interpreter complains when it ends


def terminal_page() -> Page:
    """Return how to draw on stdout: as wide as the terminal, 80 columns elsewhere."""
    is_terminal = sys.stdout.isatty()
    width = shutil.get_terminal_size((80, 24)).columns if is_terminal else 80
    return Page(
        width, (sys.stdout.encoding or "").lower().startswith("utf"), is_terminal and "NO_COLOR" not in os.environ
    )
