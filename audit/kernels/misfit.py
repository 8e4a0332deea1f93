"""The sums of the misfit test in C: many images of one camera model at once (source/misfit.c)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from sfm_audit.audit.kernels.checked import small_ints
from sfm_audit.audit.kernels.library import Doubles, Ints, Size, SmallInts, kernel
from sfm_audit.loaders.arrays import FloatArray, Int32Array, IntArray

NUM_FEATURES: Final = 40
NUM_SMOOTH: Final = 28
MAX_OWN: Final = 32
"""Columns of an image's own fit that the kernels have room for."""
_DONE: Final = 0
_Strided: Final = np.ctypeslib.ndpointer(np.float64)
_WINDOW: Final = (
    Size,
    Ints,
    Doubles,
    Doubles,
    Ints,
    Ints,
    Doubles,
    SmallInts,
    Doubles,
    SmallInts,
    _Strided,
    Size,
    _Strided,
    Size,
)


@dataclass(frozen=True, slots=True, eq=False)
class Observed:
    """The inliers of a model, as kernels take them; see `audit.inliers.residuals.ModelResiduals`.

    xyz_world: (P, 3).    xy_px: (M, 2).    point_idx, observation_row: (n,) rows of these.
    residuals_px: (2, n), point_jacobian: (2, 3, n), points next to each other.
    """

    xyz_world: FloatArray
    xy_px: FloatArray
    point_idx: Int32Array
    observation_row: Int32Array
    residuals_px: FloatArray
    point_jacobian: FloatArray

    def __post_init__(self) -> None:
        """Check what C does not: indices and shapes."""
        num = self.residuals_px.shape[1]
        if self.point_jacobian.shape != (2, 3, num) or {self.point_idx.shape, self.observation_row.shape} != {(num,)}:
            raise ValueError("arrays of observations of different lengths")
        for idx, size in (self.point_idx, len(self.xyz_world)), (self.observation_row, len(self.xy_px)):
            if num and not 0 <= int(idx.min()) <= int(idx.max()) < size:
                raise ValueError(f"row {idx.min()} or {idx.max()} of {size}")

    @classmethod
    def of(
        cls,
        xyz_world: FloatArray,
        xy_px: FloatArray,
        rows: tuple[IntArray | Int32Array, Int32Array],
        residuals_px: FloatArray,
        point_jacobian: FloatArray,
    ) -> Observed:
        """Take the arrays as they are where they have the types of the kernels; ``rows`` of points and 2D points."""
        point_idx, observation_row = (small_ints(each, len(each)) for each in rows)
        residuals_px, point_jacobian = (
            each if each.dtype == np.float64 and _is_by_rows(each) else np.ascontiguousarray(each, dtype=np.float64)
            for each in (residuals_px, point_jacobian)
        )
        xyz_world, xy_px = (np.ascontiguousarray(each, dtype=np.float64) for each in (xyz_world, xy_px))
        return cls(xyz_world, xy_px, point_idx, observation_row, residuals_px, point_jacobian)


class Window(NamedTuple):
    """Images of one camera model, of one layout of N.

    rows: (k, 2) first and last + 1 of each image's observations.
    numbers: (k, 22) quaternion, translation, 3 x 3 from gradients in the world to those in the camera, fx fy cx cy w h.
    facts: (7,) number of distortion parameters, of focal lengths, whether a fisheye, and which distortion parameters
    the radial (2) and the tangential (2) group are, -1 for those of the plain polynomial.
    d_extra: (e, 2, n) of each image, px per unit.
    """

    rows: IntArray
    numbers: FloatArray
    facts: IntArray
    d_extra: tuple[FloatArray, ...]

    @property
    def num_own(self) -> int:
        """Columns of N: pose, focal lengths, distortion."""
        return 6 + int(self.facts[0]) + int(self.facts[1])

    def only(self, chosen: IntArray) -> Window:
        """Return some of the images."""
        extra = tuple(self.d_extra[b] for b in chosen.tolist())
        return Window(self.rows[chosen], self.numbers[chosen], self.facts, extra)


def misfit_sums(observed: Observed, window: Window) -> tuple[FloatArray, FloatArray] | None:
    """Return Gram matrices (k, q + 40, q + 40) of N and features, and products with the residuals (k, q + 40).

    None where numpy is to be taken. Order, and what of the matrices is used: `audit.misfit.features`.
    """
    function = kernel("sfm_misfit_sums", *_WINDOW, Doubles, Doubles)
    if function is None or window.num_own > MAX_OWN:
        return None
    size = window.num_own + NUM_FEATURES
    gram, on_y = np.empty((len(window.rows), size, size)), np.empty((len(window.rows), size))
    status = function(*_arguments(observed, window), gram, on_y)
    return (gram, on_y) if status == _DONE else None


def misfit_meat(
    observed: Observed, window: Window, basis: FloatArray, on_y: FloatArray
) -> tuple[FloatArray, FloatArray, IntArray] | None:
    """Return the meat (k, q + 40, q + 40), the largest leverage (k,) and the number of clusters (k,) of each image.

    None where numpy is to be taken.

    Parameters
    ----------
    basis : (k, q, q) basis N is orthonormal        on_y : (k, q) coefficients of N that the residuals are left without
    """
    function = kernel("sfm_misfit_meat", *_WINDOW, Doubles, Doubles, Doubles, Doubles, Ints)
    if function is None or window.num_own > MAX_OWN:
        return None
    num, q = len(window.rows), window.num_own
    _check("basis", basis, (num, q, q))
    _check("on_y", on_y, (num, q))
    meat, leverage = np.zeros((num, q + NUM_FEATURES, q + NUM_FEATURES)), np.zeros(num)
    num_clusters = np.zeros(num, dtype=np.int64)
    status = function(*_arguments(observed, window), basis, on_y, meat, leverage, num_clusters)
    return (meat, leverage, num_clusters) if status == _DONE else None


def misfit_mixed(
    observed: Observed,
    window: Window,
    profile: tuple[FloatArray, FloatArray],
    mixing: tuple[FloatArray, FloatArray],
) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Return Gram matrices (k, 28, 28), scores (k, 28) and meat (k, 28, 28) of smooth fields, mixed and off N.

    None where numpy is to be taken.

    Parameters
    ----------
    profile : basis (k, q, q) and on_y (k, q) as of `misfit_meat`
    mixing : mix (k, 28, 28) and coefficients (k, q, 28): the columns are monomials mix - N coefficients
    """
    function = kernel("sfm_misfit_mixed", *_WINDOW, *[Doubles] * 7)
    if function is None or window.num_own > MAX_OWN:
        return None
    num, q = len(window.rows), window.num_own
    (basis, on_y), (mix, coefficients) = profile, mixing
    _check("basis", basis, (num, q, q))
    _check("on_y", on_y, (num, q))
    _check("mix", mix, (num, NUM_SMOOTH, NUM_SMOOTH))
    _check("coefficients", coefficients, (num, q, NUM_SMOOTH))
    gram, scores, meat = (np.zeros((num, NUM_SMOOTH, *rest)) for rest in ((NUM_SMOOTH,), (), (NUM_SMOOTH,)))
    status = function(*_arguments(observed, window), basis, on_y, mix, coefficients, gram, scores, meat)
    return (gram, scores, meat) if status == _DONE else None


class Tracks(NamedTuple):
    """Which tracks are asked for: those numbered first .. last - 1; of_row: (n,) number of each observation's track."""

    of_row: Int32Array
    first: int
    last: int


def misfit_tracks(
    observed: Observed,
    window: Window,
    profile: tuple[FloatArray, FloatArray, FloatArray],
    tracks: Tracks,
    per_track: FloatArray,
) -> bool:
    """Add what the observations of these images say to their tracks (last - first, 40); False: take numpy.

    Parameters
    ----------
    profile : basis (k, r, q), on_y (k, q) as of `misfit_meat`, and (k, q, 40) coefficients of N in each feature
    """
    function = kernel("sfm_misfit_tracks", *_WINDOW, Doubles, Size, Doubles, Doubles, SmallInts, Size, Size, Doubles)
    if function is None or window.num_own > MAX_OWN:
        return False
    num, q = len(window.rows), window.num_own
    basis, on_y, coefficients = profile
    _check("basis", basis, (num, basis.shape[1], q))
    _check("on_y", on_y, (num, q))
    _check("coefficients", coefficients, (num, q, NUM_FEATURES))
    _check("tracks", tracks.of_row, (len(observed.point_idx),))
    _check("per_track", per_track, (tracks.last - tracks.first, NUM_FEATURES))
    status = function(
        *_arguments(observed, window),
        basis,
        basis.shape[1],
        on_y,
        coefficients,
        tracks.of_row,
        tracks.first,
        tracks.last,
        per_track,
    )
    return status == _DONE


def _arguments(observed: Observed, window: Window) -> tuple[object, ...]:
    """What all kernels here begin with."""
    num, num_extra = len(window.rows), int(window.facts[0])
    _check("rows", window.rows, (num, 2))
    _check("numbers", window.numbers, (num, 22))
    _check("facts", window.facts, (7,))
    start, stop = window.rows.T
    if num and not (int(start.min()) >= 0 and int(stop.max()) <= len(observed.point_idx) and (start <= stop).all()):
        raise ValueError("observations that are not there")
    if int(window.facts[3:].max(initial=-1)) >= num_extra:
        raise ValueError("distortion parameters that are not there")
    extra, extra_offsets = np.empty(0), np.zeros(num, dtype=np.int64)
    if num_extra:
        for each, length in zip(window.d_extra, (stop - start).tolist(), strict=True):
            _check("d_extra", each, (num_extra, 2, length))
        extra, extra_offsets = _side_by_side(window.d_extra)
    residuals, jacobian = observed.residuals_px, observed.point_jacobian
    return (
        num,
        window.rows,
        window.numbers,
        extra,
        extra_offsets,
        window.facts,
        observed.xyz_world,
        observed.point_idx,
        observed.xy_px,
        observed.observation_row,
        residuals,
        residuals.strides[0] // 8,
        jacobian,
        jacobian.strides[1] // 8,
    )


def _side_by_side(arrays: tuple[FloatArray, ...]) -> tuple[FloatArray, IntArray]:
    """One array (m,) that holds all of these, and where each begins: the one that all are views of, or a new one."""
    base = arrays[0].base if arrays else None
    if isinstance(base, np.ndarray) and base.ndim == 1 and base.dtype == np.float64 and base.flags.c_contiguous:
        first = _address(base)
        if all(each.base is base and each.flags.c_contiguous for each in arrays):
            return base, np.array([(_address(each) - first) // 8 for each in arrays], dtype=np.int64)
    sizes = np.array([each.size for each in arrays], dtype=np.int64)
    return np.concatenate([np.ravel(each) for each in arrays] or [np.empty(0)]), np.cumsum(sizes) - sizes


def _address(array: FloatArray) -> int:
    """Where it begins in memory; ``array.ctypes.data`` takes ten times as long."""
    return int(array.__array_interface__["data"][0])


def _is_by_rows(array: FloatArray) -> bool:
    """Whether observations are next to each other, and rows equally far apart."""
    if array.strides[-1] != array.itemsize or array.strides[-2] % array.itemsize:
        return False
    return array.ndim == 2 or array.strides[0] == array.shape[1] * array.strides[1]


def _check(name: str, array: FloatArray | IntArray | Int32Array, shape: tuple[int, ...]) -> None:
    if array.shape != shape:
        raise ValueError(f"{name} of shape {array.shape}, not {shape}")
