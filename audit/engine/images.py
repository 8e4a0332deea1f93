"""Some images of a model, all questions, column by column: noise, tests, diagnostics, decisions, rows."""

from __future__ import annotations

from functools import partial
from typing import Protocol

from sfm_audit.audit.config import AuditConfig
from sfm_audit.audit.decision.decide import decide_all
from sfm_audit.audit.engine.camera import images_advice
from sfm_audit.audit.engine.error_summary import error_summary
from sfm_audit.audit.engine.image_table import KnownImages, image_columns
from sfm_audit.audit.engine.known import ModelFacts, measured_of
from sfm_audit.audit.engine.noise_columns import noise_columns
from sfm_audit.audit.engine.tables import ImagesPart
from sfm_audit.audit.misfit import MisfitTests
from sfm_audit.audit.noise.stack import ConstantFits
from sfm_audit.audit.noise.standardise import ImageNoise, ModelTracks
from sfm_audit.audit.table import ModelLabels
from sfm_audit.loaders.model import CameraRecord


class Auditing(ModelFacts, Protocol):
    """What the images of one model share and how each is looked at, see `audit.engine.model.ModelAuditor`."""

    config: AuditConfig

    @property
    def tracks(self) -> ModelTracks: ...  # noqa: D102

    @property
    def constant_fits(self) -> ConstantFits: ...  # noqa: D102

    def noise(self, image_idx: int, constant: ImageNoise) -> ImageNoise: ...  # noqa: D102

    def retest(self, image_idx: int, camera: CameraRecord) -> MisfitTests: ...  # noqa: D102


def audit_images(auditor: Auditing, image_idxs: range, labels: ModelLabels) -> list[ImagesPart]:
    """Return the part of the images table about some images, and what was decided; one part for all of them."""
    config, tracks = auditor.config, auditor.tracks
    chosen = tracks if config.noise == "track" else None
    tested = noise_columns(auditor.residuals, chosen, image_idxs, auditor.constant_fits, auditor.noise)
    errors = error_summary(auditor.residuals, image_idxs)
    measured = measured_of(auditor, image_idxs, tested.measured, errors.longest_px)
    decisions = decide_all(measured, config)
    qualities = auditor.quality[image_idxs.start : image_idxs.stop]
    advice = images_advice(qualities, decisions, partial(_retest, auditor, image_idxs), alpha=config.alpha)
    known = KnownImages(auditor, image_idxs, errors, tested, measured, decisions, advice)
    first, last = auditor.residuals.offsets[[image_idxs.start, image_idxs.stop]].tolist()
    columns = image_columns(known, labels, config.noise, tracks.statistics.others.lengths(slice(first, last)))
    return [ImagesPart.of(columns, known, config.column_groups)]


def _retest(auditor: Auditing, image_idxs: range, row: int, camera: CameraRecord) -> MisfitTests:
    return auditor.retest(image_idxs[row], camera)
