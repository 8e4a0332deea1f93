"""No effect of a misfit exceeds what the residuals of its image can hold, on all public models."""

from __future__ import annotations

import numpy as np
from corpus import parametrize_models

from sfm_audit.audit import audit_model
from sfm_audit.audit.table.words import GROUPS
from sfm_audit.loaders import open_model

MOST = {"": 1.0 + 1e-6, "_joint": 1.5}  # as the model stands, a projection; joint, with the points' freedom


@parametrize_models(more=True)
def test_no_effect_exceeds_the_residuals(model_dir):
    images = audit_model(open_model(model_dir)).images.to_pandas()
    rms_px = images.rms_px.astype(float).to_numpy()
    for suffix, most in MOST.items():
        for group in GROUPS:
            px = images[f"misfit_{group}_px{suffix}"].astype(float).to_numpy()
            known = np.isfinite(px)
            assert (px[known] <= most * rms_px[known]).all(), (group, suffix)
    named = images.misfit_px.notna()
    assert (images.misfit_px[named] <= 1.5 * images.rms_px[named]).all()
