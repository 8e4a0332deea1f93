"""What version 0.1.0 (commit fbf7037) said of the public models, policy `full`: measured then, kept to compare with."""

from __future__ import annotations

from typing import Final

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
UNDETERMINED: Final[dict[str, int]] = {
    "focal_not_identified": 99,
    "low_coverage": 96,
    "too_few_observations": 14,
    "few_occupied_cells": 8,
}
"""Undetermined images that have a reason; an image can have several."""
