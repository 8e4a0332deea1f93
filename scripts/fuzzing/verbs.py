"""Calls the command line on an input, and looks at all that it leaves behind."""

from __future__ import annotations

import io
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any, Final

import numpy as np

from scripts.fuzzing.outcomes import Outcome, caught

_AS_STORED: Final = frozenset({"params"})  # the claims of a file, whatever they are


def call_verb(words: list[str], codes: set[int], run: Path | None = None, *, max_lines: int = 2) -> Outcome:
    """Call the command line in this process."""
    from sfm_audit.audit.cli.main import main  # noqa: PLC0415 - in the worker only

    stderr, stdout, outcomes, code = io.StringIO(), io.StringIO(), list[Outcome](), 0
    with caught(outcomes), redirect_stderr(stderr), redirect_stdout(stdout):
        code = main(words)
    lines = stderr.getvalue().splitlines()
    if outcomes:
        return outcomes[0]
    if code not in codes:
        return Outcome("EXITCODE", f"{words[0]}: {code}: {lines[-1:]}")
    if len(lines) > max_lines or any("Traceback" in line or "Warning" in line for line in lines):
        return Outcome("NOISE", f"{words[0]}: {len(lines)} lines: {lines[-1][:150] if lines else ''}")
    infinite = infinite_columns(run) if run is not None and code in {0, 3} else []
    if infinite:
        return Outcome("NONFINITE", ", ".join(infinite))
    return Outcome("ok" if code in {0, 1} else "refused")


def infinite_columns(run: Path) -> list[str]:
    """Return the columns of a run folder's tables that hold infinities or NaN."""
    import pyarrow as pa  # noqa: PLC0415 - in the worker only
    import pyarrow.compute as pc  # noqa: PLC0415 - as above
    import pyarrow.parquet as pq  # noqa: PLC0415 - as above

    found = []
    for path in sorted(run.glob("*/part-*.parquet")):
        table = pq.read_table(path)
        for name in set(table.column_names) - _AS_STORED:
            column: Any = table.column(name)
            if pa.types.is_list(column.type):
                column = pc.list_flatten(column)
            if pa.types.is_floating(column.type):
                values = column.drop_null().to_numpy(zero_copy_only=False)
                if not np.isfinite(values).all():
                    found.append(f"{path.parent.name}.{name}")
    return sorted(set(found))
