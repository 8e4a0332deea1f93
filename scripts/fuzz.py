#!/usr/bin/env python3
"""Damage inputs for a while: no traceback, hang, crash, warning or number that is not finite may come of them.

    scripts/fuzz.py --minutes 3 --seed 0                 all targets in turn
    scripts/fuzz.py --minutes 3 --target models          readers of models, beside pycolmap
    scripts/fuzz.py --target run --only 4711 --seed 0    one input again

Input number i of a seed is always the same. What fails is made as small as possible and written below --failures, with
a line of what came of it; the whole campaign is one JSON record. Exit code 1 where something failed.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from itertools import count
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from scripts.fuzzing.cases import Case
from scripts.fuzzing.outcomes import Outcome
from scripts.fuzzing.targets import TARGETS, write_input
from scripts.fuzzing.workers import Worker

_PYCOLMAP_MEMORY_BYTES = 64 << 20  # it takes what a file claims
_PYCOLMAP_SECONDS = 5.0
_MAX_SAME = 3  # failures at one place that are made small and written


@dataclass(slots=True)
class Failure:
    """An input that came to no good end, as small as it was made."""

    target: str
    case: Case
    outcome: Outcome


@dataclass(slots=True)
class Campaign:
    """What happened so far. kinds: target and kind of input -> outcomes; beside: outcome here and of pycolmap."""

    outcomes: dict[str, Counter[str]] = field(default_factory=lambda: {name: Counter() for name in TARGETS})
    kinds: dict[str, Counter[str]] = field(default_factory=dict)
    places: Counter[str] = field(default_factory=Counter)
    beside: Counter[str] = field(default_factory=Counter)
    silent: list[dict[str, Any]] = field(default_factory=list)
    failures: list[Failure] = field(default_factory=list)
    lock: threading.Lock = field(default_factory=threading.Lock)


def main(args: Sequence[str] | None = None) -> int:
    """Run a campaign and write its record; return 1 where something failed."""
    options = _options(args)
    targets = options.target or list(TARGETS)
    numbers = iter([options.only]) if options.only is not None else _numbers(options.first, options.inputs)
    campaign, start = Campaign(), time.monotonic()
    end = start + 60 * options.minutes
    threads = [
        threading.Thread(target=_work, args=(options, targets, numbers, campaign, end)) for _ in range(options.jobs)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    record = _record(options, campaign, time.monotonic() - start)
    if options.record:
        options.record.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    _print(record)
    return int(bool(campaign.failures) or bool(campaign.silent))


def _numbers(first: int, num: int | None) -> Iterator[int]:
    return iter(range(first, first + num)) if num is not None else count(first)


def _options(args: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=3.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, help="number of the first input")
    parser.add_argument("--inputs", type=int, help="end after so many, if --minutes are not over before")
    parser.add_argument("--only", type=int, help="try this input alone")
    parser.add_argument("--target", action="append", choices=list(TARGETS), help="repeatable; default: all in turn")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=30.0, help="for one input")
    parser.add_argument("--memory-mb", type=int, default=2048, help="address space beside what the imports take")
    parser.add_argument("--record", type=Path, help="JSON file of the campaign")
    parser.add_argument("--failures", type=Path, help="folder for inputs that failed")
    return parser.parse_args(args)


def _work(
    options: argparse.Namespace, targets: Sequence[str], numbers: Iterator[int], campaign: Campaign, end: float
) -> None:
    limits = {"memory_bytes": options.memory_mb << 20, "seconds": options.seconds}
    worker = Worker(**limits)
    theirs = Worker(memory_bytes=_PYCOLMAP_MEMORY_BYTES, seconds=_PYCOLMAP_SECONDS, with_pycolmap=True)
    try:
        while time.monotonic() < end or options.only is not None:
            with campaign.lock:
                number = next(numbers, None)
            if number is None:
                return
            name = targets[number % len(targets)]
            _try(options, campaign, (worker, theirs), name, number)
    finally:
        worker.stop()
        theirs.stop()


def _try(
    options: argparse.Namespace, campaign: Campaign, workers: tuple[Worker, Worker], name: str, number: int
) -> None:
    target = TARGETS[name]
    case = target.draw(options.seed, number)
    outcome = workers[0].attempt(name, case)
    with campaign.lock:
        campaign.outcomes[name][outcome.kind] += 1
        campaign.kinds.setdefault(f"{name}: {case.kind}", Counter())[outcome.kind] += 1
    if target.with_pycolmap:
        _compare(campaign, case, outcome, workers[1].attempt(name, case))
    if outcome.is_good:
        return
    with campaign.lock:
        campaign.places[_place(outcome)] += 1
        is_known = campaign.places[_place(outcome)] > _MAX_SAME
    if not is_known:
        small = _smallest(workers[0], name, case, outcome)
        with campaign.lock:
            campaign.failures.append(Failure(name, small, outcome))
            if options.failures:
                _write(options.failures, name, small, outcome)


def _compare(campaign: Campaign, case: Case, ours: Outcome, theirs: Outcome) -> None:
    with campaign.lock:
        campaign.beside[f"{ours.kind} here, {theirs.kind} in pycolmap"] += 1
        if ours.kind == "ok" and theirs.kind in {"refused", "CRASH"} and len(campaign.silent) < 200:
            campaign.silent.append({**_as_json(case), "pycolmap": f"{theirs.kind} {theirs.where}"})


def _place(outcome: Outcome) -> str:
    """What failures have in common: their kind and the innermost place."""
    return f"{outcome.kind} {outcome.where.split(' @ ')[-1].split(' < ')[0]}"


def _smallest(worker: Worker, name: str, case: Case, outcome: Outcome) -> Case:
    """Leave out edits, one at a time, as long as the input fails at the same place."""
    edits = case.edits
    for edit in case.edits:
        fewer = tuple(each for each in edits if each is not edit)
        if fewer and _place(worker.attempt(name, case.but(fewer))) == _place(outcome):
            edits = fewer
    return case.but(edits)


def _write(failures: Path, name: str, case: Case, outcome: Outcome) -> None:
    folder = failures / f"{name}-{case.base}-{case.number}-{outcome.kind}"
    folder.mkdir(parents=True, exist_ok=True)
    write_input(case, folder)
    text = json.dumps({**_as_json(case), **asdict(outcome)}, indent=1)
    (folder / "what.json").write_text(text + "\n", encoding="utf-8")


def _as_json(case: Case) -> dict[str, Any]:
    return {
        "number": case.number,
        "base": case.base,
        "layout": case.layout,
        "edits": [" ".join(map(str, (each.what, each.file, each.at, each.value))) for each in case.edits],
    }


def _record(options: argparse.Namespace, campaign: Campaign, seconds: float) -> dict[str, Any]:
    import numpy as np  # noqa: PLC0415 - for its version
    import pycolmap  # noqa: PLC0415 - for its version

    return {
        "seed": options.seed,
        "first": options.first,
        "seconds": round(seconds, 1),
        "inputs": sum(sum(counts.values()) for counts in campaign.outcomes.values()),
        "versions": {"python": platform.python_version(), "numpy": np.__version__, "pycolmap": pycolmap.__version__},
        "limits": {"seconds": options.seconds, "memory_mb": options.memory_mb, "cores": os.cpu_count()},
        "outcomes": {name: dict(counts.most_common()) for name, counts in campaign.outcomes.items() if counts},
        "kinds": {kind: dict(counts.most_common()) for kind, counts in sorted(campaign.kinds.items())},
        "beside_pycolmap": dict(campaign.beside.most_common()),
        "silent": campaign.silent,
        "places": dict(campaign.places.most_common()),
        "failures": [
            {"target": each.target, **_as_json(each.case), **asdict(each.outcome)} for each in campaign.failures
        ],
    }


def _print(record: dict[str, Any]) -> None:
    print(f"{record['inputs']} inputs in {record['seconds']} s, seed {record['seed']}")
    for name, counts in record["outcomes"].items():
        print(f"  {name}: {', '.join(f'{kind} {number}' for kind, number in counts.items())}")
    for pair, number in record["beside_pycolmap"].items():
        print(f"  {number:7d} {pair}")
    for place, number in record["places"].items():
        print(f"  {number:7d} {place}")
    for failure in record["failures"]:
        print(f"  {failure['target']} {failure['number']} {failure['kind']} {failure['where']}: {failure['edits']}")
    for each in record["silent"]:
        print(f"  passes here in silence: {each['number']} {each['base']} {each['edits']}: {each['pycolmap']}")


if __name__ == "__main__":
    sys.exit(main())
