"""A model's tables in a few numbers: medians over images, and how many of them each verdict rejects."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import numpy as np

from sfm_audit.audit.misfit import GROUPS
from sfm_audit.audit.table.words import Member, Verdict

COLUMNS: Final = (
    *("verdict", "sigma_constant_px", "ks_stat", "num_standardised", "kurtosis_excess", "kurtosis_constant"),
    *("mean_track_length", "focal_over_size", "pose_offset_px", "num_inliers", "num_unverifiable", "folds_over"),
    *("misfit_px", "misfit_group", *(str(member) for member in Member if member is not Member.OUTSIDE)),
    *(f"misfit_worth_{name}" for name in ("deg", "centre", "focal_rel")),
    *(f"misfit_{group}_px{kind}" for group in GROUPS for kind in ("", "_joint")),
)


def summary_numbers(rows: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Return medians over the images of a model, and counts by verdict and by named cause; NaN where none has a number.

    Parameters
    ----------
    rows : of the images table of one model, with ``COLUMNS``
    """
    columns = {name: [row[name] for row in rows] for name in COLUMNS}

    def median(name: str, of: Callable[[float], float] = float) -> float:
        return _median([of(value) for value in columns[name] if value is not None])

    numbers = {
        "images": float(len(rows)),
        "rejected": float(columns["verdict"].count(Verdict.REJECTED)),
        "sigma_px": median("sigma_constant_px"),
        "ks_distance": median("ks_stat"),
        "num_values": 2.0 * median("num_standardised"),
        "kurtosis": median("kurtosis_excess"),
        "kurtosis_constant": median("kurtosis_constant"),
        "track_length": median("mean_track_length"),
        "focal_over_size": median("focal_over_size"),
        "pose_offset_px": median("pose_offset_px"),
        "num_inliers": median("num_inliers"),
        "unverifiable": _median(
            [a / b for a, b in zip(columns["num_unverifiable"], columns["num_inliers"], strict=True) if b]
        ),
        "folds": float(sum(map(bool, columns["folds_over"]))),
        "misfit_px": median("misfit_px"),
        "undetermined_plausible": float(columns["plausible"].count(Verdict.UNDETERMINED)),
    }
    for member in (member for member in Member if member is not Member.OUTSIDE):
        numbers[f"rejected_{member.short}"] = float(columns[str(member)].count(Verdict.REJECTED))
    for name in ("deg", "centre", "focal_rel"):
        numbers[f"worth_{name}"] = median(f"misfit_worth_{name}", abs)
    for group in GROUPS:
        numbers[f"{group}_px"] = median(f"misfit_{group}_px")
        numbers[f"joint_{group}_px"] = median(f"misfit_{group}_px_joint")
        numbers[f"cause_{group}"] = float(columns["misfit_group"].count(group))
    return numbers


def _median(values: Sequence[Any]) -> float:
    finite = [value for value in values if not math.isnan(value)]
    return float(np.median(finite)) if finite else math.nan
