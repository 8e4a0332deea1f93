"""The residuals of an image that a run does not hold, from the model as it lies where the run read it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np
from pydantic import ValidationError

from sfm_audit.audit.config import AuditConfig
from sfm_audit.audit.engine.model import ModelAuditor
from sfm_audit.audit.notebook.residuals import image_residuals_of
from sfm_audit.audit.table.thresholds import effect_px
from sfm_audit.loaders import LoadError, SparseModel, open_model
from sfm_audit.loaders.datasets.input_state import read_input_state
from sfm_audit.loaders.formats import keypoint_scales_of
from sfm_audit.loaders.paths.locations import RemotePath, parse_location
from sfm_audit.reports.charts import ResidualError, Residuals
from sfm_audit.reports.charts.residuals import residuals_of_row
from sfm_audit.reports.run_folder.reader import RunReader

_OTHER_MACHINES: Final = ("//", "\\\\")  # opening such a path sends the user's name to a host, on Windows


class ResidualSource:
    """Finds the residuals of the images of a run: in the run itself, else in its models, one in memory at a time.

    A run folder is data: of what it names, only models on this machine are read, and their residuals only where the
    files have the hash that the manifest knows. In an object store nothing is opened but what lies below ``named``, the
    locations of the command line, and with their options.
    """

    def __init__(self, run: RunReader, named: Sequence[str] = ()) -> None:
        self._run = run
        self._named = named
        self._last: tuple[str, ModelAuditor | ResidualError] | None = None

    def residuals(self, row: Mapping[str, Any]) -> Residuals:
        """Return the residuals of the image in a row of ``RUN/images`` that knows its ``part``.

        Raises
        ------
        ResidualError
            Neither the run nor the model has them; one line says why.
        RunFolderError
            The part of the run that has them is damaged.
        """
        if self._run.has_part("observations", row["part"]):
            return residuals_of_row(self._run, row["part"], row)
        auditor = self.auditor(row["model_path"])
        found = np.flatnonzero(auditor.model.images.image_id == row["image_id"])
        if not len(found):
            raise ResidualError(f"{row['model_path']}: holds no image of id {row['image_id']} any more")
        return image_residuals_of(auditor, int(found[0]), row)

    def pooled(self, row: Mapping[str, Any]) -> Residuals:
        """Return the residuals of all images of the camera in a row of ``RUN/cameras`` that knows its ``part``.

        Errors as of `residuals`.
        """
        size_px = (row["width"], row["height"]) if row["width"] else None
        if self._run.has_part("observations", row["part"]):
            names = ("x_px", "y_px", "residual_x_px", "residual_y_px")
            return Residuals.from_table(self._run.rows_of_camera(row["part"], row["camera_id"], names), size_px=size_px)
        auditor = self.auditor(row["model_path"])
        model, residuals = auditor.model, auditor.residuals
        mine = np.repeat(model.images.camera_id == row["camera_id"], np.diff(residuals.offsets))
        xy_px = model.observations.xy_px[residuals.observation_row[mine]]
        return Residuals.build(xy_px, residuals.residuals_px[:, mine].T, size_px=size_px)

    def model(self, model_path: str) -> SparseModel:
        """Return a model as it lies where the run read it, with the files that the run read.

        Raises
        ------
        ResidualError
            It cannot be read, or is another one now; one line says why.
        """
        return self.auditor(model_path).model

    def auditor(self, model_path: str) -> ModelAuditor:
        """Return the auditor of a model of the run, with the run's settings; the last one is kept.

        Errors as of `model`.
        """
        if self._last is None or self._last[0] != model_path:
            self._last = None  # two models at a time would be one too many
            try:
                self._last = model_path, self._open(model_path)
            except ResidualError as error:
                self._last = model_path, error
        found = self._last[1]
        if isinstance(found, ResidualError):
            raise found
        return found

    def _open(self, model_path: str) -> ModelAuditor:
        advice = "run again with --observations to keep the residuals with the run"
        known = next((each.sha256 for each in self._run.models() if each.model_path == model_path), None)
        try:
            location = allowed_location(self._run.info["paths"], model_path, self._named)
            if read_input_state(location).digest != known:
                raise ResidualError(f"{model_path}: the model changed since the run; {advice}")
            model = open_model(location)
            return auditor_of(model, AuditConfig.model_validate(self._run.info["config"]))
        except LoadError as error:
            raise ResidualError(f"the model cannot be read any more ({error}); {advice}") from error
        except ValidationError as error:
            raise ResidualError(f"the settings of this run are of another version; {advice}") from error


def auditor_of(model: SparseModel, config: AuditConfig) -> ModelAuditor:
    """Return the auditor of a model; the noise model ``keypoint`` reads the database.db beside or above it.

    Raises
    ------
    LoadError
        There is no database, or it cannot be read.
    """
    return ModelAuditor(
        model, config, keypoint_scales_of(model, model.location) if config.noise == "keypoint" else None
    )


def allowed_location(paths: Sequence[Mapping[str, str]], model_path: str, named: Sequence[str]) -> str:
    """Return where a model of a run may be read.

    Parameters
    ----------
    paths : the PATHs of the run with their real locations; data, as ``model_path`` is
    named : what the command line names

    Raises
    ------
    ResidualError
        It lies in an object store (or on another machine), and the command line does not name it.
    LoadError
        It is no location.
    """
    location = _recorded_location(paths, model_path)
    found = parse_location(location)
    if isinstance(found, RemotePath):
        for given in map(parse_location, named):
            if isinstance(given, RemotePath) and (given.scheme, *given.parts) == (
                found.scheme,
                *found.parts[: len(given.parts)],
            ):
                return str(replace(found, options=given.options))
        problem = f"{found.scheme}://{found.key}: is not opened because a run folder says so; name it with --model"
        raise ResidualError(problem)
    if location.startswith(_OTHER_MACHINES) or "\0" in location:
        raise ResidualError(f"{location}: is no path of this machine; nothing is opened there")
    return location


def _recorded_location(paths: Sequence[Mapping[str, str]], model_path: str) -> str:
    """Return where the model of a row lay: the real path of the PATH it was found under, and what is below that."""
    for path in paths:
        given, real = path["given"], path["real"]
        if model_path == given:
            return real
        if model_path.startswith(given.rstrip("/") + "/"):
            return f"{real.rstrip('/')}/{model_path[len(given.rstrip('/')) + 1 :]}"
    return model_path


def tau_px(config: Mapping[str, Any], sigma_px: float | None) -> float | None:
    """Return the effect that matters, px, under the settings in a run.json; None where it is not known."""
    effect = config.get("min_effect")
    return None if effect is None else effect_px(effect, sigma_px)
