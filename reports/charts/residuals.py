"""What does a figure need to know about one image? Where its inliers are, what is left of them, and on what scale."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import ArrayLike

from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.loaders.camera_models import BY_NAME
from sfm_audit.reports.errors import RunFolderError
from sfm_audit.reports.run_folder.reader import RunReader

_MAD_OF_NORMAL: Final = 0.6744897501960817
_XY: Final = ("x_px", "y_px")
_RESIDUAL: Final = ("residual_x_px", "residual_y_px")
_Z: Final = ("z_x", "z_y")
_IMAGE_COLUMNS: Final = (
    *("scene", "component", "image_id", "image_name", "camera_model", "width", "height", "params"),
    "sigma_constant_px",
)


class Columns(Protocol):
    """A data frame, an Arrow table, a dict of arrays: anything that answers to column names."""

    def __getitem__(self, name: str, /) -> Any:
        """Return one column."""


class ResidualError(ValueError):
    """The residuals cannot be drawn: a column is missing, a number is not finite, a run has none; one line says it."""


@dataclass(frozen=True, slots=True, eq=False)
class Residuals:
    """The residuals of one image.

    xy_px: (n, 2) observed points.    residual_px: (n, 2) observed - projected, px.    z: (m, 2) standardised, m <= n.
    size_px: width and height.        centre_px: the optical axis in the image.        sigma_px: robust sd per axis.
    """

    xy_px: FloatArray
    residual_px: FloatArray
    z: FloatArray
    size_px: tuple[float, float]
    centre_px: tuple[float, float]
    sigma_px: float

    @classmethod
    def build(
        cls,
        xy_px: ArrayLike,
        residual_px: ArrayLike,
        *,
        z: ArrayLike | None = None,
        size_px: tuple[float, float] | None = None,
        centre_px: tuple[float, float] | None = None,
        sigma_px: float | None = None,
    ) -> Residuals:
        """Check and complete.

        Parameters
        ----------
        xy_px, residual_px : (n, 2) px, finite
        z : (m, 2); rows with NaN are left out. By default the residuals over ``sigma_px``
        size_px : width and height; by default as far as the points reach
        centre_px : by default the centre of the image
        sigma_px : robust sd per axis; by default the median of |residual| / 0.6745

        Raises
        ------
        ResidualError
            Shapes that do not match, or numbers that are not finite.
        """
        points, left = _pairs(xy_px, "xy_px"), _pairs(residual_px, "residual_px")
        if len(points) != len(left):
            raise ResidualError(f"{len(points)} points but {len(left)} residuals; one of each per observation")
        if not np.isfinite(points).all() or not np.isfinite(left).all():
            raise ResidualError("a point or a residual is not finite; leave such rows out first")
        if sigma_px is None or not math.isfinite(sigma_px):
            sigma_px = float(np.median(np.abs(left))) / _MAD_OF_NORMAL if len(left) else math.nan
        if size_px is None:
            reach = points.max(axis=0, initial=1.0)
            size_px = float(reach[0]), float(reach[1])
        standardised = _pairs(z, "z") if z is not None else left / sigma_px if sigma_px > 0 else np.empty((0, 2))
        return cls(
            points,
            left,
            standardised[np.isfinite(standardised).all(axis=1)],
            size_px,
            centre_px or (size_px[0] / 2.0, size_px[1] / 2.0),
            sigma_px,
        )

    @classmethod
    def from_table(
        cls,
        table: Columns,
        *,
        size_px: tuple[float, float] | None = None,
        centre_px: tuple[float, float] | None = None,
        sigma_px: float | None = None,
    ) -> Residuals:
        """Build from columns ``x_px, y_px, residual_x_px, residual_y_px`` and, where there are any, ``z_x, z_y``.

        Any data frame, Arrow table or dict of arrays: rows of ``RUN/observations`` or a table of your own.
        """
        z = _two_columns(table, _Z) if _has(table, _Z) else None
        points, left = _two_columns(table, _XY), _two_columns(table, _RESIDUAL)
        return cls.build(points, left, z=z, size_px=size_px, centre_px=centre_px, sigma_px=sigma_px)

    def replaced(self, field_px: FloatArray) -> Residuals:
        """Return the same image with another field (n, 2) in place of its residuals, to draw it the same way."""
        return replace(self, residual_px=field_px)

    def __len__(self) -> int:
        return len(self.xy_px)


def read_residuals(run: str | Path, image: str, *, scene: str | None = None, component: str | None = None) -> Residuals:
    """Read one image's residuals from a run that was made with ``--observations``.

    Parameters
    ----------
    run : the run folder
    image : its name, or ``id:<image_id>``
    scene, component : which of several models of that run holds it; needed only where several have the name

    Raises
    ------
    ResidualError
        No such image, several of them, or no observations in this run.
    """
    wanted = {"scene": scene, "component": component}
    found: list[tuple[str, Mapping[str, Any]]] = []
    try:
        reader = RunReader.open(Path(run))
        for name, rows in reader.parts("images", _IMAGE_COLUMNS):
            by_id = image.removeprefix("id:") if image.startswith("id:") else None
            named = [row for row in rows if row["image_name"] == image] or [
                row for row in rows if by_id == str(row["image_id"])
            ]
            found += [(name, row) for row in named if all(v is None or row[k] == v for k, v in wanted.items())]
        if len(found) != 1:
            problem = "no image" if not found else f"{len(found)} images"
            raise ResidualError(f"{run}: {problem} of the name {image!r}; name id:<image_id>, and its scene")
        return residuals_of_row(reader, *found[0])
    except RunFolderError as error:
        raise ResidualError(str(error)) from error


def residuals_of_row(run: RunReader, part: str, row: Mapping[str, Any]) -> Residuals:
    """Read the residuals of the image in one row of ``RUN/images``, from the part of the same name.

    Raises
    ------
    ResidualError
        The run holds none.
    RunFolderError
        The part is not what the run wrote.
    """
    table = run.rows_of_image("observations", part, row["image_id"], (*_XY, *_RESIDUAL, *_Z))
    if table is None:
        raise ResidualError(f"{run.folder}: holds no observations; run again with --observations")
    return residuals_from(table, row)


def residuals_from(table: Columns, row: Mapping[str, Any]) -> Residuals:
    """Build from a table of residuals and the image's row of ``RUN/images``, which knows camera and noise."""
    return Residuals.from_table(
        table,
        size_px=(row["width"], row["height"]) if row["width"] else None,
        centre_px=principal_point(row),
        sigma_px=row["sigma_constant_px"],
    )


def principal_point(row: Mapping[str, Any]) -> tuple[float, float] | None:
    """Return cx, cy of the camera in a row, px; None where it has none."""
    model = BY_NAME.get(row["camera_model"] or "")
    if model is None or not model.principal_point_idxs or not row["params"]:
        return None
    x, y = (float(row["params"][i]) for i in model.principal_point_idxs)
    return (x, y) if math.isfinite(x) and math.isfinite(y) else None


def _pairs(values: ArrayLike, name: str) -> FloatArray:
    array = np.asarray(values, dtype=np.float64)
    if array.size == 0:
        return np.empty((0, 2))
    if array.ndim != 2 or array.shape[1] != 2:
        raise ResidualError(f"{name}: expected an array of shape (n, 2), found {array.shape}")
    return array


def _has(table: Columns, names: tuple[str, str]) -> bool:
    try:
        return all(table[name] is not None for name in names)
    except KeyError:
        return False


def _two_columns(table: Columns, names: tuple[str, str]) -> FloatArray:
    try:
        return np.column_stack([np.asarray(table[name], dtype=np.float64) for name in names])
    except KeyError as error:
        raise ResidualError(
            f"the table has no column {error.args[0]}; it needs {', '.join((*_XY, *_RESIDUAL))}"
        ) from error
