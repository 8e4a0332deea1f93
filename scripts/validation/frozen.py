"""Parameters that nobody freed: wrong values set, poses and points adjusted around them, then audited."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from enum import StrEnum
from typing import Final

import numpy as np
import pandas as pd

from scripts.validation.advice import refine
from scripts.validation.scenes import policy_columns
from scripts.validation.truth import noise_of
from sfm_audit.audit.config import AuditConfig
from sfm_audit.audit.engine.model import ModelAuditor
from sfm_audit.audit.joint import CameraStep
from sfm_audit.audit.simulate.adjust import AdjustmentError, adjust_scene, sparse_model
from sfm_audit.audit.simulate.defects import DefectKind, DefectSpec
from sfm_audit.audit.simulate.noise import NoiseKind
from sfm_audit.audit.simulate.scene import SceneSpec, SimulatedScene, simulate_scene
from sfm_audit.audit.simulate.truth import claimed_params_of
from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.loaders.camera_models import BY_NAME
from sfm_audit.loaders.model import SparseModel

_SEED: Final = 5
_MAX_DRAWS: Final = 5
NUM_IMAGES: Final = 24
POINTS_PER_IMAGE: Final = 400
FOCAL_FACTOR: Final = 1.08
K1_CHANGE: Final = 0.04
MAX_SDS: Final = 5.0
MAX_SHARE: Final = 0.02
_K1_RANGES: Final = ((-0.06, -0.03), (0.03, 0.06))


class Frozen(StrEnum):
    """What is wrong; in the first three each image has its own SIMPLE_RADIAL camera, or all share one."""

    NOTHING = "nothing (healthy twin)"
    TWO_FOCALS = "f of 2 of 24 cameras wrong by 8 %"
    TWO_K1 = "k1 of 2 of 24 cameras wrong by 0.04"
    SHARED_K1 = "k1 of a shared camera at 0"
    SHARED_TANGENTIAL = "p1 and p2 of a shared camera exchanged"
    SHARED_DISTORTION = "k1, k2, p1, p2 of a shared camera at 0"


_OWN_CAMERAS: Final = frozenset({Frozen.NOTHING, Frozen.TWO_FOCALS, Frozen.TWO_K1})
_OPENCV: Final = frozenset({Frozen.SHARED_TANGENTIAL, Frozen.SHARED_DISTORTION})


def _scene_of(case: Frozen, noise: NoiseKind, scene_idx: int, rng: np.random.Generator) -> SimulatedScene:
    """A sound scene; shared lenses have at least 0.03 of k1, OPENCV's also p1, p2 of about 0.002 and opposite signs."""
    defects: tuple[DefectSpec, ...] = ()
    if case in _OPENCV:
        sign = float(rng.choice([-1.0, 1.0]))
        values = (sign * float(rng.uniform(0.0015, 0.0025)), -sign * float(rng.uniform(0.001, 0.002)))
        defects = tuple(DefectSpec(i, DefectKind.TANGENTIAL, values=values) for i in range(NUM_IMAGES))
    spec = SceneSpec(
        num_images=NUM_IMAGES,
        points_per_image=POINTS_PER_IMAGE,
        camera_model="OPENCV" if case in _OPENCV else "SIMPLE_RADIAL",
        shared_camera=case not in _OWN_CAMERAS,
        noise=noise_of(noise),
        defects=defects,
    )
    if case not in _OWN_CAMERAS:
        spec = replace(spec, k1_range=_K1_RANGES[scene_idx % 2])
    return simulate_scene(spec, rng)


def simulate_frozen(
    case: Frozen, noise: NoiseKind, scene_idx: int, seed: int
) -> tuple[SparseModel, FloatArray, dict[int, tuple[str, ...]]]:
    """Return a model with wrong frozen parameters; the true parameters (C, p); and which are wrong, by camera row.

    Adjusted once with everything free, then with the wrong values fixed: what importing a calibration that is wrong
    in these values leaves.
    """
    for num_failed in range(_MAX_DRAWS):
        entropy = [seed, _SEED, list(Frozen).index(case), list(NoiseKind).index(noise), scene_idx, num_failed]
        rng = np.random.default_rng(entropy)
        scene = _scene_of(case, noise, scene_idx, rng)
        try:
            model = sparse_model(scene, adjust_scene(scene))
        except AdjustmentError:
            continue
        wrong = _wrong_params(case, rng, len(model.cameras))
        planted = _with_params(model, case, wrong, scene_idx)
        refined, converged = refine(planted, cameras=False)
        if converged:
            truth = claimed_params_of(BY_NAME[scene.spec.camera_model], scene.cameras.params)
            return refined, truth[: len(model.cameras)], wrong
    raise AdjustmentError(f"{case}, scene {scene_idx}: {_MAX_DRAWS} scenes could not be adjusted")


def _wrong_params(case: Frozen, rng: np.random.Generator, num_cameras: int) -> dict[int, tuple[str, ...]]:
    """Which cameras (rows) are wrong, and in what."""
    match case:
        case Frozen.NOTHING:
            return {}
        case Frozen.TWO_FOCALS:
            return {int(row): ("f",) for row in sorted(rng.permutation(num_cameras)[:2])}
        case Frozen.TWO_K1:
            return {int(row): ("k",) for row in sorted(rng.permutation(num_cameras)[:2])}
        case Frozen.SHARED_K1:
            return {0: ("k",)}
        case Frozen.SHARED_TANGENTIAL:
            return {0: ("p1", "p2")}
        case Frozen.SHARED_DISTORTION:
            return {0: ("k1", "p1", "p2")}


def _with_params(model: SparseModel, case: Frozen, wrong: dict[int, tuple[str, ...]], scene_idx: int) -> SparseModel:
    params, up = model.cameras.params.copy(), scene_idx % 2 == 0
    for row in wrong:
        names = model.camera(row).model.param_names
        own = params[int(model.cameras.param_offsets[row]) :][: len(names)]
        _SPOIL[case](own, names, up)
    return replace(model, cameras=replace(model.cameras, params=params))


def _focal(own: FloatArray, names: Sequence[str], up: bool) -> None:
    own[names.index("f")] *= FOCAL_FACTOR if up else 1.0 / FOCAL_FACTOR


def _k1(own: FloatArray, names: Sequence[str], up: bool) -> None:
    own[names.index("k")] += K1_CHANGE if up else -K1_CHANGE


def _exchanged(own: FloatArray, names: Sequence[str], _: bool) -> None:
    pair = [names.index("p1"), names.index("p2")]
    own[pair] = own[pair[::-1]]


def _zeroed(own: FloatArray, names: Sequence[str], _: bool) -> None:
    for name in ("k", "k1", "k2", "p1", "p2"):
        if name in names:
            own[names.index(name)] = 0.0


_SPOIL: Final[dict[Frozen, Callable[[FloatArray, Sequence[str], bool], None]]] = {
    Frozen.TWO_FOCALS: _focal,
    Frozen.TWO_K1: _k1,
    Frozen.SHARED_K1: _zeroed,
    Frozen.SHARED_TANGENTIAL: _exchanged,
    Frozen.SHARED_DISTORTION: _zeroed,
}


def audit_frozen(case: Frozen, noise: NoiseKind, scene_idx: int, seed: int) -> pd.DataFrame:
    """Audit one model with frozen parameters: a row per image, with what the step implies for its camera."""
    model, truth, wrong = simulate_frozen(case, noise, scene_idx, seed)
    auditor = ModelAuditor(model, AuditConfig())
    tables = auditor.tables()
    images = tables.images.to_pandas()
    frame = images[["own_step_px", "pose_offset_px", "verdict_misfit", "verdict_camera", "verdict_pose"]].copy()
    frame.insert(0, "case", str(case))
    frame.insert(1, "noise", str(noise))
    frame.insert(2, "scene", scene_idx)
    for name, values in policy_columns(tables.images).items():
        frame[name] = values
    frame["guilty"] = np.isin(model.images.camera_idx, list(wrong))
    frame["named"] = [_named(texts) for texts in images["reasons"]]
    rows = model.images.camera_idx.tolist()
    true = [dict(zip(model.camera(row).model.param_names, truth[row].tolist(), strict=True)) for row in rows]
    found = [_implied(auditor.steps.get(row), true[k], wrong.get(row, ())) for k, row in enumerate(rows)]
    return pd.concat([frame, pd.DataFrame(found)], axis=1)


def _named(reasons: Sequence[str]) -> str | None:
    """The parameter that camera_not_optimal names."""
    told = [text for text in reasons if text.startswith("camera_not_optimal")]
    return told[0].split(":", 1)[1].split("=", 1)[0].strip() if told else None


def _implied(step: CameraStep | None, truth: Mapping[str, float], wrong: Sequence[str]) -> dict[str, object]:
    """How far the implied values of the wrong parameters are from the truth: the worst, in sd and as a share."""
    empty = {"wrong": ", ".join(wrong), "off_sd": np.nan, "off_rel": np.nan, "implied_right": False}
    if step is None or not wrong:
        return empty
    names = list(step.names)
    own = [names.index(name) for name in wrong]
    true = np.array([truth[name] for name in wrong])
    off = np.abs(step.implied[own] - true)
    sds, shares = off / step.sd[own], off / np.abs(true)
    right = bool(((sds <= MAX_SDS) | (shares <= MAX_SHARE)).all())
    return {**empty, "off_sd": float(sds.max()), "off_rel": float(shares.max()), "implied_right": right}
