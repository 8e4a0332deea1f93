"""The paper's MegaDepth experiment on a tree of that layout: what KS rejects, under which noise."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Final

import numpy as np
import pandas as pd

from scripts.paper.rates import olsson_accepts
from sfm_audit.audit import ModelAuditor
from sfm_audit.audit.noise.fits import fit_constant_variance
from sfm_audit.audit.noise.standardise import constant_noise, track_noise
from sfm_audit.audit.normality import normality_tests
from sfm_audit.loaders import open_model
from sfm_audit.loaders.datasets.discover import discover

ROOT: Final = Path(__file__).resolve().parents[2]
EDGES: Final = np.linspace(-5.0, 5.0, 41)  # of the densities of z; what lies beyond counts in the outermost bins
NOISES: Final = ("constant", "track")
_KEPT: Final = (
    "image_id",
    "num_inliers",
    "num_standardised",
    "mean_track_length",
    "rms_px",
    "ks_constant_stat",
    "ks_constant_p",
    "kurtosis_constant",
    "ks_stat",
    "ks_p",
    "kurtosis_excess",
    "scale_ratio",
    "misfit_group",
    "misfit_px",
    "misfit_q",
    "verdict_ks",
    "verdict_misfit",
    "verdict_pose",
    "plausible",
    "verdict",
)


def megadepth_folder() -> Path | None:
    """Where the tree lies: below SFM_AUDIT_CORPUS or ../shared/corpus; None without."""
    corpus = Path(os.environ.get("SFM_AUDIT_CORPUS", ROOT.parent / "shared" / "corpus"))
    folder = corpus / "megadepth_like" / "MegaDepth_v1_SfM"
    return folder if folder.is_dir() else None


def model_locations(folder: Path) -> list[tuple[str, str, str]]:
    """Return scene, component and location of every model, in order."""
    found = [(ref.scene, ref.component, str(ref.location)) for ref in discover([folder]).refs]
    return sorted(found)


def megadepth_images(scene: str, component: str, location: str) -> pd.DataFrame:
    """Audit one model with the defaults; a row per image: KS under three noise models, histograms of z under two."""
    auditor = ModelAuditor(open_model(location))
    images = auditor.tables().images.to_pandas()
    kept = images[list(_KEPT)]
    kept.insert(0, "model", f"{scene}/{component}")
    extra = [_extra(auditor, i) for i in range(len(kept))]
    return pd.concat([kept, pd.DataFrame(extra, index=kept.index)], axis=1)


def histogram_columns(noise: str) -> list[str]:
    """Return the columns that count z between `EDGES` under a noise model."""
    return [f"z_{noise}_{k}" for k in range(len(EDGES) - 1)]


def _extra(auditor: ModelAuditor, image_idx: int) -> dict[str, object]:
    """KS on whitened residuals under one scale, Olsson's rule on the raw ones, and the histograms."""
    columns = auditor.residuals.rows(image_idx)
    raw = auditor.residuals.residuals_px[:, columns]
    statistics = auditor.tracks.statistics
    e = statistics.whitened_px[:, columns][:, statistics.verified[columns]]
    if not e.size:
        return {"ks_whitened_p": math.nan, "olsson_rejects": False}
    whitened = normality_tests((e / math.sqrt(fit_constant_variance(e**2).detector_px2)).T)
    row: dict[str, object] = {"ks_whitened_p": whitened.ks_p, "olsson_rejects": not olsson_accepts(np.hypot(*raw))}
    constant = constant_noise(raw)
    track = track_noise(auditor.tracks, image_idx, constant.sigma_constant_px)
    for name, noise in zip(NOISES, (constant, track), strict=True):
        inside = noise.z[np.isfinite(noise.z)].clip(EDGES[0], EDGES[-1])
        row |= dict(zip(histogram_columns(name), np.histogram(inside, EDGES)[0].tolist(), strict=True))
    return row
