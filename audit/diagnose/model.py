"""One model diagnosed: evidence from its residuals, a control refit, and refits with larger camera models."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from sfm_audit.audit.diagnose.evidence import evidence
from sfm_audit.audit.diagnose.reading import conclusion, helps, readings, refit_reading
from sfm_audit.audit.diagnose.refit import LARGER, Refit, candidates, refit
from sfm_audit.audit.diagnose.summary import COLUMNS, summary_numbers
from sfm_audit.audit.engine.model import ModelAuditor
from sfm_audit.audit.table.diagnoses import DiagnosisCode
from sfm_audit.audit.table.words import Member, Verdict
from sfm_audit.loaders.camera_models import BY_NAME

Row = Mapping[str, Any]

IMAGE_COLUMNS: Final = (*COLUMNS, "advised_camera_model", "camera_id")
MAX_ADVISED: Final = 2
MEASURED_PX: Final = 1e-3
"""Noise below it is no measurement but the rounding of numbers."""
NOT_READ: Final = (
    "Not read: where poses or parts do not hold, or nothing was measured, residuals tell nothing of a lens."
)
UNFIT: Final = frozenset({str(DiagnosisCode.PARTS_DISAGREE), str(DiagnosisCode.NOT_MEASURED)})
"""Nothing is refitted where parts do not belong together or nothing was measured."""


@dataclass(frozen=True, slots=True, eq=False)
class ModelEvidence:
    """What was found out about a model.

    numbers: of `summary_numbers` and `evidence`.    readings, refit_readings, conclusion: the same in sentences.
    refits: the control first; none where nothing was refitted.
    """

    numbers: Mapping[str, float]
    readings: Sequence[str]
    refits: Sequence[Refit]
    refit_readings: Sequence[str]
    conclusion: str


def diagnose_model(
    auditor: ModelAuditor,
    images: Sequence[Row],
    cameras: Iterable[Row],
    diagnoses: Iterable[str],
    *,
    refitted: bool = True,
    wanted: Sequence[str] = (),
    out: Path | None = None,
) -> ModelEvidence:
    """Find out why a model is judged as it is.

    Parameters
    ----------
    images, cameras : rows of the model's tables            diagnoses : codes of its diagnoses
    refitted : whether to adjust it again            wanted : camera models to try; none: by the advice
    out : folder for the model refitted as the one that is wanted
    """
    tables = summary_numbers(images)
    found = evidence(auditor)
    numbers = {**tables, **found}
    said = readings(tables, found)
    if UNFIT & set(diagnoses) or 2 * tables["rejected_pose"] > tables["images"] or not tables["sigma_px"] > MEASURED_PX:
        said = [NOT_READ]
    why_not = "Not refitted." if not refitted else _why_not(auditor, tables, diagnoses, is_wanted=bool(wanted))
    if why_not is not None:
        return ModelEvidence(numbers, said, (), (), why_not)
    control = refit(auditor.model, None, auditor.config)
    tried = _refits(auditor, control, tables, wanted or advised(images, cameras), is_wanted=bool(wanted), out=out)
    lines = [refit_reading(tables, control, each) for each in (control, *tried)]
    return ModelEvidence(numbers, said, (control, *tried), lines, conclusion(tables, control, tried))


def _why_not(
    auditor: ModelAuditor, tables: Mapping[str, float], diagnoses: Iterable[str], *, is_wanted: bool
) -> str | None:
    """Return why nothing is refitted; None where something is."""
    if not auditor.residuals.residuals_px.size:
        return "Not refitted: no image has an observation to adjust."
    if UNFIT & set(diagnoses):
        return "Not refitted: adjusting says nothing about such a model."
    if 2 * tables["rejected_plausible"] > tables["images"] and not is_wanted:
        return "Not refitted: most cameras are like none; fix their focal lengths first."
    return None


def _refits(
    auditor: ModelAuditor,
    control: Refit,
    tables: Mapping[str, float],
    names: Sequence[str],
    *,
    is_wanted: bool,
    out: Path | None,
) -> list[Refit]:
    """Refit as asked for or advised; if none of these helps, as the other larger camera models."""
    if not is_wanted and tables["rejected_misfit"] == 0:
        return []
    first = candidates(auditor.model, names)
    tried = [refit(auditor.model, name, auditor.config, out) for name in first]
    if is_wanted or any(helps(control, each) for each in tried):
        return tried
    others = [name for name in candidates(auditor.model, LARGER) if name not in first]
    present = {auditor.model.camera(i).model.name for i in range(len(auditor.model.cameras))}
    return [*tried, *(refit(auditor.model, name, auditor.config) for name in others if name not in present)]


def advised(images: Sequence[Row], cameras: Iterable[Row]) -> list[str]:
    """Return the camera models that the tables advise for what is wrong, of shared cameras first, the most frequent."""
    shared = [row["advised_camera_model"] for row in cameras if row["num_images"] > 1 and row["misfit_material"]]
    own = Counter(row["advised_camera_model"] for row in images if row[Member.MISFIT] == Verdict.REJECTED)
    names = [*shared, *(name for name, _ in own.most_common())]
    return list(dict.fromkeys(name for name in names if name in BY_NAME))[:MAX_ADVISED]
