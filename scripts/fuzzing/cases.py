"""Which input is number i of a campaign? A sound sample, and edits drawn from the seed and the number alone."""

from __future__ import annotations

import importlib
import io
import os
import pickle
import shutil
import sqlite3
import sys
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from scripts.fuzzing.edits import (
    Edit,
    applied,
    random_bytes_edits,
    random_field_edits,
    random_token_edits,
    with_fields,
)
from sfm_audit.loaders.camera_models import BY_ID

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests"))
writer: Any = importlib.import_module("model_writer")

MODELS: Final[Mapping[str, Callable[[], Any]]] = {
    "tiny": lambda: _named(writer.tiny_model()),
    "rig": lambda: _named(writer.rig_model()),
    "noisy": lambda: _named(writer.noisy_model()),
    "noisyrig": lambda: _named(_noisy_rig()),
}
PLACE: Final = os.environ.get("FUZZ_TMP") or ("/dev/shm" if Path("/dev/shm").is_dir() else None)  # noqa: S108 - in memory
"""Where inputs are written, one folder each."""

FILES: Final = ("csv", "parquet", "ptx", "pickle2", "pickle4", "npz", "database")


@dataclass(frozen=True, slots=True)
class Case:
    """One input. base: a key of `MODELS` or `FILES`; layout: binary or text, for models."""

    number: int
    base: str
    layout: str
    edits: tuple[Edit, ...]

    @property
    def is_model(self) -> bool:
        """Whether the input is a model folder."""
        return self.base in MODELS

    @property
    def kind(self) -> str:
        """What kind of input it is: the format, and for models what was changed."""
        if not self.is_model:
            return self.base
        whats = {edit.what for edit in self.edits}
        changed = "fields" if "field" in whats else "tokens" if "token" in whats else "bytes"
        return f"{self.layout}, {changed}"

    def but(self, edits: tuple[Edit, ...]) -> Case:
        """Return the same with other edits."""
        return replace(self, edits=edits)


def model_case(seed: int, number: int) -> Case:
    """Draw a damaged model."""
    rng = np.random.default_rng([seed, number])
    base, layout = str(rng.choice(list(MODELS))), str(rng.choice(["binary", "binary", "text"]))
    kind = str(rng.choice(["bytes", "fields", "fields", "tokens"] if layout == "text" else ["bytes", "fields"]))
    if kind == "fields":
        return Case(number, base, layout, tuple(random_field_edits(rng, _sound(base))))
    files = _sound_files(base, layout)
    name = str(rng.choice(sorted(files)))
    if kind == "tokens":
        return Case(number, base, layout, tuple(random_token_edits(rng, name, files[name])))
    return Case(number, base, layout, tuple(random_bytes_edits(rng, name, len(files[name]))))


def file_case(seed: int, number: int) -> Case:
    """Draw a damaged file of another kind: correspondences, a scan, a benchmark file, a database."""
    rng = np.random.default_rng([seed, number])
    base = str(rng.choice(FILES))
    data = sample_file(base)
    if base in {"csv", "ptx"} and rng.random() < 0.5:
        return Case(number, base, "", tuple(random_token_edits(rng, base, data)))
    return Case(number, base, "", tuple(random_bytes_edits(rng, base, len(data))))


def write_case(case: Case, folder: Path) -> None:
    """Write the input into an existing, empty folder: files of a model, or one file called as the base."""
    if case.is_model:
        files = _sound_files(case.base, case.layout)
        if any(edit.what == "field" for edit in case.edits):
            files = _files(with_fields(_sound(case.base), case.edits), case.layout)
    else:
        files = {case.base: sample_file(case.base)}
    for name, content in applied(case.edits, files).items():
        (folder / name).write_bytes(content)


@cache
def _sound(base: str) -> Any:
    return MODELS[base]()


@cache
def _sound_files(base: str, layout: str) -> dict[str, bytes]:
    return _files(_sound(base), layout)


def _files(model: Any, layout: str) -> dict[str, bytes]:
    files: dict[str, bytes] = writer.binary_files(model) if layout == "binary" else writer.text_files(model)
    return files


def _named(model: Any) -> Any:
    """The same model, able to write every camera model in text."""
    return model.but(name_of_model={model_id: each.name for model_id, each in BY_ID.items()})


def _noisy_rig() -> Any:
    """The noisy model with a rig of its two cameras in every frame of two images."""
    model = writer.noisy_model()
    side = (1.0, 0.0, 0.0, 0.0, -0.3, -0.1, 0.0)
    rigs = (writer.Rig(2, ((0, 1, None), (0, 7, side))),)
    frames = []
    for first in range(0, len(model.images), 2):
        pair = model.images[first : first + 2]
        data = tuple((0, image.camera_id, image.image_id) for image in pair)
        frames.append(writer.Frame(first + 1, 2, pair[0].pose, data))
    return model.but(rigs=rigs, frames=tuple(frames))


@cache
def sample_file(kind: str) -> bytes:
    """Return a sound file of a kind."""
    return _SAMPLES[kind]()


def _csv() -> bytes:
    rows = [f"{10.5 + i},{20.25 * (i % 7 + 1)},{i}.5,-{i},4e1,n{i}" for i in range(12)]
    return ("# width=1600 height=1200\nx,y,X,Y,Z,name\n" + "\n".join(rows) + "\n").encode()


def _parquet() -> bytes:
    import pyarrow as pa  # noqa: PLC0415 - in the worker only
    import pyarrow.parquet as pq  # noqa: PLC0415 - as above

    table = pa.table({name: pa.array(np.arange(1.0, 13.0)) for name in ("x", "y", "X", "Y", "Z")})
    sink = io.BytesIO()
    pq.write_table(table.replace_schema_metadata({"width": "1600", "height": "1200"}), sink)
    return sink.getvalue()


def _ptx() -> bytes:
    points = "".join(f"{i}.5 {i * 2} 3.25 0.5 1 2 3\n" for i in range(1, 13))
    header = "4\n3\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n5 6 7 1\n"
    return (header + points).encode()


def _scene_info() -> dict[str, Any]:
    paths = np.array([f"images/{i}.jpg" for i in range(4)], dtype=object)
    pairs = np.empty(3, dtype=object)
    pairs[:] = [((i, i + 1), 0.5, np.arange(6.0).reshape(2, 3)) for i in range(3)]
    return {"image_paths": paths, "depth_paths": paths, "pair_infos": pairs, "intrinsics": np.zeros((4, 3, 3))}


def _npz() -> bytes:
    sink = io.BytesIO()
    arrays = {
        "image_paths": np.array([f"{i}.jpg" for i in range(4)]),
        "overlap_matrix": np.eye(4),
        "n_points": np.eye(4),
    }
    np.savez_compressed(sink, allow_pickle=False, **arrays)
    return sink.getvalue()


def _database() -> bytes:
    folder = Path(tempfile.mkdtemp())
    try:
        with sqlite3.connect(folder / "d.db") as db:
            db.execute(
                "CREATE TABLE images(image_id INTEGER PRIMARY KEY, name TEXT NOT NULL UNIQUE, camera_id INTEGER)"
            )
            db.execute("CREATE TABLE keypoints(image_id INTEGER PRIMARY KEY, rows INTEGER, cols INTEGER, data BLOB)")
            for image in writer.noisy_model().images:
                db.execute("INSERT INTO images VALUES(?, ?, 1)", (image.image_id, image.name))
                values = np.ones((len(image.points2d), 4), dtype="<f4")
                db.execute("INSERT INTO keypoints VALUES(?, ?, 4, ?)", (image.image_id, len(values), values.tobytes()))
        db.close()
        return (folder / "d.db").read_bytes()
    finally:
        shutil.rmtree(folder)


_SAMPLES: Final[Mapping[str, Callable[[], bytes]]] = {
    "csv": _csv,
    "parquet": _parquet,
    "ptx": _ptx,
    "pickle2": lambda: pickle.dumps(_scene_info(), 2),
    "pickle4": lambda: pickle.dumps(_scene_info(), 4),
    "npz": _npz,
    "database": _database,
}
