"""A folder that holds a model in both formats: compares the files that were not read with the model."""

from __future__ import annotations

from typing import Final

from sfm_audit.loaders.assembly.raw import RawModel
from sfm_audit.loaders.errors import LoadError
from sfm_audit.loaders.model import Finding, FindingCode
from sfm_audit.loaders.paths.files import exists
from sfm_audit.loaders.paths.locations import InputPath
from sfm_audit.loaders.paths.text_lines import read_text

_NAMES: Final = ("cameras", "images", "points3D")


def compare_with_text(folder: InputPath, raw: RawModel) -> tuple[Finding, ...]:
    """Return a finding where the text files beside the binary ones hold other numbers of records."""
    counts = {"cameras": len(raw.cameras), "images": len(raw.images.image_id), "points3D": len(raw.points.order)}
    differences = []
    for name in _NAMES:
        path = folder / f"{name}.txt"
        if not exists(path):
            continue
        try:
            count = count_records(path)
        except LoadError as error:
            differences.append(f"{name}.txt cannot be read ({error.got})")
            continue
        if count != counts[name]:
            differences.append(f"{counts[name]} {name} in binary, {count} in text")
    if not differences:
        return ()
    text = f"the text files beside the binary ones, which were read, disagree: {'; '.join(differences)}"
    return (Finding(FindingCode.BINARY_TEXT_DISAGREE, len(differences), text),)


def mention_ignored_binary(folder: InputPath) -> tuple[Finding, ...]:
    """Return a finding where binary files lie beside the text files that were read because they are not complete."""
    there = [f"{name}.bin" for name in _NAMES if exists(folder / f"{name}.bin")]
    if not there:
        return ()
    text = f"the text files were read: of the binary ones there is only {', '.join(there)}"
    return (Finding(FindingCode.BINARY_TEXT_DISAGREE, len(there), text),)


def count_records(path: InputPath) -> int:
    """Return how many cameras, images or points a text file holds, without parsing them.

    Raises
    ------
    LoadError
        Where the file cannot be read as text.
    """
    file = read_text(path)
    if path.stem != "images":
        return sum(1 for _ in file.records())
    count = 0
    lines = iter(file.lines)
    for line in lines:
        stripped = line.strip()
        if stripped and not stripped.startswith(b"#"):
            count += 1
            next(lines, None)  # the image's POINTS2D
    return count
