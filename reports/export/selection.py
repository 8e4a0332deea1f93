r"""Which images does a run leave? Lists of their names, and tables of the others with the reasons.

A line of a list is an image's name as it is. A name that would not stay on its line is written as a JSON string in
double quotes instead: names with control characters or line ends, with blanks at an end, names that begin with a double
quote, and the empty name. So a line that begins with a double quote is always a JSON string, and any other never.
"""

from __future__ import annotations

import csv
import io
import json
import os
import unicodedata
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import Any, Final

from sfm_audit.loaders import MissingFileError, ModelRef
from sfm_audit.loaders.datasets.input_state import read_input_state
from sfm_audit.reports.errors import RunFolderError
from sfm_audit.reports.run_folder.reader import RunReader

COLUMNS: Final = (
    "dataset",
    "scene",
    "component",
    "model_path",
    "image_id",
    "image_name",
    "verdict",
    "reasons",
)
POSE_SDS: Final = ("sd_rotation_deg", "sd_centre")
_UNWRITABLE: Final = frozenset({"Cc", "Cs", "Zl", "Zp"})  # control characters, lone surrogates, line and paragraph ends
_FORMULA: Final = ("=", "+", "-", "@", "\uff1d", "\uff0b", "\uff0d", "\uff20")  # full width ones too


class Keep(StrEnum):
    """Which images stay: all that were not rejected, or only those that were accepted."""

    NOT_REJECTED = "not-rejected"
    ACCEPTED = "accepted"


@dataclass(frozen=True, slots=True)
class AuditedImage:
    """One image of a run: what it is called, and what the audit said.

    fold_group: its side, should the model be folded; None unknown.
    sd_rotation_deg, sd_centre: how well its pose is known (``run --covariance``); None unknown.
    is_left_out: whatever its verdict: on the other side, or known less well than wanted.
    """

    dataset: str
    scene: str
    component: str
    model_path: str
    image_id: int
    image_name: str
    verdict: str
    reasons: tuple[str, ...]
    fold_group: int | None = None
    sd_rotation_deg: float | None = None
    sd_centre: float | None = None
    is_left_out: bool = False

    @property
    def model(self) -> str:
        """``scene/component``, as lists name a model."""
        return f"{self.scene}/{self.component}"

    def is_kept(self, keep: Keep) -> bool:
        """Whether the image stays."""
        if self.is_left_out:
            return False
        return self.verdict == "accepted" if keep is Keep.ACCEPTED else self.verdict != "rejected"


def read_images(run: RunReader) -> tuple[AuditedImage, ...]:
    """Return the images of a finished run, by model and id.

    Raises
    ------
    RunFolderError
        The run was not finished, so that a list made from it would lack whole models; or it holds no model.
    """
    if run.info.get("status") != "complete":
        raise RunFolderError(run.folder, "holds a run that was not finished", "give its command again first")
    rows = run.rows("images", (*COLUMNS, "fold_group", *POSE_SDS))
    images = [_image(run, row) for row in rows]
    if not images:
        raise RunFolderError(run.folder, "holds no audited image", "run it over a dataset that can be read")
    return tuple(
        sorted(
            images, key=lambda image: (image.dataset, image.scene, image.component, image.model_path, image.image_id)
        )
    )


def _image(run: RunReader, row: Mapping[str, Any]) -> AuditedImage:
    missing = [name for name in COLUMNS if name not in row]
    if missing:
        problem = f"has tables of images without {', '.join(missing)}"
        raise RunFolderError(run.folder, problem, "audit the models again into a new folder")
    return AuditedImage(**{**row, "reasons": tuple(row["reasons"] or ())})


def on_side(run: RunReader, images: Sequence[AuditedImage], group: int) -> tuple[AuditedImage, ...]:
    """Mark the images that are on the other side of their model's fold than ``group``, 1 or 2; with a reason.

    Raises
    ------
    RunFolderError
        No model of the run has sides.
    """
    if not any(image.fold_group for image in images):
        advice = "its models are too small, or made by an older version; docs/witnesses.md says what it takes"
        raise RunFolderError(run.folder, "holds no fold_group", advice)
    other = 3 - group
    return tuple(
        replace(image, is_left_out=True, reasons=(*image.reasons, f"fold_group: {other}"))
        if image.fold_group == other
        else image
        for image in images
    )


def known_to(run: RunReader, images: Sequence[AuditedImage], limits: Mapping[str, float]) -> tuple[AuditedImage, ...]:
    """Leave out the images whose pose is known less well than ``limits`` (by column) say, or not known; with a reason.

    Raises
    ------
    RunFolderError
        The run says of no image how well its pose is known.
    """
    out = []
    for image in images:
        sds = {column: getattr(image, column) for column in limits}
        reasons = [
            f"{column}: not known" if sd is None else f"{column}: {sd:.3g} > {limits[column]:g}"
            for column, sd in sds.items()
            if sd is None or sd > limits[column]
        ]
        known = replace(image, is_left_out=True, reasons=(*image.reasons, *reasons)) if reasons else image
        out.append(known)
    if limits and all(getattr(image, column) is None for image in images for column in limits):
        problem = f"holds no {' and no '.join(limits)}"
        raise RunFolderError(run.folder, problem, "audit the models again with sfm-audit run --covariance")
    return tuple(out)


def images_of_model(run: RunReader, images: Sequence[AuditedImage], model: Path) -> tuple[AuditedImage, ...]:
    """Return the images of the model in the folder ``model``: found by its location, else by its content.

    Raises
    ------
    RunFolderError
        The run holds no audit of it, or one of files that have changed since, or of several equal copies.
    LoadError
        The model's files cannot be read.
    """
    inputs = list(run.models())
    known = ", ".join(entry.model_path for entry in inputs[:3]) + (", ..." if len(inputs) > 3 else "")
    try:
        state = read_input_state(str(model))
    except MissingFileError as error:
        if not model.is_dir():
            raise
        problem = f"holds no audit of {model}, which is no model's own folder"
        raise RunFolderError(run.folder, problem, f"name one of its models ({known})") from error
    key = ModelRef("", "", "", os.path.realpath(model), str(model)).key
    found = [entry for entry in inputs if entry.key == key]
    if found and found[0].sha256 != state.digest:
        problem = f"holds an audit of {model} from before its files changed"
        raise RunFolderError(run.folder, problem, "run the audit again")
    found = found or [entry for entry in inputs if entry.sha256 == state.digest]
    if len(found) != 1:
        problem = f"holds {len(found) or 'no'} {'audits of copies' if found else 'audit'} of {model}"
        raise RunFolderError(run.folder, problem, f"name one of its models ({known}), or audit this one first")
    return tuple(image for image in images if image.model_path == found[0].model_path)


def list_text(run: RunReader, images: Sequence[AuditedImage], keep: Keep) -> str:
    """Return the kept images, one line each: ``name``, or ``scene/component<TAB>name`` of several models.

    Raises
    ------
    RunFolderError
        Two models of the run have the same scene and component, or a kept and a removed image of a model the same
        name, so that lines could not tell them apart.
    """
    path_of: dict[str, str] = {}
    for image in images:
        if path_of.setdefault(image.model, image.model_path) != image.model_path:
            problem = f"holds two models called {image.model}: {path_of[image.model]} and {image.model_path}"
            raise RunFolderError(run.folder, problem, "a list cannot tell them apart; audit them into two folders")
    _refuse_ambiguous_names(run, images, keep)
    lines = dict.fromkeys(  # a name that several kept images have stands there once
        quoted(image.image_name) if run.num_models == 1 else f"{quoted(image.model)}\t{quoted(image.image_name)}"
        for image in images
        if image.is_kept(keep)
    )
    return "".join(f"{line}\n" for line in lines)


def _refuse_ambiguous_names(run: RunReader, images: Sequence[AuditedImage], keep: Keep) -> None:
    """Raise RunFolderError where a kept and a removed image of a model have the same name."""
    kept = Counter((image.model, image.image_name) for image in images if image.is_kept(keep))
    gone = Counter((image.model, image.image_name) for image in images if not image.is_kept(keep))
    both = [name for name in kept if name in gone]
    if both:
        model, name = both[0]
        more = f", and {len(both) - 1} more such names" if len(both) > 1 else ""
        problem = (
            f"holds {kept[both[0]] + gone[both[0]]} images called {quoted(name)} in {quoted(model)}, "
            f"{kept[both[0]]} of them kept and {gone[both[0]]} not{more}; a list of names cannot tell them apart"
        )
        raise RunFolderError(run.folder, problem, "use --model and --model-out, which go by image id")


def quoted(name: str) -> str:
    """Return a name as a list has it: as it is, or as a JSON string where it would not stay on its line."""
    is_plain = name and not name.startswith('"') and name == name.strip()
    if is_plain and not any(unicodedata.category(c) in _UNWRITABLE for c in name):
        return name
    return _as_json(name)


def _as_json(name: str) -> str:
    text = json.dumps(name, ensure_ascii=False)
    return "".join(f"\\u{ord(c):04x}" if unicodedata.category(c) in _UNWRITABLE else c for c in text)


def unquoted(field: str) -> str:
    """Return the name that a field of a list stands for; ValueError where it begins with a quote and is no JSON."""
    return str(json.loads(field)) if field.startswith('"') else field


def removed_text(images: Iterable[AuditedImage], extra: Iterable[Mapping[str, object]] = ()) -> str:
    """Return a CSV table of images with the reasons why they were removed; ``extra`` are columns put before, by row."""
    extras = list(extra)
    rows: list[dict[str, object]] = []
    for position, image in enumerate(images):
        own: dict[str, object] = {name: getattr(image, name) for name in COLUMNS}
        own["reasons"] = "; ".join(image.reasons)
        rows.append({**(extras[position] if extras else {}), **own})
    return csv_text(rows, COLUMNS)


def csv_text(rows: Sequence[Mapping[str, object]], columns: Sequence[str]) -> str:
    """Return rows as CSV, texts as :func:`cell` has them; a header line even where there is no row."""
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: cell(value) for name, value in row.items()} for row in rows)
    return text.getvalue()


def cell(value: object) -> object:
    """Return a value as a table has it: as it is, or as a JSON string where a spreadsheet or a terminal would obey it.

    A text that begins as a formula does, or that a list would not have on a line as it is; :func:`unquoted` is the way
    back.
    """
    if not isinstance(value, str) or not value:
        return value
    return _as_json(value) if value.startswith(_FORMULA) else quoted(value)


def as_bytes(text: str) -> bytes:
    """Return a text as UTF-8; what UTF-8 cannot hold becomes its code."""
    return text.encode("utf-8", errors="backslashreplace")
