"""One calibration for ``sfm-audit calibrate``: estimated, validated, drawn. Imports matplotlib, OpenCV and PoseLib."""

from __future__ import annotations

import importlib.metadata
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from matplotlib.figure import Figure
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from sfm_audit.audit.calibrate.estimate import DegenerateInputError
from sfm_audit.audit.calibrate.estimators import estimator
from sfm_audit.audit.calibrate.rows import Row, calibration_row, calibration_table, degenerate_row, residuals_table
from sfm_audit.audit.calibrate.undistort import undistort_image
from sfm_audit.audit.calibrate.validation import NoiseChoice, Validation, validate
from sfm_audit.audit.config import AuditConfig
from sfm_audit.loaders.correspondences.records import Correspondences
from sfm_audit.loaders.correspondences.scan_ptx import read_ptx
from sfm_audit.loaders.correspondences.table import read_correspondences
from sfm_audit.loaders.errors import LoadError, MalformedFileError, MissingFileError
from sfm_audit.reports import figures
from sfm_audit.reports.charts import Residuals

CALIBRATION_FILE: Final = "calibration.parquet"
RESIDUALS_FILE: Final = "residuals.parquet"


@dataclass(frozen=True, slots=True)
class Request:
    """What a user asks for; see ``sfm-audit calibrate --help``."""

    correspondences: str
    config: AuditConfig
    models: tuple[str, ...]
    scan: str | None
    image: Path | None
    width: int | None
    height: int | None
    threshold_px: float
    noise: NoiseChoice
    seed: int

    @property
    def settings(self) -> dict[str, Any]:
        """Everything that changes a number."""
        config = self.config
        return {
            "version": importlib.metadata.version("sfm-audit"),
            "scan": self.scan,
            "threshold_px": self.threshold_px,
            "noise": self.noise,
            "alpha": config.alpha,
            "min_effect": config.min_effect,
            "policy": config.policy,
            "seed": self.seed,
        }


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """What was found: the table ``calibration``, the validated estimates, and the photo if there is one."""

    request: Request
    correspondences: Correspondences
    table: pa.Table
    validations: Sequence[Validation]
    photo: NDArray[np.uint8] | None

    def files(self) -> dict[str, bytes]:
        """Return the content of every file but the summary, by name."""
        metadata = {"sfm_audit": json.dumps(self.request.settings)}
        files = {
            CALIBRATION_FILE: _parquet(self.table, metadata),
            RESIDUALS_FILE: _parquet(residuals_table(self.validations, self.correspondences), metadata),
        }
        rows = {row["model"]: row for row in self.table.to_pylist()}
        for found in self.validations:
            name = found.estimate.name
            drawn = _figures(found, rows[name], self.request.config.alpha)
            for number, (what, figure) in enumerate(drawn.items(), 1):
                files[f"{name}_{number:02d}_{what}.png"] = _png(figure)
            if self.photo is not None:
                files[f"{name}_undistorted.png"] = _encoded(undistort_image(self.photo, found.estimate.camera))
        return files


def calibrate(request: Request) -> Calibration:
    """Read, estimate with every model, and validate; an estimator that refuses gives an undetermined row.

    Raises
    ------
    LoadError
        An input cannot be read, or does not fit the others.
    """
    scan = None if request.scan is None else read_ptx(request.scan)
    correspondences = read_correspondences(
        request.correspondences, width=request.width, height=request.height, scan=scan
    )
    if request.noise == "lidar" and not correspondences.has_neighbours:
        wanted, got = "neighbours in the scan for --noise lidar (Xp..Zt)", "none"
        raise MalformedFileError(request.correspondences, None, wanted, got, "add them, or give --scan")
    photo = None if request.image is None else _read_photo(request.image, correspondences)
    rows: list[Row] = []
    validations = []
    with threadpool_limits(limits=1, user_api="blas"):
        for name in request.models:
            try:
                found = _validated(name, correspondences, request)
            except DegenerateInputError as error:
                rows.append(degenerate_row(name, error, correspondences, request.correspondences))
                continue
            validations.append(found)
            rows.append(calibration_row(found, correspondences, request.correspondences, request.config.alpha))
    return Calibration(request, correspondences, calibration_table(rows), validations, photo)


def _validated(name: str, correspondences: Correspondences, request: Request) -> Validation:
    rng = np.random.default_rng(request.seed)  # one each: no model's numbers depend on which others were asked for
    estimate = estimator(name, request.threshold_px)(correspondences, rng)
    return validate(estimate, correspondences, noise=request.noise, config=request.config)


def _read_photo(path: Path, correspondences: Correspondences) -> NDArray[np.uint8]:
    """Read a photo of the size that the correspondences have, as it is stored (no rotation by EXIF)."""
    try:
        content = np.frombuffer(path.read_bytes(), dtype=np.uint8)
    except FileNotFoundError as error:
        raise MissingFileError(str(path), None, "a photo", "nothing there", "check --image") from error
    except OSError as error:
        raise LoadError(str(path), None, "a photo", error.strerror or str(error), "check --image") from error
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    photo = cv2.imdecode(content, flags) if content.size else None
    if photo is None:
        raise MalformedFileError(str(path), None, "a photo that OpenCV reads", "something else", "check --image")
    height, width = photo.shape[:2]
    if (width, height) != (correspondences.width, correspondences.height):
        wanted = f"{correspondences.width} x {correspondences.height} px, as the correspondences say"
        raise MalformedFileError(str(path), None, wanted, f"{width} x {height} px", "give the photo they were taken in")
    return np.asarray(photo, dtype=np.uint8)


def _figures(found: Validation, row: Mapping[str, Any], alpha: float) -> dict[str, Figure]:
    camera = found.estimate.camera
    size = float(camera.width), float(camera.height)
    residuals = Residuals.build(
        found.xy_px,
        found.residuals_px,
        z=found.robust.noise.z,
        size_px=size,
        centre_px=camera.principal_point_px,
        sigma_px=found.sigma_constant_px,
    )
    return {
        "residual_vectors": figures.residual_vectors(residuals),
        "radial_profile": figures.radial_profile(residuals),
        "misfit_groups": figures.misfit_groups(row, tau_px=found.tau_px, alpha=alpha),
        "standardised_histogram": figures.standardised_histogram(residuals),
        "qq_plot": figures.qq_plot(residuals),
        "scale_comparison": figures.scale_comparison(residuals),
        "expected_error": figures.expected_error(found.expected_error.error_px, size),
    }


def _parquet(table: pa.Table, metadata: Mapping[str, str]) -> bytes:
    sink = BytesIO()
    pq.write_table(table.replace_schema_metadata(dict(metadata)), sink)
    return sink.getvalue()


def _png(figure: Figure) -> bytes:
    content = BytesIO()
    figure.savefig(content, format="png")
    return content.getvalue()


def _encoded(photo: NDArray[np.uint8]) -> bytes:
    done, content = cv2.imencode(".png", photo)
    if not done:  # pragma: no cover - PNG holds every 8 bit image
        raise ValueError("OpenCV could not write a PNG")
    return content.tobytes()
