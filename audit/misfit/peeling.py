"""Whose fault is it? Peel off the images whose misfit leaks into their neighbours (method.md section 5)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sfm_audit.audit.inliers.residuals import ModelResiduals
from sfm_audit.audit.misfit import (
    GROUPS,
    MisfitStatus,
    MisfitTests,
    coincident_keypoints,
    nuisance_columns,
    prepare_image,
    project_image,
)
from sfm_audit.audit.misfit.basis import nuisance_transform
from sfm_audit.audit.misfit.multiplicity import benjamini_hochberg, holm
from sfm_audit.audit.misfit.outcome import not_tested
from sfm_audit.audit.misfit.refit import refit_points
from sfm_audit.loaders.arrays import BoolArray, FloatArray, IntArray
from sfm_audit.loaders.model import CameraRecord, SparseModel

_MIN_CLEAN_OBSERVATIONS = 20  # of points with at least two views that are not flagged
_MIN_CLEAN_VIEWS = 2
_MAX_ROUNDS = 10
_MIN_UNFLAGGED = 8
_MAX_SWEEPS = 40
_FLAG_FROM_PX = 0.05
_SHARE_OF_LARGEST = 0.5

UNTESTED: MisfitTests = dict.fromkeys(GROUPS, not_tested(MisfitStatus.NOT_ENOUGH_EVIDENCE))
"""The tests of an image with too few observations."""


@dataclass(frozen=True, slots=True, eq=False)
class Significance:
    """Tests of many images side by side: p, q, px each (I, 6) in the order of GROUPS, NaN where not tested.

    q: Benjamini-Hochberg over the images, per group, of Holm's adjusted p over the groups of an image.
    """

    p: FloatArray
    q: FloatArray
    px: FloatArray

    @classmethod
    def of(cls, tests: Sequence[MisfitTests]) -> Significance:
        """Adjust the p-values of a model's images."""
        shape = (len(tests), len(GROUPS))
        p = np.array([[image[group].p for group in GROUPS] for image in tests], dtype=np.float64).reshape(shape)
        px = np.array([[image[group].px for group in GROUPS] for image in tests], dtype=np.float64).reshape(shape)
        return cls(p, benjamini_hochberg(holm(p).T).T, px)

    @property
    def testable(self) -> BoolArray:
        """(I,) images in which at least one group could be tested."""
        return np.asarray(~np.isnan(self.p).all(axis=1))

    def effect_px(self, alpha: float) -> FloatArray:
        """(I,) px: the largest effect among an image's groups with q < alpha, 0 without any."""
        significant = np.where(np.isnan(self.q), 1.0, self.q) < alpha
        return np.asarray(np.where(significant, self.px, 0.0).max(axis=1, initial=0.0))


@dataclass(frozen=True, slots=True, eq=False)
class Blame:
    """Misfit of all images of a model, as it stands and after peeling.

    tests, significance: as the model stands.           final_tests, final: after peeling.
    flagged: (I,) images that were left out when the points of the others were triangulated again.
    residuals_px: (2, n) of all inliers after that.      clean: (n,) those whose point has two views that are not
    flagged: what the final tests used.
    most_are_wrong: more than half of the testable images have an effect above tau, so nothing was peeled.
    """

    tests: tuple[MisfitTests, ...]
    significance: Significance
    final_tests: tuple[MisfitTests, ...]
    final: Significance
    flagged: BoolArray
    residuals_px: FloatArray
    clean: BoolArray
    most_are_wrong: bool

    @classmethod
    def of_nobody(cls, tests: Sequence[MisfitTests], residuals: ModelResiduals, *, most_are_wrong: bool) -> Blame:
        """Return the tests as they are: points independent of the images, nothing to peel, or too much."""
        significance = Significance.of(tests)
        return cls(
            tuple(tests),
            significance,
            tuple(tests),
            significance,
            np.zeros(len(tests), dtype=bool),
            residuals.residuals_px,
            np.ones(residuals.point_idx.size, dtype=bool),
            most_are_wrong,
        )


@dataclass(slots=True, eq=False)
class _State:
    """Where peeling stands; arrays are replaced, never written to.

    tests: of each image, the last one.      untested: (I,) images whose last test is older than residuals_px.
    flagged, residuals_px, clean: as in `Blame`.
    """

    tests: list[MisfitTests]
    untested: BoolArray
    flagged: BoolArray
    residuals_px: FloatArray
    clean: BoolArray

    @classmethod
    def initial(cls, tests: Sequence[MisfitTests], residuals_px: FloatArray) -> _State:
        """Nobody is flagged."""
        nobody = np.zeros(len(tests), dtype=bool)
        return cls(list(tests), nobody, nobody, residuals_px, np.ones(residuals_px.shape[1], dtype=bool))


class Peeling:
    """The images of one model, tested again and again while the guilty ones are taken out.

    Parameters
    ----------
    excluded : (I,) images that never have a say in the points (poses changed after the adjustment)
    alpha : significance          tau_px : (I,) materiality, px
    """

    def __init__(
        self, model: SparseModel, residuals: ModelResiduals, excluded: BoolArray, *, alpha: float, tau_px: FloatArray
    ) -> None:
        self._model, self._residuals, self._excluded = model, residuals, excluded
        self._alpha, self._tau_px = alpha, tau_px
        self._image_idx = np.repeat(np.arange(len(model.images)), np.diff(residuals.offsets))
        self._transforms: dict[int, FloatArray] = {}  # of each image's N to its orthonormal basis, from its first use

    def run(self, tests: Sequence[MisfitTests]) -> Blame:
        """Peel while it changes anything, test what is left and what was peeled; ``tests`` as the model stands.

        Between two refits only suspects are tested again, the images whose last test would flag them: most images
        that share points with a flagged one lose their misfit or never had any. When no suspect is left all others
        are tested, and where that finds a new one peeling goes on, so that it ends where testing all images in every
        round ends: no unflagged image has an effect that flags it.
        """
        before = Significance.of(tests)
        effect, testable = before.effect_px(self._alpha), before.testable
        most_are_wrong = bool(2 * np.count_nonzero(effect > self._tau_px) > np.count_nonzero(testable))
        if most_are_wrong or not (effect > _FLAG_FROM_PX).any():
            return Blame.of_nobody(tests, self._residuals, most_are_wrong=most_are_wrong)
        state = _State.initial(tests, self._residuals.residuals_px)
        for _ in range(_MAX_ROUNDS):
            guilty = self._guilty(state)
            if not guilty.any():
                self._test_all(state)
                guilty = self._guilty(state)
            if not guilty.any() or np.count_nonzero(testable & ~state.flagged & ~guilty) < _MIN_UNFLAGGED:
                break
            self._take_out(state, guilty, tests)
        if not state.flagged.any():
            return Blame.of_nobody(tests, self._residuals, most_are_wrong=False)
        self._test_all(state)
        for i in np.flatnonzero(state.flagged).tolist():  # against points that they had no say in
            state.tests[i] = self._test(i, state.residuals_px, state.clean)
        return Blame(
            tuple(tests),
            before,
            tuple(state.tests),
            Significance.of(state.tests),
            state.flagged,
            state.residuals_px,
            state.clean,
            most_are_wrong,
        )

    def _effect_px(self, state: _State) -> FloatArray:
        """(I,) px, of the unflagged images by their last tests, 0 for flagged ones."""
        return np.where(state.flagged, 0.0, Significance.of(state.tests).effect_px(self._alpha))

    def _guilty(self, state: _State) -> BoolArray:
        """(I,) images to take out next."""
        effect = self._effect_px(state)
        return np.asarray((effect > _FLAG_FROM_PX) & (effect >= _SHARE_OF_LARGEST * effect.max(initial=0.0)))

    def _take_out(self, state: _State, guilty: BoolArray, stands: Sequence[MisfitTests]) -> None:
        """Flag images, refit without them, test the suspects that share points with them; the others' tests are old."""
        state.flagged = state.flagged | guilty
        state.residuals_px, moving, state.clean = self._without(state.flagged)
        touched = np.zeros(len(stands), dtype=bool)
        touched[self._image_idx[moving[self._residuals.point_idx]]] = True
        for i in np.flatnonzero(~state.flagged & ~touched).tolist():
            state.tests[i] = stands[i]
        state.untested = touched & ~state.flagged  # those keep the test that convicted them
        self._test_some(state, self._effect_px(state) > _FLAG_FROM_PX)

    def _test_all(self, state: _State) -> None:
        self._test_some(state, state.untested)

    def _test_some(self, state: _State, chosen: BoolArray) -> None:
        """Test those of the chosen images whose test is older than the residuals."""
        for i in np.flatnonzero(chosen & state.untested).tolist():
            state.tests[i] = self._test(i, state.residuals_px, state.clean)
        state.untested = state.untested & ~chosen

    def _without(self, flagged: BoolArray) -> tuple[FloatArray, BoolArray, BoolArray]:
        """Residuals (2, n) refitted without the flagged images, points that moved, observations of clean points."""
        kept = ~flagged & ~self._excluded
        point_idx, num_points = self._residuals.point_idx, len(self._model.points)
        has_say = kept[self._image_idx]
        moving = np.zeros(num_points, dtype=bool)
        moving[point_idx[~has_say]] = True
        residuals = refit_points(self._residuals, kept, moving, self._basis, _MAX_SWEEPS)
        clean = np.bincount(point_idx[has_say], minlength=num_points) >= _MIN_CLEAN_VIEWS
        return residuals, moving, clean[point_idx]

    def _basis(self, image_idx: int, rows: IntArray) -> FloatArray:
        """Orthonormal basis of what was fitted to the image over all its inliers, (q, 2, m) at ``rows`` of them."""
        transform = self._transforms.get(image_idx)
        if transform is None:
            columns = self._columns(image_idx, slice(None))
            transform = nuisance_transform(columns.reshape(len(columns), -1))
            self._transforms[image_idx] = transform
            return np.tensordot(transform, columns[:, :, rows], axes=1)
        return np.tensordot(transform, self._columns(image_idx, rows), axes=1)

    def _columns(self, image_idx: int, rows: IntArray | slice) -> FloatArray:
        """N (q, 2, m) of the image at ``rows`` of its inliers."""
        camera, xyz_cam = self._geometry(image_idx, rows)
        return nuisance_columns(camera.model, project_image(camera, xyz_cam))

    def _geometry(self, image_idx: int, rows: IntArray | slice) -> tuple[CameraRecord, FloatArray]:
        """Camera and points (m, 3) in its frame at ``rows`` of the inliers; images with inliers have a camera."""
        image = self._model.image(image_idx)
        if image.camera is None:
            raise ValueError(f"image {image.image_id} has inliers but no camera")
        point_idx = self._residuals.point_idx[self._residuals.rows(image_idx)][rows]
        return image.camera, image.cam_from_world(self._model.points.xyz_world.take(point_idx, axis=0))

    def _test(self, image_idx: int, residuals_px: FloatArray, clean: BoolArray) -> MisfitTests:
        """Score tests of one image on residuals (2, n of the model), on its inliers of clean points."""
        rows = self._residuals.rows(image_idx)
        used = np.flatnonzero(clean[rows])
        if used.size < _MIN_CLEAN_OBSERVATIONS:
            return UNTESTED
        camera, xyz_cam = self._geometry(image_idx, used)
        xy_px = self._model.observations.xy_px.take(self._residuals.observation_row[rows][used], axis=0)
        prepared = prepare_image(camera, xyz_cam, clusters=coincident_keypoints(xy_px))
        return prepared.test(residuals_px[:, rows].take(used, axis=1))
