"""How often is a folded model noticed, and a right one suspected? From the model alone, and against another model.

    .venv/bin/python scripts/study_folds.py               # 6 buildings of each kind, about 10 minutes
    .venv/bin/python scripts/study_folds.py --quick       # 1 of each kind
    .venv/bin/python scripts/study_folds.py --photos DIR  # healthy models, DIR/NAME/{sparse/0,database.db}

Buildings are simulated, matched, verified and mapped by COLMAP: `turned`, a box that looks the same from opposite
sides, and `street`, a facade that repeats itself every 8 m. Each is mapped twice: from all matches (it may fold), and
from the true ones alone (a right model). Whether a model is folded is asked of the true poses. With --photos the models
are verified and mapped again with another seed, and every difference is a false alarm.
"""

from __future__ import annotations

import argparse
import contextlib
import shutil
import sqlite3
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap

from sfm_audit.audit.alignment import PoseComparison, Poses, compare_poses
from sfm_audit.audit.inliers.residuals import model_residuals
from sfm_audit.audit.table.witnesses import wilson_upper
from sfm_audit.audit.witnesses.fold import Fold, find_fold
from sfm_audit.audit.witnesses.should_see import should_see
from sfm_audit.loaders import SparseModel, open_model
from sfm_audit.loaders.arrays import FloatArray, IntArray

WIDTH, HEIGHT, FOCAL = 1200, 900, 960.0
NUM_CAMERAS = 40
HALF_TURN = np.diag([-1.0, -1.0, 1.0])
PERIOD, UNITS = 8.0, 5


@dataclass(frozen=True, slots=True, eq=False)
class Building:
    """Points that are photographed.

    xyz, normal: (n, 3).    looks: (n,) equal numbers look the same.    copy: (n,) repetition that a point is in.
    unit: typical depth, m.    turned: whether copies are turned against each other, or shifted.
    """

    xyz: FloatArray
    normal: FloatArray
    looks: IntArray
    copy: IntArray
    cameras: Poses
    unit: float
    turned: bool


def turned_building(rng: np.random.Generator, num_unique: int) -> Building:
    """A box of 10 x 6 x 6 m, the same from opposite sides, and cameras on a circle around it."""
    walls, normals, looks, copies = [], [], [], []
    for axis, (half, away) in enumerate(((5.0, 3.0), (3.0, 5.0))):
        wall = np.c_[rng.uniform(-half, half, 330), away - rng.uniform(0, 0.4, 330), rng.uniform(0, 6, 330)]
        wall = wall if axis == 0 else wall[:, [1, 0, 2]]
        outward = np.eye(3)[1 - axis]
        for copy in range(2):
            turn = HALF_TURN if copy else np.eye(3)
            walls.append(wall @ turn)
            normals.append(np.tile(outward @ turn, (330, 1)))
            looks.append(np.arange(330) + 330 * axis)
            copies.append(np.full(330, copy))
    angle, radius = rng.uniform(0, 2 * np.pi, num_unique), rng.uniform(6.5, 9, num_unique)
    ground = np.c_[radius * np.cos(angle), radius * np.sin(angle), rng.uniform(0, 0.8, num_unique)]
    around = np.c_[np.cos(angle), np.sin(angle), np.zeros(num_unique)]
    theta = 2 * np.pi * np.arange(NUM_CAMERAS) / NUM_CAMERAS + rng.normal(0, 0.02, NUM_CAMERAS)
    centre = np.c_[17 * np.cos(theta), 17 * np.sin(theta), 2 + rng.normal(0, 0.3, NUM_CAMERAS)]
    return Building(
        np.concatenate([*walls, ground]),
        np.concatenate([*normals, around]),
        np.concatenate([*looks, 660 + np.arange(num_unique)]),
        np.concatenate([*copies, np.zeros(num_unique, np.int64)]),
        looking(centre, np.array([0, 0, 2.5]) + rng.normal(0, 0.3, (NUM_CAMERAS, 3))),
        14.0,
        turned=True,
    )


def street_building(rng: np.random.Generator, num_unique: int) -> Building:
    """A facade of five equal units, and cameras that walk along it."""
    unit = np.c_[rng.uniform(0, PERIOD, 260), -rng.uniform(0, 0.8, 260), rng.uniform(0, 7, 260)]
    length = PERIOD * UNITS
    shifts = [unit + np.array([PERIOD * k, 0, 0]) for k in range(UNITS)]
    own = np.c_[rng.uniform(0, length, num_unique), rng.uniform(-0.5, 2, num_unique), rng.uniform(0, 5, num_unique)]
    xyz = np.concatenate([*shifts, own])
    along = np.linspace(2, length - 2, NUM_CAMERAS) + rng.normal(0, 0.1, NUM_CAMERAS)
    centre = np.c_[along, 9 + rng.normal(0, 0.4, NUM_CAMERAS), 2 + rng.normal(0, 0.3, NUM_CAMERAS)]
    aim = np.c_[along + rng.normal(0, 1.5, NUM_CAMERAS), np.zeros(NUM_CAMERAS), np.full(NUM_CAMERAS, 3.0)]
    return Building(
        xyz,
        np.tile([0.0, 1.0, 0.0], (len(xyz), 1)),
        np.concatenate([np.tile(np.arange(260), UNITS), 260 + np.arange(num_unique)]),
        np.concatenate([np.repeat(np.arange(UNITS), 260), np.zeros(num_unique, np.int64)]),
        looking(centre, aim),
        9.0,
        turned=False,
    )


def looking(centre: FloatArray, at: FloatArray) -> Poses:
    """Return upright cameras that look at points."""
    forward = (at - centre) / np.linalg.norm(at - centre, axis=1, keepdims=True)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return Poses(np.stack([right, np.cross(forward, right), forward], axis=1), centre)


@dataclass(frozen=True, slots=True, eq=False)
class Photo:
    """What one camera sees: points (k,), keypoints (k, 2) px, unit rays to the camera (k, 3)."""

    point: IntArray
    xy_px: FloatArray
    ray: FloatArray


def photographs(rng: np.random.Generator, building: Building) -> list[Photo]:
    """Photograph points before the camera, inside, at less than 72 degrees from the wall's normal; 65 % of them."""
    out = []
    for rotation, centre in zip(building.cameras.rotation, building.cameras.centre, strict=True):
        cam = (building.xyz - centre) @ rotation.T
        xy = FOCAL * cam[:, :2] / cam[:, 2:] + [WIDTH / 2, HEIGHT / 2]
        ray = centre - building.xyz
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        seen = (cam[:, 2] > 0) & (xy > 0).all(axis=1) & (xy < [WIDTH, HEIGHT]).all(axis=1)
        seen &= ((ray * building.normal).sum(axis=1) > np.cos(np.radians(72))) & (rng.random(len(ray)) < 0.65)
        point = np.flatnonzero(seen)
        out.append(Photo(point, xy[point] + rng.normal(0, 0.4, (len(point), 2)), ray[point]))
    return out


def matches(rng: np.random.Generator, building: Building, photos: list[Photo]) -> dict[tuple[int, int], IntArray]:
    """Match what looks the same, less often the more the directions differ, as descriptors do."""
    out = {}
    for i, a in enumerate(photos):
        for j, b in enumerate(photos[:i]):
            _, in_a, in_b = np.intersect1d(building.looks[a.point], building.looks[b.point], return_indices=True)
            other = building.copy[a.point[in_a]] != building.copy[b.point[in_b]]
            ray = np.where(other[:, None] & building.turned, b.ray[in_b] @ HALF_TURN, b.ray[in_b])
            angle = np.degrees(np.arccos(np.clip((a.ray[in_a] * ray).sum(axis=1), -1, 1)))
            kept = rng.random(len(angle)) < np.exp(-((angle / 32) ** 2))
            if np.count_nonzero(kept) >= 12:
                out[j, i] = np.c_[in_b[kept], in_a[kept]]
    return out


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
    for k in range(num):
        for name, make in (("turned", turned_building), ("street", street_building)):
            many = {"turned": 400, "street": 300}[name]
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


def study_photos(folder: Path) -> None:
    """Map models of real photos again with another seed, and print what differs."""
    num_images = num_moved = num_remarked = num_models = num_torn = 0
    for database in sorted(folder.glob("*/database.db")):
        first = database.parent / "sparse/0"
        if not (first / "images.bin").exists():
            continue
        before = open_model(str(first))
        if len(before.images) < 8:
            continue
        with tempfile.TemporaryDirectory() as scratch:
            path = map_database(verified_again(database, Path(scratch)), Path(scratch), 2)
            after = open_model(str(path)) if path else None
        residuals = model_residuals(before)
        depth = median_depth(before)
        found = against(before, after, depth) if after else None
        fold = find_fold(should_see(before, residuals))
        num_models += 1
        num_remarked += bool(fold and fold.is_remarkable)
        said = "cannot be compared"
        if found is not None:
            num_images += len(found.main)
            num_moved += int(found.moved.sum())
            num_torn += bool(found.fragments)
            said = (
                f"{len(found.fragments)} fragments, {int(found.moved.sum())} of {len(found.main)} moved, centres "
                f"{np.median(found.centre_error):.2g} median depths, {np.median(found.rotation_deg):.2g} deg, bending "
                f"{found.bending:.2g}"
            )
        print(
            f"{database.parent.name}: {len(before.images)} images; mapped again: {said}; alone: {told(fold)}",
            flush=True,
        )
    print(
        f"{num_torn} of {num_models} models torn, {num_moved} of {num_images} images moved (Wilson's upper bound "
        f"{wilson_upper(num_moved, num_images):.2%}), {num_remarked} of {num_models} remarked on"
    )


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
