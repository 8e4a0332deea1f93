"""Position priors of a model: of its database, or of a CSV file.

CSV: a line of column names, then a line per image. ``name``; ``x, y, z`` (any Cartesian unit; metres with ``unit=m``
in a comment line) or ``lat, lon, alt`` (WGS84, degrees and m); and, where known, ``sd``, or ``sd_x, sd_y, sd_z``, or
``cov_xx, cov_xy, cov_xz, cov_yy, cov_yz, cov_zz``, in the same unit (m, east-north-up with WGS84). Lines that begin
with # are comments.
"""

from __future__ import annotations

import csv
import re
from pathlib import Path
from typing import Final

import numpy as np

from sfm_audit.loaders.arrays import BoolArray, FloatArray
from sfm_audit.loaders.colmap.database import database_of
from sfm_audit.loaders.colmap.priors import CARTESIAN, NOT_SAID, WGS84, StoredPriors, read_stored_priors
from sfm_audit.loaders.errors import LoadError, MalformedFileError, called
from sfm_audit.loaders.evidence import NotAsked, PositionPriors
from sfm_audit.loaders.model import SparseModel
from sfm_audit.loaders.paths.files import open_input, reading
from sfm_audit.loaders.paths.locations import InputPath, parse_location
from sfm_audit.loaders.paths.text_lines import TextFile, parse_floats, read_text
from sfm_audit.loaders.references.geodesy import ecef_of, enu_of
from sfm_audit.loaders.references.matching import rows_by_name
from sfm_audit.loaders.references.poses import ADVICE, MAX_POSES

AUTO: Final = "auto"
_MAGIC: Final = b"SQLite format 3\0"
_CARTESIAN: Final = ("x", "y", "z")
_GEODETIC: Final = ("lat", "lon", "alt")
_SDS: Final = ("sd_x", "sd_y", "sd_z")
_COVARIANCE: Final = ("cov_xx", "cov_xy", "cov_xz", "cov_yy", "cov_yz", "cov_zz")
_UPPER: Final = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
_MAX_ALTITUDE_M: Final = 1e7
_MAX_COORDINATE: Final = 1e12
_NAMES_SHOWN: Final = (8, 20)  # of a header that is none: so many names, so many characters of each


def priors_of(model: SparseModel, priors: str, shown_as: str, below: str = "") -> PositionPriors | NotAsked:
    """Return the position priors of a model's images.

    Parameters
    ----------
    priors : ``auto``: the database beside the model or up to three folders above; or a database, or a CSV file
    shown_as : the model's location for messages
    below : the path of the model below what was given, with slashes: a database that belongs to the model is called
        by its place there

    Returns
    -------
    PositionPriors
        `NotAsked` where there is no database for ``auto``, or no prior of the model's images.

    Raises
    ------
    LoadError
        The named file cannot be read.
    """
    if priors != AUTO:
        return _of_images(model, parse_location(priors))
    try:
        path, name = database_of(model.location, shown_as, below, "--priors")
        with called(name):
            return _of_images(model, path, name)
    except LoadError as error:
        return NotAsked(str(error))


def _of_images(model: SparseModel, path: InputPath, shown: str | None = None) -> PositionPriors | NotAsked:
    stored, is_metric = read_priors(path)
    rows = rows_by_name(stored.names, list(range(len(stored.names))), model.images.name)
    if not (rows >= 0).any():
        wanted, got = "priors of the model's images", f"{len(stored.names)} of other images" if stored.names else "none"
        return NotAsked(str(LoadError(shown or str(path), None, wanted, got, ADVICE)))
    position, covariance = stored.position[rows], stored.covariance[rows]  # row -1 is replaced
    position[rows < 0], covariance[rows < 0] = np.nan, np.nan
    if stored.system == WGS84:
        position = enu_of(position, _middle_of(stored.position[rows[rows >= 0]]))
    return PositionPriors(shown or str(path), position, covariance, is_metric)


def _middle_of(geodetic: FloatArray) -> FloatArray:
    """Return the one of (n, 3) positions that is nearest to their median, which one wrong prior does not move."""
    ecef = ecef_of(geodetic)
    nearest: FloatArray = geodetic[np.argmin(((ecef - np.median(ecef, axis=0)) ** 2).sum(axis=1))]
    return nearest


def read_priors(path: InputPath) -> tuple[StoredPriors, bool]:
    """Read a database or CSV file; also whether its unit is the metre. LoadError where it cannot be read."""
    file, _ = open_input(path, only_head=True)
    with file, reading(path):
        is_database = file.read(len(_MAGIC)) == _MAGIC
    if is_database and isinstance(path, Path):
        stored = read_stored_priors(path)
        is_metric = stored.system in {WGS84, CARTESIAN}  # pycolmap's are metres; what has no system has no unit
    else:
        stored, is_metric = _read_csv(path)
    _check(path, stored)
    return stored, is_metric


def _check(path: InputPath, stored: StoredPriors) -> None:
    """Raise where positions or covariances cannot be such."""
    position, covariance = stored.position, stored.covariance
    limits = np.array([90.0, 360.0, _MAX_ALTITUDE_M]) if stored.system == WGS84 else np.full(3, _MAX_COORDINATE)
    wrong = np.flatnonzero(~(np.abs(position) <= limits).all(axis=1))
    if len(wrong):
        what = "latitude, longitude and altitude" if stored.system == WGS84 else "a position"
        got = f"{position[wrong[0]].tolist()} of {stored.names[wrong[0]]!r}"
        raise MalformedFileError(str(path), None, what, got, ADVICE)
    known = np.isfinite(covariance).all(axis=(1, 2))
    with np.errstate(all="ignore"):
        values = np.full((len(covariance), 3), 1.0)
        symmetric = np.abs(covariance - covariance.transpose(0, 2, 1)).max(axis=(1, 2), initial=0.0)
        values[known] = np.linalg.eigvalsh(covariance[known])
        largest = values[:, 2]
        bad = known & ~((values[:, 0] > 1e-12 * largest) & (largest < _MAX_COORDINATE) & (symmetric <= 1e-6 * largest))
    half = np.isfinite(covariance).any(axis=(1, 2)) & ~known
    wrong = np.flatnonzero(bad | half)
    if len(wrong):
        name = stored.names[wrong[0]]
        got = f"one that is none, of {name!r}"
        raise MalformedFileError(str(path), None, "covariances that are symmetric and positive", got, ADVICE)


def _read_csv(path: InputPath) -> tuple[StoredPriors, bool]:
    file = read_text(path, ADVICE)
    lines = [(line, record) for line, record in file.records()]
    if not lines:
        raise file.truncated("a line of column names", "none")
    if not file.is_terminated:
        raise file.truncated("a line end after the last line", "none, so its last number may be cut")
    header = [cell.strip().lower() for cell in _cells(file, *lines[0])]
    axes = next((axes for axes in (_CARTESIAN, _GEODETIC) if set(axes) <= set(header)), None)
    if "name" not in header or axes is None or len(set(header)) != len(header):
        count, length = _NAMES_SHOWN
        got = f"{len(header)}: {', '.join(repr(cell[:length]) for cell in header[:count])}"
        raise file.malformed(lines[0][0], "the columns name and x, y, z, or name and lat, lon, alt", got)
    sds = next((each for each in (_COVARIANCE, _SDS, ("sd",)) if set(each) <= set(header)), ())
    if len(lines) > MAX_POSES:
        raise file.malformed(lines[MAX_POSES][0], f"at most {MAX_POSES} priors", "more")
    names, rows = [], []
    for line, record in lines[1:]:
        cells = [cell.strip() for cell in _cells(file, line, record)]
        if len(cells) != len(header):
            raise file.malformed(line, f"{len(header)} cells, as the line of names has", f"{len(cells)}")
        names.append(cells[header.index("name")])
        wanted = [cells[header.index(column)] or "nan" for column in (*axes, *sds)]
        rows.append(parse_floats(file, line, [cell.encode() for cell in wanted], ", ".join((*axes, *sds))))
    values = np.array(rows).reshape(len(rows), len(axes) + len(sds))
    known: BoolArray = np.asarray(np.isfinite(values[:, :3]).all(axis=1))
    kept = tuple(name for name, is_known in zip(names, known, strict=True) if is_known)
    if len(set(kept)) != len(kept):
        raise file.malformed(lines[0][0], "each name once", f"{len(kept) - len(set(kept))} again")
    system = WGS84 if axes == _GEODETIC else NOT_SAID
    in_metres = any(b"unit=m" in comment for comment in _comments(file))
    values = values[known]
    stored = StoredPriors(kept, values[:, :3], _covariance(values[:, 3:]), system)
    return stored, system == WGS84 or in_metres


def _comments(file: TextFile) -> list[list[bytes]]:
    """Return the words of each comment; blanks around = do not count."""
    lines = (line.strip() for line in file.lines)
    return [re.split(rb"[#\s,;]+", re.sub(rb"\s*=\s*", b"=", line)) for line in lines if line.startswith(b"#")]


def _covariance(values: FloatArray) -> FloatArray:
    """(n, 3, 3) from no column, one sd, three sds, or six numbers."""
    n, columns = values.shape
    if columns == len(_COVARIANCE):
        full: FloatArray = values[:, _UPPER]
        return full
    out = np.full((n, 3, 3), np.nan)
    if columns:
        with np.errstate(over="ignore"):
            squares = np.where(values > 0, values**2, np.where(np.isnan(values), np.nan, -1.0))  # -1: refused by _check
        unknown: BoolArray = np.asarray(np.isnan(squares).any(axis=1))
        out[:] = np.where(unknown[:, None, None], np.nan, 0.0)
        for axis in range(3):
            out[:, axis, axis] = squares[:, axis if columns == 3 else 0]
    return out


def _cells(file: TextFile, line: int, record: bytes) -> list[str]:
    try:
        return next(csv.reader([record.decode("utf-8-sig").strip("\r")], strict=True))
    except (UnicodeDecodeError, csv.Error, StopIteration) as error:
        raise file.malformed(line, "a line of CSV in UTF-8", str(error)) from error
