"""The page's sections on who is to blame: misfit, frozen parameters, and how well a focal length is known."""

from __future__ import annotations

from typing import Final

import numpy as np
import pandas as pd

from scripts.validation import words
from scripts.validation.bounds import cells, focal_ratios, sound_scenes
from scripts.validation.markdown import percent, table
from scripts.validation.truth import CAMERA_DEFECTS, SCENE_FOCAL_PX, SOUND, TAU_PX, is_right
from sfm_audit.audit.misfit import GROUPS
from sfm_audit.audit.table.words import Severity

CLASSES: Final = ((0.2, 0.3), (0.3, 0.5), (0.5, np.inf))
_CLASS_NAMES: Final = [f"{low:g}–{high:g} px" if high < np.inf else f"≥ {low:g} px" for low, high in CLASSES]
_BLAME_DESIGNS: Final = ("none", "quarter", "half", "quarter, 150 points", "quarter, short tracks")


def right_answer(frame: pd.DataFrame) -> pd.Series:
    """Whether each image's named cause is the planted one."""
    pairs = zip(frame["kind"], frame["misfit_group"], strict=True)
    return pd.Series([is_right(kind, name) for kind, name in pairs], index=frame.index, dtype=bool)


def blame_section(scenes: pd.DataFrame) -> str:
    """Return who is rejected for misfit, for which cause, and how severe it is."""
    rows = []
    for design in _BLAME_DESIGNS:
        part = scenes[scenes["design"] == design]
        if not len(part):
            continue
        sound = part["kind"] == SOUND
        for how, column in (("alone", "effect_alone_px"), ("joint", "effect_joint_px")):
            rejected = part[column] > TAU_PX
            shares = [percent(float(rejected[part["true_px"].between(*limits)].mean())) for limits in CLASSES]
            row = (percent(float(rejected[sound].mean())), *shares, percent(float(rejected[~sound].mean())))
            rows.append((design, how, str(int(sound.sum())), str(int((~sound).sum())), *row))
    quarter = scenes[scenes["design"] == "quarter"]
    return "\n\n".join(
        [
            words.BLAME,
            table(("scenes", "test", "sound", "wrong", "sound rejected", *_CLASS_NAMES, "all wrong"), rows),
            "![Effects image by image and in the joint test](figures/validation_joint.svg)",
            words.CAUSES,
            _causes(quarter),
            "By noise, a quarter wrong:",
            _blame_by_noise(quarter),
            words.SEVERITY,
            _severity(quarter),
        ]
    )


def _causes(quarter: pd.DataFrame) -> str:
    """How often each group was named, by what was planted."""
    found, rows = quarter[(quarter["effect_joint_px"] > TAU_PX) & (quarter["kind"] != SOUND)], []
    for kind in CAMERA_DEFECTS:
        own = found[found["kind"] == str(kind)]
        counts = [str(int((own["misfit_group"] == str(group)).sum())) for group in GROUPS]
        rows.append((str(kind), str(len(own)), *counts, percent(float(right_answer(own).mean()))))
    return table(("planted", "found", *(str(group).replace("_", " ") for group in GROUPS), "right"), rows)


def _blame_by_noise(quarter: pd.DataFrame) -> str:
    rows = []
    for noise, _, part in cells(quarter):
        sound = part["kind"] == SOUND
        hit = part["verdict_misfit"] == "rejected"
        large = part["true_px"] >= 0.5
        standard = (part["policy_standard"] == "rejected")[sound]
        above = part["effect_joint_px"] > TAU_PX
        shown = (hit[sound], standard, above[large], hit[large], above[~sound], hit[~sound])
        shares = [percent(float(share.mean())) for share in shown]
        rows.append((str(noise), str(int(sound.sum())), str(int((~sound).sum())), *shares))
    header = ("noise", "sound", "wrong", "sound rejected", "by policy standard", "≥ 0.5 px found", "rejected")
    return table((*header, "all wrong found", "rejected"), rows)


def _severity(quarter: pd.DataFrame) -> str:
    """What the misfits that were found are worth, and what follows, by true size."""
    found, rows = quarter[(quarter["effect_joint_px"] > TAU_PX) & (quarter["kind"] != SOUND)], []
    for (low, high), name in zip(CLASSES, _CLASS_NAMES, strict=True):
        own = found[found["true_px"].between(low, high)]
        if own.empty:
            continue
        ratio = (own["effect_joint_px"] / own["true_px"]).quantile([0.05, 0.5, 0.95])
        worth = [own[f"misfit_worth_{what}"].abs().median() for what in ("deg", "centre", "focal_rel")]
        numbers = (*(f"{r:.2f}" for r in ratio), *(f"{w:.2g}" for w in worth))
        remarked = own["misfit_without_worth"].astype(bool)
        shares = [(own["severity"] == severity).mean() for severity in Severity]
        rows.append((name, str(len(own)), *numbers, *(percent(float(share)) for share in (*shares, remarked.mean()))))
    header = ("true size", "found", "effect / truth 5 %", "median", "95 %", "rotation, degrees", "centre / depth", "f")
    return table((*header, *(str(severity) for severity in Severity), "accepted with a remark"), rows)


def frozen_section(frame: pd.DataFrame) -> str:
    """Return what is said of parameters that were wrong and never freed."""
    rows = []
    for case in frame["case"].unique():
        own = frame[frame["case"] == case]
        guilty = own["guilty"].astype(bool)
        cameras = own[guilty].drop_duplicates(["noise", "scene", "off_sd"])
        counts = [
            f"{int((part[column] == 'rejected').sum())} of {len(part)}"
            for part, column in (
                (own[guilty], "verdict_camera"),
                (own[~guilty], "verdict_camera"),
                (own, "verdict_misfit"),
                (own[~guilty], "policy_standard"),
            )
        ]
        named = ", ".join(f"{name} {count}" for name, count in cameras["named"].value_counts().items())
        numbers = (own.loc[guilty, "own_step_px"].median(), own.loc[~guilty, "own_step_px"].max())
        steps = ["–" if np.isnan(number) else f"{number:.3f}" for number in numbers]
        off = "–" if cameras.empty else f"{cameras['off_sd'].max():.1f}"
        right = f"{int(cameras['implied_right'].sum())} of {len(cameras)}" if len(cameras) else "–"
        rows.append((case, *counts, *steps, named or "–", off, right))
    header = ("frozen", "guilty: camera", "others: camera", "misfit", "others: standard", "own_step_px, guilty")
    last = ("largest of others", "named", "worst, sd", "value right")
    return "\n\n".join([words.FROZEN, table((*header, *last), rows)])


def focal_sd_section(scenes: pd.DataFrame) -> str:
    """Return how the errors of focal lengths compare with their standard deviations."""
    rows = []
    for noise, n, part in cells(sound_scenes(scenes)):
        ratios = focal_ratios(part)
        rel = f"{100 * float((part['sd_focal_px'] / SCENE_FOCAL_PX).median()):.3f}"
        rows.append((str(noise), str(n), str(len(part)), rel, *(f"{ratio:.2f}" for ratio in ratios.values())))
    header = ("noise", "n", "images", "median sd, %", "joint", "conditional on the points")
    return "\n\n".join([words.FOCAL_SD, table(header, rows)])
