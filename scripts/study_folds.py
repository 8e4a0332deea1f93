"""How often is a folded model noticed, and a right one suspected? From the model alone, and against another model.

    .venv/bin/python scripts/study_folds.py               # 6 buildings of each kind, about 15 minutes
    .venv/bin/python scripts/study_folds.py --quick       # 1 of each kind
    .venv/bin/python scripts/study_folds.py --photos DIR  # healthy models, DIR/NAME/{sparse/0,database.db}

Buildings are simulated, matched, verified and mapped by COLMAP: `turned`, a box that looks the same from opposite
sides, `tower`, a square one that looks the same from four, and `street`, a facade that repeats itself every 8 m. Each
is mapped twice: from all matches (it may fold), and from the true ones alone (a right model). Whether a model is folded
is asked of the true poses. With --photos the models are verified and mapped again with another seed, and every
difference is a false alarm; what the model alone says is told of the whole, and of its images that healthy.json names.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import shutil
import sqlite3
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap

from scripts.folds.buildings import (
    HEIGHT,
    WIDTH,
    Building,
    Photo,
    matches,
    photographs,
    street_building,
    tower_building,
    turned_building,
)
from sfm_audit.audit.alignment import PoseComparison, Poses, compare_poses
from sfm_audit.audit.inliers.residuals import model_residuals
from sfm_audit.audit.table.witnesses import wilson_upper
from sfm_audit.audit.witnesses.fold import MIN_IMAGES, Fold, find_fold
from sfm_audit.audit.witnesses.should_see import should_see
from sfm_audit.loaders import SparseModel, open_model
from sfm_audit.loaders.arrays import FloatArray, IntArray

_MIN_PHOTOS = 8
_RIGHT_SHARE = 0.8
"""Of a model's images that have to be healthy, for the model to be a right one."""


def mapped(folder: Path, photos: list[Photo], pairs: dict[tuple[int, int], IntArray]) -> Path | None:
    """Let COLMAP verify and map; return the largest model."""
    folder.mkdir()
    with pycolmap.Database.open(folder / "database.db") as database:
        camera = pycolmap.Camera(
            model="SIMPLE_RADIAL", width=WIDTH, height=HEIGHT, params=[0.8 * WIDTH, WIDTH / 2, HEIGHT / 2, 0.0]
        )
        camera.camera_id = database.write_camera(camera)
        rig = pycolmap.Rig()
        rig.add_ref_sensor(camera.sensor_id)
        rig_id, ids = database.write_rig(rig), []
        for k, photo in enumerate(photos):
            image = pycolmap.Image(name=f"{k:03d}.jpg", camera_id=camera.camera_id)
            image.image_id = database.write_image(image)
            frame = pycolmap.Frame()
            frame.rig_id = rig_id
            frame.add_data_id(image.data_id)
            database.write_frame(frame)
            database.write_keypoints(image.image_id, np.ascontiguousarray(photo.xy_px, np.float32))
            ids.append(image.image_id)
        for (i, j), pair in pairs.items():
            database.write_matches(ids[i], ids[j], pair.astype(np.uint32))
    pycolmap.geometric_verification(folder / "database.db")
    return map_database(folder / "database.db", folder, 1)


def map_database(database: Path, folder: Path, seed: int) -> Path | None:
    """Map a database in one thread; return the folder of the largest model."""
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads, options.random_seed, options.extract_colors = 1, seed, False
    (folder / "maps").mkdir()
    models = pycolmap.incremental_mapping(database, folder, folder / "maps", options=options)
    if not models:
        return None
    largest = max(models.values(), key=lambda model: int(model.num_reg_images()))
    (folder / "model").mkdir()
    largest.write_binary(folder / "model")
    return folder / "model"


def verified_again(database: Path, folder: Path) -> Path:
    """Copy a database and verify its matches anew: COLMAP's RANSAC finds others each time."""
    copy = folder / "database.db"
    shutil.copy(database, copy)
    with contextlib.closing(sqlite3.connect(copy)) as connection:
        connection.execute("DELETE FROM two_view_geometries")
        connection.commit()
    pycolmap.geometric_verification(copy)
    return copy


def poses_of(model: SparseModel) -> Poses:
    """Return the poses of a model, in the order of its images."""
    return Poses.of(model.images.quat_cam_from_world_wxyz, model.images.translation_cam_from_world)


def against(before: SparseModel, after: SparseModel, unit: float) -> PoseComparison | None:
    """Compare two models over the images that both have."""
    names = sorted(set(before.images.name) & set(after.images.name))
    both = [
        poses_of(model).take(np.array([model.images.name.index(name) for name in names])) for model in (before, after)
    ]
    return compare_poses(both[0], both[1], unit)


def fold_of(model: SparseModel) -> Fold | None:
    """Ask the model alone."""
    return find_fold(should_see(model, model_residuals(model)))


def told(found: Fold | None) -> str:
    """What the model alone says, in a few characters."""
    if found is None:
        return "no groups"
    return f"score {found.score:.2f}, mixed {found.mixed:.2f}{', remarked' if found.is_remarkable else ''}"


def right_share(found: Fold | None, moved: FloatArray) -> float:
    """Share of images whose group is the side that the true poses say."""
    if found is None:
        return float("nan")
    same = np.mean((found.group == 1) == (moved > 0))
    return float(max(same, 1 - same))


def buildings(num: int) -> Iterator[tuple[str, Building, int]]:
    """Yield name, building and seed: every other one with few unique points."""
    makers = (("turned", turned_building, 400), ("street", street_building, 300), ("tower", tower_building, 400))
    for k in range(num):
        for name, make, many in makers:
            unique = many if k % 2 == 0 else many // 3
            yield f"{name}, {unique} unique points", make(np.random.default_rng(7000 + k), unique), 7000 + k


def study_buildings(num: int) -> None:
    """Map buildings, and print what notices their folds."""
    counts = dict.fromkeys(("folded", "gate", "remark", "right", "gate wrong", "remark wrong"), 0)
    for name, building, seed in buildings(num):
        rng = np.random.default_rng(seed)
        photos = photographs(rng, building)
        pairs = matches(rng, building, photos)
        true = {(i, j): m[photos[i].point[m[:, 0]] == photos[j].point[m[:, 1]]] for (i, j), m in pairs.items()}
        with tempfile.TemporaryDirectory() as scratch:
            paths = [mapped(Path(scratch, "all"), photos, pairs)]
            paths += [mapped(Path(scratch, "true"), photos, {k: m for k, m in true.items() if len(m) >= 12})]
            models = [open_model(str(path)) for path in paths if path is not None]
        if len(models) < 2:
            print(f"{name}: not mapped", flush=True)
            continue
        truth = [_truth(building, model) for model in models]
        folds = [fold_of(model) for model in models]
        unit = building.unit / truth[1].alignment.similarity.scale if truth[1] else building.unit
        gate = against(models[1], models[0], unit)
        is_folded = bool(truth[0] is None or truth[0].fragments)
        noticed, remarked = bool(gate is None or gate.fragments), bool(folds[0] and folds[0].is_remarkable)
        counts["folded" if is_folded else "right"] += 1
        counts["gate" if is_folded else "gate wrong"] += noticed
        counts["remark" if is_folded else "remark wrong"] += remarked
        counts["right"] += 1
        counts["remark wrong"] += bool(folds[1] and folds[1].is_remarkable)
        share = right_share(folds[0], truth[0].moved.astype(float)) if truth[0] else float("nan")
        sizes = [len(one.image_idxs) for one in truth[0].fragments] if truth[0] else []
        print(
            f"{name}, seed {seed}: {len(models[0].images)} images, fragments {sizes} by the truth; gate "
            f"{'fails' if noticed else 'passes'}; alone: {told(folds[0])}, {share:.0%} in the right group; "
            f"right model of {len(models[1].images)}: {told(folds[1])}",
            flush=True,
        )
    print(counts)


def _truth(building: Building, model: SparseModel) -> PoseComparison | None:
    """Compare a model with the poses that took its photos, in units of the true model."""
    true = building.cameras.take(np.array([int(name[:3]) for name in model.images.name]))
    return compare_poses(true, poses_of(model), building.unit)


@dataclass
class Photos:
    """Counts over models of real photos.

    models, torn: mapped again, and with a fragment then.    images, moved: healthy ones of these, and elsewhere then.
    asked, remarked: right models of which the model alone says something, and remarked on.
    """

    models: int = 0
    torn: int = 0
    images: int = 0
    moved: int = 0
    asked: int = 0
    remarked: int = 0


def study_photos(folder: Path) -> None:
    """Map models of real photos again with another seed, and print what differs."""
    counts = Photos()
    for database in sorted(folder.glob("*/database.db")):
        first = database.parent / "sparse/0"
        if (first / "images.bin").exists():
            before = open_model(str(first))
            if len(before.images) >= _MIN_PHOTOS:
                print(f"{database.parent.name}: {_photos(before, database, counts)}", flush=True)
    print(
        f"{counts.torn} of {counts.models} models torn, {counts.moved} of {counts.images} images moved (Wilson's upper "
        f"bound {wilson_upper(counts.moved, counts.images):.2%}); model alone: {counts.remarked} of {counts.asked} "
        f"right models remarked on (upper bound {wilson_upper(counts.remarked, counts.asked):.0%})"
    )


def _photos(before: SparseModel, database: Path, counts: Photos) -> str:
    """Count one model, and say what was found."""
    proven = database.with_name("healthy.json")
    names = (
        set(json.loads(proven.read_text(encoding="utf-8"))["images"]) if proven.exists() else set(before.images.name)
    )
    with tempfile.TemporaryDirectory() as scratch:
        path = map_database(verified_again(database, Path(scratch)), Path(scratch), 2)
        after = open_model(str(path)) if path else None
    found = against(before, after, median_depth(before)) if after else None
    fold = fold_of(before) if len(before.images) >= MIN_IMAGES else None
    is_right = len(names) >= _RIGHT_SHARE * len(before.images)
    counts.asked += fold is not None and is_right
    counts.remarked += bool(fold and fold.is_remarkable and is_right)
    said = "cannot be compared"
    if found is not None and after is not None:
        common = sorted(set(before.images.name) & set(after.images.name))
        healthy = np.array([name in names for name in common])
        counts.models += 1
        counts.torn += bool(found.fragments)
        counts.images += int(healthy.sum())
        counts.moved += int((found.moved & healthy).sum())
        said = (
            f"{len(found.fragments)} fragments, {int(found.moved.sum())} of {len(found.main)} moved, centres "
            f"{np.median(found.centre_error):.2g} median depths, {np.median(found.rotation_deg):.2g} deg, bending "
            f"{found.bending:.2g}"
        )
    return f"{len(before.images)} images, {len(names)} healthy; mapped again: {said}; alone: {told(fold)}"


def median_depth(model: SparseModel) -> float:
    """Median distance of seen points from the cameras, model units."""
    image = np.repeat(np.arange(len(model.images)), np.diff(model.observations.offsets))
    linked = model.observations.point_idx >= 0
    away = model.points.xyz_world[model.observations.point_idx[linked]] - poses_of(model).centre[image[linked]]
    return float(np.median(np.linalg.norm(away, axis=1)))


def main() -> None:
    """Measure what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="one building of each kind")
    parser.add_argument("--photos", type=Path, metavar="DIR", help="models of real photos with their databases")
    options = parser.parse_args()
    pycolmap.logging.minloglevel = 2
    if options.photos:
        study_photos(options.photos)
    else:
        study_buildings(1 if options.quick else 6)


if __name__ == "__main__":
    main()
