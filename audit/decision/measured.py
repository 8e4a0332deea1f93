"""What is measured of many images before anything is decided, as columns: `Diagnostics`, one image a row.

Row i of every array is the same image. Where a `Diagnostics` has None, ``known`` is False and the numbers are NaN or 0.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from sfm_audit.audit.decision.diagnostics import (
    CameraDiagnostics,
    ConsistencyDiagnostics,
    Diagnostics,
    GroupDiagnostics,
    MisfitDiagnostics,
    OwnDiagnostics,
    SharedMisfit,
    Worth,
)
from sfm_audit.audit.table.witnesses import WitnessStatement
from sfm_audit.audit.table.words import GROUPS, MisfitGroup, MisfitStatus, Reason
from sfm_audit.loaders.arrays import BoolArray, FloatArray, IntArray

STATUSES: Final = tuple(MisfitStatus)
STATUS_CODES: Final = {status: code for code, status in enumerate(STATUSES)}
_UNKNOWN: Final = Worth(math.nan, math.nan, math.nan)
_NOBODY: Final = GroupDiagnostics(math.nan, math.nan, -math.inf, MisfitStatus.NO_COLUMNS)


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredNoise:
    """`NoiseDiagnostics` of n images, (n,) each."""

    num_standardised: IntArray
    num_values: IntArray
    ks_stat: FloatArray
    ks_p: FloatArray
    is_fitted: BoolArray


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredMisfit:
    """`MisfitDiagnostics` of n images.

    known, num_tested, sigma_px: (n,).    q, px, gain, rank: (n, 6) in the order of GROUPS; rank -1 unknown.
    status: (n, 6) places in STATUSES.    worth: (n, 6, 3) degrees, share of the depth, share of f; NaN unknown.
    shared: by row, what the image's camera shows as a whole.
    """

    known: BoolArray
    num_tested: IntArray
    sigma_px: FloatArray
    q: FloatArray
    px: FloatArray
    gain: FloatArray
    rank: IntArray
    status: IntArray
    worth: FloatArray
    shared: Mapping[int, SharedMisfit]

    @classmethod
    def of(cls, images: Sequence[MisfitDiagnostics | None]) -> MeasuredMisfit:
        """Return the columns of these records."""
        groups = [None if each is None else each.groups for each in images]
        return cls(
            np.array([each is not None for each in images], dtype=bool),
            np.array([0 if each is None else each.num_tested for each in images], dtype=np.int64),
            np.array([math.nan if each is None else each.sigma_px for each in images], dtype=np.float64),
            *_of_groups(groups),
            {i: each.shared for i, each in enumerate(images) if each is not None and each.shared is not None},
        )


def _of_groups(
    images: Sequence[Mapping[MisfitGroup, GroupDiagnostics] | None],
) -> tuple[FloatArray, FloatArray, FloatArray, IntArray, IntArray, FloatArray]:
    flat = [_NOBODY if each is None else each[group] for each in images for group in GROUPS]
    shape = len(images), len(GROUPS)
    numbers = np.array([(each.q, each.px, each.gain) for each in flat], dtype=np.float64).reshape(*shape, 3)
    ranks = [-1 if each.rank is None else each.rank for each in flat]
    worth = [each.worth or _UNKNOWN for each in flat]
    q, px, gain = (np.asarray(np.ascontiguousarray(numbers[:, :, k])) for k in range(3))
    return (
        q,
        px,
        gain,
        np.array(ranks, dtype=np.int64).reshape(shape),
        np.array([STATUS_CODES[each.status] for each in flat], dtype=np.int64).reshape(shape),
        np.array([(w.rotation_deg, w.centre_rel, w.focal_rel) for w in worth], dtype=np.float64).reshape(*shape, 3),
    )


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredCamera:
    """`CameraDiagnostics` of n images, (n,) each; principal_point_px, size_px: (n, 2), NaN where there is none."""

    known: BoolArray
    focal_over_size: FloatArray
    folds_over: BoolArray
    principal_point_px: FloatArray
    size_px: IntArray
    coverage: FloatArray
    occupied_cells: IntArray
    has_focal: BoolArray
    sd_focal_rel: FloatArray
    singular_share: FloatArray
    is_singular: BoolArray
    k1: FloatArray
    has_k1: BoolArray
    sd_k1: FloatArray
    is_joint: BoolArray

    @classmethod
    def of(cls, images: Sequence[CameraDiagnostics | None]) -> MeasuredCamera:
        """Return the columns of these records."""

        def floats(name: str) -> FloatArray:
            values = [math.nan if each is None else getattr(each, name) for each in images]
            return np.array([math.nan if value is None else value for value in values], dtype=np.float64)

        def flags(name: str) -> BoolArray:
            return np.array([each is not None and bool(getattr(each, name)) for each in images], dtype=bool)

        def pairs(name: str, nothing: tuple[float, float], dtype: type) -> Any:
            values = [nothing if each is None else getattr(each, name) or nothing for each in images]
            return np.array(values, dtype=dtype).reshape(-1, 2)

        return cls(
            known=np.array([each is not None for each in images], dtype=bool),
            focal_over_size=floats("focal_over_size"),
            folds_over=flags("folds_over"),
            principal_point_px=pairs("principal_point_px", (math.nan, math.nan), np.float64),
            size_px=pairs("size_px", (0, 0), np.int64),
            coverage=floats("coverage"),
            occupied_cells=np.array([0 if each is None else each.occupied_cells for each in images], dtype=np.int64),
            has_focal=flags("has_focal"),
            sd_focal_rel=floats("sd_focal_rel"),
            singular_share=floats("singular_share"),
            is_singular=flags("is_singular"),
            k1=floats("k1"),
            has_k1=np.array([each is not None and each.k1 is not None for each in images], dtype=bool),
            sd_k1=floats("sd_k1"),
            is_joint=flags("is_joint"),
        )

    @property
    def has_principal_point(self) -> BoolArray:
        """(n,) whether the camera has one: panoramas have none."""
        return np.asarray(~np.isnan(self.principal_point_px).any(axis=1))


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredParts:
    """`ConsistencyDiagnostics` of n images, (n,) each; texts: by row, where something was found."""

    known: BoolArray
    inconsistent: BoolArray
    all_behind: BoolArray
    rms_px: FloatArray
    texts: Mapping[int, str]

    @classmethod
    def of(cls, images: Sequence[ConsistencyDiagnostics | None]) -> MeasuredParts:
        """Return the columns of these records."""
        return cls(
            np.array([each is not None for each in images], dtype=bool),
            np.array([each is not None and bool(each.inconsistent) for each in images], dtype=bool),
            np.array([each is not None and each.all_behind for each in images], dtype=bool),
            np.array([math.nan if each is None else each.rms_px for each in images], dtype=np.float64),
            {i: each.text for i, each in enumerate(images) if each is not None and each.text},
        )


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredOwn:
    """`OwnDiagnostics` of n images.

    records: of each image, None where it takes no part; images of one camera may have the same record.
    has_own: (n,) whether its camera has own parameters.    step_px, sigma_px: (n,), NaN where unknown.
    largest, largest_sd: (n,) step and sd of `OwnDiagnostics.largest`, NaN without.
    """

    records: Sequence[OwnDiagnostics | None]
    has_own: BoolArray
    step_px: FloatArray
    sigma_px: FloatArray
    largest: FloatArray
    largest_sd: FloatArray

    @classmethod
    def of(cls, images: Sequence[OwnDiagnostics | None], has_own: Iterable[bool]) -> MeasuredOwn:
        """Return the columns of these records; the same record is looked at once."""
        known: dict[int, tuple[float, float, float, float]] = {id(None): (math.nan,) * 4}
        for each in images:
            if each is not None and id(each) not in known:
                largest = each.largest
                step, sd = (math.nan, math.nan) if largest is None else (largest.step, largest.sd)
                known[id(each)] = each.step_px, each.sigma_px, step, sd
        numbers = np.array([known[id(each)] for each in images], dtype=np.float64).reshape(-1, 4)
        return cls(images, np.fromiter(has_own, dtype=bool, count=len(images)), *numbers.T.copy())


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """All that is decided upon, of n images.

    num_inliers, pose_offset_px, largest_residual_px, longer_side_px, half_pixel: (n,), see `Diagnostics`.
    gains: (n, 3) of pose, camera, both; NaN where unknown.    unusable, remarks: by row, where there are some.
    testimonies: of each image; None where no witness was asked.
    """

    num_inliers: IntArray
    noise: MeasuredNoise
    pose_offset_px: FloatArray
    misfit: MeasuredMisfit
    camera: MeasuredCamera
    largest_residual_px: FloatArray
    longer_side_px: IntArray
    unusable: Mapping[int, Reason]
    remarks: Mapping[int, tuple[Reason, ...]]
    parts: MeasuredParts
    own: MeasuredOwn
    gains: FloatArray
    half_pixel: BoolArray
    testimonies: Sequence[tuple[WitnessStatement, ...] | None]

    def __len__(self) -> int:
        return len(self.num_inliers)

    @classmethod
    def of(cls, images: Sequence[Diagnostics]) -> Measured:
        """Return the columns of these records."""
        noise = [each.noise for each in images]
        gains = [(g.pose, g.camera, g.both) if (g := each.gains) else (math.nan,) * 3 for each in images]
        return cls(
            _ints([each.num_inliers for each in images]),
            MeasuredNoise(
                _ints([each.num_standardised for each in noise]),
                _ints([each.num_values for each in noise]),
                np.array([each.ks_stat for each in noise], dtype=np.float64),
                np.array([each.ks_p for each in noise], dtype=np.float64),
                np.array([each.is_fitted for each in noise], dtype=bool),
            ),
            np.array([each.pose_offset_px for each in images], dtype=np.float64),
            MeasuredMisfit.of([each.misfit for each in images]),
            MeasuredCamera.of([each.camera for each in images]),
            np.array([each.largest_residual_px for each in images], dtype=np.float64),
            _ints([each.longer_side_px for each in images]),
            {i: each.unusable for i, each in enumerate(images) if each.unusable is not None},
            {i: each.remarks for i, each in enumerate(images) if each.remarks},
            MeasuredParts.of([each.consistency for each in images]),
            MeasuredOwn.of([each.own for each in images], [each.has_own for each in images]),
            np.array(gains, dtype=np.float64).reshape(-1, 3),
            np.array([each.half_pixel for each in images], dtype=bool),
            [each.testimonies for each in images],
        )


def _ints(values: Sequence[int]) -> IntArray:
    return np.array(values, dtype=np.int64)
