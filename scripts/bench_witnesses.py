"""Measure what verified pairs, connectivity, the fold test and the covariance of poses cost beside the audit.

    python scripts/bench_witnesses.py [--images 1000] [--pairs 30000]     some minutes
    python scripts/bench_witnesses.py --quick                              100 images, 1500 pairs

One simulated model and a database.db with its verified pairs (own observations of the same points, plus keypoints
that nobody matched), both written to a temporary folder. The audit without a database, and the witnesses alone,
take turns in one process; the ratios of the medians are reported: pairs and connectivity together have to stay below a
half, the fold test below one (with --quick they are only printed: fixed costs of a small model). The fold test is part
of every audit; its time is taken off. Times are of the process's CPU: a busy machine does not count.
"""

from __future__ import annotations

import argparse
import itertools
import sqlite3
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np

from sfm_audit.audit.config import AuditConfig
from sfm_audit.audit.engine.model import ModelAuditor, audit_model
from sfm_audit.audit.simulate.adjust import true_claim, write_model
from sfm_audit.audit.simulate.matches import OwnPairs
from sfm_audit.audit.simulate.noise import NoiseKind, NoiseSpec
from sfm_audit.audit.simulate.scene import SceneSpec, simulate_scene
from sfm_audit.audit.witnesses.connectivity import ask_connectivity
from sfm_audit.audit.witnesses.covisibility import covisibility
from sfm_audit.audit.witnesses.evidence import Evidence
from sfm_audit.audit.witnesses.fold import ask_fold
from sfm_audit.audit.witnesses.pairs import ask_pairs
from sfm_audit.loaders import SparseModel, open_model
from sfm_audit.loaders.colmap.pairs import MAX_IMAGES, DatabasePairs

_SCHEMA = (
    "CREATE TABLE images (image_id INTEGER PRIMARY KEY, name TEXT)",
    "CREATE TABLE keypoints (image_id INTEGER PRIMARY KEY, rows INTEGER, cols INTEGER, data BLOB)",
    "CREATE TABLE two_view_geometries (pair_id INTEGER PRIMARY KEY, rows INTEGER, cols INTEGER, data BLOB, config)",
)
COVARIANCE = AuditConfig(covariance=True)
_MATCHES = 150  # of a pair, at least: with false ones where the model shares fewer points


def main() -> int:
    """Parse arguments, simulate, measure in turns, print the ratio."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--images", type=int, default=1000)
    parser.add_argument("--pairs", type=int, default=30_000)
    parser.add_argument("--keypoints", type=int, default=8000, help="per image, matched or not")
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--quick", action="store_true")
    args = parser.parse_args()
    num_images, num_pairs = (100, 1500) if args.quick else (args.images, args.pairs)
    with tempfile.TemporaryDirectory() as work:
        folder = Path(work)
        model = _model(folder / "sparse" / "0", num_images, args.keypoints)
        num_matches = _write_database(folder / "database.db", model, num_pairs)
        size_mb = (folder / "database.db").stat().st_size / 1e6
        print(
            f"{num_images} images, {len(model.observations)} observations; {num_pairs} pairs, {num_matches} matches, ",
            end="",
        )
        print(f"database of {size_mb:.0f} MB")
        audits, asked = [], []
        for _ in range(args.repeat):
            audits.append(_seconds(lambda: audit_model(model)))
            asked.append((*_ask(model, folder / "database.db"), _seconds(lambda: audit_model(model, COVARIANCE))))
    pairs, connectivity, fold, with_poses = (statistics.median(each) for each in zip(*asked, strict=True))
    audit = statistics.median(audits) - fold - connectivity
    ratio = (pairs + connectivity) / audit
    print(
        f"audit {audit:.2f} s, pairs {pairs:.2f} s, connectivity {connectivity:.2f} s: {ratio:.2f} of the audit; fold "
        f"{fold:.2f} s: {fold / audit:.2f}; covariance {with_poses - audit - fold - connectivity:.2f} s: "
        f"{(with_poses - fold - connectivity) / audit - 1:.2f}"
    )
    return int((ratio > 0.5 or fold > audit) and not args.quick)


def _seconds(work: Callable[[], object]) -> float:
    start = time.process_time()
    work()
    return time.process_time() - start


def _model(folder: Path, num_images: int, num_keypoints: int) -> SparseModel:
    """A simulated model of 2000 observations per image, tracks of 5 on average, written and read again."""
    noise = NoiseSpec(NoiseKind.PER_TRACK_LOGNORMAL, sigma_px=0.5)
    spec = SceneSpec(
        num_images=num_images,
        points_per_image=2000,
        unlinked_per_image=num_keypoints - 2000,
        noise=noise,
        track_decay=0.70,
        max_neighbours=24,
    )
    scene = simulate_scene(spec, np.random.default_rng(0))
    folder.mkdir(parents=True)
    write_model(scene, true_claim(scene), folder)
    return open_model(folder)


def _write_database(path: Path, model: SparseModel, num_pairs: int) -> int:
    """Write the pairs that share most points, and false ones where there are too few; return the number of matches."""
    rng = np.random.default_rng(1)
    seen = covisibility(ModelAuditor(model).residuals, len(model.points))[1]
    order = np.argsort(-seen.num_shared, kind="stable")[:num_pairs]
    pairs = list(zip(seen.first[order].tolist(), seen.second[order].tolist(), strict=True))
    others = (pair for pair in itertools.combinations(range(len(model.images)), 2) if pair not in set(pairs))
    pairs += itertools.islice(others, num_pairs - len(pairs))
    own, total = OwnPairs(model), 0
    with closing(sqlite3.connect(path)) as db:
        for statement in _SCHEMA:
            db.execute(statement)
        for i, name in enumerate(model.images.name):
            xy_px = own.keypoints_px(i).astype("<f4")
            db.execute("INSERT INTO images VALUES (?, ?)", (i + 1, name))
            db.execute("INSERT INTO keypoints VALUES (?, ?, 2, ?)", (i + 1, len(xy_px), xy_px.tobytes()))
        for first, second in pairs:
            matches = own.matches(first, second)
            if len(matches) < _MATCHES:
                false = rng.integers(0, model.images.num_points2d[[first, second]].min(), (_MATCHES - len(matches), 2))
                matches = np.vstack([matches, false.astype(np.uint32)])
            key = (first + 1) * MAX_IMAGES + second + 1
            row = (key, len(matches), matches.astype("<u4").tobytes())
            db.execute("INSERT INTO two_view_geometries VALUES (?, ?, 2, ?, 2)", row)
            total += len(matches)
        db.commit()
    return total


def _ask(model: SparseModel, database: Path) -> tuple[float, float, float]:
    """Return the seconds of pairs, of connectivity with the shared points that both use, and of the fold test."""
    auditor = ModelAuditor(model)
    residuals, sigma_px = auditor.residuals, auditor.sigma_constant_px  # of the audit, whoever is asked
    evidence = Evidence(model, residuals, sigma_px, DatabasePairs(database, model))
    connectivity = _seconds(lambda: ask_connectivity(evidence))
    pairs = _seconds(lambda: ask_pairs(evidence))
    return pairs, connectivity, _seconds(lambda: ask_fold(evidence))


if __name__ == "__main__":
    sys.exit(main())
