"""Which camera model is it? Formats store a fixed set of coefficients; those that are exactly 0 were not estimated.

The misfit test takes all parameters of a camera for fitted ones, so the smallest model that holds what is not 0 is
the right one: an adjustment never leaves a free coefficient at exactly 0.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from sfm_audit.loaders.assembly.raw import RawCamera
from sfm_audit.loaders.camera_models import BY_NAME, CameraModel

_ALIASES: Final = {"f": "fx", "k": "k1"}
_SINGLE: Final = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "RADIAL_3", "SIMPLE_BROWN", "FRAME")
_DOUBLE: Final = ("PINHOLE", "OPENCV", "BROWN", "FRAME")
_FISHEYE_SINGLE: Final = ("SIMPLE_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "SIMPLE_OPENCV_FISHEYE")
_FISHEYE_DOUBLE: Final = ("FISHEYE", "OPENCV_FISHEYE")


def camera_of(
    camera_id: int, size: tuple[int, int], values: Mapping[str, float], *, is_fisheye: bool = False
) -> RawCamera:
    """Return the camera with these parameters, in the smallest model that holds those that are not 0.

    Parameters
    ----------
    values : fx, fy, cx, cy in px, first pixel centre at (0.5, 0.5); k1 .. k4, p1, p2 as OpenCV means them; skew, px per
        unit of the distorted normalised y. What is left out is 0, fy is fx.
    is_fisheye : whether the coefficients are of the equidistant plane

    Raises
    ------
    ValueError
        No model holds the parameters.
    """
    known = {"fy": values["fx"], **values}
    skew = known.pop("skew", 0.0)
    is_single = known["fx"] == known["fy"] or known["fx"] != known["fx"]
    if skew != 0 or (not is_fisheye and known.get("k4", 0.0) != 0):
        known |= {"b1": known["fx"] / known["fy"] - 1.0 if known["fy"] else 0.0, "b2": _share(skew, known["fy"])}
        known["fx"], is_single = known["fy"], True
    candidates: tuple[str, ...]
    if is_fisheye:
        candidates = _FISHEYE_SINGLE if is_single else _FISHEYE_DOUBLE
    else:
        candidates = _SINGLE if is_single else _DOUBLE
    nonzero = {name for name, value in known.items() if value != 0 and name not in {"fx", "fy", "cx", "cy"}}
    for name in candidates:
        model = BY_NAME[name]
        if nonzero <= {_ALIASES.get(param, param) for param in model.param_names}:
            return raw_camera(camera_id, model, size, known)
    raise ValueError(", ".join(sorted(nonzero)))


def _share(skew: float, focal: float) -> float:
    return skew / focal if focal else 0.0


def raw_camera(camera_id: int, model: CameraModel, size: tuple[int, int], values: Mapping[str, float]) -> RawCamera:
    """Return the camera with the parameters of ``model`` taken from ``values``; those left out are 0."""
    params = tuple(float(values.get(_ALIASES.get(name, name), 0.0)) for name in model.param_names)
    return RawCamera(camera_id, model.model_id, size[0], size[1], params)
