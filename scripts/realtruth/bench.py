"""The models with ground truth: where they are, what is right, and what the audit says of each image."""

from __future__ import annotations

import json
import os
from collections.abc import Collection
from pathlib import Path
from typing import Any, Final

import pandas as pd
from tqdm import tqdm

from sfm_audit.audit import AuditConfig, audit_model
from sfm_audit.audit.table.words import POLICIES, MisfitGroup, Verdict, verdict_under
from sfm_audit.loaders import open_model

ROOT: Final = Path(__file__).resolve().parents[2]
QUICK_MODELS: Final = ("entry_C_srsh", "entry_H_srper", "fountain_P_pose", "fountain_P_rs_per")
CAUSES: Final[dict[str, frozenset[MisfitGroup]]] = {
    "k2": frozenset({MisfitGroup.RADIAL}),
    "tangential": frozenset({MisfitGroup.TANGENTIAL, MisfitGroup.PRINCIPAL_POINT}),
    "rs": frozenset({MisfitGroup.ROLLING_SHUTTER, MisfitGroup.AFFINE}),
    "smooth": frozenset({MisfitGroup.SMOOTH}),
}
"""What may be named for a planted kind: tangential and principal point span nearly the same fields."""


def bench_folder(given: Path | None) -> Path | None:
    """The folder given, else `realtruth` beside the corpus of the tests; None where it is not there."""
    corpus = Path(os.environ.get("SFM_AUDIT_CORPUS", str(ROOT.parent / "shared" / "corpus")))
    folder = corpus.parent / "realtruth" if given is None else given
    return folder if any(folder.glob("*/truth.json")) else None


def audit_bench(folder: Path, *, only: Collection[str] = (), excluded: Collection[str] = ()) -> pd.DataFrame:
    """Audit the models and return the images table with the truth beside it.

    Parameters
    ----------
    only : names of models; all of them when empty        excluded : scenes to leave out

    Returns
    -------
    pandas.DataFrame
        One row per image that the truth names. ``planted_px``: RMS of the planted field that the image's own pose and
        intrinsics do not take up; of a moved pose its pose_offset_px. ``model``, ``bench_scene``, ``label``, ``kind``,
        ``focal_rel``, ``gt_px``: of the truth. ``beside_planted``: the model has planted images or a wrong camera.
        ``under_<policy>``: its verdict. ``findings``: codes of the model's findings. All else: the audit's columns.
    """
    parts = []
    for path in tqdm(sorted(path.parent for path in folder.glob("*/truth.json")), disable=None):
        truth = json.loads((path / "truth.json").read_text(encoding="utf-8"))
        if (not only or path.name in only) and truth["scene"] not in excluded:
            parts.append(_audited(path, truth))
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame()


def _audited(path: Path, truth: dict[str, Any]) -> pd.DataFrame:
    tables = audit_model(open_model(path / "sparse" / "0"), AuditConfig())
    images = tables.images.to_pandas()
    images = images.assign(
        **{f"under_{policy}": [verdict_under(policy, row) for row in tables.images.to_pylist()] for policy in POLICIES}
    )
    images = images[images.image_name.isin(truth["images"])].reset_index(drop=True)
    known = [truth["images"][name] for name in images.image_name]
    errors = [one.get("truth") or {} for one in known]
    codes = frozenset(finding["code"] for finding in tables.models.to_pylist()[0]["findings"])
    wrong = any(one["label"] in {"defective", "absorbed"} for one in truth["images"].values())
    told = {
        "model": path.name,
        "bench_scene": truth["scene"],
        "label": [one["label"] for one in known],
        "kind": [one["kind"] for one in known],
        "planted_px": [
            float(offset if one["kind"] == "pose" else one["planted_px"])
            for one, offset in zip(known, images.pose_offset_px, strict=True)
        ],
        "focal_rel": [float(error.get("focal_rel", "nan")) for error in errors],
        "gt_px": [float(error.get("gt_px", "nan")) for error in errors],
        "beside_planted": wrong,
        "findings": [codes] * len(images),
    }
    return images.assign(**told)


def healthy(images: pd.DataFrame) -> pd.DataFrame:
    """Images of models in which nothing is planted."""
    return images[(images.label == "healthy") & ~images.beside_planted]


def neighbours(images: pd.DataFrame) -> pd.DataFrame:
    """Healthy images of models that have planted ones."""
    return images[(images.label == "healthy") & images.beside_planted]


def planted(images: pd.DataFrame) -> pd.DataFrame:
    """Images with a defect that somebody planted and that can be seen."""
    return images[images.label == "defective"]


def rejected(images: pd.DataFrame, *columns: str) -> pd.Series:
    """Whether any of these verdicts rejects."""
    return (images[list(columns)] == Verdict.REJECTED).any(axis=1)


def hit(images: pd.DataFrame) -> pd.Series:
    """Whether a member that looks at cameras and poses rejects: misfit, own parameters, or the pose."""
    return rejected(images, "verdict_misfit", "verdict_camera", "verdict_pose")
