"""What is measured of one image before anything is decided: numbers, no verdicts.

Every number is a column of the images table, or follows from some: a finished run can be decided again under other
settings (`audit.decision.from_table`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from sfm_audit.audit.misfit import MisfitTests, bic
from sfm_audit.audit.table.words import GROUPS, LENS_GROUPS, MisfitGroup, MisfitStatus, Reason
from sfm_audit.loaders.arrays import FloatArray


@dataclass(frozen=True, slots=True)
class NoiseDiagnostics:
    """Goodness of fit of the standardised residuals (method.md section 4).

    num_standardised: observations with a z; ``what`` they are called where they are too few.
    num_values: values of z that were tested.    is_fitted: whether the noise model could be fitted.
    """

    num_standardised: int
    num_values: int
    ks_stat: float
    ks_p: float
    is_fitted: bool


@dataclass(frozen=True, slots=True)
class GroupDiagnostics:
    """One misfit group of one image or camera.

    q: adjusted over groups, and over images or cameras; NaN unless tested.    px: RMS of the explained field.
    gain: BIC gain, by how much the group pays for its parameters; -inf unless tested.
    """

    q: float
    px: float
    gain: float
    status: MisfitStatus


def misfit_groups(
    tests: MisfitTests, q: FloatArray, *, num_observations: int, sigma_px: float
) -> dict[MisfitGroup, GroupDiagnostics]:
    """Return the diagnostics of all groups; q is (6,) in the order of GROUPS, NaN where not tested."""
    return {
        group: GroupDiagnostics(
            float(value), tests[group].px, bic(tests[group], num_observations, sigma_px), tests[group].status
        )
        for group, value in zip(GROUPS, q, strict=True)
    }


@dataclass(frozen=True, slots=True)
class SharedMisfit:
    """A camera whose images together show a material misfit: its id, its images, the group with effect and q."""

    camera_id: int
    num_images: int
    group: MisfitGroup
    px: float
    q: float


@dataclass(frozen=True, slots=True)
class MisfitDiagnostics:
    """The tests on which the verdict rests.

    num_tested: inliers that they used.    sigma_px: the image's noise, for a tau in sigma.
    shared: what its camera's images say together; only where most images of the model are wrong.
    """

    groups: Mapping[MisfitGroup, GroupDiagnostics]
    num_tested: int
    sigma_px: float
    shared: SharedMisfit | None = None

    @property
    def num_lens_groups(self) -> int:
        """How many groups of the lens could be tested."""
        return sum(self.groups[group].status is MisfitStatus.TESTED for group in LENS_GROUPS)


@dataclass(frozen=True, slots=True)
class CameraDiagnostics:
    """Measures of the camera, and what the image says about it (method.md section 6).

    focal_over_size: f / max(width, height).    principal_point_px: None where the camera has none (panoramas).
    sd_focal_rel, sd_k1: standard deviations, NaN where unknown.    singular_share: smallest / largest singular value of
    the parameters' columns, NaN where derivatives are not finite.    is_singular: some combination has no effect.
    """

    focal_over_size: float
    folds_over: bool
    principal_point_px: tuple[float, float] | None
    principal_point_outside: bool
    size_px: tuple[int, int]
    coverage: float
    occupied_cells: int
    has_focal: bool
    sd_focal_rel: float
    singular_share: float
    is_singular: bool
    k1: float | None
    sd_k1: float


@dataclass(frozen=True, slots=True)
class Diagnostics:
    """All that is decided upon, of one image or of one estimated camera.

    unusable: what makes it impossible to project any point.    num_inliers: observations behind all that follows.
    largest_residual_px, longer_side_px: 2D points whose residuals are rounding were not measured.
    misfit, camera: None without inliers.    remarks: reasons that decide nothing, found elsewhere.
    """

    num_inliers: int
    noise: NoiseDiagnostics
    pose_offset_px: float
    misfit: MisfitDiagnostics | None = None
    camera: CameraDiagnostics | None = None
    largest_residual_px: float = math.nan
    longer_side_px: int = 0
    unusable: Reason | None = None
    remarks: tuple[Reason, ...] = field(default=())
