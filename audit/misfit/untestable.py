"""Which images have too few points for every test? Asked of many at once: then nothing else of a test is needed."""

from __future__ import annotations

from typing import Final

import numpy as np

from sfm_audit.audit.misfit import basis
from sfm_audit.audit.misfit.fields import GROUP_COLUMNS
from sfm_audit.audit.misfit.outcome import MIN_CLUSTERS_PER_RANK, MisfitTest, MisfitTests, not_tested, refusal
from sfm_audit.audit.table.words import GROUPS, MisfitGroup, MisfitStatus
from sfm_audit.loaders.arrays import FloatArray, IntArray

MAX_POINTS: Final = 2 * MIN_CLUSTERS_PER_RANK - 1
"""With more points than these, a group of two fields can be tested."""


def untestable_tests(nuisance: FloatArray, fields: FloatArray, num_clusters: IntArray) -> list[MisfitTests | None]:
    """Return the score tests of B images in which no group can be tested; None where `prepare` has to say.

    Parameters
    ----------
    nuisance : (B, q, m) N of each image, from `nuisance_columns`
    fields : (B, 42, m) E of each, from `candidate_fields`        num_clusters : (B,) observations that count

    Notes
    -----
    The ranks are those of `prepare` along its Gram path. Where that leaves a rank in doubt, where a derivative is zero
    or out of range, and where some group can be tested, the answer is None.
    """
    out: list[MisfitTests | None] = [None] * len(nuisance)
    if not fields.shape[1] or nuisance.shape[2] > 2 * MAX_POINTS:
        return out
    with np.errstate(over="ignore", invalid="ignore"):  # beyond range is not usual
        chosen, q = basis.nuisance_bases(nuisance)
        sq_lengths = np.einsum("bcm,bcm->bc", fields, fields)
    usual = basis.in_range(sq_lengths, basis.MODEST_SQUARE)[chosen]
    chosen, q = chosen[usual], q[usual]
    ranks = _ranks_of_groups(q, fields[chosen], sq_lengths[chosen])
    known: dict[tuple[tuple[int | None, ...], int], MisfitTests | None] = {}
    for b, of_groups in zip(chosen.tolist(), ranks, strict=True):
        key = of_groups, int(num_clusters[b])
        if key not in known:
            known[key] = _refused(*key)
        refused = known[key]
        out[b] = None if refused is None else dict(refused)
    return out


def _ranks_of_groups(q: FloatArray, fields: FloatArray, sq_lengths: FloatArray) -> list[tuple[int | None, ...]]:
    """By image the rank of each group off Q: None where too few values are free, -1 where it is in doubt."""
    num_free = q.shape[2] - q.shape[1]
    by_group: list[list[int | None]] = []
    for columns in GROUP_COLUMNS.values():
        if num_free < columns.stop - columns.start:
            by_group.append([None] * len(q))
            continue
        own = fields[:, columns]
        left = (own - (own @ q.swapaxes(1, 2)) @ q) / np.sqrt(sq_lengths[:, columns])[:, :, None]
        values = np.linalg.eigvalsh(left @ left.swapaxes(1, 2))
        sure, null = basis.SURE_FIELD * values.shape[1], basis.SURE_NULL  # the trace of unit columns is their number
        doubtful = ((values <= sure) & (values > null)).any(axis=1)
        by_group.append(np.where(doubtful, -1, (values > sure).sum(axis=1)).tolist())
    return list(zip(*by_group, strict=True))


def _refused(ranks: tuple[int | None, ...], num_clusters: int) -> MisfitTests | None:
    """Why each group is not tested; None where one may be."""
    out: dict[MisfitGroup, MisfitTest] = {}
    for group, rank in zip(GROUP_COLUMNS, ranks, strict=True):
        test = not_tested(MisfitStatus.NOT_ENOUGH_EVIDENCE) if rank is None else refusal(rank, num_clusters)
        if test is None or rank == -1:
            return None
        out[group] = test
    return {group: out[group] for group in GROUPS}
