"""docs/paper.md: what was claimed, what was measured, and the words for it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import pandas as pd

from scripts.paper import words
from scripts.paper.board_study import PROTECTIONS, RENDERED, RIGHT, WRONG
from scripts.paper.claims import (
    Claim,
    Tables,
    Word,
    groups_that_ran,
    judge_claims,
    of_model,
    olsson_shares,
    per_third,
    percent,
    predicted_ratios,
    separations,
)
from scripts.paper.figures import examples, label
from scripts.paper.motivating import SCALES as MOTIVATING_SCALES
from scripts.paper.motivating import SIGMAS, SIZES
from scripts.paper.rates import SCALES, TESTS, THIRDS, chosen, rates_by_third, rejects
from scripts.paper.tables import CAMERAS, NUM_TRAIN, NUM_VIEWS, ROOM_MODELS
from scripts.validation.markdown import table
from scripts.validation.study import Check

STAND_FOR: Final = {"plain": "axisp3364", "wide": "axis223m"}
PAPER_ZHANG: Final = {  # method.md section 9: sd on held-out views, px
    "plain": {"M1": 2.91, "M2": 2.73, "M3": 2.95, "M4": 2.52, "M5": 0.19},
    "wide": {"M1": 2.99, "M2": 2.96, "M3": 3.03, "M4": 3.19, "M5": 0.81},
}
PAPER_ROOM: Final = {
    ("plain", "D1"): "1.71: KS, DAP",
    ("plain", "D3"): "1.47: none",
    ("plain", "pnprf"): "1.08: none",
    ("wide", "D1"): "2.23: KS, DAP",
    ("wide", "D3"): "0.98: DAP",
    ("wide", "pnprf"): "1.05: DAP",
}
NAMES: Final = {"D1": "EAPRD D(1,0)", "D3": "EAPRD D(3,0)", "pnprf": "PnPRF"}
TEST_NAMES: Final = {"ks": "KS", "dap": "DAP", "sw": "SW"}
_BOLD: Final = {
    Word.REPRODUCED: "reproduced",
    Word.NOT_REPRODUCED: "**not reproduced**",
    Word.CANNOT: "*cannot be tested*",
}


def document(tables: Tables, checks: Sequence[Check], seed: int) -> str:
    """Return the whole page."""
    source = main_source(tables)
    claims = judge_claims(tables, source)
    sections = [
        words.INTRO.format(seed=seed),
        _summary(tables, claims, source),
        _claims(claims, source),
        _motivating(tables["motivating"]),
        _boards(tables["boards"]),
        _protection(tables.get("protection")),
        _tables(tables["zhang"], tables["rooms"]),
        _megadepth(tables.get("megadepth")),
        _olsson(tables, source),
        _checks(checks),
        words.LIMITS,
    ]
    return "\n\n".join(section for section in sections if section) + "\n"


def main_source(tables: Tables) -> str:
    """Rendered boards decide where there are any."""
    sources = tables["boards"]["source"].unique()
    return RENDERED if RENDERED in sources else str(sources[0])


def _summary(tables: Tables, claims: Sequence[Claim], source: str) -> str:
    """Ten lines for the statistician."""
    found = {claim.number: claim for claim in claims}
    boards = chosen(tables["boards"], source=source, refused="no")

    def thirds(model: str, column: str) -> str:
        return per_third(rates_by_third(of_model(boards, model), column))

    def said(*numbers: str) -> str:
        return ", ".join(f"{number} {found[number].word}" for number in numbers)

    counts = [f"{sum(claim.word is word for claim in claims)} {word}" for word in Word]
    olsson = olsson_shares(boards)
    return words.SUMMARY.format(
        counts=f"Of {len(claims)} claims, second readings included: " + ", ".join(counts),
        ks_robust=thirds(WRONG, "ks_robust"),
        ks_plain=thirds(WRONG, "ks_plain"),
        lengths=thirds(WRONG, "ks_norm_unscaled_plain"),
        lengths_right=thirds(RIGHT, "ks_norm_unscaled_plain"),
        misfit=thirds(WRONG, "verdict_misfit"),
        misfit_right=thirds(RIGHT, "verdict_misfit"),
        dap_right=thirds(RIGHT, "dap_robust"),
        sw=thirds(WRONG, "sw_robust"),
        olsson_wrong=percent(olsson[0]),
        olsson_right=percent(olsson[1]),
        megadepth=found["10"].measured,
        cause=found["10b"].measured,
        zhang=found["7"].measured,
        best=_best(boards),
        sd=found["5"].measured,
        low_sd=found["6"].measured,
        tails=found["8"].measured,
        scales=found["8b"].measured,
        said_1=said("1", "1b"),
        said_1c=said("1c", "2c"),
        said_3=said("3", "4"),
        said_5=said("5", "6"),
        said_8=said("8", "8b"),
        said_9=said("9"),
        said_10=said("10", "10b"),
        said_7=said("7"),
    )


def _best(boards: pd.DataFrame) -> str:
    """Say which statistic separates best, and which is next."""
    share = separations(boards)
    first, second = sorted(share, key=lambda name: -share[name])[:2]
    numbers = f"found in the upper thirds less rejected D(3,0): {percent(share[first])}, then `{second}`"
    return f"`{first}` separates best ({numbers} {percent(share[second])})"


def _claims(claims: Sequence[Claim], source: str) -> str:
    rows = [(claim.number, claim.says, claim.rule, claim.measured, _BOLD[claim.word]) for claim in claims]
    header = ("", "the paper says", "reproduced if", "measured", "word")
    return "\n\n".join([words.CLAIMS.format(boards=source), left_table(header, rows)])


def number(value: float) -> str:
    """Two decimals; a dash where there is none."""
    return "–" if math.isnan(value) else f"{value:.2f}"


def left_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table of text."""
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)])


def _motivating(frame: pd.DataFrame) -> str:
    rows = []
    for n in SIZES:
        for sigma in SIGMAS:
            cell = chosen(frame, n=n, sigma=sigma, wrong=True)
            row = [str(n), f"{sigma:g}", str(len(chosen(cell, scale="plain")))]
            for name in MOTIVATING_SCALES:
                own = chosen(cell, scale=name)
                row += [percent(float(own["ks_rejects"].mean())), f"{100 * own['tail'].mean():.1f} %"]
            row += [percent(float(cell["olsson_accepts"].mean()))]
            rows.append(row)
    header = ["n", "sigma", "trials"]
    for name in MOTIVATING_SCALES:
        header += [f"KS, {name}", "tail"]
    wrong = chosen(frame, wrong=True).groupby("scale")["ks_rejects"].mean()
    more = "more often" if wrong["plain"] > wrong["winsorised"] else "less often"
    comparison = f"{more} ({percent(wrong['plain'])} against {percent(wrong['winsorised'])} over all cells)"
    right = chosen(frame, wrong=False)
    size = ", ".join(f"{name} {percent(chosen(right, scale=name)['ks_rejects'].mean())}" for name in MOTIVATING_SCALES)
    note = f"The true hypothesis is rejected by KS under the scale {size}."
    return "\n\n".join([words.MOTIVATING.format(comparison=comparison), table([*header, "Olsson accepts"], rows), note])


def _boards(boards: pd.DataFrame) -> str:
    seeds = f"{boards.groupby('source')['seed'].nunique().max()}"
    rendered = chosen(boards, source=RENDERED)
    detector = "not rendered" if not len(rendered) else f"{rendered['detector_sd'].median():.3f}"
    parts = [words.BOARDS.format(seeds=seeds, detector=detector)]
    parts += [_rates(boards, str(source)) for source in sorted(boards["source"].unique(), reverse=True)]
    parts += [words.DEVIATIONS, _deviations(boards)]
    judged = boards[boards["refused"] == "no"]
    ran = {model: groups_that_ran(of_model(judged, model)) for model in (WRONG, RIGHT)}
    parts.append(words.GROUPS.format(wrong=ran[WRONG], right=ran[RIGHT]))
    return "\n\n".join(parts)


def _rates(boards: pd.DataFrame, source: str) -> str:
    """Share of sets rejected, by statistic, model and third."""
    part = chosen(boards, source=source)
    columns = [(f"{test}, {scale}", f"{test}_{scale}") for test in TESTS for scale in SCALES]
    columns += [("ks, literal", "ks_literal"), ("ks, median without factor", "ks_median")]
    columns += [("misfit, some group after Holm", "misfit_p"), ("verdict_misfit", "verdict_misfit")]
    rows = []
    for name, column in columns:
        rates = [rates_by_third(of_model(part, model), column) for model in (WRONG, RIGHT)]
        rows.append((name, *(percent(share) for shares in rates for share in shares)))
    sizes = [len(chosen(part, model=model, third=third)) for model in (WRONG, RIGHT) for third in THIRDS]
    rows.append(("sets", *(str(size) for size in sizes)))
    refused = int((part["refused"] != "no").sum())
    tail = f" Refused by the estimator: {refused} of {len(part)}."
    header = (source, *(f"{name} {third}" for name in ("D(1,0)", "D(3,0)") for third in THIRDS))
    return f"Share of sets rejected at 5 %, corners: {source}.{tail}\n\n" + table(header, rows)


def _deviations(boards: pd.DataFrame) -> str:
    rows = []
    for source in sorted(boards["source"].unique(), reverse=True):
        for model, name in ((WRONG, "D(1,0)"), (RIGHT, "D(3,0)")):
            part = chosen(boards, source=source, model=model, refused="no")
            ratios = [f"{r:.3f}" for scale in SCALES for r in predicted_ratios(part, scale)]
            sds = [f"{chosen(part, third=third)['sd'].median():.3f}" for third in THIRDS]
            rows.append((f"{source}, {name}", *ratios, *sds))
    header = ("", *(f"{scale} {third}" for scale in SCALES for third in THIRDS), *(f"sd {third}" for third in THIRDS))
    return table(header, rows)


def _protection(frame: pd.DataFrame | None) -> str:
    if frame is None:
        return ""
    rows = []
    for points in PROTECTIONS:
        part = chosen(frame, points=points)
        shares = [
            float(chosen(part, model=model, third=third)["significant"].mean())
            for model in (WRONG, RIGHT)
            for third in THIRDS
        ]
        rows.append((points, *(percent(share) for share in shares)))
    header = ("points are", *(f"{name} {third}" for name in ("D(1,0)", "D(3,0)") for third in THIRDS))
    return "\n\n".join([words.PROTECTION, table(header, rows)])


def _tables(zhang: pd.DataFrame, rooms: pd.DataFrame) -> str:
    rows = []
    for camera in CAMERAS:
        for model in PAPER_ZHANG[camera]:
            part = chosen(zhang, camera=camera, model=model)
            numbers = (f"{part['sd'].median():.2f}", f"{part['train_sd'].median():.2f}", f"{part['f'].median():.1f}")
            ks = [percent(float(rejects(part, f"{test}_robust").mean())) for test in TEST_NAMES]
            rows.append((f"{camera}, {model}", *numbers, *ks, f"{PAPER_ZHANG[camera][model]:.2f}"))
    runs = zhang["seed"].nunique()
    intro = words.TABLES.format(train=NUM_TRAIN, held=NUM_VIEWS - NUM_TRAIN, runs=runs)
    header = ("", "sd, held out", "sd, used", "f", *TEST_NAMES.values(), "paper's sd")
    room_header = (
        "",
        "f",
        "k1",
        "k2",
        "k3",
        "sd",
        "predicted",
        *TEST_NAMES.values(),
        "misfit",
        "few",
        "refused",
        "paper's sd, rejecting",
    )
    rooms_intro = words.ROOMS.format(rooms=len(rooms) // (len(CAMERAS) * len(ROOM_MODELS)))
    room_rows = [_room_row(chosen(rooms, camera=camera, model=model)) for camera in CAMERAS for model in ROOM_MODELS]
    return "\n\n".join([intro, table(header, rows), rooms_intro, table(room_header, room_rows)])


def _room_row(part: pd.DataFrame) -> tuple[str, ...]:
    camera, model = str(part["camera"].iloc[0]), str(part["model"].iloc[0])
    solved = chosen(part, refused="no")
    numbers = [f"{solved['f'].median():.1f}", *(f"{solved[k].median():.3f}" for k in ("k1", "k2", "k3"))]
    numbers += [f"{solved[name].median():.2f}" for name in ("sd", "predicted_robust")]
    tests = [percent(float(rejects(solved, column).mean())) for column in (*(f"{t}_robust" for t in TEST_NAMES),)]
    misfit = percent(float(rejects(solved, "verdict_misfit").mean()))
    few = percent(float((solved["verdict_misfit"] == "undetermined").mean()))
    refused = percent(float((part["refused"] != "no").mean()))
    name = f"{camera} ({STAND_FOR[camera]}), {NAMES[model]}"
    return name, *numbers, *tests, misfit, few, refused, PAPER_ROOM[camera, model]


def _megadepth(images: pd.DataFrame | None) -> str:
    if images is None:
        return words.NO_CORPUS
    models = images["model"].nunique()
    intro = words.MEGADEPTH.format(images=len(images), models=models)
    columns = ("ks_constant_p", "ks_whitened_p", "ks_p", "verdict_misfit", "verdict_pose", "plausible", "verdict")
    names = ("KS, constant", "KS, whitened", "KS, track", "misfit", "pose", "plausible", "policy full")
    rows = []
    for name, part in [*images.groupby("model"), ("all", images)]:
        rms = f"{part['rms_px'].median():.2f}"
        kurtosis = [number(part[k].median()) for k in ("kurtosis_constant", "kurtosis_excess")]
        shares = [percent(float(rejects(part.dropna(subset=[column]), column).mean())) for column in columns]
        rows.append((str(name), str(len(part)), rms, *shares, *kurtosis))
    header = ("model", "images", "rms, px", *names, "kurtosis, constant", "kurtosis, track")
    return "\n\n".join([intro, table(header, rows), _megadepth_words(images), _examples(images)])


def _megadepth_words(images: pd.DataFrame) -> str:
    hit, misfit = rejects(images, "ks_constant_p"), rejects(images, "verdict_misfit")
    track = rejects(images, "ks_p")
    stay = int((hit & track).sum())
    clean = int((hit & ~track & ~misfit & ~rejects(images, "verdict_pose")).sum())
    ratio = images["scale_ratio"].dropna()
    return words.MEGADEPTH_WORDS.format(
        rejected=int(hit.sum()),
        stay=stay,
        clean=clean,
        gone=percent(1.0 - stay / hit.sum()) if hit.any() else "–",
        misfit=int(misfit.sum()),
        images=len(images),
        both=percent(float(misfit[hit].mean())),
        others=percent(float(misfit[~hit].mean())),
        ratio=f"{ratio.median():.2f}",
        below=percent(float((ratio < 1.0).mean())),
    )


def _examples(images: pd.DataFrame) -> str:
    rows = []
    for row, word in zip(examples(images), ("accepts", "rejects"), strict=True):
        misfit = f"{row['misfit_group']} {row['misfit_px']:.2f} px" if isinstance(row["misfit_group"], str) else "none"
        numbers = (str(int(row["num_inliers"])), f"{row['rms_px']:.2f}", f"{row['mean_track_length']:.1f}")
        tests = [f"D = {row[f'{ks}_stat']:.3f}, p = {row[f'{ks}_p']:.2g}" for ks in ("ks_constant", "ks")]
        rows.append((label(row), word, *numbers, *tests, misfit, str(row["verdict"])))
    header = ("image", "KS, constant", "inliers", "rms, px", "track", "constant", "track noise", "misfit", "verdict")
    return table(header, rows)


def _olsson(tables: Tables, source: str) -> str:
    rows = []
    boards = chosen(tables["boards"], source=source, refused="no")
    groups = [
        (f"board, {name}, {third} third", chosen(of_model(boards, model), third=third))
        for model, name in ((WRONG, "D(1,0), wrong"), (RIGHT, "D(3,0), right"))
        for third in THIRDS
    ]
    rooms = chosen(tables["rooms"], refused="no")
    groups += [
        (f"room, {c}, {NAMES[m]}, wrong", chosen(rooms, camera=c, model=m)) for c in CAMERAS for m in ROOM_MODELS
    ]
    if "megadepth" in tables:
        groups.append(("MegaDepth's layout", tables["megadepth"]))
    for name, part in groups:
        olsson = 1.0 - float(part["olsson_rejects"].astype(bool).mean()) if len(part) else math.nan
        misfit = 1.0 - float(rejects(part, "verdict_misfit").mean()) if len(part) else math.nan
        rows.append((name, str(len(part)), percent(olsson), percent(misfit)))
    return "\n\n".join([words.OLSSON, table(("", "images", "Olsson accepts", "misfit does not reject"), rows)])


def _checks(checks: Sequence[Check]) -> str:
    rows = [
        (c.claim, c.cell, f"{percent(c.low)} to {percent(c.high)}", f"{100 * c.rate:.1f} %", str(c.trials), c.outcome)
        for c in checks
    ]
    return "\n\n".join([words.CHECKS, table(("", "corners", "band", "measured", "sets", ""), rows)])
