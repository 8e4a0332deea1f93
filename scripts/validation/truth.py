"""What is planted in the study, and which answers count as right."""

from __future__ import annotations

from typing import Final

from sfm_audit.audit.misfit import MisfitGroup
from sfm_audit.audit.simulate.defects import DefectKind
from sfm_audit.audit.simulate.noise import NoiseKind, NoiseSpec

SIGMA_PX: Final = 0.5
ALPHA: Final = 0.05
TAU_PX: Final = 0.2
SCENE_FOCAL_PX: Final = 1000.0  # of the median camera of a scene
CAMERA_DEFECTS: Final = (
    DefectKind.RADIAL_K2,
    DefectKind.RADIAL_K3,
    DefectKind.TANGENTIAL,
    DefectKind.ASPECT,
    DefectKind.PRINCIPAL_POINT,
    DefectKind.ROLLING_SHUTTER,
)
_DECENTRED: Final = frozenset({MisfitGroup.TANGENTIAL, MisfitGroup.PRINCIPAL_POINT})
ANSWERS: Final[dict[DefectKind, frozenset[MisfitGroup]]] = {
    DefectKind.RADIAL_K2: frozenset({MisfitGroup.RADIAL}),
    DefectKind.RADIAL_K3: frozenset({MisfitGroup.RADIAL}),
    DefectKind.TANGENTIAL: _DECENTRED,
    DefectKind.ASPECT: frozenset({MisfitGroup.AFFINE}),
    DefectKind.PRINCIPAL_POINT: _DECENTRED,
    DefectKind.ROLLING_SHUTTER: frozenset({MisfitGroup.ROLLING_SHUTTER, MisfitGroup.AFFINE}),
}
"""Tangential and principal point are nearly the same field; affine may answer rolling shutter, not the reverse."""

SOUND: Final = "none"
NOISES: Final = tuple(NoiseKind)
SIZES: Final = (25, 50, 100, 250, 600, 2000, 5000)


def noise_of(kind: NoiseKind, sigma_px: float = SIGMA_PX) -> NoiseSpec:
    """The noise of the study; lognormal spreads 0.5."""
    return NoiseSpec(kind, sigma_px)


def is_right(kind: str, answer: object) -> bool:
    """Whether ``answer`` names the planted cause."""
    return kind != SOUND and isinstance(answer, str) and MisfitGroup(answer) in ANSWERS[DefectKind(kind)]
