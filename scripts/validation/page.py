"""docs/validation.md: for a statistician who does not believe us."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

import numpy as np
import pandas as pd

from scripts.validation import faults, words
from scripts.validation.bounds import Tables, Within, cells, effect_ratio, tested_share
from scripts.validation.faults import right_answer
from scripts.validation.markdown import percent, table
from scripts.validation.rules import rule_rows
from scripts.validation.study import HOLDS, VIOLATED, WITHIN_CHANCE, Check
from scripts.validation.truth import ALPHA, CAMERA_DEFECTS, SIGMA_PX, SOUND, TAU_PX
from scripts.validation.witnesses import witnesses_section
from sfm_audit.audit.misfit import GROUPS
from sfm_audit.audit.simulate.defects import DefectKind

POWER_CLASSES: Final = ((0.03, 0.1), (0.1, 0.2), (0.2, 0.3), (0.3, 0.5), (0.5, 1.2))


def document(tables: Tables, checks: Sequence[Check | Within], seed: int) -> dict[str, str]:
    """Return the pages by file name: what a reader needs, and the tables behind it."""
    page = [
        words.INTRO.format(seed=seed, holds=HOLDS, chance=WITHIN_CHANCE, violated=VIOLATED.lower()),
        _claims(checks),
        _setup(tables["scenes"]),
        words.FIGURES,
        faults.blame_section(tables["scenes"]),
        _poses(tables["scenes"]),
        _cameras(tables["cameras"]),
        _advice(tables["advice"]),
        _rules(tables["scenes"]),
        witnesses_section(),
        words.LIMITS,
    ]
    details = [
        words.DETAILS.format(seed=seed),
        _single_size(tables["singles"]),
        _scene_size(tables["scenes"]),
        _power(tables["power"], tables["exact"]),
        faults.frozen_section(tables["frozen"]),
        faults.focal_sd_section(tables["scenes"]),
    ]
    return {
        "validation.md": "\n\n".join(page) + "\n",
        "validation_details.md": "\n\n".join(details) + "\n",
    }


def _claims(checks: Sequence[Check | Within]) -> str:
    """The bounds and whether they hold, a row per claim."""
    rows, details = [], []
    for claim in dict.fromkeys(check.claim for check in checks):
        own = [check for check in checks if check.claim == claim]
        count = {word: sum(check.outcome == word for check in own) for word in (HOLDS, WITHIN_CHANCE, VIOLATED)}
        show: Callable[[float], str] = percent if isinstance(own[0], Check) else "{:.3f}".format
        rates = [check.rate for check in own]
        measured = show(rates[0]) if len(own) == 1 else f"{show(min(rates))} to {show(max(rates))}"
        trials = [check.trials for check in own if isinstance(check, Check)]
        bounds = f"{show(own[0].low)} to {show(own[0].high)}"
        images = (
            "" if not trials else str(min(trials)) if min(trials) == max(trials) else f"{min(trials)}–{max(trials)}"
        )
        word = f"{count[VIOLATED]} of {len(own)} violated" if count[VIOLATED] else HOLDS
        if count[WITHIN_CHANCE]:
            word += f", {count[WITHIN_CHANCE]} outside {WITHIN_CHANCE}"
        rows.append((claim, bounds, measured, str(len(own)), images, word))
        details += [
            f"- {check.outcome}: {claim}; {check.cell}: {show(check.rate)}"
            for check in own
            if check.outcome == VIOLATED
        ]
    total = sum(check.outcome == VIOLATED for check in checks)
    verdict = f"Of {len(checks)} bounds {total} are violated" + (":" if details else ".")
    header = ("claim", "bounds", "measured, range over cells", "cells", "images per cell", "")
    return "\n\n".join(["## What must hold, and whether it does", table(header, rows), "\n".join([verdict, *details])])


def _rate(part: pd.DataFrame, column: str) -> str:
    hits = tested_share(part, column)
    return "–" if hits is None else percent(float(hits.mean()))


def _size_table(frame: pd.DataFrame, tests: Sequence[str], verdicts: Sequence[str], suffix: str = "_p") -> str:
    rows = []
    for noise, n, part in cells(frame):
        rates = [_rate(part, f"{test}{suffix}") for test in tests]
        shares = [percent(float((part[verdict] == "rejected").mean())) for verdict in verdicts]
        rows.append((str(noise), str(n), str(len(part)), *rates, *shares))
    names = [test.removeprefix("misfit_").replace("_", " ") for test in tests]
    return table(("noise", "n", "images", *names, *(v.replace("_", " ") for v in verdicts)), rows)


_MISFIT: Final = [f"misfit_{group}" for group in GROUPS]
_POLICIES: Final = ("policy_standard", "policy_camera", "policy_full")
_CAMERA_VERDICTS: Final = ("verdict_misfit", "verdict_camera", "verdict_pose")


def _single_size(singles: pd.DataFrame) -> str:
    return "\n\n".join(
        [
            words.SINGLE_MISFIT,
            _size_table(singles, _MISFIT, ["verdict_misfit"]),
            "![Size of the misfit groups against n](figures/validation_size.svg)",
            words.SINGLE_GOODNESS_OF_FIT.format(
                rejected=_any(singles, "rejected"), undetermined=_any(singles, "undetermined")
            ),
            _size_table(
                singles,
                ["ks", "ks_fitted", "ks_norm", "dap", "sw"],
                ["verdict_ks", "policy_standard", "policy_camera", "policy_full"],
            ),
        ]
    )


def _setup(scenes: pd.DataFrame) -> str:
    per_scene = scenes.drop_duplicates(["design", "noise", "n", "scene"])
    failed = per_scene[per_scene["num_failed"] > 0]
    where = ", ".join(sorted(set(failed["design"]))) or "none"
    redrawn = f"{int(failed['num_failed'].sum())} beside {len(per_scene)} (designs: {where})"
    return words.SETUP.format(tau=TAU_PX, redrawn=redrawn)


def _any(frame: pd.DataFrame, verdict: str) -> str:
    return percent(float((frame[["verdict_pose", "verdict_plausible"]] == verdict).any(axis=1).mean()))


def _scene_size(scenes: pd.DataFrame) -> str:
    size = scenes[scenes["design"] == "size"]
    scales = []
    for noise, n, part in cells(size):
        numbers = [
            float(part["sigma_constant_px"].mean()),
            float(part["sigma_predicted_px"].mean()),
            float(part["sigma_d_px"].median()),
            float(part["sigma_l"].median()),
            float(part["kurtosis_excess"].mean()),
        ]
        nu0 = f"{float(part['noise_nu0'].median()):.3g}"
        scales.append((str(noise), str(n), *(f"{number:.3f}" for number in numbers), nu0))
    tests = ["ks", "ks_fitted", "ks_norm", "dap", "sw", "ks_constant"]
    return "\n\n".join(
        [
            words.SCENE_GOODNESS_OF_FIT,
            _size_table(size, tests, ["verdict_ks", "verdict_noise", *_POLICIES]),
            "![Size of the goodness-of-fit tests against n](figures/validation_goodness_of_fit.svg)",
            words.SCENE_MISFIT,
            _size_table(size, _MISFIT, []),
            words.SCENE_JOINT,
            _size_table(size, _MISFIT, [*_CAMERA_VERDICTS, "plausible"], suffix="_p_joint"),
            words.SHARED_SIZE,
            _size_table(scenes[scenes["design"] == "size, shared camera"], _MISFIT, ["verdict_misfit"]),
            words.SCALES,
            table(("noise", "n", "raw", "predicted", "sigma_d", "sigma_l", "excess kurtosis", "nu0"), scales),
        ]
    )


def _own_group_found(frame: pd.DataFrame) -> pd.Series:
    """Whether the group that carries the defect's name has p < 5 %."""
    name_of = dict(zip(map(str, CAMERA_DEFECTS), GROUPS[:1] + GROUPS[:5], strict=True))
    p = [row[f"misfit_{name_of[row['kind']]}_p"] for _, row in frame.iterrows()]
    return pd.Series(p, index=frame.index) < ALPHA


def _power(power: pd.DataFrame, exact: pd.DataFrame) -> str:
    rows, effects = [], []
    for kind in CAMERA_DEFECTS:
        for n in sorted(power["n"].unique()):
            for low, high in POWER_CLASSES:
                chosen = (power["kind"] == str(kind)) & (power["n"] == n) & power["true_px"].between(low, high)
                part = power[chosen]
                if not len(part):
                    continue
                found = part["verdict_misfit"] == "rejected"
                shares = [
                    _own_group_found(part).mean(),
                    found.mean(),
                    right_answer(part)[found].mean(),
                    *((part[f"{test}_p"] < ALPHA).mean() for test in ("ks", "ks_fitted", "dap", "sw")),
                ]
                size = f"{low:g}–{high:g}"
                rows.append((str(kind), str(n), size, str(len(part)), *(percent(float(share)) for share in shares)))
    of_ratio = power.assign(ratio=effect_ratio(power))
    for n in sorted(power["n"].unique()):
        for low, high in POWER_CLASSES[1:]:
            ratio = of_ratio.loc[(of_ratio["n"] == n) & of_ratio["true_px"].between(low, high), "ratio"]
            if len(ratio):
                effects.append(_effect_row(f"all kinds, {low:g}–{high:g} px", n, ratio))
    for kind in exact["kind"].unique():
        part = exact[exact["kind"] == kind]
        size = f"{kind} as stated, {part['true_px'].mean():.2f} px"
        effects.append(_effect_row(size, int(part["n"].iloc[0]), effect_ratio(part)))
    header = ("defect", "n", "true px", "images", "own group", "verdict_misfit", "of these right", "ks", "ks_fitted")
    return "\n\n".join(
        [
            words.POWER,
            table((*header, "dap", "sw"), rows),
            "![Power against the true effect](figures/validation_power.svg)",
            words.EFFECT.format(error=f"{SIGMA_PX / np.sqrt(250):.2f}", word=_effect_word(of_ratio)),
            table(("size", "n", "images", "5 %", "median", "95 %", "within 20 %"), effects),
        ]
    )


def _effect_word(of_ratio: pd.DataFrame) -> str:
    """From which size on the effect is within 20 % in 95 % of the images."""
    seen = of_ratio[of_ratio["n"] == 250]
    close = (seen["ratio"] - 1.0).abs() <= 0.2
    edges = [0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5, 0.6, 0.8]
    good = [edge for edge in edges if close[seen["true_px"] >= edge].mean() >= 0.95]
    above = f"from {min(good):g} px on" if good else "at no size"
    share = percent(float(close[seen["true_px"] > 0.1].mean()))
    return f"Of the images with more than 0.1 px at n = 250, {share} are within 20 %; 95 % and more are {above}."


def _effect_row(size: str, n: int, ratio: pd.Series) -> tuple[str, ...]:
    quantiles = [f"{float(ratio.quantile(q)):.2f}" for q in (0.05, 0.5, 0.95)]
    return (size, str(n), str(len(ratio)), *quantiles, percent(float(((ratio - 1.0).abs() <= 0.2).mean())))


def _poses(scenes: pd.DataFrame) -> str:
    part = scenes[scenes["design"] == "poses and corners"]
    rows = []
    names = {SOUND: "sound", str(DefectKind.PERTURBED_POSE): "pose moved", str(DefectKind.FEW_POINTS): "corner only"}
    for kind, name in names.items():
        own = part[part["kind"] == kind]
        verdicts = ("verdict_pose", "verdict_misfit", "verdict_camera", "verdict_noise", "verdict_ks")
        shares = [(own[column] == "rejected").mean() for column in verdicts]
        not_accepted = [(own[column] != "accepted").mean() for column in ("plausible", *_POLICIES)]
        offset = f"{own['pose_offset_px'].median():.3f}" if len(own) else "–"
        rows.append((name, str(len(own)), *(percent(float(s)) for s in (*shares, *not_accepted)), offset))
    header = ("images", "number", "pose", "misfit", "camera", "noise", "ks", "not plausible")
    return "\n\n".join(
        [
            words.POSES,
            table((*header, *(policy.replace("_", " ") for policy in _POLICIES), "pose_offset_px"), rows),
        ]
    )


def _cameras(cameras: pd.DataFrame) -> str:
    rows = []
    for k2 in sorted(cameras["k2"].unique()):
        part = cameras[cameras["k2"] == k2]
        pooled = [_rate(part, f"misfit_{group}_p") for group in GROUPS]
        px = f"{part['misfit_radial_px'].median():.3f}"
        p = f"{part['misfit_radial_p'].median():.2g}"
        shares = [percent(float(part[name].mean())) for name in ("share_rejected", "share_shared_reason")]
        rows.append((f"{k2:g}", str(len(part)), *pooled, p, px, *shares))
    header = ("missing k2", "scenes", *(str(group).replace("_", " ") for group in GROUPS))
    return "\n\n".join(
        [
            words.CAMERAS,
            table((*header, "p, radial", "px, radial", "images rejected", "shared_camera"), rows),
        ]
    )


def _advice(advice: pd.DataFrame) -> str:
    rows = []
    for (design, kind), part in advice.groupby(["design", "kind"], sort=False):
        rejected = part[part["rejected"].astype(bool)]
        named = rejected["advised"].value_counts()
        listed = ", ".join(f"{name} {count}" for name, count in named.items())
        tried = rejected["passes"].dropna().astype(bool)
        passes = percent(float(tried.mean())) if len(tried) else "–"
        whole = percent(float(rejected["accepted"].dropna().astype(bool).mean())) if len(tried) else "–"
        numbers = (str(len(part)), str(len(rejected)), listed, str(len(tried)))
        rows.append((str(design), str(kind), *numbers, passes, whole))
    header = ("scenes", "planted", "number", "rejected", "advice", "refitted", "pass afterwards", "policy standard")
    return "\n\n".join(
        [
            words.ADVICE,
            table(header, rows),
        ]
    )


def _rules(scenes: pd.DataFrame) -> str:
    header = ("rule", "threshold", "sound rejected", "wrong rejected", "of these ≥ 0.5 px", "cannot say")
    return "\n\n".join(
        [
            words.RULES,
            table(header, rule_rows(scenes[scenes["design"] == "quarter"])),
            "![False alarms against detections](figures/validation_rules.svg)",
        ]
    )
