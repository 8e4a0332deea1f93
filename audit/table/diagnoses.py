"""The diagnoses that a model can get, and what to do about each: one record per diagnosis, in the order of urgency."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from sfm_audit.audit.table.types import INT64, TEXT, UINT32, list_of, struct_of


class DiagnosisCode(StrEnum):
    """What is the matter with a model, one of its cameras, or some of its images; the first is the most urgent."""

    PARTS_DISAGREE = "parts_disagree"
    WITNESSES_DISAGREE = "witnesses_disagree"
    IMPLAUSIBLE_CAMERAS = "implausible_cameras"
    POSES_MOVED = "poses_moved"
    CAMERA_FROZEN = "camera_frozen"
    SHARED_LENS = "shared_lens"
    SHARED_FIELD = "shared_field"
    OWN_LENSES = "own_lenses"
    OWN_FIELDS = "own_fields"
    NOISE_ONLY = "noise_only"
    NOT_MEASURED = "not_measured"
    FOCAL_UNKNOWN = "focal_unknown"
    TOO_LITTLE = "too_little"
    SOUND = "sound"


@dataclass(frozen=True, slots=True)
class DiagnosisWords:
    """meaning: what is the matter.    action: one thing to do.    command: to copy; {MODEL} and RUN are replaced.

    ``action`` may name {advice}, ``command`` {camera} too.
    """

    meaning: str
    action: str
    command: str


_ADJUST: Final = "colmap bundle_adjuster --input_path {MODEL} --output_path ADJUSTED"
_DIAGNOSE: Final = "sfm-audit diagnose RUN {MODEL}"

DIAGNOSES: Final[dict[DiagnosisCode, DiagnosisWords]] = {
    DiagnosisCode.PARTS_DISAGREE: DiagnosisWords(
        "poses, points, cameras and 2D points do not belong together",
        "do not use; repair the converter that wrote the model",
        "sfm-audit explain-code inconsistent",
    ),
    DiagnosisCode.WITNESSES_DISAGREE: DiagnosisWords(
        "witnesses outside of the images contradict their places",
        "look at these images before anything else is believed",
        "sfm-audit filter RUN --keep accepted --list kept.txt",
    ),
    DiagnosisCode.IMPLAUSIBLE_CAMERAS: DiagnosisWords(
        "cameras that no camera is like (focal length, fold or principal point)",
        "fix their focal length from EXIF or a calibration and reconstruct again; until then leave them out",
        "sfm-audit filter RUN --list kept.txt",
    ),
    DiagnosisCode.POSES_MOVED: DiagnosisWords(
        "poses are not where their own points want them: changed, rounded or not adjusted afterwards",
        "run bundle adjustment over the whole model and audit again",
        _ADJUST,
    ),
    DiagnosisCode.CAMERA_FROZEN: DiagnosisWords(
        "cameras were frozen at a wrong value",
        "run bundle adjustment with it free and audit again",
        f"{_ADJUST} --BundleAdjustment.refine_focal_length 1 --BundleAdjustment.refine_extra_params 1",
    ),
    DiagnosisCode.SHARED_LENS: DiagnosisWords(
        "the shared lens lacks a term",
        "refit camera {camera} as {advice}; diagnose tries it and says what remains",
        _DIAGNOSE,
    ),
    DiagnosisCode.SHARED_FIELD: DiagnosisWords(
        "all images of a camera share a field that no larger camera model was seen to hold",
        "compare refits; if none holds it, use a calibration of this lens or another solver's model",
        _DIAGNOSE,
    ),
    DiagnosisCode.OWN_LENSES: DiagnosisWords(
        "lenses of single images lack a term",
        "refit them as {advice}; diagnose tries it and says what remains",
        _DIAGNOSE,
    ),
    DiagnosisCode.OWN_FIELDS: DiagnosisWords(
        "images carry smooth fields of their own that no lens holds: motion while rows are read, or misplaced surfaces",
        "leave these images out where the pose matters; diagnose tells motion from surfaces as far as data can",
        _DIAGNOSE,
    ),
    DiagnosisCode.NOISE_ONLY: DiagnosisWords(
        "only the noise is another one; nothing speaks against the cameras",
        "keep",
        "sfm-audit filter RUN --policy camera --list kept.txt",
    ),
    DiagnosisCode.NOT_MEASURED: DiagnosisWords(
        "2D points are projections, not measurements",
        "audit the model that holds the detected keypoints",
        "sfm-audit explain-code exact_projections",
    ),
    DiagnosisCode.FOCAL_UNKNOWN: DiagnosisWords(
        "the points do not fix the focal length",
        "share one camera among photos of the same device and zoom, or fix the focal length from EXIF",
        f"{_ADJUST} --BundleAdjustment.refine_focal_length 0",
    ),
    DiagnosisCode.TOO_LITTLE: DiagnosisWords(
        "these images say too little about themselves",
        "match them against more neighbours, or leave them out",
        "sfm-audit filter RUN --keep accepted --list kept.txt",
    ),
    DiagnosisCode.SOUND: DiagnosisWords(
        "nothing speaks against the model",
        "use it",
        "sfm-audit filter RUN --list kept.txt",
    ),
}


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """One diagnosis of a model, an element of the column ``diagnoses``.

    camera_id: None where it is not about one camera.    severity: the worst of its images, None where none is rejected.
    examples: names of images, two per model.    command: RUN in it stands for the run folder.
    """

    code: DiagnosisCode
    camera_id: int | None
    severity: str | None
    num_images: int
    examples: tuple[str, ...]
    text: str
    action: str
    command: str


DIAGNOSIS: Final = struct_of(
    code=TEXT,
    camera_id=UINT32,
    severity=TEXT,
    num_images=INT64,
    examples=list_of(TEXT),
    text=TEXT,
    action=TEXT,
    command=TEXT,
)
"""A `Diagnosis` as the table has it."""
