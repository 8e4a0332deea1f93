"""Decide a finished run again: from the columns of its images table to the verdicts under other settings.

Nothing is measured again: numbers are those of the run, and what could not be told then (a misfit that was not tested
because the pose was wrong) cannot be told now.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np
import pyarrow as pa

from sfm_audit.audit.config import AuditConfig
from sfm_audit.audit.decision.columns import CAUSE_COLUMNS, VERDICT_COLUMNS, WORTH_COLUMNS, decision_columns
from sfm_audit.audit.decision.decide import decide_all
from sfm_audit.audit.decision.decisions import Decisions
from sfm_audit.audit.decision.diagnostics import Diagnostics
from sfm_audit.audit.decision.from_row import READ_COLUMNS, diagnostics_of_row, number_of
from sfm_audit.audit.decision.measured import Measured
from sfm_audit.audit.table import build_table
from sfm_audit.audit.table.given import Column
from sfm_audit.audit.table.words import GROUPS, Member, MisfitStatus
from sfm_audit.loaders.arrays import BoolArray

Row = Mapping[str, Any]

FIXED_SETTINGS: Final = ("noise", "points", "min_track_length", "min_track_eigenvalue", "grid")
"""Settings that change what is measured."""
_MODEL: Final = ("dataset", "scene", "component", "model_path")
_ADVICE: Final = "advised_camera_model"
_NOT_ASKED: Final = frozenset({MisfitStatus.NO_COLUMNS, MisfitStatus.EXCLUDED})


class RedecisionError(ValueError):
    """A finished run cannot be decided again in this way."""


class MissingColumnError(RedecisionError):
    """The table is of another version: columns that decide are not there."""

    def __init__(self, columns: Sequence[str]) -> None:
        super().__init__(f"the images table has no column {', '.join(columns)}: written by another version, run again")
        self.columns = tuple(columns)


class FixedSettingError(RedecisionError):
    """A setting that cannot be applied to a finished run: it changes what is measured."""

    def __init__(self, setting: str, wanted: object, of_run: object, why: str = "it changes what is measured") -> None:
        super().__init__(f"{setting} = {wanted} cannot be applied to a run with {of_run}: {why}, run again")
        self.setting, self.wanted, self.of_run = setting, wanted, of_run


def redecide(images: pa.Table, settings: AuditConfig, *, run: AuditConfig) -> pa.Table:
    """Decide the images of a finished run again.

    Parameters
    ----------
    images : the images table of a run            settings : under which to decide            run : the run's own

    Returns
    -------
    pa.Table
        The same rows and columns; replaced are the verdicts, severity, reasons, reason_details and the named misfit
        with its effect, q and worth. ``advised_camera_model`` is null where it depends on what changed.

    Raises
    ------
    MissingColumnError
        The table was written by a version that does not keep all numbers that decide.
    FixedSettingError
        The noise model, the points, a setting of the tracks or the grid differ from the run's, or ``min_effect`` is
        below the run's: whom the joint test admits to the base depends on it.

    Notes
    -----
    Under another policy the result is that of a run under this policy. Under another ``min_effect``, ``alpha`` or
    pose threshold the joint tests and the statistics of tracks stay those of the run; images whose misfit was not
    tested because pose or camera were rejected stay undetermined in verdict_misfit.
    """
    _check_columns(images)
    _check_settings(settings, run)
    rows = images.select([name for name in images.column_names if name in _READ]).to_pylist()
    _check_effect(rows, settings, run)
    of_run = [diagnostics_of_row(row) for row in rows]
    found = _without_stale_shared(rows, of_run, settings)
    decisions = decide_all(Measured.of(found), settings)
    before = decisions if settings == run else decide_all(Measured.of(of_run), run)
    same_limits = (settings.alpha, settings.min_effect) == (run.alpha, run.min_effect)
    same = _same_advice(decisions, before, same_limits=same_limits).tolist()
    sigma_px = np.array([number_of(row["sigma_constant_px"]) for row in rows], dtype=np.float64)
    advice = [row[_ADVICE] if holds else None for row, holds in zip(rows, same, strict=True)]
    return _replaced(images, {**decision_columns(decisions, sigma_px), _ADVICE: advice})


def redecide_cameras(cameras: pa.Table, images: pa.Table, settings: AuditConfig, *, run: AuditConfig) -> pa.Table:
    """Return the cameras of one model under other settings: ``misfit_material`` and the advice that rests on it.

    Parameters
    ----------
    cameras, images : the tables of one model as the run wrote them            settings, run : as of `redecide`

    Notes
    -----
    The cause that is named stays that of the run. A camera is material still if its effect is above the median tau of
    its images; the advice for one that is no longer goes.
    """
    if settings.min_effect == run.min_effect or not cameras.num_rows:
        return cameras
    sigma_px: dict[int, list[float]] = {}
    for row in images.select(["camera_id", "sigma_constant_px"]).to_pylist():
        sigma_px.setdefault(row["camera_id"], []).append(number_of(row["sigma_constant_px"]))
    material, advice = [], []
    for row in cameras.select(["camera_id", "misfit_px", "misfit_material", _ADVICE]).to_pylist():
        tau_px = settings.tau_px(float(np.nanmedian(sigma_px.get(row["camera_id"], [math.nan]))))
        still = bool(row["misfit_material"]) and number_of(row["misfit_px"]) > tau_px
        material.append(still)
        advice.append(row[_ADVICE] if still == bool(row["misfit_material"]) else None)
    for name, values in (("misfit_material", material), (_ADVICE, advice)):
        at = cameras.column_names.index(name)
        kind = cameras.schema.field(at)
        cameras = cameras.set_column(at, kind, pa.array(values, type=kind.type))
    return cameras


_WRITTEN: Final = (*CAUSE_COLUMNS, *WORTH_COLUMNS, _ADVICE, *VERDICT_COLUMNS)
_READ: Final = frozenset({*READ_COLUMNS, *_MODEL, _ADVICE, "camera_id"})


def _check_columns(images: pa.Table) -> None:
    missing = sorted((_READ | set(_WRITTEN)) - set(images.column_names))
    if missing:
        raise MissingColumnError(missing)


def _check_settings(settings: AuditConfig, run: AuditConfig) -> None:
    for name in FIXED_SETTINGS:
        wanted, of_run = getattr(settings, name), getattr(run, name)
        if wanted != of_run:
            raise FixedSettingError(name, wanted, of_run)


def _check_effect(rows: Iterable[Row], settings: AuditConfig, run: AuditConfig) -> None:
    """Raise where what matters is smaller than in the run, in any image: px and sigma cannot be compared otherwise."""
    if settings.min_effect == run.min_effect:
        return
    sigma_px = [number_of(row["sigma_constant_px"]) for row in rows]
    if any(settings.tau_px(sigma) < run.tau_px(sigma) for sigma in sigma_px):
        why = "smaller misfits were not admitted to the joint test"
        raise FixedSettingError("min_effect", settings.min_effect, run.min_effect, why)


def _without_stale_shared(
    rows: Sequence[Row], found: Sequence[Diagnostics], settings: AuditConfig
) -> list[Diagnostics]:
    """Return the diagnostics; a camera is named as a whole only where most images of its model are still wrong.

    And where what its images say together is still above tau, the median of its images'.
    """
    effect_px = np.array([_effect_px(each, settings) for each in found])
    tau_px = np.array([settings.tau_px(each.misfit.sigma_px) if each.misfit else np.nan for each in found])
    models = [tuple(row[name] for name in _MODEL) for row in rows]
    cameras = [(model, row["camera_id"]) for model, row in zip(models, rows, strict=True)]
    most_wrong = {
        key: 2 * np.count_nonzero(effect_px[of] > tau_px[of]) > np.count_nonzero(~np.isnan(effect_px[of]))
        for key, of in _members(models).items()
    }
    asked = {key: [i for i in of if found[i].misfit is not None] for key, of in _members(cameras).items()}
    limit_px = {key: float(np.median(tau_px[of])) if of else np.nan for key, of in asked.items()}
    out = []
    for each, model, camera in zip(found, models, cameras, strict=True):
        misfit = each.misfit
        if misfit is not None and misfit.shared is not None:
            holds = most_wrong[model] and misfit.shared.px > limit_px[camera]
            each = each if holds else replace(each, misfit=replace(misfit, shared=None))  # noqa: PLW2901
        out.append(each)
    return out


def _members(keys: Sequence[Hashable]) -> dict[Hashable, list[int]]:
    """Return the rows of each key."""
    out: dict[Hashable, list[int]] = {}
    for i, key in enumerate(keys):
        out.setdefault(key, []).append(i)
    return out


def _effect_px(diagnostics: Diagnostics, settings: AuditConfig) -> float:
    """Return the largest effect among the significant groups, 0 without any; NaN where nobody asked."""
    misfit = diagnostics.misfit
    if misfit is None or all(misfit.groups[group].status in _NOT_ASKED for group in GROUPS):
        return math.nan
    return max((test.px for test in misfit.groups.values() if test.q < settings.alpha), default=0.0)


def _same_advice(decisions: Decisions, before: Decisions, *, same_limits: bool) -> BoolArray:
    """(n,) whether what the advice rests on is the same: what was tried to repair a misfit depends on alpha and tau."""
    if decisions is before:
        return np.ones(len(decisions), dtype=bool)
    misfit, was = decisions.misfit, before.misfit
    same = (misfit.cause == was.cause) & (misfit.material == was.material).all(axis=1)
    same &= decisions.rejects == before.rejects
    same &= decisions.members[Member.MISFIT].verdict == before.members[Member.MISFIT].verdict
    return np.asarray(same & (same_limits | ~misfit.material.any(axis=1)))


def _replaced(images: pa.Table, written: Mapping[str, Column]) -> pa.Table:
    """Return the table with these columns replaced, in place."""
    wanted = pa.schema([images.schema.field(name) for name in _WRITTEN])
    fresh = build_table({name: written[name] for name in _WRITTEN}, wanted)
    for name in _WRITTEN:
        at = images.column_names.index(name)
        images = images.set_column(at, images.schema.field(at), fresh.column(name))
    return images
