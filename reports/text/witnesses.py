"""The line that says which witnesses outside of the images were asked: silence is no pass."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any, Final

from sfm_audit.reports.text.wording import counted, paragraph, plain

NOBODY: Final = (
    "Nobody outside of the images was asked (run --database auto asks verified pairs of a database.db, --reference "
    "known poses, --priors positions of a sensor)."
)
UNUSED: Final = "Nobody outside of the images was asked: what was named does not fit, as findings say"
_NOT_USED: Final = ("database_not_used", "reference_not_used", "priors_not_used")


def witnesses_line(
    asked: Mapping[str, int], num_models: int, num_images: int, num_spoken_of: int, findings: Collection[str]
) -> str:
    """Return one sentence.

    Parameters
    ----------
    asked : in how many models each witness was asked
    num_spoken_of : images of which some witness could say something
    findings : codes of all findings of the models
    """
    if not asked:
        unused = [code for code in _NOT_USED if code in findings]
        return f"{UNUSED} ({', '.join(unused)})." if unused else NOBODY
    said = [f"{name} in {num} of {counted(num_models, 'model')}" for name, num in asked.items()]
    silent = num_images - num_spoken_of
    rest = f"; they can say nothing of {silent} of {counted(num_images, 'image')}" if silent else ""
    return f"Witnesses outside of the images that were asked: {', '.join(said)}{rest}."


def testimonies_words(row: Mapping[str, Any]) -> list[str]:
    """Say what each witness that was asked said of the image of a row of ``RUN/images``, those that agree included."""
    said = row.get("testimonies") or []
    return [plain(f"{each['witness']}: {each['text']}") for each in said]


def testimony_lines(row: Mapping[str, Any], width: int) -> str:
    """Return the same as a section of an image's story; empty where no witness said anything."""
    lines = [paragraph(f"- {text}", width, "  ") for text in testimonies_words(row)]
    return "\n".join(["What witnesses outside of the image say", *lines]) if lines else ""
