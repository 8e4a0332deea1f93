"""Who sees which point, who should, and what pairs of images have in common: witnesses.c."""

from __future__ import annotations

from typing import Final, TypeAlias

import numpy as np

from sfm_audit.audit.kernels.checked import small_ints
from sfm_audit.audit.kernels.library import Bytes, Double, Doubles, Ints, Size, SmallInts, kernel
from sfm_audit.loaders.arrays import BoolArray, FloatArray, IndexArray, Int32Array, IntArray

Pairs: TypeAlias = tuple[IntArray, IntArray, IntArray]
Looks: TypeAlias = tuple[IntArray, IntArray, BoolArray, FloatArray, FloatArray]
Turned: TypeAlias = tuple[IntArray, Int32Array]
_NUM_SUMS: Final = 6
_PER_IMAGE: Final = 64  # pairs that are expected
_PER_SIGHT: Final = 4  # images that should see a point, for each that does
_TOO_MANY: Final = 1 << 30


def shared_points(offsets: IntArray, point_idx: IndexArray, num_points: int) -> tuple[Turned, Pairs] | None:
    """Return which images see each point, and how many points pairs of images share; None for the numpy path.

    Parameters
    ----------
    offsets, point_idx : (I + 1,), (n,) the points that images see, as often as they do

    Returns
    -------
    Turned
        offsets (P + 1,), images (k,), ascending
    Pairs
        first < second, number (m,)
    """
    run = kernel("witness_shared", Size, Size, Ints, SmallInts, Ints, SmallInts, Size, Ints, Ints, Ints)
    num_images = len(offsets) - 1
    if run is None or not _in_range(point_idx, num_points) or not _are_offsets(offsets, len(point_idx)):
        return None
    if max(num_images, len(point_idx)) >= _TOO_MANY:
        return None
    rows = small_ints(point_idx, len(point_idx))
    seen_offsets, images = np.empty(num_points + 1, dtype=np.int64), np.empty(len(point_idx), dtype=np.int32)
    capacity = _PER_IMAGE * num_images
    for _ in range(2):
        first, second, num_shared = (np.empty(capacity, dtype=np.int64) for _ in range(3))
        given = num_images, num_points, offsets, rows, seen_offsets, images
        num = run(*given, capacity, first, second, num_shared)
        if num < 0:
            return None
        if num <= capacity:
            break
        capacity = num
    return (seen_offsets, images[: seen_offsets[-1]]), (first[:num], second[:num], num_shared[:num])


def cuts(first: IntArray, second: IntArray, num: int) -> tuple[IntArray, BoolArray] | None:
    """Return bridges (b, 2), smaller vertex first, and which vertices (num,) are articulations; None for numpy.

    Parameters
    ----------
    first, second : (k,) the vertices that each edge joins
    """
    run = kernel("witness_cuts", Size, Ints, Ints, Ints, Bytes)
    if run is None or not _in_range(first, num) or not _in_range(second, num):
        return None
    starts = np.concatenate([first, second])
    neighbour = np.concatenate([second, first])[np.argsort(starts, kind="stable")]
    offsets = _offsets(np.bincount(starts, minlength=num))
    bridges, articulation = np.empty((num, 2), dtype=np.int64), np.empty(num, dtype=np.uint8)
    found = run(num, offsets, neighbour, bridges, articulation)
    return None if found < 0 else (bridges[:found], articulation.astype(np.bool_))


def should_see(
    seen: tuple[FloatArray, IntArray, IntArray, FloatArray, FloatArray],
    views: tuple[FloatArray, FloatArray, FloatArray, FloatArray, BoolArray],
    limits: tuple[float, float, float],
) -> Looks | None:
    """Return point, image, sees, ray (3, m), distance of the pairs (m,) of `should_see.ShouldSee`; None for numpy.

    Parameters
    ----------
    seen : xyz (3, p); by point offsets (p + 1,), and of these observations image (n,), ray (3, n), distance (n,)
    views : rotation (I, 3, 3), centre (I, 3), share (I,) of the depth per px, size (I, 2) px, usable (I,)
    limits : reach, ratio of distances, cosine
    """
    types = (Size, Size, Doubles, Ints, Ints, Doubles, Doubles, Bytes, Doubles, Doubles, Doubles)
    run = kernel("witness_should_see", *types, Double, Double, Double, Size, Ints, Ints, Bytes, Doubles, Doubles)
    (xyz, offsets, image, ray, distance), (rotation, centre, share, size, usable) = seen, views
    if run is None or not _in_range(image, len(centre)) or not _are_offsets(offsets, len(image)):
        return None
    given = len(centre), xyz.shape[1], *map(np.ascontiguousarray, (xyz, offsets, image, ray, distance))
    poses = usable.view(np.uint8), rotation.reshape(-1, 9), centre, np.column_stack([share, size])
    capacity = _PER_SIGHT * len(image)
    for _ in range(2):
        points, images = (np.empty(capacity, dtype=np.int64) for _ in range(2))
        sees, rays, distances = np.empty(capacity, dtype=np.uint8), np.empty((capacity, 3)), np.empty(capacity)
        num = run(*given, *poses, *limits, capacity, points, images, sees, rays, distances)
        if num < 0:
            return None
        if num <= capacity:
            break
        capacity = num
    return points[:num], images[:num], sees[:num].view(np.bool_), rays[:num].T, distances[:num]


def pair_sums(
    sizes: tuple[int, int],
    point: IntArray,
    image: IntArray,
    sees: BoolArray,
    of_views: tuple[FloatArray, FloatArray],
) -> (
    tuple[IntArray, IntArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray] | None
):
    """Return what `fold.PairSums` holds; None for the numpy path.

    Parameters
    ----------
    sizes : numbers of points and images        point, image, sees : (m,) as of `should_see.ShouldSee`, image by image
    of_views : their rays (3, m), best those of an image beside each other, and logarithms of their distances (m,)
    """
    types = (Size, Size, Size, Ints, Ints, Bytes, Doubles, Doubles, SmallInts, Size, Ints, Ints, Doubles, Doubles)
    run = kernel("witness_pair_sums", *types)
    (num_points, num_images), (ray, log_distance) = sizes, of_views
    if run is None or not _in_range(point, num_points) or not _in_range(image, num_images):
        return None
    of_points = np.bincount(point, minlength=num_points)
    capacity = int(min(num_images * (num_images - 1) // 2, (of_points * (of_points - 1) // 2).sum()))
    first, second = (np.empty(capacity, dtype=np.int64) for _ in range(2))
    sums, own_rest = np.empty((capacity, _NUM_SUMS)), np.zeros(num_images)
    number = np.zeros((num_images, num_images), dtype=np.int32)
    given = _ints(point), _ints(image), sees.view(np.uint8), np.ascontiguousarray(ray.T), log_distance
    num = run(num_images, num_points, len(point), *given, number, capacity, first, second, sums, own_rest)
    if num < 0:
        return None
    columns = sums[:num].T
    return first[:num], second[:num], columns[0], columns[1], columns[2], columns[3], columns[4], columns[5], own_rest


def _in_range(idx: IntArray | Int32Array, end: int) -> bool:
    return not idx.size or bool(idx.min() >= 0 and idx.max() < end)


def _are_offsets(offsets: IntArray, end: int) -> bool:
    return bool(offsets[0] == 0 and offsets[-1] == end and (np.diff(offsets) >= 0).all())


def _ints(values: IntArray | Int32Array) -> IntArray:
    """Whole numbers as the kernels take them."""
    return np.ascontiguousarray(values, dtype=np.int64)


def _offsets(counts: IntArray) -> IntArray:
    return np.concatenate([[0], np.cumsum(counts)])
