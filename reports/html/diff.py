"""The page of ``sfm-audit diff``: what changed between two runs, image by image."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from markupsafe import Markup

from sfm_audit.audit.table.words import Verdict
from sfm_audit.reports.charts import runs
from sfm_audit.reports.compare.comparison import Comparison, ImageState, ScopeChange
from sfm_audit.reports.compare.keys import ImageKey
from sfm_audit.reports.html.page import environment
from sfm_audit.reports.html.payload import as_json
from sfm_audit.reports.text.wording import counted, plain, px

MAX_CHANGED: Final = 10_000
MAX_SCOPES: Final = 300
NOT_THERE: Final = "not there"
_KINDS: Final = {
    "newly_rejected": "newly rejected",
    "lost": "lost",
    "fixed": "fixed",
    "moved": "moved",
    "added": "added",
    "remodelled": "another camera model",
    "grown_px": "larger systematic error",
}
_OTHER: Final = "another verdict"


@dataclass(frozen=True, slots=True)
class ComparedInfo:
    """One of the two runs. folder: as the user named it.    info: the content of its run.json."""

    folder: str
    info: Mapping[str, Any]


def render_diff(comparison: Comparison, runs_of: tuple[ComparedInfo, ComparedInfo], note: str | None = None) -> str:
    """Return the page; ``note``: what a reader should know first, such as settings that differ."""
    scopes = [change for change in comparison.changes if change.scope.kind == "scene"]
    changed = sorted((each for each in scopes if each.anything), key=lambda each: (-_weight(each), each.scope))
    rows = _rows(comparison)
    whole = comparison.whole
    num_images = len(comparison.before.images.keys() | comparison.after.images.keys())
    return (
        environment()
        .get_template("diff.html.j2")
        .render(
            heads=[_head(each) for each in runs_of],
            note=plain(note) if note else None,
            summary=f"{counted(len(rows), 'image')} of {num_images} changed",
            nothing_in_common=comparison.nothing_in_common,
            states=[*map(str, Verdict), NOT_THERE],
            moves=_moves(comparison),
            figure=_figure(whole),
            counts=[(words, len(getattr(whole, name))) for name, words in _KINDS.items()],
            scopes=[_scope(each) for each in changed[:MAX_SCOPES]],
            num_changed=len(changed),
            num_scopes=len(scopes),
            lists=[
                ("Scenes lost", [plain(name) for name in whole.lost_scenes[:MAX_SCOPES]]),
                ("Scenes added", [plain(name) for name in whole.added_scenes[:MAX_SCOPES]]),
                ("Models none of whose images is left", [plain(name) for name in whole.lost_models[:MAX_SCOPES]]),
            ],
            num_rows=min(len(rows), MAX_CHANGED),
            num_all=len(rows),
            payload=as_json({"rows": rows[:MAX_CHANGED]}),
        )
    )


def _head(run: ComparedInfo) -> dict[str, Any]:
    info = run.info
    return {
        "folder": plain(run.folder),
        "paths": [plain(path["given"]) for path in info.get("paths", [])][:6],
        "version": plain(info["version"]),
        "finished": plain(info["finished"]) if info.get("finished") else None,
        "command": plain(info["command"]) if info.get("command") else None,
        "policy": plain(str(info["config"].get("policy", "-"))),
    }


def _figure(whole: ScopeChange) -> Markup:
    counts: dict[str, dict[str, int]] = {
        name: {
            str(Verdict.ACCEPTED): numbers.num_accepted,
            str(Verdict.REJECTED): numbers.num_rejected,
            str(Verdict.UNDETERMINED): numbers.num_undetermined,
        }
        for name, numbers in (("before", whole.before), ("now", whole.after))
    }
    return runs.verdict_bars(counts, "Verdicts before and now; the table beside it has the numbers")


def _moves(comparison: Comparison) -> list[tuple[str, list[int]]]:
    """Images by verdict before (rows) and now (columns)."""
    before, after = comparison.before.images, comparison.after.images
    found = Counter((_verdict(before.get(key)), _verdict(after.get(key))) for key in before.keys() | after.keys())
    states = [*map(str, Verdict), NOT_THERE]
    return [(old, [found[old, new] for new in states]) for old in states]


def _verdict(state: ImageState | None) -> str:
    return NOT_THERE if state is None else str(state.verdict)


def _scope(change: ScopeChange) -> dict[str, Any]:
    before, after = change.before, change.after
    return {
        "name": plain(change.scope.name),
        "counts": [before.num_images, after.num_images, *(len(getattr(change, name)) for name in _KINDS)],
        "px": [
            px(value)
            for value in (before.sigma_px, after.sigma_px, before.recomputed_error_px, after.recomputed_error_px)
        ],
    }


def _weight(change: ScopeChange) -> int:
    return len(change.newly_rejected) + len(change.lost)


def _rows(comparison: Comparison) -> list[list[Any]]:
    """One row per changed image: name, scene, kinds, verdicts, noise before and now, growth, remark; worst first."""
    whole, before, after = comparison.whole, comparison.before.images, comparison.after.images
    kinds: defaultdict[ImageKey, list[str]] = defaultdict(list)
    remarks: dict[ImageKey, str] = {}
    growth = dict(whole.grown_px)
    for name, words in _KINDS.items():
        for key, remark in getattr(whole, name):
            kinds[key].append(words)
            if isinstance(remark, str) and remark:
                remarks.setdefault(key, remark)
    for key in before.keys() & after.keys():
        if key not in kinds and before[key].verdict != after[key].verdict:
            kinds[key].append(_OTHER)
    order = [*_KINDS.values(), _OTHER]
    ranked = sorted(kinds, key=lambda key: (order.index(kinds[key][0]), -growth.get(key, 0.0), key))
    return [
        [
            plain(key.image_name),
            plain(f"{key.dataset}/{key.scene}"),
            kinds[key],
            _verdict(before.get(key)),
            _verdict(after.get(key)),
            *_noise(before.get(key), after.get(key)),
            _short(growth.get(key)),
            plain(remarks.get(key, "")),
        ]
        for key in ranked
    ]


def _noise(*states: ImageState | None) -> Sequence[float | None]:
    return [_short(state.sigma_px if state else None) for state in states]


def _short(value: float | None) -> float | None:
    return None if value is None else float(f"{value:.4g}")
