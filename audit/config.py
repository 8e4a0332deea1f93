"""What can be set, and what is it when nobody sets it? One frozen record; unknown names are refused."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

NoiseName = Literal["track", "constant"]
PolicyName = Literal["paper"]


class AuditConfig(BaseModel):
    """Everything that changes a number in the tables (METHOD.md's symbols in the descriptions)."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    noise: NoiseName = Field(
        default="track",
        description="noise model behind z: track (predicted from the rest of the track), constant (one per image)",
    )
    policy: PolicyName = Field(
        default="paper",
        description="which verdicts decide: paper = verdict_ks",
    )
    alpha: float = Field(
        default=0.05,
        gt=0,
        lt=1,
        description="level of the tests: an image is rejected when its p-value is below",
    )
    min_observations: int = Field(
        default=20,
        ge=2,
        description="a verdict needs that many standardised observations, or it is undetermined",
    )
    min_track_length: int = Field(
        default=3,
        ge=3,
        description="observations of tracks with fewer audited observations cannot be verified",
    )
    min_track_eigenvalue: float = Field(
        default=0.05,
        gt=0,
        lt=1,
        description="smaller eigenvalue of I - H below which an observation cannot be verified",
    )
    pose_offset_threshold_px: float = Field(
        default=0.5,
        gt=0,
        description="px; images with a larger pose_offset_px are left out of the statistics of tracks",
    )
    grid: int = Field(
        default=8,
        ge=1,
        description="occupied_cells counts cells of a grid x grid division of the image",
    )
