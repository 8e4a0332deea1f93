"""What the model functions hand to each other: one contiguous 1-D array per number, nothing stacked."""

from __future__ import annotations

from enum import IntEnum
from typing import Final, NamedTuple, TypeAlias

import numpy as np

from sfm_audit.loaders.arrays import FloatArray

EPSILON: Final = float(np.finfo(np.float64).eps)
"""Smallest Zc that COLMAP projects (HasProjectableDepth in src/colmap/sensor/models.h)."""

Column: TypeAlias = FloatArray | float
"""(n,) values, or one number that holds for all n points."""


class Want(IntEnum):
    """How much a model function computes."""

    VALUE = 0
    D_POINT = 1
    D_EXTRA = 2


class Warp(NamedTuple):
    """A distorted point of the normalised plane, with d (x, y) / d (u, v) and d (x, y) / d extra where asked for."""

    x: FloatArray
    y: FloatArray
    xu: Column = 0.0
    xv: Column = 0.0
    yu: Column = 0.0
    yv: Column = 0.0
    d_extra: tuple[tuple[Column, Column], ...] = ()


class Plane(NamedTuple):
    """A distorted normalised point, with its derivatives by the point in the camera frame and by extra parameters.

    ``d_cam``: dx/dX, dx/dY, dx/dZ, dy/dX, dy/dY, dy/dZ in 1 / model unit; empty when not asked for.
    """

    x: FloatArray
    y: FloatArray
    d_cam: tuple[Column, ...] = ()
    d_extra: tuple[tuple[Column, Column], ...] = ()


def in_front(z_cam: FloatArray) -> FloatArray:
    """Return ``z_cam``, NaN where COLMAP does not project for lack of depth; the array itself where nothing is."""
    if z_cam.min(initial=np.inf) >= EPSILON:
        return z_cam
    return np.where(z_cam >= EPSILON, z_cam, np.nan)
