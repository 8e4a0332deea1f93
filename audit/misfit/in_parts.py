"""The score tests of images with so many points that their columns are made a part at a time.

A million points have 700 MB of candidate fields. What is summed over points is summed over parts instead, as often as
the mathematics asks for the sums before it can go on; clusters of observations are never cut.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from sfm_audit.audit.misfit import basis
from sfm_audit.audit.misfit.design import ImageDesign, OffPose
from sfm_audit.audit.misfit.fields import GROUP_COLUMNS, NUM_FIELDS
from sfm_audit.audit.misfit.outcome import MisfitTests, judged_by_f, not_tested, refusal
from sfm_audit.audit.misfit.pooled import (
    PooledNormal,
    PooledSolution,
    PooledSums,
    PooledTests,
    add_rows,
    judged,
    scored,
    solve_normal,
    solve_triangle,
    triangle_of,
)
from sfm_audit.audit.table.words import GROUPS, MisfitStatus
from sfm_audit.loaders.arrays import BoolArray, FloatArray, IntArray

AT_ONCE: Final = 2**15
"""Observations of an image up to which all its columns are in memory at the same time."""
PART: Final = 2**13
"""Observations of a part of a larger image."""
_CLUSTERS: Final = 2**16  # whose scores are in memory at the same time


@dataclass(frozen=True, slots=True, eq=False)
class PartedImage:
    """An image whose columns are made when asked for.

    track: (n,) which cluster each observation belongs to, 0 .. num_tracks - 1.
    nuisance: gives (q, 2, p) what the image's own fit took up, of p chosen observations.
    part: gives the design of chosen observations; its pose is ``nuisance`` again.
    """

    track: IntArray
    nuisance: Callable[[IntArray], FloatArray]
    part: Callable[[IntArray], ImageDesign]

    def parts(self, rows: IntArray | None = None) -> Iterator[IntArray]:
        """Yield the observations, or some of them, a part at a time."""
        size = len(self.track) if rows is None else len(rows)
        for start in range(0, size, PART):
            chosen = np.arange(start, min(start + PART, size))
            yield chosen if rows is None else rows[chosen]


class ColumnSums(NamedTuple):
    """What of columns (q, m) their least squares need.

    norms: (q,) lengths.    gram: (q, q) of the columns that are not zero, of unit length.    num_values: m.
    """

    norms: FloatArray
    gram: FloatArray
    num_values: int


def column_sums(image: PartedImage) -> ColumnSums:
    """Sum up the nuisance columns of an image."""
    norms = gram = np.zeros(())
    with np.errstate(over="ignore", invalid="ignore"):
        for chosen in image.parts():
            columns = _flat(image.nuisance(chosen))
            norms = np.hypot(norms, basis.column_norms(columns))
            gram = gram + columns @ columns.T
        used = norms != 0
        gram = gram[np.ix_(used, used)] / norms[used] / norms[used][:, None]
    return ColumnSums(norms, gram, 2 * len(image.track))


def column_triangle(image: PartedImage, norms: FloatArray) -> FloatArray:
    """Return R (q', q') of a QR of the unit columns that are not zero: as accurate as one of all of them at once."""
    used = norms != 0
    triangle = np.zeros((0, int(np.count_nonzero(used))))
    for chosen in image.parts():
        unit = _flat(image.nuisance(chosen))[used] / norms[used][:, None]
        triangle = np.asarray(np.linalg.qr(np.concatenate([triangle, unit.T]), mode="r"))
    return triangle


def image_tests_in_parts(image: PartedImage, num_clusters: int) -> MisfitTests:
    """Test one image as `prepare` and `test` do; its designs have no intrinsics beside the nuisance columns.

    Parameters
    ----------
    num_clusters : ``image.track`` is numbered below it
    """
    found = _solved([image], num_clusters)
    if isinstance(found, MisfitStatus):
        return {group: not_tested(found) for group in GROUPS}
    normal, solution, scores, meat = found
    tests: MisfitTests = {}
    for group, columns in GROUP_COLUMNS.items():
        if group in normal.refused:
            tests[group] = not_tested(MisfitStatus.NOT_FINITE)
            continue
        transform = solution.transform[group]
        rank, own = transform.shape[1], transform.T @ meat[columns, columns] @ transform
        refused = refusal(rank, num_clusters)
        tests[group] = (
            refused or judged_by_f(transform.T @ scores[columns], own, [rank], num_clusters, len(image.track))[0]
        )
    return tests


def camera_tests_in_parts(images: Sequence[PartedImage], num_tracks: int) -> PooledTests:
    """Test a camera on all its images at once, as `camera_tests` does, a part of an image at a time."""
    found = _solved(images, num_tracks)
    if isinstance(found, MisfitStatus):
        return PooledTests({group: not_tested(found) for group in GROUPS}, 0, 0, 0)
    normal, solution, scores, meat = found
    tests = {group: judged(group, scores, meat, normal, solution) for group in GROUPS}
    return PooledTests(tests, normal.num_images, normal.num_observations, normal.num_tracks)


def _solved(
    images: Sequence[PartedImage], num_tracks: int
) -> tuple[PooledNormal, PooledSolution, FloatArray, FloatArray] | MisfitStatus:
    """Both passes: normal equations, solution, scores (42,) and meat (42, 42); or why nothing can be tested."""
    images = [image for image in images if len(image.track)]
    if not images:
        return MisfitStatus.NOT_ENOUGH_EVIDENCE
    first = images[0].part(np.zeros(1, dtype=np.int64))
    if not len(first.fields):
        return MisfitStatus.NO_FIELDS
    profiles: list[_Profile] = []
    sums = PooledSums(len(first.intrinsics), num_tracks)
    for image in images:
        profile = _profile(image)
        if profile is None or not profile.finite[: len(first.intrinsics)].all():
            return MisfitStatus.NOT_FINITE
        profiles.append(profile)
        for part, track in _off_pose(image, profile, image.parts()):
            sums.add(part, track)
    if not np.isfinite(sums.before).all():
        return MisfitStatus.NOT_FINITE
    sums.num_images = len(images)
    normal = sums.normal()
    solution = solve_normal(normal)
    if solution is None:
        parts = (_off_pose(image, known, image.parts()) for image, known in zip(images, profiles, strict=True))
        solution = solve_triangle(triangle_of((part for each in parts for part, _ in each), normal), normal)
    return normal, solution, *_scores(list(zip(images, profiles, strict=True)), num_tracks, normal, solution)


def _scores(
    images: list[tuple[PartedImage, _Profile]], num_tracks: int, normal: PooledNormal, solution: PooledSolution
) -> tuple[FloatArray, FloatArray]:
    """Scores (42,) and meat (42, 42): clusters meet in all images, so block by block of clusters."""
    scores, meat = np.zeros(NUM_FIELDS), np.zeros((NUM_FIELDS, NUM_FIELDS))
    for start in range(0, num_tracks, _CLUSTERS):
        stop = min(start + _CLUSTERS, num_tracks)
        per_track, last_row = np.zeros((stop - start, NUM_FIELDS)), np.empty(stop - start, dtype=np.int64)
        for image, profile in images:
            rows = np.flatnonzero((image.track >= start) & (image.track < stop))
            for part, track in _off_pose(image, profile, image.parts(rows)):
                own_scores, per_observation = scored(part, normal, solution)
                scores += own_scores
                add_rows(per_track, track - start, per_observation, last_row)
        meat += per_track.T @ per_track
    return scores, meat


class _Profile(NamedTuple):
    """How to take an image's nuisance columns N (q, 2n) out of others.

    to_basis: (q', q) to_basis N is an orthonormal basis.    on_columns, on_y: (k + 42, q'), (q',) coordinates on it of
    the columns before, and of the residuals.    finite: (k + 42,) columns that are.
    """

    to_basis: FloatArray
    on_columns: FloatArray
    on_y: FloatArray
    finite: BoolArray


def _profile(image: PartedImage) -> _Profile | None:
    """None where derivatives are not finite. Columns and residuals are projected twice, as those of small images."""
    sums = column_sums(image)
    if not np.isfinite(sums.norms).all() or not np.isfinite(sums.gram).all():
        return None
    to_basis = _to_basis(image, sums)
    norms = np.zeros(())
    for chosen in image.parts():
        norms = np.hypot(norms, basis.column_norms(_columns(image.part(chosen))))
    profile = _Profile(to_basis, np.zeros((norms.size, len(to_basis))), np.zeros(len(to_basis)), np.isfinite(norms))
    for _ in range(2):
        on_columns, on_y = profile.on_columns.copy(), profile.on_y.copy()
        for chosen in image.parts():
            q, columns, y = _projected(image.part(chosen), profile)
            on_columns += columns @ q.T
            on_y += q @ y
        profile = profile._replace(on_columns=on_columns, on_y=on_y)
    return profile


def _to_basis(image: PartedImage, sums: ColumnSums) -> FloatArray:
    """(q', q) what makes an orthonormal basis of the nuisance columns, orthonormalised twice."""
    used = sums.norms != 0
    out = np.zeros((0, used.size))
    if not used.any():
        return out
    values, vectors = np.linalg.eigh(sums.gram)
    if values[0] <= basis.SMALLEST_PIVOT * values[-1]:
        _, singular, rows = np.linalg.svd(column_triangle(image, sums.norms))
        kept = singular > basis.NUISANCE_THRESHOLD * singular[0]
        values, vectors = singular[kept] ** 2, rows[kept].T
    out = np.zeros((values.size, used.size))
    out[:, used] = (vectors / np.sqrt(values)).T / sums.norms[used]
    gram = np.zeros((len(out), len(out)))
    for chosen in image.parts():
        q = out @ _flat(image.nuisance(chosen))
        gram += q @ q.T
    values, vectors = np.linalg.eigh(gram)
    return np.asarray((vectors / np.sqrt(values)).T @ out)


def _off_pose(image: PartedImage, profile: _Profile, parts: Iterator[IntArray]) -> Iterator[tuple[OffPose, IntArray]]:
    """Parts of an image with its nuisance columns profiled, and their clusters; the first has the coordinates."""
    coordinates = profile.on_columns
    for chosen in parts:
        q, columns, y = _projected(image.part(chosen), profile)
        yield (
            OffPose(columns, coordinates, y, np.einsum("qm,qm->m", q, q), profile.finite),
            image.track[chosen],
        )
        coordinates = coordinates[:, :0]


def _projected(design: ImageDesign, profile: _Profile) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Basis (q', m), columns (k + 42, m) and residuals (m,) of a part, off the basis as far as the profile knows."""
    q = profile.to_basis @ _flat(design.pose)
    columns = _columns(design)
    columns[~profile.finite] = 0.0
    columns -= profile.on_columns @ q
    return q, columns, design.residuals_px.reshape(-1) - profile.on_y @ q


def _columns(design: ImageDesign) -> FloatArray:
    return np.concatenate([_flat(design.intrinsics), _flat(design.fields)])


def _flat(columns: FloatArray) -> FloatArray:
    return columns.reshape(len(columns), 2 * columns.shape[-1])
