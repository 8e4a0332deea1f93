"""What can be set, and what is it when nobody sets it? One frozen record; unknown names are refused."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

NoiseName = Literal["track", "constant", "keypoint"]
PointsName = Literal["in-sample", "independent"]
PolicyName = Literal["full", "camera", "paper"]


class AuditConfig(BaseModel):
    """Everything that changes a number in the tables (method.md's symbols in the descriptions)."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    noise: NoiseName = Field(
        default="track",
        description="noise model behind z: track (predicted from the rest of the track), constant (one per image), "
        "keypoint (track, and the size of keypoints in database.db)",
    )
    points: PointsName = Field(
        default="in-sample",
        description="whether the 3D points were triangulated from these images (in-sample) or measured otherwise "
        "(independent: nothing to undo, nobody to blame; takes noise = constant)",
    )
    policy: PolicyName = Field(
        default="full",
        description="which verdicts decide: paper = verdict_ks; camera = misfit, pose, plausible; full = all four",
    )
    min_effect: str = Field(
        default="0.2px",
        pattern=r"^(\d+(\.\d*)?|\.\d+)(px|sigma)$",
        description="tau: a significant misfit below it does not reject; in px, or in sigma of the image (0.5sigma)",
    )
    alpha: float = Field(
        default=0.05,
        gt=0,
        lt=1,
        description="level of the tests: an image is rejected when its p-value is below",
    )
    min_ks_distance: float = Field(
        default=0.0,
        ge=0,
        lt=1,
        description="verdict_ks rejects only where D is larger too; 0 is the paper's decision, which with thousands of "
        "observations an image rejects noise that is hardly different (0.03 asks for a visible difference)",
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
    min_focal_over_size: float = Field(
        default=0.3, gt=0, description="f / max(width, height) below which a camera is implausible"
    )
    max_focal_over_size: float = Field(
        default=10.0, gt=0, description="f / max(width, height) above which a camera is implausible"
    )
    max_sd_focal_rel: float = Field(
        default=0.01, gt=0, description="sd of f / f above which the focal length is not identified"
    )
    min_k1_sds: float = Field(default=2.0, gt=0, description="|k1| / sd below which k1 is not identified (a remark)")
    min_coverage: float = Field(
        default=0.2, ge=0, description="share of the image under the inliers' hull below which nothing is said"
    )
    min_occupied_cells: int = Field(
        default=16, ge=0, description="occupied cells (of grid x grid) below which nothing is said"
    )
    grid: int = Field(
        default=8,
        ge=1,
        description="occupied_cells counts cells of a grid x grid division of the image",
    )

    @model_validator(mode="after")
    def _independent_points_have_no_tracks(self) -> Self:
        if self.points == "independent" and self.noise != "constant":
            raise ValueError(f"points = independent takes noise = constant, not {self.noise}")
        return self

    def tau_px(self, sigma_px: float) -> float:
        """Return min_effect in px for an image with noise ``sigma_px`` (sigma_constant_px)."""
        if self.min_effect.endswith("px"):
            return float(self.min_effect.removesuffix("px"))
        return float(self.min_effect.removesuffix("sigma")) * sigma_px
