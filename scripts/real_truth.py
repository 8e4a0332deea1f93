"""Audit reconstructions of real photos whose cameras are known, and say how often the audit is right.

    python scripts/real_truth.py [FOLDER]                the rates
    python scripts/real_truth.py --check [FOLDER]        exit code 1 where a rate leaves its bound
    python scripts/real_truth.py --write [FOLDER]        writes docs/realtruth.md (the public corpus too, where it is)
    python scripts/real_truth.py --quick [FOLDER]        four of the models

Without a folder the models are looked for beside the corpus of the tests (SFM_AUDIT_CORPUS, else ../shared/corpus), as
`realtruth`; where they are not, the script says so and exits with 0. They are no part of the project, and nothing of a
single photo is written: rates per scene and kind alone.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import pandas as pd
from tqdm import tqdm

from scripts.corpus_report import corpus_folders
from scripts.realtruth.bench import QUICK_MODELS, ROOT, audit_bench, bench_folder
from scripts.realtruth.bounds import bounds
from scripts.realtruth.page import document
from sfm_audit.audit import audit_model
from sfm_audit.loaders import LoadError, discover, open_model

PAGE: Final = ROOT / "docs" / "realtruth.md"


def public_images() -> pd.DataFrame | None:
    """The images table of the public corpus; None where there is no corpus."""
    parts = []
    for ref in tqdm(discover([str(folder) for folder in corpus_folders([])]).refs, disable=None):
        try:
            parts.append(audit_model(open_model(ref.location)).images.to_pandas())
        except LoadError:
            continue
    return pd.concat(parts, ignore_index=True) if parts else None


def main(argv: Sequence[str] | None = None) -> int:
    """Audit, print, check, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?", help="folder of the models; default: beside the corpus")
    parser.add_argument("--quick", action="store_true", help=f"{', '.join(QUICK_MODELS)} alone")
    parser.add_argument("--exclude", metavar="SCENE", action="append", default=[], help="leave a scene out")
    parser.add_argument("--check", action="store_true", help="exit code 1 where a rate leaves its bound")
    parser.add_argument("--write", action="store_true", help=f"write {PAGE.relative_to(ROOT)}")
    args = parser.parse_args(argv)
    if args.write and (args.quick or args.exclude):
        parser.error("--write takes all models: leave --quick and --exclude out")
    folder = bench_folder(args.folder)
    if folder is None:
        print("skipped: no models with ground truth here (FOLDER, or `realtruth` beside SFM_AUDIT_CORPUS)")
        return 0
    images = audit_bench(folder, only=QUICK_MODELS if args.quick else (), excluded=args.exclude)
    if not len(images):
        print("skipped: no model is left")
        return 0
    if args.write:
        PAGE.write_text(document(images, public_images()), encoding="utf-8")
    elif not args.check:
        print(document(images, None))
    found = bounds(images)
    for bound in found if args.check else [bound for bound in found if not bound.holds]:
        print("ok  " if bound.holds else "NOT HELD:", bound, file=sys.stdout if bound.holds else sys.stderr)
    return int(args.check and not all(bound.holds for bound in found))


if __name__ == "__main__":
    sys.exit(main())
