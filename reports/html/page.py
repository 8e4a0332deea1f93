"""The page itself: what `reports.html.content` counted, drawn and put into the template."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Any, Final

from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
from markupsafe import Markup

from sfm_audit.audit.table import TABLES
from sfm_audit.audit.table.thresholds import ALPHA, effect_px
from sfm_audit.audit.table.words import MEMBER_QUESTIONS, POLICIES, Member, Verdict
from sfm_audit.loaders.camera_models import BY_NAME
from sfm_audit.reports import figures
from sfm_audit.reports.html.content import MAX_CAMERAS, MAX_SCENES, Reason, RunContent
from sfm_audit.reports.html.pictures import ImagePictures, Picture
from sfm_audit.reports.html.svg import to_svg
from sfm_audit.reports.run_folder.reader import Row
from sfm_audit.reports.text.explain import LIMITS, plain_reason
from sfm_audit.reports.text.reasons import reasons_of
from sfm_audit.reports.text.witnesses import witnesses_line
from sfm_audit.reports.text.wording import counted, number, plain, px

_PANEL_ONLY: Final = (
    *("scene", "component", "model_path", "image_id", "camera_id", "camera_model", "width", "height"),
    *("num_points2d", "num_linked", "num_standardised", "mean_track_length", "occupied_cells"),
    *("median_px", "p95_px", "max_px", "sigma_constant_px", "sigma_d_px", "scale_ratio"),
    *("ks_stat", "ks_q", "ks_fitted_p", "dap_p", "sw_p", "skewness", "ks_constant_stat", "ks_constant_p"),
    *("kurtosis_constant", "misfit_group", "misfit_q", "sd_focal_rel", "focal_over_size", "expected_error_px"),
    *(str(member) for member in Member),
)
_DIGITS: Final = 5  # significant, in the numbers on the page


@dataclass(frozen=True, slots=True)
class TableColumn:
    """One column of the sortable table. kind: name, text, verdict, codes, count, px, number or p."""

    name: str
    title: str
    kind: str


IMAGE_COLUMNS: Final = (
    TableColumn("image_name", "Image", "name"),
    TableColumn("scene", "Scene", "text"),
    TableColumn("verdict", "Verdict", "verdict"),
    TableColumn("codes", "Why", "codes"),
    TableColumn("num_inliers", "Inliers", "count"),
    TableColumn("rms_px", "RMS, px", "px"),
    TableColumn("sigma_predicted_px", "Noise, px", "px"),
    TableColumn("misfit_px", "Misfit, px", "px"),
    TableColumn("ks_p", "KS p", "p"),
    TableColumn("kurtosis_excess", "Kurtosis", "number"),
    TableColumn("pose_offset_px", "Pose, px", "px"),
    TableColumn("coverage", "Coverage", "number"),
    TableColumn("advised_camera_model", "Advised camera", "text"),
)


@dataclass(frozen=True, slots=True, eq=False)
class PageInput:
    """What the page is made from.

    content: of `read_content`.    pictures: of the first ``len(pictures)`` of its rows.
    no_photos: why there are no thumbnails; None where there are.
    """

    content: RunContent
    pictures: Sequence[ImagePictures] = ()
    no_photos: str | None = None


def render_page(page: PageInput) -> str:
    """Return the page: one HTML document that asks for nothing outside itself."""
    content = page.content
    environment = Environment(
        loader=PackageLoader("sfm_audit.reports.html"),
        autoescape=select_autoescape(default=True, default_for_string=True),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["breakable"] = _breakable
    return environment.get_template("report.html.j2").render(
        version=content.run.info["version"],
        complete=content.run.info.get("status") == "complete",
        config=content.config,
        totals={verdict: content.verdicts.count(verdict) for verdict in Verdict},
        num_images=content.num_images,
        summary=counted(content.num_images, "image") + " in " + counted(len(content.models), "model"),
        questions=_questions(content),
        verdict_figure=_verdict_figure(content),
        scenes=_scenes(content),
        num_scenes=len(content.scenes),
        reasons=_reason_rows(content.reasons),
        remarks=_reason_rows(content.remarks),
        distributions=_distributions(content),
        cameras=[_camera(i, row, content.config) for i, row in enumerate(content.cameras)],
        num_cameras=content.num_cameras,
        max_cameras=MAX_CAMERAS,
        worst=[_worst(i, row, page.pictures[i]) for i, row in enumerate(content.rows[: len(page.pictures)])],
        no_photos=page.no_photos,
        num_rows=len(content.rows),
        findings=_findings(content),
        failures=[plain(item["message"]) for item in content.run.info.get("failures", [])],
        limits=(*LIMITS, _witnesses(content)),
        payload=_payload(content, len(page.pictures)),
        style=Markup(_asset("page.css")),  # noqa: S704 - our own files
        script=Markup(_asset("page.js")),  # noqa: S704
        table_library=Markup(_asset("vendor/dataTables.min.js")),  # noqa: S704
    )


def _witnesses(content: RunContent) -> str:
    """Say which witnesses outside of the images were asked, and of how many images they could say something."""
    asked = Counter(name for row in content.models for name in row["witnesses"] or [])
    num_spoken_of = sum(content.counts[Member.OUTSIDE].values()) if Member.OUTSIDE in content.counts else 0
    return witnesses_line(asked, len(content.models), content.num_images, num_spoken_of)


def _breakable(name: str) -> Markup:
    """Let a long name of a column break after its underscores."""
    return Markup("_<wbr>").join(name.split("_"))  # join escapes the pieces


def _table_columns(content: RunContent) -> list[TableColumn]:
    """All columns; without the scene where there is only one."""
    return [column for column in IMAGE_COLUMNS if column.name != "scene" or len(content.scenes) > 1]


def _asset(name: str) -> str:
    return resources.files("sfm_audit.reports.html").joinpath(name).read_text(encoding="utf-8")


def _questions(content: RunContent) -> list[dict[str, Any]]:
    policy = content.config.get("policy")
    named = [(f"policy {name}", ", ".join(member.short for member in members)) for name, members in POLICIES.items()]
    rows = [*named, *((str(member), question) for member, question in MEMBER_QUESTIONS.items())]
    return [
        {"name": name, "words": words, "decides": name == f"policy {policy}", **_shares(content.counts[name])}
        for name, words in rows
        if content.counts[name] or not content.num_images
    ]


def _shares(counts: Mapping[str, int]) -> dict[str, Any]:
    total = sum(counts.values())
    share = 100.0 * counts.get("rejected", 0) / total if total else 0.0
    return {**{verdict: counts.get(verdict, 0) for verdict in Verdict}, "total": total, "share": f"{share:.0f} %"}


def _verdict_figure(content: RunContent) -> Markup:
    names = (*(f"policy {name}" for name in POLICIES), *map(str, Member))
    counts = {name: content.counts[name] for name in names if content.counts[name] or not content.num_images}
    return to_svg(figures.verdict_bars(counts), key="verdicts", label="Verdicts by policy and question; see the table")


def _scenes(content: RunContent) -> list[dict[str, Any]]:
    several = len({dataset for dataset, _ in content.scenes}) > 1
    rows = [
        {"name": plain(f"{dataset}/{scene}" if several else scene), **_shares(counts)}
        for (dataset, scene), counts in content.scenes.items()
    ]
    rows.sort(key=lambda row: (-row["rejected"] / max(row["total"], 1), row["name"]))
    return rows[:MAX_SCENES]


def _reason_rows(reasons: Mapping[str, Reason]) -> list[dict[str, Any]]:
    ordered = sorted(reasons.items(), key=lambda item: (-item[1].images, item[0]))
    return [
        {"code": code, "images": reason.images, "example": plain(reason.example), "detail": plain(reason.detail)}
        for code, reason in ordered
    ]


def _distributions(content: RunContent) -> list[Picture]:
    numbers, verdicts = content.numbers, content.verdicts
    noise = content.noise_model or "chosen"
    alpha = float(content.config.get("alpha", ALPHA.default))
    tau = _tau_px(content.config, None)
    marks = {f"matters above {tau:g} px": tau} if tau else {}
    p_columns = {"noise_model": [content.noise_model], **{name: numbers[name] for name in ("ks_p", "ks_constant_p")}}
    both = ("constant noise", f"{noise} noise")
    shown = {
        "Noise per axis of each image, as the rest of its tracks predicts it.": figures.histogram_by_verdict(
            numbers["sigma_predicted_px"], verdicts, label="predicted noise per axis, px", log=True
        ),
        "Excess kurtosis: 0 for a normal, positive for heavy tails.": figures.noise_comparison(
            numbers["kurtosis_constant"], numbers["kurtosis_excess"], names=both, label="excess kurtosis of z"
        ),
        "Systematic residual of the named misfit that nothing else could take up.": figures.histogram_by_verdict(
            numbers["misfit_px"], verdicts, label="misfit, px RMS", log=True, marks=marks
        ),
        "Observed over predicted variance: below 1 over-fitted, above 1 under-fitted.": figures.histogram_by_verdict(
            numbers["scale_ratio"], verdicts, label="scale ratio", log=True, marks={"as predicted": 1.0}
        ),
        "Kolmogorov-Smirnov distance under both noise models.": figures.noise_comparison(
            numbers["ks_constant_stat"], numbers["ks_stat"], names=both, label="KS distance D"
        ),
        "How often KS rejects at any level. On the diagonal: as often as chance.": figures.ks_comparison(
            p_columns, alpha=alpha
        ),
    }
    return [
        Picture(caption, svg=to_svg(figure, key=f"distribution-{i}", label=caption))
        for i, (caption, figure) in enumerate(shown.items())
    ]


def _tau_px(config: Mapping[str, Any], sigma_px: float | None) -> float | None:
    """Return the effect that matters, px; None where it is in sigma and the noise is not known."""
    effect = config.get("min_effect")
    return None if effect is None else effect_px(str(effect), sigma_px)


def _camera(index: int, row: Row, config: Mapping[str, Any]) -> dict[str, Any]:
    model = BY_NAME.get(row["camera_model"])
    names = model.param_names if model else ()
    tau = _tau_px(config, None)
    figure = figures.misfit_groups(row, tau_px=tau, alpha=float(config.get("alpha", ALPHA.default)))
    label = f"Systematic residuals by kind of misfit, all images of camera {row['camera_id']} together"
    group = row["misfit_group"]
    return {
        "title": f"{plain(row['scene'])}/{plain(row['component'])}, camera {row['camera_id']}",
        "found": group is not None,
        "model": row["camera_model"],
        "size": f"{row['width']} x {row['height']}",
        "params": [(name, f"{value:.6g}") for name, value in zip(names, row["params"] or [], strict=False)],
        "counts": [row[name] for name in ("num_images", "num_points3d", "num_observations")],
        "misfit": f"{group.replace('_', ' ')}, {px(row['misfit_px'])} px RMS" if group else "none found",
        "advice": row["advised_camera_model"],
        "figure": to_svg(figure, key=f"camera-{index}", label=label),
    }


def _worst(index: int, row: Row, pictures: ImagePictures) -> dict[str, Any]:
    return {
        "anchor": f"worst-{index}",
        "name": plain(row["image_name"]),
        "place": plain(f"{row['scene']}/{row['component']}"),
        "verdict": row["verdict"],
        "reasons": [plain_reason(reason, row) for reason in reasons_of(row)],
        "facts": f"{row['num_inliers']} inliers, RMS {px(row['rms_px'])} px, "
        f"predicted noise {px(row['sigma_predicted_px'])} px, coverage {number(row['coverage'])}",
        "pictures": pictures.pictures,
        "missing": pictures.missing,
    }


def _findings(content: RunContent) -> list[tuple[str, str]]:
    return [
        (plain(f"{row['scene']}/{row['component']}"), plain(finding["text"]))
        for row in content.models
        for finding in row["findings"] or []
    ][:MAX_SCENES]


def _payload(content: RunContent, num_pictures: int) -> Markup:
    """Return the rows as JSON that cannot end the script element it stands in."""
    units = {column.name: (column.unit, column.meaning) for column in TABLES["images"]}
    facts = [name for name in (*(c.name for c in IMAGE_COLUMNS), *_PANEL_ONLY) if name in units]
    facts = [name for name in dict.fromkeys(facts) if name != "image_name"]
    payload = {
        "columns": [{"name": c.name, "title": c.title, "kind": c.kind} for c in _table_columns(content)],
        "facts": [{"name": name, "unit": units[name][0], "meaning": units[name][1]} for name in facts],
        "rows": [
            [plain(row["image_name"]), _codes(row), _sentences(row), *(_value(row[name]) for name in facts)]
            for row in content.rows
        ],
        "numPictures": num_pictures,
    }
    text = json.dumps(payload, ensure_ascii=False, separators=(",", ":"), allow_nan=False)
    for character in "<>&\u2028\u2029":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return Markup(text)  # noqa: S704 - no character of it means anything to HTML


def _codes(row: Row) -> list[str]:
    return list(dict.fromkeys(reason["code"] for reason in reasons_of(row)))


def _sentences(row: Row) -> list[str]:
    return [plain_reason(reason, row) for reason in reasons_of(row)]


def _value(value: Any) -> Any:
    """Return what JSON holds: numbers with `_DIGITS` significant digits, null for what is not finite."""
    if isinstance(value, float):
        return float(f"{value:.{_DIGITS}g}") if math.isfinite(value) else None
    return plain(value) if isinstance(value, str) else value
