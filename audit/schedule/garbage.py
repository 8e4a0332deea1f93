"""How do processes start and end without a look for garbage? None is there.

Importing what audits makes 400,000 objects that stay until the end. Python's collector walks them again and again while
they are made, with every large collection afterwards, and once more when the process ends.
"""

from __future__ import annotations

import gc
import sys
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def importing() -> Iterator[None]:
    """Import inside without collecting; where something was imported, what is there at the end is not walked again."""
    was_on, num_before = gc.isenabled(), len(sys.modules)
    gc.disable()
    try:
        yield
    finally:
        if len(sys.modules) > num_before:  # else nothing came that stays, and garbage that waits would stay with it
            gc.freeze()
        if was_on:
            gc.enable()


def leaving() -> None:
    """Say that the process is about to end: what it holds goes with it, and need not be walked for cycles."""
    gc.freeze()
