"""What is the matter with a model, and what is to be done first? From the verdicts of its images, a diagnosis each.

Every image that is not accepted belongs to one diagnosis: the most urgent one that its reasons allow.
"""

from __future__ import annotations

import math
import shlex
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

from sfm_audit.audit.decision.rejections import REJECTING_CODES
from sfm_audit.audit.table.diagnoses import DIAGNOSES, Diagnosis, DiagnosisCode
from sfm_audit.audit.table.words import (
    GROUP_MEANINGS,
    MISFIT_CODES,
    SEVERITY_ORDER,
    WITNESS_CODES,
    ReasonCode,
    Verdict,
)

Row = Mapping[str, Any]
_Key = tuple[DiagnosisCode, int | None, str | None]  # code, camera_id, advice: what images of one diagnosis share

IMAGE_COLUMNS: Final = (
    *("image_name", "camera_id", "verdict", "severity", "reasons", "misfit_group", "misfit_px"),
    "advised_camera_model",
)
CAMERA_COLUMNS: Final = (
    *("camera_id", "camera_model", "num_images", "misfit_material", "misfit_group", "misfit_px"),
    "advised_camera_model",
)
MAX_EXAMPLES: Final = 2
_NONE: Final = "none"  # how an advice begins that no larger model holds it
_IMPLAUSIBLE: Final = frozenset(
    {ReasonCode.FOCAL_OUT_OF_RANGE, ReasonCode.DISTORTION_FOLDS, ReasonCode.PRINCIPAL_POINT_OUTSIDE}
)
_STEPS: Final = (ReasonCode.POSE_NOT_OPTIMAL, ReasonCode.CAMERA_NOT_OPTIMAL)
_ORDER: Final = {code: rank for rank, code in enumerate(DiagnosisCode)}


def triage(
    images: Sequence[Row], cameras: Iterable[Row], model_path: str, *, parts_disagree: bool = False
) -> list[Diagnosis]:
    """Return the diagnoses of a model, the most urgent first; elements of the column ``diagnoses`` of the models table.

    Parameters
    ----------
    images, cameras : rows with ``IMAGE_COLUMNS``, ``CAMERA_COLUMNS``            model_path : for the commands to copy
    parts_disagree : the model has this finding: every rejection is about that, whatever its reasons are

    Notes
    -----
    A diagnosis is about one camera where the camera as a whole is at fault, else about all images that share it. Two
    images of the model are named as examples: the worst of the most urgent diagnosis.
    """
    by_id = {row["camera_id"]: row for row in cameras}
    groups: dict[_Key, list[Row]] = {}
    for row in images:
        code = _code_of(row, by_id.get(row["camera_id"]))
        if parts_disagree and row["verdict"] == Verdict.REJECTED:
            code = DiagnosisCode.PARTS_DISAGREE
        if code is not None:
            groups.setdefault(_key(code, row, by_id), []).append(row)
    if not groups:
        accepted = [row for row in images if row["verdict"] == Verdict.ACCEPTED]
        groups = {(DiagnosisCode.SOUND, None, None): accepted} if accepted else {}
    ordered = sorted(groups.items(), key=lambda item: (_ORDER[item[0][0]], -len(item[1]), str(item[0][1:])))
    found = [_diagnosis(key, rows, by_id, model_path) for key, rows in ordered]
    if not found or found[0].code is DiagnosisCode.SOUND:
        return found
    worst = sorted(ordered[0][1], key=_badness)[:MAX_EXAMPLES]
    return [replace(found[0], examples=tuple(row["image_name"] for row in worst)), *found[1:]]


def _code_of(row: Row, camera: Row | None) -> DiagnosisCode | None:
    """Return the most urgent diagnosis that the reasons of an image allow; None for an accepted one."""
    codes = [said.partition(":")[0] for said in row["reasons"] or ()]
    if row["verdict"] == Verdict.ACCEPTED:
        return None
    if set(codes) & {ReasonCode.INCONSISTENT, ReasonCode.POINTS_BEHIND}:
        return DiagnosisCode.PARTS_DISAGREE
    if set(codes) & set(WITNESS_CODES.values()):
        return DiagnosisCode.WITNESSES_DISAGREE
    if row["verdict"] == Verdict.REJECTED:
        return _code_of_rejected(row, codes, camera)
    return _code_of_undetermined(codes)


def _code_of_undetermined(codes: Sequence[str]) -> DiagnosisCode | None:
    if set(codes) & set(REJECTING_CODES):
        return None  # a rejection that does not count (audit.decision.rejections)
    if ReasonCode.EXACT_PROJECTIONS in codes:
        return DiagnosisCode.NOT_MEASURED
    return DiagnosisCode.FOCAL_UNKNOWN if ReasonCode.FOCAL_NOT_IDENTIFIED in codes else DiagnosisCode.TOO_LITTLE


def _code_of_rejected(row: Row, codes: Sequence[str], camera: Row | None) -> DiagnosisCode:
    if set(codes) & _IMPLAUSIBLE:
        return DiagnosisCode.IMPLAUSIBLE_CAMERAS
    step = next((code for code in codes if code in _STEPS), None)  # the order of reasons says which comes first
    if step is not None:
        return DiagnosisCode.POSES_MOVED if step == ReasonCode.POSE_NOT_OPTIMAL else DiagnosisCode.CAMERA_FROZEN
    if not set(codes) & {*MISFIT_CODES.values(), ReasonCode.SHARED_CAMERA}:
        return DiagnosisCode.NOISE_ONLY
    if camera is not None and camera["num_images"] > 1 and camera["misfit_material"]:
        return DiagnosisCode.SHARED_LENS if _model_of(camera) else DiagnosisCode.SHARED_FIELD
    return DiagnosisCode.OWN_LENSES if _model_of(row) else DiagnosisCode.OWN_FIELDS


def _model_of(row: Row) -> str | None:
    """Return the camera model that is advised; None where none is, or none holds what was found."""
    advice = row["advised_camera_model"]
    return None if advice is None or advice.startswith(_NONE) else str(advice)


def _key(code: DiagnosisCode, row: Row, cameras: Mapping[int, Row]) -> _Key:
    """Return what images must share to be of one diagnosis: its code, and the camera or the advice."""
    if code in {DiagnosisCode.SHARED_LENS, DiagnosisCode.SHARED_FIELD}:
        return code, row["camera_id"], _model_of(cameras[row["camera_id"]])
    if code is DiagnosisCode.CAMERA_FROZEN and cameras.get(row["camera_id"], {"num_images": 1})["num_images"] > 1:
        return code, row["camera_id"], None
    return code, None, _model_of(row) if code is DiagnosisCode.OWN_LENSES else None


def _badness(row: Row) -> tuple[int, float, str]:
    severity = SEVERITY_ORDER.get(row["severity"], len(SEVERITY_ORDER))
    return severity, -_number(row["misfit_px"]), row["image_name"]


def _number(value: float | None) -> float:
    return 0.0 if value is None or math.isnan(value) else float(value)


def _diagnosis(key: _Key, rows: Sequence[Row], cameras: Mapping[int, Row], model_path: str) -> Diagnosis:
    code, camera_id, advice = key
    words = DIAGNOSES[code]
    camera = None if camera_id is None else cameras.get(camera_id)
    return Diagnosis(
        code,
        camera_id,
        min((row["severity"] for row in rows), key=lambda each: SEVERITY_ORDER.get(each, len(SEVERITY_ORDER))),
        len(rows),
        (),
        f"{words.meaning}{_details(code, rows, camera)}",
        words.action.format(camera=camera_id, advice=advice),
        words.command.replace("{MODEL}", shlex.quote(model_path)),
    )


def _details(code: DiagnosisCode, rows: Sequence[Row], camera: Row | None) -> str:
    """Say which term, parameter or field it is, as far as the tables know."""
    if camera is not None and code in {DiagnosisCode.SHARED_LENS, DiagnosisCode.SHARED_FIELD}:
        field = GROUP_MEANINGS.get(camera["misfit_group"], "no named field")
        said = f"{field} {_number(camera['misfit_px']):.2f} px in all its images"
        return f" (camera {camera['camera_id']}, {camera['camera_model']}, {camera['num_images']} images): {said}"
    if code is DiagnosisCode.CAMERA_FROZEN:
        texts = Counter(_text_of(row, ReasonCode.CAMERA_NOT_OPTIMAL) for row in rows)
        return f": {texts.most_common(1)[0][0]}"
    if code is DiagnosisCode.WITNESSES_DISAGREE:
        against = Counter(reason.partition(":")[0] for row in rows for reason in row["reasons"])
        told = [f"{witness} {against[reason]}" for witness, reason in WITNESS_CODES.items() if against[reason]]
        return f" ({', '.join(told)})"
    if code in {DiagnosisCode.OWN_LENSES, DiagnosisCode.OWN_FIELDS}:
        named = Counter(row["misfit_group"] for row in rows if row["misfit_group"])
        return f" ({', '.join(f'{group} {count}' for group, count in named.most_common(3))})" if named else ""
    return ""


def _text_of(row: Row, code: ReasonCode) -> str:
    return next((said.partition(":")[2].strip() for said in row["reasons"] if said.partition(":")[0] == code), "")
