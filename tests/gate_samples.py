"""Run folders with chosen images for tests of comparing: scenes of many images, and changes planted into them."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from run_samples import STATE, make_ref, sample_table, settings

from sfm_audit.reports.compare.comparison import RunSnapshot, compare
from sfm_audit.reports.compare.gate import judge
from sfm_audit.reports.compare.gate_policy import GatePolicy
from sfm_audit.reports.run_folder.reader import RunReader
from sfm_audit.reports.run_folder.store import RunStore

_EMPTY = GatePolicy()
_count = iter(range(10**6))

NASTY = (
    "<script>alert('1')</script>.jpg",
    "quotes\"'&amp;`|.jpg",
    "two\nlines\x1b[31m\x00.jpg",
    "\u202egpj.txt",
    "תמונה של מגדל.jpg",
    "x" * 300 + ".jpg",
    "| a | *b* _c_ [d](http://e.f) ![g](h) @i #1 $k$ ~~l~~.jpg",
    " spaces  in  it ",
    "",
)


def scene(num_images: int = 40, **columns: Any) -> dict[str, Any]:
    """Columns of one scene's images: sound, with a sigma of 0.3 px each, unless given."""
    n = len(columns.get("image_name", range(num_images)))
    sound = {
        "image_name": [f"IMG_{i:04d}.jpg" for i in range(n)],
        "verdict": ["accepted"] * n,
        "verdict_misfit": ["accepted"] * n,
        "verdict_pose": ["accepted"] * n,
        "reasons": [[] for _ in range(n)],
        "camera_model": ["SIMPLE_RADIAL"] * n,
        "sigma_constant_px": np.full(n, 0.3),
        "misfit_px": np.full(n, np.nan),
        "pose_offset_px": np.full(n, 1e-9),
        "num_inliers": np.full(n, 500),
        "image_id": np.arange(n),
        "camera_id": np.arange(n),
    }
    return {**sound, **columns}


def but(columns: Mapping[str, Any], *images: int, **changes: Any) -> dict[str, Any]:
    """Change some images of a scene."""
    out = {name: list(values) for name, values in columns.items()}
    for name, value in changes.items():
        for i in images:
            out[name][i] = value
    return out


def without(columns: Mapping[str, Any], *images: int) -> dict[str, Any]:
    """Leave some images out of a scene."""
    return {name: [v for i, v in enumerate(values) if i not in images] for name, values in columns.items()}


def rejected(columns: Mapping[str, Any], *images: int, reason: str = "ks_rejected: p = 0.01") -> dict[str, Any]:
    """Reject some images of a scene."""
    return but(columns, *images, verdict="rejected", reasons=[reason])


def write_run(
    folder: Path,
    scenes: Mapping[str, Mapping[str, Any]],
    models: Mapping[str, Any] | None = None,
    failures: Any = (),
    config: Mapping[str, Any] | None = None,
    cameras: Mapping[str, Any] | None = None,
) -> RunReader:
    """Write a run: one model per entry, named dataset/scene/component or scene, each with the same ``cameras``."""
    with RunStore(folder, settings(**(config or {}))) as store:
        for name, columns in scenes.items():
            dataset, scene_name, component = name.split("/") if name.count("/") == 2 else ("data", name, "0")
            labels = {"dataset": dataset, "scene": scene_name, "component": component}
            ref = make_ref(f"{dataset}/{scene_name}/sparse/{component}", **labels)
            n = len(columns["image_name"])
            same = {**labels, "model_path": ref.model_path}
            numbers = {"noise_s0_px": [0.3], "recomputed_point_error_px": [0.5], **(models or {})}
            count = {f"num_{v}": [list(columns["verdict"]).count(v)] for v in ("accepted", "rejected", "undetermined")}
            tables = {
                "images": sample_table("images", n, **{k: [v] * n for k, v in same.items()}, **columns),
                "models": sample_table(
                    "models", 1, num_images=[n], **count, **{k: [v] for k, v in same.items()}, **numbers
                ),
                "cameras": _cameras(same, cameras or {"camera_id": []}),
            }
            store.write(ref, STATE, tables, 0.1)
        store.finish(None, list(failures), 1.0)
    return RunReader.open(folder)


def run(scenes: Mapping[str, Mapping[str, Any]], **options: Any) -> RunSnapshot:
    """Write a run into the working folder and read it."""
    return RunSnapshot.read(write_run(Path(f"RUN{next(_count)}"), scenes, **options))


def failures(before: RunSnapshot | None, after: RunSnapshot, gate: GatePolicy = _EMPTY) -> set[str]:
    """Return what fails: scope and name of the checks."""
    comparison = compare(before, after) if before else None
    return {f"{check.scope.name} {check.name}" for check in judge(gate, after, comparison) if not check.passed}


def failed(before: RunSnapshot | None, after: RunSnapshot, gate: GatePolicy = _EMPTY) -> set[str]:
    """Return the names of the checks that fail, bands by their key."""
    return {name.split()[-1].removeprefix("band.") for name in failures(before, after, gate)}


def _cameras(same: Mapping[str, Any], columns: Mapping[str, Any]) -> pa.Table:
    n = len(columns["camera_id"])
    return sample_table("cameras", n, **{k: [v] * n for k, v in same.items()}, **columns)
