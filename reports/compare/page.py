"""How do people read what changed between two runs, and what a gate says? Pages for the terminal, 80 columns."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Final

from rich.cells import cell_len

from sfm_audit.reports.compare.comparison import Comparison, ScopeChange
from sfm_audit.reports.compare.gate_report import GateReport
from sfm_audit.reports.compare.keys import Noted
from sfm_audit.reports.run_folder.reader import Row
from sfm_audit.reports.text.drawing import Field, Listing, Page, draw
from sfm_audit.reports.text.wording import MISSING, counted, paragraph, plain, px, shorten

MAX_SCOPES: Final = 40
MAX_NAMES: Final = 12
MAX_CHECKS: Final = 25
OTHER_NAMES: Final = (
    "No image of one run is in the other. Images are compared by dataset, scene and name, and a dataset is the base "
    "name of the PATH given to run: audit folders of the same name."
)


def render_comparison(comparison: Comparison, names: tuple[str, str], page: Page) -> str:
    """Return the page of ``diff``: scopes in a table, then images by name; ``names``: the two folders."""
    change = comparison.whole
    head = paragraph(f"sfm-audit diff: {plain(names[1])} against {plain(names[0])}", page.width)
    parts = [head]
    if comparison.nothing_in_common:
        parts.append(paragraph(OTHER_NAMES, page.width))
    if not any(each.anything for each in comparison.changes):
        parts.append(f"Nothing changed: {counted(change.after.num_images, 'image')}.")
        return "\n".join([*parts, ""])
    parts += [_scopes(comparison, page), *_scene_lists(change, page), *_image_lists(comparison, page)]
    return "\n".join(part.rstrip("\n") + "\n" for part in parts)


def render_gate(report: GateReport, page: Page) -> str:
    """Return the page of ``check``: the outcome, the failed checks with images, what else was noted."""
    outcome = "PASSED" if report.passed else "FAILED"
    lines = [paragraph(f"{outcome}  {plain(report.headline)}", page.width, "  ")]
    lines += [paragraph(f"not read  {plain(message)}", page.width, "  ") for _, message in report.unread[:MAX_CHECKS]]
    for check in report.failed[:MAX_CHECKS]:
        where = shorten(plain(check.scope.name), 40)
        lines.append(paragraph(f"{where}  {check.name}: {plain(check.message)}", page.width, "  "))
        lines += _name_lines(check.images, page)
    if len(report.failed) > MAX_CHECKS:
        lines.append(f"... and {len(report.failed) - MAX_CHECKS} more failed checks, see --json")
    lines += [paragraph(f"note: {plain(note)}", page.width, "  ") for note in report.notes]
    return "\n".join([*lines, ""])


def _scopes(comparison: Comparison, page: Page) -> str:
    """Draw one row per scene; the whole run stands last where there are several."""
    scenes = [change for change in comparison.changes if change.scope.kind == "scene"]
    shown = sorted((change for change in scenes if change.anything), key=lambda change: change.scope)
    title = f"{counted(len(shown), 'scene')} of {len(scenes)} changed"
    if len(shown) > MAX_SCOPES:
        shown = sorted(shown, key=lambda c: (-len(c.lost) - len(c.newly_rejected), c.scope))[:MAX_SCOPES]
        title += f"; the {MAX_SCOPES} with most images lost or newly rejected"
    listed = [*shown, comparison.whole] if len(scenes) > 1 else shown
    rows: list[Row] = [{"change": change} for change in listed]
    fields = [
        Field("images\nbefore", lambda r: str(r["change"].before.num_images)),
        Field("\nnow", lambda r: str(r["change"].after.num_images)),
        _counter("\nlost", lambda c: c.lost, "red"),
        _counter("newly\nrej.", lambda c: c.newly_rejected, "red"),
        _counter("\nfixed", lambda c: c.fixed, "green"),
        Field("sigma\nbefore", lambda r: px(r["change"].before.sigma_px)),
        Field("px\nnow", lambda r: px(r["change"].after.sigma_px)),
        Field("error\nbefore", lambda r: px(r["change"].before.recomputed_error_px)),
        Field("px\nnow", lambda r: px(r["change"].after.recomputed_error_px)),
    ]
    return draw(Listing(title, "scene", [[plain(change.scope.name)] for change in listed], rows), fields, page)


def _counter(title: str, images: Callable[[ScopeChange], Noted], style: str) -> Field:
    return Field(
        title, lambda r: str(len(images(r["change"]))) or MISSING, lambda r: style if images(r["change"]) else ""
    )


def _scene_lists(change: ScopeChange, page: Page) -> list[str]:
    lists = {
        "Scenes lost": change.lost_scenes,
        "Scenes added": change.added_scenes,
        "Models none of whose images is left": change.lost_models,
    }
    return [_listing(title, [plain(name) for name in names], page) for title, names in lists.items() if names]


def _image_lists(comparison: Comparison, page: Page) -> list[str]:
    change = comparison.whole
    grown = tuple((key, f"+{growth:.2f} px") for key, growth in change.grown_px)
    folds = [fragment for each in change.poses for fragment in each.fragments]
    parts = [paragraph(f"Fold: {plain(fragment.words)}", page.width, "  ") for fragment in folds[:MAX_NAMES]]
    for title, images in (
        ("Newly rejected", change.newly_rejected),
        ("Fixed", change.fixed),
        ("Lost", change.lost),
        ("Added", change.added),
        ("Another camera model", change.remodelled),
        ("Larger systematic error", grown),
        ("Cameras elsewhere", change.moved),
    ):
        if images:
            parts.append("\n".join([f"{title}: {counted(len(images), 'image')}", *_name_lines(images, page)]))
    return parts


def _name_lines(images: Noted, page: Page) -> list[str]:
    """One line per image, its name shortened, the remark behind it as far as there is room."""
    lines = []
    for key, remark in images[:MAX_NAMES]:
        name = shorten(plain("/".join(key)), page.width // 2 if remark else page.width - 4)
        lines.append(_clip(f"    {name}  {plain(remark)}".rstrip(), page.width))
    if len(images) > MAX_NAMES:
        lines.append(f"    ... and {len(images) - MAX_NAMES} more")
    return lines


def _clip(line: str, width: int) -> str:
    """Cut the end off a line; of a remark, the beginning says what it is about."""
    if cell_len(line) <= width:
        return line
    while cell_len(line) > width - 3:
        line = line[:-1]
    return f"{line.rstrip()}..."


def _listing(title: str, names: Iterable[str], page: Page) -> str:
    listed = list(names)
    lines = [f"    {shorten(name, page.width - 4)}" for name in listed[:MAX_NAMES]]
    if len(listed) > MAX_NAMES:
        lines.append(f"    ... and {len(listed) - MAX_NAMES} more")
    return "\n".join([f"{title}: {len(listed)}", *lines])
