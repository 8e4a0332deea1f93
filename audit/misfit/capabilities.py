"""What each camera model can express, and how one model's parameters look in a larger one.

The test never asks this table: whether a model has a group follows from the rank of the group's fields after
projection. It is for advice.
"""

from __future__ import annotations

import numpy as np

from sfm_audit.audit.cameras.functions import Family
from sfm_audit.audit.cameras.models import functions_of
from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.loaders.camera_models import BY_NAME, COLMAP_MODELS, CameraModel


def undistorted_model(model: CameraModel) -> CameraModel | None:
    """Return the model without distortion parameters to use when they are not identified; None if it has none."""
    undistorted = functions_of(model).undistorted
    return None if undistorted is None else BY_NAME[undistorted]


def larger_models(model: CameraModel) -> tuple[CameraModel, ...]:
    """Return COLMAP's models that hold every term of ``model`` and have more parameters, fewest first, of its family.

    Families: the pinhole models with polynomial distortion, and the equidistant fisheyes. FOV, the division models and
    EUCM have no relatives; the first family takes their place, because their extra freedom is radial.
    """
    if model.is_spherical:
        return ()
    functions = functions_of(model)
    family = Family.FISHEYE if functions.family is Family.FISHEYE else Family.POLYNOMIAL
    relatives = [m for m in COLMAP_MODELS if functions_of(m).family is family]
    larger = [m for m in relatives if functions_of(m).terms >= functions.terms and m.num_params > model.num_params]
    return tuple(sorted(larger, key=lambda m: (m.num_params, m.model_id)))


def extended_params(model: CameraModel, params: FloatArray, larger: CameraModel) -> FloatArray | None:
    """Return the parameters of the same camera in another model, new terms zero; None where that cannot express it."""
    family = functions_of(model).family
    if family is Family.NONE or functions_of(larger).family is not family:
        return None
    values = {name: float(value) for names, value in zip(_common_names(model), params, strict=True) for name in names}
    if (
        _is_rad_tan(larger)
        and not _is_rad_tan(model)
        and any(values.get(name, 0.0) for name in ("p1", "p2", "sx1", "sy1"))
    ):
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
    synonyms = functions_of(model).synonyms
    return [synonyms.get(name, (name,)) for name in model.param_names]


def _is_rad_tan(model: CameraModel) -> bool:
    """Whether tangential and prism terms act on the radially distorted point."""
    return functions_of(model).tangential_after_radial
