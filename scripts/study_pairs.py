"""Measure how often verified pairs speak against a healthy image, and how often they find a moved camera.

    python scripts/study_pairs.py [FOLDER...]     simulated scenes, and the models with a database below each FOLDER
    python scripts/study_pairs.py --quick         a few simulated scenes; fails when a number leaves its band

A model counts as healthy unless a truth.json beside its database says ``"folded": true``; of a model with a
healthy.json (scripts/study_healthy.py) only the images that it names count. In healthy models some
cameras are then moved, one at a time and without adjusting anything afterwards: turned by 1 and by 0.3 degrees about a
random axis through their centre, and shifted by 3 % of the median depth of their points in a random direction.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from sfm_audit.audit.config import AuditConfig
from sfm_audit.audit.decision.outside import disagrees
from sfm_audit.audit.engine.model import ModelAuditor
from sfm_audit.audit.simulate.adjust import adjust_scene, sparse_model
from sfm_audit.audit.simulate.matches import OwnPairs
from sfm_audit.audit.simulate.noise import NoiseKind, NoiseSpec
from sfm_audit.audit.simulate.scene import SceneSpec, simulate_scene
from sfm_audit.audit.table.witnesses import wilson_upper
from sfm_audit.audit.witnesses.evidence import Evidence, WitnessReport
from sfm_audit.audit.witnesses.pairs import ask_pairs
from sfm_audit.loaders import discover, open_model
from sfm_audit.loaders.colmap.database import find_database
from sfm_audit.loaders.colmap.pairs import DatabasePairs
from sfm_audit.loaders.errors import LoadError
from sfm_audit.loaders.model import FindingCode, PairSource, SparseModel

MOVES: Final = {
    "turned by 1 degree": (1.0, 0.0),
    "by 0.3 degrees": (0.3, 0.0),
    "shifted by 3 % of the depth": (0.0, 0.03),
}
SETTINGS: Final = AuditConfig()
MAX_FALSE_SHARE: Final = 0.01  # bands of --quick
MIN_POWER: Final = (0.8, 0.1, 0.8)


@dataclass
class Tally:
    """Counts of one group of models.

    models, images, spoken_of, against: as they stand.    others, others_against: spoken of, not shown to be healthy.
    strong, contradicted: pairs.    found: models with finding.
    moved, seen: cameras moved that are spoken of, and found, by move.    beside, wronged: other images then.
    """

    models: int = 0
    images: int = 0
    spoken_of: int = 0
    against: int = 0
    others: int = 0
    others_against: int = 0
    strong: int = 0
    contradicted: int = 0
    found: int = 0
    moved: Counter[str] = field(default_factory=Counter)
    seen: Counter[str] = field(default_factory=Counter)
    beside: int = 0
    wronged: int = 0


def main() -> int:
    """Parse arguments, measure, print tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="*", help="where models with databases lie")
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--moved", type=int, default=6, help="cameras that are moved, per model and move")
    args = parser.parse_args()
    rng = np.random.default_rng(13)
    tallies: dict[str, Tally] = {}
    for name, model, source in _simulated(3 if args.quick else 12):
        _add(tallies.setdefault(name, Tally()), model, source, rng, num_moved=args.moved)
    for folder in args.folders:
        for name, model, source, healthy in _stored(folder):
            num_moved = 0 if name.startswith("folded") else args.moved
            _add(tallies.setdefault(name, Tally()), model, source, rng, num_moved=num_moved, healthy=healthy)
    print("\n".join(_lines(tallies)))
    return _in_band(tallies["simulated"]) if args.quick else 0


def _simulated(num: int) -> Iterator[tuple[str, SparseModel, PairSource]]:
    """Healthy scenes, adjusted, of three kinds of noise."""
    for seed in range(num):
        kind = (NoiseKind.GAUSSIAN, NoiseKind.PER_TRACK_LOGNORMAL, NoiseKind.LAPLACE)[seed % 3]
        spec = SceneSpec(num_images=12, points_per_image=500, noise=NoiseSpec(kind, sigma_px=0.5))
        scene = simulate_scene(spec, np.random.default_rng(seed))
        model = sparse_model(scene, adjust_scene(scene))
        yield "simulated", model, OwnPairs(model)


def _stored(folder: str) -> Iterator[tuple[str, SparseModel, PairSource, set[str] | None]]:
    """Models below a folder that have a database, and their images that are healthy, None for all.

    Models that do not fit their database are named.
    """
    for ref in discover([folder]).refs:
        path = find_database(ref.location)
        if path is None:
            continue
        truth = path.with_name("truth.json")
        proven = path.with_name("healthy.json")
        healthy = set(json.loads(proven.read_text(encoding="utf-8"))["images"]) if proven.exists() else None
        folded = truth.exists() and json.loads(truth.read_text(encoding="utf-8"))["folded"]
        group = "folded" if folded else "healthy"
        try:
            model = open_model(ref.location)
            yield f"{group}, {Path(folder).name}", model, DatabasePairs(path, model), healthy
        except LoadError as error:
            print(f"left out: {error}", file=sys.stderr)


def _add(
    tally: Tally,
    model: SparseModel,
    source: PairSource,
    rng: np.random.Generator,
    *,
    num_moved: int,
    healthy: set[str] | None = None,
) -> None:
    counts = np.array([healthy is None or name in healthy for name in model.images.name])
    auditor = ModelAuditor(model)
    report = _ask(auditor, auditor.sigma_constant_px, source)
    if report is None:
        return
    against = _against(report)
    spoken = np.array([each is not None for each in report.testimonies])
    tally.others += int((spoken & ~counts).sum())
    tally.others_against += int((against & ~counts).sum())
    for image_idx in np.flatnonzero(against).tolist():
        print(f"{model.location}, {model.images.name[image_idx]}: {report.testimonies[image_idx]}", file=sys.stderr)
    against &= counts
    tally.models += 1
    tally.images += int(counts.sum())
    spoken_of = np.flatnonzero(spoken & counts)
    tally.spoken_of += len(spoken_of)
    tally.against += int(against.sum())
    tally.strong += sum(map(int, report.columns["num_pairs_strong"])) // 2
    tally.contradicted += sum(map(int, report.columns["num_pairs_contradicting"])) // 2
    tally.found += any(each.code is FindingCode.CONTRADICTED_PAIRS for each in report.findings)
    for image_idx in rng.permutation(spoken_of)[:num_moved].tolist():
        for move, (turn_deg, shift) in MOVES.items():
            moved = ModelAuditor(_moved(auditor, image_idx, turn_deg, shift, rng))
            said = _ask(moved, auditor.sigma_constant_px, source)
            if said is None:
                continue
            now = _against(said) & counts
            tally.moved[move] += 1
            tally.seen[move] += bool(now[image_idx])
            tally.beside += int(counts.sum()) - 1
            tally.wronged += int(now.sum()) - bool(now[image_idx])


def _ask(auditor: ModelAuditor, sigma_px: np.ndarray, source: PairSource) -> WitnessReport | None:
    report = ask_pairs(Evidence(auditor.model, auditor.residuals, sigma_px, source))
    if report is None or report.witness is None:
        for finding in report.findings if report else ():
            print(f"left out: {finding.text}", file=sys.stderr)
        return None
    return report


def _against(report: WitnessReport) -> np.ndarray:
    return np.array([each is not None and disagrees(each, SETTINGS) for each in report.testimonies])


def _moved(
    auditor: ModelAuditor, image_idx: int, turn_deg: float, shift: float, rng: np.random.Generator
) -> SparseModel:
    """Return the model with one camera turned about its centre, or shifted by a share of its median depth."""
    model = auditor.model
    quat = model.images.quat_cam_from_world_wxyz.copy()
    translation = model.images.translation_cam_from_world.copy()
    way = rng.normal(size=3)
    way /= np.linalg.norm(way)
    turn = Rotation.from_rotvec(np.radians(turn_deg) * way)
    depth = np.median(model.image(image_idx).cam_from_world(auditor.inliers(image_idx).xyz_world)[:, 2])
    quat[image_idx] = np.roll((turn * Rotation.from_quat(np.roll(quat[image_idx], -1))).as_quat(), 1)
    translation[image_idx] = turn.apply(translation[image_idx]) + shift * depth * way
    images = replace(model.images, quat_cam_from_world_wxyz=quat, translation_cam_from_world=translation)
    return replace(model, images=images)


_HEADER: Final = (
    *("models", "number", "images", "spoken of", "disagrees", "share, upper end", "of others"),
    *("strong pairs", "contradict", "finding"),
)


def _lines(tallies: dict[str, Tally]) -> Sequence[str]:
    """Two tables: models as they stand, and with one camera moved."""
    lines = [
        f"| {' | '.join(_HEADER)} |",
        "|---" * len(_HEADER) + "|",
    ]
    for name, t in tallies.items():
        share = f"{t.against / max(t.spoken_of, 1):.1%}, {wilson_upper(t.against, t.spoken_of):.1%}"
        counts = f"{t.models} | {t.images} | {t.spoken_of} | {t.against}"
        others = f"{t.others_against} of {t.others}"
        lines.append(f"| {name} | {counts} | {share} | {others} | {t.strong} | {t.contradicted} | {t.found} |")
    lines += ["", f"| one camera | {' | '.join(MOVES)} | other images then |", f"|---|{'---|' * (len(MOVES) + 1)}"]
    for name, t in tallies.items():
        if t.moved:
            found = " | ".join(f"{t.seen[move]} of {t.moved[move]}" for move in MOVES)
            lines.append(f"| {name} | {found} | {t.wronged} of {t.beside} |")
    return lines


def _in_band(tally: Tally) -> int:
    """Return 1 where size or power left the bands."""
    power = [tally.seen[move] / tally.moved[move] for move in MOVES]
    wrong = (tally.against + tally.wronged) / (tally.spoken_of + tally.beside)
    if wrong <= MAX_FALSE_SHARE and all(got >= wanted for got, wanted in zip(power, MIN_POWER, strict=True)):
        return 0
    print(f"out of band: false alarms {wrong:.3f} (at most {MAX_FALSE_SHARE}), power {power} (at least {MIN_POWER})")
    return 1


if __name__ == "__main__":
    sys.exit(main())
