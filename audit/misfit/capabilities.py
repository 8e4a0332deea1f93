"""What each of COLMAP's camera models can express, and how one model's parameters look in a larger one.

The test never asks this table: whether a model has a group follows from the rank of the group's fields after
projection. It is for advice.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Final

import numpy as np

from sfm_audit.audit.cameras import is_fisheye
from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.loaders.camera_models import BY_NAME, CAMERA_MODELS, CameraModel


class Term(StrEnum):
    """Terms of a lens; RADIAL_2 is the coefficient of u r^2, and so on."""

    ASPECT = "aspect"
    RADIAL_2 = "radial_2"
    RADIAL_4 = "radial_4"
    RADIAL_6 = "radial_6"
    RADIAL_8 = "radial_8"
    TANGENTIAL = "tangential"


_ONE, _TWO = (Term.RADIAL_2,), (Term.RADIAL_2, Term.RADIAL_4)
_THREE = (*_TWO, Term.RADIAL_6)
_FOUR = (*_THREE, Term.RADIAL_8)
_ASPECT, _TANGENTIAL = (Term.ASPECT,), (Term.TANGENTIAL,)

TERMS: Final[dict[str, frozenset[Term]]] = {
    name: frozenset(terms)
    for name, terms in {
        "SIMPLE_PINHOLE": (),
        "PINHOLE": _ASPECT,
        "SIMPLE_RADIAL": _ONE,
        "RADIAL": _TWO,
        "OPENCV": (*_ASPECT, *_TWO, *_TANGENTIAL),
        "FULL_OPENCV": (*_ASPECT, *_FOUR, *_TANGENTIAL),
        "FOV": (*_ASPECT, *_ONE),
        "SIMPLE_DIVISION": _ONE,
        "DIVISION": (*_ASPECT, *_ONE),
        "EUCM": (*_ASPECT, *_TWO),
        "SIMPLE_FISHEYE": (),
        "FISHEYE": _ASPECT,
        "SIMPLE_RADIAL_FISHEYE": _ONE,
        "RADIAL_FISHEYE": _TWO,
        "OPENCV_FISHEYE": (*_ASPECT, *_FOUR),
        "THIN_PRISM_FISHEYE": (*_ASPECT, *_FOUR, *_TANGENTIAL),
        "RAD_TAN_THIN_PRISM_FISHEYE": (*_ASPECT, *_FOUR, *_TANGENTIAL),
        "EQUIRECTANGULAR": (),
    }.items()
}
"""What a model holds, exactly or (FOV, division, EUCM: one or two radial degrees of freedom) in effect."""

_POLYNOMIAL: Final = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
_SIMPLER: Final = {
    ("FOV", "DIVISION", "EUCM", "OPENCV", "FULL_OPENCV"): "PINHOLE",
    ("SIMPLE_RADIAL", "RADIAL", "SIMPLE_DIVISION"): "SIMPLE_PINHOLE",
    ("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"): "SIMPLE_FISHEYE",
    ("OPENCV_FISHEYE", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE"): "FISHEYE",
}
_SYNONYMS: Final = {"f": ("fx", "fy"), "k": ("k1",)}
_RAD_TAN: Final = "RAD_TAN_THIN_PRISM_FISHEYE"
_RAD_TAN_SYNONYMS: Final = {f"k{i}": (f"k{i + 1}",) for i in range(6)} | {"p0": ("p2",)}


def undistorted_model(model: CameraModel) -> CameraModel | None:
    """Return the model without distortion parameters to use when they are not identified; None if it has none."""
    for names, simpler in _SIMPLER.items():
        if model.name in names:
            return BY_NAME[simpler]
    return None


def larger_models(model: CameraModel) -> tuple[CameraModel, ...]:
    """Return the models that hold every term of ``model`` and have more parameters, fewest first, of its family.

    Families: the pinhole models with polynomial distortion, and the equidistant fisheyes. FOV, the division models and
    EUCM have no relatives; the first family takes their place, because their extra freedom is radial.
    """
    if model.is_spherical:
        return ()
    family = [m for m in CAMERA_MODELS if (is_fisheye(m) if is_fisheye(model) else m.name in _POLYNOMIAL)]
    larger = [m for m in family if TERMS[m.name] >= TERMS[model.name] and m.num_params > model.num_params]
    return tuple(sorted(larger, key=lambda m: (m.num_params, m.model_id)))


def extended_params(model: CameraModel, params: FloatArray, larger: CameraModel) -> FloatArray | None:
    """Return the parameters of the same camera in another model, new terms zero; None where that cannot express it."""
    same_family = is_fisheye(larger) if is_fisheye(model) else {model.name, larger.name} <= set(_POLYNOMIAL)
    if not same_family:
        return None
    values = {name: float(value) for names, value in zip(_common_names(model), params, strict=True) for name in names}
    if larger.name == _RAD_TAN != model.name and any(values.get(name, 0.0) for name in ("p1", "p2", "sx1", "sy1")):
        return None  # there these terms act on the radially distorted point
    out = []
    for names in _common_names(larger):
        wanted = {values.pop(name, 0.0) for name in names}
        if len(wanted) > 1:
            return None
        out.append(wanted.pop())
    return None if any(values.values()) else np.array(out)


def _common_names(model: CameraModel) -> list[tuple[str, ...]]:
    """The names of the family's largest model for each parameter; two for a focal length that serves both axes."""
    synonyms = _RAD_TAN_SYNONYMS if model.name == _RAD_TAN else _SYNONYMS
    return [synonyms.get(name, (name,)) for name in model.param_names]
