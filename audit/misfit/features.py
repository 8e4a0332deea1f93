"""What the candidate fields of an image are made of, and the sums over observations that the score tests need.

The 42 fields of `audit.misfit.fields` lie in the span of 40 *features* in the units of the test: radial (2) and
tangential (2) columns, rolling shutter (6), and 15 monomials of degree 0 to 4 of the predicted point, along x and along
y. The principal point's columns are the constant ones, the affine ones are the first monomials about another centre.
Monomials times monomials are moments, the same along x and y. `audit.kernels.misfit` sums up the same in C.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np

from sfm_audit.audit.inliers.projected import ImageInliers
from sfm_audit.audit.inliers.stationarity import pose_columns
from sfm_audit.audit.kernels.misfit import NUM_FEATURES
from sfm_audit.audit.misfit import basis
from sfm_audit.audit.misfit.fields import GROUP_COLUMNS, NUM_FIELDS, OWN_COEFFICIENTS
from sfm_audit.audit.misfit.nuisance import fitted_param_idxs
from sfm_audit.audit.table.words import MisfitGroup
from sfm_audit.loaders.arrays import FloatArray, IntArray
from sfm_audit.loaders.model import CameraRecord

NUM_MONOMIALS: Final = 15
LENS: Final = slice(0, 4)
SHUTTER: Final = slice(4, 10)
ALONG_X: Final = slice(10, 25)
ALONG_Y: Final = slice(25, 40)
_AFFINE: Final = GROUP_COLUMNS[MisfitGroup.AFFINE]


def _feature_of_field() -> IntArray:
    """(42,) the feature that each field is, in its own unit; of the affine ones the first monomials along x."""
    out = np.empty(NUM_FIELDS, dtype=np.int64)
    along_x, along_y = np.arange(ALONG_X.start, ALONG_X.stop), np.arange(ALONG_Y.start, ALONG_Y.stop)
    out[GROUP_COLUMNS[MisfitGroup.RADIAL]] = 0, 1
    out[GROUP_COLUMNS[MisfitGroup.TANGENTIAL]] = 2, 3
    out[_AFFINE] = along_x[1:3]
    out[GROUP_COLUMNS[MisfitGroup.PRINCIPAL_POINT]] = along_x[0], along_y[0]
    out[GROUP_COLUMNS[MisfitGroup.ROLLING_SHUTTER]] = np.arange(SHUTTER.start, SHUTTER.stop)
    out[GROUP_COLUMNS[MisfitGroup.SMOOTH]] = np.concatenate([along_x[1:], along_y[1:]])
    return out


FEATURE_OF_FIELD: Final = _feature_of_field()
FIELD_OF_FEATURE: Final = np.array(
    [max(np.flatnonzero(feature == FEATURE_OF_FIELD).tolist()) for feature in range(NUM_FEATURES)], dtype=np.int64
)
"""(40,) of the two fields that begin with the same monomial the smooth one, which is that monomial."""


class ImageFeatures(NamedTuple):
    """One image: rows (q + 11, 2, n), N, the residuals, lens (4) and rolling shutter (6); monomials (15, n)."""

    rows: FloatArray
    monomials: FloatArray

    @property
    def num_own(self) -> int:
        """Columns of N."""
        return len(self.rows) - 1 - SHUTTER.stop


def image_features(inliers: ImageInliers) -> ImageFeatures:
    """Return the features of the inliers of an image, of a camera that has fields."""
    camera, xy_px = inliers.camera, inliers.predicted_px
    q = 6 + len(fitted_param_idxs(camera.model))
    rows = np.empty((q + 1 + SHUTTER.stop, *xy_px.shape))
    rows[q] = inliers.residuals_px
    with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is left to `prepare`
        pose = pose_columns(inliers.jacobian_cam, inliers.xyz_cam, out=rows[:6])
        _fill_intrinsics(rows[6:q], camera, xy_px, inliers.d_extra)
        row = (xy_px[1] - 0.5 * camera.height) / camera.height
        np.multiply(pose, row, out=rows[q + 5 :])
        _fill_lens(rows[q + 1 : q + 5], camera, inliers.u, inliers.d_extra)
        return ImageFeatures(rows, _monomials(camera, xy_px))


def affine_offset(camera: CameraRecord) -> tuple[float, float]:
    """Return what of the constant feature the affine fields hold beside the first monomials in x and in y."""
    half = 0.5 * max(camera.width, camera.height)
    cx, cy = (float(camera.params[i]) for i in camera.model.principal_point_idxs)
    return (0.5 * camera.width - cx) / half, (0.5 * camera.height - cy) / half


def _fill_intrinsics(out: FloatArray, camera: CameraRecord, xy_px: FloatArray, d_extra: FloatArray) -> None:
    """Columns of `fitted_param_idxs`, as `nuisance_columns` takes them from the derivatives in all parameters."""
    model, params = camera.model, camera.params
    for place, idx in enumerate(fitted_param_idxs(model)):
        if idx in model.extra_idxs:
            out[place] = d_extra[model.extra_idxs.index(idx)]
            continue
        for axis, focal in enumerate((model.focal_idxs[0], model.focal_idxs[-1])):
            if focal == idx:  # x = f v + c
                np.divide(xy_px[axis] - params[model.principal_point_idxs[axis]], params[focal], out=out[place, axis])
            else:
                out[place, axis] = 0.0


def _fill_lens(out: FloatArray, camera: CameraRecord, u: FloatArray, d_extra: FloatArray) -> None:
    """Radial and tangential columns of `candidate_fields`, (4, 2, n)."""
    focals = camera.model.focal_idxs
    scale = np.array([[camera.params[focals[0]]], [camera.params[focals[-1]]]])
    square = u * u
    r2 = square[0] + square[1]
    np.multiply(u * scale, r2 * r2, out=out[0])
    np.multiply(out[0], r2, out=out[1])
    out[3, 1] = out[2, 0] = 2.0 * u[0] * u[1]
    out[2, 1] = r2 + 2.0 * square[1]
    out[3, 0] = r2 + 2.0 * square[0]
    out[2:] *= scale
    starts = {MisfitGroup.RADIAL: 0, MisfitGroup.TANGENTIAL: 2}
    for group, names in OWN_COEFFICIENTS.get(camera.model.name, {}).items():
        own = [camera.model.extra_idxs.index(camera.model.param_names.index(name)) for name in names]
        out[starts[group] : starts[group] + 2] = d_extra[own]


def _monomials(camera: CameraRecord, xy_px: FloatArray) -> FloatArray:
    """(15, n) of (predicted - (w, h) / 2) / (max(w, h) / 2): by degree, then by the power of y."""
    half = 0.5 * max(camera.width, camera.height)
    out = np.empty((NUM_MONOMIALS, xy_px.shape[1]))
    out[0] = 1.0
    np.divide(xy_px - np.array([[0.5 * camera.width], [0.5 * camera.height]]), half, out=out[1:3])
    x, y = out[1], out[2]
    for degree in range(2, 5):
        first = degree * (degree + 1) // 2
        above = out[first - degree : first]
        np.multiply(above, x, out=out[first : first + degree])
        np.multiply(above[-1], y, out=out[first + degree])
    return out


def sums_of(features: ImageFeatures) -> tuple[FloatArray, FloatArray]:
    """Return the Gram matrix (q + 40, q + 40) of N and the features, and their products with the residuals (q + 40,).

    Used are N with all, radial and tangential ones, rolling shutter, and monomials, each among themselves; the rest is
    zero here and there.
    """
    (rows, m), q = features, features.num_own
    lens_end, shutter_end = q + 5, q + 11
    flat = rows.reshape(len(rows), -1)
    along_x, along_y = rows[: q + 1, 0] @ m.T, rows[: q + 1, 1] @ m.T
    with_own, moments = flat[: q + 1] @ flat.T, _gram(m)
    gram = np.zeros((q + NUM_FEATURES, q + NUM_FEATURES))
    gram[:q, :q] = with_own[:q, :q]
    gram[:q, q : q + SHUTTER.stop] = with_own[:q, q + 1 :]
    gram[:q, q:][:, ALONG_X], gram[:q, q:][:, ALONG_Y] = along_x[:q], along_y[:q]
    gram[q:, :q] = gram[:q, q:].T
    of_features = gram[q:, q:]
    of_features[LENS, LENS] = _gram(flat[q + 1 : lens_end])
    of_features[SHUTTER, SHUTTER] = _gram(flat[lens_end:shutter_end])
    of_features[ALONG_X, ALONG_X] = of_features[ALONG_Y, ALONG_Y] = moments
    on_y = np.concatenate([with_own[q, :q], with_own[q, q + 1 :], along_x[q], along_y[q]])
    return gram, on_y


def packed(gram: FloatArray, on_y: FloatArray, num_own: int) -> FloatArray:
    """Return what `sums_of` says of B images, (B, q + 40, q + 40), (B, q + 40), without what is told twice: (B, m)."""
    row, column = _stored(num_own)
    return np.concatenate([gram[:, row, column], on_y], axis=1)


def unpacked(rows: FloatArray, num_own: int) -> tuple[FloatArray, FloatArray]:
    """Return what `packed` was given, to the last bit."""
    row, column = _stored(num_own)
    size = num_own + NUM_FEATURES
    gram = np.zeros((len(rows), size, size))
    gram[:, row, column] = gram[:, column, row] = rows[:, : len(row)]
    of_features = gram[:, num_own:, num_own:]
    of_features[:, ALONG_Y, ALONG_Y] = of_features[:, ALONG_X, ALONG_X]
    return gram, rows[:, len(row) :]


@lru_cache(maxsize=32)
def _stored(num_own: int) -> tuple[IntArray, IntArray]:
    """Rows and columns of a Gram matrix of `sums_of` that `packed` takes."""
    used = np.zeros((num_own + NUM_FEATURES,) * 2, dtype=np.bool_)
    used[:num_own] = True
    for block in (LENS, SHUTTER, ALONG_X):
        used[num_own:, num_own:][block, block] = True
    row, column = np.nonzero(np.triu(used))
    return row.astype(np.int64), column.astype(np.int64)


def _gram(rows: FloatArray) -> FloatArray:
    """Return rows @ rows.T of few, long rows: BLAS takes a general product in half the time of a symmetric one."""
    out = np.empty((len(rows), len(rows)))
    np.matmul(rows[1:], rows.T, out=out[1:])
    out[0, 1:], out[0, 0] = out[1:, 0], rows[0] @ rows[0]
    return out


def meat_of(scores: FloatArray, num_own: int) -> FloatArray:
    """Return the sum over observations of what `scores_of` (q + 40, n) says, times itself: (q + 40, q + 40).

    The same blocks as of `sums_of`, and monomials along x with those along y; the rest is zero.
    """
    out = np.zeros((len(scores), len(scores)))
    out[:num_own] = scores[:num_own] @ scores.T
    out[num_own:, :num_own] = out[:num_own, num_own:].T
    features, of_features = scores[num_own:], out[num_own:, num_own:]
    for block in (LENS, SHUTTER, ALONG_Y):
        of_features[block, block] = _gram(features[block])
    smooth = slice(ALONG_X.start, ALONG_Y.stop)
    of_features[ALONG_X, smooth] = features[ALONG_X] @ features[smooth].T
    of_features[ALONG_Y, ALONG_X] = of_features[ALONG_X, ALONG_Y].T
    return out


class Weights(NamedTuple):
    """left: (2, n) y - N c.    weights: (2, n) left / sqrt(1 - h).    leverage: the largest h."""

    left: FloatArray
    weights: FloatArray
    leverage: float


def weights_of(features: ImageFeatures, to_basis: FloatArray, on_y: FloatArray) -> Weights:
    """Return residuals off N, weighted by their leverage h, the squared length of what ``to_basis`` N says.

    Parameters
    ----------
    to_basis : (r, q)        on_y : (q,) c
    """
    q, n = features.num_own, features.rows.shape[2]
    flat, y = features.rows[:q].reshape(q, 2 * n), features.rows[q].reshape(2 * n)
    along = to_basis @ flat
    leverage = np.einsum("rm,rm->m", along, along)
    left = y - on_y @ flat
    weights = left / np.sqrt(1.0 - np.minimum(leverage, basis.MAX_LEVERAGE))
    return Weights(left.reshape(2, n), weights.reshape(2, n), float(leverage.max(initial=0.0)))


def mixed_of(features: ImageFeatures, mix: FloatArray, coefficients: FloatArray) -> FloatArray:
    """Return (28, 2, n) smooth fields, mixed and off N: monomials mix - N coefficients, mix (28, 28), (q, 28)."""
    q, half = features.num_own, NUM_MONOMIALS - 1
    out = np.empty((2 * half, 2, features.rows.shape[2]))
    for axis, own in enumerate((mix[:half], mix[half:])):
        out[:, axis] = own.T @ features.monomials[1:] - coefficients.T @ features.rows[:q, axis]
    return out


def scores_of(features: ImageFeatures, weights: FloatArray) -> FloatArray:
    """Return (q + 40, n): both rows of N and of each feature times weights (2, n), summed."""
    q = features.num_own
    out = np.empty((q + NUM_FEATURES, weights.shape[1]))
    of_features = out[q:]
    np.einsum("cin,in->cn", features.rows[:q], weights, out=out[:q])
    np.einsum("cin,in->cn", features.rows[q + 1 :], weights, out=of_features[: SHUTTER.stop])
    np.multiply(features.monomials, weights[0], out=of_features[ALONG_X])
    np.multiply(features.monomials, weights[1], out=of_features[ALONG_Y])
    return out


def widened(matrix: FloatArray, offset: FloatArray, num_own: int) -> FloatArray:
    """Return matrices of N and fields, (..., q + 42, q + 42), from those of N and features, with `affine_offset`s.

    Parameters
    ----------
    matrix : (B, q + 40, q + 40)        offset : (B, 2)
    """
    chosen = _chosen(num_own)
    out = matrix[:, chosen[:, None], chosen]
    affine, constant = _affine_and_constant(num_own)
    out[:, affine, :] += offset[:, :, None] * out[:, constant, None, :]
    out[:, :, affine] += offset[:, None, :] * out[:, :, constant, None]
    return np.asarray(out)


def widened_columns(columns: FloatArray, offset: FloatArray, num_own: int) -> FloatArray:
    """Return (B, q + 42) products of N and fields from (B, q + 40) of N and features."""
    out = columns[:, _chosen(num_own)]
    affine, constant = _affine_and_constant(num_own)
    out[:, affine] += offset * out[:, constant, None]
    return np.asarray(out)


def _chosen(num_own: int) -> IntArray:
    return np.concatenate([np.arange(num_own), num_own + FEATURE_OF_FIELD])


def _affine_and_constant(num_own: int) -> tuple[slice, int]:
    """Where the affine columns are, and the constant along x."""
    constant = num_own + GROUP_COLUMNS[MisfitGroup.PRINCIPAL_POINT].start
    return slice(num_own + _AFFINE.start, num_own + _AFFINE.stop), constant
