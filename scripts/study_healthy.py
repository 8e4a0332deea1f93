"""Which images of a reconstruction of real photos are where they should be? Those that two others put there too.

    .venv/bin/python scripts/study_healthy.py FOLDER...    models FOLDER/NAME/sparse/0 with FOLDER/NAME/database.db

The matches of every pair of images are dealt into two halves at random; each half is verified anew and mapped with a
seed of its own, so that the two models have no match in common. An image is called healthy if both have it, and if
either, aligned with the model that is judged, puts its centre within 2 % of the median depth and its rotation within
1 degree: half of the matches know a pose less well than all. What the matches of both halves have wrong alike (a
building that looks the same from two sides) this cannot see: photos of such things have to be left out by a person.
Writes FOLDER/NAME/healthy.json, which study_pairs.py reads.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import shutil
import sqlite3
import tempfile
from pathlib import Path
from typing import Final

import numpy as np
import pycolmap

from scripts.study_folds import map_database, median_depth, poses_of
from sfm_audit.audit.alignment import align
from sfm_audit.loaders import SparseModel, open_model
from sfm_audit.loaders.arrays import BoolArray

MAX_CENTRE: Final = 0.02
MAX_ROTATION_DEG: Final = 1.0


def main() -> None:
    """Judge every model, write what was found beside it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--again", action="store_true", help="judge also what has a healthy.json")
    options = parser.parse_args()
    pycolmap.logging.minloglevel = 2
    for folder in options.folders:
        for database in sorted(folder.glob("*/database.db")):
            out = database.with_name("healthy.json")
            if (database.parent / "sparse/0/images.bin").exists() and (options.again or not out.exists()):
                out.write_text(json.dumps(judged(database)) + "\n", encoding="utf-8")


def judged(database: Path) -> dict[str, object]:
    """Map the two halves of a database, and return the names of the images that both put where the model has them."""
    model = open_model(str(database.parent / "sparse/0"))
    agrees = np.ones(len(model.images), dtype=np.bool_)
    largest = []
    for half in range(2):
        with tempfile.TemporaryDirectory() as scratch:
            mapped = map_database(half_of(database, Path(scratch), half), Path(scratch), 11 + half)
            other = open_model(str(mapped)) if mapped else None
        largest.append(0 if other is None else len(other.images))
        agrees &= agreeing(model, other) if other is not None else False
    names = [name for name, good in zip(model.images.name, agrees, strict=True) if good]
    print(f"{database.parent.name}: {len(model.images)} images, halves map {largest}, {len(names)} agree", flush=True)
    return {"images": names, "of": len(model.images), "max_centre": MAX_CENTRE, "max_rotation_deg": MAX_ROTATION_DEG}


def half_of(database: Path, folder: Path, half: int) -> Path:
    """Copy a database with one half of the matches of every pair, verified anew."""
    copy = folder / "database.db"
    shutil.copy(database, copy)
    rng = np.random.default_rng(5)  # the same for both halves, which are complements
    with contextlib.closing(sqlite3.connect(copy)) as connection:
        connection.execute("DELETE FROM two_view_geometries")
        rows = connection.execute("SELECT pair_id, rows, data FROM matches WHERE rows > 0 ORDER BY pair_id").fetchall()
        for pair_id, num, data in rows:
            kept = np.frombuffer(data, "<u4").reshape(num, 2)[rng.permutation(num)[half::2]]
            values = (len(kept), np.ascontiguousarray(kept).tobytes(), pair_id)
            connection.execute("UPDATE matches SET rows = ?, data = ? WHERE pair_id = ?", values)
        connection.commit()
    pycolmap.geometric_verification(copy)
    return copy


def agreeing(model: SparseModel, other: SparseModel) -> BoolArray:
    """Return (I,) the images of a model that another one, aligned with it, puts in the same place."""
    out = np.zeros(len(model.images), dtype=np.bool_)
    row_of = {name: row for row, name in enumerate(other.images.name)}
    rows = np.array([row for row, name in enumerate(model.images.name) if name in row_of], dtype=np.int64)
    others = np.array([row_of[model.images.name[row]] for row in rows.tolist()], dtype=np.int64)
    if not len(rows):
        return out
    found = align(poses_of(model).take(rows), poses_of(other).take(others), median_depth(model))
    if found is not None:
        near = np.linalg.norm(found.centre, axis=1) < MAX_CENTRE
        out[rows] = near & (found.rotation_deg < MAX_ROTATION_DEG)
    return out


if __name__ == "__main__":
    main()
