"""Does a run pass its gate? A policy and the numbers of one or two runs in, checks out."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Final

from sfm_audit.reports.compare.comparison import Comparison, RunSnapshot, ScopeChange, ScopeNumbers, scope_numbers
from sfm_audit.reports.compare.gate_policy import Band, GatePolicy, Limits
from sfm_audit.reports.compare.keys import Noted, Scope
from sfm_audit.reports.compare.measure import Measure, pose_measures
from sfm_audit.reports.compare.pose_limits import pose_limits
from sfm_audit.reports.text.wording import counted

NOT_MEASURED: Final = "not measured"


@dataclass(frozen=True, slots=True)
class Check:
    """One question and its answer.

    name: the key of the gate file it comes from.    value, allowed: in the key's unit, None where there is no number.
    images: what it is about, each with a remark.
    """

    scope: Scope
    name: str
    passed: bool
    value: float | None
    allowed: float | None
    message: str
    images: Noted = ()


def judge(policy: GatePolicy, run: RunSnapshot, comparison: Comparison | None) -> list[Check]:
    """Return all checks of a gate, those of the whole run first.

    Parameters
    ----------
    policy : what is allowed
    run : the run
    comparison : the run against its baseline; None without one, and the bands are not used
    """
    numbers = scope_numbers(run)
    changes = {change.scope: change for change in comparison.changes} if comparison else {}
    scopes = sorted({*numbers, *changes}, key=lambda scope: (_LEVELS[scope.kind], scope))
    checks = list(_unmatched(policy, scopes))
    for scope in scopes:
        own, change = numbers.get(scope), changes.get(scope)
        limits = policy.limits_of(scope)
        checks += _limit_checks(scope, limits, own or _NOTHING, change)
        checks += [
            Check(scope, f"limits.{each.name}", each.passed, each.value, each.allowed, each.message, each.images)
            for each in pose_limits(limits, own.accepted if own else ())
        ]
    if comparison:
        for change in checked_changes(comparison):
            checks += _band_checks(change, policy.band_of(change.scope))
    return sorted(checks, key=lambda check: (_LEVELS[check.scope.kind], check.scope))


def checked_changes(comparison: Comparison) -> Iterator[ScopeChange]:
    """Yield the scopes that bands apply to: a level with a single member is not judged twice.

    Only scenes that the baseline has can be compared with it; of the others, nothing but their levels says something.
    """
    scenes = [change for change in comparison.changes if change.scope.kind == "scene"]
    datasets = {change.scope.dataset for change in scenes}
    for change in comparison.changes:
        num_below = len([s for s in scenes if s.scope.dataset == change.scope.dataset])
        is_needed = {"run": len(datasets) != 1, "dataset": num_below != 1, "scene": True}[change.scope.kind]
        if is_needed and change.was_there:
            yield change


def measures(change: ScopeChange) -> Iterator[Measure]:
    """Yield every number of a scope that a band bounds."""
    before, after = change.before, change.after
    scenes, models = change.lost_scenes, change.lost_models
    yield Measure("lost_scenes", len(scenes), _listed("scene", scenes))
    yield Measure("lost_models", len(models), _listed("model", models))
    yield _share_of_images("lost_images", change.lost, before.num_images, "images of the baseline are lost")
    if not change.num_common:
        return  # everything is lost or new: there is nothing else to compare
    yield _share_of_images(
        "camera_model_changed", change.remodelled, change.num_common, "images have another camera model"
    )
    yield _share_of_images("newly_rejected", change.newly_rejected, change.num_common, "images are newly rejected")
    yield from _share_measures(before, after)
    yield from _level_measures(before, after)
    yield _systematic(change)
    yield from pose_measures(change)


def _share_measures(before: ScopeNumbers, after: ScopeNumbers) -> Iterator[Measure]:
    accepted = [numbers.share(numbers.num_accepted) or 0.0 for numbers in (before, after)]
    yield Measure(
        "share_accepted", accepted[0] - accepted[1], f"{_percent(accepted[1])} accepted after {_percent(accepted[0])}"
    )
    rejected = [numbers.share(numbers.num_rejected) or 0.0 for numbers in (before, after)]
    yield Measure(
        "share_rejected", rejected[1] - rejected[0], f"{_percent(rejected[1])} rejected after {_percent(rejected[0])}"
    )
    rises = [
        (new - old, code, old, new)
        for code in sorted({*before.rejected_by_reason, *after.rejected_by_reason})
        for old, new in [[(n.share(n.rejected_by_reason.get(code, 0)) or 0.0) for n in (before, after)]]
    ]
    rise, code, old, new = max(rises, key=lambda item: (item[0], item[1]), default=(0.0, "", 0.0, 0.0))
    words = f"{_percent(new)} rejected with {code} after {_percent(old)}" if code else "no image rejected"
    yield Measure("share_rejected_by_reason", rise, words)


def _level_measures(before: ScopeNumbers, after: ScopeNumbers) -> Iterator[Measure]:
    for key, name, old, new in (
        ("median_sigma", "median sigma_constant_px", before.sigma_px, after.sigma_px),
        ("noise_s0", "noise_s0_px", before.noise_s0_px, after.noise_s0_px),
        ("recomputed_error", "recomputed error", before.recomputed_error_px, after.recomputed_error_px),
    ):
        if old is None:
            continue
        if new is None:
            yield Measure(key, math.nan, f"{name} is {NOT_MEASURED} any more, it was {old:.4g} px")
            continue
        rise = (new - old) / old if old > 0 else (0.0 if new <= old else math.inf)
        yield Measure(key, rise, f"{name} {new:.4g} px after {old:.4g} px")


def _systematic(change: ScopeChange) -> Measure:
    if not change.grown_px:
        return Measure("systematic_px", 0.0, "no image has a new systematic error")
    largest = change.grown_px[0][1]
    images = tuple((key, f"+{growth:.2f} px") for key, growth in change.grown_px)
    words = f"{counted(len(images), 'image')} with a larger systematic error, up to +{largest:.2f} px"
    return Measure("systematic_px", largest, words, images)


def _share_of_images(key: str, images: Noted, total: int, words: str) -> Measure:
    share = len(images) / total if total else 0.0
    return Measure(key, share, f"{len(images)} of {total} {words} ({_percent(share)})", images)


def _listed(what: str, names: Sequence[str]) -> str:
    return f"no {what} is lost" if not names else f"{counted(len(names), what)} lost: {', '.join(names)}"


def _band_checks(change: ScopeChange, band: Band) -> Iterator[Check]:
    for measure in measures(change):
        allowed = float(getattr(band, measure.key))
        if math.isinf(allowed):
            continue
        passed = measure.value <= allowed + _ROUNDING  # False for NaN
        images = measure.images
        if measure.key == "systematic_px":  # those below the band are not what it is about
            over = [growth > allowed + _ROUNDING for _, growth in change.grown_px]
            images = tuple(image for image, is_over in zip(images, over, strict=True) if is_over)
        message = f"{measure.words}; {_allowed_words(measure.key, allowed)}"
        value = measure.value if math.isfinite(measure.value) else None
        yield Check(change.scope, f"band.{measure.key}", passed, value, allowed, message, images)


def _limit_checks(scope: Scope, limits: Limits, numbers: ScopeNumbers, change: ScopeChange | None) -> Iterator[Check]:
    reasons = (
        ("max_share_rejected_by_reason", limits.max_share_rejected_by_reason, numbers.rejected_by_reason),
        ("max_share_by_reason", limits.max_share_by_reason, numbers.by_reason),
    )
    shares: list[tuple[str, float | None, float | None, Callable[[float], str]]] = [
        ("min_images", limits.min_images, numbers.num_images, _count),
        ("min_share_accepted", limits.min_share_accepted, numbers.share(numbers.num_accepted), _percent),
        ("max_share_rejected", limits.max_share_rejected, numbers.share(numbers.num_rejected), _percent),
        ("max_share_undetermined", limits.max_share_undetermined, numbers.share(numbers.num_undetermined), _percent),
        *(
            (f"{key}.{code}", allowed, numbers.share(counts.get(code, 0)), _percent)
            for key, by_reason, counts in reasons
            for code, allowed in sorted(by_reason.items())
        ),
        ("max_median_sigma_px", limits.max_median_sigma_px, numbers.sigma_px, _px),
        ("max_noise_s0_px", limits.max_noise_s0_px, numbers.noise_s0_px, _px),
        ("max_recomputed_error_px", limits.max_recomputed_error_px, numbers.recomputed_error_px, _px),
    ]
    if change is not None:
        shares.append(("max_lost_images", limits.max_lost_images, len(change.lost), _count))
    lost = change.lost if change is not None else ()
    for name, allowed, value, show in shares:
        if allowed is None:
            continue
        images = lost if name == "max_lost_images" else ()
        yield _limit_check(scope, name, allowed, value, show=show, images=images)


def _limit_check(
    scope: Scope,
    name: str,
    allowed: float,
    value: float | None,
    *,
    show: Callable[[float], str],
    images: Noted,
) -> Check:
    is_least = name.startswith("min_")
    words = f"{'at least' if is_least else 'at most'} {show(allowed)} allowed"
    if value is None:
        return Check(scope, f"limits.{name}", False, None, allowed, f"{NOT_MEASURED}; {words}")
    passed = value >= allowed - _ROUNDING if is_least else value <= allowed + _ROUNDING
    return Check(scope, f"limits.{name}", passed, value, allowed, f"{show(value)}; {words}", images)


def _unmatched(policy: GatePolicy, scopes: Iterable[Scope]) -> Iterator[Check]:
    """A section that is about nothing checks nothing: most likely a scene is lost, or a name is misspelt."""
    listed = list(scopes)
    for kind in ("dataset", "scene"):
        candidates = [scope for scope in listed if scope.kind == kind]
        for section in getattr(policy, kind):
            if not any(section.matches(scope) for scope in candidates):
                names = sorted({name for scope in candidates for name in (scope.scene, scope.name) if name})
                close = get_close_matches(section.match, names, n=1)
                message = f"no {kind} is called {section.match!r}{f', did you mean {close[0]!r}?' if close else ''}"
                yield Check(Scope(), f"{kind}.match", False, None, None, message)


def _allowed_words(key: str, allowed: float) -> str:
    if key in {"lost_scenes", "lost_models", "fragments", "pose_centre", "bending"}:
        return f"{allowed:g} allowed"
    if key == "pose_rotation_deg":
        return f"{allowed:g} deg allowed"
    if key == "systematic_px":
        return f"+{_px(allowed)} allowed"
    if key in {"median_sigma", "noise_s0", "recomputed_error"}:
        return f"+{_percent(allowed)} allowed"
    if key.startswith("share_"):
        return f"a {'fall' if key == 'share_accepted' else 'rise'} by {_percent(allowed)} allowed"
    return f"{_percent(allowed)} allowed"


def _percent(share: float) -> str:
    return f"{100 * share:.3g} %"


def _px(value: float) -> str:
    return f"{value:.4g} px"


def _count(value: float) -> str:
    return f"{value:g}"


_LEVELS: Final = {"run": 0, "dataset": 1, "scene": 2}
_ROUNDING: Final = 1e-9  # 0.3 - 0.2 is not above 0.1
_NOTHING: Final = ScopeNumbers(0, 0, 0, 0, {}, None, None, None)
