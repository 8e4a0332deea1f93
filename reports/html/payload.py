"""The rows of the page's table, as the script reads them."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

from markupsafe import Markup

from sfm_audit.audit.table.words import Member
from sfm_audit.reports.html.content import RunContent
from sfm_audit.reports.run_folder.reader import Row
from sfm_audit.reports.text.explain import plain_reasons
from sfm_audit.reports.text.reasons import reasons_of
from sfm_audit.reports.text.wording import plain

_PANEL_ONLY: Final = (
    *("scene", "component", "model_path", "image_id", "camera_id", "camera_model", "width", "height"),
    *("num_points2d", "num_linked", "num_standardised", "mean_track_length", "occupied_cells"),
    *("median_px", "p95_px", "max_px", "sigma_constant_px", "sigma_d_px", "scale_ratio"),
    *("ks_stat", "ks_q", "ks_fitted_p", "dap_p", "sw_p", "skewness", "ks_constant_stat", "ks_constant_p"),
    *("kurtosis_constant", "misfit_group", "misfit_q", "sd_focal_rel", "focal_over_size", "expected_error_px"),
    *(str(member) for member in Member),
)
_DIGITS: Final = 5  # significant, in the numbers on the page
_FIRST_FACT: Final = 5  # of a row, after name, codes, sentences, camera and scene


@dataclass(frozen=True, slots=True)
class TableColumn:
    """One column of the sortable table.

    kind: name, text, verdict, codes, count, px, number, small (three digits) or p.
    rank: the higher, the wider the screen that shows it.
    """

    name: str
    title: str
    kind: str
    rank: int = 0


IMAGE_COLUMNS: Final = (
    TableColumn("image_name", "Image", "name"),
    TableColumn("scene", "Scene", "text", 1),
    TableColumn("verdict", "Verdict", "verdict"),
    TableColumn("codes", "Why", "codes"),
    TableColumn("num_inliers", "Inliers", "count", 1),
    TableColumn("rms_px", "RMS, px", "px", 2),
    TableColumn("sigma_predicted_px", "Noise, px", "px", 1),
    TableColumn("misfit_px", "Misfit, px", "px", 1),
    TableColumn("ks_p", "KS p", "p", 2),
    TableColumn("kurtosis_excess", "Kurtosis", "number", 2),
    TableColumn("pose_offset_px", "Pose, px", "px", 2),
    TableColumn("coverage", "Coverage", "number", 2),
    *(
        TableColumn(name, title, "small", 2)
        for name, title in (
            ("sd_rotation_deg", "Rotation sd, deg"),
            ("sd_centre", "Centre sd, depths"),
            ("reference_centre_rel", "To reference, depths"),
            ("reference_rotation_deg", "To reference, deg"),
            ("prior_distance", "To prior"),
        )
    ),
    TableColumn("advised_camera_model", "Advised camera", "text", 1),
)
_GIVE_WAY: Final = {"ks_p", "kurtosis_excess"}  # to columns that only some runs have
_OPTIONAL: Final = tuple(column.name for column in IMAGE_COLUMNS if column.kind == "small")


@dataclass(frozen=True, slots=True, eq=False)
class Places:
    """Scenes and cameras of a page by number, so that a click can ask for one of them, whatever it is called."""

    scenes: dict[tuple[str, str], int]
    cameras: dict[tuple[str, int | None], int]
    scene_titles: list[str]
    camera_titles: list[str]

    @classmethod
    def of(cls, content: RunContent) -> Places:
        """Number the scenes of the run, and the cameras of the rows on the page."""
        scenes: dict[tuple[str, str], int] = {}
        for key in content.scenes:
            scenes.setdefault(key, len(scenes))
        several = len({dataset for dataset, _ in scenes}) > 1
        cameras: dict[tuple[str, int | None], int] = {}
        titles: list[str] = []
        for row in content.rows:
            if cameras.setdefault((row["part"], row["camera_id"]), len(cameras)) == len(titles):
                titles.append(camera_title(row, several=several))
        names = [plain(f"{dataset}/{scene}" if several else scene) for dataset, scene in scenes]
        return cls(scenes, cameras, names, titles)


def camera_title(row: Row, *, several: bool) -> str:
    """Return how the page calls a camera; ``several``: datasets."""
    dataset = f"{row['dataset']}/" if several else ""
    return f"{plain(dataset + row['scene'])}/{plain(row['component'])}, camera {row['camera_id']}"


def table_columns(content: RunContent) -> list[TableColumn]:
    """Return all columns; without the scene where there is only one, and what was not measured in this run."""
    unwanted = {"scene"} if len(content.scenes) < 2 else set()
    unwanted |= {name for name in _OPTIONAL if all(_value(row.get(name)) is None for row in content.rows)}
    crowded = set() if unwanted.issuperset(_OPTIONAL) else _GIVE_WAY
    return [
        replace(column, rank=3) if column.name in crowded else column
        for column in IMAGE_COLUMNS
        if column.name not in unwanted
    ]


def payload(
    content: RunContent,
    places: Places,
    *,
    num_pictures: int = 0,
    thumbnails: Sequence[str | None] = (),
    views: Sequence[Mapping[str, Any] | None] = (),
) -> Markup:
    """Return the rows as JSON; ``thumbnails``: of the first rows.    views: of `reports.html.scenes`."""
    units = {column.name: (column.unit, column.meaning) for column in content.columns}
    facts = [name for name in (*(c.name for c in table_columns(content)), *_PANEL_ONLY) if name in units]
    facts = [name for name in dict.fromkeys(facts) if name != "image_name"]
    rows = [
        [
            plain(row["image_name"]),
            _codes(row),
            plain_reasons(row),
            places.cameras[row["part"], row["camera_id"]],
            places.scenes[row["dataset"], row["scene"]],
            *(_value(row[name]) for name in facts),
        ]
        for row in content.rows
    ]
    return as_json(
        {
            "columns": [
                {"name": c.name, "title": c.title, "kind": c.kind, "rank": c.rank} for c in table_columns(content)
            ],
            "facts": [{"name": name, "unit": units[name][0], "meaning": units[name][1]} for name in facts],
            "firstFact": _FIRST_FACT,
            "rows": rows,
            "scenes": places.scene_titles,
            "datasets": [plain(dataset) for dataset, _ in content.scenes],
            "cameras": places.camera_titles,
            "numPictures": num_pictures,
            "thumbnails": list(thumbnails),
            "views": list(views),
        }
    )


def as_json(value: Any) -> Markup:
    """Return JSON that cannot end the script element it stands in."""
    text = json.dumps(value, ensure_ascii=False, separators=(",", ":"), allow_nan=False)
    for character in "<>&\u2028\u2029":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return Markup(text)  # noqa: S704 - no character of it means anything to HTML


def _codes(row: Row) -> list[str]:
    return list(dict.fromkeys(reason["code"] for reason in reasons_of(row)))


def _value(value: Any) -> Any:
    """Return what JSON holds: numbers with `_DIGITS` significant digits, null for what is not finite."""
    if isinstance(value, float):
        return float(f"{value:.{_DIGITS}g}") if math.isfinite(value) else None
    return plain(value) if isinstance(value, str) else value
