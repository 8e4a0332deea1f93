"""What belongs to one camera model: projection, its derivatives, the way back, and which terms its lens has.

`models` holds one record per model; the constructors here make it from a distortion of the plane Z = 1, of the
equidistant plane, or of the ray itself.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Final, TypeAlias

import numpy as np

from sfm_audit.audit.cameras.columns import Plane, Want, Warp
from sfm_audit.audit.cameras.fisheye import fisheye_plane
from sfm_audit.audit.cameras.inverse import fisheye_rays, perspective_rays, unit_rays
from sfm_audit.audit.cameras.perspective import perspective_plane
from sfm_audit.audit.cameras.rational import PlaneFunction
from sfm_audit.audit.cameras.warps import WarpFunction
from sfm_audit.loaders.arrays import FloatArray

RaysFunction: TypeAlias = Callable[[FloatArray, FloatArray, Sequence[float]], FloatArray]
DepthFunction: TypeAlias = Callable[[FloatArray, Sequence[float]], FloatArray]
FoldFunction: TypeAlias = Callable[[Sequence[float], float], bool]


class Term(StrEnum):
    """Terms of a lens; RADIAL_2 is the coefficient of u r^2, and so on."""

    ASPECT = "aspect"
    RADIAL_2 = "radial_2"
    RADIAL_4 = "radial_4"
    RADIAL_6 = "radial_6"
    RADIAL_8 = "radial_8"
    TANGENTIAL = "tangential"


class Family(StrEnum):
    """Models of one family hold each other: the parameters of the smaller ones are a part of the larger ones'."""

    POLYNOMIAL = "polynomial"
    FISHEYE = "fisheye"
    NONE = "none"


SYNONYMS: Final[Mapping[str, tuple[str, ...]]] = {"f": ("fx", "fy"), "k": ("k1",)}
"""What a parameter is called in the largest model of its family; f serves both axes."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraFunctions:
    """One camera model's mathematics; names and ids are in `loaders.camera_models`.

    Attributes
    ----------
    name : str
        As in `loaders.camera_models`.
    plane : callable
        (x, y, z, extra, want) -> `Plane`: points (n,) each in the camera frame to the distorted normalised plane
        (spherical: to shares of the image), with derivatives as far as wanted.
    rays : callable
        (x, y, extra) -> (n, 3) unit rays of points on that plane; NaN where there is none.
    distort : callable or None
        (u, v, extra, want) -> `Warp`: the distortion of the undistorted plane; None for spherical models.
    folds : callable or None
        (extra, squared distorted radius) -> whether the model ends before that radius; None where no closed form is
        known and the derivative has to be followed.
    is_fisheye : bool
        Whether it distorts the equidistant plane theta (X, Y) / rho instead of (X, Y) / Z.
    terms : frozenset of Term
        What the lens holds, exactly or (FOV, division, EUCM: one or two radial degrees of freedom) in effect.
    undistorted : str or None
        The model without distortion parameters; None for a model that has none.
    family, synonyms, tangential_after_radial
        Which models can hold it, what its parameters are called there, and whether its tangential and prism terms act
        on the radially distorted point.
    """

    name: str
    plane: PlaneFunction
    rays: RaysFunction
    distort: WarpFunction | None
    terms: frozenset[Term]
    undistorted: str | None = None
    is_fisheye: bool = False
    family: Family = Family.NONE
    folds: FoldFunction | None = None
    synonyms: Mapping[str, tuple[str, ...]] = field(default_factory=lambda: SYNONYMS)
    tangential_after_radial: bool = False


def perspective(
    name: str, warp: WarpFunction, terms: Sequence[Term], undistorted: str | None, family: Family = Family.POLYNOMIAL
) -> CameraFunctions:
    """Return a model that distorts (X, Y) / Z."""

    def plane(x: FloatArray, y: FloatArray, z: FloatArray, extra: Sequence[float], want: Want) -> Plane:
        return perspective_plane(x, y, z, warp, extra, want=want)

    def rays(x: FloatArray, y: FloatArray, extra: Sequence[float]) -> FloatArray:
        return perspective_rays(warp, x, y, extra)

    return CameraFunctions(
        name=name,
        plane=plane,
        rays=rays,
        distort=warp,
        terms=frozenset(terms),
        undistorted=undistorted,
        family=family,
    )


def fisheye(
    name: str,
    warp: WarpFunction,
    terms: Sequence[Term],
    undistorted: str | None,
) -> CameraFunctions:
    """Return a model that distorts theta (X, Y) / rho."""

    def plane(x: FloatArray, y: FloatArray, z: FloatArray, extra: Sequence[float], want: Want) -> Plane:
        return fisheye_plane(x, y, z, warp, extra, want=want)

    def rays(x: FloatArray, y: FloatArray, extra: Sequence[float]) -> FloatArray:
        return fisheye_rays(warp, x, y, extra)

    return CameraFunctions(
        name=name,
        plane=plane,
        rays=rays,
        distort=warp,
        terms=frozenset(terms),
        undistorted=undistorted,
        is_fisheye=True,
        family=Family.FISHEYE,
    )


def rational(
    name: str,
    plane: PlaneFunction,
    depth: DepthFunction,
    terms: Sequence[Term],
    undistorted: str,
    *,
    folds: FoldFunction | None = None,
) -> CameraFunctions:
    """Return a model that divides by another depth than Z; ``depth`` gives Z of the ray (x, y, Z) by r^2."""

    def rays(x: FloatArray, y: FloatArray, extra: Sequence[float]) -> FloatArray:
        return unit_rays(x, y, depth(x * x + y * y, extra))

    def distort(u: FloatArray, v: FloatArray, extra: Sequence[float], want: Want) -> Warp:
        found = plane(u, v, np.ones_like(u), extra, want)
        if want is Want.VALUE:
            return Warp(found.x, found.y)
        xu, xv, _, yu, yv, _ = found.d_cam
        return Warp(found.x, found.y, xu, xv, yu, yv, found.d_extra)

    return CameraFunctions(
        name=name,
        plane=plane,
        rays=rays,
        distort=distort,
        terms=frozenset(terms),
        undistorted=undistorted,
        folds=folds,
    )
