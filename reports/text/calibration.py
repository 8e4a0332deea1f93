"""Which estimated camera holds? The comparison that ``sfm-audit calibrate`` prints, made from its table's rows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, Final

from sfm_audit.audit.table.words import is_remark
from sfm_audit.reports.run_folder.reader import Row
from sfm_audit.reports.text.drawing import Field, Listing, Page, draw
from sfm_audit.reports.text.legend import level_words
from sfm_audit.reports.text.summary import SHORT_GROUP, VERDICT_STYLE
from sfm_audit.reports.text.wording import MISSING, counted, number, paragraph, plain, probability, px

_NOISE_WORDS: Final = {
    "constant": "noise constant (one scale for all)",
    "lidar": "noise lidar (detector and scan, by the neighbours of each point)",
}
CAVEATS: Final = (
    "KS judges the noise, misfit the camera: KS alone accepts many a wrong lens.",
    "A low sd does not prove a model: an estimator that bends to its points leaves small residuals.",
    "sd of f and expected error take the 3D points as exact, and hold only if the model does.",
    "Undetermined is no pass: these correspondences do not say enough about the camera.",
)


def render_calibration(rows: Sequence[Row], settings: Mapping[str, Any], page: Page) -> str:
    """Return the page as text, every line at most ``page.width`` cells wide.

    Parameters
    ----------
    rows : of the table ``calibration``, one per estimator
    settings : alpha, min_effect, policy, seed, threshold_px
    """
    found = [row for row in rows if row["num_inliers"] is not None]
    parts = [_heading(rows[0], found, settings, page.width)]
    if found:
        names = [[row["model"]] for row in found]
        parts.append(draw(Listing("Cameras", "model", names, found), _camera_fields(), page))
        parts.append(draw(Listing("Is the noise what the noise model says?", "model", names, found), _noise(), page))
        parts.append(draw(Listing("Does the camera model hold?", "model", names, found), _misfit(), page))
        parts.append(draw(Listing("Do the points determine it?", "model", names, found), _evidence(), page))
    parts.append(_reasons(rows, page.width))
    if found:
        parts.append("\n".join(paragraph(line, page.width, "  ") for line in _notes(found, settings)))
    return "\n".join(part.rstrip("\n") + "\n" for part in parts)


def _heading(row: Row, found: Sequence[Row], settings: Mapping[str, Any], width: int) -> str:
    what = f"{plain(row['correspondences'])}: {counted(row['num_correspondences'], 'correspondence')}"
    noise = _NOISE_WORDS[found[0]["noise_model"]] if found else "no camera found"
    said = f"{what}, image of {row['width']} x {row['height']} px; {noise}"
    return paragraph(f"{said}; judged by policy {settings['policy']}; {level_words(settings)}", width, "  ")


def _camera_fields() -> list[Field]:
    return [
        Field("\nf px", _focal),
        *(Field(f"\n{name}", partial(_coefficient, name)) for name in ("k1", "k2", "k3")),
        Field("sd px\nempir.", lambda r: px(r["sd_px"])),
        Field("sd px\npredic.", lambda r: px(r["sd_predicted_px"])),
        Field("tests that\nreject", lambda r: ", ".join(r["tests_rejecting"]) or "none", numeric=False),
        Field("\nverdict", lambda r: r["verdict"], lambda r: VERDICT_STYLE[r["verdict"]], numeric=False),
    ]


def _noise() -> list[Field]:
    return [
        Field("robust\nKS p", lambda r: probability(r["ks_p"])),
        Field("\nDAP p", lambda r: probability(r["dap_p"])),
        Field("\nSW p", lambda r: probability(r["sw_p"])),
        Field("plain\nKS p", lambda r: probability(r["ks_plain_p"])),
        Field("sigma d\npx", lambda r: px(r["sigma_d_px"])),
        Field("sigma l\nsteps", lambda r: number(r["sigma_l"], 3)),
        Field("excess\nkurtosis", lambda r: number(r["kurtosis_excess"])),
        Field("mean within\nquartiles", lambda r: "yes" if r["olsson_accepts"] else "no", numeric=False),
    ]


def _misfit() -> list[Field]:
    return [
        *(Field(f"{group}\np", partial(_group_p, group)) for group in ("radial", "tangential", "affine", "smooth")),
        Field("\ncause", _cause, numeric=False),
        Field("effect\npx", lambda r: px(r["misfit_px"])),
        Field("matters\nabove", lambda r: px(r["tau_px"])),
    ]


def _evidence() -> list[Field]:
    return [
        Field("in-\nliers", lambda r: str(r["num_inliers"])),
        Field("sd f\n/ f", lambda r: _percent(r["sd_focal_rel"])),
        Field("corr.\nf, z", lambda r: number(r["correlation_focal_depth"], 3)),
        Field("flat-\nness", lambda r: _flatness(r["planarity"])),
        Field("tilt\ndeg", lambda r: number(r["plane_tilt_deg"], 1)),
        Field("cover-\nage", lambda r: number(r["coverage"])),
        Field("\ncells", lambda r: str(r["occupied_cells"])),
        Field("expected\nerror px", lambda r: px(r["expected_error_px"])),
        Field("pose\npx", lambda r: px(r["pose_offset_px"])),
        Field("\nplausible", lambda r: r["plausible"], lambda r: VERDICT_STYLE[r["plausible"]], numeric=False),
    ]


def _reasons(rows: Sequence[Row], width: int) -> str:
    """List what speaks against each estimate, and what is only remarked."""
    lines = ["Why"]
    for row in rows:
        if not row["reasons"]:
            lines.append(f"  {row['model']}  nothing speaks against it")
        for reason in row["reasons"]:
            code, _, detail = plain(reason).partition(":")
            remark = " (remark)" if is_remark(code, row) else ""
            lines.append(paragraph(f"  {row['model']}  {code}{remark}: {detail.strip()}", width, "    "))
    return "\n".join(lines)


def _notes(found: Sequence[Row], settings: Mapping[str, Any]) -> list[str]:
    notes = []
    if any(row["distortion"] == "division" for row in found):
        names = ", ".join(row["model"] for row in found if row["distortion"] == "division")
        notes.append(f"k of {names} divide (undistorted = distorted / (1 + k1 r^2 + ...)): not to be compared.")
    notes.append(
        f"Tests that reject: p < {settings['alpha']:g} under the robust scale. Misfit: p before Holm; given: the model "
        "has it."
    )
    return ["Notes", *(f"- {note}" for note in (*notes, *CAVEATS))]


def _focal(row: Row) -> str:
    if row["fx_px"] == row["fy_px"]:
        return number(row["fx_px"]) if row["fx_px"] < 1000 else f"{row['fx_px']:.1f}"
    return f"{row['fx_px']:.0f}, {row['fy_px']:.0f}"


def _coefficient(name: str, row: Row) -> str:
    if name not in row["estimated"]:
        return MISSING
    return f"{row[name]:.4f}" if abs(row[name]) < 10 else f"{row[name]:.3g}"


def _group_p(group: str, row: Row) -> str:
    if row[f"misfit_{group}_rank"] == 0:
        return "given"
    return probability(row[f"misfit_{group}_p"])


def _cause(row: Row) -> str:
    group = row["misfit_group"]
    return "none" if group is None else str(SHORT_GROUP.get(group, group))


def _percent(value: float | None) -> str:
    return MISSING if value is None else f"{value:.2%}"


def _flatness(value: float | None) -> str:
    if value is None:
        return MISSING
    return "plane" if value < 1e-6 else f"{value:.1g}" if value < 0.01 else number(value)
