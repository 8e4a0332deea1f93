"""Measure size and power of every test and verdict on simulated images and reconstructions with known truth.

    python scripts/validate_statistics.py              writes docs/validation.md and docs/figures/validation_*.svg
    python scripts/validate_statistics.py --quick      a minute of it, writes nothing: CI runs that

Exit code 1 where a rate is further from its bounds than chance explains. The full study takes about half an hour of one
core; figures need matplotlib (``pip install -e .[study]``). The same seed gives the same page on any number of jobs.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

from scripts.validation.bounds import all_checks
from scripts.validation.figures import draw_figures
from scripts.validation.page import document
from scripts.validation.plan import full_plan, quick_plan
from scripts.validation.study import HOLDS, VIOLATED, run_tasks

DOCS = Path(__file__).resolve().parent.parent / "docs"


def _said(page: str, share: float) -> str:
    """Say on the page that it is not the full study."""
    if share == 1.0:
        return page
    said = (
        f"Made with `--share {share:g}`: that part of the full study's images where sizes and powers are measured,\n"
        "all of its scenes with a quarter of the images wrong, with moved poses and with frozen parameters."
    )
    title, _, rest = page.partition("\n")
    return f"{title}\n\n{said}\n{rest}"


def main() -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="fewer images, check only")
    parser.add_argument("--share", type=float, default=1.0, help="of the images behind sizes and powers")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=0, help="processes; --quick: 1, else all cores")
    parser.add_argument("--docs", type=Path, default=DOCS, help="folder of validation.md and figures/")
    parser.add_argument(
        "--keep", type=Path, help="folder of finished pieces, Parquet files, from which a later run goes on"
    )
    args = parser.parse_args()
    jobs = args.jobs or (1 if args.quick else os.cpu_count() or 1)
    tables = run_tasks(quick_plan(args.seed) if args.quick else full_plan(args.seed, args.share), jobs, args.keep)
    checks = all_checks(tables)
    for check in checks:
        if check.outcome != HOLDS:
            line = (
                f"{check.outcome}: {check.claim}; {check.cell}: {check.rate:.4f}, {check.low:g}..{check.high:g} wanted"
            )
            print(line, file=sys.stderr)
    violated = sum(check.outcome == VIOLATED for check in checks)
    print(f"{len(checks)} bounds, {violated} violated")
    if not args.quick:
        args.docs.mkdir(parents=True, exist_ok=True)
        for name, page in document(tables, checks, args.seed).items():
            (args.docs / name).write_text(_said(page, args.share), encoding="utf-8")
        draw_figures(tables, args.docs / "figures")
    return 1 if violated else 0


if __name__ == "__main__":
    sys.exit(main())
