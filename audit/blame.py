"""Whose fault is it? Peel off the images whose misfit leaks into their neighbours (method.md section 5)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from audit.misfit import (
    GROUPS,
    MisfitStatus,
    MisfitTests,
    coincident_keypoints,
    nuisance_columns,
    prepare_image,
    project_image,
)
from audit.misfit.basis import nuisance_basis, unit_columns
from audit.misfit.outcome import not_tested
from audit.multiplicity import benjamini_hochberg, holm
from audit.refit import refit_points
from audit.residuals import ModelResiduals
from loaders.arrays import BoolArray, FloatArray
from loaders.model import CameraRecord, SparseModel

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

    def run(self, tests: Sequence[MisfitTests]) -> Blame:
        """Peel while it changes anything, test what is left and what was peeled; ``tests`` as the model stands."""
        before = Significance.of(tests)
        effect, testable = before.effect_px(self._alpha), before.testable
        most_are_wrong = bool(2 * np.count_nonzero(effect > self._tau_px) > np.count_nonzero(testable))
        if most_are_wrong or not (effect > _FLAG_FROM_PX).any():
            return Blame.of_nobody(tests, self._residuals, most_are_wrong=most_are_wrong)
        current, flagged = list(tests), np.zeros(len(tests), dtype=bool)
        residuals, clean = self._residuals.residuals_px, flagged
        for _ in range(_MAX_ROUNDS):
            effect = np.where(flagged, 0.0, Significance.of(current).effect_px(self._alpha))
            guilty = (effect > _FLAG_FROM_PX) & (effect >= _SHARE_OF_LARGEST * effect.max(initial=0.0))
            if not guilty.any() or np.count_nonzero(testable & ~flagged & ~guilty) < _MIN_UNFLAGGED:
                break
            flagged |= guilty
            residuals, moving, clean = self._without(flagged)
            current = self._retest(current, flagged, tests, residuals, moving, clean)
        if not flagged.any():
            return Blame.of_nobody(tests, self._residuals, most_are_wrong=False)
        for i in np.flatnonzero(flagged).tolist():  # against points that they had no say in
            current[i] = self._test(i, residuals, clean)
        return Blame(
            tuple(tests), before, tuple(current), Significance.of(current), flagged, residuals, clean, most_are_wrong
        )

    def _retest(
        self,
        current: list[MisfitTests],
        flagged: BoolArray,
        stands: Sequence[MisfitTests],
        residuals: FloatArray,
        moving: BoolArray,
        clean: BoolArray,
    ) -> list[MisfitTests]:
        """Test the unflagged images that share points with flagged ones; those keep the test that convicted them."""
        out = list(current)
        for i in np.flatnonzero(~flagged).tolist():
            touched = moving[self._residuals.point_idx[self._residuals.rows(i)]].any()
            out[i] = self._test(i, residuals, clean) if touched else stands[i]
        return out

    def _without(self, flagged: BoolArray) -> tuple[FloatArray, BoolArray, BoolArray]:
        """Residuals (2, n) refitted without the flagged images, points that moved, observations of clean points."""
        kept = ~flagged & ~self._excluded
        point_idx, num_points = self._residuals.point_idx, len(self._model.points)
        has_say = kept[self._image_idx]
        moving = np.zeros(num_points, dtype=bool)
        moving[point_idx[~has_say]] = True
        residuals = refit_points(self._residuals, num_points, kept, moving, self._basis, _MAX_SWEEPS)
        clean = np.bincount(point_idx[has_say], minlength=num_points) >= _MIN_CLEAN_VIEWS
        return residuals, moving, clean[point_idx]

    def _basis(self, image_idx: int) -> FloatArray:
        """Orthonormal basis (q, 2, n) of what was fitted to the image."""
        camera, xyz_cam = self._geometry(image_idx)
        columns = nuisance_columns(camera.model, project_image(camera, xyz_cam))
        basis = nuisance_basis(unit_columns(columns.reshape(len(columns), -1)))
        return basis.reshape(len(basis), *columns.shape[1:])

    def _geometry(self, image_idx: int) -> tuple[CameraRecord, FloatArray]:
        """Camera and inlier points (n, 3) in its frame; images with inliers have a camera."""
        image = self._model.image(image_idx)
        if image.camera is None:
            raise ValueError(f"image {image.image_id} has inliers but no camera")
        point_idx = self._residuals.point_idx[self._residuals.rows(image_idx)]
        return image.camera, image.cam_from_world(self._model.points.xyz_world[point_idx])

    def _test(self, image_idx: int, residuals_px: FloatArray, clean: BoolArray) -> MisfitTests:
        """Score tests of one image on residuals (2, n of the model), on its inliers of clean points."""
        rows = self._residuals.rows(image_idx)
        used = np.flatnonzero(clean[rows])
        if used.size < _MIN_CLEAN_OBSERVATIONS:
            return UNTESTED
        camera, xyz_cam = self._geometry(image_idx)
        xy_px = self._model.observations.xy_px[self._residuals.observation_row[rows][used]]
        prepared = prepare_image(camera, xyz_cam[used], clusters=coincident_keypoints(xy_px))
        return prepared.test(residuals_px[:, rows][:, used])
