"""COLMAP's camera models: ids as on disk, names, and the meaning of each parameter, one record each in one list.

The mathematics of a model is its record of the same name in `audit.cameras.models`.

Source: COLMAP 4.2 ``src/colmap/sensor/models.h``; checked against ``pycolmap.CameraModelId`` in the tests.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True, slots=True)
class CameraModel:
    """One of COLMAP's camera models.

    model_id, name: as in files.    param_names: in the order in which files store the parameters.
    is_spherical: whether the camera sees directions behind it (no Zc > 0 condition, method.md section 1).
    """

    model_id: int
    name: str
    param_names: tuple[str, ...]
    is_spherical: bool = False

    @property
    def num_params(self) -> int:
        """How many numbers a file stores for this model."""
        return len(self.param_names)

    @property
    def focal_idxs(self) -> tuple[int, ...]:
        """Rows of the focal lengths, px."""
        return tuple(i for i, name in enumerate(self.param_names) if name in {"f", "fx", "fy"})

    @property
    def principal_point_idxs(self) -> tuple[int, ...]:
        """Rows of the principal point, px."""
        return tuple(i for i, name in enumerate(self.param_names) if name in {"cx", "cy"})

    @property
    def extra_idxs(self) -> tuple[int, ...]:
        """Rows of the distortion parameters; empty for EQUIRECTANGULAR, whose parameters are the image size."""
        known = {"f", "fx", "fy", "cx", "cy", "w", "h"}
        return tuple(i for i, name in enumerate(self.param_names) if name not in known)


def _model(model_id: int, name: str, params: str, *, is_spherical: bool = False) -> CameraModel:
    return CameraModel(model_id, name, tuple(params.split()), is_spherical)


CAMERA_MODELS: Final[tuple[CameraModel, ...]] = (
    _model(0, "SIMPLE_PINHOLE", "f cx cy"),
    _model(1, "PINHOLE", "fx fy cx cy"),
    _model(2, "SIMPLE_RADIAL", "f cx cy k"),
    _model(3, "RADIAL", "f cx cy k1 k2"),
    _model(4, "OPENCV", "fx fy cx cy k1 k2 p1 p2"),
    _model(5, "OPENCV_FISHEYE", "fx fy cx cy k1 k2 k3 k4"),
    _model(6, "FULL_OPENCV", "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6"),
    _model(7, "FOV", "fx fy cx cy omega"),
    _model(8, "SIMPLE_RADIAL_FISHEYE", "f cx cy k"),
    _model(9, "RADIAL_FISHEYE", "f cx cy k1 k2"),
    _model(10, "THIN_PRISM_FISHEYE", "fx fy cx cy k1 k2 p1 p2 k3 k4 sx1 sy1"),
    _model(11, "RAD_TAN_THIN_PRISM_FISHEYE", "fx fy cx cy k0 k1 k2 k3 k4 k5 p0 p1 s0 s1 s2 s3"),
    _model(12, "SIMPLE_DIVISION", "f cx cy k"),
    _model(13, "DIVISION", "fx fy cx cy k"),
    _model(14, "SIMPLE_FISHEYE", "f cx cy"),
    _model(15, "FISHEYE", "fx fy cx cy"),
    _model(16, "EUCM", "fx fy cx cy alpha beta"),
    _model(17, "EQUIRECTANGULAR", "w h", is_spherical=True),
)
BY_ID: Final[dict[int, CameraModel]] = {model.model_id: model for model in CAMERA_MODELS}
BY_NAME: Final[dict[str, CameraModel]] = {model.name: model for model in CAMERA_MODELS}
