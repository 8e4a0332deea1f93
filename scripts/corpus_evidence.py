"""What corpus_report.py needs to know of a model beyond its tables: numbers that tell lens, motion and noise apart."""

from __future__ import annotations

import dataclasses
import math
import tempfile
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd
import pycolmap
from scipy.spatial import cKDTree

from sfm_audit.audit import ModelAuditor, audit_model
from sfm_audit.audit.misfit import (
    GROUPS,
    MisfitGroup,
    camera_tests,
    candidate_fields,
    image_design,
    nuisance_columns,
    prepare,
    project_image,
)
from sfm_audit.audit.misfit.capabilities import extended_params
from sfm_audit.audit.misfit.fields import GROUP_COLUMNS
from sfm_audit.audit.misfit.pooled import ImageDesign
from sfm_audit.audit.noise.fits import fit_constant_variance
from sfm_audit.audit.normality import normality_tests
from sfm_audit.audit.simulate.colmap_files import write_colmap_binary
from sfm_audit.audit.table.words import Member, Verdict
from sfm_audit.loaders import ModelRef, SparseModel, open_model
from sfm_audit.loaders.arrays import FloatArray, IntArray
from sfm_audit.loaders.camera_models import BY_NAME

SIGNIFICANT: Final = 0.01
MIN_INLIERS: Final = 50
CELLS_PER_SIDE: Final = 24
NEIGHBOURS_PER_SIDE: Final = 40
SAME_KEYPOINT_PX: Final = 0.5
SMOOTH: Final = MisfitGroup.SMOOTH


@dataclass(frozen=True, slots=True, eq=False)
class AuditedModel:
    """A model's tables, and what else was measured.

    images, cameras: data frames.    model: its row of the table of models.    whitened: per image, ks_p and kurtosis
    of e / robust sd of e.    numbers: by name, see `evidence` and `summary_numbers`.
    """

    name: str
    dataset: str
    images: pd.DataFrame
    cameras: pd.DataFrame
    model: Mapping[str, Any]
    whitened: pd.DataFrame
    numbers: Mapping[str, float]

    @property
    def num_rejected(self) -> int:
        """Images that the policy rejects."""
        return int((self.images.verdict == Verdict.REJECTED).sum())

    @property
    def share_rejected(self) -> float:
        """Of the images."""
        return self.num_rejected / len(self.images) if len(self.images) else 0.0


def audit_for_report(name: str, ref: ModelRef, *, refit: Sequence[str] = ()) -> AuditedModel:
    """Audit a model; ``refit`` names camera models to adjust it with and audit again."""
    model = open_model(ref.location)
    auditor = ModelAuditor(model)
    tables = auditor.tables()
    images, cameras = tables.images.to_pandas(), tables.cameras.to_pandas()
    row = tables.models.to_pylist()[0]
    numbers = summary_numbers(images)
    if (images.verdict == Verdict.REJECTED).mean() > 0.5:
        numbers |= evidence(auditor)
        for camera_model in refit:
            numbers |= refit_numbers(model, camera_model)
    return AuditedModel(name, ref.dataset, images, cameras, row, whitened_tests(auditor), numbers)


def whitened_tests(auditor: ModelAuditor) -> pd.DataFrame:
    """KS p and excess kurtosis of e / robust sd of e, by row of the image table."""
    rows = []
    for i in range(len(auditor.model.images)):
        columns = auditor.residuals.rows(i)
        statistics = auditor.tracks.statistics
        e = statistics.whitened_px[:, columns][:, statistics.verified[columns]]
        tests = normality_tests((e / math.sqrt(fit_constant_variance(e**2).detector_px2)).T)
        rows.append({"ks_p": tests.ks_p, "kurtosis": tests.kurtosis_excess})
    return pd.DataFrame(rows, columns=["ks_p", "kurtosis"])


def summary_numbers(images: pd.DataFrame) -> dict[str, float]:
    """Medians over images, and how many of them each verdict rejects and each cause is named for."""
    numbers = {
        "images": float(len(images)),
        "sigma_px": images.sigma_constant_px.median(),
        "ks_distance": images.ks_stat.median(),
        "num_values": 2.0 * images.num_standardised.median(),
        "kurtosis": images.kurtosis_excess.median(),
        "kurtosis_constant": images.kurtosis_constant.median(),
        "track_length": images.mean_track_length.median(),
        "focal_over_size": images.focal_over_size.median(),
        "pose_offset_px": images.pose_offset_px.median(),
        "num_inliers": images.num_inliers.median(),
        "unverifiable": (images.num_unverifiable / images.num_inliers).median(),
        "folds": float(images.folds_over.fillna(value=False).sum()),
    }
    for member in (member for member in Member if member is not Member.OUTSIDE):
        numbers[f"rejected_{member.short}"] = float((images[member] == Verdict.REJECTED).sum())
    numbers["undetermined_plausible"] = float((images.plausible == Verdict.UNDETERMINED).sum())
    for name in ("deg", "centre", "focal_rel"):
        numbers[f"worth_{name}"] = images[f"misfit_worth_{name}"].astype(float).abs().median()
    numbers["misfit_px"] = images.misfit_px.median()
    for group in GROUPS:
        numbers[f"{group}_px"] = images[f"misfit_{group}_px"].median()
        numbers[f"joint_{group}_px"] = images[f"misfit_{group}_px_joint"].median()
        numbers[f"cause_{group}"] = float((images.misfit_group == group).sum())
    return {name: float(value) for name, value in numbers.items()}


def evidence(auditor: ModelAuditor) -> dict[str, float]:
    """Numbers that tell a lens from motion and both from noise that neighbours share; medians over images."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        per_image = [found for i in range(len(auditor.model.images)) if (found := _image_evidence(auditor, i))]
        medians = pd.DataFrame(per_image).astype(float)
    if not len(medians):
        return _common(auditor)
    numbers = {name: float(medians[name].median()) for name in ("beyond_rs_px",)}
    numbers |= {
        name: float(medians[name].mean()) for name in ("by_observations", "by_cells", "beyond_rs", "neighbours")
    }
    return numbers | {"persistence": _persistence(auditor)} | _common(auditor)


def _image_evidence(auditor: ModelAuditor, image_idx: int) -> dict[str, float] | None:
    fact, columns = auditor.quality[image_idx], auditor.residuals.rows(image_idx)
    if fact is None or columns.stop - columns.start < MIN_INLIERS:
        return None
    camera, y = fact.shape.camera, auditor.residuals.residuals_px[:, columns]
    inliers = auditor.inliers(image_idx)
    projected = project_image(camera, inliers.image.cam_from_world(inliers.xyz_world))
    nuisance, fields = nuisance_columns(camera.model, projected), candidate_fields(camera, projected)
    shutter = fields[GROUP_COLUMNS[MisfitGroup.ROLLING_SHUTTER]]
    longer = max(camera.width, camera.height)
    cells = _cells(inliers.xy_px, longer / CELLS_PER_SIDE)
    beyond = prepare(np.concatenate([nuisance, shutter]), fields).test(y)[SMOOTH]
    by_observations = prepare(nuisance, fields).test(y)[SMOOTH]
    by_cells = prepare(nuisance, fields, clusters=cells).test(y)[SMOOTH]
    return {
        "beyond_rs_px": beyond.px,
        "beyond_rs": _significant(beyond.p),
        "by_observations": _significant(by_observations.p),
        "by_cells": _significant(by_cells.p),
        "neighbours": _neighbours(inliers.xy_px, y, longer / NEIGHBOURS_PER_SIDE),
    }


def _significant(p: float) -> float:
    return math.nan if math.isnan(p) else float(p < SIGNIFICANT)


def _cells(xy_px: FloatArray, side_px: float) -> IntArray:
    """Number the cells of a grid; equal numbers are in one cell."""
    _, number = np.unique(np.floor(xy_px / side_px), axis=0, return_inverse=True)
    return number.ravel().astype(np.int64)


def _neighbours(xy_px: FloatArray, residuals_px: FloatArray, radius_px: float) -> float:
    """Correlation of residuals (2, n) of points closer than the radius, pairs on one keypoint left out."""
    pairs = cKDTree(xy_px).query_pairs(radius_px, output_type="ndarray")
    apart = np.linalg.norm(xy_px[pairs[:, 0]] - xy_px[pairs[:, 1]], axis=1) > SAME_KEYPOINT_PX
    first, second = pairs[apart].T
    if not first.size:
        return math.nan
    return float(
        (residuals_px[:, first] * residuals_px[:, second]).sum() / first.size / (residuals_px**2).sum(axis=0).mean()
    )


def _persistence(auditor: ModelAuditor) -> float:
    """Correlation of a point's residuals in an image and the next one by name."""
    residuals, order = auditor.residuals, np.argsort(auditor.model.images.name)
    both, squares = 0.0, 0.0
    for i, j in zip(order[:-1].tolist(), order[1:].tolist(), strict=True):
        first, second = residuals.rows(i), residuals.rows(j)
        _, a, b = np.intersect1d(residuals.point_idx[first], residuals.point_idx[second], return_indices=True)
        x, y = residuals.residuals_px[:, first][:, a], residuals.residuals_px[:, second][:, b]
        both += float((x * y).sum())
        squares += 0.5 * float((x**2).sum() + (y**2).sum())
    return both / squares if squares else math.nan


def _common(auditor: ModelAuditor) -> dict[str, float]:
    """Return px of the fields that all images have in common, each image's own pose and intrinsics profiled."""
    used = [
        i for i, fact in enumerate(auditor.quality) if fact is not None and not fact.shape.camera.model.is_spherical
    ]

    def design(k: int) -> ImageDesign:
        fact, columns = auditor.quality[used[k]], auditor.residuals.rows(used[k])
        if fact is None:
            raise ValueError("an image without inliers")
        inliers = auditor.inliers(used[k])
        xyz_cam = inliers.image.cam_from_world(inliers.xyz_world)
        own = image_design(fact.shape.camera, xyz_cam, auditor.residuals.residuals_px[:, columns], inliers.point_idx)
        nuisance = np.concatenate([own.pose, own.intrinsics])
        return ImageDesign(nuisance, own.intrinsics[:0], own.fields, own.residuals_px, own.track)

    tests = camera_tests(design, len(used), len(auditor.model.points)).tests
    return {f"common_{group}_px": tests[group].px for group in GROUPS}


def refit_numbers(model: SparseModel, camera_model: str) -> dict[str, float]:
    """Adjust the model with another camera model and audit it again: ``refit_<model>_<number>``."""
    with tempfile.TemporaryDirectory() as before, tempfile.TemporaryDirectory() as after:
        write_colmap_binary(_with_cameras(model, camera_model), Path(before), np.random.default_rng(0))
        reconstruction = pycolmap.Reconstruction(before)
        options = pycolmap.BundleAdjustmentOptions()
        options.print_summary = False
        pycolmap.logging.minloglevel = int(pycolmap.logging.WARNING)
        pycolmap.bundle_adjustment(reconstruction, options)
        reconstruction.write(after)
        numbers = summary_numbers(audit_model(open_model(after)).images.to_pandas())
    return {f"refit_{camera_model}_{name}": value for name, value in numbers.items()}


def _with_cameras(model: SparseModel, name: str) -> SparseModel:
    """The same model with all cameras as those of a larger camera model, new terms zero."""
    larger = BY_NAME[name]
    params = []
    for i in range(len(model.cameras)):
        camera = model.camera(i)
        extended = camera.params if camera.model is larger else extended_params(camera.model, camera.params, larger)
        if extended is None:
            raise ValueError(f"{name} cannot express {camera.model.name}")
        params.append(extended)
    cameras = dataclasses.replace(
        model.cameras,
        model_id=np.full(len(params), larger.model_id, dtype=np.int64),
        params=np.concatenate(params),
        param_offsets=np.arange(len(params) + 1, dtype=np.int64) * larger.num_params,
    )
    return dataclasses.replace(model, cameras=cameras)
