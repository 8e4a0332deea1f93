#!/usr/bin/env python3
"""Are the tables of two run folders the same to the last bit? For changes that must not change a number.

    scripts/compare_runs.py RUN0 RUN1 [--ignore COLUMN,...] [--only COLUMN,...] [--rtol R [--atol A]]

With --rtol numbers may differ by R times the larger of both, or by A (1e-12 if not given), for changes of the order of
arithmetic; texts, counts and verdicts may not, and in what people read (reasons, findings) numbers are not compared.
Columns that only RUN1 has are listed and do not count; a column that RUN1 lacks, another type, another row or another
bit does (NaN equals NaN, null equals null). Exit code 0: the same; 1: not.
"""

from __future__ import annotations

import argparse
import math
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import pyarrow as pa
import pyarrow.parquet as pq

NUMBER: Final = re.compile(r"[-+]?\d+(\.\d+)?(e[-+]?\d+)?")
TABLES = ("images", "cameras", "models", "observations")


def bits(column: pa.ChunkedArray[Any]) -> Sequence[object]:
    """Values of a column that compare as their bits do."""
    kind = column.type
    if pa.types.is_float64(kind):
        return column.combine_chunks().view(pa.int64()).to_pylist()
    if pa.types.is_list(kind) and pa.types.is_float64(kind.value_type):
        return [
            None if row is None else [value if value is None else float.hex(value) for value in row]
            for row in column.to_pylist()
        ]
    return column.to_pylist()


def is_close(old: object, new: object, rtol: float, atol: float) -> bool:
    """Whether two values, lists or records agree but for rounding; of prose all but its numbers."""
    if isinstance(old, float) and isinstance(new, float):
        if math.isnan(old) or math.isnan(new):
            return math.isnan(old) and math.isnan(new)
        return math.isclose(old, new, rel_tol=rtol, abs_tol=atol)
    if isinstance(old, list) and isinstance(new, list):
        return len(old) == len(new) and all(is_close(a, b, rtol, atol) for a, b in zip(old, new, strict=True))
    if isinstance(old, dict) and isinstance(new, dict):
        return old.keys() == new.keys() and all(is_close(old[key], new[key], rtol, atol) for key in old)
    if isinstance(old, str) and isinstance(new, str):
        return NUMBER.sub("#", old) == NUMBER.sub("#", new)
    return old == new


def differences(old: pa.Table, new: pa.Table, args: argparse.Namespace) -> list[str]:
    """Return one line per column that is not the same."""
    ignored, only = ({name for name in text.split(",") if name} for text in (args.ignore, args.only))
    if old.num_rows != new.num_rows:
        return [f"{old.num_rows} rows before, {new.num_rows} after"]
    out = []
    for name in old.column_names:
        if name in ignored or (only and name not in only):
            continue
        if name not in new.column_names:
            out.append(f"{name}: no such column any more")
        elif old.schema.field(name).type != new.schema.field(name).type:
            out.append(f"{name}: {old.schema.field(name).type} before, {new.schema.field(name).type} after")
        else:
            if args.rtol is None:
                before, after = bits(old[name]), bits(new[name])
                changed = [k for k, (a, b) in enumerate(zip(before, after, strict=True)) if a != b]
            else:
                before, after = old[name].to_pylist(), new[name].to_pylist()
                pairs = enumerate(zip(before, after, strict=True))
                changed = [k for k, (a, b) in pairs if not is_close(a, b, args.rtol, args.atol)]
            if changed:
                k = changed[0]
                example = f"{old[name][k].as_py()!r} -> {new[name][k].as_py()!r}"
                out.append(f"{name}: {len(changed)} of {len(before)} differ, such as row {k}: {example}")
    return out


def main() -> int:
    """Compare and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("old", type=Path)
    parser.add_argument("new", type=Path)
    parser.add_argument("--ignore", default="", help="columns that may differ, separated by commas")
    parser.add_argument("--only", default="", help="the only columns to compare")
    parser.add_argument("--rtol", type=float, help="relative difference that numbers may have")
    parser.add_argument("--atol", type=float, default=1e-12, help="with --rtol: difference that numbers may have")
    args = parser.parse_args()
    failed, added = 0, set()
    for table in TABLES:
        parts = [{path.name for path in (run / table).glob("part-*.parquet")} for run in (args.old, args.new)]
        for name in sorted(parts[0] ^ parts[1]):
            failed += 1
            print(f"{table}/{name}: only in {args.old if name in parts[0] else args.new}")
        for name in sorted(parts[0] & parts[1]):
            old, new = (pq.read_table(run / table / name) for run in (args.old, args.new))
            added |= {f"{table}.{column}" for column in set(new.column_names) - set(old.column_names)}
            for line in differences(old, new, args):
                failed += 1
                print(f"{table}/{name}: {line}")
        print(f"{table}: {len(parts[0] & parts[1])} parts compared")
    if added:
        print(f"new columns: {', '.join(sorted(added))}")
    same = "the same to the last bit" if args.rtol is None else f"the same to a relative {args.rtol:g}"
    print(f"{failed} differences" if failed else same)
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
