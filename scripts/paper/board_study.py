"""The paper's Figure 3: a board comes closer, D(1,0) (wrong) and D(3,0) (right) are estimated from each set."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
import pandas as pd

from scripts.paper.judging import judged
from scripts.paper.rates import ALPHA, thirds_of
from sfm_audit.audit.calibrate.estimate import Estimate
from sfm_audit.audit.calibrate.estimators import estimator
from sfm_audit.audit.calibrate.validation import validate
from sfm_audit.audit.misfit import GROUPS, MisfitTests, candidate_fields, prepare
from sfm_audit.audit.misfit.multiplicity import holm
from sfm_audit.audit.simulate.board import BoardSet, BoardSpec, board_sets

WRONG, RIGHT = "D1", "D3"
MODELS: Final = (WRONG, RIGHT)
RENDERED, POINTS = "rendered", "points"
PROTECTIONS: Final = ("taken as exact", "taken as measured")


@dataclass(frozen=True, slots=True)
class BoardDesign:
    """What is simulated: ``source`` is `RENDERED` or `POINTS`."""

    source: str
    spec: BoardSpec = field(default_factory=BoardSpec)

    def with_truth(self, k1: float, k2: float, k3: float) -> BoardDesign:
        """The same study of another lens."""
        return replace(self, spec=replace(self.spec, coefficients=(k1, k2, k3)))


def board_rows(design: BoardDesign, seed: int) -> pd.DataFrame:
    """Return a row per set and model; sets are numbered from 1 by coverage."""
    boards = board_sets(design.spec, seed, rendered=design.source == RENDERED)
    coverage = pd.Series([board.coverage for board in boards])
    third, rank = thirds_of(coverage), coverage.rank(method="first").astype(int)
    rows = []
    for k, board in enumerate(boards):
        detector = board.correspondences.xy_px - board.true_xy_px
        about = {"source": design.source, "seed": seed, "set": int(rank[k]), "third": third[k]}
        about |= {"coverage": board.coverage, "detector_sd": float(np.sqrt((detector**2).mean()))}
        for name in MODELS:
            rng = np.random.default_rng([seed, k])
            rows.append(about | judged(name, estimator(name), board.correspondences, rng)[0])
    return pd.DataFrame(rows)


def protection_rows(design: BoardDesign, seed: int) -> pd.DataFrame:
    """Return, per set, model and `PROTECTIONS`, whether any misfit group is significant after Holm.

    Scanned 3D points have errors, and of a field that the pose would explain at exact points it leaves nothing but
    these errors. `audit.calibrate.lens_misfit` minds that, the test of images in a reconstruction does not.
    """
    boards = board_sets(design.spec, seed, rendered=design.source == RENDERED)
    third = thirds_of(pd.Series([board.coverage for board in boards]))
    rows = []
    for k, board in enumerate(boards):
        for name in MODELS:
            estimate = estimator(name)(board.correspondences, np.random.default_rng([seed, k]))
            measured = validate(estimate, board.correspondences).tests
            for points, tests in zip(PROTECTIONS, (_as_exact_points(estimate, board), measured), strict=True):
                p = holm(np.array([tests[group].p for group in GROUPS]))
                about = {"model": name, "third": third[k], "points": points}
                rows.append(about | {"significant": bool(np.nanmin(p) < ALPHA)})
    return pd.DataFrame(rows)


def _as_exact_points(estimate: Estimate, board: BoardSet) -> MisfitTests:
    """Test as the images of a reconstruction are tested."""
    kept = estimate.inliers
    projected = estimate.project(board.correspondences.xyz_world[kept])
    prepared = prepare(
        np.concatenate([projected.pose, projected.d_params]), candidate_fields(estimate.camera.pinhole, projected)
    )
    return prepared.test(np.ascontiguousarray(estimate.residuals_px[kept].T))
