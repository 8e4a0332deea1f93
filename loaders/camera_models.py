"""Camera models: ids, names, and the meaning of each parameter, one record each in one list; COLMAP's come first.

The mathematics of a model is its record of the same name in `audit.cameras.models`.

Source of ids 0 to 17: COLMAP 4.2 ``src/colmap/sensor/models.h``; checked against ``pycolmap.CameraModelId`` in the
tests. Ids from 1000 on are this program's own, for lenses of other programs that COLMAP cannot write down; no file
holds them. A parameter's name means the same in all models: ``p1`` is the factor of 2 u v in x, as in OpenCV; readers
of formats that count otherwise exchange the numbers.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Final


@dataclass(frozen=True, slots=True)
class CameraModel:
    """One camera model.

    model_id, name: of COLMAP's models as in its files.    param_names: in the order in which files store the
    parameters. is_spherical: whether the camera sees directions behind it (no Zc > 0 condition, method.md section 1).
    """

    model_id: int
    name: str
    param_names: tuple[str, ...]
    is_spherical: bool = False

    @property
    def is_colmap(self) -> bool:
        """Whether COLMAP has this model."""
        return self.model_id < FIRST_OWN_ID

    @property
    def num_params(self) -> int:
        """How many numbers a file stores for this model."""
        return len(self.param_names)

    @property
    def focal_idxs(self) -> tuple[int, ...]:
        """Rows of the focal lengths, px."""
        return _rows_of(self.param_names)[0]

    @property
    def principal_point_idxs(self) -> tuple[int, ...]:
        """Rows of the principal point, px."""
        return _rows_of(self.param_names)[1]

    @property
    def extra_idxs(self) -> tuple[int, ...]:
        """Rows of the distortion parameters; empty for EQUIRECTANGULAR, whose parameters are the image size."""
        return _rows_of(self.param_names)[2]


@lru_cache(maxsize=64)
def _rows_of(names: tuple[str, ...]) -> tuple[tuple[int, ...], tuple[int, ...], tuple[int, ...]]:
    """Rows of focal lengths, principal point and distortion; asked dozens of times for every image."""
    focals, centre, size = {"f", "fx", "fy"}, {"cx", "cy"}, {"w", "h"}
    rest = set(names) - focals - centre - size
    focal, principal_point, extra = (
        tuple(i for i, name in enumerate(names) if name in chosen) for chosen in (focals, centre, rest)
    )
    return focal, principal_point, extra


FIRST_OWN_ID: Final = 1000


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
    # OpenSfM brown, BlocksExchange: three radial and two tangential terms; one focal length: OpenMVG pinhole_brown_t2
    _model(1000, "BROWN", "fx fy cx cy k1 k2 p1 p2 k3"),
    _model(1001, "SIMPLE_BROWN", "f cx cy k1 k2 p1 p2 k3"),
    # OpenMVG pinhole_radial_k3
    _model(1002, "RADIAL_3", "f cx cy k1 k2 k3"),
    # OpenMVG fisheye: OPENCV_FISHEYE with one focal length
    _model(1003, "SIMPLE_OPENCV_FISHEYE", "f cx cy k1 k2 k3 k4"),
    # OpenSfM dual: perspective (transition 1) to equidistant (0), then two radial terms
    _model(1004, "DUAL", "f cx cy k1 k2 transition"),
    # Metashape frame, BlocksExchange with skew; b1, b2 as shares of f: x = f ((1 + b1) x' + b2 y') + cx
    _model(1005, "FRAME", "f cx cy k1 k2 p1 p2 k3 k4 b1 b2"),
    # VisualSFM: the polynomial leads from the distorted to the undistorted point, u = d (1 + k d^2)
    _model(1006, "INVERSE_RADIAL", "f cx cy k"),
)
COLMAP_MODELS: Final = tuple(model for model in CAMERA_MODELS if model.is_colmap)
BY_ID: Final[dict[int, CameraModel]] = {model.model_id: model for model in CAMERA_MODELS}
BY_NAME: Final[dict[str, CameraModel]] = {model.name: model for model in CAMERA_MODELS}
