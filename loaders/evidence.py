"""What can be given besides a model: verified matches, poses of a reference, position priors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.loaders.model import PairSource


@dataclass(frozen=True, slots=True, eq=False)
class ReferencePoses:
    """Where a reference has the images of a model; NaN for images that it does not know.

    location: of the reference.    rotation: (I, 3, 3) camera from the reference's world.
    centre: (I, 3) its world, its unit.    is_metric: whether that is the metre.
    """

    location: str
    rotation: FloatArray
    centre: FloatArray
    is_metric: bool


@dataclass(frozen=True, slots=True, eq=False)
class PositionPriors:
    """Where a sensor says the cameras of a model were; NaN for images without a prior.

    location: where they stand.    position: (I, 3) Cartesian.    is_metric: whether the unit is the metre.
    covariance: (I, 3, 3) in that unit squared, NaN where it is not known.
    """

    location: str
    position: FloatArray
    covariance: FloatArray
    is_metric: bool


@dataclass(frozen=True, slots=True)
class NotAsked:
    """Evidence that was named and has nothing on a model; ``reason``: why, in one line."""

    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class Given:
    """Evidence besides a model; None for what was not named."""

    pairs: PairSource | None = None
    reference: ReferencePoses | NotAsked | None = None
    priors: PositionPriors | NotAsked | None = None


NOTHING_GIVEN: Final = Given()
