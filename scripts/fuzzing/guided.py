"""Readers fuzzed by coverage with atheris, which is not installed with the project: ``pip install atheris`` (Linux).

    .venv/bin/python -m scripts.fuzzing.guided pickle4 --minutes 5 --corpus FOLDER

Inputs that reach new branches of `sfm_audit.loaders` are kept in the corpus and changed further. What ends with another
error than a LoadError, a warning, an infinity or a crash stops the campaign; the input is written as crash-*.
"""

from __future__ import annotations

import argparse
import importlib
import shutil
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

_MODEL_FILES: Final = {
    f"{name}.{suffix}": layout
    for suffix, layout in (("bin", "binary"), ("txt", "text"))
    for name in ("cameras", "images", "points3D", "rigs", "frames")
}
_MAX_BYTES: Final = 20_000


class WrongOutcomeError(Exception):
    """An input came to no good end."""


def main(args: Sequence[str] | None = None) -> None:
    """Fuzz one kind of file; atheris ends this process."""
    atheris: Any = importlib.import_module("atheris")
    with atheris.instrument_imports(include=["sfm_audit.loaders"]):  # nothing of it may be imported before
        cases: Any = importlib.import_module("scripts.fuzzing.cases")
        targets: Any = importlib.import_module("scripts.fuzzing.targets")
        for room in ("correspondences.table", "correspondences.scan_ptx", "scene_info.file", "colmap.database"):
            importlib.import_module(f"sfm_audit.loaders.{room}")
        importlib.import_module("sfm_audit.loaders.opening")
        importlib.import_module("sfm_audit.loaders.datasets.image_counts")
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kind", choices=(*cases.FILES, *_MODEL_FILES))
    parser.add_argument("--minutes", type=float, default=5.0)
    parser.add_argument("--corpus", type=Path, required=True, help="folder of inputs; grows")
    options = parser.parse_args(args)
    options.corpus.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="fuzz-guided-", dir=cases.PLACE) as folder:
        sound = Path(folder, "sound")
        sound.mkdir()
        (options.corpus / "sound").write_bytes(_sound(cases, options.kind, sound))

        read = targets.read_file if options.kind in cases.FILES else targets.read_model

        def one(data: bytes) -> None:
            place = Path(folder, "in")
            _place(options.kind, sound, place, data)
            found = read(cases.Case(0, options.kind, "", ()), place)
            if not found.is_good:
                raise WrongOutcomeError(f"{found.kind} {found.where}")

        seconds = f"-max_total_time={60 * options.minutes:.0f}"
        limits = [f"-max_len={_MAX_BYTES}", "-timeout=30", "-rss_limit_mb=4096", f"-artifact_prefix={options.corpus}/"]
        atheris.Setup([sys.argv[0], seconds, *limits, str(options.corpus)], one)
        atheris.Fuzz()


def _sound(cases: Any, kind: str, folder: Path) -> bytes:
    """Return the sound file; for a file of a model write its neighbours into ``folder``."""
    if kind in cases.FILES:
        sample: bytes = cases.sample_file(kind)
        return sample
    cases.write_case(cases.Case(0, "rig", _MODEL_FILES[kind], ()), folder)
    return (folder / kind).read_bytes()


def _place(kind: str, sound: Path, folder: Path, data: bytes) -> None:
    """Write an input, beside the sound files of its model, into ``folder``."""
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(sound, folder)
    (folder / kind).write_bytes(data)


if __name__ == "__main__":
    main()
