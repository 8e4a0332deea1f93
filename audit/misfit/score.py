"""Is the camera model wrong? The score test of one image (method.md section 5, steps 1 to 4)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from sfm_audit.audit.inliers.projected import project_image
from sfm_audit.audit.misfit import basis
from sfm_audit.audit.misfit.fields import GROUP_COLUMNS, candidate_fields
from sfm_audit.audit.misfit.nuisance import nuisance_columns
from sfm_audit.audit.misfit.outcome import MisfitTest, MisfitTests, judged_by_f, not_tested, refusal
from sfm_audit.audit.table.words import MisfitGroup, MisfitStatus
from sfm_audit.loaders.arrays import FloatArray, IntArray
from sfm_audit.loaders.model import CameraRecord

_NO_TRANSFORM: Final = np.empty((0, 0))


@dataclass(frozen=True, slots=True, eq=False)
class Clusters:
    """Observations that count as one in the meat; all others count by themselves.

    members: (k,) observations of clusters of two or more, by cluster.    starts: (c,) first member of each cluster.
    """

    members: IntArray
    starts: IntArray

    @classmethod
    def of(cls, clusters: IntArray | None) -> Clusters | None:
        """Take the number of each observation's cluster, (n,); None if each observation is its own."""
        if clusters is None:
            return None
        at = _alike(clusters)
        order = at[np.argsort(clusters[at], kind="stable")]
        is_start = np.diff(clusters[order], prepend=-1) != 0
        has_twin = ~is_start | ~np.append(is_start[1:], True)
        if not has_twin.any():
            return None
        return cls(order[has_twin], np.flatnonzero(is_start[has_twin]).astype(np.int64))

    @property
    def num_merged(self) -> int:
        """By how many the clusters are fewer than the observations."""
        return len(self.members) - len(self.starts)

    def merge(self, g: FloatArray) -> None:
        """Sum columns (c, n) over clusters, in place.

        A cluster's sum stands at its first member; the others are zero, which adds nothing to the meat.
        """
        sums = np.add.reduceat(g.take(self.members, axis=1), self.starts, axis=1)
        g[:, self.members] = 0.0
        g[:, self.members[self.starts]] = sums


def _alike(numbers: IntArray) -> IntArray:
    """Ascending rows of (n,) whose last 16 bits another row has too: twins, and few others; 16 bits are sorted fast."""
    bits = numbers.astype(np.uint16)
    order = np.argsort(bits, kind="stable")
    bits = bits[order]
    is_same = bits[1:] == bits[:-1]
    found = np.zeros(len(numbers), dtype=np.bool_)
    found[order[1:][is_same]] = found[order[:-1][is_same]] = True
    return np.flatnonzero(found).astype(np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class PreparedGroup:
    """A group's orthonormal fields are U = transform^T fields[columns]; ``refused`` where it cannot be tested.

    columns: of PreparedImage.fields.    transform: (c, r).
    """

    columns: slice
    transform: FloatArray
    refused: MisfitTest | None = None


@dataclass(frozen=True, slots=True, eq=False)
class PreparedImage:
    """What of the score test depends on the camera and the points alone; `test` then takes any residuals.

    nuisance_basis: (q', 2n) Q.                fields: (42, 2, n) candidate fields, projected off Q.
    inverse_root: (2, n) 1 / sqrt(1 - h).      clusters: None when every observation is its own.
    """

    nuisance_basis: FloatArray
    fields: FloatArray
    inverse_root: FloatArray
    groups: dict[MisfitGroup, PreparedGroup]
    clusters: Clusters | None = None

    @property
    def num_observations(self) -> int:
        """Observations per test."""
        return int(self.inverse_root.shape[1])

    @property
    def num_clusters(self) -> int:
        """Independent ones among them."""
        return self.num_observations - (0 if self.clusters is None else self.clusters.num_merged)

    def test(self, residuals_px: FloatArray) -> MisfitTests:
        """Test residuals (2, n), observed minus projected, px, of the points the image was prepared with.

        Steps 2 to 4. Costs a fifth of the preparation.
        """
        if all(group.refused for group in self.groups.values()):
            return {name: group.refused for name, group in self.groups.items() if group.refused}
        with np.errstate(over="ignore", invalid="ignore"):  # residuals beyond 1e150 px: the meat is singular
            return self._tests(residuals_px)

    def _tests(self, residuals_px: FloatArray) -> MisfitTests:
        y = basis.project_off(self.nuisance_basis, residuals_px.reshape(-1))
        scores = self.fields.reshape(len(self.fields), -1) @ y
        # both rows of each point of fields * y / sqrt(1 - h)
        g = np.asarray(np.einsum("cin,in->cn", self.fields, y.reshape(2, -1) * self.inverse_root))
        if self.clusters is not None:
            self.clusters.merge(g)
        transform, ranks = self._joined_transform()
        meat = transform.T @ (g @ g.T) @ transform  # M = sum_k g_k g_k^T, of each group on the diagonal
        judged = iter(judged_by_f(transform.T @ scores, meat, ranks, self.num_clusters, self.num_observations))
        return {name: group.refused or next(judged) for name, group in self.groups.items()}

    def _joined_transform(self) -> tuple[FloatArray, list[int]]:
        """(42, R) transforms of the groups that can be tested, side by side, and their ranks."""
        tested = [group for group in self.groups.values() if group.refused is None]
        ranks = [group.transform.shape[1] for group in tested]
        out = np.zeros((len(self.fields), sum(ranks)))
        start = 0
        for group, rank in zip(tested, ranks, strict=True):
            out[group.columns, start : start + rank] = group.transform
            start += rank
        return out, ranks

    def explained_px(self, residuals_px: FloatArray, group: MisfitGroup) -> FloatArray:
        """Return (2, n) px, U U^T y: the group's share of the residuals, NaN where it is not tested.

        Its RMS length contains the noise that r directions explain anyway; ``MisfitTest.px`` is cleaned of it.
        """
        prepared = self.groups[group]
        if prepared.refused is not None:
            return np.full_like(residuals_px, math.nan)
        y = basis.project_off(self.nuisance_basis, residuals_px.reshape(-1))
        own = self.fields[prepared.columns].reshape(len(prepared.transform), -1)
        along = prepared.transform @ (prepared.transform.T @ (own @ y))
        return np.asarray((along @ own).reshape(residuals_px.shape))


def prepare_image(
    camera: CameraRecord,
    xyz_cam: FloatArray,
    *,
    param_idxs: tuple[int, ...] | None = None,
    clusters: IntArray | None = None,
) -> PreparedImage:
    """Prepare the score test of an image from its camera and its points (n, 3) in the camera frame.

    The cheapest way when nobody else needs the columns; see `nuisance_columns` and `prepare` for the rest.
    """
    projected = project_image(camera, xyz_cam)
    nuisance = nuisance_columns(camera.model, projected, param_idxs)
    return _prepare(nuisance, candidate_fields(camera, projected), clusters, exact=False)


def prepare(
    nuisance: FloatArray,
    fields: FloatArray,
    *,
    rows: IntArray | None = None,
    clusters: IntArray | None = None,
    exact: bool = False,
    overwrite_fields: bool = False,
) -> PreparedImage:
    """Do all of the score test that does not need the residuals.

    Parameters
    ----------
    nuisance : (q, 2, n) N, from `nuisance_columns`
    fields : (42, 2, n) E, from `candidate_fields`, or (0, 2, n) for spherical cameras
    rows : observations to use; all by default. Residuals and clusters are then those of these rows
    clusters : (n,) observations of equal number, >= 0, count as one in the meat; each counts by itself by default
    exact : never take the Gram path
    overwrite_fields : whether ``fields`` may be used as scratch memory, which takes float64 in C order and no ``rows``

    Notes
    -----
    Step 1. H0: the residuals are independent between clusters and have mean zero off the span of N; their variance and
    shape are free. Blind to fields in the span of N, and to what the 3D points or the poses of other images absorbed.

    Any basis of the projected fields gives the same T; orthonormality matters only for px. An orthonormal basis comes
    from the Gram matrix unless that leaves a rank in doubt (points in a small part of the image, planar scenes).
    """
    if rows is not None:
        nuisance, fields = nuisance[:, :, rows], fields[:, :, rows]
    own = fields if overwrite_fields else np.array(fields, dtype=np.float64, order="C")
    return _prepare(nuisance, own, clusters, exact=exact)


def _prepare(nuisance: FloatArray, fields: FloatArray, clusters: IntArray | None, *, exact: bool) -> PreparedImage:
    """`prepare` in place of ``fields``."""
    n = fields.shape[2]
    clustered = Clusters.of(clusters)
    columns = basis.unit_columns(nuisance.reshape(len(nuisance), -1))
    status = MisfitStatus.TESTED
    if not len(fields):
        status = MisfitStatus.NO_FIELDS
    elif n == 0:
        status = MisfitStatus.NOT_ENOUGH_EVIDENCE
    elif not np.isfinite(columns).all():
        status = MisfitStatus.NOT_FINITE
    if status is not MisfitStatus.TESTED:
        groups = {
            group: PreparedGroup(where, _NO_TRANSFORM, not_tested(status)) for group, where in GROUP_COLUMNS.items()
        }
        return PreparedImage(np.empty((0, 2 * n)), np.empty((0, 2, n)), np.ones((2, n)), groups, clustered)
    q = basis.nuisance_basis(columns, exact=exact)
    num_clusters = n - (0 if clustered is None else clustered.num_merged)
    groups = _project_fields(q, fields.reshape(len(fields), -1), num_clusters, exact=exact)
    leverage = np.minimum(np.einsum("qm,qm->m", q, q), basis.MAX_LEVERAGE)
    return PreparedImage(q, fields, (1.0 / np.sqrt(1.0 - leverage)).reshape(2, n), groups, clustered)


def _project_fields(
    q: FloatArray, fields: FloatArray, num_clusters: int, *, exact: bool
) -> dict[MisfitGroup, PreparedGroup]:
    """Project fields (42, m) off Q, in place; return each group's basis within them.

    The unit length of step 1 enters with the transforms: their products are smaller than the fields.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        on_nuisance = basis.project_off_in_place(q, fields)
        gram = fields @ fields.T
        before = gram + on_nuisance @ on_nuisance.T
        sq_norms = before.diagonal()
    if basis.may_stay_unscaled(sq_norms):
        finite = np.ones(len(fields), dtype=bool)
        scale = 1.0 / np.sqrt(sq_norms)
        gram, before = (product * scale * scale[:, None] for product in (gram, before))
    else:
        finite, scale = _scale_in_place(fields, on_nuisance), np.ones(len(fields))
        gram = fields @ fields.T
        before = gram + on_nuisance @ on_nuisance.T
    free_values = fields.shape[1] - len(q)
    groups = {}
    for group, columns in GROUP_COLUMNS.items():
        refused = None
        if not finite[columns].all():
            refused = not_tested(MisfitStatus.NOT_FINITE)
        elif free_values < columns.stop - columns.start:
            refused = not_tested(MisfitStatus.NOT_ENOUGH_EVIDENCE)
        transform = _NO_TRANSFORM
        if refused is None:
            own_scale, own_before = scale[columns, None], before[columns, columns]
            by_gram = None if exact else basis.field_transform(gram[columns, columns], own_before)
            if by_gram is None:
                fields[columns] *= own_scale
                transform = _exactly(q, fields[columns], basis.largest_sq(own_before))
            else:
                transform = own_scale * by_gram
            refused = refusal(transform.shape[1], num_clusters)
        groups[group] = PreparedGroup(columns, transform, refused)
    return groups


def _scale_in_place(fields: FloatArray, on_nuisance: FloatArray) -> FloatArray:
    """Scale projected fields (c, m) and their coordinates (c, q) to unit length before the projection, zero ones not.

    Those that are not finite become zero; return (c,) which are finite.
    """
    norms = basis.column_norms(np.hstack([fields, on_nuisance]))
    finite = np.isfinite(norms)
    divisor = np.where(finite & (norms > 0), norms, 1.0)[:, None]
    for part in fields, on_nuisance:
        part[~finite] = 0.0
        np.divide(part, divisor, out=part)
    return finite


def _exactly(q: FloatArray, own: FloatArray, largest_sq: float) -> FloatArray:
    """Replace a group's projected unit fields, (c, m), by an orthonormal basis; return which of them it takes.

    The Gram path keeps singular values above 1e-5 only: what one projection leaves of Q is 1e-11 of them. This path
    keeps smaller ones and projects twice.
    """
    basis.project_off_in_place(q, own)
    orthonormal = basis.exact_basis(own, basis.FIELD_THRESHOLD * math.sqrt(largest_sq))
    own[: len(orthonormal)] = orthonormal
    return np.eye(len(own))[:, : len(orthonormal)]
