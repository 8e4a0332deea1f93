"""How much do reconstructions of the same photos differ by themselves? A gate file whose bands leave room for that.

The rule, also in docs/nightly.md: every run is compared with every other, both ways, by the gate's own measures; a band
is the largest value met, times a margin that is larger for fewer runs, but not below the floor.
"""

from __future__ import annotations

import glob
import json
import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations
from typing import Final

from sfm_audit.reports.compare.comparison import RunSnapshot, compare
from sfm_audit.reports.compare.gate import checked_changes, measures
from sfm_audit.reports.compare.gate_policy import BAND_KEYS, Band
from sfm_audit.reports.compare.keys import Scope
from sfm_audit.reports.compare.motion import Aligner

MARGINS: Final = ((5, 2.0), (3, 3.0), (2, 4.0))  # from so many runs on: the factor on the largest difference
FLOOR_SHARE: Final = 0.5  # of the default band: three runs that happen to agree do not promise that the fourth will
SYSTEMATIC_MARGIN: Final = 1.5  # px of a camera defect: a factor of 3 would hide what the gate is for
_KEPT_AT_DEFAULT: Final = frozenset({"systematic_px"})
_ONE_IMAGE: Final = frozenset(
    {"newly_rejected", "share_accepted", "share_rejected", "share_rejected_by_reason", "moved_images"}
)
_COUNTS: Final = frozenset({"lost_scenes", "lost_models", "fragments"})
_SHARES: Final = _ONE_IMAGE | {"lost_images", "camera_model_changed"}
_WIDEST: Final = {
    **dict.fromkeys(_SHARES, 0.5),
    **dict.fromkeys(("median_sigma", "noise_s0", "recomputed_error"), 1.0),
    "systematic_px": 2.0,
}  # from here on a band says nothing: half of the images, twice the noise, eight times the default growth
_DIGITS: Final = 1e4
_NO_DIGITS: Final = 1e12  # larger ones are rounded as they are


@dataclass(frozen=True, slots=True, eq=False)
class LearntBands:
    """Bands by key. common: for all scopes; scenes: only what a scene needs wider than that."""

    num_runs: int
    margin: float
    largest: Mapping[str, float]
    common: Mapping[str, float]
    scenes: Mapping[Scope, Mapping[str, float]]


def learn_bands(runs: Sequence[RunSnapshot], align: Aligner | None = None) -> LearntBands:
    """Learn bands from two or more runs over reconstructions of the same photos.

    Notes
    -----
    Levels above the scenes, where there are any, give the bands for all; a scene that varies more gets its own. One
    image more or less with another verdict, or elsewhere, is always within the band of a scene.
    ``align``: see `compare`.
    """
    if len(runs) < 2:
        raise ValueError(f"a band takes two runs or more, got {len(runs)}")
    largest: defaultdict[Scope, dict[str, float]] = defaultdict(lambda: dict.fromkeys(BAND_KEYS, 0.0))
    fewest: dict[Scope, int] = {}
    for before, after in permutations(runs, 2):
        for change in checked_changes(compare(before, after, align)):
            worst = largest[change.scope]
            fewest[change.scope] = min(fewest.get(change.scope, change.num_common), change.num_common)
            for measure in measures(change):
                value = math.inf if math.isnan(measure.value) else measure.value
                worst[measure.key] = max(worst[measure.key], value)
    margin = next(factor for least, factor in MARGINS if len(runs) >= least)
    bands = {
        scope: {key: _band(key, value, margin, fewest[scope]) for key, value in worst.items()}
        for scope, worst in largest.items()
    }
    above = [scope for scope in bands if scope.kind != "scene"] or list(bands)
    common = {key: max((bands[scope][key] for scope in above), default=0.0) for key in BAND_KEYS}
    scenes = {
        scope: wider
        for scope in sorted(scope for scope in bands if scope.kind == "scene")
        if (wider := {k: v for k, v in bands[scope].items() if v > common[k]})
    }
    everywhere = {key: max((worst[key] for worst in largest.values()), default=0.0) for key in BAND_KEYS}
    return LearntBands(len(runs), margin, everywhere, common, scenes)


def says_nothing(learnt: LearntBands) -> list[str]:
    """Return a line per band that hardly any night would leave, such as 0.6 of all images newly rejected."""
    wide = [("", key, learnt.common[key]) for key in BAND_KEYS]
    wide += [
        (f"scene {scope.name}: ", key, band) for scope, bands in learnt.scenes.items() for key, band in bands.items()
    ]
    return [
        f"{_one_line(where)}{key} = {_number(value)} says nothing: the runs differ by more than a gate could "
        "allow; look at them with sfm-audit diff, and learn from runs that belong together"
        for where, key, value in wide
        if value >= _WIDEST.get(key, math.inf)
    ]


def gate_toml(learnt: LearntBands, names: Sequence[str]) -> str:
    """Return the gate file: bands, and in comments what they were learnt from."""
    lines = [
        f"# Learnt by sfm-audit learn-band from {learnt.num_runs} runs:",
        *(f"#   {_one_line(name)}" for name in names),
        f"# A band is {learnt.margin:g} times the largest difference between two of them, and at least a floor.",
        f"# (systematic_px: {SYSTEMATIC_MARGIN:g} times.) The comment beside a band is that difference.",
        "# docs/nightly.md explains the keys; add [limits] as you like.",
        "",
        "[band]",
    ]
    lines += [
        f"{key} = {_number(learnt.common[key])}  # largest difference {_number(learnt.largest[key])}"
        for key in BAND_KEYS
    ]
    for scope, bands in learnt.scenes.items():
        match = glob.escape(scope.name)
        lines += ["", "[[scene]]", f"match = {_toml_text(match)}", "[scene.band]"]
        lines += [f"{key} = {_number(value)}" for key, value in bands.items()]
    return "\n".join(lines) + "\n"


def _band(key: str, largest: float, margin: float, num_images: int) -> float:
    default = float(getattr(Band(), key))
    if key in _COUNTS:
        return float(math.ceil(margin * largest)) if math.isfinite(largest) else math.inf
    if key in _KEPT_AT_DEFAULT:
        return _round_up(max(default, SYSTEMATIC_MARGIN * largest))
    floor = FLOOR_SHARE * default
    if key in _ONE_IMAGE and num_images:
        floor = max(floor, 1.0 / num_images)
    band = _round_up(max(floor, margin * largest))
    return min(band, 1.0) if key in _SHARES else band


def _round_up(value: float) -> float:
    return math.ceil(value * _DIGITS - 1e-6) / _DIGITS if value < _NO_DIGITS else value


def _number(value: float) -> str:
    return f"{value:.4g}" if value < 1 else f"{round(value, 4):g}"


def _one_line(text: str) -> str:
    return text.encode("unicode_escape").decode() if not text.isprintable() else text


def _toml_text(text: str) -> str:
    """TOML's basic strings are JSON's, but for DEL."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")
