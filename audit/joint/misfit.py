"""Which images have a camera that is wrong in its form? Joint tests with sequential inclusion (method.md 11b)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final, NamedTuple, Protocol

import numpy as np

from sfm_audit.audit.inliers.projected import ProjectedImage
from sfm_audit.audit.joint.candidates import CandidateScores, FieldsInParts, ImageFields, candidate_scores
from sfm_audit.audit.joint.design import AT_ONCE, EVERY
from sfm_audit.audit.joint.group_test import GroupTest, untested
from sfm_audit.audit.joint.image_scores import GroupSumsOfImage, scores_of_many
from sfm_audit.audit.joint.image_tests import ImageTests, tests_of_scores, tests_of_sums
from sfm_audit.audit.joint.inclusion import Candidate, include
from sfm_audit.audit.joint.system import JointSystem
from sfm_audit.audit.joint.worth import NO_WORTH, Worth
from sfm_audit.audit.kernels.threads import over_ranges
from sfm_audit.audit.misfit.fields import GROUP_COLUMNS, NUM_FIELDS, candidate_fields
from sfm_audit.audit.misfit.multiplicity import benjamini_hochberg, holm
from sfm_audit.audit.table.words import GROUPS, MisfitGroup, MisfitStatus
from sfm_audit.loaders.arrays import BoolArray, FloatArray, IntArray
from sfm_audit.loaders.model import CameraRecord

MAX_ROUNDS: Final = 8
_INCLUDE_FROM_PX: Final = 0.1
_SHARE_OF_LARGEST: Final = 0.5
_MOST_SUSPECTS: Final = 0.1


OfImage = GroupSumsOfImage | CandidateScores | None
"""What the tests of an image ask for; None where it has no candidate fields."""


class JointTest(NamedTuple):
    """What (8) says of one group in one image, at the time when it counts.

    q: of Holm over groups and Benjamini-Hochberg over the images that were tested in the same round.
    p, q, px: NaN unless tested.    rank: r, None where unknown.
    gain: |z|^2 - tr M in units of the noise.    worth: what admitting the group would do to the image.
    """

    p: float
    q: float
    px: float
    rank: int | None
    status: MisfitStatus
    gain: float
    worth: Worth

    def bic(self, num_observations: int) -> float:
        """Return |z|^2 - tr M + r - r log 2n; -inf unless tested."""
        if self.status is not MisfitStatus.TESTED or self.rank is None:
            return -math.inf
        return self.gain + self.rank - self.rank * math.log(2 * num_observations)


JointTests = dict[MisfitGroup, JointTest]


@dataclass(frozen=True, slots=True, eq=False)
class JointMisfit:
    """Misfit of all images of a model, nobody blamed for another.

    tests: per image; of an included one those with which it was included.
    effect_px: (I,) largest effect among significant groups, 0 without any, NaN where nothing was tested.
    included: (I,) images whose fields became free parameters of the base.    round_included: (I,) -1 = never.
    cause: per image, None without significant groups.
    most_are_wrong: more than half of the tested images end with an effect above tau: rather their common camera.
    """

    tests: tuple[JointTests, ...]
    effect_px: FloatArray
    included: BoolArray
    round_included: tuple[int, ...]
    cause: tuple[MisfitGroup | None, ...]
    most_are_wrong: bool


class Beside(Protocol):
    """Who wants other fields of an image projected off the base at the image's first test."""

    def fields(
        self, image_idx: int, camera: CameraRecord, projected: ProjectedImage, candidates: FloatArray
    ) -> FloatArray:
        """(c, 2, n) px per unit; ``candidates`` of `candidate_fields`."""
        ...

    def power(self, image_idx: int) -> int:
        """Of r^2 in the radial term among the fields, 0 where an image is not asked for any; see `ScoresOfMany`."""
        ...

    def take(self, image_idx: int, scores: CandidateScores) -> None:
        """Hear what these fields would take up."""
        ...


def joint_misfit(
    system: JointSystem,
    *,
    alpha: float,
    tau_px: FloatArray,
    excluded: BoolArray | None = None,
    suspects: BoolArray | None = None,
    beside: Beside | None = None,
) -> JointMisfit:
    """Test all images against everything that was or could be fitted, and free the fields of those that fail.

    Parameters
    ----------
    tau_px : (I,) materiality, px; NaN where unknown counts as never material
    excluded : (I,) images that are wrong in another way (pose, own parameters). They keep their free pose and own
        parameters, so that they pull at nobody, but are neither tested nor counted. Ignored if they are more than
        half of the images with columns: then it is not they that are wrong.
    suspects : (I,) images that are tested first, and included where they fail, before anybody else is tested. They
        decide on the order alone: everybody is tested in the end. All at once where None, where nobody is suspected,
        or more than a tenth are: then they are rather neighbours of wrong images, and do not say who is wrong.
    beside : asked once for every image that is tested, at its first test

    Notes
    -----
    H0 per image and group: the scores of E~ have mean zero; tracks are independent, nothing else is assumed of the
    noise. Blind to what base and points absorb (eigenvalues of K below 1e-4).

    *Inclusion:* images with q < alpha, an effect > min(0.1 px, tau / 2) and >= half of the largest get the group
    with the largest effect as parameters of their own; at most 8 rounds; not if more than half of the tested images
    would then be included. An included image keeps its tests and is no hypothesis any more. Only images that share
    points with an included one are tested again: what an included field did to others it did through shared points.
    Between two rounds these are the ones with any p < alpha; all others, and who was not tested yet, when nobody is
    left to include, and if that finds somebody, rounds go on. Until then those that were not tested count as images
    with p = 1 (`benjamini_hochberg`): looking at suspects alone makes nobody more significant.
    """
    has_columns = system.observations.layout.has_columns
    left_out = np.zeros_like(has_columns) if excluded is None else excluded & has_columns
    if 2 * np.count_nonzero(left_out) > np.count_nonzero(has_columns):
        left_out = np.zeros_like(has_columns)
    tested = has_columns & ~left_out
    rounds = _Rounds(system, tested, alpha=alpha, tau_px=tau_px, beside=beside)
    nothing = {out: _nothing(out) for out in (False, True)}
    rounds.tests = [nothing[out] for out in left_out.tolist()]  # who is tested has an answer soon
    first = tested & (tested if suspects is None else suspects)
    is_few = 0 < np.count_nonzero(first) <= _MOST_SUSPECTS * np.count_nonzero(tested)
    return rounds.run(first if is_few else tested)


def included_from(tau_px: FloatArray) -> FloatArray:
    """Return the effect (I,) above which an image is included, px; tau_px (I,), NaN where never material."""
    return np.fmin(_INCLUDE_FROM_PX, 0.5 * tau_px)


def _nothing(left_out: bool) -> dict[MisfitGroup, GroupTest]:
    status = MisfitStatus.EXCLUDED if left_out else MisfitStatus.NO_COLUMNS
    return dict.fromkeys(GROUPS, untested(status))


class _Rounds:
    """Where inclusion stands."""

    def __init__(
        self, system: JointSystem, tested: BoolArray, *, alpha: float, tau_px: FloatArray, beside: Beside | None
    ) -> None:
        num_images = len(tested)
        self._system, self._base = system, system.base
        self._many = scores_of_many(system, self._base)
        self._tested, self._alpha, self._beside = tested, alpha, beside
        self._tau_px = np.where(np.isnan(tau_px), np.inf, tau_px)
        self._include_from = included_from(self._tau_px)
        self.tests: list[dict[MisfitGroup, GroupTest]] = []
        self._worth: list[dict[MisfitGroup, Worth]] = [{}] * num_images
        self._q = np.full((num_images, len(GROUPS)), np.nan)
        self._least_p = np.full(num_images, np.nan)  # of all groups of an image
        self._asked = np.zeros(num_images, dtype=bool)
        self._round = np.full(num_images, -1)

    def run(self, first: BoolArray) -> JointMisfit:
        """Test the first, include, test again, and everybody else."""
        self._test(first)
        stale = self._tested & ~first  # were not tested since something was included that they share points with
        for number in range(MAX_ROUNDS):
            new = self._next()
            if not new.any() and stale.any():
                self._test(stale)
                stale[:] = False
                new = self._next()
            if not new.any():
                break
            self._include(new)
            self._round[new] = number
            stale = (stale | self._touched(new)) & self._tested & (self._round < 0)
            suspects = stale & (self._least_p < self._alpha)
            self._test(suspects)
            stale &= ~suspects
        if stale.any():
            self._test(stale)
        wrong = np.count_nonzero(self._effects() > self._tau_px)
        return self._result(bool(2 * wrong > np.count_nonzero(self._tested)))

    def _next(self) -> BoolArray:
        """(I,) whose fields are to be free next; nobody's if more than half of the tested images would then be."""
        waiting = np.where(self._round < 0, self._effects(), 0.0)
        new = (waiting > self._include_from) & (waiting >= _SHARE_OF_LARGEST * waiting.max(initial=0.0))
        most = 2 * np.count_nonzero(new | (self._round >= 0)) > np.count_nonzero(self._tested)
        return np.zeros_like(new) if most else np.asarray(new)

    def _test(self, chosen: BoolArray) -> None:
        images = np.flatnonzero(chosen).tolist()
        counts = np.array([self._system.observations.num_of(image) for image in images], dtype=np.int64)

        def tested(start: int, stop: int) -> None:
            some = images[start:stop]
            answers = _image_tests(self._system, some, self._scores_of(some), self._alpha)
            for image, answer in zip(some, answers, strict=True):
                self.tests[image], self._worth[image] = answer

        over_ranges(tested, len(images), counts)
        self._asked |= chosen
        waiting = np.flatnonzero(self._tested & (self._round < 0))
        p = np.array([[self.tests[i][group].p for group in GROUPS] for i in waiting.tolist()]).reshape(-1, len(GROUPS))
        p[~self._asked[waiting]] = 1.0
        self._q[waiting] = benjamini_hochberg(holm(p).T).T
        self._least_p[waiting] = np.fmin.reduce(p, axis=1)

    def _scores_of(self, images: Sequence[int]) -> list[OfImage]:
        """Of each image, what its tests ask for."""
        beside = [None if self._asked[image] else self._beside for image in images]
        powers = [0 if each is None else each.power(image) for image, each in zip(images, beside, strict=True)]
        compiled = [None] * len(images) if self._many is None else self._many.tested(images, powers)
        out: list[OfImage] = []
        for image, each, power, found in zip(images, beside, powers, compiled, strict=True):
            if found is None:
                out.append(self._by_numpy(image, each))
                continue
            own, missing = (found, found.missing) if isinstance(found, GroupSumsOfImage) else _divided(found)
            if power and each is not None:
                each.take(image, missing())
            out.append(own)
        return out

    def _by_numpy(self, image: int, beside: Beside | None) -> CandidateScores | None:
        fields: ImageFields | FieldsInParts
        if self._system.observations.num_of(image) <= AT_ONCE:
            fields = _fields_of(self._system, image, beside)
            is_empty = not fields.fields.size
        else:
            fields = FieldsInParts(partial(_fields_of, self._system, image, beside))
            is_empty = not fields.part(slice(1)).fields.size
        if is_empty:
            return None
        scores = candidate_scores(self._base, [image], lambda _: fields)
        if beside is None:
            return scores
        own, missing = _divided(scores)
        beside.take(image, missing())
        return own

    def _significant(self) -> dict[int, list[MisfitGroup]]:
        """Groups with q < alpha, of each image that has any."""
        out: dict[int, list[MisfitGroup]] = {}
        for image, k in np.argwhere(self._q < self._alpha).tolist():
            out.setdefault(image, []).append(GROUPS[k])
        return out

    def _effects(self) -> FloatArray:
        """(I,) largest effect among significant groups."""
        out = np.zeros(len(self.tests))  # nothing is significant where nothing was tested
        for image, significant in self._significant().items():
            out[image] = max(self.tests[image][group].px for group in significant)
        return out

    def _include(self, new: BoolArray) -> None:
        candidates, observations, significant = [], self._system.observations, self._significant()
        for image in np.flatnonzero(new).tolist():
            own = GROUP_COLUMNS[max(significant[image], key=lambda g: self.tests[image][g].px)]
            parts = (_columns_of(self._system, image, chosen=part)[:, :, own] for part in observations.parts(image))
            candidates.append(Candidate(image, np.concatenate(list(parts)), partial(observations.nuisance, image)))
        self._base = include(self._base, candidates)
        self._many = scores_of_many(self._system, self._base)

    def _touched(self, new: BoolArray) -> BoolArray:
        """(I,) images that share points with any of the new ones."""
        observations = self._system.observations
        shown = np.zeros(observations.num_points, dtype=bool)
        shown[observations.point_idx[new[observations.image_idx]]] = True
        out = np.zeros_like(new)
        out[observations.image_idx[shown[observations.point_idx]]] = True
        return out

    def _result(self, most: bool) -> JointMisfit:
        place: dict[int, int] = {}  # of a large model's blocks nearly all images are untested, and share their tests
        for image, own in enumerate(self.tests):
            place.setdefault(id(own), image)
        told = {key: self._joint_tests(image) for key, image in place.items() if not self._tested[image]}
        tests = [told.get(id(own), {}) for own in self.tests]
        causes: list[MisfitGroup | None] = [None] * len(tests)
        for image in np.flatnonzero(self._tested).tolist():
            tests[image] = self._joint_tests(image)
        for image, significant in self._significant().items():
            causes[image] = self._cause(image, significant, tests[image])
        effect = np.where(self._tested, self._effects(), np.nan)
        return JointMisfit(tuple(tests), effect, self._round >= 0, tuple(self._round.tolist()), tuple(causes), most)

    def _joint_tests(self, image: int) -> JointTests:
        q, worth = self._q[image].tolist(), self._worth[image]
        return {
            group: JointTest(t.p, q[k], t.px, t.rank, t.status, t.gain, worth.get(group, NO_WORTH))
            for k, (group, t) in enumerate(self.tests[image].items())
        }

    def _cause(self, image: int, significant: list[MisfitGroup], tests: JointTests) -> MisfitGroup:
        material = [group for group in significant if tests[group].px > self._tau_px[image]]
        n = self._system.observations.num_of(image)
        return max(material or significant, key=lambda group: tests[group].bic(n))


def _fields_of(
    system: JointSystem, image: int, beside: Beside | None = None, chosen: slice | IntArray = EVERY
) -> ImageFields:
    """42 candidate fields of an image, px per unit, and those of ``beside``; none of panoramas."""
    return ImageFields(_columns_of(system, image, beside, chosen), system.observations.nuisance(image, chosen))


def _columns_of(
    system: JointSystem, image: int, beside: Beside | None = None, chosen: slice | IntArray = EVERY
) -> FloatArray:
    """(n, 2, c) the same without nuisance columns."""
    inliers = system.observations.inliers(image, chosen)
    camera, projected = inliers.camera, inliers.projected
    candidates = candidate_fields(camera, projected)
    if beside is not None and len(candidates):
        candidates = np.concatenate([candidates, beside.fields(image, camera, projected, candidates)])
    return np.ascontiguousarray(candidates.transpose(2, 1, 0))


def _divided(scores: CandidateScores) -> tuple[CandidateScores, Callable[[], CandidateScores]]:
    """Those of the candidate fields, and those of the parameters that the camera may lack."""
    return scores.only(slice(0, NUM_FIELDS)), partial(scores.only, slice(NUM_FIELDS, None))


def _image_tests(
    system: JointSystem, images: Sequence[int], scores: Sequence[OfImage], alpha: float
) -> list[ImageTests]:
    """Of each image the tests of all groups, and the worth of those that may be significant."""
    summed = [each for each in scores if isinstance(each, GroupSumsOfImage)]
    known = {i: each for i, each in zip(images, scores, strict=True) if isinstance(each, CandidateScores)}
    found = {**tests_of_sums(system, summed, alpha), **tests_of_scores(system, known, alpha)}
    nothing = dict.fromkeys(GROUPS, untested(MisfitStatus.NO_FIELDS))
    return [found.get(image, (nothing, {})) for image in images]
