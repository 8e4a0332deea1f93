"""What version 0.1.0 (commit fbf7037) said of the public models, policy `full`: measured then, kept to compare with."""

from __future__ import annotations

from typing import Final

import numpy as np
import pandas as pd

from sfm_audit.audit.table.words import Member, ReasonCode, Verdict

LISTED: Final = (Verdict.ACCEPTED, Verdict.REJECTED, Verdict.UNDETERMINED)
BEFORE_INTRO: Final = """\
The same models by version 0.1.0 (commit fbf7037, policy `full`: KS at 5 %, images tested one by one with the points as
they are, deviations conditional on the points) and now (policy `standard`: the joint system of method.md, section 11).
A share that is rejected here is no error rate: nobody knows the truth of these models
([realtruth.md](realtruth.md) has models where it is known)."""
VERDICTS: Final[dict[str, str]] = {
    "9001": "5/2/3",
    "9002/0": "0/15/2",
    "9002/1": "0/7/4",
    "9003/0": "0/0/2",
    "9003/1": "4/5/1",
    "bartoszek_dense": "8/1/14",
    "bartoszek_sparse": "8/1/14",
    "bjr_20e0_dense": "23/2/0",
    "bjr_20e0_sparse": "24/1/0",
    "cedric_0401": "0/7/0",
    "flaugusto_rigs0": "0/0/2",
    "fobdor_0": "0/0/3",
    "gtsfm_astrovision_vesta": "0/4/0",
    "gtsfm_crane_mast_txt": "0/8/0",
    "gtsfm_lund_cluster_txt": "3/0/0",
    "gtsfm_lund_gt_txt": "0/12/0",
    "gtsfm_palace_txt": "0/11/0",
    "gtsfm_unsorted_txt": "0/0/3",
    "halogen_mvs": "3/2/0",
    "halogen_sparse": "3/2/0",
    "hexgp_b0b3": "13/0/0",
    "hsu_fox_bin": "8/47/0",
    "hsu_fox_txt": "8/47/0",
    "kapture_maupertuis_txt": "4/0/0",
    "marychrisgo_dense": "1/4/0",
    "multicam_robot_bin": "7/35/0",
    "own_sceaux_castle_opencv": "0/11/0",
    "own_south_building_sub_radial": "10/7/0",
    "pradyumna_s1": "4/30/0",
    "pratikk_sfm_1": "0/25/67",
    "pratikk_sfm_7": "0/14/0",
    "sbcv_sceaux_bin": "0/11/0",
    "sbcv_sceaux_percam_txt": "0/11/0",
    "sbcv_subfolders_txt": "1/8/0",
    "softmurata": "139/11/27",
    "terteros_bin": "1/2/0",
    "terteros_txt": "1/2/0",
    "wesley_cup0": "0/0/2",
    "yifr": "0/24/1",
    "yinsy_A": "3/38/0",
    "yoojuno_r1_1": "0/2/0",
    "yowsitian_dense": "8/110/0",
    "yowsitian_sparse": "5/113/0",
}
"""By model: images accepted / rejected / undetermined."""
REJECTED: Final[dict[str, int]] = {
    "verdict_misfit": 487,
    "verdict_pose": 11,
    "plausible": 40,
    "verdict_ks": 187,
}
"""Images that a verdict rejects; verdict_camera and verdict_noise did not exist."""
REASONS: Final[dict[str, int]] = {
    "misfit_smooth": 223,
    "misfit_rolling_shutter": 147,
    "misfit_affine": 44,
    "misfit_radial": 40,
    "misfit_principal_point": 19,
    "misfit_tangential": 14,
    "pose_not_optimal": 11,
    "distortion_folds": 30,
    "focal_out_of_range": 25,
}
"""Rejected images that have a reason which rejects; an image can have several."""
UNDETERMINED: Final[dict[str, int]] = {
    "focal_not_identified": 99,
    "low_coverage": 96,
    "too_few_observations": 14,
    "few_occupied_cells": 8,
}
"""Undetermined images that have a reason; an image can have several."""


def counts() -> str:
    """Images accepted/rejected/undetermined by version 0.1.0."""
    return "/".join(map(str, np.array([said.split("/") for said in VERDICTS.values()], int).sum(axis=0)))


def page_part(images: pd.DataFrame) -> list[str]:
    """Shares rejected and undetermined, before and now, per verdict and reason."""
    rows: list[tuple[str, int | None, int]] = []
    for verdict, then in zip(LISTED, counts().split("/"), strict=True):
        rows.append((str(verdict), int(then), int((images.verdict == verdict).sum())))
    for member in (member for member in Member if member is not Member.OUTSIDE):
        now = int((images[member] == Verdict.REJECTED).sum())
        rows.append((f"rejected by {member}", REJECTED.get(member), now))
    for verdict, codes in (
        (Verdict.REJECTED, REASONS),
        (Verdict.UNDETERMINED, UNDETERMINED),
    ):
        rows += [(f"{verdict}, {code}", num, _with_reason(images, verdict, code)) for code, num in codes.items()]
    remark = ReasonCode.MISFIT_WITHOUT_WORTH
    rows.append((f"remark {remark}", None, sum(_with_reason(images, verdict, remark) for verdict in LISTED)))
    out = ["## Before and now", "", BEFORE_INTRO, "", "| images | 0.1.0 | now |", "|---|---:|---:|"]
    return [*out, *(f"| {words} | {_of(then, len(images))} | {_of(now, len(images))} |" for words, then, now in rows)]


def _with_reason(images: pd.DataFrame, verdict: Verdict, code: str) -> int:
    said = images[images.verdict == verdict].reasons
    return sum(any(reason.split(":", 1)[0] == code for reason in reasons) for reasons in said)


def _of(num: int | None, total: int) -> str:
    return "-" if num is None else f"{num} ({num / total:.0%})"
