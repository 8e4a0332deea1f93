"""Diagnostics of a sound image, and the same with one thing changed, for tests of the decision."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

from sfm_audit.audit.decision.diagnostics import (
    CameraDiagnostics,
    ConsistencyDiagnostics,
    Diagnostics,
    Gains,
    GroupDiagnostics,
    MisfitDiagnostics,
    NoiseDiagnostics,
    OwnDiagnostics,
    OwnStep,
    SharedMisfit,
    Worth,
)
from sfm_audit.audit.table.words import GROUPS, MisfitGroup, MisfitStatus

NAN = math.nan


def group(q=0.5, px=0.01, gain=0.0, status=MisfitStatus.TESTED, worth=None) -> GroupDiagnostics:
    return GroupDiagnostics(q, px, gain, status, None, worth)


def misfit(*, num_tested=300, sigma_px=0.5, shared: SharedMisfit | None = None, **groups) -> MisfitDiagnostics:
    return MisfitDiagnostics({g: groups.get(g, group()) for g in GROUPS}, num_tested, sigma_px, shared)


CAMERA = CameraDiagnostics(
    focal_over_size=0.8,
    folds_over=False,
    principal_point_px=(800.0, 600.0),
    size_px=(1600, 1200),
    coverage=0.5,
    occupied_cells=40,
    has_focal=True,
    sd_focal_rel=0.001,
    singular_share=0.1,
    is_singular=False,
    k1=0.05,
    sd_k1=0.001,
    is_joint=True,
)
NOISE = NoiseDiagnostics(num_standardised=290, num_values=580, ks_stat=0.02, ks_p=0.5, is_fitted=True)
FITS = ConsistencyDiagnostics(inconsistent=False, text="", rms_px=1.0)
FOCAL = OwnStep("f", stored=1000.0, implied=1000.1, step=0.1, sd=0.5)
RADIAL = OwnStep("k", stored=0.05, implied=0.0501, step=0.0001, sd=0.001)
OWN = OwnDiagnostics(step_px=0.01, sigma_px=0.5, num_images=1, steps=(FOCAL, RADIAL))
SOUND = Diagnostics(
    num_inliers=300,
    noise=NOISE,
    pose_offset_px=0.01,
    misfit=misfit(),
    camera=CAMERA,
    largest_residual_px=2.0,
    longer_side_px=1600,
    consistency=FITS,
    own=OWN,
    has_own=True,
    gains=Gains(pose=1.0, camera=1.0, both=5.0),
)
EXACT_PX = 1600 * 2.0**-16

MATERIAL = group(q=0.01, px=0.3, gain=10.0)
NOT_TESTED = group(q=NAN, px=NAN, gain=-math.inf, status=MisfitStatus.NOT_ENOUGH_EVIDENCE)
ABSORBED = group(q=NAN, px=NAN, gain=-math.inf, status=MisfitStatus.ABSORBED)
EXCLUDED = group(q=NAN, px=NAN, gain=-math.inf, status=MisfitStatus.EXCLUDED)
LENS = (MisfitGroup.RADIAL, MisfitGroup.TANGENTIAL, MisfitGroup.AFFINE, MisfitGroup.PRINCIPAL_POINT)


def sound(**changes: Any) -> Diagnostics:
    return replace(SOUND, **changes)


def noise(num_inliers=300, **changes) -> Diagnostics:
    return sound(num_inliers=num_inliers, noise=replace(NOISE, **changes))


def with_misfit(**changes) -> Diagnostics:
    return sound(misfit=misfit(**changes))


def camera(**changes) -> Diagnostics:
    return sound(camera=replace(CAMERA, **changes))


def own(step_px=0.3, sds=6.0, **changes) -> Diagnostics:
    """A focal length that moves by so many standard deviations, and gains so many px."""
    return sound(own=replace(OWN, step_px=step_px, steps=(moved(sds), RADIAL), **changes))


def moved(sds: float, name: str = "f") -> OwnStep:
    return OwnStep(name, stored=1000.0, implied=1000.0 + 2.0 * sds, step=2.0 * sds, sd=2.0)


def parts(**changes) -> Diagnostics:
    return sound(consistency=replace(FITS, **changes))


def worth(deg=0.1, focal=0.005, centre=0.01) -> Worth:
    return Worth(deg, centre, focal)


def worth_misfit(name="radial", **changes) -> Diagnostics:
    return with_misfit(**{name: replace(MATERIAL, worth=worth(**changes))})
