"""Does the advised camera model fit? Switch one camera to it, refine with pycolmap, audit again."""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd
import pycolmap

from scripts.validation.scenes import Design, simulate
from sfm_audit.audit.config import AuditConfig
from sfm_audit.audit.engine.model import ModelAuditor
from sfm_audit.audit.misfit import extended_camera
from sfm_audit.audit.simulate.colmap_files import write_colmap_binary
from sfm_audit.audit.simulate.scene import SimulatedScene
from sfm_audit.loaders import open_model
from sfm_audit.loaders.camera_models import BY_NAME
from sfm_audit.loaders.model import CameraRecord, CameraTable, SparseModel

_MAX_ITERATIONS = 200
_FUNCTION_TOLERANCE = 1e-10


def advise_one(design: Design, scene_idx: int, seed: int) -> pd.DataFrame:
    """Scenes with one defective image: refit with that image's advised camera; no row where it was not rejected."""
    scene, model, _ = simulate(design, scene_idx, seed)
    before = ModelAuditor(model, AuditConfig()).tables().images.to_pandas()
    rows = []
    for defect in scene.defects:
        found = before.iloc[defect.image_idx]
        row = {
            "kind": str(defect.kind),
            "true_px": defect.systematic_px,
            "rejected": found["verdict_misfit"] == "rejected",
            "named": found["misfit_group"],
            "advised": found["advised_camera_model"],
            "passes": None,
        }
        advised = row["advised"] if row["rejected"] else None
        if isinstance(advised, str) and advised in BY_NAME:
            row |= _again(model, defect.image_idx, {int(model.images.camera_idx[defect.image_idx]): advised})
        rows.append({"design": design.name, **row})
    return pd.DataFrame(rows)


def advise_shared(design: Design, scene_idx: int, seed: int) -> pd.DataFrame:
    """Scenes whose images share one wrong camera: refit with the camera's advised model."""
    scene, model, _ = simulate(design, scene_idx, seed)
    camera = ModelAuditor(model, AuditConfig()).tables().cameras.to_pandas().iloc[0]
    advised = camera["advised_camera_model"]
    row: dict[str, object] = {
        "design": design.name,
        "kind": "shared_k2",
        "true_px": _median_size(scene),
        "rejected": advised is not None,
        "named": camera["misfit_group"],
        "advised": advised,
        "passes": None,
    }
    if isinstance(advised, str) and advised in BY_NAME:
        row |= _again(model, None, {0: advised})
    return pd.DataFrame([row])


def _median_size(scene: SimulatedScene) -> float:
    return float(np.median([defect.systematic_px or 0.0 for defect in scene.defects]))


def _again(model: SparseModel, image_idx: int | None, advised: Mapping[int, str]) -> dict[str, object]:
    """What the audit says of the image (None: of the first camera) after refinement with the advised models."""
    refined, converged = refine(with_models(model, advised))
    auditor = ModelAuditor(refined, AuditConfig())
    tables = auditor.tables()
    if image_idx is None:
        camera = tables.cameras.to_pandas().iloc[0]
        num_rejected = int((tables.images.to_pandas()["verdict_misfit"] == "rejected").sum())
        return {
            "passes": auditor.cameras[0].misfit.material == (),
            "accepted": bool((tables.images.to_pandas()["verdict"] == "accepted").all()),
            "converged": converged,
            "left_px": camera["misfit_px"],
            "others_rejected": num_rejected,
        }
    image = tables.images.to_pandas().iloc[image_idx]
    others = tables.images.to_pandas().drop(index=image_idx)
    return {
        "passes": image["verdict_misfit"] == "accepted",
        "accepted": image["verdict"] == "accepted",
        "converged": converged,
        "left_px": image["misfit_px"],
        "others_rejected": int((others["verdict_misfit"] == "rejected").sum()),
    }


def with_models(model: SparseModel, advised: Mapping[int, str]) -> SparseModel:
    """Return the model with some cameras (rows) as ones of larger models, their new parameters 0."""
    cameras: list[CameraRecord] = []
    for row in range(len(model.cameras)):
        camera = model.camera(row)
        if row in advised:
            extended = extended_camera(camera, BY_NAME[advised[row]])
            if extended is None:
                raise ValueError(f"{advised[row]} cannot express {camera.model.name}")
            camera = extended
        cameras.append(camera)
    table = CameraTable(
        np.array([camera.camera_id for camera in cameras], dtype=np.uint32),
        np.array([camera.model.model_id for camera in cameras], dtype=np.int64),
        np.array([camera.width for camera in cameras], dtype=np.int64),
        np.array([camera.height for camera in cameras], dtype=np.int64),
        np.concatenate([camera.params for camera in cameras]),
        np.cumsum([0, *(len(camera.params) for camera in cameras)]).astype(np.int64),
    )
    return dataclasses.replace(model, cameras=table)


def refine(model: SparseModel, *, cameras: bool = True) -> tuple[SparseModel, bool]:
    """Bundle-adjust with pycolmap as COLMAP does by default, by way of files; and whether the solver converged.

    cameras: whether their own parameters are free; poses and points always are.
    """
    with tempfile.TemporaryDirectory() as folder:
        write_colmap_binary(model, Path(folder), np.random.default_rng(0))
        reconstruction = pycolmap.Reconstruction(folder)
        config = pycolmap.BundleAdjustmentConfig()
        for image_id in reconstruction.images:
            config.add_image(image_id)
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
        options = pycolmap.BundleAdjustmentOptions()
        options.print_summary = False
        options.refine_principal_point = False
        options.refine_focal_length = options.refine_extra_params = cameras
        solver = options.ceres.solver_options
        solver.num_threads = 1
        solver.max_num_iterations = _MAX_ITERATIONS
        solver.function_tolerance, solver.gradient_tolerance = _FUNCTION_TOLERANCE, 1e-4
        summary = pycolmap.create_default_bundle_adjuster(options, config, reconstruction).solve()
        reconstruction.write(folder)
        converged = summary.termination_type == pycolmap.BundleAdjustmentTerminationType.CONVERGENCE
        return open_model(folder), converged
