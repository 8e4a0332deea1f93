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
    steps: dict[int, CameraStep] = {}
    for alike in _alike(system, cameras):
        of_alike = np.stack([covariances[camera] for camera in alike])
        steps.update(zip(alike, _camera_steps(system, alike, of_alike), strict=True))
    return tuple(steps[camera] for camera in cameras)


def _alike(system: JointSystem, cameras: Sequence[int]) -> list[list[int]]:
    """Cameras of one model together, which have the same own parameters."""
    models: dict[int, list[int]] = {}
    for camera, model in zip(cameras, system.model.cameras.model_id[list(cameras)].tolist(), strict=True):
        models.setdefault(model, []).append(camera)
    return list(models.values())


def _camera_steps(system: JointSystem, cameras: Sequence[int], covariances: FloatArray) -> list[CameraStep]:
    """The steps of cameras of one model; covariances (B, q, q) of their own parameters."""
    observations, layout, records = system.observations, system.observations.layout, map(system.model.camera, cameras)
    model, params = system.model.camera(cameras[0]).model, list(layout.own_param_idxs[cameras[0]])
    every_param = np.stack([record.params for record in records])
    columns = np.stack([layout.own_of_camera(camera) for camera in cameras]).astype(np.int64)
    step, plain = system.base.step[columns], system.plain_step[columns]
    images = _images_of(layout.camera_idx, cameras)
    counts = np.diff(observations.offsets)
    num = np.array([counts[own].sum() for own in images])
    sigma_px = np.array([median_of(observations.sigma_px, own) for own in images])
    with np.errstate(invalid="ignore", divide="ignore"):
        px, plain_px = (
            np.where(num > 0, sigma_px * np.sqrt(walds(system, columns, each) / num), math.nan).tolist()
            for each in (step, plain)
        )
    sd = np.sqrt(np.maximum(np.einsum("bii->bi", covariances), 0.0))
    focals = [params.index(i) for i in model.focal_idxs]
    sd_focal_rel = _sd_focal_rel(covariances[:, focals][:, :, focals], every_param[:, list(model.focal_idxs)]).tolist()
    stored, correlation = every_param[:, params], _correlation(covariances, sd)
    return [
        CameraStep(
            camera,
            images[k],
            int(num[k]),
            tuple(model.param_names[i] for i in params),
            stored[k],
            step[k],
            sd[k],
            plain[k],
            px[k],
            plain_px[k],
            sd_focal_rel[k],
            bool(not focals or math.isfinite(sd_focal_rel[k])),
            _implied(system, images[k], stored[k] + step[k], step[k], focals),
            correlation[k],
            float(sigma_px[k]),
        )
        for k, camera in enumerate(cameras)
    ]


def _images_of(camera_idx: IntArray, cameras: Sequence[int]) -> list[IntArray]:
    """The images of each of some cameras, ascending."""
    order = np.argsort(camera_idx, kind="stable")
    ordered = camera_idx[order]
    first, last = (np.searchsorted(ordered, cameras, side=side).tolist() for side in ("left", "right"))
    return [order[start:stop] for start, stop in zip(first, last, strict=True)]


def _correlation(covariance: FloatArray, sd: FloatArray) -> FloatArray:
    """Correlations (B, q, q) of covariances, NaN where a standard deviation is not known or zero."""
    with np.errstate(invalid="ignore", divide="ignore"):
        scaled = covariance / sd[:, None, :] / sd[:, :, None]
    known = (sd > 0) & np.isfinite(sd)
    return np.where(known[:, None, :] & known[:, :, None], scaled, math.nan)


def _sd_focal_rel(covariance: FloatArray, focals: FloatArray) -> FloatArray:
    """sd_f / |f| (B,) from the covariances (B, k, k) of k focal lengths each, NaN without any.

    Two focal lengths are one lens: what is asked is how well its focal length is known, pixels taken as square as
    stored. A forward sequence leaves fy open to 0.9 % and fx to 0.1 %; its focal length is known to 0.1 %, and
    own_fy_sd says the rest.
    """
    out = np.full(len(focals), math.nan)
    known = np.isfinite(covariance).all(axis=(1, 2)) & (focals.shape[1] > 0)
    relative = covariance[known] / focals[known][:, None, :] / focals[known][:, :, None]
    if focals.shape[1] == 1:
        out[known] = np.sqrt(np.maximum(relative[:, 0, 0], 0.0))
    elif known.any():
        information = np.linalg.pinv(relative, hermitian=True).sum(axis=1).sum(axis=1)
        with np.errstate(invalid="ignore", divide="ignore"):
            out[known] = np.where(information > 0, 1.0 / np.sqrt(information), math.nan)
    return out


def _implied(
    system: JointSystem, images: IntArray, values: FloatArray, step: FloatArray, focals: list[int]
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
