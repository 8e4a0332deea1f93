"""Bundle-adjusted scenes with known truth: simulate, adjust with pycolmap, audit, keep what the study counts."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import pandas as pd
import pyarrow as pa

from scripts.validation.rivals import rival_columns
from scripts.validation.truth import CAMERA_DEFECTS, SOUND, noise_of
from sfm_audit.audit.config import AuditConfig
from sfm_audit.audit.engine.model import ModelAuditor
from sfm_audit.audit.misfit import GROUPS
from sfm_audit.audit.misfit.significance import UNTESTED, Significance
from sfm_audit.audit.simulate.adjust import AdjustmentError, adjust_scene, sparse_model
from sfm_audit.audit.simulate.defects import DefectKind, DefectSpec
from sfm_audit.audit.simulate.noise import NoiseKind
from sfm_audit.audit.simulate.scene import SceneSpec, SimulatedScene, simulate_scene
from sfm_audit.audit.table.words import POLICIES, Member, ReasonCode, verdict_under
from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.loaders.model import SparseModel

IMAGES_PER_SCENE = 40
_ATTEMPTS = 3
_SEED = 4
_MAX_DRAWS = 5
_SIZES_PX = (0.2, 1.2)
_POSE_PX = (1.0, 3.0)
_CORNER_POINTS = (8, 25)  # below the last
KEPT = (
    *("num_inliers", "num_standardised", "coverage", "occupied_cells", "rms_px", "mean_px"),
    *("sigma_constant_px", "sigma_d_px", "sigma_l", "sigma_predicted_px", "kurtosis_excess"),
    *(f"{test}_p" for test in ("ks", "ks_fitted", "ks_norm", "dap", "sw", "ks_constant", "ks_fitted_constant")),
    *(f"misfit_{group}_{what}" for group in GROUPS for what in ("p", "px")),
    *(f"misfit_{group}_{what}_joint" for group in GROUPS for what in ("px", "q")),
    *("misfit_group", "misfit_px", "misfit_worth_deg", "misfit_worth_centre", "misfit_worth_focal_rel", "severity"),
    *("advised_camera_model", "pose_offset_px", "own_step_px", "sd_focal_px", "sd_focal_px_conditional"),
    *("verdict_ks", "verdict_misfit", "verdict_camera", "verdict_pose", "plausible", "verdict_noise"),
)


@dataclass(frozen=True, slots=True)
class Design:
    """One kind of scene.

    name: where its rows go in the page.  code: its place in the seeds.   share: of the images with a camera defect.
    num_poses, num_corners: images whose pose was moved after adjustment, or that see only a corner.
    shared_k2: all images share one camera, whose lens has this k2 that the model lacks; None: own cameras.
    """

    name: str
    code: int
    noise: NoiseKind = NoiseKind.GAUSSIAN
    n: int = 400
    share: float = 0.0
    num_poses: int = 0
    num_corners: int = 0
    shared_k2: float | None = None
    scene: SceneSpec = field(default_factory=SceneSpec)

    def spec(self, rng: np.random.Generator, scene_idx: int) -> SceneSpec:
        """Draw which images are defective, in which way and how much."""
        num_images = self.scene.num_images
        num_cameras = round(self.share * num_images)
        order = [int(i) for i in rng.permutation(num_images)]
        defects = []
        for place in range(num_cameras):
            kind = CAMERA_DEFECTS[(place + scene_idx) % len(CAMERA_DEFECTS)]
            defects.append(DefectSpec(order.pop(), kind, float(rng.uniform(*_SIZES_PX))))
        defects += [
            DefectSpec(order.pop(), DefectKind.PERTURBED_POSE, float(rng.uniform(*_POSE_PX)))
            for _ in range(self.num_poses)
        ]
        for _ in range(self.num_corners):
            values = (float(rng.integers(*_CORNER_POINTS)), float(rng.integers(4)))
            defects.append(DefectSpec(order.pop(), DefectKind.FEW_POINTS, values=values))
        if self.shared_k2 is not None and self.shared_k2 > 0:
            defects = [DefectSpec(i, DefectKind.RADIAL_K2, values=(self.shared_k2,)) for i in range(num_images)]
        return replace(
            self.scene,
            points_per_image=self.n,
            noise=noise_of(self.noise),
            shared_camera=self.shared_k2 is not None,
            defects=tuple(defects),
        )


def simulate(design: Design, scene_idx: int, seed: int) -> tuple[SimulatedScene, SparseModel, int]:
    """Simulate and adjust one scene; scenes that bundle adjustment cannot bring to an optimum are drawn again.

    Returns the scene, its model, and how many were drawn in vain (a corner's few points can leave an image adrift).
    """
    noise_idx = list(NoiseKind).index(design.noise)
    for num_failed in range(_MAX_DRAWS):
        rng = np.random.default_rng([seed, _SEED, design.code, noise_idx, design.n, scene_idx, num_failed])
        scene = simulate_scene(design.spec(rng, scene_idx), rng)
        try:
            return scene, sparse_model(scene, adjust_scene(scene)), num_failed
        except AdjustmentError:
            continue
    raise AdjustmentError(f"{design.name}, scene {scene_idx}: {_MAX_DRAWS} scenes could not be adjusted")


def policy_columns(images: pa.Table) -> dict[str, list[str]]:
    """Return what each policy says of every image of an image table."""
    members = images.select([str(member) for member in Member]).to_pylist()
    return {f"policy_{policy}": [str(verdict_under(policy, row)) for row in members] for policy in POLICIES}


def audit_images(design: Design, scene_idx: int, seed: int) -> pd.DataFrame:
    """Audit one scene; a row per image."""
    scene, model, num_failed = simulate(design, scene_idx, seed)
    auditor = ModelAuditor(model, AuditConfig())
    tables = auditor.tables()
    images = tables.images.to_pandas()
    frame = images[list(KEPT)].copy()
    frame.insert(0, "design", design.name)
    frame.insert(1, "noise", str(design.noise))
    frame.insert(2, "n", design.n)
    frame.insert(3, "scene", scene_idx)
    frame["num_failed"] = num_failed
    frame["noise_nu0"] = tables.models["noise_nu0"][0].as_py()
    for code in (ReasonCode.SHARED_CAMERA, ReasonCode.MISFIT_WITHOUT_WORTH):
        frame[str(code)] = [any(text.startswith(code) for text in texts) for texts in images["reasons"]]
    frame = frame.assign(**_joint_columns(auditor), **policy_columns(tables.images))
    frame["effect_alone_px"] = _effect_alone_px(auditor)
    stored = model.cameras.params[model.cameras.param_offsets[model.images.camera_idx]]
    frame["focal_error_px"] = stored - scene.claimed_params[:, 0]
    kinds, sizes = [SOUND] * len(images), [0.0] * len(images)
    for defect in scene.defects:
        kinds[defect.image_idx], sizes[defect.image_idx] = str(defect.kind), defect.systematic_px or 0.0
    frame["kind"], frame["true_px"] = kinds, sizes
    return pd.concat([frame, rival_columns(auditor)], axis=1)


def _joint_columns(auditor: ModelAuditor) -> dict[str, FloatArray]:
    """Return the p of every group in the joint test, and each image's largest significant effect."""
    joint = auditor.joint
    if joint is None:
        raise ValueError("a scene whose parts do not belong together")
    tests = joint.misfit.tests
    p = {f"misfit_{group}_p_joint": np.array([image[group].p for image in tests]) for group in GROUPS}
    return {**p, "effect_joint_px": joint.misfit.effect_px}


def _effect_alone_px(auditor: ModelAuditor) -> FloatArray:
    """Return the largest significant effect of each image (I,), 0 without any, image by image as the model stands."""
    found = Significance.of([UNTESTED if each is None else each.misfit for each in auditor.quality])
    return np.asarray(np.where(found.q < auditor.config.alpha, found.px, 0.0).max(axis=1))


def audit_shared_camera(design: Design, scene_idx: int, seed: int) -> pd.DataFrame:
    """Audit one scene whose images share a camera; one row: the pooled tests and what the images say."""
    _, model, num_failed = simulate(design, scene_idx, seed)
    tables = ModelAuditor(model, AuditConfig()).tables()
    camera, images = tables.cameras.to_pandas().iloc[0], tables.images.to_pandas()
    rejected = images["verdict_misfit"] == "rejected"
    shared = pd.Series([any(text.startswith("shared_camera") for text in texts) for texts in images["reasons"]])
    row = {
        "design": design.name,
        "noise": str(design.noise),
        "n": design.n,
        "k2": design.shared_k2,
        **{f"misfit_{group}_{what}": camera[f"misfit_{group}_{what}"] for group in GROUPS for what in ("p", "px")},
        "misfit_group": camera["misfit_group"],
        "advised_camera_model": camera["advised_camera_model"],
        "share_rejected": float(rejected.mean()),
        "share_shared_reason": float(shared.mean()),
        "num_images": len(images),
        "num_failed": num_failed,
    }
    return pd.DataFrame([row])
