"""The page itself: what `reports.html.content` counted, drawn and put into the template."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import resources
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
from markupsafe import Markup, escape

from sfm_audit.audit.table.concerns import findings_about
from sfm_audit.audit.table.thresholds import ALPHA, effect_px
from sfm_audit.audit.table.words import MEMBER_QUESTIONS, POLICIES, Member, Verdict
from sfm_audit.loaders.camera_models import BY_NAME
from sfm_audit.reports.charts import CAPTIONS, cameras, runs
from sfm_audit.reports.html.content import MAX_CAMERAS, MAX_SCENES, Reason, RunContent
from sfm_audit.reports.html.payload import Places, camera_title, payload
from sfm_audit.reports.html.pictures import ImagePictures, Picture
from sfm_audit.reports.html.scenes import ModelView, draw_view
from sfm_audit.reports.html.statements import witnesses_of
from sfm_audit.reports.html.todo import codes_of, diagnoses_of
from sfm_audit.reports.run_folder.reader import Row
from sfm_audit.reports.text.explain import LIMITS, plain_reasons
from sfm_audit.reports.text.legend import settings_words
from sfm_audit.reports.text.witnesses import witnesses_line
from sfm_audit.reports.text.wording import counted, number, plain, px


@dataclass(frozen=True, slots=True, eq=False)
class PageInput:
    """What the page is made from.

    content: of `read_content`.    pictures: of the first ``len(pictures)`` of its rows.
    no_photos: why there are no photos; None where there are.    thumbnails: data URLs, of the first rows.
    fields: of the first cameras, by position; a text says why there is none.    views: of models.
    """

    content: RunContent
    pictures: Sequence[ImagePictures] = ()
    no_photos: str | None = None
    thumbnails: Sequence[str | None] = ()
    fields: Mapping[int, Picture | str] = field(default_factory=dict)
    views: Sequence[ModelView] = ()


def render_page(page: PageInput) -> str:
    """Return the page: one HTML document that asks for nothing outside itself."""
    content, info = page.content, page.content.run.info
    places = Places.of(content)
    views = [draw_view(view, content.rows) for view in page.views]
    diagnoses, num_diagnoses = diagnoses_of(content)
    return (
        environment()
        .get_template("report.html.j2")
        .render(
            run_head=_head(content),
            complete=info.get("status") == "complete",
            judged=_judged(content),
            totals={verdict: content.verdicts.count(verdict) for verdict in Verdict},
            num_images=content.num_images,
            decided_again=info.get("decided_again"),
            summary=_summary(content),
            questions=_questions(content),
            verdict_figure=_verdict_figure(content),
            datasets=_datasets(content),
            scenes=_scenes(content, places),
            num_scenes=len(content.scenes),
            reasons=_reason_rows(content.reasons),
            remarks=_reason_rows(content.remarks),
            distributions=_distributions(content),
            cameras=[_camera(row, content, places, page.fields.get(i)) for i, row in enumerate(content.cameras)],
            num_cameras=content.num_cameras,
            max_cameras=MAX_CAMERAS,
            views=views,
            witnesses=witnesses_of(content.outside, content.models, content.rows),
            worst=_worst_images(page),
            no_photos=page.no_photos,
            num_rows=len(content.rows),
            diagnoses=diagnoses,
            num_diagnoses=num_diagnoses,
            codes=(codes := codes_of(content)),
            explained={f"{section.kind}-{section.code}" for section in codes},
            findings=_findings(content),
            failures=[plain(item["message"]) for item in info.get("failures", [])],
            limits=(*LIMITS, _witnesses(content)),
            payload=payload(
                content,
                places,
                num_pictures=len(page.pictures),
                thumbnails=page.thumbnails,
                views=[view.data for view in views],
            ),
        )
    )


def environment() -> Environment:
    """Return how templates are filled: all texts escaped, styles and scripts from our own files."""
    made = Environment(
        loader=PackageLoader("sfm_audit.reports.html"),
        autoescape=select_autoescape(default=True, default_for_string=True),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters["breakable"] = _breakable
    made.filters["coded"] = _coded
    made.globals["asset"] = lambda name: Markup(_asset(name))  # noqa: S704 - our own files
    return made


def _witnesses(content: RunContent) -> str:
    """Say which witnesses outside of the images were asked, and of how many images they could say something."""
    asked = Counter(name for row in content.models for name in row["witnesses"] or [])
    num_spoken_of = sum(content.counts[Member.OUTSIDE].values()) if Member.OUTSIDE in content.counts else 0
    codes = {str(finding["code"]) for row in content.models for finding in row["findings"] or []}
    return witnesses_line(asked, len(content.models), content.num_images, num_spoken_of, codes)


def _breakable(name: str) -> Markup:
    """Let a long name of a column break after its underscores."""
    return Markup("_<wbr>").join(name.split("_"))  # join escapes the pieces


def _coded(text: str) -> Markup:
    """Show what stands between backticks as code; a text with an odd one stays as it is."""
    pieces = text.split("`")
    if len(pieces) % 2 == 0:
        return escape(text)
    shown = (Markup("<code>{}</code>").format(piece) if i % 2 else escape(piece) for i, piece in enumerate(pieces))
    return Markup("").join(shown)


def _asset(name: str) -> str:
    return resources.files("sfm_audit.reports.html").joinpath(name).read_text(encoding="utf-8")


def _questions(content: RunContent) -> list[dict[str, Any]]:
    policy = content.config.get("policy")
    nobody = () if Member.OUTSIDE in content.counts else (Member.OUTSIDE,)
    named = [
        (f"policy {name}", ", ".join(member.short for member in members if member not in nobody))
        for name, members in POLICIES.items()
    ]
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


def _summary(content: RunContent) -> str:
    return counted(content.num_images, "image") + " in " + counted(len(content.models), "model")


def _judged(content: RunContent) -> str:
    """What judged the images, at which level, in words."""
    has_witnesses = any(row["witnesses"] for row in content.models)
    said = settings_words(content.config, has_witnesses=has_witnesses)
    return f"{said[0].upper()}{said[1:]}."


def _head(content: RunContent) -> dict[str, Any]:
    """What was audited, where, when, by which version and command."""
    info = content.run.info
    datasets = list(dict.fromkeys(dataset for dataset, _ in content.scenes))
    few = [plain(name) for name in datasets[:4]]
    return {
        "datasets": ", ".join(few) + (f" and {len(datasets) - len(few)} more" if len(datasets) > len(few) else ""),
        "paths": [plain(path["given"]) for path in info.get("paths", [])],
        "version": info["version"],
        "finished": plain(info["finished"]) if info.get("finished") else None,
        "command": plain(info["command"]) if info.get("command") else None,
    }


def _verdict_figure(content: RunContent) -> Markup:
    names = (*(f"policy {name}" for name in POLICIES), *map(str, Member))
    counts = {name: content.counts[name] for name in names if content.counts[name] or not content.num_images}
    return runs.verdict_bars(counts, "Verdicts by policy and question; see the table")


def _datasets(content: RunContent) -> list[dict[str, Any]]:
    """One row per dataset; none where there is only one."""
    found: dict[str, dict[str, int]] = {}
    scenes: dict[str, int] = {}
    for (dataset, _), counts in content.scenes.items():
        total = found.setdefault(dataset, dict.fromkeys(Verdict, 0))
        scenes[dataset] = scenes.get(dataset, 0) + 1
        for verdict, count in counts.items():
            total[verdict] = total.get(verdict, 0) + count
    rows = [{"name": plain(name), "scenes": scenes[name], **_shares(counts)} for name, counts in found.items()]
    return sorted(rows, key=lambda row: row["name"]) if len(rows) > 1 else []


def _scenes(content: RunContent, places: Places) -> list[dict[str, Any]]:
    rows = [
        {"name": places.scene_titles[places.scenes[key]], "number": places.scenes[key], **_shares(counts)}
        for key, counts in content.scenes.items()
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
    both = ("constant noise", f"{content.noise_model or 'chosen'} noise")
    alpha = float(content.config.get("alpha", ALPHA.default))
    tau = _tau_px(content.config, None)

    def by_verdict(
        column: str, label: str, caption: str, *, log: bool = True, marks: Mapping[str, float] | None = None
    ) -> Picture:
        svg = runs.histogram_by_verdict(numbers[column], verdicts, label=label, caption=caption, log=log, marks=marks)
        return Picture(caption, svg)

    def by_noise(first: str, second: str, label: str, caption: str) -> Picture:
        svg = runs.noise_comparison(numbers[first], numbers[second], names=both, label=label, caption=caption)
        return Picture(caption, svg)

    often = "How often KS rejects at any level. On the diagonal: as often as chance."
    p_values = numbers["ks_constant_p"], numbers["ks_p"]
    return [
        by_verdict(
            "sigma_predicted_px",
            "predicted noise per axis, px",
            "Noise per axis of each image, as the rest of its tracks predicts it.",
        ),
        by_noise(
            "kurtosis_constant",
            "kurtosis_excess",
            "excess kurtosis of z",
            "Excess kurtosis: 0 for a normal, positive for heavy tails.",
        ),
        by_verdict(
            "misfit_px",
            "misfit, px RMS",
            "Systematic residual of the named misfit that nothing else could take up.",
            marks={f"matters above {tau:g} px": tau} if tau else None,
        ),
        by_verdict(
            "scale_ratio",
            "scale ratio",
            "Observed over predicted variance: below 1 over-fitted, above 1 under-fitted.",
            marks={"as predicted": 1.0},
        ),
        by_noise(
            "ks_constant_stat", "ks_stat", "KS distance D", "Kolmogorov-Smirnov distance under both noise models."
        ),
        Picture(often, runs.ks_comparison(*p_values, noise=content.noise_model, alpha=alpha, caption=often)),
    ]


def _tau_px(config: Mapping[str, Any], sigma_px: float | None) -> float | None:
    """Return the effect that matters, px; None where it is in sigma and the noise is not known."""
    effect = config.get("min_effect")
    return None if effect is None else effect_px(str(effect), sigma_px)


def _camera(row: Row, content: RunContent, places: Places, shown: Picture | str | None) -> dict[str, Any]:
    model = BY_NAME.get(row["camera_model"])
    names = model.param_names if model else ()
    alpha = float(content.config.get("alpha", ALPHA.default))
    label = f"Systematic residuals by kind of misfit, all images of camera {row['camera_id']} together"
    figure = cameras.misfit_groups(row, tau_px=_tau_px(content.config, None), alpha=alpha, label=label)
    group = row["misfit_group"]
    pictures = [Picture("Systematic residuals, its images pooled.", figure)]
    if isinstance(shown, Picture):
        pictures.insert(0, shown)
    pictures += _correlations(row)
    return {
        "title": camera_title(row, several=len({dataset for dataset, _ in content.scenes}) > 1),
        "number": places.cameras.get((row["part"], row["camera_id"])),
        "found": group is not None,
        "model": row["camera_model"],
        "size": f"{row['width']} x {row['height']}",
        "params": [(name, f"{value:.6g}") for name, value in zip(names, row["params"] or [], strict=False)],
        "counts": [row[name] for name in ("num_images", "num_points3d", "num_observations")],
        "misfit": f"{group.replace('_', ' ')}, {px(row['misfit_px'])} px RMS" if group else "none found",
        "advice": row["advised_camera_model"],
        "pictures": pictures,
        "missing": shown if isinstance(shown, str) else None,
    }


def _correlations(row: Row) -> list[Picture]:
    names, lower = row["own_parameters"], row["own_correlations"]
    if not names or not lower or len(names) < 2:
        return []
    caption = CAPTIONS["correlations"]
    return [Picture(caption, cameras.correlations(names, lower, label=caption))]


def _worst_images(page: PageInput) -> list[dict[str, Any]]:
    models = {row["model_path"]: row for row in page.content.models}
    shown = zip(page.content.rows, page.pictures, strict=False)
    return [_worst(i, row, pictures, models.get(row["model_path"])) for i, (row, pictures) in enumerate(shown)]


def _worst(index: int, row: Row, pictures: ImagePictures, model: Row | None) -> dict[str, Any]:
    findings = findings_about(row, model["findings"] or [], model["num_images"] or 0) if model else []
    return {
        "anchor": f"worst-{index}",
        "name": plain(row["image_name"]),
        "place": plain(f"{row['scene']}/{row['component']}"),
        "verdict": row["verdict"],
        "reasons": plain_reasons(row),
        "findings": [(plain(str(finding["code"])), plain(finding["text"])) for finding in findings],
        "facts": f"{row['num_inliers']} inliers, RMS {px(row['rms_px'])} px, "
        f"predicted noise {px(row['sigma_predicted_px'])} px, coverage {number(row['coverage'])}",
        "pictures": pictures.pictures,
        "missing": pictures.missing,
    }


def _findings(content: RunContent) -> list[tuple[str, str, str]]:
    return [
        (plain(f"{row['scene']}/{row['component']}"), plain(str(finding["code"])), plain(finding["text"]))
        for row in content.models
        for finding in row["findings"] or []
    ][:MAX_SCENES]
