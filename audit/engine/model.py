"""One model in, its tables out: the order in which the questions are asked (method.md, in the order data meets it)."""

from __future__ import annotations

from functools import cached_property, partial
from threading import RLock
from typing import TYPE_CHECKING, Any

import numpy as np
from threadpoolctl import threadpool_limits

from sfm_audit.audit.camera_quality.measure import CameraQuality
from sfm_audit.audit.config import AuditConfig
from sfm_audit.audit.consistency import ModelConsistency, consistency_of
from sfm_audit.audit.decision.diagnostics import MisfitDiagnostics, OwnDiagnostics, SharedMisfit
from sfm_audit.audit.decision.triage import CAMERA_COLUMNS, triage
from sfm_audit.audit.engine.camera import CameraAudit, audit_cameras, retested, settled
from sfm_audit.audit.engine.findings import (
    consistency_findings,
    joint_findings,
    parts_disagree,
    pose_findings,
    residual_findings,
)
from sfm_audit.audit.engine.image import ImageAudit, ImageEvidence, audit_image, camera_diagnostics
from sfm_audit.audit.engine.images import audit_images
from sfm_audit.audit.engine.jointly import (
    consistency_diagnostics,
    expected_error_px,
    gains_of,
    implied_by_camera,
    joint_camera,
    misfit_diagnostics,
    own_diagnostics,
    pose_columns,
    untested_misfit,
)
from sfm_audit.audit.engine.observations import observation_table
from sfm_audit.audit.engine.quality import quality_of_images, suspects_of
from sfm_audit.audit.engine.rows import camera_columns, model_row
from sfm_audit.audit.engine.spreading import Spread, in_turn
from sfm_audit.audit.engine.tables import ModelAudit, Said, images_table, triage_rows
from sfm_audit.audit.inliers.frames import claimed_frames
from sfm_audit.audit.inliers.projected import inlier_set
from sfm_audit.audit.inliers.residuals import ModelResiduals, model_residuals
from sfm_audit.audit.inliers.stored_errors import StoredErrors, compare_stored_errors
from sfm_audit.audit.joint import CameraStep, JointAudit, audit_jointly, included_from
from sfm_audit.audit.kernels.threads import together
from sfm_audit.audit.misfit import MisfitTests, fitted_param_idxs
from sfm_audit.audit.noise.keypoint import KeypointTracks, keypoint_noise, keypoint_tracks
from sfm_audit.audit.noise.stack import ConstantFits, constant_fits
from sfm_audit.audit.noise.standardise import ImageNoise, ModelTracks, constant_noise, model_tracks, track_noise
from sfm_audit.audit.table import ModelLabels, build_table, schema
from sfm_audit.audit.table.words import MisfitStatus
from sfm_audit.audit.witnesses.asking import Outside, ask
from sfm_audit.audit.witnesses.evidence import Evidence
from sfm_audit.loaders.arrays import BoolArray, FloatArray, IntArray
from sfm_audit.loaders.evidence import NOTHING_GIVEN, Given
from sfm_audit.loaders.model import CameraRecord, InlierSet, SparseModel

if TYPE_CHECKING:
    import pyarrow as pa


class ModelAuditor:
    """What the images of one model share, computed once and in file order, and each image's audit on top of it.

    Parameters
    ----------
    model : from `loaders.open_model`
    config : noise model and thresholds; the defaults when None
    keypoint_scale_px : (M,) keypoint size of each row of ``model.observations``, NaN unknown; for noise ``keypoint``
    spread : where the stages run that look at one image at a time; the numbers do not depend on it
    given : what was given besides the model for witnesses to look at
    """

    def __init__(
        self,
        model: SparseModel,
        config: AuditConfig | None = None,
        keypoint_scale_px: FloatArray | None = None,
        *,
        spread: Spread[ModelAuditor] = in_turn,
        given: Given = NOTHING_GIVEN,
    ) -> None:
        self.model, self._given, self._spread = model, given, spread
        self.config = config or AuditConfig()
        self._keypoint_scale_px = keypoint_scale_px
        self._looking, self._retested = RLock(), dict[tuple[int, str, bytes], MisfitTests]()
        if self.config.noise == "keypoint" and keypoint_scale_px is None:
            raise ValueError("the noise model keypoint needs keypoint_scale_px")

    def __getstate__(self) -> dict[str, Any]:
        """Leave out where images are audited: an unpickled auditor runs serially."""
        return {**self.__dict__, "_spread": in_turn, "_given": NOTHING_GIVEN, "_looking": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take what was kept, with a lock of its own."""
        self.__dict__.update(state, _looking=RLock())

    @cached_property
    def residuals(self) -> ModelResiduals:
        """All inliers of the model, projected."""
        return model_residuals(self.model)

    @cached_property
    def tracks(self) -> ModelTracks:
        """Whitened residuals, track variances and the prior of the ``track`` noise model."""
        return model_tracks(
            self.residuals,
            len(self.model.points),
            pose_offset_threshold_px=self.config.pose_offset_threshold_px,
            min_track_length=self.config.min_track_length,
            min_eigenvalue=self.config.min_track_eigenvalue,
        )

    @cached_property
    def keypoint_tracks(self) -> KeypointTracks:
        """Tracks weighted by the size of keypoints, for the ``keypoint`` noise model."""
        if self._keypoint_scale_px is None:
            raise ValueError("the noise model keypoint needs keypoint_scale_px")
        return keypoint_tracks(
            self.residuals,
            len(self.model.points),
            self._keypoint_scale_px[self.residuals.observation_row],
            pose_offset_threshold_px=self.config.pose_offset_threshold_px,
            min_track_length=self.config.min_track_length,
            min_eigenvalue=self.config.min_track_eigenvalue,
        )

    @cached_property
    def constant_fits(self) -> ConstantFits:
        """One robust scale of the raw residuals of each image."""
        return constant_fits(self.residuals)

    @property
    def sigma_constant_px(self) -> FloatArray:
        """Robust sd per axis of each image's raw residuals (I,), NaN where undetermined."""
        return self.constant_fits.sigma_px

    @cached_property
    def tau_px(self) -> FloatArray:
        """Materiality of a misfit in each image (I,), px; NaN where the noise is unknown and tau is in sigma."""
        return np.array([self.config.tau_px(float(sigma)) for sigma in self.sigma_constant_px], dtype=np.float64)

    @property
    def quality(self) -> tuple[CameraQuality | None, ...]:
        """What each image says of its camera as the model stands; None without inliers."""
        with self._looking:  # the joint step asks while another thread may be about to find out
            return self._quality

    @cached_property
    def _quality(self) -> tuple[CameraQuality | None, ...]:
        _ = self.sigma_constant_px  # with the residuals, what the images share
        return tuple(self._spread(_quality_of, self))

    @cached_property
    def consistency(self) -> ModelConsistency:
        """Whether cameras, poses, points and 2D points belong together."""
        return consistency_of(self.model, self.residuals)

    @cached_property
    def moved(self) -> BoolArray:
        """(I,) images whose pose is away from the optimum of their own residuals."""
        return np.asarray(self.residuals.pose_offset_px > self.config.pose_offset_threshold_px)

    @cached_property
    def joint(self) -> JointAudit | None:
        """What the joint system says; None where nobody is asked, because the parts do not belong together."""
        if self.consistency.parts_disagree:
            return None
        frames = claimed_frames(self.model)
        return audit_jointly(
            self.model,
            self.residuals,
            self.sigma_constant_px,
            alpha=self.config.alpha,
            tau_px=self.tau_px,
            excluded=self.moved,
            left_out=self.consistency.inconsistent,
            suspects=lambda: suspects_of(self.quality, self.config.alpha, included_from(self.tau_px)),
            frame_idx=None if frames is None else frames.frame_idx,
            image_from_frame=None if frames is None else frames.image_from_frame,
            points_independent=self.config.points == "independent",
            with_poses=self.config.covariance,
        )

    @cached_property
    def outside(self) -> Outside:
        """What witnesses outside of the images say."""
        return ask(Evidence.of(self.model, self.residuals, self.sigma_constant_px, self._given))

    @cached_property
    def steps(self) -> dict[int, CameraStep]:
        """By row of the camera table: the own parameters of the cameras in the joint system."""
        return {} if self.joint is None else {step.camera_idx: step for step in self.joint.steps}

    @cached_property
    def own(self) -> dict[int, OwnDiagnostics]:
        """By row of the camera table: the same as what decides."""
        return {camera_idx: own_diagnostics(step, step.sigma_px) for camera_idx, step in self.steps.items()}

    @cached_property
    def implied(self) -> dict[int, dict[str, float]]:
        """By row of the camera table and column: changes that parameters which nobody freed would take."""
        return {} if self.joint is None else implied_by_camera(self.joint.implied)

    @cached_property
    def cameras(self) -> list[CameraAudit]:
        """Every camera that has an image with inliers."""
        return audit_cameras(
            self.model,
            self.residuals,
            self.quality,
            self.sigma_constant_px,
            alpha=self.config.alpha,
            tau_px=self.tau_px,
            holds=~self.moved & ~self.consistency.inconsistent,
            retest=self.retest,
        )

    def misfit(self, image_idx: int) -> MisfitDiagnostics | None:
        """The tests on which the verdict about the image in row ``image_idx`` rests; None without inliers."""
        if self.quality[image_idx] is None:
            return None
        sigma_px = float(self.sigma_constant_px[image_idx])
        if self.joint is None or self.consistency.inconsistent[image_idx]:
            rows = self.residuals.rows(image_idx)
            return untested_misfit(rows.stop - rows.start, sigma_px, MisfitStatus.EXCLUDED)
        shared = self.shared_misfit(image_idx) if self.joint.misfit.most_are_wrong else None
        return misfit_diagnostics(self.joint, image_idx, sigma_px, shared)

    def retest(self, image_idx: int, camera: CameraRecord) -> MisfitTests:
        """Return the misfit tests of the image if it had been fitted with this camera, to first order."""
        key = image_idx, camera.model.name, camera.params.tobytes()  # a camera with one image asks what its image asks
        if key not in self._retested:
            self._retested[key] = retested(self.model, self.residuals, image_idx, camera)
        return self._retested[key]

    def shared_misfit(self, image_idx: int) -> SharedMisfit | None:
        """Return what the image's camera shows as a whole, if its images together find a material misfit."""
        camera_id = int(self.model.images.camera_id[image_idx])
        camera = next((c for c in self.cameras if c.camera.camera_id == camera_id), None)
        if camera is None or len(camera.image_idxs) < 2 or not camera.misfit.material or camera.misfit.group is None:
            return None
        found = camera.misfit
        return SharedMisfit.of(camera_id, len(camera.image_idxs), camera.misfit.group, found.px, found.q)

    @cached_property
    def stored_errors(self) -> StoredErrors:
        """The stored point errors beside recomputed ones."""
        return compare_stored_errors(self.model, self.residuals)

    def inliers(self, image: int | str) -> InlierSet:
        """Return the 2D-3D inliers of an image, given its row, its name or ``id:<image_id>``."""
        return inlier_set(self.model, self.residuals, self.model.image_idx(image) if isinstance(image, str) else image)

    def image(self, image: int | str) -> ImageAudit:
        """Audit one image within its model, given its row, its name or ``id:<image_id>``."""
        image_idx = self.model.image_idx(image) if isinstance(image, str) else image
        return audit_image(self.evidence(image_idx), self.config)

    def evidence(self, image_idx: int) -> ImageEvidence:
        """Return what is known of an image before anything is decided, given its row."""
        rows = self.residuals.rows(image_idx)
        residuals_px = self.residuals.residuals_px[:, rows]
        constant, parts = constant_noise(residuals_px), self.consistency
        return ImageEvidence(
            self.inliers(image_idx),
            residuals_px,
            float(self.residuals.pose_offset_px[image_idx]),
            constant,
            self.noise(image_idx, constant),
            track_length=self.tracks.statistics.others.lengths(rows),
            quality=self.quality[image_idx],
            misfit=self.misfit(image_idx),
            retest=partial(self.retest, image_idx),
            consistency=consistency_diagnostics(parts.images[image_idx], all_behind=parts.points_behind),
            half_pixel=parts.half_pixel and bool(parts.images[image_idx].half_pixel),
            testimonies=self.outside.testimonies(image_idx),
            outside=self.outside.columns(image_idx),
            **self._of_camera(image_idx),
        )

    def _of_camera(self, image_idx: int) -> dict[str, Any]:
        """What the joint system says of the image's camera, as `ImageEvidence` has it."""
        quality, joint = self.quality[image_idx], self.joint
        if quality is None:
            return {}
        has_own = bool(fitted_param_idxs(quality.shape.camera.model))
        step = self.steps.get(int(self.model.images.camera_idx[image_idx]))
        if joint is None or step is None or not joint.num_observations[image_idx]:
            return {"has_own": has_own}
        sigma_px = float(self.sigma_constant_px[image_idx])
        return {
            "has_own": has_own,
            "own": self.own[step.camera_idx],
            "gains": gains_of(joint, image_idx),
            "camera": joint_camera(camera_diagnostics(quality), quality, step),
            "expected_error_px": expected_error_px(quality, joint.covariances[image_idx], sigma_px),
            "implied": self.implied.get(step.camera_idx, {}),
            "pose": pose_columns(joint, image_idx, self.model.images.name),
        }

    def noise(self, image_idx: int, constant: ImageNoise) -> ImageNoise:
        """Return the image's noise under the chosen model, given its row and its noise of one scale."""
        match self.config.noise:
            case "constant":
                return constant
            case "track":
                return track_noise(self.tracks, image_idx, constant.sigma_constant_px)
            case "keypoint":
                return keypoint_noise(self.keypoint_tracks, self.tracks, image_idx, constant.sigma_constant_px)

    def standardised(self, image_idx: int) -> tuple[IntArray, FloatArray]:
        """Return which of the image's inliers (m,) the noise model standardises, and their z (m, 2)."""
        rows = self.residuals.rows(image_idx)
        noise = self.noise(image_idx, constant_noise(self.residuals.residuals_px[:, rows]))
        match self.config.noise:
            case "constant":
                used = np.arange(rows.stop - rows.start)
            case "track":
                used = np.flatnonzero(self.tracks.statistics.verified[rows])
            case "keypoint":
                offsets, verified = self.keypoint_tracks.tracks.offsets, self.keypoint_tracks.tracks.statistics.verified
                known = np.flatnonzero(self.keypoint_tracks.known[rows])
                used = known[verified[int(offsets[image_idx]) : int(offsets[image_idx + 1])]]
        return used, noise.z

    def observations(self, labels: ModelLabels | None = None) -> pa.Table:
        """Return what is left of every inlier: the table ``observations``, one row each."""
        length = self.tracks.statistics.track_length
        return observation_table(self.model, self.residuals, length, self.standardised, labels or self._own_labels)

    @property
    def _own_labels(self) -> ModelLabels:
        return ModelLabels("", "", "0", self.model.location)

    def tables(self, labels: ModelLabels | None = None, *, observations: bool = False) -> ModelAudit:
        """Audit all images and return the tables; ``labels`` fill the text columns that name the model."""
        labels = labels or self._own_labels
        _ = self.tau_px, self.moved, self.consistency  # what all of these ask, before the images are spread
        together(lambda: self.joint, lambda: (self.cameras, self.outside, self.tracks))  # what is kept longest, last
        _ = self.config.noise == "keypoint" and self.keypoint_tracks
        parts = self._spread(partial(audit_images, labels=labels), self)
        said = Said.together([part.said for part in parts])
        own_findings = residual_findings(self.stored_errors, self.tracks, len(self.model.points), said.num_exact)
        own_findings += [*consistency_findings(self.consistency), *joint_findings(self.model, self.joint, self.tau_px)]
        findings = [*self.model.findings, *pose_findings(self.model), *own_findings, *self.outside.findings]
        audits = [settled(camera, said.camera_rejected) for camera in self.cameras]
        cameras = camera_columns(self, audits, labels)
        row = model_row(
            self.model, labels, self.tracks, self.stored_errors, findings, said.counts, self.outside.witnesses
        )
        rows = [row for part in parts for row in part.triage_rows]
        of_cameras = triage_rows(cameras, CAMERA_COLUMNS)
        row["diagnoses"] = triage(rows, of_cameras, labels.model_path, parts_disagree=parts_disagree(findings))
        return ModelAudit(
            images_table(parts, self.config.column_groups),
            build_table(cameras, schema("cameras")),
            build_table({name: [value] for name, value in row.items()}, schema("models")),
            self.observations(labels) if observations else None,
        )


def audit_model(
    model: SparseModel,
    config: AuditConfig | None = None,
    labels: ModelLabels | None = None,
    keypoint_scale_px: FloatArray | None = None,
    *,
    observations: bool = False,
    spread: Spread[ModelAuditor] = in_turn,
    given: Given = NOTHING_GIVEN,
) -> ModelAudit:
    """Audit all images of a model.

    Parameters
    ----------
    model : from `loaders.open_model`
    config : noise model and thresholds; the defaults when None
    labels : the text columns that name the model in a dataset
    observations : whether to make the table of observations too, one row per inlier
    keypoint_scale_px, spread, given : see `ModelAuditor`

    Returns
    -------
    ModelAudit
        Arrow tables; ``.images.to_pandas()`` for a data frame. Columns, units, meanings: docs/tables.md.
    """
    # Matrices are small here: a second BLAS thread only waits for the first, and on a busy machine that costs 10 x.
    # Odd numbers end as NaN and undetermined; what numpy says about them on the way is nothing for the terminal.
    with threadpool_limits(limits=1, user_api="blas"), np.errstate(all="ignore"):
        auditor = ModelAuditor(model, config, keypoint_scale_px, spread=spread, given=given)
        return auditor.tables(labels, observations=observations)


def _quality_of(auditor: ModelAuditor, image_idxs: range) -> list[CameraQuality | None]:
    noise_px, grid = auditor.sigma_constant_px, auditor.config.grid
    return quality_of_images(auditor.model, auditor.residuals, noise_px, image_idxs, grid=grid)
