"""Do two groups of images look at the same place, and each sees points of its own? So a folded model looks.

Opposite sides of a symmetric building are put on top of each other: what looks the same is merged, what tells the sides
apart is seen by one side alone, although images of the other side stand beside it. Two images that stand beside each
other see the same points less often where they are of different sides than where they are of the same one.

The model alone cannot tell that from other reasons to see different points: day and night, a loop that the matcher did
not close, leaves. So this is a remark with the two groups, no verdict (docs/witnesses.md has its rates).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy import sparse
from scipy.linalg import eigh

from sfm_audit.audit.kernels import witnesses as kernels
from sfm_audit.audit.witnesses.evidence import ColumnValues, Evidence, WitnessReport
from sfm_audit.audit.witnesses.looks_together import sums_of_pairs
from sfm_audit.audit.witnesses.should_see import MAX_ANGLE_DEG, MAX_DISTANCE_RATIO, ShouldSee, should_see
from sfm_audit.loaders.arrays import BoolArray, FloatArray, IntArray
from sfm_audit.loaders.model import Finding, FindingCode

MIN_IMAGES: Final = 12
MAX_IMAGES: Final = 2000
"""Pairs of images are held as a full matrix; above that nothing is asked."""
MIN_POINTS: Final = 500
MIN_SCORE: Final = 0.15
"""Share of common points that images of different groups lack, from which the model is remarked on."""
MIN_MIXED: Final = 0.7
"""Close pairs across the groups / those that groups scattered at random would have."""
_MIN_GROUP: Final = 3
_MIN_EITHER: Final = 8  # points that either of two images sees and both should
_NUM_SPLITS: Final = 3
_KNOWN: Final = 1e-6
"""Smaller parts of an eigenvector, and smaller distances between eigenvalues, of the largest are taken for rounding."""
_FULL_BELOW: Final = 20.0  # entries of full matrices per pair of looks at a point
_FULL_AT_ONCE: Final = 1 << 21  # numbers: 16 MB
_STEP_DEG: Final = 1.0  # pairs are compared with pairs of the same angle
_MIN_PAIRS: Final = 4  # in such a step, in either group, and half as many across


@dataclass(frozen=True, slots=True, eq=False)
class Fold:
    """Two groups of images that look at the same place and see less of the same than others so close.

    score: 1 - common points of close pairs across the groups / those of pairs within them, at the same angles.
    mixed: close pairs across / those of groups scattered at random.    group: (I,) 1 the larger, 2, 0 neither.
    """

    score: float
    mixed: float
    group: IntArray

    @property
    def is_remarkable(self) -> bool:
        """Whether the model is remarked on."""
        return self.score > MIN_SCORE and self.mixed > MIN_MIXED


@dataclass(frozen=True, slots=True, eq=False)
class PairSums:
    """What pairs of images have in common, summed over the points that both should see; (k,) each.

    first, second: rows of the images, first < second.    num: points.    both, either: seen by both, by either.
    cosine: between their rays.    log_ratio: of their distances, first over second.
    rest: product of what they see beyond what a point is seen on average.    own_rest: (I,) its square, by image.
    """

    first: IntArray
    second: IntArray
    num: FloatArray
    both: FloatArray
    either: FloatArray
    cosine: FloatArray
    log_ratio: FloatArray
    rest: FloatArray
    own_rest: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class ClosePairs:
    """Pairs of images (k,) that are close enough to see the same: points that both or either see and both should.

    step: the angle between them, in steps.
    """

    first: IntArray
    second: IntArray
    both: FloatArray
    either: FloatArray
    step: IntArray

    def of_those(self, kept: BoolArray) -> ClosePairs:
        """Return the pairs of a mask (k,)."""
        return ClosePairs(self.first[kept], self.second[kept], self.both[kept], self.either[kept], self.step[kept])


def ask_fold(evidence: Evidence) -> WitnessReport | None:
    """Report the two groups of every model that is large enough, and a finding where they are remarkable."""
    num_images = len(evidence.model.images)
    if not MIN_IMAGES <= num_images <= MAX_IMAGES:
        return None
    found = find_fold(should_see(evidence.model, evidence.residuals, seen_by=evidence.turned[0]))
    if found is None:
        return None
    group = tuple(int(g) if g else None for g in found.group)
    columns: dict[str, ColumnValues] = {"fold_score": np.full(num_images, found.score), "fold_group": group}
    return WitnessReport(None, columns=columns, findings=tuple(_findings(found)))


def _findings(found: Fold) -> Iterator[Finding]:
    if found.is_remarkable:
        sizes = [int(np.count_nonzero(found.group == k)) for k in (1, 2)]
        text = (
            f"two groups of {sizes[0]} and {sizes[1]} images (fold_group) stand side by side and have "
            f"{found.score:.0%} fewer points in common than images so close within a group: missing matches, "
            "two times of day, or a fold"
        )
        yield Finding(FindingCode.POSSIBLE_FOLD, sizes[1], text)


def find_fold(seen: ShouldSee) -> Fold | None:
    """Return the two groups that have least in common for how close they are; None where none can be told apart."""
    if seen.num_points < MIN_POINTS:
        return None
    sums = pair_sums(seen)
    del seen  # of a large model as much as the matrix of its pairs
    pairs = _close_pairs(sums)
    found = [judged(split, pairs) for split in _splits(sums)]
    told = [fold for fold in found if fold is not None]
    return max(told, key=lambda fold: (fold.mixed > MIN_MIXED, fold.score), default=None)


def pair_sums(seen: ShouldSee) -> PairSums:
    """Compare all pairs of images over the points that both should see."""
    log_distance = np.log(seen.distance)
    sizes = seen.num_points, seen.num_images
    found = kernels.pair_sums(sizes, seen.point, seen.image, seen.sees, (seen.ray, log_distance))
    if found is not None:
        return PairSums(*found)
    num = np.bincount(seen.point, minlength=seen.num_points)
    num_products = float(num.astype(np.float64) @ num)
    if seen.num_points * float(seen.num_images) ** 2 > _FULL_BELOW * num_products:
        return PairSums(*sums_of_pairs(seen, log_distance, num))
    return _sums_in_full(seen, log_distance, num)


def _sums_in_full(seen: ShouldSee, log_distance: FloatArray, num: IntArray) -> PairSums:
    """`pair_sums` by products of full matrices, which are faster where most images look at the same place."""
    rate = np.bincount(seen.point, seen.sees, minlength=seen.num_points) / np.maximum(num, 1)
    should, sees = seen.matrix(np.ones(len(seen.point))), seen.matrix(seen.sees)
    together = crossed(should, should)
    first, second = np.nonzero(np.triu(together, 1))

    def of_pairs(left: sparse.csr_array, right: sparse.csr_array) -> FloatArray:
        return np.asarray(crossed(left, right)[first, second])

    both = of_pairs(sees, sees)
    half = crossed(sees, should)
    either = half[first, second] + half[second, first] - both
    cosine = np.sum([of_pairs(ray, ray) for ray in map(seen.matrix, seen.ray)], axis=0)
    logs = crossed(seen.matrix(log_distance), should)
    rest = seen.matrix(seen.sees - rate[seen.point])
    rests = crossed(rest, rest)
    return PairSums(
        first,
        second,
        together[first, second],
        both,
        either,
        cosine,
        logs[first, second] - logs[second, first],
        rests[first, second],
        np.diag(rests).copy(),
    )


def _splits(sums: PairSums) -> Iterator[IntArray]:
    """Yield sides (I,) 1, -1, 0 by the leading eigenvectors of the co-detection of images, given who should see."""
    size = np.sqrt(np.maximum(sums.own_rest, np.finfo(float).tiny))
    together = np.zeros((len(size), len(size)))
    together[sums.first, sums.second] = sums.rest / (size[sums.first] * size[sums.second])
    together[sums.second, sums.first] = together[sums.first, sums.second]
    yield from sides(*_leading(together))


def sides(values: FloatArray, vectors: FloatArray) -> Iterator[IntArray]:
    """Yield the signs of those vectors that are no arbitrary ones of an eigenspace, 0 where a sign would be rounding.

    An eigenvector of a long strip of images lies in a part of it and falls off exponentially: far away it is made of
    rounding errors, whose signs are those of the processor and of the order of images.
    """
    apart = -np.diff(values) > _KNOWN * values[0]
    for k in range(_NUM_SPLITS):
        if apart[k] and (k == 0 or apart[k - 1]):
            vector = vectors[:, k]
            known = np.abs(vector) > _KNOWN * np.abs(vector).max()
            yield np.where(known, np.sign(vector), 0.0).astype(np.int64)


def crossed(left: sparse.csr_array, right: sparse.csr_array) -> FloatArray:
    """Return left^T right (I, I) of two (P, I), as full matrices, some points at a time."""
    num_points, num_images = left.shape
    out = np.zeros((num_images, num_images))
    step = max(1, _FULL_AT_ONCE // max(num_images, 1))
    for start in range(0, num_points, step):
        out += left[start : start + step].toarray().T @ right[start : start + step].toarray()
    return out


def _leading(symmetric: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the largest eigenvalues (_NUM_SPLITS + 1,), largest first, and their vectors (n, _NUM_SPLITS + 1).

    The matrix is written over.
    """
    n = len(symmetric)
    values, vectors = eigh(
        symmetric.T, subset_by_index=(n - _NUM_SPLITS - 1, n - 1), overwrite_a=True
    )  # LAPACK's order
    return values[::-1], vectors[:, ::-1]


def _close_pairs(sums: PairSums) -> ClosePairs:
    """Choose the pairs that look in one direction from one distance."""
    num = np.maximum(sums.num, 1.0)
    angle = np.degrees(np.arccos(np.clip(sums.cosine / num, -1.0, 1.0)))
    close = (sums.either >= _MIN_EITHER) & (angle < MAX_ANGLE_DEG)
    close &= np.abs(sums.log_ratio) < np.log(MAX_DISTANCE_RATIO) * num
    step = (angle[close] / _STEP_DEG).astype(np.int64)
    return ClosePairs(sums.first[close], sums.second[close], sums.both[close], sums.either[close], step)


def judged(side: IntArray, pairs: ClosePairs) -> Fold | None:
    """Measure how much less two groups see of the same; None where they are hardly beside each other."""
    pairs = pairs.of_those((side[pairs.first] != 0) & (side[pairs.second] != 0))
    takes_part = np.union1d(pairs.first, pairs.second)
    sides = side[takes_part]
    num = np.count_nonzero(sides > 0), np.count_nonzero(sides < 0)
    if min(num) < _MIN_GROUP:
        return None
    larger = sides[0] if num[0] == num[1] else 1 if num[0] > num[1] else -1  # as many: that of the first image
    group = np.zeros(len(side), dtype=np.int64)
    group[takes_part] = np.where(sides == larger, 1, 2)
    across = side[pairs.first] != side[pairs.second]
    missing = expected = num_across = 0.0
    for step in range(int(MAX_ANGLE_DEG / _STEP_DEG)):
        here = pairs.step == step
        cross, within = here & across, here & ~across
        if 2 * np.count_nonzero(cross) >= _MIN_PAIRS // 2 and 2 * np.count_nonzero(within) >= _MIN_PAIRS:
            share = pairs.both[within].sum() / pairs.either[within].sum()
            expected += 2 * share * pairs.either[cross].sum()
            missing += 2 * (share * pairs.either[cross].sum() - pairs.both[cross].sum())
            num_across += 2 * np.count_nonzero(cross)
    if expected <= 0:
        return None
    first = max(num) / sum(num)
    at_random = 2 * first * (1 - first) * 2 * len(pairs.step)
    return Fold(float(missing / expected), float(num_across / at_random), group)
