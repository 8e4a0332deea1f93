"""One model or one image in a line, and as a small piece of HTML: what an interactive session shows of a result."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any, Final

from sfm_audit.audit.table.words import MEMBER_QUESTIONS, VERDICT_ORDER, Verdict, is_remark
from sfm_audit.reports.text.explain import plain_reason
from sfm_audit.reports.text.reasons import reasons_of
from sfm_audit.reports.text.wording import counted, plain, shorten

_MAX_ROWS: Final = 8
_NAME_WIDTH: Final = 40
_PLACE_WIDTH: Final = 60


def brief_line(verdicts: Mapping[str, int], model: Mapping[str, Any], policy: str) -> str:
    """Return where the model lies, its size, and how many images got which verdict.

    Parameters
    ----------
    verdicts : images per verdict        model : row of the table ``models``        policy : which verdicts decide
    """
    said = ", ".join(f"{verdicts.get(verdict, 0)} {verdict}" for verdict in reversed(VERDICT_ORDER))
    where = shorten(plain(model["model_path"]), _PLACE_WIDTH)
    findings = counted(len(model["findings"]), "finding")
    return f"{where}: {counted(sum(verdicts.values()), 'image')}, {said} under {policy}; {findings}"


def brief_html(
    verdicts: Mapping[str, int], model: Mapping[str, Any], policy: str, images: Sequence[Mapping[str, Any]]
) -> str:
    """Return the same with the findings and the reasons, counted, as HTML; every name is escaped.

    images : rows of the table ``images``, with ``image_name``, ``verdict`` and ``reasons``
    """
    codes = Counter(
        code for row in images if row["verdict"] != Verdict.ACCEPTED for code in {_code(r) for r in row["reasons"]}
    )
    example = {_code(said): row["image_name"] for row in reversed(images) for said in row["reasons"]}
    reasons = [(code, str(count), shorten(plain(example[code]), _NAME_WIDTH)) for code, count in codes.most_common()]
    findings = [(str(found["code"]), plain(str(found["text"]))) for found in model["findings"]]
    parts = [f"<p><b>{escape(brief_line(verdicts, model, policy))}</b></p>"]
    parts += _table("Reasons of images that are not accepted", ("reason", "images", "such as"), reasons)
    parts += _table("Findings about the model", ("finding", ""), findings)
    return "".join(parts)


def brief_image(row: Mapping[str, Any], codes: Sequence[str]) -> str:
    """Return the image's name, its verdict, and codes of reasons."""
    why = f" ({', '.join(dict.fromkeys(codes))})" if codes else ""
    return f"{shorten(plain(row['image_name']), _NAME_WIDTH)}: {row['verdict']}{why}"


def brief_image_html(row: Mapping[str, Any]) -> str:
    """Return the image's verdict, its reasons in plain words and the questions, as HTML."""
    reasons = [
        ("remark" if is_remark(reason["code"], row) else str(reason["code"]), plain_reason(reason, row))
        for reason in reasons_of(dict(row))
    ]
    asked = [(words, str(row[member])) for member, words in MEMBER_QUESTIONS.items() if row[member] is not None]
    parts = [f"<p><b>{escape(brief_image(row, codes=[]))}</b></p>"]
    return "".join([*parts, *_table("", ("why", ""), reasons), *_table("", ("question", "answer"), asked)])


def _code(reason: str) -> str:
    return reason.partition(":")[0]


def _table(title: str, head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Return a table; nothing where it has no rows."""
    if not rows:
        return []
    more = f"<p>and {len(rows) - _MAX_ROWS} more</p>" if len(rows) > _MAX_ROWS else ""
    cells = "".join(f"<th>{escape(cell)}</th>" for cell in head)
    body = "".join(f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>" for row in rows[:_MAX_ROWS])
    caption = f"<p>{escape(title)}</p>" if title else ""
    return [f"{caption}<table><thead><tr>{cells}</tr></thead><tbody>{body}</tbody></table>{more}"]
