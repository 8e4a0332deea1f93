"""Formats whose files may be called anything with a certain ending: the one such file in a folder."""

from __future__ import annotations

from sfm_audit.loaders.errors import MissingFileError
from sfm_audit.loaders.model_format import matching
from sfm_audit.loaders.paths.files import names_in
from sfm_audit.loaders.paths.locations import InputPath


def only_file(folder: InputPath, pattern: str) -> InputPath:
    """Return the file in ``folder`` that ``pattern`` fits.

    Raises
    ------
    MissingFileError
        There is none, or there are several: which one is meant cannot be known.
    """
    found = matching(pattern, names_in(folder))
    if len(found) != 1:
        got = f"{len(found)}: {', '.join(found[:3])}{', ...' if len(found) > 3 else ''}" if found else "none"
        advice = "give each a folder of its own" if found else "check the path"
        raise MissingFileError(str(folder), None, f"one file {pattern}", got, advice)
    return folder / found[0]
