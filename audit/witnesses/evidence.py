"""What a witness may look at, and what it reports."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from sfm_audit.audit.alignment.poses import camera_centres
from sfm_audit.audit.inliers.residuals import ModelResiduals
from sfm_audit.audit.table.witnesses import Witness, WitnessStatement
from sfm_audit.audit.witnesses.covisibility import Covisibility, SeenBy, covisibility
from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.loaders.evidence import Given, NotAsked, PositionPriors, ReferencePoses
from sfm_audit.loaders.model import Finding, PairSource, SparseModel

ColumnValues: TypeAlias = npt.NDArray[Any] | tuple[object, ...]
"""(I,) values of a column of the images table, by row of the images; NaN or None where there is none."""


@dataclass(frozen=True, eq=False)
class Evidence:
    """What witnesses may look at.

    model, residuals: as they stand.    sigma_px: (I,) robust noise per axis of each image, NaN where unknown.
    pairs: verified matches of a database; None where none was given, and so reference and priors.
    """

    model: SparseModel
    residuals: ModelResiduals
    sigma_px: FloatArray
    pairs: PairSource | None = None
    reference: ReferencePoses | NotAsked | None = None
    priors: PositionPriors | NotAsked | None = None

    @classmethod
    def of(cls, model: SparseModel, residuals: ModelResiduals, sigma_px: FloatArray, given: Given) -> Evidence:
        """Put what was measured and what was given together."""
        return cls(model, residuals, sigma_px, given.pairs, given.reference, given.priors)

    @cached_property
    def turned(self) -> tuple[SeenBy, Covisibility]:
        """Which images see each point, and which images share how many points."""
        return covisibility(self.residuals, len(self.model.points))

    @property
    def seen(self) -> Covisibility:
        """Which images share how many points."""
        return self.turned[1]

    @cached_property
    def median_depth(self) -> float:
        """Median over the images of the median distance of their inliers from them, model units; NaN without any."""
        images, points = self.model.images, self.model.points.xyz_world
        centre = camera_centres(images.quat_cam_from_world_wxyz, images.translation_cam_from_world)
        with np.errstate(all="ignore"):
            medians = [
                np.median(np.linalg.norm(points[self.residuals.point_idx[rows]] - centre[i], axis=1))
                for i in range(len(images))
                if (rows := self.residuals.rows(i)).stop > rows.start
            ]
        known = np.array(medians)[np.isfinite(medians)] if medians else np.empty(0)
        return float(np.median(known)) if len(known) else math.nan


@dataclass(frozen=True, slots=True, eq=False)
class WitnessReport:
    """What one witness says of a model.

    witness: None for measures that speak in columns and findings only, and not in verdict_outside.
    testimonies: (I,) of each image, None where it has nothing to say; empty where ``witness`` is None.
    columns: of the images table, (I,) each.    findings: of the model.
    """

    witness: Witness | None
    testimonies: tuple[WitnessStatement | None, ...] = ()
    columns: Mapping[str, ColumnValues] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()
