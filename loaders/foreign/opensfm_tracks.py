"""OpenSfM's ``tracks.csv``: which image sees which track where. Facts at the head of `opensfm`."""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import Final

import numpy as np
import pyarrow as pa
from pyarrow import csv

from sfm_audit.loaders.arrays import FloatArray, IntArray
from sfm_audit.loaders.errors import MalformedFileError
from sfm_audit.loaders.model import Finding, FindingCode
from sfm_audit.loaders.paths.files import read_bytes
from sfm_audit.loaders.paths.locations import InputPath
from sfm_audit.loaders.paths.text_lines import check_text

_HEADER: Final = b"OPENSFM_TRACKS_VERSION_v"
_WIDTHS: Final = {0: 8, 1: 9, 2: 11}
_COLUMNS: Final = ("image", "track", "feature", "x", "y")
_ADVICE: Final = "check that this is OpenSfM's tracks.csv of version 0, 1 or 2, or create the tracks again"


@dataclass(frozen=True, slots=True, eq=False)
class Tracks:
    """All observations, one row each. image_idx, track_idx: (M,) positions in the names. xy: (M, 2) normalised."""

    image_names: list[str]
    track_names: list[str]
    image_idx: IntArray
    track_idx: IntArray
    xy: FloatArray
    findings: tuple[Finding, ...]


def read_tracks(path: InputPath) -> Tracks:
    """Read ``tracks.csv``; LoadError where that cannot be done."""
    check_text(path, _ADVICE)  # a file of zeros ends there, before it is in memory
    content = read_bytes(path)
    head, _, rest = content.partition(b"\n")
    version = 0
    if head.startswith(_HEADER):
        number = head.removeprefix(_HEADER).strip()
        version = int(number) if number.isdigit() and len(number) == 1 else -1
        body = rest
    else:
        body = content
    if version not in _WIDTHS:
        raise MalformedFileError(str(path), None, "version 0, 1 or 2 in the first line", f"{head[:60]!r}", _ADVICE)
    names = [*_COLUMNS, *(f"unused{row}" for row in range(_WIDTHS[version] - len(_COLUMNS)))]
    table = _parse(path, body, names) if body.strip() else pa.table({name: pa.array([], pa.string()) for name in names})
    image, track = (table[name].combine_chunks().dictionary_encode() for name in ("image", "track"))
    xy = [np.asarray(table[name].cast(pa.float64()).to_numpy(), np.float64) for name in ("x", "y")]
    ended = not body or body.endswith(b"\n")
    text = f"{path.name} does not end its last line: its last number may be cut"
    return Tracks(
        [str(name) for name in image.dictionary.to_pylist()],
        [str(name) for name in track.dictionary.to_pylist()],
        image.indices.to_numpy().astype(np.int64),
        track.indices.to_numpy().astype(np.int64),
        np.stack(xy, axis=1).reshape(-1, 2),
        () if ended else (Finding(FindingCode.UNTERMINATED_TEXT, 1, text),),
    )


def _parse(path: InputPath, body: bytes, names: list[str]) -> pa.Table:
    """Return the five columns that matter, by Arrow's parser."""
    types = {name: pa.float64() if name in {"x", "y"} else pa.string() for name in names}
    try:
        return csv.read_csv(
            io.BytesIO(body),
            read_options=csv.ReadOptions(column_names=names, use_threads=False),
            parse_options=csv.ParseOptions(delimiter="\t", quote_char=False),
            convert_options=csv.ConvertOptions(
                column_types=types, include_columns=list(_COLUMNS), null_values=[], strings_can_be_null=False
            ),
        )
    except (pa.ArrowInvalid, pa.ArrowKeyError) as error:
        got = str(error).splitlines()[0][:160]
        raise MalformedFileError(str(path), None, f"lines of {len(names)} values", got, _ADVICE) from None
