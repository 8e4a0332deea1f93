"""What must hold, as numbers, against what was measured."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
import pandas as pd

from scripts.validation.singles import EXACT_DEFECTS
from scripts.validation.study import HOLDS, VIOLATED, Check, check
from scripts.validation.truth import ALPHA, ANSWERS, CAMERA_DEFECTS, SIGMA_PX, SOUND, TAU_PX, is_right
from sfm_audit.audit.misfit import GROUPS
from sfm_audit.audit.simulate.defects import DefectKind
from sfm_audit.audit.simulate.noise import NoiseKind

Tables = dict[str, pd.DataFrame]
LEVEL_TESTS: Final = ("ks_fitted", "dap", "sw")
PLAIN_KS: Final = {NoiseKind.GAUSSIAN: 0.01, NoiseKind.PER_TRACK_LOGNORMAL: 0.05}
_LARGE, _MATERIAL = "0.5 px", 0.5
_NONE_OF_2520 = 0.0015  # upper end of Wilson's 95 % interval of 0 of 2520


@dataclass(frozen=True, slots=True)
class Within:
    """A number that is no share, and its bounds."""

    claim: str
    cell: str
    value: float
    low: float
    high: float

    @property
    def rate(self) -> float:
        """The number."""
        return self.value

    @property
    def outcome(self) -> str:
        """`HOLDS` or `VIOLATED`."""
        return HOLDS if self.low <= self.value <= self.high else VIOLATED


def all_checks(tables: Tables) -> list[Check | Within]:
    """Every bound of the study; those of a table that was not made, or a cell without trials, are left out."""
    found = [
        *_misfit_size(tables["singles"], "one camera per image, independent points"),
        *_misfit_size(_design(tables, "size"), "one camera per image, bundle-adjusted"),
        *_misfit_size(_design(tables, "size, shared camera"), "shared camera, tested singly", high=0.08),
        *_joint_size(tables["scenes"]),
        *_goodness_of_fit(_design(tables, "size")),
        *_power(tables["exact"]),
        *_effects(tables["exact"], tables["power"]),
        *_quarter(_design(tables, "quarter")),
        *_no_defects(tables["scenes"]),
        *_focal_sd(tables["scenes"]),
        *_frozen(tables["frozen"]),
        *_poses_and_corners(_design(tables, "poses and corners")),
        *_cameras(tables["cameras"]),
        *_advice(tables["advice"]),
    ]
    return [check for check in found if isinstance(check, Within) or check.trials]


def _design(tables: Tables, name: str) -> pd.DataFrame:
    scenes = tables["scenes"]
    return scenes[scenes["design"] == name]


def cells(frame: pd.DataFrame) -> Iterator[tuple[NoiseKind, int, pd.DataFrame]]:
    """The rows of each noise and n."""
    for noise in NoiseKind:
        for n in sorted(frame["n"].unique()):
            part = frame[(frame["noise"] == str(noise)) & (frame["n"] == n)]
            if len(part):
                yield noise, int(n), part


def tested_share(part: pd.DataFrame, column: str) -> pd.Series | None:
    """Whether p < 5 % where the test ran; None where it ran in fewer than half of the images."""
    p = part[column].dropna()
    return p < ALPHA if 2 * len(p) > len(part) else None


def _joint_size(scenes: pd.DataFrame) -> Iterator[Check]:
    """Sound images among sound ones from n = 100 on (below it is liberal, see the page), and among wrong ones."""
    quarter = scenes[(scenes["design"] == "quarter") & (scenes["kind"] == SOUND)]
    for where, frame in (("scenes without defects, n >= 100", sound_scenes(scenes)), ("a quarter wrong", quarter)):
        for group in GROUPS:
            hits = tested_share(frame, f"misfit_{group}_p_joint")
            if hits is not None:
                yield check(f"size of the joint misfit test, {where}", str(group), hits, 0.015, 0.07)


def _misfit_size(frame: pd.DataFrame, where: str, high: float = 0.07) -> Iterator[Check]:
    for noise, n, part in cells(frame):
        for group in GROUPS:
            hits = tested_share(part, f"misfit_{group}_p")
            if hits is None:
                continue
            cell = f"{group}, {noise}, n = {n}"
            if n >= 50:
                yield check(f"size of the misfit groups from n = 50, {where}", cell, hits, 0.015, high)
            else:
                yield check(f"size of the misfit groups below n = 50, {where}", cell, hits, 0.0, 0.08)


def _goodness_of_fit(frame: pd.DataFrame) -> Iterator[Check | Within]:
    for noise, n, part in cells(frame):
        if noise not in PLAIN_KS or n < 100:
            continue
        low, high, word = (0.03, 0.07, "n >= 500") if n >= 500 else (0.02, 0.08, "100 <= n < 500")
        for test in LEVEL_TESTS:
            claim = f"size of ks_fitted, dap, sw under Gaussian and per-track noise, {word}"
            yield check(claim, f"{test}, {noise}, n = {n}", part[f"{test}_p"] < ALPHA, low, high)
        claim = "size of plain ks (conservative: pose and scale were fitted)"
        yield check(claim, f"{noise}, n = {n}", part["ks_p"] < ALPHA, 0.0, PLAIN_KS[noise])
        if noise is NoiseKind.GAUSSIAN and n >= 500:
            bias = float(part["sigma_predicted_px"].mean()) / SIGMA_PX - 1.0
            yield Within("predicted sigma is unbiased to 2 %, Gaussian, n >= 500", f"n = {n}", bias, -0.02, 0.02)
            sigma_l = float(part["sigma_l"].median())
            yield Within("sigma_l is about 0 where the noise is homoscedastic", f"n = {n}", sigma_l, 0.0, 0.15)


def _power(exact: pd.DataFrame) -> Iterator[Check]:
    groups = {DefectKind.RADIAL_K2: "radial", DefectKind.TANGENTIAL: "tangential"}
    for kind, group in groups.items():
        part = exact[exact["kind"] == str(kind)]
        values = ", ".join(f"{value:g}" for value in EXACT_DEFECTS[kind])
        cell = f"{kind} = {values}, group {group}"
        yield check("power at n = 250, sigma 0.5 px", cell, part[f"misfit_{group}_p"] < ALPHA, 0.95)


def effect_ratio(frame: pd.DataFrame) -> pd.Series:
    """The measured effect in the largest group that counts as the right answer, over the true systematic RMS."""
    ratio = pd.Series(float("nan"), index=frame.index)
    for kind, groups in ANSWERS.items():
        rows = frame["kind"] == str(kind)
        columns = [f"misfit_{group}_px" for group in groups if group != "affine" or kind is DefectKind.ASPECT]
        ratio[rows] = frame.loc[rows, columns].max(axis=1) / frame.loc[rows, "true_px"]
    return ratio


def _effects(exact: pd.DataFrame, power: pd.DataFrame) -> Iterator[Check | Within]:
    close = (effect_ratio(exact) - 1.0).abs() <= 0.2
    for kind in EXACT_DEFECTS:
        rows = exact["kind"] == str(kind)
        claim = "effect within 20 % of the truth, image by image, n = 250: k2 = 0.05, p1 = p2 = 1e-3"
        yield check(claim, str(kind), close[rows], 0.95)
    of_size = power[(power["n"] == 250) & (power["true_px"] > 0.1)]
    for kind in CAMERA_DEFECTS:
        rows = of_size["kind"] == str(kind)
        if not rows.any():
            continue
        median = float(effect_ratio(of_size)[rows].median())
        yield Within("median effect within 20 % of the truth above 0.1 px, n = 250", str(kind), median, 0.8, 1.2)


def _quarter(frame: pd.DataFrame) -> Iterator[Check]:
    where = "a quarter of the images defective"
    rejected = frame["verdict_misfit"] == "rejected"
    sound = frame["kind"] == SOUND
    claim = f"sound images rejected by verdict_misfit, {where}"
    yield check(claim, "all noises", rejected[sound], 0.0, _NONE_OF_2520)
    for name in ("verdict_camera", "verdict_pose", "policy_standard"):
        hits = (frame[name] == "rejected")[sound]
        yield check(f"sound images rejected by {name.replace('_', ' ')}, {where}", "all noises", hits, 0.0, 0.005)
    large = frame["true_px"] >= _MATERIAL
    found = frame["effect_joint_px"] > TAU_PX
    yield check(f"images of >= {_LARGE} found (effect above tau), {where}", "all noises", found[large], 0.96)
    yield check(f"images of >= {_LARGE} rejected by verdict_misfit, {where}", "all noises", rejected[large], 0.96)
    named = frame[(rejected | found) & ~sound]
    right = pd.Series(
        [is_right(kind, name) for kind, name in zip(named["kind"], named["misfit_group"], strict=True)],
        index=named.index,
        dtype=bool,
    )
    yield check(f"cause named right, {where}", "all kinds", right, 0.9)
    for kind in CAMERA_DEFECTS:
        yield check(f"cause named right, each kind, {where}", str(kind), right[named["kind"] == str(kind)], 0.7)


def _no_defects(scenes: pd.DataFrame) -> Iterator[Check]:
    part = sound_scenes(scenes)
    for noise in NoiseKind:
        own = part[part["noise"] == str(noise)]
        for policy in ("standard", "camera") if len(own) else ():
            hits = own[f"policy_{policy}"] == "rejected"
            yield check(f"scenes without defects: rejected by policy {policy}", str(noise), hits, 0.0, 0.005)


def focal_ratios(frame: pd.DataFrame) -> dict[str, float]:
    """Return the RMS of (f - truth) / sd over images, sd of the joint system and conditional on the points."""
    squares = {
        name: (frame["focal_error_px"] / frame[column]) ** 2
        for name, column in (("joint", "sd_focal_px"), ("conditional", "sd_focal_px_conditional"))
    }
    return {name: float(np.sqrt(ratio.mean())) for name, ratio in squares.items()}


def sound_scenes(scenes: pd.DataFrame) -> pd.DataFrame:
    """Images of scenes without defects and 100 points or more, own cameras."""
    return scenes[scenes["design"].isin(["none", "size"]) & (scenes["n"] >= 100)]


def _focal_sd(scenes: pd.DataFrame) -> Iterator[Within]:
    part = sound_scenes(scenes)
    for noise in NoiseKind:
        own = part[part["noise"] == str(noise)]
        if len(own):
            claim = "RMS of (f - truth) / sd, sd of f in the joint system, scenes without defects"
            yield Within(claim, str(noise), focal_ratios(own)["joint"], 0.8, 1.8)


def _frozen(frame: pd.DataFrame) -> Iterator[Check]:
    guilty = frame["guilty"].astype(bool)
    rejected = frame["verdict_camera"] == "rejected"
    for case in frame["case"].unique():
        own = frame["case"] == case
        yield check("frozen parameters: guilty images rejected by verdict_camera", case, rejected[own & guilty], 1.0)
        claim = "frozen parameters: other images of the model rejected by verdict_camera"
        yield check(claim, case, rejected[own & ~guilty], 0.0, 0.0)
        claim = "frozen parameters: other images of the model rejected by policy standard"
        yield check(claim, case, (frame["policy_standard"] == "rejected")[own & ~guilty], 0.0, 0.005)
        claim = "frozen parameters: any image rejected by verdict_misfit"
        yield check(claim, case, (frame["verdict_misfit"] == "rejected")[own], 0.0, 0.005)
        cameras = frame[own & guilty].drop_duplicates(["noise", "scene", "off_sd"])
        right = cameras["implied_right"].astype(bool)
        yield check("frozen parameters: implied value within 5 sd or 2 % of the truth", case, right, 0.95)


def _poses_and_corners(frame: pd.DataFrame) -> Iterator[Check]:
    moved, corner = (frame["kind"] == str(kind) for kind in (DefectKind.PERTURBED_POSE, DefectKind.FEW_POINTS))
    sound = frame["kind"] == SOUND
    found = frame["verdict_pose"] == "rejected"
    yield check("poses moved by >= 1 px after adjustment found by verdict_pose", "all noises", found[moved], 1.0)
    yield check("sound images rejected by verdict_pose", "all noises", found[sound], 0.0, 0.0)
    hits = (frame["policy_camera"] != "accepted")[corner]
    yield check("images with under 25 inliers in a corner not accepted by policy camera", "all noises", hits, 0.95)


def _cameras(cameras: pd.DataFrame) -> Iterator[Check]:
    sound = cameras[cameras["k2"] == 0]
    for group in GROUPS:
        hits = tested_share(sound, f"misfit_{group}_p")
        if hits is not None:
            yield check("size of the pooled misfit tests of a sound shared camera", str(group), hits, 0.0, 0.08)
    for k2 in sorted(set(cameras["k2"]) - {0.0}):
        part = cameras[(cameras["k2"] == k2) & (k2 >= 0.01)]
        if len(part):
            hits = part["misfit_radial_p"] < 0.001
            yield check(
                "a shared camera without its k2 found by the pooled test, p < 0.001", f"k2 = {k2:g}", hits, 0.95
            )


def _advice(advice: pd.DataFrame) -> Iterator[Check]:
    tried = advice[advice["passes"].notna()]
    for design in tried["design"].unique():
        hits = tried.loc[tried["design"] == design, "passes"].astype(bool)
        yield check("the advised model, refined by pycolmap, passes the misfit test", f"{design}, all kinds", hits, 0.9)
