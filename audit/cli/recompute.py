"""The residuals of an image that a run does not hold, from the model as it lies where the run read it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from pydantic import ValidationError
from threadpoolctl import threadpool_limits

from sfm_audit.audit.config import AuditConfig
from sfm_audit.audit.engine.model import ModelAuditor
from sfm_audit.audit.table.thresholds import effect_px
from sfm_audit.loaders import LoadError, SparseModel, open_model
from sfm_audit.loaders.datasets.input_state import read_input_state
from sfm_audit.loaders.formats import keypoint_scales_of
from sfm_audit.reports.figures import ResidualError, Residuals
from sfm_audit.reports.figures.residuals import principal_point, residuals_of_row
from sfm_audit.reports.run_folder.reader import RunReader


class ResidualSource:
    """Finds the residuals of the images of a run: in the run itself, else in its models, one in memory at a time."""

    def __init__(self, run: RunReader) -> None:
        self._run = run
        self._held = (run.folder / "observations").is_dir()
        self._last: tuple[str, ModelAuditor | ResidualError] | None = None

    def residuals(self, row: Mapping[str, Any]) -> Residuals:
        """Return the residuals of the image in a row of ``RUN/images`` that knows its ``part``.

        Raises
        ------
        ResidualError
            Neither the run nor the model has them; one line says why.
        """
        if self._held and (self._run.folder / "observations" / row["part"]).exists():
            return residuals_of_row(self._run.folder, row["part"], row)
        auditor = self._auditor(row["model_path"])
        found = np.flatnonzero(auditor.model.images.image_id == row["image_id"])
        if not len(found):
            raise ResidualError(f"{row['model_path']}: holds no image of id {row['image_id']} any more")
        return image_residuals_of(auditor, int(found[0]), row)

    def _auditor(self, model_path: str) -> ModelAuditor:
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
        location = _location(self._run, model_path)
        known = {item["model_path"]: item["sha256"] for item in self._run.info.get("inputs", [])}
        advice = "run again with --observations to keep the residuals with the run"
        try:
            if model_path in known and read_input_state(location).digest != known[model_path]:
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


def image_residuals_of(auditor: ModelAuditor, image_idx: int, row: Mapping[str, Any]) -> Residuals:
    """Return what the figures need of the image in row ``image_idx`` of the model; ``row``: of ``RUN/images``."""
    with threadpool_limits(limits=1, user_api="blas"):
        _, z = auditor.standardised(image_idx)
        inliers = auditor.inliers(image_idx)
        residuals_px = auditor.residuals.residuals_px[:, auditor.residuals.rows(image_idx)].T
    return Residuals.build(
        inliers.xy_px,
        residuals_px,
        z=z,
        size_px=(row["width"], row["height"]) if row["width"] else None,
        centre_px=principal_point(row),
        sigma_px=row["sigma_constant_px"],
    )


def _location(run: RunReader, model_path: str) -> str:
    """Return where the model of a row lies: the real path of the PATH it was found under, and what is below that."""
    for path in run.info.get("paths", []):
        given = str(path["given"])
        if model_path == given:
            return str(path["real"])
        if model_path.startswith(given.rstrip("/") + "/"):
            return f"{str(path['real']).rstrip('/')}/{model_path[len(given.rstrip('/')) + 1 :]}"
    return model_path


def tau_px(config: Mapping[str, Any], sigma_px: float | None) -> float | None:
    """Return the effect that matters, px, under the settings in a run.json; None where it is not known."""
    effect = config.get("min_effect")
    return None if effect is None else effect_px(effect, sigma_px)
