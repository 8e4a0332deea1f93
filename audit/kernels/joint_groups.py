"""Tests of groups of candidate fields of many images, from the sums of their functions: `joint_groups.c`."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from sfm_audit.audit.kernels.checked import doubles, ints
from sfm_audit.audit.kernels.joint import DENSE, DONE, FIELDS, SCALAR
from sfm_audit.audit.kernels.joint_scores import Scores
from sfm_audit.audit.kernels.library import Double, Doubles, Ints, Size, kernel
from sfm_audit.loaders.arrays import BoolArray, FloatArray, IntArray

_TERMS: Final = 2
_MOST_FIELDS: Final = 32


class Fields(NamedTuple):
    """Of what the fields of k images are made, and to which groups they belong.

    term: (f, 2) functions of each, -1 none.    factor: (k, f, 2) of each function.
    ends: (g + 1,) fields ends[i]:ends[i + 1] are of group i; those behind are tested by nobody.
    with_rest: (k,) whether these are asked for.
    """

    term: IntArray
    factor: FloatArray
    ends: IntArray
    with_rest: BoolArray


class GroupLimits(NamedTuple):
    """Where numpy says what group tests say; see `sfm_audit.audit.joint.group_test`.

    left_of_terms: share of its functions' squared lengths that a field has at least.
    kept_eigenvalue: of K with unit columns.    singular: smallest squared pivot of the meat with unit diagonal.
    tracks_per_rank: that a test needs; without them there is no statistic.
    """

    left_of_terms: float
    kept_eigenvalue: float
    singular: float
    tracks_per_rank: int


class GroupNumbers(NamedTuple):
    """What the tests of g groups of k images are made of; C columns of an image, r fields behind the groups.

    done: (k,) whether the rest holds.    statistic, gain, rank: (k, g).
    change: (k, g, C) of an image's own columns, were the group admitted.
    rest_square, rest_score: (k, r) and rest_gram, rest_meat: (k, r, r) of the fields that belong to no group; where
    these were asked for.
    """

    done: BoolArray
    statistic: FloatArray
    gain: FloatArray
    rank: IntArray
    change: FloatArray
    rest_square: FloatArray
    rest_score: FloatArray
    rest_gram: FloatArray
    rest_meat: FloatArray


def group_numbers(sums: Scores, fields: Fields, limits: GroupLimits) -> GroupNumbers | None:
    """Return the numbers of the tests of all groups; None without kernels."""
    function = kernel("joint_group_tests", *_ARGUMENTS)
    if function is None:
        return None
    k, width = sums.solution.shape[:2]
    num, term, ends = len(fields.term), np.ascontiguousarray(fields.term, dtype=np.int64), fields.ends
    sizes = np.diff(ends)
    is_sound = (
        term.shape == (num, _TERMS)
        and (term >= -1).all()
        and (term < FIELDS).all()
        and (term[:, 0] >= 0).all()
        and ends[0] == 0
        and ends[-1] <= num
        and (sizes >= 0).all()
        and (sizes <= _MOST_FIELDS).all()
    )
    if not is_sound:
        raise ValueError("fields of other functions")
    groups, rest = len(sizes), num - int(ends[-1])
    status = np.where(sums.done, DONE, 1).astype(np.int64)
    statistic, gain = np.full((2, k, groups), np.nan)
    rank, change = np.zeros((k, groups), dtype=np.int64), np.zeros((k, groups, width))
    rest_square, rest_score = np.zeros((2, k, rest))
    rest_gram, rest_meat = np.zeros((2, k, rest, rest))
    given = (
        *(doubles(each, (k, FIELDS, FIELDS)) for each in (sums.gram, sums.meat)),
        doubles(sums.plain, (k, SCALAR, SCALAR)),
        doubles(sums.dense_plain, (k, DENSE)),
        doubles(sums.score, (k, FIELDS)),
        doubles(sums.solution, (k, width, FIELDS)),
    )
    made_of = num, term, doubles(fields.factor, (k, num, _TERMS)), groups, ints(ends, groups + 1)
    asked, tracks = ints(fields.with_rest.astype(np.int64), k), ints(sums.num_tracks, k)
    out = statistic, gain, rank, change, rest_square, rest_score, rest_gram, rest_meat
    if function(k, FIELDS, SCALAR, width, *given, *made_of, asked, tracks, *limits, status, *out) != DONE:
        return None
    return GroupNumbers(status == DONE, *out)


_ARGUMENTS: Final = (
    *([Size] * 4),
    *([Doubles] * 6),
    *(Size, Ints, Doubles, Size, Ints, Ints, Ints),
    *(Double, Double, Double, Size),
    *(Ints, Doubles, Doubles, Ints),
    *([Doubles] * 5),
)
