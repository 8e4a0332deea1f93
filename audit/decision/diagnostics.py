"""What is measured of one image before anything is decided: numbers, no verdicts.

Every number is a column of the images table, or follows from some: a finished run can be decided again under other
settings (`audit.decision.from_table`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from sfm_audit.audit.misfit import MisfitTests, bic
from sfm_audit.audit.table.witnesses import WitnessStatement
from sfm_audit.audit.table.words import GROUPS, MisfitGroup, MisfitStatus, Reason
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
class Worth:
    """Changes of an image if a misfit were admitted: degrees, share of the median depth, share of f; NaN unknown."""

    rotation_deg: float
    centre_rel: float
    focal_rel: float


@dataclass(frozen=True, slots=True)
class GroupDiagnostics:
    """One misfit group of one image or camera.

    q: adjusted over groups, and over images or cameras; NaN unless tested.    px: RMS of the explained field.
    gain: BIC gain, by how much the group pays for its parameters; -inf unless tested.
    worth: what admitting the group would do to the image; None where it is not known.
    """

    q: float
    px: float
    gain: float
    status: MisfitStatus
    rank: int | None = None
    worth: Worth | None = None


def misfit_groups(
    tests: MisfitTests, q: FloatArray, *, num_observations: int, sigma_px: float
) -> dict[MisfitGroup, GroupDiagnostics]:
    """Return the diagnostics of all groups; q is (6,) in the order of GROUPS, NaN where not tested."""
    return {
        group: GroupDiagnostics(
            float(value),
            tests[group].px,
            bic(tests[group], num_observations, sigma_px),
            tests[group].status,
            tests[group].rank,
        )
        for group, value in zip(GROUPS, q, strict=True)
    }


@dataclass(frozen=True, slots=True)
class SharedMisfit:
    """A camera whose images together show a material misfit: the group and its effect, and the same in words."""

    group: MisfitGroup
    px: float
    text: str

    @classmethod
    def of(cls, camera_id: int, num_images: int, group: MisfitGroup, px: float, q: float) -> SharedMisfit:
        """Put camera, images, group, effect and q into words."""
        return cls(group, px, f"camera {camera_id}, {num_images} images: {group} {px:.2f} px, q = {q:.2g}")


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


@dataclass(frozen=True, slots=True)
class CameraDiagnostics:
    """Measures of the camera, and what the image says about it (method.md section 6).

    focal_over_size: f / max(width, height).    principal_point_px: None where the camera has none (panoramas).
    size_px: width and height.
    sd_focal_rel, sd_k1: standard deviations, NaN where unknown.    singular_share: smallest / largest singular value of
    the parameters' columns, NaN where derivatives are not finite.    is_singular: some combination has no effect.
    is_joint: whether the deviations are those of the joint system, or conditional on the points.
    """

    focal_over_size: float
    folds_over: bool
    principal_point_px: tuple[float, float] | None
    size_px: tuple[int, int]
    coverage: float
    occupied_cells: int
    has_focal: bool
    sd_focal_rel: float
    singular_share: float
    is_singular: bool
    k1: float | None
    sd_k1: float
    is_joint: bool = False


@dataclass(frozen=True, slots=True)
class ConsistencyDiagnostics:
    """Do camera, pose, points and 2D points belong together? (method.md section 12).

    inconsistent: None where too little is known.    text: what was found, and the cause.    rms_px: after the own
    pose's step.    all_behind: all observations of the model lie behind their cameras.
    """

    inconsistent: bool | None
    text: str
    rms_px: float
    all_behind: bool = False


@dataclass(frozen=True, slots=True)
class OwnStep:
    """One own parameter: stored value, the value that the joint step implies, the step and its sd.

    step: the smaller of the weighted and the unweighted one where they agree in sign, else 0.
    """

    name: str
    stored: float
    implied: float
    step: float
    sd: float


@dataclass(frozen=True, slots=True)
class OwnDiagnostics:
    """The camera's own parameters in the joint system (method.md section 11).

    step_px: what freeing them alone would gain, the smaller of weighted and unweighted.    sigma_px: of its images.
    num_images: that share the camera.
    """

    step_px: float
    sigma_px: float
    num_images: int
    steps: tuple[OwnStep, ...]

    @property
    def largest(self) -> OwnStep | None:
        """The parameter whose step is most of its standard deviations; None without any that is known."""
        known = [step for step in self.steps if step.sd > 0]
        return max(known, key=lambda step: abs(step.step) / step.sd, default=None)


@dataclass(frozen=True, slots=True)
class Gains:
    """What freeing the pose alone, the camera alone, or both would gain; NaN where unknown."""

    pose: float
    camera: float
    both: float


@dataclass(frozen=True, slots=True)
class Diagnostics:
    """All that is decided upon, of one image or of one estimated camera.

    unusable: what makes it impossible to project any point.    num_inliers: observations behind all that follows.
    largest_residual_px: length of the longest one, against longer_side_px: what is only rounded was not measured.
    misfit, camera: None without inliers.    remarks: reasons that decide nothing, found elsewhere.
    consistency, own, gains: None where nobody asked; has_own: whether the camera has own parameters to ask for.
    half_pixel: its 2D points, and those of most images, are shifted by half a pixel (finding pixel_convention).
    testimonies: what witnesses outside of the image say of it; None where no witness was asked.
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
    consistency: ConsistencyDiagnostics | None = None
    own: OwnDiagnostics | None = None
    has_own: bool = False
    gains: Gains | None = None
    half_pixel: bool = False
    testimonies: tuple[WitnessStatement, ...] | None = None
