"""Run the audit on a corpus of public models, diagnose them, and write docs/corpus.md from what came out.

    python scripts/corpus_report.py FOLDER... [-o docs/corpus.md] [--work DIR]     every model below the folders
    python scripts/corpus_report.py --quick [FOLDER...]     a few models against their bands; refits and writes nothing

Everything on the page is from `sfm-audit run` (its tables) and `sfm-audit diagnose --json`, as anybody can call them.
Without folders the corpus is looked for as the tests do: SFM_AUDIT_CORPUS, else ../shared/corpus; without a corpus
the script says so and exits with 0. --work keeps the run folder and a JSON file per model, and goes on from them.
Models of more than 150 images are not refitted: adjusting one with four camera models can take half an hour. Exit
code 1: --quick found a median outside its band; without it, an image that is not accepted belongs to no diagnosis with
an action.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import pandas as pd
from tqdm import tqdm

from scripts.corpus.models import CorpusModel, models_of
from scripts.corpus.noise import check_bands
from scripts.corpus.page import document, without_action
from sfm_audit.audit.cli.errors import ExitCode
from sfm_audit.audit.table.diagnoses import DiagnosisCode

ROOT: Final = Path(__file__).resolve().parent.parent
MAX_REFITTED: Final = 150  # images
QUICK_MODELS: Final = (
    *("hsu_fox_bin", "halogen_sparse", "marychrisgo_dense", "softmurata"),
    *("yinsy_A", "own_south_building_sub_radial"),
)


def corpus_folders(given: Sequence[Path]) -> list[Path]:
    """The folders given, or the corpus of the tests; none where there is no corpus."""
    if given:
        return list(given)
    root = Path(os.environ.get("SFM_AUDIT_CORPUS", str(ROOT.parent / "shared" / "corpus")))
    return [path for path in (root / "models", root / "megadepth_like" / "MegaDepth_v1_SfM") if path.is_dir()]


def audited(folders: Sequence[Path], work: Path, *, quick: bool) -> tuple[list[CorpusModel], list[str]]:
    """Run and diagnose the models below the folders; the second list says in one line each what cannot be read."""
    run = work / "run"
    scenes = [argument for scene in QUICK_MODELS for argument in ("--scene", scene)] if quick else []
    sfm_audit("run", *map(str, folders), *scenes, "-o", str(run), "--quiet")
    return models_of(run, [] if quick else diagnosed(run, work / "diagnoses"))


def diagnosed(run: Path, folder: Path) -> list[dict[str, Any]]:
    """Diagnose every model that something speaks against, one file each; what is there already is not done again."""
    folder.mkdir(exist_ok=True)
    out: list[dict[str, Any]] = []
    rows = pd.read_parquet(run / "models", columns=["model_path", "num_images", "diagnoses"]).to_dict("records")
    for row in tqdm([row for row in rows if {each["code"] for each in row["diagnoses"]} - {DiagnosisCode.SOUND}]):
        location = str(row["model_path"])
        file = folder / f"{hashlib.sha256(location.encode()).hexdigest()[:16]}.json"
        if not file.exists():
            refit = "--refit" if row["num_images"] <= MAX_REFITTED else "--no-refit"
            sfm_audit("diagnose", str(run), location, refit, "--json", str(file), "--quiet")
        out += json.loads(file.read_bytes())["models"]
    return out


def sfm_audit(*arguments: str) -> None:
    """Call the command line; models that cannot be read are no failure here."""
    command = [sys.executable, "-m", "sfm_audit", *arguments]
    done = subprocess.run(command, check=False, stdout=subprocess.DEVNULL)
    if done.returncode not in {ExitCode.OK, ExitCode.UNREADABLE_INPUT}:
        raise SystemExit(f"{' '.join(command)}: exit code {done.returncode}")


def main() -> int:
    """Write the page, or check."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="*", help="COLMAP models or folders of them")
    parser.add_argument("-o", "--out", type=Path, default=ROOT / "docs" / "corpus.md")
    parser.add_argument("--work", type=Path, help="keep the run folder and the diagnoses here")
    parser.add_argument("--quick", action="store_true", help="a few models against their bands; writes nothing")
    args = parser.parse_args()
    folders = corpus_folders(args.folders)
    if not folders:
        print("skipped: no corpus of real models here (SFM_AUDIT_CORPUS names one)")
        return 0
    with tempfile.TemporaryDirectory() as scratch:
        models, unread = audited(folders, args.work or Path(scratch), quick=args.quick)
    if args.quick:
        problems = check_bands(models)
    else:
        problems = without_action(models)
        args.out.write_text(document(models, unread), encoding="utf-8")
    for line in problems:
        print("OUT OF BAND:" if args.quick else "NO ACTION:", line, file=sys.stderr)
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
