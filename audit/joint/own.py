"""Do the cameras' own parameters sit at their optimum, and how well are they known? (method.md section 11)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from sfm_audit.audit.joint.layout import NUM_POSE, median_of
from sfm_audit.audit.joint.system import JointSystem
from sfm_audit.audit.table.thresholds import MIN_OWN_STEP_SDS
from sfm_audit.loaders.arrays import BoolArray, FloatArray, IntArray

_KEPT_EIGENVALUE: Final = 1e-12
_CURVED: Final = 0.01  # relative step of a focal length from which on its second order matters


@dataclass(frozen=True, slots=True, eq=False)
class CameraStep:
    """What adjusting everything would do to one camera's own parameters.

    camera_idx: row of CameraTable.    image_idxs: its images in the system.    num_observations: theirs.
    names: (q,) own parameters.    stored, step, sd: (q,) in their units. sd: sandwich clustered by track,
    NaN where the parameter is not identified.
    implied: (q,) the values that the step speaks for: stored + step, but see `_implied_focal`; of a material step those
    of `sfm_audit.audit.joint.again.implied_again`.
    plain_step: (q,) with w = 1: what a least-squares adjuster would do. Nothing should be rejected unless both agree.
    own_step_px: what freeing these parameters alone would gain, RMS px; plain_step_px: the same of ``plain_step``.
    sd_focal_rel: sd_f / |f|, of both focal lengths together where there are two (see `_sd_focal_rel`); NaN where one is
    not identified or there is none.
    focal_identified: whether all focal lengths are.
    correlation: (q, q) of the estimates, from the covariance behind ``sd``; NaN where one is not identified.
    sigma_px: median noise of its images.
    """

    camera_idx: int
    image_idxs: IntArray
    num_observations: int
    names: tuple[str, ...]
    stored: FloatArray
    step: FloatArray
    sd: FloatArray
    plain_step: FloatArray
    own_step_px: float
    plain_step_px: float
    sd_focal_rel: float
    focal_identified: bool
    implied: FloatArray
    correlation: FloatArray
    sigma_px: float

    def is_material(self, tau_px: float) -> bool:
        """Whether both steps gain more than tau and a parameter moves by more than 5 sd in both.

        Whom the joint test leaves out: `sfm_audit.audit.decision.camera.material_step` rejects the same cameras.
        """
        gain_px = min(self.own_step_px, self.plain_step_px)
        return bool(gain_px > tau_px and ((np.abs(self.agreed) > MIN_OWN_STEP_SDS * self.sd) & (self.sd > 0)).any())

    @property
    def agreed(self) -> FloatArray:
        """(q,) the smaller of the two steps where they agree in sign, else 0."""
        smaller = np.minimum(np.abs(self.step), np.abs(self.plain_step))
        return np.where(self.step * self.plain_step > 0, np.copysign(smaller, self.step), 0.0)


@dataclass(frozen=True, slots=True)
class Gains:
    """What freeing the pose alone, the camera alone, or both would gain, in units of the noise squared."""

    pose: float
    camera: float
    both: float


def own_parameters(
    system: JointSystem, image_covariances: Mapping[int, FloatArray] | None = None
) -> tuple[CameraStep, ...]:
    """Return the steps of all cameras that have images in the system.

    Parameters
    ----------
    image_covariances : `JointSystem.image_covariances` of images, by image, where they are at hand

    Notes
    -----
    own_step_px = s sqrt(step^T [(S^+)_own]^-1 step / n) in the base system: points, poses and all other cameras
    profiled; s the median sigma and n the observations of the camera's images.
    """
    layout = system.observations.layout
    cameras = np.unique(layout.camera_idx[layout.has_columns]).tolist()
    known = {} if image_covariances is None else image_covariances
    covariances: dict[int, FloatArray] = {}
    for image, covariance in known.items():
        if layout.takes_part(image):
            covariances[int(layout.camera_idx[image])] = covariance[NUM_POSE:, NUM_POSE:]
    missing = [camera for camera in cameras if camera not in covariances]
    found = system.covariances([layout.own_of_camera(camera) for camera in missing])
    covariances.update(zip(missing, found, strict=True))
    gains = _gains_of_cameras(system, cameras)
    return tuple(_camera_step(system, camera, covariances[camera], gains[camera]) for camera in cameras)


def _gains_of_cameras(system: JointSystem, cameras: Sequence[int]) -> dict[int, tuple[float, float]]:
    """What either step of each camera's own parameters gains, in units of the noise squared."""
    own = {camera: system.observations.layout.own_of_camera(camera) for camera in cameras}
    out: dict[int, tuple[float, float]] = {}
    for num in {columns.size for columns in own.values()}:
        alike = [camera for camera in cameras if own[camera].size == num]
        columns = np.stack([own[camera] for camera in alike]).astype(np.int64)
        gains = (walds(system, columns, step[columns]).tolist() for step in (system.base.step, system.plain_step))
        out.update(zip(alike, zip(*gains, strict=True), strict=True))
    return out


def _camera_step(
    system: JointSystem, camera_idx: int, covariance: FloatArray, gains: tuple[float, float]
) -> CameraStep:
    observations, layout = system.observations, system.observations.layout
    camera = system.model.camera(camera_idx)
    columns, params = layout.own_of_camera(camera_idx), list(layout.own_param_idxs[camera_idx])
    images = layout.images_of_camera(camera_idx)
    n = int(np.diff(observations.offsets)[images].sum())
    sigma_px = median_of(observations.sigma_px, images)
    step, plain = system.base.step[columns], system.plain_step[columns]
    sd = np.sqrt(np.maximum(covariance.diagonal(), 0.0))
    focals = [params.index(i) for i in camera.model.focal_idxs]
    sd_focal_rel = _sd_focal_rel(covariance[np.ix_(focals, focals)], camera.params[list(camera.model.focal_idxs)])
    px = [sigma_px * math.sqrt(gain / n) if n else math.nan for gain in gains]
    return CameraStep(
        camera_idx,
        images,
        n,
        tuple(camera.model.param_names[i] for i in params),
        camera.params[params],
        step,
        sd,
        plain,
        px[0],
        px[1],
        sd_focal_rel,
        bool(not focals or math.isfinite(sd_focal_rel)),
        _implied(
            system, images, camera.params[params] + step, [params.index(i) for i in camera.model.focal_idxs], step
        ),
        _correlation(covariance, sd),
        sigma_px,
    )


def _correlation(covariance: FloatArray, sd: FloatArray) -> FloatArray:
    """Return the correlations (q, q) of a covariance, NaN where a standard deviation is not known or zero."""
    with np.errstate(invalid="ignore", divide="ignore"):
        scaled = covariance / sd / sd[:, None]
    known = (sd > 0) & np.isfinite(sd)
    return np.where(known & known[:, None], scaled, math.nan)


def _sd_focal_rel(covariance: FloatArray, focals: FloatArray) -> float:
    """Return sd_f / |f| from the covariance (k, k) of k focal lengths, NaN without any.

    Two focal lengths are one lens: what is asked is how well its focal length is known, pixels taken as square as
    stored. A forward sequence leaves fy open to 0.9 % and fx to 0.1 %; its focal length is known to 0.1 %, and
    own_fy_sd says the rest.
    """
    if not focals.size or not np.isfinite(covariance).all():
        return math.nan
    relative = covariance / focals / focals[:, None]
    if focals.size == 1:
        return math.sqrt(max(float(relative[0, 0]), 0.0))
    one = np.ones(focals.size)
    information = float(one @ np.linalg.pinv(relative, hermitian=True) @ one)
    return 1.0 / math.sqrt(information) if information > 0 else math.nan


def _implied(
    system: JointSystem, images: IntArray, values: FloatArray, focals: list[int], step: FloatArray
) -> FloatArray:
    """Implied values, (q,); focal lengths that move by more than a percent are corrected for the step's curvature."""
    out = values.copy()
    stored = values - step
    large = [k for k in focals if abs(step[k]) > _CURVED * abs(stored[k])]
    if not large:
        return out
    relief = float(np.median([system.relief_change(image) for image in images.tolist()]))
    for k in large:
        out[k] = _implied_focal(float(stored[k]), float(step[k]), relief)
    return out


def _implied_focal(stored: float, step: float, relief: float) -> float:
    """Return f' of a step that changed depth over relief by ``relief`` (relative).

    f / (Z + d) for points with relief d: the linear step says 1 + a - b Z / (Z + d) of it, a = step / f, the truth is
    (1 + a') / (1 + b' Z / (Z + d)). Equal for all d if 1 + a' = s^2 / (s - b), s = 1 + a - b. Poses that followed a
    wrong focal length (8 % too long: linear -8.0 %) come back at once (-7.4 %); where they did not, b = 0.
    """
    scale = 1.0 + step / stored - relief
    if not (scale > 0 and scale - relief > _CURVED):
        return stored + step
    return stored * scale * scale / (scale - relief)


def walds(system: JointSystem, columns: IntArray, steps: FloatArray) -> FloatArray:
    """Return step^T [(S^+)_bb]^-1 step (B,) at columns b (B, k); unidentified directions gain nothing."""
    return _walds(system.base.inverse.main.blocks(columns), ~system.base.inverse.unidentified[columns], steps)


def _walds(blocks: FloatArray, identified: BoolArray, steps: FloatArray) -> FloatArray:
    """The same of blocks (B, k, k) of S^+ and who is identified (B, k)."""
    diagonal = np.einsum("bii->bi", blocks)
    used = (diagonal > 0) & identified
    scale = np.sqrt(np.where(used, diagonal, 1.0))
    unit = np.where(used[:, :, None] & used[:, None, :], blocks / scale[:, None, :] / scale[:, :, None], 0.0)
    np.einsum("bii->bi", unit)[~used] = 1.0  # a parameter by itself, which does not move
    values, vectors = np.linalg.eigh(unit)
    along = (vectors.swapaxes(1, 2) @ np.where(used, steps / scale, 0.0)[:, :, None])[:, :, 0]
    kept = values > _KEPT_EIGENVALUE
    return np.asarray((np.where(kept, along, 0.0) ** 2 / np.where(kept, values, 1.0)).sum(axis=1))


def image_gains(system: JointSystem, image_idxs: Sequence[int]) -> list[Gains]:
    """Return what freeing each image's pose alone, its camera's own parameters alone, or both would gain.

    Notes
    -----
    Everything else is free. step_b^T [(S^+)_bb]^-1 step_b of the camera is what it gains *beside* a free pose, so the
    pose alone gains the rest of both, and the other way round: a focal length that nobody adjusted to gains
    everything alone, and next to nothing beside a pose that makes up for it.
    """
    layout = system.observations.layout
    out = [Gains(math.nan, math.nan, math.nan)] * len(image_idxs)
    columns = layout.columns[list(image_idxs)]
    num_real = (columns < layout.num_columns).sum(axis=1)
    for num in np.unique(num_real[num_real > 0]).tolist():
        places = np.flatnonzero(num_real == num)
        own = columns[places, :num]  # padding comes last
        blocks, identified = system.base.inverse.main.blocks(own), ~system.base.inverse.unidentified[own]
        steps = system.base.step[own]
        both, beside_camera, beside_pose = (
            _walds(blocks[:, part, part], identified[:, part], steps[:, part]).tolist()
            for part in (slice(None), slice(NUM_POSE), slice(NUM_POSE, None))
        )
        for k, place in enumerate(places.tolist()):
            out[place] = Gains(pose=both[k] - beside_pose[k], camera=both[k] - beside_camera[k], both=both[k])
    return out
