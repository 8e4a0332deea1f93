"""2D-3D correspondences from a table: CSV or Parquet with columns x, y, X, Y, Z (docs/correspondences.md)."""

from __future__ import annotations

from pathlib import Path
from typing import Final, Literal

import numpy as np

from sfm_audit.loaders.arrays import BoolArray, FloatArray
from sfm_audit.loaders.correspondences.gridded_scan import GriddedScan, neighbours
from sfm_audit.loaders.correspondences.number_table import NumberTable, read_number_table
from sfm_audit.loaders.correspondences.records import Correspondences
from sfm_audit.loaders.errors import MalformedFileError
from sfm_audit.loaders.paths.locations import parse_location

IMAGE: Final = ("x", "y")
WORLD: Final = ("X", "Y", "Z")
PAN: Final = ("Xp", "Yp", "Zp")
TILT: Final = ("Xt", "Yt", "Zt")
IGNORED: Final = ("name",)

_MAX_SIDE: Final = 2**31 - 1  # px; what readers of images can count


def read_correspondences(
    location: str | Path, *, width: int | None = None, height: int | None = None, scan: GriddedScan | None = None
) -> Correspondences:
    """Read the correspondences of one image.

    Parameters
    ----------
    location : of a CSV or Parquet file; its first bytes say which. Columns x, y (px, first pixel centre at 0.5, 0.5),
        X, Y, Z (model units), either all or none of Xp, Yp, Zp, Xt, Yt, Zt (the neighbours in pan and tilt), and
        ``name``, which is not read
    width, height : of the image, px, where the file does not state them
    scan : that X, Y, Z were picked from; its grid then gives the neighbours

    Raises
    ------
    LoadError
        The file cannot be read; a column is missing or unknown; a cell is no finite number; a point lies outside the
        image; the size of the image is missing or stated twice, differently; a neighbour is the point itself; a point
        is not one of the scan, or has no neighbour there; the file states ``rows=N`` and holds another number. The
        message names the line (CSV) or row (Parquet, from 1).
    """
    table = read_number_table(parse_location(location), (IMAGE, WORLD, PAN, TILT), IGNORED)
    has_neighbours = _check_columns(table)
    _check_rows(table)
    size = _side(table, "width", width), _side(table, "height", height)
    xy_px, xyz_world = table.groups[IMAGE], table.groups[WORLD]
    _check_inside(table, xy_px, size)
    pan = table.groups[PAN] if has_neighbours else None
    tilt = table.groups[TILT] if has_neighbours else None
    if scan is not None:
        if has_neighbours:
            got = f"columns {', '.join((*PAN, *TILT))} and a scan"
            advice = "leave out the scan, or remove the columns"
            raise MalformedFileError(table.path, table.header(), "neighbours from one source", got, advice)
        pan, tilt = _look_up(table, xyz_world, scan)
    for what, neighbour in (("pan", pan), ("tilt", tilt)):
        if neighbour is not None:
            wanted = f"a neighbour in {what} that is another point"
            distance = np.linalg.norm(neighbour - xyz_world, axis=1)
            _refuse(table, distance == 0.0, wanted, WORLD, "name the next point of the scan")
    return Correspondences(*size, xy_px, xyz_world, pan, tilt)


def _check_columns(table: NumberTable) -> bool:
    """Whether the table has the neighbours; raises where columns are missing."""
    missing = [name for name in (*IMAGE, *WORLD) if name not in table.columns]
    if missing:
        raise _missing(table, missing, "add them")
    optional = (*PAN, *TILT)
    missing = [name for name in optional if name not in table.columns]
    if missing and len(missing) < len(optional):
        raise _missing(table, missing, "give both neighbours of every point, or none")
    return not missing


def _missing(table: NumberTable, missing: list[str], advice: str) -> MalformedFileError:
    wanted = f"column{'s' if len(missing) > 1 else ''} {', '.join(missing)}"
    got = f"only {', '.join(table.columns)}"
    return MalformedFileError(table.path, table.header(), wanted, got, advice)


def _check_rows(table: NumberTable) -> None:
    """Compare the number of rows with the number that the file states, if it does: a truncated file is recognised."""
    stated = table.facts.get("rows")
    if stated is not None and stated != str(table.num):
        advice = "copy the file again, or correct what it states"
        raise MalformedFileError(table.path, None, f"{stated} rows, as it states", f"{table.num}", advice)


def _side(table: NumberTable, what: Literal["width", "height"], option: int | None) -> int:
    """The width or height of the image, px, from the file or the option; both must say the same."""
    stated = table.facts.get(what)
    if stated is None and option is None:
        advice = "add a first line such as `# width=1600 height=1200` (Parquet: schema metadata), or give the option"
        raise MalformedFileError(table.path, None, f"the image's {what}, px", "nothing", advice)
    if stated is not None and not (stated.isascii() and stated.isdigit() and len(stated) <= 10):
        raise _not_a_side(table, what, stated)
    side = int(stated) if stated is not None else option
    if side is None or not 0 < side <= _MAX_SIDE:
        raise _not_a_side(table, what, str(side))
    if option is not None and side != option:
        advice = "leave out the option, or correct the file"
        raise MalformedFileError(table.path, None, f"{what}={option}, as the option says", f"{what}={side}", advice)
    return side


def _not_a_side(table: NumberTable, what: str, got: str) -> MalformedFileError:
    return MalformedFileError(table.path, None, f"the image's {what}, a whole number of px", got[:40], "correct it")


def _check_inside(table: NumberTable, xy_px: FloatArray, size: tuple[int, int]) -> None:
    beyond = (xy_px < 0.0) | (xy_px > np.array(size))
    advice = "check the image's size, and that the centre of the first pixel is (0.5, 0.5), not (0, 0)"
    _refuse(table, beyond[:, 0] | beyond[:, 1], f"a point inside the image of {size[0]} x {size[1]} px", IMAGE, advice)


def _look_up(table: NumberTable, xyz_world: FloatArray, scan: GriddedScan) -> tuple[FloatArray, FloatArray]:
    """Return the neighbours (n, 3) in pan and tilt, from the scan; raises where a point has none."""
    found = neighbours(scan, xyz_world)
    if found.faults:
        row, fault = next(iter(found.faults.items()))
        got = fault + _and_others(table, list(found.faults)[1:])
        advice = "copy X, Y, Z from the scan, after its transformation"
        wanted = f"a point of {scan.path} with neighbours in pan and tilt"
        raise MalformedFileError(table.path, table.position(row), wanted, got, advice)
    return found.pan_xyz_world, found.tilt_xyz_world


def _refuse(table: NumberTable, wrong: BoolArray, wanted: str, names: tuple[str, ...], advice: str) -> None:
    """Raise where a row is wrong; the first one is shown, the others are named."""
    rows = np.flatnonzero(wrong).tolist()
    if rows:
        got = ", ".join(table.at(name, rows[0]) for name in names) + _and_others(table, rows[1:])
        raise MalformedFileError(table.path, table.position(rows[0]), wanted, got, advice)


def _and_others(table: NumberTable, rows: list[int]) -> str:
    """Name the other rows with the same fault, ten at most."""
    if not rows:
        return ""
    numbers = ", ".join(str(table.position(row).number) for row in rows[:10])
    more = f" and {len(rows) - 10} more" if len(rows) > 10 else ""
    return f" (likewise {table.position(rows[0]).unit}s {numbers}{more})"
