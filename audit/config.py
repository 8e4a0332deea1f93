"""What can be set, and what is it when nobody sets it? One frozen record; unknown names are refused."""

from __future__ import annotations

import math
from typing import Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from sfm_audit.audit.table import ColumnGroup, thresholds
from sfm_audit.audit.table.words import PolicyName

NoiseName = Literal["track", "constant", "keypoint"]
PointsName = Literal["in-sample", "independent"]


class AuditConfig(BaseModel):
    """Everything that changes a number in the tables (method.md's symbols in the descriptions)."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    noise: NoiseName = Field(
        default="track",
        description="noise model behind z: track (predicted from the rest of the track), constant (one per image), "
        "keypoint (track, and the size of keypoints in database.db)",
    )
    points: PointsName = Field(
        default="in-sample",
        description="whether the 3D points were triangulated from these images (in-sample) or measured otherwise "
        "(independent: nothing to undo; takes noise = constant)",
    )
    database: str | None = Field(
        default=None,
        min_length=1,
        max_length=4096,
        description="the database.db whose verified pairs are asked (docs/witnesses.md); auto: the one beside each "
        "model or up to three folders above it",
    )
    covariance: bool = Field(
        default=False,
        description="whether to say how well every pose is known (columns sd_rotation_deg, sd_centre and others)",
    )
    reference: str | None = Field(
        default=None,
        min_length=1,
        max_length=4096,
        description="poses that are known otherwise (docs/witnesses.md): a model, a tree of models, a trajectory, or a "
        "CSV; adds the columns reference_*",
    )
    priors: str | None = Field(
        default=None,
        min_length=1,
        max_length=4096,
        description="position priors (docs/witnesses.md): a CSV, a database.db, or auto for the one that belongs to "
        "each model; adds the columns prior_*",
    )
    policy: PolicyName = Field(
        default="standard",
        description="which verdicts decide: standard = misfit, camera, pose, plausible, noise, outside; camera = the "
        "first four; full = all; paper = verdict_ks",
    )
    min_effect: str = Field(
        default=thresholds.MIN_EFFECT,
        max_length=40,
        pattern=r"^(\d+(\.\d*)?|\.\d+)(px|sigma)$",
        description="tau: a significant misfit below it does not reject; in px, or in sigma of the image (0.5sigma)",
    )
    alpha: float = Field(default=thresholds.ALPHA.default, gt=0, lt=1, description=thresholds.ALPHA.meaning)
    min_ks_distance: float = Field(
        default=thresholds.MIN_KS_DISTANCE.default, ge=0, lt=1, description=thresholds.MIN_KS_DISTANCE.meaning
    )
    max_noise_distance: float = Field(
        default=thresholds.MAX_NOISE_DISTANCE.default, ge=0, lt=1, description=thresholds.MAX_NOISE_DISTANCE.meaning
    )
    min_observations: int = Field(
        default=int(thresholds.MIN_OBSERVATIONS.default),
        ge=2,
        le=1_000_000_000,
        description=thresholds.MIN_OBSERVATIONS.meaning,
    )
    min_track_length: int = Field(
        default=3,
        ge=3,
        le=1_000_000,
        description="observations of tracks with fewer audited observations cannot be verified",
    )
    min_track_eigenvalue: float = Field(
        default=0.05,
        gt=0,
        lt=1,
        description="smaller eigenvalue of I - H below which an observation cannot be verified",
    )
    pose_offset_threshold_px: float = Field(
        default=thresholds.MAX_POSE_OFFSET_PX.default, gt=0, le=1e6, description=thresholds.MAX_POSE_OFFSET_PX.meaning
    )
    min_focal_over_size: float = Field(
        default=thresholds.MIN_FOCAL_OVER_SIZE.default, gt=0, le=1e6, description=thresholds.MIN_FOCAL_OVER_SIZE.meaning
    )
    max_focal_over_size: float = Field(
        default=thresholds.MAX_FOCAL_OVER_SIZE.default, gt=0, le=1e6, description=thresholds.MAX_FOCAL_OVER_SIZE.meaning
    )
    max_sd_focal_rel: float = Field(
        default=thresholds.MAX_SD_FOCAL_REL.default, gt=0, le=1e6, description=thresholds.MAX_SD_FOCAL_REL.meaning
    )
    min_k1_sds: float = Field(
        default=thresholds.MIN_K1_SDS.default, gt=0, le=1e6, description=thresholds.MIN_K1_SDS.meaning
    )
    min_coverage: float = Field(
        default=thresholds.MIN_COVERAGE.default, ge=0, le=1e6, description=thresholds.MIN_COVERAGE.meaning
    )
    min_occupied_cells: int = Field(
        default=int(thresholds.MIN_OCCUPIED_CELLS.default),
        ge=0,
        le=1_000_000,
        description=thresholds.MIN_OCCUPIED_CELLS.meaning,
    )
    grid: int = Field(
        default=8,
        ge=1,
        le=256,
        description="occupied_cells counts cells of a grid x grid division of the image",
    )

    @property
    def column_groups(self) -> tuple[ColumnGroup, ...]:
        """Which columns the images table has besides those of every run."""
        given: dict[ColumnGroup, str | None] = {"reference": self.reference, "priors": self.priors}
        return tuple(group for group, what in given.items() if what is not None)

    @model_validator(mode="after")
    def _independent_points_have_no_tracks(self) -> Self:
        if self.points == "independent" and self.noise != "constant":
            raise ValueError(f"points = independent takes noise = constant, not {self.noise}")
        return self

    def tau_px(self, sigma_px: float) -> float:
        """Return min_effect in px for an image with noise ``sigma_px`` (sigma_constant_px)."""
        effect = thresholds.effect_px(self.min_effect, sigma_px)
        return math.nan if effect is None else effect
