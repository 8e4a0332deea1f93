"""The line that says which witnesses outside of the images were asked: silence is no pass."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from sfm_audit.reports.text.wording import counted

NOBODY: Final = "Nobody outside of the images was asked (run --database auto asks verified pairs of a database.db)."


def witnesses_line(asked: Mapping[str, int], num_models: int, num_images: int, num_spoken_of: int) -> str:
    """Return one sentence.

    Parameters
    ----------
    asked : in how many models each witness was asked
    num_spoken_of : images of which some witness could say something
    """
    if not asked:
        return NOBODY
    said = [f"{name} in {num} of {counted(num_models, 'model')}" for name, num in asked.items()]
    silent = num_images - num_spoken_of
    rest = f"; they can say nothing of {silent} of {counted(num_images, 'image')}" if silent else ""
    return f"Witnesses outside of the images that were asked: {', '.join(said)}{rest}."
