"""What is done with a damaged input, and what is right to come of it."""

from __future__ import annotations

import io
import re
import shutil
import tempfile
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from scripts.fuzzing.cases import FILES, PLACE, Case, file_case, model_case, write_case

GOOD: Final = frozenset({"ok", "finding", "refused"})
_MAX_STDERR_LINES: Final = 2


@dataclass(frozen=True, slots=True)
class Outcome:
    """What came of an input. kind: of `GOOD`, or TRACEBACK, WARNING, NONFINITE, EXITCODE, NOISE; where: one line."""

    kind: str
    where: str = ""

    @property
    def is_good(self) -> bool:
        """Whether that is right."""
        return self.kind in GOOD


@dataclass(frozen=True, slots=True)
class Target:
    """draw: (seed, number) -> the input; run: (input, folder that holds it) -> what came of it."""

    draw: Callable[[int, int], Case]
    run: Callable[[Case, Path], Outcome]
    with_pycolmap: bool = False


def place_of(error: BaseException) -> str:
    """Return type, message and the last places of this project in a traceback, innermost first."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = [frame for frame in frames if "sfm_audit" in frame.filename or "/audit/" in frame.filename]
    places = [f"{_short(frame.filename)}:{frame.lineno}" for frame in reversed(ours[-4:] or frames[-2:])]
    return f"{type(error).__name__}: {' '.join(str(error).split())[:100]} @ {' < '.join(places)}"


def _short(filename: str) -> str:
    return re.sub(r".*/(?=(?:loaders|audit|reports)/)", "", filename)


@contextmanager
def _caught(outcomes: list[Outcome]) -> Iterator[list[warnings.WarningMessage]]:
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
            Outcome("WARNING", f"{first.category.__name__}: {first.message} @ {_short(first.filename)}:{first.lineno}")
        )


def read_model(case: Case, folder: Path) -> Outcome:
    """Open the model: a model, with or without findings, or a LoadError of one line."""
    from sfm_audit.loaders import LoadError, open_model  # noqa: PLC0415 - in the worker only
    from sfm_audit.loaders.datasets.image_counts import count_images  # noqa: PLC0415 - as above

    del case
    outcomes: list[Outcome] = []
    found = Outcome("ok")
    with _caught(outcomes):
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
    with _caught(outcomes):
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
        return _verb(["run", str(folder), "-o", str(out / "run"), "--jobs", "1", "--quiet"], {0, 3}, out / "run")
    finally:
        shutil.rmtree(out, ignore_errors=True)


def _verb(words: list[str], codes: set[int], run: Path | None = None) -> Outcome:
    """Call the command line in this process."""
    from sfm_audit.audit.cli.main import main  # noqa: PLC0415 - in the worker only

    stderr, stdout, outcomes, code = io.StringIO(), io.StringIO(), list[Outcome](), 0
    with _caught(outcomes), redirect_stderr(stderr), redirect_stdout(stdout):
        code = main(words)
    lines = stderr.getvalue().splitlines()
    if outcomes:
        return outcomes[0]
    if code not in codes:
        return Outcome("EXITCODE", f"{words[0]}: {code}: {lines[-1:]}")
    if len(lines) > _MAX_STDERR_LINES or any("Traceback" in line or "Warning" in line for line in lines):
        return Outcome("NOISE", f"{words[0]}: {len(lines)} lines: {lines[-1][:150] if lines else ''}")
    infinite = infinite_columns(run) if run is not None and code in {0, 3} else []
    if infinite:
        return Outcome("NONFINITE", ", ".join(infinite))
    return Outcome("refused" if code == 3 else "ok")


def infinite_columns(run: Path) -> list[str]:
    """Return the columns of a run folder's tables that hold infinities or NaN."""
    import pyarrow.parquet as pq  # noqa: PLC0415 - in the worker only

    found = []
    for path in sorted(run.glob("*/part-*.parquet")):
        table = pq.read_table(path)
        for name in table.column_names:
            column = table.column(name)
            if str(column.type) in {"double", "float"}:
                values = column.drop_null().to_numpy()
                if not np.isfinite(values).all():
                    found.append(f"{path.parent.name}.{name}")
    return sorted(set(found))


TARGETS: Final[Mapping[str, Target]] = {
    "models": Target(model_case, read_model, with_pycolmap=True),
    "files": Target(file_case, read_file),
    "run": Target(model_case, run_cli),
}
"""Add a target here: how its inputs are drawn, and what is done with one. Run folders are damaged like models are:
`draw` takes a finished run as its base, `run` calls the verbs on it with `_verb`."""


def attempt(target: str, case: Case) -> Outcome:
    """Write the input into a folder of its own, try it, and clean up."""
    root = Path(tempfile.mkdtemp(prefix="fuzz-", dir=PLACE))
    try:
        folder = root / "in"
        folder.mkdir()
        write_case(case, folder)
        return TARGETS[target].run(case, folder)
    finally:
        shutil.rmtree(root, ignore_errors=True)
