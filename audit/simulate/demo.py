"""The photo collection of ``sfm-audit demo``: forty images, seven planted defects, noise that belongs to the tracks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from sfm_audit.audit.simulate.defects import DefectKind, DefectSpec
from sfm_audit.audit.simulate.noise import NoiseKind, NoiseSpec
from sfm_audit.audit.simulate.scene import SceneSpec, SimulatedScene

_NUM_IMAGES: Final = 40
_POINTS_PER_IMAGE: Final = 350
_RADIAL_PX: Final = (0.3, 0.6, 1.0)
_POSE_PX: Final = (1.5, 3.0)
_CORNERS: Final = ((22.0, 0.0), (18.0, 3.0))
_NOISE: Final = NoiseSpec(NoiseKind.PER_TRACK_LOGNORMAL, sigma_px=0.5, log_spread=0.7)


@dataclass(frozen=True, slots=True)
class TruthRecord:
    """What is wrong with one image, in types that JSON has. size_px: systematic RMS, None for too few points."""

    image_name: str
    defect: str
    size_px: float | None
    words: str


def demo_scene(seed: int) -> SceneSpec:
    """Return the demo's spec: which images are defective, and in which order, depends on the seed."""
    rng = np.random.default_rng([seed, 0])
    images = rng.choice(_NUM_IMAGES, size=len(_RADIAL_PX) + len(_POSE_PX) + len(_CORNERS), replace=False).tolist()
    defects = (
        *((DefectKind.RADIAL_K2, size, None) for size in _RADIAL_PX),
        *((DefectKind.PERTURBED_POSE, size, None) for size in _POSE_PX),
        *((DefectKind.FEW_POINTS, 1.0, values) for values in _CORNERS),
    )
    return SceneSpec(
        num_images=_NUM_IMAGES,
        points_per_image=_POINTS_PER_IMAGE,
        noise=_NOISE,
        defects=tuple(DefectSpec(i, *defect) for i, defect in zip(images, defects, strict=True)),
    )


def truth_records(scene: SimulatedScene) -> list[TruthRecord]:
    """Return the planted defects of a scene, by image; ``dataclasses.asdict`` of each goes into truth.json."""
    return [TruthRecord(d.image_name, d.kind.value, d.systematic_px, d.words) for d in scene.defects]
