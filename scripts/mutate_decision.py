"""Is there a line that decides and that no test looks at? Change each, run the tests that must notice.

One mutant changes one comparison, condition, constant, operator, branch, return value or member of a set in a function
that decides (scripts/mutation/targets.py). Mutants live in forked processes only: an import hook hands out the changed
source, no file of the working tree is touched. Survivors stand in docs/mutants.md with a reason each.

    --list      the mutants, without running them
    --file F    only those of one file
    --quick     the named mutants and a seeded sample of the others
    --check     fail on a survivor without a written reason, and on a written one that is gone or dies (not --quick)
    --write     add survivors without a reason to docs/mutants.md, to be filled in; drop those that are gone or die
"""

from __future__ import annotations

import argparse
import random
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from scripts.mutation import survivors  # noqa: E402 # a script finds its parts beside itself
from scripts.mutation.mutants import Mutant, mutants_of  # noqa: E402
from scripts.mutation.runner import Outcome, Runner  # noqa: E402
from scripts.mutation.targets import NAMED, TARGETS  # noqa: E402

SAMPLE: Final = 40
"""Mutants of the quick part beside the named ones: less than a minute on one core."""


def all_mutants(only: str | None) -> list[Mutant]:
    """Return the mutants of all targets, the named ones first."""
    named = [one.mutant(ROOT) for one in NAMED]
    generated = [mutant for target in TARGETS for mutant in mutants_of(target, ROOT)]
    found = [mutant for mutant in (*named, *generated) if only in (None, mutant.file)]
    if not found:
        raise SystemExit(f"no mutants in {only}; there are some in {', '.join(target.file for target in TARGETS)}")
    return found


def run(mutants: Sequence[Mutant], jobs: int) -> list[Mutant]:
    """Run all, print the survivors as they are found, and return them in order."""
    runner = Runner(ROOT, jobs)
    runner.check_unchanged({mutant.tests for mutant in mutants})
    started, survived = time.monotonic(), []
    for number, (mutant, outcome) in enumerate(runner.run(mutants), 1):
        if outcome is Outcome.SURVIVED:
            survived.append(mutant)
            print(f"survived: {mutant}", flush=True)
        if number % 100 == 0:
            print(f"{number} of {len(mutants)}, {time.monotonic() - started:.0f} s", flush=True)
    print(f"{len(mutants)} mutants, {len(survived)} survived, {time.monotonic() - started:.0f} s")
    return [mutant for mutant in mutants if mutant in survived]


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--list", action="store_true", help="print the mutants")
    parser.add_argument("--file", help="only those of one file, such as audit/decision/members.py")
    parser.add_argument("--quick", action="store_true", help=f"the named ones and {SAMPLE} of the others")
    parser.add_argument("--check", action="store_true", help="fail unless docs/mutants.md gives each survivor a reason")
    parser.add_argument("--write", action="store_true", help="bring docs/mutants.md up to date")
    parser.add_argument("--seed", type=int, default=0, help="of the sample")
    parser.add_argument("--jobs", type=int, default=0, help="processes at a time; all cores by default")
    options = parser.parse_args()
    if options.quick and options.write:
        parser.error("--write needs all mutants of a file, not a sample")
    mutants = all_mutants(options.file)
    if options.quick:
        generated = [mutant for mutant in mutants if not mutant.named]
        chosen = random.Random(options.seed).sample(generated, min(SAMPLE, len(generated)))  # noqa: S311 # a sample
        mutants = [mutant for mutant in mutants if mutant.named or mutant in chosen]
    if options.list:
        print(*mutants, f"{len(mutants)} mutants", sep="\n")
        return 0
    survived = run(mutants, options.jobs)
    if options.write:
        survivors.update(ROOT, mutants, survived)
    asked = options.check or options.quick
    faults = survivors.faults(ROOT, mutants, survived, complete=not options.quick) if asked else []
    print(*faults, sep="\n", end="\n" if faults else "")
    return 1 if faults else 0


if __name__ == "__main__":
    raise SystemExit(main())
