"""Measure how often references and position priors speak against a healthy image, and what they find.

    python scripts/study_references.py [MODEL=REFERENCE ...] [--truth FOLDER]
    python scripts/study_references.py --quick       fewer simulated scenes; fails when a number leaves its band

Simulated scenes are adjusted; their reference is the truth with an error of 0.2 % of the median depth per axis and 0.05
degrees, their priors are the true centres with errors of a known law. Then single cameras are moved, a third of the
images is moved together, the model is bent, single priors are wrong, and the errors of priors are made to wander.

MODEL=REFERENCE: a model of real photos, and poses of its images from elsewhere; with a truth.json up to two folders
above the model only images that it calls healthy are counted. FOLDER: models with a truth.json that holds the errors of
each image against known cameras (rot_deg, centre_rel), aligned by their points; they are compared with the limits.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from sfm_audit.audit.alignment.poses import Poses, natural_order
from sfm_audit.audit.config import AuditConfig
from sfm_audit.audit.decision.outside import disagrees
from sfm_audit.audit.engine.model import ModelAuditor
from sfm_audit.audit.simulate.adjust import adjust_scene, sparse_model, true_claim
from sfm_audit.audit.simulate.noise import NoiseKind, NoiseSpec
from sfm_audit.audit.simulate.scene import SceneSpec, simulate_scene
from sfm_audit.audit.table.witnesses import wilson_upper
from sfm_audit.audit.witnesses.evidence import Evidence, WitnessReport
from sfm_audit.audit.witnesses.priors import ask_priors
from sfm_audit.audit.witnesses.reference import ask_reference, statement
from sfm_audit.loaders import open_model
from sfm_audit.loaders.arrays import BoolArray, FloatArray
from sfm_audit.loaders.evidence import NotAsked, PositionPriors, ReferencePoses
from sfm_audit.loaders.model import FindingCode, SparseModel
from sfm_audit.loaders.references.formats import reference_of

SETTINGS: Final = AuditConfig()
KINDS: Final = (NoiseKind.GAUSSIAN, NoiseKind.PER_TRACK_LOGNORMAL, NoiseKind.LAPLACE)
CENTRE_SD, ROTATION_SD_DEG = 0.002, 0.05
MOVES: Final = {"turned by 1 degree": (1.0, 0.0), "turned by 3 degrees": (3.0, 0.0), "shifted by 5 %": (0.0, 0.05)}
MOVES["shifted by 15 % of the depth"] = (0.0, 0.15)
PRIOR_SDS: Final = (0.003, 0.01, 0.03)
"""Of priors, per axis, in median depths."""
OFFSETS: Final = (3.0, 5.0, 8.0)
"""Of a wrong prior, in sd per axis."""
MAX_FALSE_SHARE: Final = 0.015  # bands of --quick
MAX_FALSE_FINDINGS: Final = 0.1
MIN_POWER: Final = {
    "turned by 3 degrees": 1.0,
    "shifted by 15 % of the depth": 1.0,
    "fragment": 1.0,
    "bow": 0.9,
    "off by 8 sd": 0.95,
    "wandering": 0.8,
}


@dataclass
class Count:
    """How many of how many, and the share."""

    num: int = 0
    total: int = 0

    def add(self, what: BoolArray | Sequence[bool]) -> None:
        """Count."""
        self.num, self.total = self.num + int(np.sum(what)), self.total + len(what)

    @property
    def share(self) -> float:
        """Of what was asked."""
        return self.num / max(self.total, 1)

    def __str__(self) -> str:
        return f"{self.num} of {self.total} ({self.share:.1%}, upper end {wilson_upper(self.num, self.total):.1%})"


Counts = dict[str, Count]


@dataclass(frozen=True)
class Scene:
    """A healthy model, what was measured of it, and where its cameras truly are, both in its own order."""

    model: SparseModel
    auditor: ModelAuditor
    truth: Poses

    def asked(self, **given: ReferencePoses | PositionPriors) -> Evidence:
        """Return the evidence with something given."""
        return Evidence(self.model, self.auditor.residuals, self.auditor.sigma_constant_px, None, **given)  # type: ignore[arg-type]

    @property
    def depth(self) -> float:
        """Median depth, model units, which are those of the truth to a per cent."""
        return self.asked().median_depth


def main() -> int:
    """Parse arguments, measure, print tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pairs", nargs="*", metavar="MODEL=REFERENCE")
    parser.add_argument("--truth", type=Path, metavar="FOLDER")
    parser.add_argument("--quick", action="store_true")
    args = parser.parse_args()
    rng = np.random.default_rng(17)
    false, found = Counts(), Counts()
    for scene in _simulated(2 if args.quick else 12):
        _references(scene, rng, false, found)
        _priors(scene, rng, false, found, num=15 if args.quick else 60)
    _print("Healthy, simulated: speaks against", false)
    _print("Planted, simulated: found", found)
    if args.pairs:
        _print("Real photos and a reference: speaks against", _real(args.pairs))
    if args.truth:
        _print("Real photos, errors against known cameras: above the limits", _against_truth(args.truth))
    return _in_band(false, found) if args.quick else 0


def _print(title: str, counts: Counts) -> None:
    print(f"\n{title}\n")
    print("| what | how many |\n|---|---|")
    print("\n".join(f"| {name} | {count} |" for name, count in counts.items()))


def _simulated(num: int) -> Iterator[Scene]:
    """Healthy scenes, adjusted, of three kinds of noise."""
    for seed in range(num):
        spec = SceneSpec(num_images=18, points_per_image=300, noise=NoiseSpec(KINDS[seed % 3], sigma_px=0.5))
        scene = simulate_scene(spec, np.random.default_rng(seed))
        model, truth = sparse_model(scene, adjust_scene(scene)), sparse_model(scene, true_claim(scene))
        yield Scene(model, ModelAuditor(model), _poses(truth))


def _poses(model: SparseModel) -> Poses:
    return Poses.of(model.images.quat_cam_from_world_wxyz, model.images.translation_cam_from_world)


def _against(report: WitnessReport | None) -> BoolArray:
    if report is None or report.witness is None:
        raise ValueError("a witness was not asked")
    return np.array([disagrees(each, SETTINGS) for each in report.testimonies if each is not None])


def _has(report: WitnessReport | None, code: FindingCode) -> bool:
    return report is not None and any(finding.code is code for finding in report.findings)


def _count(counts: Counts, name: str, what: BoolArray | Sequence[bool]) -> None:
    counts.setdefault(name, Count()).add(what)


def _reference(scene: Scene, rng: np.random.Generator) -> ReferencePoses:
    """The truth with errors, in another world."""
    n = len(scene.model.images)
    turns = Rotation.from_rotvec(np.radians(rng.normal(0, ROTATION_SD_DEG, (n, 3)))).as_matrix()
    world = Rotation.random(random_state=int(rng.integers(1 << 30))).as_matrix()
    centre = scene.truth.centre + rng.normal(0, CENTRE_SD * scene.depth, (n, 3))
    return ReferencePoses("reference", turns @ scene.truth.rotation @ world.T, 3.0 * centre @ world.T, is_metric=True)


def _references(scene: Scene, rng: np.random.Generator, false: Counts, found: Counts) -> None:
    reference = _reference(scene, rng)
    report = ask_reference(scene.asked(reference=reference))
    _count(false, "reference, images", _against(report))
    _count(false, "reference, models with drift", [_has(report, FindingCode.REFERENCE_DRIFT)])
    _count(false, "reference, models with fragments", [_has(report, FindingCode.REFERENCE_FRAGMENTS)])
    n = len(scene.model.images)
    for name, (turn_deg, shift) in MOVES.items():
        for image_idx in rng.permutation(n)[:6].tolist():
            way = rng.normal(size=3)
            way /= np.linalg.norm(way)
            rotation, centre = reference.rotation.copy(), reference.centre.copy()
            rotation[image_idx] = Rotation.from_rotvec(np.radians(turn_deg) * way).as_matrix() @ rotation[image_idx]
            centre[image_idx] += 3.0 * shift * scene.depth * way
            against = _against(
                ask_reference(scene.asked(reference=replace(reference, rotation=rotation, centre=centre)))
            )
            _count(found, name, [against[image_idx]])
            _count(false, "reference, other images then", np.delete(against, image_idx))
    order = np.array(natural_order(scene.model.images.name))
    part = order[: n // 3]
    turn = Rotation.from_rotvec([0.0, 0.3, 0.0]).as_matrix()
    rotation, centre = reference.rotation.copy(), reference.centre.copy()
    rotation[part], centre[part] = rotation[part] @ turn.T, centre[part] @ turn.T
    moved = ask_reference(scene.asked(reference=replace(reference, rotation=rotation, centre=centre)))
    _count(found, "fragment", [_has(moved, FindingCode.REFERENCE_FRAGMENTS)])
    bow = np.zeros((n, 3))
    bow[order, 2] = 0.2 * scene.depth * np.sin(np.linspace(0, 2 * np.pi, n))
    bent = ask_reference(scene.asked(reference=replace(reference, centre=reference.centre + bow)))
    _count(found, "bow", [_has(bent, FindingCode.REFERENCE_DRIFT)])


def _priors(scene: Scene, rng: np.random.Generator, false: Counts, found: Counts, *, num: int) -> None:
    n = len(scene.model.images)
    order = np.array(natural_order(scene.model.images.name))
    for k in range(num):
        sd = PRIOR_SDS[k % len(PRIOR_SDS)] * scene.depth * np.array([1.0, 1.0, 2.0])
        noise = rng.normal(size=(n, 3)) * sd
        said = np.tile(np.diag(sd**2), (n, 1, 1))
        priors = PositionPriors("priors", 3.0 * (scene.truth.centre + noise), 9.0 * said, is_metric=True)
        report = ask_priors(scene.asked(priors=priors))
        _count(false, "priors, images", _against(report))
        _count(false, "priors, models with drift", [_has(report, FindingCode.PRIORS_DRIFT)])
        _count(false, "priors, models with spread", [_has(report, FindingCode.PRIORS_SPREAD)])
        for name, covariance in (("3 times too small", said), ("lacking", np.full_like(said, np.nan))):
            other = ask_priors(scene.asked(priors=replace(priors, covariance=covariance)))
            _count(false, f"priors, covariances {name}, images", _against(other))
            if name != "lacking":
                _count(found, f"covariances {name}", [_has(other, FindingCode.PRIORS_SPREAD)])
        for offset in OFFSETS:
            image_idx = int(rng.integers(n))
            position = priors.position.copy()
            way = rng.normal(size=3)
            position[image_idx] += 3.0 * offset * sd * way / np.linalg.norm(way)
            against = _against(ask_priors(scene.asked(priors=replace(priors, position=position))))
            _count(found, f"off by {offset:.0f} sd", [against[image_idx]])
            _count(false, "priors, other images then", np.delete(against, image_idx))
        wander = np.zeros((n, 3))
        wander[order] = _autoregressive(rng, n, 0.9) * sd
        drifting = ask_priors(scene.asked(priors=replace(priors, position=3.0 * (scene.truth.centre + wander))))
        _count(found, "wandering", [_has(drifting, FindingCode.PRIORS_DRIFT)])


def _autoregressive(rng: np.random.Generator, n: int, memory: float) -> FloatArray:
    """(n, 3) of unit variance, each the one before times ``memory`` and something new."""
    out = rng.normal(size=(n, 3))
    for i in range(1, n):
        out[i] = memory * out[i - 1] + np.sqrt(1 - memory**2) * out[i]
    return out


def _real(pairs: Sequence[str]) -> Counts:
    """Models of real photos beside a reference, and with single cameras moved."""
    counts = Counts()
    rng = np.random.default_rng(19)
    for pair in pairs:
        location, _, named = pair.partition("=")
        model = open_model(location)
        reference = reference_of(model, named, "", "")
        if isinstance(reference, NotAsked):
            print(f"left out: {reference.reason}", file=sys.stderr)
            continue
        healthy = _healthy(Path(location), model)
        evidence = Scene(model, ModelAuditor(model), _poses(model)).asked(reference=reference)
        report = ask_reference(evidence)
        if report is None or report.witness is None:
            print(f"left out: {location}: {report.findings[0].text if report else ''}", file=sys.stderr)
            continue
        asked = np.array([each is not None for each in report.testimonies])
        against = np.array([each is not None and disagrees(each, SETTINGS) for each in report.testimonies])
        scores = np.array([np.nan if each is None else each.score for each in report.testimonies])
        name = Path(named).stem
        _count(counts, f"{name}: healthy images", against[asked & healthy])
        drift = next((f.text for f in report.findings if f.code is FindingCode.REFERENCE_DRIFT), "no drift")
        print(f"{location}: largest score of healthy images {np.nanmax(scores[healthy]):.2f} limits; {drift}")
        for move, (turn_deg, shift) in MOVES.items():
            for image_idx in rng.permutation(np.flatnonzero(asked & healthy))[:6].tolist():
                moved = _moved(
                    reference, evidence.median_depth * _scale(model, reference), image_idx, (turn_deg, shift), rng
                )
                said = ask_reference(replace_reference(evidence, moved))
                if said is not None and said.witness is not None:
                    found = said.testimonies[image_idx]
                    _count(counts, f"{name}: {move}", [found is not None and disagrees(found, SETTINGS)])
    return counts


def replace_reference(evidence: Evidence, reference: ReferencePoses) -> Evidence:
    """Return the same evidence with another reference."""
    return Evidence(evidence.model, evidence.residuals, evidence.sigma_px, None, reference)


def _scale(model: SparseModel, reference: ReferencePoses) -> float:
    """Return the size of the reference / that of the model, from their spread; near enough to move a camera by."""
    known = np.isfinite(reference.centre).all(axis=1)
    own, other = _poses(model).centre[known], reference.centre[known]
    return float(
        np.median(np.linalg.norm(np.diff(other, axis=0), axis=1) / np.linalg.norm(np.diff(own, axis=0), axis=1))
    )


def _moved(
    reference: ReferencePoses, depth: float, image_idx: int, move: tuple[float, float], rng: np.random.Generator
) -> ReferencePoses:
    way = rng.normal(size=3)
    way /= np.linalg.norm(way)
    rotation, centre = reference.rotation.copy(), reference.centre.copy()
    rotation[image_idx] = Rotation.from_rotvec(np.radians(move[0]) * way).as_matrix() @ rotation[image_idx]
    centre[image_idx] += move[1] * depth * way
    return replace(reference, rotation=rotation, centre=centre)


def _healthy(folder: Path, model: SparseModel) -> BoolArray:
    """Which images nothing was planted in; all without a truth.json."""
    above = (parent / "truth.json" for parent in folder.absolute().parents[:2])
    path = next((each for each in above if each.exists()), None)
    if path is None:
        return np.ones(len(model.images), dtype=bool)
    labels = json.loads(path.read_text(encoding="utf-8"))["images"]
    return np.array([labels.get(name, {}).get("label", "healthy") == "healthy" for name in model.images.name])


def _against_truth(folder: Path) -> Counts:
    """Errors of images against known cameras, by their label."""
    counts = Counts()
    for path in sorted(folder.glob("*/truth.json")):
        for image in json.loads(path.read_text(encoding="utf-8"))["images"].values():
            truth = image.get("truth")
            if truth:
                said = statement(truth["centre_rel"], truth["rot_deg"], "")
                _count(counts, image["label"], [disagrees(said, SETTINGS)])
    return counts


def _in_band(false: Counts, found: Counts) -> int:
    """Return 1 where size or power left the bands."""
    wrong = []
    for name, count in false.items():
        limit = MAX_FALSE_FINDINGS if "models" in name else MAX_FALSE_SHARE
        if count.share > limit:
            wrong.append(f"{name}: {count}, at most {limit:.0%}")
    wrong += [
        f"{name}: {found[name]}, at least {least:.0%}" for name, least in MIN_POWER.items() if found[name].share < least
    ]
    print("\n".join(f"out of band: {each}" for each in wrong), end="\n" if wrong else "")
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
