"""The pooled tests of a camera from sums over the observations of its images (method.md section 5, *Cameras*).

`audit.misfit.pooled.camera_tests` says what the numbers mean, and answers where digits do not last here.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from sfm_audit.audit.kernels import kernels_in_use
from sfm_audit.audit.kernels.misfit import NUM_FEATURES, Tracks
from sfm_audit.audit.misfit.features import FEATURE_OF_FIELD, FIELD_OF_FEATURE, widened, widened_columns
from sfm_audit.audit.misfit.fields import GROUP_COLUMNS, NUM_FIELDS
from sfm_audit.audit.misfit.mixed import mix_of, transforms_of
from sfm_audit.audit.misfit.outcome import MisfitTest, judged_by_chi2, not_tested, refusal
from sfm_audit.audit.misfit.pooled import PooledNormal, PooledSolution, PooledTests, judged
from sfm_audit.audit.misfit.stacked import LOST_DIGITS, LOST_OF_SMOOTH, profiled, ranks_of
from sfm_audit.audit.misfit.sums import ModelSums, NumberedTracks
from sfm_audit.audit.table.words import GROUPS, MisfitGroup, MisfitStatus
from sfm_audit.loaders.arrays import FloatArray

_POSE: Final = 6
_SMOOTH: Final = GROUP_COLUMNS[MisfitGroup.SMOOTH]
_MIN_OBSERVATIONS: Final = 64  # per image: of fewer the profiles of poses are more than the columns
_SMALLEST_PIVOT: Final = 1e-8  # of the intrinsics' normal matrix, unit columns
_TRACKS_AT_ONCE: Final = 1 << 16  # whose scores are in memory at the same time; numpy has all


def camera_tests_of_sums(source: ModelSums, images: Sequence[int]) -> PooledTests | None:
    """Test a camera on its images; None where `camera_tests` has to say.

    Parameters
    ----------
    images : rows of the image table, all of one camera

    Notes
    -----
    One pass over the observations, for the scores of tracks, and one before it of images whose sums are not known.
    Memory: 3 kB for each image and 320 bytes for each of 65,536 tracks (of all with numpy alone).
    """
    num_observations = sum(source.num_of(image) for image in images)
    if not images or not all(map(source.can_sum, images)) or num_observations < _MIN_OBSERVATIONS * len(images):
        return None
    with np.errstate(all="ignore"):  # what is out of range is in doubt
        first = _first_pass(source, images)
        solution = None if first is None else _solution(first)
        if first is None or solution is None:
            return None
        normal, profiles = first.normal, _profiles(first, solution)
        mixed = None if MisfitGroup.SMOOTH in solution.transform else _mixed(source, images, first, solution, profiles)
        if MisfitGroup.SMOOTH not in solution.transform and mixed is None:
            return None
        z = solution.to_basis.T @ normal.on_y[: normal.num_intrinsics]
        scores = normal.on_y[normal.num_intrinsics :] - solution.on_basis.T @ z
        meat, mixed_meat = _meat(source, images, first, profiles, mixed)
        tests = {group: judged(group, scores, meat, normal, solution) for group in solution.transform}
        if mixed is not None:
            tests[MisfitGroup.SMOOTH] = _judged_mixed(mixed, mixed_meat, first, solution)
    ordered = {group: tests[group] for group in GROUPS}
    return PooledTests(ordered, normal.num_images, normal.num_observations, normal.num_tracks)


class _Pooled(NamedTuple):
    """After the first pass; C: the k intrinsics, E: the fields, in the units of `audit.misfit.features`.

    to_basis: (I, 6, 6) to_basis P is an orthonormal basis of each image's pose columns P.    on_y: (I, 6) y - P on_y
    is off P.    coefficients: (I, 6, k + 42) [C, E] - P coefficients is off P.
    subtracted: (k + 42, k + 42) sum of the squares of coefficients, all columns of unit length.
    tracks: of the images.    offset: `affine_offset`.
    """

    normal: PooledNormal
    to_basis: FloatArray
    on_y: FloatArray
    coefficients: FloatArray
    subtracted: FloatArray
    tracks: NumberedTracks
    offset: FloatArray


def _first_pass(source: ModelSums, images: Sequence[int]) -> _Pooled | None:
    """Accumulate over images; None where some pose is in doubt."""
    gram = before = on_y = subtracted = np.zeros(())
    num_observations, offset, profiles = 0, np.zeros(2), []
    for window in source.windows(images):
        own, y = window.sums()
        wide, q = widened(own, window.offset, window.num_own), _POSE
        found = profiled(wide, widened_columns(y, window.offset, window.num_own), q)
        if not found.sure.all():
            return None
        length = 1.0 / found.scale[:, q:]
        unit = found.coefficients * length[:, None, :]
        gram = gram + (found.left * length[:, :, None] * length[:, None, :]).sum(axis=0)
        before = before + wide[:, q:, q:].sum(axis=0)
        on_y = on_y + (found.scores * length).sum(axis=0)
        subtracted = subtracted + (unit.swapaxes(1, 2) @ unit).sum(axis=0)
        profiles.append((found.to_basis, found.on_y, unit * found.scale[:, :q, None]))
        num_observations += int(window.num_observations.sum())
        offset = window.offset[0]
    scale = 1.0 / np.sqrt(np.diagonal(before))
    both = scale * scale[:, None]
    tracks = source.tracks(images)
    normal = PooledNormal(
        gram * both,
        before * both,
        on_y * scale,
        scale,
        frozenset(),
        2 * num_observations - _POSE * len(images),
        len(images),
        num_observations,
        tracks.num_tracks,
    )
    to_basis, profiled_y, coefficients = (np.concatenate(parts) for parts in zip(*profiles, strict=True))
    return _Pooled(normal, to_basis, profiled_y, coefficients, subtracted * both, tracks, offset)


def _solution(first: _Pooled) -> PooledSolution | None:
    """Profile the intrinsics, once for all images; None where digits or a rank are in doubt.

    The smooth group alone may be left out instead.
    """
    normal = first.normal
    k = normal.num_intrinsics
    values, vectors = np.linalg.eigh(normal.gram[:k, :k])
    if not values[0] > _SMALLEST_PIVOT:
        return None
    to_basis = np.asarray(vectors / np.sqrt(values))
    on_basis = to_basis.T @ normal.gram[:k, k:]
    left = normal.gram[k:, k:] - on_basis.T @ on_basis
    on_intrinsics = to_basis @ on_basis
    transforms = {}
    for group, columns in GROUP_COLUMNS.items():
        values, vectors = np.linalg.eigh(left[columns, columns])
        # a direction of the fields, and what the intrinsics take of it: so much was subtracted with poses
        direction = np.zeros((k + NUM_FIELDS, len(values)))
        direction[:k] = -on_intrinsics[:, columns] @ vectors
        direction[k:][columns] = vectors
        with_poses = np.sqrt(np.maximum(np.einsum("ic,ij,jc->c", direction, first.subtracted, direction), 0.0))
        along = np.concatenate([direction[:k], with_poses[None]])
        is_smooth = group is MisfitGroup.SMOOTH
        ranks, certain = ranks_of(values[None], along[None], LOST_OF_SMOOTH if is_smooth else LOST_DIGITS)
        if not certain[0] and not is_smooth:
            return None
        if not certain[0]:
            continue
        kept = slice(len(values) - int(ranks[0]), None)
        transforms[group] = np.asarray(vectors[:, kept] / np.sqrt(values[kept]))
    return PooledSolution(to_basis, on_basis, transforms)


class _Mixed(NamedTuple):
    """The smooth fields, mixed so that their digits last.

    mix: (28, 28) of the features.    scores: (28,) of what is mixed.    transform: (28, r) to an orthonormal basis.
    """

    mix: FloatArray
    scores: FloatArray
    transform: FloatArray


_Profiles = tuple[FloatArray, FloatArray, FloatArray]


def _mixed(
    source: ModelSums, images: Sequence[int], first: _Pooled, solution: PooledSolution, profiles: _Profiles
) -> _Mixed | None:
    """Sum up mixed and projected smooth fields, as `audit.misfit.mixed` does; None where their rank is in doubt."""
    k, normal = first.normal.num_intrinsics, first.normal
    left = normal.gram[k:, k:] - solution.on_basis.T @ solution.on_basis
    found = mix_of(left[None, _SMOOTH, _SMOOTH], normal.before[None, k:, k:][:, _SMOOTH, _SMOOTH])
    mix = found.mix[0] * normal.scale[k:][_SMOOTH, None]
    _, on_y, coefficients = profiles
    of_mixed = coefficients[:, :, FEATURE_OF_FIELD[_SMOOTH]] @ mix
    gram, scores, at = np.zeros(mix.shape), np.zeros(len(mix)), 0
    for window in source.windows(images):
        own = slice(at, at + len(window.images))
        no_leverage = np.zeros((len(window.images), window.num_own, window.num_own))
        chosen = np.arange(len(window.images))
        mixes = np.repeat(mix[None], len(window.images), axis=0)
        own_gram, own_scores, _ = window.mixed(no_leverage, on_y[own], chosen, mixes, of_mixed[own])
        gram, scores, at = gram + own_gram.sum(axis=0), scores + own_scores.sum(axis=0), own.stop
    for _, transform in transforms_of(found, gram[None]):
        if len(transform):
            return _Mixed(mix, scores, transform[0])
    return None


def _judged_mixed(mixed: _Mixed, meat: FloatArray, first: _Pooled, solution: PooledSolution) -> MisfitTest:
    normal, transform = first.normal, mixed.transform
    if normal.num_free - solution.to_basis.shape[1] < len(mixed.mix):
        return not_tested(MisfitStatus.NOT_ENOUGH_EVIDENCE)
    refused = refusal(transform.shape[1], normal.num_tracks)
    own_meat = transform.T @ meat @ transform
    return refused or judged_by_chi2(transform.T @ mixed.scores, own_meat, normal.num_observations)


def _meat(
    source: ModelSums, images: Sequence[int], first: _Pooled, profiles: _Profiles, mixed: _Mixed | None
) -> tuple[FloatArray, FloatArray]:
    """(42, 42) of the fields off all that was profiled, of unit length before, and (28, 28) of the mixed ones.

    Scores of tracks, block by block of tracks.
    """
    normal = first.normal
    basis, on_y, coefficients = profiles
    at_once = _TRACKS_AT_ONCE if kernels_in_use() else normal.num_tracks
    windows = list(source.windows(images)) if kernels_in_use() else None  # numpy's hold their features
    meat, mixed_meat = np.zeros((NUM_FEATURES, NUM_FEATURES)), np.zeros((0, 0) if mixed is None else mixed.mix.shape)
    for start in range(0, normal.num_tracks, at_once):
        tracks = Tracks(first.tracks.of_row, start, min(start + at_once, normal.num_tracks))
        per_track = np.zeros((tracks.last - tracks.first, NUM_FEATURES))
        at = 0
        for window in source.windows(images) if windows is None else windows:
            own = slice(at, at + len(window.images))
            lowest, highest = first.tracks.reach[own].T
            if ((lowest < tracks.last) & (highest >= tracks.first)).any():
                window.add_tracks(per_track, (basis[own], on_y[own], coefficients[own]), tracks)
                window.forget()  # most images are met once
            at = own.stop
        meat += per_track.T @ per_track
        if mixed is not None:
            own_tracks = per_track[:, FEATURE_OF_FIELD[_SMOOTH]] @ mixed.mix
            mixed_meat += own_tracks.T @ own_tracks
    scale = normal.scale[normal.num_intrinsics :]
    return widened(meat[None], first.offset[None], 0)[0] * scale * scale[:, None], mixed_meat


def _profiles(first: _Pooled, solution: PooledSolution) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Basis (I, r, q), on_y (I, q) and coefficients (I, q, 40) of each image, as `WindowSums.add_tracks` takes them."""
    normal = first.normal
    k, num_images = normal.num_intrinsics, normal.num_images
    scale, scale_of_fields = normal.scale[:k], normal.scale[k:]
    to_basis = solution.to_basis * scale[:, None]
    own = np.zeros((num_images, _POSE + k, to_basis.shape[1]))  # the basis of the intrinsics, in columns of N
    own[:, :_POSE], own[:, _POSE:] = -first.coefficients[:, :, :k] @ to_basis, to_basis
    basis = np.zeros((num_images, _POSE + to_basis.shape[1], _POSE + k))
    basis[:, :_POSE, :_POSE], basis[:, _POSE:] = first.to_basis, own.swapaxes(1, 2)
    on_y = own @ (solution.to_basis.T @ normal.on_y[:k])
    on_y[:, :_POSE] += first.on_y
    coefficients = own @ (solution.on_basis / scale_of_fields)
    coefficients[:, :_POSE] += first.coefficients[:, :, k:]
    return basis, on_y, np.ascontiguousarray(coefficients[:, :, FIELD_OF_FEATURE])
