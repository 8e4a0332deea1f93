"""What some images of a model say of their cameras, as the model stands."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from typing import Final

import numpy as np

from sfm_audit.audit.camera_quality.coverage import Spread, covered, sizes_of, spread_of
from sfm_audit.audit.camera_quality.expected_error import medians_of
from sfm_audit.audit.camera_quality.identifiability import unit_triangle
from sfm_audit.audit.camera_quality.joined import sums_of_joined
from sfm_audit.audit.camera_quality.measure import (
    CameraQuality,
    CameraShape,
    PointSums,
    image_sums,
    image_sums_in_parts,
    qualities_of,
)
from sfm_audit.audit.inliers.joined import MAX_JOINED, joined_inliers
from sfm_audit.audit.inliers.projected import image_inliers
from sfm_audit.audit.inliers.residuals import ModelResiduals
from sfm_audit.audit.kernels.spread import Inliers, image_spread
from sfm_audit.audit.misfit import MisfitTests, nuisance_columns
from sfm_audit.audit.misfit.images import misfit_of_images
from sfm_audit.audit.misfit.in_parts import AT_ONCE
from sfm_audit.audit.misfit.significance import UNTESTED, Significance
from sfm_audit.audit.misfit.sums import ModelSums
from sfm_audit.loaders.arrays import BoolArray, FloatArray, IntArray
from sfm_audit.loaders.model import CameraRecord, SparseModel, moved

_MAX_POINTS_AT_ONCE: Final = 4096
_POINTS_IN_A_TURN: Final = 1 << 18
_SUSPECT_FROM: Final = 0.5  # of the effect that an image is included from: its points have taken up a part


def suspects_of(qualities: Sequence[CameraQuality | None], alpha: float, included_from_px: FloatArray) -> BoolArray:
    """Return the images (I,) whose camera does not explain their points, taken as given: who may be wrong.

    Parameters
    ----------
    included_from_px : (I,) the effect from which the joint test includes an image, NaN never

    Notes
    -----
    Such an image may be wrong, or a neighbour of a wrong one, which its points follow: this rejects nobody.
    """
    found = Significance.of([UNTESTED if each is None else each.misfit for each in qualities])
    is_large = found.px > _SUSPECT_FROM * included_from_px[:, None]
    return np.asarray(((found.q < alpha) & is_large).any(axis=1))


def quality_of_images(
    model: SparseModel, residuals: ModelResiduals, sigma_px: FloatArray, image_idxs: Iterable[int], *, grid: int
) -> list[CameraQuality | None]:
    """Return what each of some images says of its camera, None without inliers.

    Parameters
    ----------
    sigma_px : (I,) sigma_constant_px        grid : of occupied_cells

    Notes
    -----
    What depends on a camera alone is computed once for all of these images.
    """
    images = list(image_idxs)
    out: list[CameraQuality | None] = [None] * len(images)
    shapes = _shapes_of(model, images)
    by_image = [shapes.get(int(model.images.camera_idx[image_idx])) for image_idx in images]
    num_inliers = np.diff(residuals.offsets)[images]
    asked = [place for place, shape in enumerate(by_image) if num_inliers[place] and shape is not None]
    source = ModelSums(model, residuals)
    for places in _in_turns(asked, num_inliers):
        own, of_images = [images[place] for place in places], [shape for place in places if (shape := by_image[place])]
        seen, depth = spread_of_images([shape.camera for shape in of_images], model, residuals, own, grid)
        misfits, sums = _sums_of(of_images, source, own, depth)
        for place, quality in zip(places, qualities_of(of_images, misfits, sums, seen, sigma_px[own]), strict=True):
            out[place] = quality
    return out


def _in_turns(places: Sequence[int], num_inliers: IntArray) -> Iterator[list[int]]:
    """Yield places of images whose columns are in memory together."""
    turn, num_points = [], 0
    for place in places:
        turn.append(place)
        num_points += int(num_inliers[place])
        if num_points >= _POINTS_IN_A_TURN:
            yield turn
            turn, num_points = [], 0
    if turn:
        yield turn


def _shapes_of(model: SparseModel, image_idxs: Sequence[int]) -> dict[int, CameraShape | None]:
    """By row of the camera table, of the cameras of some images."""
    used = np.unique(model.images.camera_idx[np.array(image_idxs, dtype=np.int64)])
    rows = used[(used >= 0) & (used < len(model.cameras))].tolist()
    return dict(zip(rows, CameraShape.of_all([model.camera(row) for row in rows]), strict=True))


def _sums_of(
    shapes: Sequence[CameraShape], source: ModelSums, image_idxs: Sequence[int], depth: FloatArray
) -> tuple[list[MisfitTests], list[PointSums]]:
    """What the inliers of images, with their cameras' shapes and depths, add up to; of small images together."""
    alike: dict[tuple[int, int], list[int]] = {}
    out: dict[int, tuple[MisfitTests, PointSums]] = {}
    model, residuals = source.model, source.residuals
    tested = misfit_of_images(source, [i for i in image_idxs if source.num_of(i) > MAX_JOINED])
    for place, (shape, image_idx) in enumerate(zip(shapes, image_idxs, strict=True)):
        rows = residuals.rows(image_idx)
        num_inliers = rows.stop - rows.start
        if num_inliers <= MAX_JOINED:
            alike.setdefault((int(model.images.camera_idx[image_idx]), num_inliers), []).append(place)
        elif image_idx in tested:
            triangle, far = partial(_triangle_of, model, residuals, image_idx), float(depth[place])
            tests, gram, known = tested[image_idx]
            out[place] = tests, PointSums(gram, 2 * num_inliers, far, triangle, known)
        elif num_inliers <= AT_ONCE:
            out[place] = image_sums(shape.camera, image_inliers(model, residuals, image_idx))
        else:
            xy_px = model.observations.xy_px.take(residuals.observation_row[rows], axis=0)
            out[place] = image_sums_in_parts(shape.camera, partial(image_inliers, model, residuals, image_idx), xy_px)
    for (_, num_inliers), places in alike.items():
        step = _MAX_POINTS_AT_ONCE // num_inliers
        for part in (places[start : start + step] for start in range(0, len(places), step)):
            joined = joined_inliers(model, residuals, [image_idxs[place] for place in part], num_inliers)
            out.update(zip(part, sums_of_joined(shapes[part[0]].camera, joined, len(part)), strict=True))
    return [out[place][0] for place in range(len(out))], [out[place][1] for place in range(len(out))]


def _triangle_of(model: SparseModel, residuals: ModelResiduals, image_idx: int, norms: FloatArray) -> FloatArray:
    """`unit_triangle` of an image's columns."""
    own = image_inliers(model, residuals, image_idx)
    columns = nuisance_columns(own.camera.model, own.projected)
    return unit_triangle(columns.reshape(len(columns), -1), norms)


def spread_of_images(
    cameras: Sequence[CameraRecord],
    model: SparseModel,
    residuals: ModelResiduals,
    image_idxs: Sequence[int],
    grid: int,
) -> tuple[Spread, FloatArray]:
    """Return how far the inliers of images spread, whose cameras are given, and their median Zc (B,), model units."""
    own, size_px = np.array(image_idxs, dtype=np.int64), sizes_of(cameras)
    observed = residuals.observation_row, residuals.point_idx, model.observations.xy_px, model.points.xyz_world
    poses = model.images.quat_cam_from_world_wxyz, model.images.translation_cam_from_world
    lie = image_spread(Inliers(residuals.offsets, *observed, *poses), own, size_px, grid)
    if lie is not None:
        return Spread(covered(lie.hull_px2, size_px), lie.occupied_cells), lie.median_depth
    first, last = residuals.offsets[own], residuals.offsets[own + 1]
    offsets: IntArray = np.concatenate([[0], np.cumsum(last - first)])
    columns = np.repeat(first - offsets[:-1], last - first) + np.arange(offsets[-1])
    xy_px = model.observations.xy_px.take(residuals.observation_row[columns], axis=0)
    quats, shifts = (np.repeat(each[own], last - first, axis=0).T for each in poses)
    xyz_world = model.points.xyz_world.take(residuals.point_idx[columns], axis=0)
    return spread_of(xy_px, offsets, cameras, grid), medians_of(moved(quats, shifts, xyz_world)[:, 2], offsets)
