"""The one list of camera models' mathematics; ids, names and parameters are `loaders.camera_models`' own list.

Adding a model is one record in each list (a test compares them).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from sfm_audit.audit.cameras.functions import CameraFunctions, Family, Term, fisheye, perspective, rational
from sfm_audit.audit.cameras.other_warps import brown, dual, frame, inverse_radial, inverse_radial_rays
from sfm_audit.audit.cameras.rational import (
    division_depth,
    division_folds,
    division_plane,
    eucm_depth,
    eucm_plane,
)
from sfm_audit.audit.cameras.spherical import spherical_plane, spherical_rays
from sfm_audit.audit.cameras.warps import fov, full_opencv, identity, opencv, rad_tan_thin_prism, radial, thin_prism
from sfm_audit.loaders.camera_models import CameraModel

_ONE, _TWO = (Term.RADIAL_2,), (Term.RADIAL_2, Term.RADIAL_4)
_THREE = (*_TWO, Term.RADIAL_6)
_FOUR = (*_THREE, Term.RADIAL_8)
_ASPECT, _TANGENTIAL = (Term.ASPECT,), (Term.TANGENTIAL,)
_RAD_TAN_SYNONYMS: Final = {f"k{i}": (f"k{i + 1}",) for i in range(6)} | {"p0": ("p2",)}

CAMERA_FUNCTIONS: Final[tuple[CameraFunctions, ...]] = (
    perspective("SIMPLE_PINHOLE", identity, (), None),
    perspective("PINHOLE", identity, _ASPECT, None),
    perspective("SIMPLE_RADIAL", radial, _ONE, "SIMPLE_PINHOLE"),
    perspective("RADIAL", radial, _TWO, "SIMPLE_PINHOLE"),
    perspective("OPENCV", opencv, (*_ASPECT, *_TWO, *_TANGENTIAL), "PINHOLE"),
    fisheye("OPENCV_FISHEYE", radial, (*_ASPECT, *_FOUR), "FISHEYE"),
    perspective("FULL_OPENCV", full_opencv, (*_ASPECT, *_FOUR, *_TANGENTIAL), "PINHOLE"),
    perspective("FOV", fov, (*_ASPECT, *_ONE), "PINHOLE", Family.NONE),
    fisheye("SIMPLE_RADIAL_FISHEYE", radial, _ONE, "SIMPLE_FISHEYE"),
    fisheye("RADIAL_FISHEYE", radial, _TWO, "SIMPLE_FISHEYE"),
    fisheye("THIN_PRISM_FISHEYE", thin_prism, (*_ASPECT, *_FOUR, *_TANGENTIAL), "FISHEYE"),
    replace(
        fisheye("RAD_TAN_THIN_PRISM_FISHEYE", rad_tan_thin_prism, (*_ASPECT, *_FOUR, *_TANGENTIAL), "FISHEYE"),
        synonyms=_RAD_TAN_SYNONYMS,
        tangential_after_radial=True,
    ),
    rational("SIMPLE_DIVISION", division_plane, division_depth, _ONE, "SIMPLE_PINHOLE", folds=division_folds),
    rational("DIVISION", division_plane, division_depth, (*_ASPECT, *_ONE), "PINHOLE", folds=division_folds),
    fisheye("SIMPLE_FISHEYE", identity, (), None),
    fisheye("FISHEYE", identity, _ASPECT, None),
    rational("EUCM", eucm_plane, eucm_depth, (*_ASPECT, *_TWO), "PINHOLE"),
    CameraFunctions(
        name="EQUIRECTANGULAR", plane=spherical_plane, rays=spherical_rays, distort=None, terms=frozenset()
    ),
    perspective("BROWN", brown, (*_ASPECT, *_THREE, *_TANGENTIAL), "PINHOLE"),
    perspective("SIMPLE_BROWN", brown, (*_THREE, *_TANGENTIAL), "SIMPLE_PINHOLE"),
    perspective("RADIAL_3", radial, _THREE, "SIMPLE_PINHOLE"),
    fisheye("SIMPLE_OPENCV_FISHEYE", radial, _FOUR, "SIMPLE_FISHEYE"),
    perspective("DUAL", dual, _TWO, "SIMPLE_PINHOLE", Family.NONE),
    perspective("FRAME", frame, (*_ASPECT, *_FOUR, *_TANGENTIAL), "SIMPLE_PINHOLE"),
    replace(
        perspective("INVERSE_RADIAL", inverse_radial, _ONE, "SIMPLE_PINHOLE", Family.NONE), rays=inverse_radial_rays
    ),
)
FUNCTIONS: Final[dict[str, CameraFunctions]] = {each.name: each for each in CAMERA_FUNCTIONS}


def functions_of(model: CameraModel) -> CameraFunctions:
    """Return the mathematics of a camera model."""
    return FUNCTIONS[model.name]
