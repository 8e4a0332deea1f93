"""The paper's ten claims, and a word for each that follows from the numbers by a rule."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import pandas as pd

from scripts.paper.board_study import RENDERED, RIGHT, WRONG
from scripts.paper.motivating import TAIL
from scripts.paper.rates import ALPHA, SCALES, TESTS, THIRDS, chosen, rates_by_third, rejects
from scripts.validation.study import VIOLATED, Check
from sfm_audit.audit.misfit import GROUPS

Tables = dict[str, pd.DataFrame]
MOSTLY: Final = 0.5  # a test that finds fewer does not separate
TOO_STRICT: Final = 2.0 * ALPHA  # share of correct cameras rejected
MARGIN: Final = 0.05  # a difference of two shares that counts
FOLLOWS: Final = 0.05  # of the ratio of predicted and empirical standard deviation, about 1
_LENGTHS: Final = "ks_norm_unscaled_plain"
LOW_SD_PX: Final = 1.0  # the threshold that one meets most often
TAILS_SHOW: Final = 2.0  # times as many values beyond the tail's start


class Word(StrEnum):
    """What became of a claim."""

    REPRODUCED = "reproduced"
    NOT_REPRODUCED = "not reproduced"
    CANNOT = "cannot be tested"


@dataclass(frozen=True, slots=True)
class Claim:
    """number: the paper's claim, with a letter for a second reading.    rule: what makes the word "reproduced"."""

    number: str
    says: str
    rule: str
    measured: str
    word: Word


def word_of(holds: bool | None) -> Word:
    """Return the word; None: there are no numbers."""
    if holds is None:
        return Word.CANNOT
    return Word.REPRODUCED if holds else Word.NOT_REPRODUCED


def rises_to_most(low: float, mid: float, high: float) -> bool | None:
    """Whether the wrong camera is rejected more often with more coverage, and mostly in the highest third."""
    if math.isnan(low + mid + high):
        return None
    return high >= MOSTLY and low <= mid <= high and low < high


def within_level(hits: int, trials: int) -> bool | None:
    """Whether a share of rejected correct cameras is no more than the level, up to chance."""
    return None if not trials else Check("", "", hits, trials, 0.0, ALPHA).outcome != VIOLATED


def too_strict(hits: int, trials: int) -> bool | None:
    """Whether a test rejects correct cameras more often than at twice its level, and chance does not explain it."""
    return None if not trials else Check("", "", hits, trials, 0.0, TOO_STRICT).outcome == VIOLATED


def too_permissive(found: float, found_by_ks: float) -> bool | None:
    """Whether a test misses most wrong cameras, or more of them than KS does."""
    if math.isnan(found + found_by_ks):
        return None
    return found < MOSTLY or found < found_by_ks - MARGIN


def follows(ratios: tuple[float, ...]) -> bool | None:
    """Whether predicted / empirical standard deviation is 1 in all thirds."""
    if any(math.isnan(ratio) for ratio in ratios):
        return None
    return all(abs(ratio - 1.0) <= FOLLOWS for ratio in ratios)


def low_sd_proves_nothing(sd_wrong: pd.Series) -> bool | None:
    """Whether most of the wrong cameras that are found out have a standard deviation (px) that one calls low."""
    return None if not len(sd_wrong) else bool((sd_wrong < LOW_SD_PX).mean() >= MOSTLY)


def only_third_plausible(m1: float, m3: float) -> bool | None:
    """Whether KS mostly rejects M1 and mostly accepts M3."""
    return None if math.isnan(m1 + m3) else m1 >= MOSTLY and m3 < MOSTLY


def shows_tails(robust: float, plain: float) -> bool | None:
    """Whether the robust scale leaves clearly more values in the tails than the plain one."""
    return None if math.isnan(robust + plain) else robust >= TAILS_SHOW * plain


def finds_more(first: float, second: float) -> bool | None:
    """Whether the first share exceeds the second by more than `MARGIN`."""
    return None if math.isnan(first + second) else first > second + MARGIN


def mostly(share: float) -> bool | None:
    """Whether it is a majority."""
    return None if math.isnan(share) else share >= MOSTLY


def percent(share: float) -> str:
    """Without decimals, as the paper's figures are read."""
    return "–" if math.isnan(share) else f"{100.0 * share:.0f} %"


def per_third(shares: tuple[float, float, float]) -> str:
    """Low / mid / high."""
    return " / ".join("–" if math.isnan(share) else f"{100.0 * share:.0f}" for share in shares) + " %"


def judge_claims(tables: Tables, source: str = RENDERED) -> list[Claim]:
    """Return all claims; a table that was not made gives claims that cannot be tested."""
    boards = tables.get("boards", pd.DataFrame())
    if len(boards):
        boards = chosen(boards, source=source, refused="no")
    return [
        _rejects_wrong(boards, "1", "ks_robust", "KS of the signed residuals, robust scale"),
        _rejects_wrong(boards, "1b", "ks_plain", "KS of the signed residuals, maximum-likelihood scale"),
        _rejects_wrong(boards, "1c", _LENGTHS, "KS of the lengths, maximum-likelihood scale"),
        _accepts_right(boards, "2", "ks_robust", "KS of the signed residuals, robust scale"),
        _accepts_right(boards, "2c", _LENGTHS, "KS of the lengths, maximum-likelihood scale"),
        _dap(boards),
        _sw(boards),
        _predicted(boards),
        _low_sd(boards),
        _zhang(tables),
        _tails(tables),
        _scales(tables),
        _olsson(boards, tables),
        _megadepth_share(tables),
        _megadepth_cause(tables),
    ]


def of_model(boards: pd.DataFrame, model: str) -> pd.DataFrame:
    """Return a model's rows; none of none."""
    return chosen(boards, model=model) if len(boards) else boards


def upper_thirds(frame: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of the mid and high third."""
    return frame[frame["third"] != THIRDS[0]] if len(frame) else frame


def _share(frame: pd.DataFrame, column: str) -> float:
    return float(rejects(frame, column).mean()) if len(frame) else math.nan


def _thirds(frame: pd.DataFrame, column: str) -> tuple[float, float, float]:
    return rates_by_third(frame, column) if len(frame) else (math.nan, math.nan, math.nan)


def _rejects_wrong(boards: pd.DataFrame, number: str, column: str, how: str) -> Claim:
    rates = _thirds(of_model(boards, WRONG), column)
    return Claim(
        number,
        f"KS rejects D(1,0), more so with coverage ({how})",
        f"rejected shares rise over the thirds of coverage to {percent(MOSTLY)} or more",
        f"{per_third(rates)} rejected by third",
        word_of(rises_to_most(*rates)),
    )


def _accepts_right(boards: pd.DataFrame, number: str, column: str, how: str) -> Claim:
    right = of_model(boards, RIGHT)
    hits = int(rejects(right, column).sum()) if len(right) else 0
    return Claim(
        number,
        f"KS accepts D(3,0) ({how})",
        f"no more than {percent(ALPHA)} rejected, up to chance",
        f"{hits} of {len(right)} rejected",
        word_of(within_level(hits, len(right))),
    )


def _dap(boards: pd.DataFrame) -> Claim:
    right = of_model(boards, RIGHT)
    hits = int(rejects(right, "dap_robust").sum()) if len(right) else 0
    return Claim(
        "3",
        "D'Agostino-Pearson is too strict",
        f"it rejects more than {percent(TOO_STRICT)} of the correct cameras, beyond chance",
        f"{hits} of {len(right)} D(3,0) rejected ({percent(_share(right, 'dap_robust'))})",
        word_of(too_strict(hits, len(right))),
    )


def _sw(boards: pd.DataFrame) -> Claim:
    wrong = upper_thirds(of_model(boards, WRONG))
    found, by_ks = _share(wrong, "sw_robust"), _share(wrong, "ks_robust")
    return Claim(
        "4",
        "Shapiro-Wilk is too permissive",
        f"in the upper two thirds it finds fewer than {percent(MOSTLY)} of D(1,0), or fewer than KS",
        f"{percent(found)} found; KS {percent(by_ks)}",
        word_of(too_permissive(found, by_ks)),
    )


def predicted_ratios(frame: pd.DataFrame, scale: str = "robust") -> tuple[float, ...]:
    """Return the median of predicted / empirical standard deviation in each third."""
    if not len(frame):
        return (math.nan,) * len(THIRDS)
    ratio = frame[f"predicted_{scale}"] / frame["sd"]
    return tuple(float(ratio[frame["third"] == third].median()) for third in THIRDS)


def _predicted(boards: pd.DataFrame) -> Claim:
    right, wrong = (predicted_ratios(of_model(boards, model)) for model in (RIGHT, WRONG))
    text = " / ".join(f"{ratio:.3f}" for ratio in right)
    other = " / ".join(f"{ratio:.3f}" for ratio in wrong)
    return Claim(
        "5",
        "the predicted sd follows the empirical one under the right model",
        f"median ratio within {percent(FOLLOWS)} of 1 in every third",
        f"D(3,0) {text}; D(1,0) {other} by third",
        word_of(follows(right)),
    )


def _low_sd(boards: pd.DataFrame) -> Claim:
    right, wrong = of_model(boards, RIGHT), of_model(boards, WRONG)
    found = wrong.loc[rejects(wrong, "verdict_misfit"), "sd"] if len(wrong) else pd.Series(dtype=float)
    low = float((found < LOW_SD_PX).mean()) if len(found) else math.nan
    shared = float((found <= right["sd"].max()).mean()) if len(found) else math.nan
    return Claim(
        "6",
        "a low sd does not prove the model",
        f"{percent(MOSTLY)} or more of the D(1,0) that misfit rejects have a sd below {LOW_SD_PX:g} px",
        f"{percent(low)} of {len(found)}; {percent(shared)} have a sd that D(3,0) has too",
        word_of(low_sd_proves_nothing(found)),
    )


def _zhang(tables: Tables) -> Claim:
    frame = tables.get("zhang", pd.DataFrame())
    share = {m: _share(chosen(frame, model=m) if len(frame) else frame, "ks_robust") for m in ("M1", "M3", "M5")}
    text = ", ".join(f"{model} {percent(rate)}" for model, rate in share.items())
    return Claim(
        "7",
        "of Zhang's models M1 is wrong and M3 plausible (simulated stand-ins: of theirs only M5 is right)",
        f"KS rejects M1 in {percent(MOSTLY)} or more of the runs and M3 in fewer, on held-out views",
        f"rejected: {text}",
        word_of(only_third_plausible(share["M1"], share["M3"])),
    )


def _motivating(tables: Tables, column: str) -> dict[str, float]:
    frame = tables.get("motivating", pd.DataFrame())
    if not len(frame):
        return dict.fromkeys(("winsorised", "MAD", "plain"), math.nan)
    return {str(k): float(v) for k, v in chosen(frame, wrong=True).groupby("scale")[column].mean().items()}


def _tails(tables: Tables) -> Claim:
    tail = _motivating(tables, "tail")
    shares = {name: f"{100.0 * share:.1f} %" for name, share in tail.items()}
    measured = f"{shares['winsorised']} of the values (MAD {shares['MAD']}), plain {shares['plain']}; normal 0.27 %"
    return Claim(
        "8",
        "robust scaling exposes a wrong model that plain scaling hides (tails of the motivating example)",
        f"{TAILS_SHOW:g} times as many values beyond {TAIL:g} sd under the robust scale",
        measured,
        word_of(shows_tails(tail["winsorised"], tail["plain"])),
    )


def _scales(tables: Tables) -> Claim:
    rate = _motivating(tables, "ks_rejects")
    return Claim(
        "8b",
        "the same, as KS decides",
        f"KS rejects more often, by {percent(MARGIN)} or more, under the robust scale",
        f"rejected {percent(rate['winsorised'])} (MAD {percent(rate['MAD'])}), plain {percent(rate['plain'])}",
        word_of(finds_more(rate["winsorised"], rate["plain"])),
    )


def separations(boards: pd.DataFrame) -> dict[str, float]:
    """Return, by statistic, the share of D(1,0) found in the upper two thirds less the share of D(3,0) rejected."""
    wrong, right = upper_thirds(of_model(boards, WRONG)), of_model(boards, RIGHT)
    columns = [f"{test}_{scale}" for test in TESTS for scale in SCALES] + ["verdict_misfit"]
    return {column: _share(wrong, column) - _share(right, column) for column in columns}


def olsson_shares(boards: pd.DataFrame) -> tuple[float, float]:
    """Return the shares of wrong and of right cameras that Olsson's rule accepts, upper two thirds."""
    if not len(boards):
        return math.nan, math.nan
    both = (upper_thirds(of_model(boards, model))["olsson_rejects"].astype(bool) for model in (WRONG, RIGHT))
    wrong, right = (1.0 - float(rejected.mean()) for rejected in both)
    return wrong, right


def _olsson(boards: pd.DataFrame, tables: Tables) -> Claim:
    wrong, right = olsson_shares(boards)
    frame = tables.get("motivating", pd.DataFrame())
    one_dimensional = ""
    if len(frame):
        shares = [float(chosen(frame, wrong=claim)["olsson_accepts"].mean()) for claim in (True, False)]
        one_dimensional = f"; motivating example: wrong {percent(shares[0])}, right {percent(shares[1])}"
    return Claim(
        "9",
        "Olsson's rule prefers wrong models",
        f"it accepts D(1,0) more often than D(3,0), by {percent(MARGIN)} or more, in the upper two thirds",
        f"accepted: D(1,0) {percent(wrong)}, D(3,0) {percent(right)}{one_dimensional}",
        word_of(finds_more(wrong, right)),
    )


def _tested_images(tables: Tables) -> pd.DataFrame:
    frame = tables.get("megadepth", pd.DataFrame())
    return frame[frame["ks_constant_p"].notna()] if len(frame) else frame


def _megadepth_share(tables: Tables) -> Claim:
    frame = _tested_images(tables)
    share = _share(frame, "ks_constant_p")
    return Claim(
        "10",
        "70 of 100 MegaDepth images are rejected (KS, one scale per image)",
        f"{percent(MOSTLY)} or more of the images of a tree of that layout are rejected",
        f"{percent(share)} of {len(frame)} images" if len(frame) else "not run: no corpus",
        word_of(mostly(share)),
    )


def _megadepth_cause(tables: Tables) -> Claim:
    frame = _tested_images(tables)
    rejected = frame[rejects(frame, "ks_constant_p")] if len(frame) else frame
    stay = _share(rejected, "ks_p")
    wrong, others = _share(rejected, "verdict_misfit"), math.nan
    if len(frame):
        others = _share(frame[~rejects(frame, "ks_constant_p")], "verdict_misfit")
    measured = "not run: no corpus"
    if len(frame):
        measured = f"{percent(stay)} of {len(rejected)} stay; misfit rejects {percent(wrong)} of them"
        measured += f", {percent(others)} of the others"
    return Claim(
        "10b",
        "these rejections mean over-fitted cameras",
        f"{percent(MOSTLY)} or more of them stay when noise may differ from track to track",
        measured,
        word_of(mostly(stay)),
    )


def misfit_checks(boards: pd.DataFrame) -> list[Check]:
    """Return what must hold in each source of corners: of `verdict_misfit`, and of method.md section 9's numbers."""
    found = []
    for source in sorted(boards["source"].unique()):
        part = chosen(boards, source=source)
        wrong, right = of_model(part, WRONG), of_model(part, RIGHT)
        upper = upper_thirds(wrong)
        bands = (
            ("verdict_misfit rejects D(1,0), upper two thirds", upper, "verdict_misfit", 0.95, 1.0),
            ("verdict_misfit rejects D(3,0)", right, "verdict_misfit", 0.0, 0.06),
            ("KS of lengths, ML scale, D(1,0), low third", _third(wrong, "low"), _LENGTHS, 0.0, 0.1),
            ("KS of lengths, ML scale, D(1,0), mid third", _third(wrong, "mid"), _LENGTHS, 0.6, 0.9),
            ("KS of lengths, ML scale, D(1,0), high third", _third(wrong, "high"), _LENGTHS, 0.95, 1.0),
            ("KS of lengths, ML scale, D(3,0)", right, _LENGTHS, 0.0, 0.06),
            ("KS of signed residuals, robust scale, D(1,0)", wrong, "ks_robust", 0.0, 0.1),
            ("KS of signed residuals, robust scale, D(3,0)", right, "ks_robust", 0.0, 0.05),
        )
        for name, frame, column, low, high in bands:
            hits = rejects(frame, column)
            found.append(Check(name, source, int(hits.sum()), len(frame), low, high))
    return [check for check in found if check.trials]


def _third(frame: pd.DataFrame, third: str) -> pd.DataFrame:
    return chosen(frame, third=third)


def groups_that_ran(frame: pd.DataFrame) -> str:
    """Name the misfit groups that ran in all, in some (share) and in none of the rows."""
    shares = {str(group): float(frame[f"{group}_ran"].astype(bool).mean()) for group in GROUPS}
    named = [f"{group}" + ("" if share == 1.0 else f" ({percent(share)})") for group, share in shares.items() if share]
    absent = [group for group, share in shares.items() if not share]
    text = ", ".join(name.replace("_", " ") for name in named)
    return text + (f"; never {', '.join(name.replace('_', ' ') for name in absent)}" if absent else "")
