"""The verdicts on pose and plausibility, threshold by threshold (method.md section 7)."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sfm_audit.audit.camera_quality.identifiability import Identifiability, ParameterCovariance
from sfm_audit.audit.camera_quality.plausibility import (
    CameraPlausibility,
    PlausibilityLimits,
    judge_plausible,
    judge_pose,
)
from sfm_audit.audit.decision.verdict import REASON_MEANINGS, ReasonCode, Verdict

ACCEPTED, REJECTED, UNDETERMINED = Verdict.ACCEPTED, Verdict.REJECTED, Verdict.UNDETERMINED


def camera(focal_over_size=0.8, *, folds=False, centre=(800.0, 600.0)):
    return CameraPlausibility(focal_over_size, folds_over=folds, principal_point_px=centre, size_px=(1600, 1200))


def found(sd_focal_rel=0.001, sd_k1=0.001, *, k1=0.05, share=0.1, has_focal=True, has_k1=True):
    parameters = ParameterCovariance((), np.empty((0, 0)), share)
    return Identifiability(parameters, 1.0, sd_focal_rel, sd_k1, k1, has_focal=has_focal, has_k1=has_k1)


def judge(a_camera=None, identified=None, *, coverage=0.5, occupied_cells=40, num_inliers=300, limits=None):
    return judge_plausible(
        a_camera or camera(),
        identified or found(),
        coverage=coverage,
        occupied_cells=occupied_cells,
        num_inliers=num_inliers,
        limits=limits or PlausibilityLimits(),
    )


def codes(judgement):
    return [reason.code for reason in judgement.reasons]


@pytest.mark.parametrize(
    ("offset", "num_inliers", "verdict", "reason"),
    [
        (0.0, 20, ACCEPTED, None),
        (0.5, 100, ACCEPTED, None),
        (0.51, 100, REJECTED, ReasonCode.POSE_NOT_OPTIMAL),
        (3.0, 19, UNDETERMINED, ReasonCode.TOO_FEW_OBSERVATIONS),
        (math.nan, 0, UNDETERMINED, ReasonCode.TOO_FEW_OBSERVATIONS),
        (math.nan, 100, UNDETERMINED, ReasonCode.NON_FINITE_DERIVATIVES),
    ],
)
def test_pose(offset, num_inliers, verdict, reason):
    judgement = judge_pose(offset, num_inliers)
    assert judgement.verdict == verdict
    assert codes(judgement) == ([reason] if reason else [])


def test_pose_reason_carries_the_number_and_the_limit():
    (reason,) = judge_pose(1.2345, 100, PlausibilityLimits(max_pose_offset_px=0.25)).reasons
    assert str(reason) == "pose_not_optimal: pose_offset_px = 1.23 > 0.25"


@pytest.mark.parametrize(
    ("change", "verdict", "reason"),
    [
        ({}, ACCEPTED, None),
        ({"a_camera": camera(0.3)}, ACCEPTED, None),
        ({"a_camera": camera(10.0)}, ACCEPTED, None),
        ({"a_camera": camera(0.299)}, REJECTED, ReasonCode.FOCAL_OUT_OF_RANGE),
        ({"a_camera": camera(10.1)}, REJECTED, ReasonCode.FOCAL_OUT_OF_RANGE),
        ({"a_camera": camera(-5.0)}, REJECTED, ReasonCode.FOCAL_OUT_OF_RANGE),
        ({"a_camera": camera(math.nan)}, REJECTED, ReasonCode.FOCAL_OUT_OF_RANGE),
        ({"a_camera": camera(folds=True)}, REJECTED, ReasonCode.DISTORTION_FOLDS),
        ({"a_camera": camera(centre=(-1.0, 600.0))}, REJECTED, ReasonCode.PRINCIPAL_POINT_OUTSIDE),
        ({"identified": found(0.01)}, ACCEPTED, None),
        ({"identified": found(0.0101)}, UNDETERMINED, ReasonCode.FOCAL_NOT_IDENTIFIED),
        ({"identified": found(math.nan, share=1e-12)}, UNDETERMINED, ReasonCode.FOCAL_NOT_IDENTIFIED),
        ({"identified": found(math.nan)}, UNDETERMINED, ReasonCode.NOISE_NOT_FITTED),
        ({"identified": found(math.nan, share=math.nan)}, UNDETERMINED, ReasonCode.NON_FINITE_DERIVATIVES),
        ({"identified": found(k1=0.0021)}, ACCEPTED, None),
        ({"identified": found(k1=-0.0019)}, ACCEPTED, ReasonCode.K1_NOT_IDENTIFIED),
        ({"identified": found(k1=0.0, has_k1=False)}, ACCEPTED, None),
        ({"coverage": 0.2}, ACCEPTED, None),
        ({"coverage": 0.199}, UNDETERMINED, ReasonCode.LOW_COVERAGE),
        ({"coverage": math.nan}, UNDETERMINED, ReasonCode.LOW_COVERAGE),
        ({"occupied_cells": 16}, ACCEPTED, None),
        ({"occupied_cells": 15}, UNDETERMINED, ReasonCode.FEW_OCCUPIED_CELLS),
        ({"num_inliers": 20}, ACCEPTED, None),
        ({"num_inliers": 19}, UNDETERMINED, ReasonCode.TOO_FEW_OBSERVATIONS),
    ],
)
def test_plausible(change, verdict, reason):
    judgement = judge(**change)
    assert judgement.verdict == verdict
    assert codes(judgement) == ([reason] if reason else [])


def test_rejection_wins_and_everything_is_listed():
    judgement = judge(camera(0.1, folds=True), found(0.5, 1.0), coverage=0.01, occupied_cells=1)
    assert judgement.verdict == REJECTED
    assert codes(judgement) == [
        ReasonCode.FOCAL_OUT_OF_RANGE,
        ReasonCode.DISTORTION_FOLDS,
        ReasonCode.FOCAL_NOT_IDENTIFIED,
        ReasonCode.LOW_COVERAGE,
        ReasonCode.FEW_OCCUPIED_CELLS,
        ReasonCode.K1_NOT_IDENTIFIED,
    ]
    assert "0.1, outside [0.3, 10]" in str(judgement.reasons[0])
    assert "50.00% > 1%" in str(judgement.reasons[2])
    assert judge(camera(0.1), num_inliers=3).verdict == REJECTED


def test_a_panorama_has_neither_focal_length_nor_principal_point():
    panorama = CameraPlausibility(math.nan, folds_over=False, principal_point_px=None, size_px=(1600, 800))
    judgement = judge(panorama, found(math.nan, math.nan, k1=math.nan, has_focal=False, has_k1=False))
    assert judgement.verdict == ACCEPTED
    assert not judgement.reasons


def test_every_reason_has_a_meaning():
    assert set(REASON_MEANINGS) == set(ReasonCode)
