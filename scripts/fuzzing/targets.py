"""What is done with a damaged input, and what is right to come of it."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from scripts.fuzzing.cases import FILES, PLACE, Case, file_case, model_case, write_case
from scripts.fuzzing.outcomes import Outcome, caught
from scripts.fuzzing.run_folders import BASES, read_run_folder, run_folder_case, write_run_folder
from scripts.fuzzing.verbs import call_verb


@dataclass(frozen=True, slots=True)
class Target:
    """draw: (seed, number) -> the input; run: (input, folder that holds it) -> what came of it."""

    draw: Callable[[int, int], Case]
    run: Callable[[Case, Path], Outcome]
    with_pycolmap: bool = False


def read_model(case: Case, folder: Path) -> Outcome:
    """Open the model: a model, with or without findings, or a LoadError of one line."""
    from sfm_audit.loaders import LoadError, open_model  # noqa: PLC0415 - in the worker only
    from sfm_audit.loaders.datasets.image_counts import count_images  # noqa: PLC0415 - as above

    del case
    outcomes: list[Outcome] = []
    found = Outcome("ok")
    with caught(outcomes):
        try:
            model = open_model(folder)
            for row in range(len(model.images)):
                _ = model.image(row).rotation_cam_from_world
            codes = ",".join(sorted({str(finding.code) for finding in model.findings}))
            found = Outcome("finding", codes) if model.findings else Outcome("ok")
        except LoadError as error:
            found = _refusal(error, folder)
        try:
            count_images(str(folder))
        except LoadError as error:
            if "\n" in str(error):
                found = Outcome("NOISE", str(error)[:200])
    return outcomes[0] if outcomes else found


def _refusal(error: Exception, folder: Path) -> Outcome:
    text = str(error)
    if "\n" in text or len(text) > 1000 or str(folder) not in text:
        return Outcome("NOISE", text[:200])
    return Outcome("refused")


def read_file(case: Case, folder: Path) -> Outcome:
    """Read a file of correspondences, a scan, a benchmark file or a database."""
    from sfm_audit.loaders import LoadError  # noqa: PLC0415 - in the worker only

    path, outcomes, found = folder / case.base, list[Outcome](), Outcome("ok")
    with caught(outcomes):
        try:
            values = _READERS[case.base](path)
            if values is not None and np.isinf(values).any():
                found = Outcome("NONFINITE", case.base)
        except LoadError as error:
            found = _refusal(error, folder)
    return outcomes[0] if outcomes else found


def _numbers(path: Path) -> Any:
    from sfm_audit.loaders.correspondences.table import read_correspondences  # noqa: PLC0415 - in the worker only

    return read_correspondences(path).xyz_world


def _scan(path: Path) -> Any:
    from sfm_audit.loaders.correspondences.scan_ptx import read_ptx  # noqa: PLC0415 - in the worker only

    return read_ptx(path).xyz_world


def _benchmark(path: Path) -> None:
    from sfm_audit.loaders.scene_info.file import read_scene_info  # noqa: PLC0415 - in the worker only

    read_scene_info(path)


def _keypoints(path: Path) -> Any:
    from sfm_audit.loaders import open_model  # noqa: PLC0415 - in the worker only
    from sfm_audit.loaders.colmap.database import read_keypoint_shapes  # noqa: PLC0415 - as above

    folder = path.parent / "model"
    folder.mkdir(exist_ok=True)
    write_case(Case(0, "noisy", "binary", ()), folder)
    read_keypoint_shapes(path, open_model(folder))


_READERS: Final[Mapping[str, Callable[[Path], Any]]] = {
    "csv": _numbers,
    "parquet": _numbers,
    "ptx": _scan,
    "pickle2": _benchmark,
    "pickle4": _benchmark,
    "npz": _benchmark,
    "database": _keypoints,
}
if set(_READERS) != set(FILES):
    raise RuntimeError("a kind of file without a reader")


def run_cli(case: Case, folder: Path) -> Outcome:
    """Run the command line on the model: exit code 0 or 3, few lines on stderr, finite numbers in the tables."""
    del case
    out = Path(tempfile.mkdtemp(dir=folder.parent))
    try:
        return call_verb(["run", str(folder), "-o", str(out / "run"), "--jobs", "1", "--quiet"], {0, 3}, out / "run")
    finally:
        shutil.rmtree(out, ignore_errors=True)


TARGETS: Final[Mapping[str, Target]] = {
    "models": Target(model_case, read_model, with_pycolmap=True),
    "files": Target(file_case, read_file),
    "run": Target(model_case, run_cli),
    "run folders": Target(run_folder_case, read_run_folder),
}
"""Add a target here: how its inputs are drawn, and what is done with one."""


def write_input(case: Case, folder: Path) -> None:
    """Write any input into an existing, empty folder."""
    if case.base in BASES:
        write_run_folder(case, folder)
    else:
        write_case(case, folder)


def attempt(target: str, case: Case) -> Outcome:
    """Write the input into a folder of its own, try it, and clean up."""
    root = Path(tempfile.mkdtemp(prefix="fuzz-", dir=PLACE))
    try:
        folder = root / "in"
        folder.mkdir()
        write_input(case, folder)
        return TARGETS[target].run(case, folder)
    finally:
        shutil.rmtree(root, ignore_errors=True)
