"""What can come of an input, and how anything else than a result is caught."""

from __future__ import annotations

import re
import traceback
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Final

GOOD: Final = frozenset({"ok", "finding", "refused"})


@dataclass(frozen=True, slots=True)
class Outcome:
    """What came of an input.

    kind: of `GOOD`, or TRACEBACK, WARNING, NONFINITE, EXITCODE, NOISE, SILENT.    where: one line.
    """

    kind: str
    where: str = ""

    @property
    def is_good(self) -> bool:
        """Whether that is right."""
        return self.kind in GOOD


def place_of(error: BaseException) -> str:
    """Return type, message and the last places of this project in a traceback, innermost first."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = [frame for frame in frames if "sfm_audit" in frame.filename or "/audit/" in frame.filename]
    places = [f"{short_name(frame.filename)}:{frame.lineno}" for frame in reversed(ours[-4:] or frames[-2:])]
    return f"{type(error).__name__}: {' '.join(str(error).split())[:100]} @ {' < '.join(places)}"


def short_name(filename: str) -> str:
    """Return a path from the room on."""
    return re.sub(r".*/(?=(?:loaders|audit|reports)/)", "", filename)


@contextmanager
def caught(outcomes: list[Outcome]) -> Iterator[list[warnings.WarningMessage]]:
    """Turn any exception and warning into an outcome: that none escapes is what is tested."""
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        try:
            yield seen
        except Exception as error:  # noqa: BLE001 - see above
            outcomes.append(Outcome("TRACEBACK", place_of(error)))
    if seen and not outcomes:
        first = seen[0]
        outcomes.append(
            Outcome(
                "WARNING", f"{first.category.__name__}: {first.message} @ {short_name(first.filename)}:{first.lineno}"
            )
        )
