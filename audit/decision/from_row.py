"""From a row of the images table to the numbers that decide: `audit.engine.rows`, backwards."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any, Final

from sfm_audit.audit.decision.diagnostics import (
    CameraDiagnostics,
    ConsistencyDiagnostics,
    Diagnostics,
    Gains,
    GroupDiagnostics,
    MisfitDiagnostics,
    NoiseDiagnostics,
    OwnDiagnostics,
    OwnStep,
    SharedMisfit,
    Worth,
)
from sfm_audit.audit.table.columns import own_parameter_names
from sfm_audit.audit.table.thresholds import SINGULAR_SHARE
from sfm_audit.audit.table.witnesses import Witness, WitnessStatement
from sfm_audit.audit.table.words import GROUPS, UNUSABLE, Member, MisfitGroup, MisfitStatus, Reason, ReasonCode
from sfm_audit.loaders.camera_models import BY_NAME, CameraModel

Row = Mapping[str, Any]

READ_COLUMNS: Final = (
    *("camera_model", "width", "height", "params", "num_inliers", "max_px", "coverage", "occupied_cells"),
    *("num_standardised", "ks_stat", "ks_p", "sigma_constant_px", "pose_offset_px", "focal_over_size", "folds_over"),
    *(f"misfit_{group}_{number}_joint" for group in GROUPS for number in ("px", "q", "rank")),
    *("num_misfit_tested", "misfit_details", "own_step_px", "own_num_images", "own_sigma_px", "own_implied"),
    *(f"own_{name}_{number}" for name in own_parameter_names() for number in ("step", "sd")),
    *("gain_pose", "gain_camera", "gain_both", "sd_focal_rel", "sd_k1", "singular_share", "half_pixel"),
    *(str(Member.CAMERA), "reason_details", "testimonies"),
)
"""All that `diagnostics_of_row` looks at."""


def number_of(value: float | None) -> float:
    """Return a number of a row, NaN where it is null."""
    return math.nan if value is None else float(value)


def diagnostics_of_row(row: Row) -> Diagnostics:
    """Return the numbers that decide about the image of this row; columns are ``READ_COLUMNS``.

    What stands in the way of all questions (a pose that is not finite) and what is known of the parts in words come
    from ``reason_details``: these reasons are there whatever the settings were.
    """
    reasons = [_reason(item) for item in row["reason_details"]]
    own = _own(row)
    return Diagnostics(
        num_inliers=row["num_inliers"],
        noise=NoiseDiagnostics(
            row["num_standardised"],
            2 * row["num_standardised"],
            number_of(row["ks_stat"]),
            number_of(row["ks_p"]),
            is_fitted=row["ks_p"] is not None,
        ),
        pose_offset_px=number_of(row["pose_offset_px"]),
        misfit=_misfit(row, _first(reasons, (ReasonCode.SHARED_CAMERA,))),
        camera=_camera(row, is_joint=own is not None),
        largest_residual_px=number_of(row["max_px"]),
        longer_side_px=max(row["width"] or 0, row["height"] or 0),
        unusable=_first(reasons, UNUSABLE),
        consistency=None if row[Member.CAMERA] is None else _consistency(reasons),
        own=own,
        has_own=row["folds_over"] is not None and bool(_own_names(BY_NAME[row["camera_model"]])),
        gains=_gains(row, own),
        half_pixel=row["half_pixel"],
        testimonies=_testimonies(row),
    )


def _testimonies(row: Row) -> tuple[WitnessStatement, ...] | None:
    """What the witnesses said of the image; None where none was asked."""
    if row["testimonies"] is None:
        return None
    return tuple(
        WitnessStatement(
            Witness(item["witness"]),
            number_of(item["score"]),
            number_of(item["limit"]),
            item["text"],
            number_of(item["q"]),
            item["unit"],
        )
        for item in row["testimonies"]
    )


def _reason(item: Mapping[str, Any]) -> Reason:
    """An element of ``reason_details``."""
    return Reason(
        ReasonCode(item["code"]),
        Member(item["verdict"]),
        item["text"],
        item["value"],
        item["limit"],
        item["unit"],
        None if item["group"] is None else MisfitGroup(item["group"]),
    )


def _first(reasons: Iterable[Reason], codes: Iterable[ReasonCode]) -> Reason | None:
    return next((reason for reason in reasons if reason.code in codes), None)


def _consistency(reasons: Iterable[Reason]) -> ConsistencyDiagnostics:
    """Whether the parts fit is asked before all else, and does not depend on settings."""
    behind, apart = _first(reasons, (ReasonCode.POINTS_BEHIND,)), _first(reasons, (ReasonCode.INCONSISTENT,))
    if behind is not None:
        return ConsistencyDiagnostics(None, behind.text, math.nan, all_behind=True)
    if apart is not None:
        return ConsistencyDiagnostics(inconsistent=True, text=apart.text, rms_px=number_of(apart.value))
    return ConsistencyDiagnostics(inconsistent=False, text="", rms_px=math.nan)


def _misfit(row: Row, shared: Reason | None) -> MisfitDiagnostics | None:
    """The tests of all groups; None without inliers."""
    if row["misfit_details"] is None:
        return None
    groups = {MisfitGroup(item["group"]): _group(row, item) for item in row["misfit_details"]}
    beside = None
    if shared is not None and shared.group is not None:
        beside = SharedMisfit(shared.group, number_of(shared.value), shared.text)
    return MisfitDiagnostics(groups, row["num_misfit_tested"], number_of(row["sigma_constant_px"]), beside)


def _group(row: Row, item: Mapping[str, Any]) -> GroupDiagnostics:
    name = f"misfit_{item['group']}"
    worth = Worth(*(number_of(item[f"worth_{what}"]) for what in ("deg", "centre", "focal_rel")))
    return GroupDiagnostics(
        number_of(row[f"{name}_q_joint"]),
        number_of(row[f"{name}_px_joint"]),
        -math.inf if item["gain"] is None else item["gain"],
        MisfitStatus(item["status"]),
        row[f"{name}_rank_joint"],
        worth,
    )


def _camera(row: Row, *, is_joint: bool) -> CameraDiagnostics | None:
    """The numbers of the camera; None without inliers."""
    if row["folds_over"] is None:
        return None
    model: CameraModel = BY_NAME[row["camera_model"]]
    params, share = row["params"], number_of(row["singular_share"])
    sd_focal_rel, has_focal = number_of(row["sd_focal_rel"]), bool(model.focal_idxs)
    lost = is_joint and has_focal and math.isnan(sd_focal_rel)
    centre = model.principal_point_idxs
    return CameraDiagnostics(
        focal_over_size=number_of(row["focal_over_size"]),
        folds_over=row["folds_over"],
        principal_point_px=(params[centre[0]], params[centre[1]]) if centre else None,
        size_px=(row["width"], row["height"]),
        coverage=number_of(row["coverage"]),
        occupied_cells=row["occupied_cells"],
        has_focal=has_focal,
        sd_focal_rel=sd_focal_rel,
        singular_share=share,
        is_singular=share <= SINGULAR_SHARE or lost,
        k1=params[model.extra_idxs[0]] if model.extra_idxs else None,
        sd_k1=number_of(row["sd_k1"]),
        is_joint=is_joint,
    )


def _own_names(model: CameraModel) -> tuple[str, ...]:
    """All parameters but the principal point; none of panoramas."""
    if model.is_spherical:
        return ()
    return tuple(name for i, name in enumerate(model.param_names) if i not in model.principal_point_idxs)


def _own(row: Row) -> OwnDiagnostics | None:
    """The joint steps of the camera's own parameters; None where the image takes no part in the joint system."""
    if row["own_num_images"] is None:
        return None
    model: CameraModel = BY_NAME[row["camera_model"]]
    stored = dict(zip(model.param_names, row["params"], strict=True))
    steps = tuple(
        OwnStep(name, stored[name], math.nan, number_of(row[f"own_{name}_step"]), number_of(row[f"own_{name}_sd"]))
        for name in _own_names(model)
    )
    own = OwnDiagnostics(number_of(row["own_step_px"]), number_of(row["own_sigma_px"]), row["own_num_images"], steps)
    implied = number_of(row["own_implied"])
    return replace(own, steps=tuple(replace(step, implied=implied) if step is own.largest else step for step in steps))


def _gains(row: Row, own: OwnDiagnostics | None) -> Gains | None:
    if own is None:
        return None
    return Gains(number_of(row["gain_pose"]), number_of(row["gain_camera"]), number_of(row["gain_both"]))
