"""Decision rules side by side: share of sound images rejected, share of wrong ones found."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
import pandas as pd

from scripts.validation.truth import ALPHA, SOUND

OURS: Final = ("verdict_misfit", "policy_standard", "policy_camera", "policy_full")
SCORES: Final = {
    "effect_joint_px": "misfit effect, joint test",
    "rms_px": "RMS",
    "biasedness_8": "biasedness, 8 x 8 cells",
}


class Rule(NamedTuple):
    """A rule's decision on every image; None in ``cannot_say`` where it always decides."""

    name: str
    threshold: str
    rejects: pd.Series
    cannot_say: float = 0.0


def rules(frame: pd.DataFrame) -> list[Rule]:
    """Return the rules' decisions on the images of ``frame``."""
    out = [Rule(f"{name.replace('_', ' ')} (ours)", "", frame[name] == "rejected") for name in OURS]
    out += [
        Rule("KS, track noise model (policy paper)", "5 %", frame["policy_paper"] == "rejected"),
        Rule("KS, constant noise (the paper's rule)", "5 %", frame["ks_constant_p"] < ALPHA),
        Rule("KS with Lilliefors' null, constant noise", "5 %", frame["ks_fitted_constant_p"] < ALPHA),
        Rule("RMS", "1 px", frame["rms_px"] > 1.0),
    ]
    best = best_threshold(frame, "rms_px")
    out.append(Rule("RMS", f"{best:.3f} px, in hindsight", frame["rms_px"] > best))
    out.append(Rule("Olsson: mean outside the quartiles", "", frame["olsson_rejects"].astype(bool)))
    for column, name in (("biasedness_50", "biasedness, 50 x 50 cells"), ("biasedness_8", "biasedness, 8 x 8 cells")):
        best = best_threshold(frame, column)
        word = "–" if np.isnan(best) else f"{best:.2f}, in hindsight"
        out.append(Rule(name, word, frame[column] > best, float(frame[column].isna().mean())))
    return out


def best_threshold(frame: pd.DataFrame, column: str) -> float:
    """Return the threshold with the largest difference of detections and false alarms; NaN without values."""
    alarms, detections, thresholds = curve(frame, column)
    return float(thresholds[int(np.argmax(detections - alarms))]) if len(thresholds) else float("nan")


def curve(frame: pd.DataFrame, column: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return false alarms and detections of ``column`` > threshold, for every threshold that occurs."""
    thresholds = np.unique(frame[column].dropna().to_numpy())
    sound = np.sort(frame.loc[frame["kind"] == SOUND, column].dropna().to_numpy())
    wrong = np.sort(frame.loc[frame["kind"] != SOUND, column].dropna().to_numpy())
    alarms = 1.0 - np.searchsorted(sound, thresholds, side="right") / max(1, len(sound))
    detections = 1.0 - np.searchsorted(wrong, thresholds, side="right") / max(1, len(wrong))
    return alarms, detections, thresholds


def rule_rows(frame: pd.DataFrame) -> list[tuple[str, ...]]:
    """Return the rows of the page's table."""
    sound, large = frame["kind"] == SOUND, frame["true_px"] >= 0.5
    rows = []
    for rule in rules(frame):
        shares = [rule.rejects[chosen].mean() for chosen in (sound, ~sound, large)]
        numbers = [f"{100 * float(share):.1f} %" for share in (*shares, rule.cannot_say)]
        rows.append((rule.name, rule.threshold, *numbers))
    return rows
