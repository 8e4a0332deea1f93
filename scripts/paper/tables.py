"""The paper's tables 1 to 3 on the simulated stand-ins of its two cameras, whose data is not public."""

from __future__ import annotations

from typing import Final, get_args

import numpy as np
import pandas as pd

from scripts.paper.judging import judged
from scripts.paper.rates import TESTS
from sfm_audit.audit.calibrate.estimators import estimator
from sfm_audit.audit.calibrate.zhang import ZhangModel, zhang
from sfm_audit.audit.noise.standardise import constant_noise
from sfm_audit.audit.normality import normality_tests
from sfm_audit.audit.simulate.room import RoomSpec, room_sets, zhang_views

CAMERAS: Final = ("plain", "wide")  # stand for axisp3364 and axis223m
ROOM_MODELS: Final = ("D1", "D3", "pnprf")
NUM_VIEWS: Final = 20
NUM_TRAIN: Final = 12


def zhang_rows(camera: str, seed: int) -> pd.DataFrame:
    """Table 1: a row per model M1 to M5, calibrated on some views and judged on the others."""
    views = zhang_views(camera, seed, num_views=NUM_VIEWS)
    rows = []
    for model in get_args(ZhangModel):
        found = zhang(views[:NUM_TRAIN], model, views[NUM_TRAIN:])
        tests = normality_tests(constant_noise(np.ascontiguousarray(found.residuals_px.T)).z)
        row = {"camera": camera, "seed": seed, "model": model, "sd": found.sd_px, "train_sd": found.train_sd_px}
        row |= {"f": found.camera.focal_px[0], "k1": float(found.camera.coefficients[0])}
        rows.append(row | {f"{test}_robust": getattr(tests, f"{test}_p") for test in TESTS})
    return pd.DataFrame(rows)


def room_rows(camera: str, first: int, last: int, seed: int) -> pd.DataFrame:
    """Tables 2 and 3: a row per set of 24 annotated points and model."""
    rows = []
    for k, room in enumerate(room_sets(RoomSpec(camera_name=camera), seed, last)):
        if k < first:
            continue
        for name in ROOM_MODELS:
            row, _ = judged(name, estimator(name), room.correspondences, np.random.default_rng([seed, k]))
            rows.append({"camera": camera, "set": k, **row})
    return pd.DataFrame(rows)
