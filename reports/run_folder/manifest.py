"""Which models and parts does a run folder hold? manifest.jsonl, a line per model, kept as bytes and read line by line.

While a run is under way lines are added as models are finished, and the last line of a model holds; a line that ends
it (``dropped``) says that it has no parts any more. When the run is complete the file is written anew, by key, and its
SHA-256 goes into run.json.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from pydantic import ValidationError

from sfm_audit.reports.errors import DamagedRunError
from sfm_audit.reports.run_folder.disk import read_plain
from sfm_audit.reports.run_folder.record import ManifestRecord, ModelRecord, first_problem

MANIFEST: Final = "manifest.jsonl"
MAX_BYTES: Final = 512_000_000  # 600,000 models
_KEY_FIRST: Final = b'{"key": "'
_KEY_CHARS: Final = 16
_DROPPED: Final = b'", "dropped": true}'


@dataclass(frozen=True, slots=True, eq=False)
class Manifest:
    """The lines of a manifest, one per model, in the order of their keys."""

    folder: Path
    lines: tuple[bytes, ...]

    @classmethod
    def read(cls, folder: Path, wanted: ManifestRecord | None) -> Manifest:
        """Read the manifest of a complete run (``wanted``), or of one under way (None).

        Raises
        ------
        DamagedRunError
            It is not the one that run.json names.
        """
        try:
            content = read_plain(folder / MANIFEST, MAX_BYTES, follow_links=False)
        except FileNotFoundError as error:
            if wanted is None:
                return cls(folder, ())
            raise DamagedRunError(folder, f"its {MANIFEST} is gone") from error
        except OSError as error:
            raise DamagedRunError(folder, f"its {MANIFEST} cannot be read ({error.strerror})") from error
        if wanted is not None and hashlib.sha256(content).hexdigest() != wanted.sha256:
            raise DamagedRunError(folder, f"its {MANIFEST} is not the one that its run.json names")
        lines = _last_lines(content)
        if wanted is not None and len(lines) != wanted.num_models:
            raise DamagedRunError(folder, f"its {MANIFEST} names {len(lines)} models, its run.json {wanted.num_models}")
        return cls(folder, lines)

    def __len__(self) -> int:
        return len(self.lines)

    def models(self) -> Iterator[ModelRecord]:
        """Yield what the lines say; DamagedRunError where one is none."""
        for number, line in enumerate(self.lines, 1):
            yield _parsed(self.folder, number, line)

    def find(self, key: str) -> ModelRecord | None:
        """Return what is said of the model with this key; None where there is none."""
        start = _KEY_FIRST + key.encode()
        return next(
            (_parsed(self.folder, n, line) for n, line in enumerate(self.lines, 1) if line.startswith(start)), None
        )

    def by_key(self) -> dict[str, bytes]:
        """Return the lines by the keys they begin with; others are left out, their models count as not finished."""
        return {_key_of(line): line for line in self.lines if line.startswith(_KEY_FIRST)}


def line_of(model: ModelRecord) -> bytes:
    """Return the line of a model, without its end."""
    return json.dumps(model.model_dump()).encode()


def dropped_line(key: str) -> bytes:
    """Return the line that says that a model has no parts any more."""
    return _KEY_FIRST + key.encode() + _DROPPED


def parsed_or_none(line: bytes) -> ModelRecord | None:
    """Return what a line says; None where it is damaged."""
    try:
        return ModelRecord.model_validate_json(line)
    except ValidationError:
        return None


def with_hash(lines: Iterable[bytes]) -> tuple[list[bytes], ManifestRecord]:
    """Return the pieces of a manifest file, and what run.json says of it."""
    pieces = [line + b"\n" for line in lines]
    digest = hashlib.sha256()
    for piece in pieces:
        digest.update(piece)
    return pieces, ManifestRecord(num_models=len(pieces), sha256=digest.hexdigest())


def _last_lines(content: bytes) -> tuple[bytes, ...]:
    """Return the last line of each key in the order of keys; the rest of a line that was being written is left out."""
    last: dict[str, bytes] = {}
    for line in content.split(b"\n")[:-1]:
        last[_key_of(line)] = line
    return tuple(last[key] for key in sorted(last) if not last[key].endswith(_DROPPED))


def _key_of(line: bytes) -> str:
    """Return the key with which a line begins; of a damaged line, something that no other line has."""
    start = len(_KEY_FIRST)
    return line[start : start + _KEY_CHARS].decode(errors="replace") if line.startswith(_KEY_FIRST) else repr(line)


def _parsed(folder: Path, number: int, line: bytes) -> ModelRecord:
    try:
        return ModelRecord.model_validate_json(line)
    except ValidationError as error:
        raise DamagedRunError(folder, f"its {MANIFEST}: line {number} is damaged ({first_problem(error)})") from error
