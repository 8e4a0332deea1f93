"""One model in, its tables out: the order in which the questions are asked (METHOD.md, in the order data meets it)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pyarrow as pa
from threadpoolctl import threadpool_limits

from audit.config import AuditConfig
from audit.image_audit import ImageAudit, judged
from audit.multiplicity import benjamini_hochberg
from audit.residuals import ModelResiduals, model_residuals
from audit.rows import Row, image_row, model_row
from audit.standardise import ModelTracks, constant_noise, model_tracks, track_noise
from audit.stored_errors import StoredErrors, compare_stored_errors, stale_finding
from audit.table import ModelLabels, build_table, empty_table, schema
from audit.verdict import ReasonCode
from loaders.model import Finding, FindingCode, InlierSet, SparseModel

_REMOVABLE_SHARE = 0.05  # of the squared residuals: above it the 3D points are not at their optimum


@dataclass(frozen=True, slots=True, eq=False)
class ModelAudit:
    """The tables of one model, as written to a run folder: ``images`` has a row per image, ``models`` one row."""

    images: pa.Table
    models: pa.Table


class ModelAuditor:
    """What the images of one model share, computed once and in file order, and each image's audit on top of it.

    Parameters
    ----------
    model : from `loaders.open_model`
    config : noise model and thresholds; the defaults when None
    """

    def __init__(self, model: SparseModel, config: AuditConfig | None = None) -> None:
        self.model = model
        self.config = config or AuditConfig()

    @cached_property
    def residuals(self) -> ModelResiduals:
        """All inliers of the model, projected."""
        return model_residuals(self.model)

    @cached_property
    def tracks(self) -> ModelTracks:
        """Whitened residuals, track variances and the prior of the ``track`` noise model."""
        return model_tracks(
            self.residuals,
            len(self.model.points),
            pose_offset_threshold_px=self.config.pose_offset_threshold_px,
            min_track_length=self.config.min_track_length,
            min_eigenvalue=self.config.min_track_eigenvalue,
        )

    @cached_property
    def stored_errors(self) -> StoredErrors:
        """The stored point errors beside recomputed ones."""
        return compare_stored_errors(self.model, self.residuals)

    def inliers(self, image: int | str) -> InlierSet:
        """Return the 2D-3D inliers of an image, given its row, its name or ``id:<image_id>``."""
        image_idx = self.model.image_idx(image) if isinstance(image, str) else image
        residuals, observations = self.residuals, self.model.observations
        row = residuals.observation_row[residuals.rows(image_idx)]
        point_idx = observations.point_idx[row]
        return InlierSet(
            self.model.image(image_idx),
            observations.xy_px.take(row, axis=0),
            self.model.points.xyz_world.take(point_idx, axis=0),
            point_idx,
            num_dangling=int(residuals.num_dangling[image_idx]),
            num_behind=int(residuals.num_behind[image_idx]),
            num_nonfinite=int(residuals.num_nonfinite[image_idx]),
        )

    def image(self, image: int | str) -> ImageAudit:
        """Audit one image within its model, given its row, its name or ``id:<image_id>``."""
        image_idx = self.model.image_idx(image) if isinstance(image, str) else image
        rows = self.residuals.rows(image_idx)
        residuals_px = self.residuals.residuals_px[:, rows]
        constant = constant_noise(residuals_px)
        chosen = constant
        if self.config.noise == "track":
            chosen = track_noise(self.tracks, image_idx, constant.sigma_constant_px)
        return judged(
            self.inliers(image_idx),
            residuals_px,
            float(self.residuals.pose_offset_px[image_idx]),
            constant,
            chosen,
            self.tracks.statistics.track_length[rows],
            self.config,
        )

    def tables(self, labels: ModelLabels | None = None) -> ModelAudit:
        """Audit all images and return the tables; ``labels`` fill the text columns that name the model."""
        labels = labels or ModelLabels("", "", "0", self.model.location)
        rows: list[Row] = []
        judgements = []
        num_exact = 0
        for image_idx in range(len(self.model.images)):
            audit = self.image(image_idx)
            rows.append(image_row(audit, labels, self.config.noise, self.config.grid))
            judgements.append((audit.judgement, audit.ks))
            num_exact += any(reason.code == ReasonCode.EXACT_PROJECTIONS for reason in audit.judgement.reasons)
        findings = [*self.model.findings, *self._own_findings(num_exact)]
        row = model_row(self.model, labels, self.tracks, self.stored_errors, findings, judgements)
        return ModelAudit(_images_table(rows), build_table({k: [v] for k, v in row.items()}, schema("models")))

    def _own_findings(self, num_exact: int) -> list[Finding]:
        """Findings that need residuals."""
        statistics = self.tracks.statistics
        found = [stale_finding(self.stored_errors)]
        if num_exact:
            text = f"the 2D points of {num_exact} images are projections of the 3D points, not measurements"
            found.append(Finding(FindingCode.EXACT_PROJECTIONS, num_exact, text))
        elif statistics.removable_sq_px2 > _REMOVABLE_SHARE * statistics.total_sq_px2:
            share = statistics.removable_sq_px2 / statistics.total_sq_px2
            text = f"3D points are not at their optimum: moving them alone removes {share:.1%} of the squared residuals"
            found.append(Finding(FindingCode.POINTS_NOT_OPTIMAL, len(self.model.points), text))
        if self.tracks.too_many_nonstationary:
            count = int(np.count_nonzero(self.tracks.nonstationary))
            text = (
                f"{count} images are not at the optimum of their poses, too many to leave out of the track statistics"
            )
            found.append(Finding(FindingCode.TRACK_STATISTICS_FROM_ALL_IMAGES, count, text))
        return [finding for finding in found if finding is not None]


def audit_model(model: SparseModel, config: AuditConfig | None = None, labels: ModelLabels | None = None) -> ModelAudit:
    """Audit all images of a model.

    Parameters
    ----------
    model : from `loaders.open_model`
    config : noise model and thresholds; the defaults when None
    labels : the text columns that name the model in a dataset

    Returns
    -------
    ModelAudit
        Arrow tables; ``.images.to_pandas()`` for a data frame. Columns, units, meanings: docs/tables.md.
    """
    # Matrices are small here: a second BLAS thread only waits for the first, and on a busy machine that costs 10 x.
    with threadpool_limits(limits=1, user_api="blas"):
        return ModelAuditor(model, config).tables(labels)


def _images_table(rows: Sequence[Row]) -> pa.Table:
    if not rows:
        return empty_table("images")
    columns = {name: [row[name] for row in rows] for name in rows[0]}
    columns["ks_q"] = list(benjamini_hochberg(np.array(columns["ks_p"], dtype=np.float64)))
    return build_table(columns, schema("images"))
