"""One camera, all its images: the misfit tests pooled (method.md section 5, cameras)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import numpy as np

from sfm_audit.audit.camera_quality.measure import CameraQuality
from sfm_audit.audit.decision.decisions import Decisions
from sfm_audit.audit.decision.diagnostics import misfit_groups
from sfm_audit.audit.decision.misfit import MisfitDecision, decide_each
from sfm_audit.audit.inliers.joined import MAX_JOINED, joined_inliers
from sfm_audit.audit.inliers.projected import ImageInliers, image_inliers
from sfm_audit.audit.inliers.residuals import ModelResiduals
from sfm_audit.audit.misfit import (
    ImageDesign,
    MisfitTests,
    PooledTests,
    ProjectedImage,
    Retest,
    advised_camera_model,
    image_retest,
    project_image,
    projected_design,
)
from sfm_audit.audit.misfit.camera_sums import camera_tests_of_sums
from sfm_audit.audit.misfit.design import Piece, piece_of
from sfm_audit.audit.misfit.in_parts import AT_ONCE, PartedImage, camera_tests_in_parts
from sfm_audit.audit.misfit.pooled import camera_tests_of_pieces
from sfm_audit.audit.misfit.pooled_stack import in_windows, pieces_of_joined
from sfm_audit.audit.misfit.significance import UNTESTED, Significance
from sfm_audit.audit.misfit.sums import ModelSums
from sfm_audit.audit.table.words import VERDICT_ORDER, Member, Verdict
from sfm_audit.loaders.arrays import BoolArray, FloatArray, IntArray
from sfm_audit.loaders.model import CameraRecord, SparseModel

_MAX_WINDOW: Final = 128


@dataclass(frozen=True, slots=True, eq=False)
class CameraAudit:
    """What all images of a camera say about it.

    image_idxs: (k,) its images with inliers.        num_points, num_observations: 3D points and inliers behind it.
    """

    camera: CameraRecord
    image_idxs: IntArray
    num_points: int
    num_observations: int
    tests: MisfitTests
    misfit: MisfitDecision
    advised_camera_model: str | None


@dataclass(frozen=True, slots=True, eq=False)
class _CameraImages:
    """The images of one camera with inliers, and the rows of their tracks, numbered from 0."""

    model: SparseModel
    residuals: ModelResiduals
    camera: CameraRecord
    image_idxs: IntArray

    def only(self, holds: BoolArray) -> _CameraImages:
        """Return those of the images that hold (I,)."""
        return replace(self, image_idxs=self.image_idxs[holds[self.image_idxs]])

    def tests(self, camera: CameraRecord, tracks: Sequence[IntArray], num_tracks: int) -> PooledTests:
        """Test as if the images had been taken with ``camera``."""

        def projected(k: int, chosen: IntArray | None) -> tuple[ImageInliers, ProjectedImage]:
            own = self.inliers(k, chosen)
            return own, own.projected if camera is self.camera else project_image(camera, own.xyz_cam)

        def design(k: int, chosen: IntArray | None = None) -> ImageDesign:
            own, seen = projected(k, chosen)
            track = tracks[k] if chosen is None else tracks[k][chosen]
            return projected_design(camera, seen, own.residuals_px, track)

        def pose(k: int, chosen: IntArray) -> FloatArray:
            return projected(k, chosen)[1].pose

        def together(ks: list[int]) -> list[Piece]:
            own = joined_inliers(self.model, self.residuals, self.image_idxs[ks].tolist(), len(tracks[ks[0]]))
            seen = own.projected if camera is self.camera else project_image(camera, own.xyz_cam)
            track = np.concatenate([tracks[k] for k in ks])
            return pieces_of_joined(projected_design(camera, seen, own.residuals_px, track), [tracks[k] for k in ks])

        def some(ahead: range) -> list[Piece]:
            found: dict[int, Piece] = {}
            for num_points in {len(tracks[k]) for k in ahead}:
                alike = [k for k in ahead if len(tracks[k]) == num_points]
                if 0 < num_points <= MAX_JOINED and len(alike) > 1:
                    found.update(zip(alike, together(alike), strict=True))
            return [found[k] if k in found else piece_of(design(k)) for k in ahead]

        longest = max(map(len, tracks), default=0)
        if longest <= AT_ONCE:
            num_images, size = len(self.image_idxs), _MAX_WINDOW if longest <= MAX_JOINED else 1
            return camera_tests_of_pieces(in_windows(some, num_images, size), num_images, num_tracks, exact=False)
        parted = [PartedImage(track, partial(pose, k), partial(design, k)) for k, track in enumerate(tracks)]
        return camera_tests_in_parts(parted, num_tracks)

    def inliers(self, k: int, chosen: IntArray | None = None) -> ImageInliers:
        """Inliers of the k-th image, or some of them."""
        return image_inliers(self.model, self.residuals, int(self.image_idxs[k]), chosen)

    @property
    def num_observations(self) -> int:
        """Inliers of all images."""
        return int(np.diff(self.residuals.offsets)[self.image_idxs].sum())

    def tracks(self) -> tuple[list[IntArray], int]:
        """Rows of each image's points in the list of this camera's points, and the length of that list."""
        parts = [self.residuals.point_idx[self.residuals.rows(int(i))] for i in self.image_idxs]
        points, row = np.unique(np.concatenate(parts), return_inverse=True)
        ends = np.cumsum([part.size for part in parts])[:-1]
        return [part.astype(np.int64) for part in np.split(row, ends)], points.size


def audit_cameras(
    model: SparseModel,
    residuals: ModelResiduals,
    quality: Sequence[CameraQuality | None],
    sigma_px: FloatArray,
    *,
    alpha: float,
    tau_px: FloatArray,
    holds: BoolArray,
    retest: Callable[[int, CameraRecord], MisfitTests],
) -> list[CameraAudit]:
    """Audit every camera that has an image with inliers, in the order of the camera table.

    Parameters
    ----------
    quality : per image, None without inliers            sigma_px, tau_px : (I,) sigma_constant_px and materiality
    holds : (I,) images whose pose and consistency hold; the others have no say (one bad pose in 24 makes a wrong lens)
    retest : the misfit tests of an image under another camera

    Notes
    -----
    Poses are profiled per image, intrinsics once, observations of one track count as one. A camera with a single image
    has that image's tests: Hotelling's law holds for few observations too, and clustering by track changes nothing
    there but for points that the image sees twice. q: Benjamini-Hochberg over the model's cameras.
    """
    groups = _groups_of(model, residuals, np.flatnonzero([each is not None for each in quality]))
    sums = {i: each.sums for i, each in enumerate(quality) if each is not None and each.sums is not None}
    source = ModelSums(model, residuals, sums)
    tests = [_pooled(source, group.only(holds), quality) for group in groups]
    significance = Significance.of(tests)
    of_cameras = [
        misfit_groups(test, q, num_observations=group.num_observations, sigma_px=_median(sigma_px[group.image_idxs]))
        for group, test, q in zip(groups, tests, significance.q, strict=True)
    ]
    taus: FloatArray = np.array([_median(tau_px[group.image_idxs]) for group in groups], dtype=np.float64)
    found = decide_each(of_cameras, alpha=alpha, tau_px=taus)
    out = []
    for group, test, misfit, tau in zip(groups, tests, found, taus.tolist(), strict=True):
        advice = advised_camera_model(
            group.camera,
            misfit.group if misfit.material else None,
            misfit.material,
            retest=_retest(group, retest),
            distortion_identified=_distortion_identified([quality[int(i)] for i in group.image_idxs]),
            alpha=alpha,
            tau_px=tau,
        )
        counts = source.num_points_of(group.image_idxs.tolist()), group.num_observations
        out.append(CameraAudit(group.camera, group.image_idxs, *counts, test, misfit, advice))
    return out


def retested(model: SparseModel, residuals: ModelResiduals, image_idx: int, camera: CameraRecord) -> MisfitTests:
    """Return the misfit tests of the image in a row if it had been fitted with this camera, to first order."""
    own = image_inliers(model, residuals, image_idx)
    return image_retest(own.xyz_cam, own.residuals_px)(camera)


def _median(values: FloatArray) -> float:
    """Most cameras of a photo collection have one image."""
    return float(values[0]) if len(values) == 1 else float(np.median(values))


def _groups_of(model: SparseModel, residuals: ModelResiduals, image_idxs: IntArray) -> list[_CameraImages]:
    """Images by camera, in the order of the camera table."""
    camera_idx = model.images.camera_idx[image_idxs]
    by_camera = image_idxs[np.argsort(camera_idx, kind="stable")]
    cameras, counts = np.unique(camera_idx, return_counts=True)
    ends = np.cumsum(counts)
    return [
        _CameraImages(model, residuals, model.camera(camera), by_camera[end - count : end])
        for camera, count, end in zip(cameras.tolist(), counts.tolist(), ends.tolist(), strict=True)
    ]


def _pooled(source: ModelSums, group: _CameraImages, quality: Sequence[CameraQuality | None]) -> MisfitTests:
    """The tests of all images of a camera together; of the image alone where it has one."""
    if not len(group.image_idxs):
        return UNTESTED
    own = quality[int(group.image_idxs[0])]
    if len(group.image_idxs) == 1 and own is not None:
        return own.misfit
    found = camera_tests_of_sums(source, group.image_idxs.tolist())
    return (group.tests(group.camera, *group.tracks()) if found is None else found).tests


def _retest(group: _CameraImages, of_image: Callable[[int, CameraRecord], MisfitTests]) -> Retest:
    """The geometry waits until it is asked, which happens to few cameras."""
    if len(group.image_idxs) == 1:
        return partial(of_image, int(group.image_idxs[0]))
    return lambda camera: group.tests(camera, *group.tracks()).tests


def _distortion_identified(quality: Sequence[CameraQuality | None], min_sds: float = 2.0) -> bool:
    """Whether some distortion parameter differs from 0 by two standard deviations, the images' information summed.

    Each image's information is taken after its own pose and focal length were profiled, so the sum is a little low.
    """
    known = [each for each in quality if each is not None]
    if not known or not known[0].shape.camera.model.extra_idxs:
        return True
    camera = known[0].shape.camera
    for idx in camera.model.extra_idxs:
        sds = np.array([each.identifiability.parameters.sd_of(camera.model.param_names[idx]) for each in known])
        sds = sds[np.isfinite(sds) & (sds > 0)]
        information = float((sds**-2.0).sum())
        if information > 0 and abs(camera.params[idx]) >= min_sds / math.sqrt(information):
            return True
    return False


def settled(camera: CameraAudit, rejected: BoolArray) -> CameraAudit:
    """Return the camera without the advice that less would do where half of its images or more are rejected.

    Parameters
    ----------
    rejected : (I,) images of the model that the policy ``camera`` rejects
    """
    if camera.misfit.material or 2 * np.count_nonzero(rejected[camera.image_idxs]) < len(camera.image_idxs):
        return camera
    return replace(camera, advised_camera_model=None)


def is_advisable(decisions: Decisions) -> BoolArray:
    """(n,) images whose decision allows to advise a camera model.

    No lens is advised where the parts do not belong together, and no smaller one where any question rejects or the
    misfit could not be asked for.
    """
    said, material = decisions.members[Member.MISFIT].verdict, decisions.misfit.material.any(axis=1)
    asked = decisions.misfit.measured.known & (said != VERDICT_ORDER[Verdict.UNDETERMINED])
    agree = material == (said == VERDICT_ORDER[Verdict.REJECTED])
    return np.asarray(asked & agree & (material | ~decisions.rejects))


def images_advice(
    qualities: Sequence[CameraQuality | None],
    decisions: Decisions,
    retest: Callable[[int, CameraRecord], MisfitTests] | None,
    *,
    alpha: float,
) -> list[str | None]:
    """Return the camera models that n images ask for, None where none is advised.

    Parameters
    ----------
    retest : the misfit tests of the image in a row under another camera
    """
    out: list[str | None] = [None] * len(qualities)
    material: BoolArray = np.asarray(decisions.misfit.material.any(axis=1))
    for i in np.flatnonzero(is_advisable(decisions)).tolist():
        quality = qualities[i]
        if quality is None:
            continue
        found = decisions.misfit.record(i) if material[i] else None
        out[i] = advised_camera_model(
            quality.shape.camera,
            found.group if found else None,
            found.material if found else (),
            retest=None if retest is None else partial(retest, i),
            distortion_identified=_distortion_identified([quality]),
            alpha=alpha,
            tau_px=float(decisions.misfit.tau_px[i]),
        )
    return out
