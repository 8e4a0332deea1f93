"""Models and tables for tests of runs: small synthetic reconstructions, and result rows with chosen values."""

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pycolmap

from sfm_audit.audit.table import build_table, schema
from sfm_audit.audit.table.words import Member
from sfm_audit.loaders import ModelRef
from sfm_audit.loaders.datasets.input_state import InputState
from sfm_audit.reports.run_folder.store import RunSettings

CONFIG = {
    "noise": "track",
    "points": "in-sample",
    "policy": "full",
    "min_effect": "0.2px",
    "alpha": 0.05,
    "pose_offset_threshold_px": 0.5,
}
STATE = InputState(1000, "stamp", "digest")
TESTS = Path(__file__).resolve().parent


def settings(paths=("data",), **changes: Any) -> RunSettings:
    return RunSettings("0.1.0", {**CONFIG, **changes}, list(paths))


def make_ref(location: str = "data/a/sparse/0", **labels: str) -> ModelRef:
    given = {"dataset": "data", "scene": "a", "component": "0", "model_path": location, **labels}
    return ModelRef(location=f"/{location}", **given)


def sample_table(name: str, num_rows: int, **given: Any) -> pa.Table:
    """Return a table of the schema with the columns given and fill values in the others."""
    fills: Mapping[Callable[[pa.DataType], bool], Any] = {
        pa.types.is_string: ["x"] * num_rows,
        pa.types.is_list: [[] for _ in range(num_rows)],
        pa.types.is_boolean: [True] * num_rows,
        pa.types.is_floating: np.full(num_rows, 0.25),
        pa.types.is_integer: np.full(num_rows, 3),
    }
    wanted = schema(name)
    if name == "images":
        given = {**dict.fromkeys(map(str, Member), ["accepted"] * num_rows), "severity": [None] * num_rows, **given}
    columns = {field.name: next(fill for is_type, fill in fills.items() if is_type(field.type)) for field in wanted}
    return build_table({**columns, **given}, wanted)


def sample_tables(
    ref: ModelRef, verdicts=("accepted", "rejected"), models=None, cameras=None, **images: Any
) -> dict[str, pa.Table]:
    """Return the tables of one model with one image per verdict and one camera, which they share."""
    n = len(verdicts)
    labels = {name: getattr(ref, name) for name in ("dataset", "scene", "component", "model_path")}
    counts = {f"num_{verdict}": [verdicts.count(verdict)] for verdict in ("accepted", "rejected", "undetermined")}
    names = [f"IMG_{i:04d}.jpg" for i in range(n)]
    image_labels = {name: [value] * n for name, value in labels.items()}
    one = {name: [value] for name, value in labels.items()}
    return {
        "images": sample_table(
            "images", n, **{**image_labels, "image_name": names, "verdict": list(verdicts), **images}
        ),
        "cameras": sample_table("cameras", 1, **{**one, "num_images": [n], **(cameras or {})}),
        "models": sample_table("models", 1, num_images=[n], **counts, **one, **(models or {})),
    }


def write_models(folder: Path, names, num_points: int = 80, seed: int = 0) -> None:
    """Write one synthetic model with 0.5 px of noise per name into folder/<name>/sparse/0."""
    for i, name in enumerate(names):
        pycolmap.set_random_seed(seed + i)
        options = pycolmap.SyntheticDatasetOptions()
        options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, 5, num_points
        reconstruction = pycolmap.synthesize_dataset(options)
        noise = pycolmap.SyntheticNoiseOptions()
        noise.point2D_stddev = 0.5
        pycolmap.synthesize_noise(noise, reconstruction)
        target = folder / name / "sparse" / "0"
        target.mkdir(parents=True)
        reconstruction.write(str(target))


def truncate(file: Path) -> None:
    file.write_bytes(file.read_bytes()[:-7])


def read_run(run: Path) -> dict[str, pa.Table]:
    """Return the tables of a run, rows sorted by identity, without the metadata of parts."""
    order = {
        "images": ("model_path", "image_id"),
        "cameras": ("model_path", "camera_id"),
        "models": ("model_path",),
    }
    tables = {}
    for name, keys in order.items():
        parts = [pq.ParquetFile(path).read() for path in sorted((run / name).glob("*.parquet"))]
        table = pa.concat_tables([part.replace_schema_metadata(None) for part in parts])
        tables[name] = table.sort_by([(key, "ascending") for key in keys])
    return tables


def part_times(run: Path) -> dict[str, int]:
    return {str(path.relative_to(run)): path.stat().st_mtime_ns for path in sorted(run.rglob("part-*.parquet"))}


def start_cli(*args: str | Path, stub: str | None = None, **options: Any) -> subprocess.Popen[str]:
    """Start sfm-audit in a process of its own; ``stub`` names a function of audit_stubs that audits in its place."""
    code = "from sfm_audit.audit.cli.main import entry_point"
    if stub:
        code += "\nimport functools, audit_stubs, sfm_audit.audit.cli.auditing as auditing"
        code += f"\nauditing.audit_many = functools.partial(auditing.audit_many, audit=audit_stubs.{stub})"
    code += "\nentry_point()"
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([str(TESTS), os.environ.get("PYTHONPATH", "")])}
    # an interrupt must reach the child also where the tests run in the background, which ignores it
    own_signals = {"preexec_fn": lambda: signal.signal(signal.SIGINT, signal.SIG_DFL)}
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    command = [sys.executable, "-c", code, *map(str, args)]
    return subprocess.Popen(command, text=True, env=env, **{**own_signals, **streams, **options})


def run_cli(*args: str | Path, stub: str | None = None, **options: Any) -> tuple[int, str, str]:
    """Run sfm-audit in a process of its own; return its exit code, stdout and stderr."""
    with start_cli(*args, stub=stub, **options) as process:
        out, err = process.communicate(timeout=120)
    return process.returncode, out, err


def wait_for(condition: Callable[[], Any], seconds: float = 180.0) -> Any:
    """Wait until a condition holds and return its value."""
    end = time.monotonic() + seconds
    while not (value := condition()):
        if time.monotonic() > end:
            raise TimeoutError
        time.sleep(0.005)
    return value


def copy_models(source: Path, target: Path) -> Path:
    return Path(shutil.copytree(source, target))
