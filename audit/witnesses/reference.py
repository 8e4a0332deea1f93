"""Is every image where a reference has it? After one robust similarity for the whole model (method.md section 13).

The score of an image is the larger of its two shares of the limits: centre in median depths, rotation in degrees.
Blind to what the similarity takes up: global scale, place and turn; and to errors of the reference itself.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from sfm_audit.audit.alignment import PoseComparison, Poses, align, compare_poses, natural_order, usable_poses
from sfm_audit.audit.table.thresholds import MAX_REFERENCE_CENTRE, MAX_REFERENCE_ROTATION_DEG, MIN_DRIFT
from sfm_audit.audit.table.witnesses import Witness, WitnessStatement
from sfm_audit.audit.witnesses.evidence import ColumnValues, Evidence, WitnessReport
from sfm_audit.audit.witnesses.sequence import shared_rms, smoothness_p
from sfm_audit.loaders.arrays import FloatArray, IntArray
from sfm_audit.loaders.evidence import NotAsked, ReferencePoses
from sfm_audit.loaders.model import Finding, FindingCode, SparseModel

COLUMNS: Final = ("reference_centre_error", "reference_centre_rel", "reference_rotation_deg")
LEVEL: Final = 0.01  # of the findings about drift
_SHOWN: Final = 3


def ask_reference(evidence: Evidence) -> WitnessReport | None:
    """Ask the reference; None where none was given."""
    reference = evidence.reference
    if reference is None:
        return None
    if isinstance(reference, NotAsked):
        return _silent(evidence.model, reference.reason)
    images = evidence.model.images
    quats, shifts = images.quat_cam_from_world_wxyz, images.translation_cam_from_world
    known = usable_poses(quats, shifts) & np.isfinite(reference.centre).all(axis=1)
    rows = np.array([i for i in natural_order(images.name) if known[i]], dtype=np.int64)
    if not evidence.median_depth > 0 or len(rows) < 3:
        return _silent(evidence.model, f"{reference.location}: it has {len(rows)} images of the model, 3 are needed")
    own = Poses.of(quats[rows], shifts[rows])
    theirs = Poses(reference.rotation[rows], reference.centre[rows])
    found = compare_poses(own, theirs, evidence.median_depth)
    follow = 0 if found is None else int(found.main.sum()) + sum(len(each.image_idxs) for each in found.fragments)
    if found is None or 2 * follow < len(rows):
        text = f"{follow or 'no 3'} of {len(rows)} images lie to each other as there"
        hint = _convention(own, theirs, evidence.median_depth)
        return _silent(evidence.model, f"{reference.location}: {text}{hint}")
    return _report(evidence, reference, rows, found)


def _convention(own: Poses, theirs: Poses, unit: float) -> str:
    """Return under which other convention most images would follow the reference, if there is one; or nothing."""
    back = theirs.rotation.transpose(0, 2, 1)
    others = (
        (
            "if its poses were inverted: camera from world and world from camera are mixed up",
            Poses(back, -np.einsum("nij,nj->ni", theirs.rotation, theirs.centre)),
        ),
        ("with its rotations inverted", Poses(back, theirs.centre)),
        (
            "with cameras that look along -z and have y upwards (OpenGL's axes)",
            Poses(np.diag([1.0, -1.0, -1.0]) @ theirs.rotation, theirs.centre),
        ),
    )
    for text, poses in others:
        found = align(own, poses, unit)
        follow = 0 if found is None else np.count_nonzero(found.supports)
        if 2 * follow > len(own):
            return f"; {follow} would {text}"
    return ""


def _silent(model: SparseModel, reason: str) -> WitnessReport:
    columns: dict[str, ColumnValues] = {name: np.full(len(model.images), np.nan) for name in COLUMNS}
    columns["reference_fragment"] = (None,) * len(model.images)
    return WitnessReport(None, columns=columns, findings=(Finding(FindingCode.REFERENCE_NOT_USED, 1, reason),))


def _report(evidence: Evidence, reference: ReferencePoses, rows: IntArray, found: PoseComparison) -> WitnessReport:
    num_images = len(evidence.model.images)
    per_unit = evidence.median_depth * found.alignment.similarity.scale
    values = found.centre_error * per_unit, found.centre_error, found.rotation_deg
    columns: dict[str, ColumnValues] = {
        name: _spread_out(value, rows, num_images) for name, value in zip(COLUMNS, values, strict=True)
    }
    columns["reference_fragment"] = _fragments(found, rows, num_images)
    unit = "m" if reference.is_metric else "units of the reference"
    said: list[WitnessStatement | None] = [None] * num_images
    for k, image_idx in enumerate(rows.tolist()):
        said[image_idx] = statement(found.centre_error[k], found.rotation_deg[k], f"{values[0][k]:.3g} {unit}")
    findings = tuple(_findings(evidence, reference, rows, found))
    return WitnessReport(Witness.REFERENCE, tuple(said), columns, findings)


def statement(centre_rel: float, rotation_deg: float, length: str) -> WitnessStatement:
    """Return what the reference says of an image: the larger share of its two limits."""
    score = max(centre_rel / MAX_REFERENCE_CENTRE, rotation_deg / MAX_REFERENCE_ROTATION_DEG)
    text = f"its centre is {length} ({centre_rel:.3g} median depths) and its rotation {rotation_deg:.2g} degrees off"
    return WitnessStatement(Witness.REFERENCE, float(score), 1.0, text, unit="limits")


def _spread_out(values: FloatArray, rows: IntArray, num: int) -> FloatArray:
    out = np.full(num, np.nan)
    out[rows] = values
    return out


def _fragments(found: PoseComparison, rows: IntArray, num: int) -> tuple[int | None, ...]:
    """0 for the main group, 1.. for fragments by size; None for images that moved alone or are not known."""
    out: list[int | None] = [None] * num
    for k in np.flatnonzero(found.main).tolist():
        out[int(rows[k])] = 0
    for number, fragment in enumerate(found.fragments, start=1):
        for k in fragment.image_idxs.tolist():
            out[int(rows[k])] = number
    return tuple(out)


def _findings(
    evidence: Evidence, reference: ReferencePoses, rows: IntArray, found: PoseComparison
) -> Iterator[Finding]:
    scale = found.alignment.similarity.scale
    if reference.is_metric:
        sd = _sd_of_scale(evidence, rows, found)
        text = f"a unit of the model is {scale:.4g} m of {reference.location} (sd {100 * sd / scale:.2g} %)"
        yield Finding(FindingCode.REFERENCE_SCALE, 1, text)
    errors = found.alignment.centre[found.main]
    drift = shared_rms(errors)
    if drift > MIN_DRIFT and smoothness_p(errors) < LEVEL:
        length = f"{drift * evidence.median_depth * scale:.3g} {'m' if reference.is_metric else 'of its units'}"
        text = f"neighbours in the sequence share {length} RMS of their distance from {reference.location}"
        yield Finding(FindingCode.REFERENCE_DRIFT, int(found.main.sum()), f"{text} ({drift:.2g} median depths)")
    if found.fragments:
        names = evidence.model.images.name
        said = [
            f"{len(each.image_idxs)} images ({', '.join(names[int(rows[k])] for k in each.image_idxs[:_SHOWN])}"
            f"{', ...' if len(each.image_idxs) > _SHOWN else ''}) by {each.shift:.2g} median depths and "
            f"{each.turn_deg:.2g} degrees, {each.stretch:.3g} times as large"
            for each in found.fragments[:_SHOWN]
        ]
        yield Finding(FindingCode.REFERENCE_FRAGMENTS, len(found.fragments), f"moved together: {'; '.join(said)}")


def _sd_of_scale(evidence: Evidence, rows: IntArray, found: PoseComparison) -> float:
    """Return the sd of the scale if the errors of the centres in the main group are independent."""
    images = evidence.model.images
    poses = Poses.of(images.quat_cam_from_world_wxyz[rows], images.translation_cam_from_world[rows])
    inside = found.alignment.supports
    spread = float(((poses.centre[inside] - poses.centre[inside].mean(axis=0)) ** 2).sum())
    errors = found.alignment.centre[inside] * evidence.median_depth
    sd = np.sqrt((errors**2).mean() / spread) if spread > 0 else np.nan
    return float(sd * found.alignment.similarity.scale)
