"""The joint system is what stacking every column and solving by least squares gives, in closed form and blocks."""

from __future__ import annotations

import dataclasses
from functools import partial

import numpy as np
import pytest
from joint_reference import SPEC, in_order_of, model_of, projector, solved, stacked, system_of, with_param, with_poses
from numpy.testing import assert_allclose
from scipy import sparse, stats
from scipy.spatial.transform import Rotation

from sfm_audit.audit.engine.model import ModelAuditor
from sfm_audit.audit.joint import (
    candidates,
    image_from_frame,
    image_gains,
    joint_misfit,
    joint_system,
    misfit,
    own_parameters,
)
from sfm_audit.audit.joint.candidates import FieldsInParts, ImageFields, candidate_scores
from sfm_audit.audit.joint.group_test import group_root
from sfm_audit.audit.joint.group_test import test_group as judge_group
from sfm_audit.audit.joint.inclusion import Candidate, include
from sfm_audit.audit.joint.inverse import joint_inverse, joint_solution
from sfm_audit.audit.joint.normal import reduced_systems
from sfm_audit.audit.joint.worth import worth_of
from sfm_audit.audit.misfit.fields import GROUP_COLUMNS, candidate_fields
from sfm_audit.audit.table.words import GROUPS, MisfitGroup, MisfitStatus

NAMES = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "OPENCV", "SIMPLE_RADIAL_FISHEYE")


@pytest.fixture(scope="module", params=[*NAMES, "shared"])
def model(request):
    spec = dataclasses.replace(SPEC, shared_camera=True) if request.param == "shared" else SPEC
    if request.param != "shared":
        spec = dataclasses.replace(SPEC, camera_model=request.param)
    return model_of(spec, seed=1)


@pytest.fixture(scope="module")
def system(model):
    return system_of(model)


@pytest.fixture(scope="module")
def reference(model, system):
    return in_order_of(stacked(model), system.observations)


def fields_of(system, image):
    inliers = system.observations.inliers(image)
    camera, projected = inliers.camera, inliers.projected
    fields = np.ascontiguousarray(candidate_fields(camera, projected).transpose(2, 1, 0))
    return ImageFields(fields, system.observations.nuisance(image))


def placed(reference, image, fields):
    out = np.zeros((len(reference.y), fields.shape[2]))
    rows = reference.rows[image]
    out[rows] = fields.reshape(-1, fields.shape[2]) * reference.root[rows, None]
    return out


def off(columns, values):
    basis = projector(columns)
    once = values - basis @ (basis.T @ values)
    return once - basis @ (basis.T @ once)


def test_every_observation_of_these_models_takes_part(system, reference):
    assert system.observations.source.size == len(reference.y) // 2


def test_step_and_covariance_are_least_squares_own(system, reference, model):
    step, covariance = solved(reference.columns, reference.y)
    layout = system.observations.layout
    for camera in range(len(model.cameras)):
        columns, own = layout.own_of_camera(camera), reference.own[camera]
        sd = np.sqrt(covariance[own, own])
        assert_allclose(system.base.step[columns], step[own], atol=1e-8 * sd.max(initial=0), rtol=1e-7)
        found = system.base.inverse.main.block(columns)
        assert_allclose(found / sd / sd[:, None], covariance[np.ix_(own, own)] / sd / sd[:, None], atol=1e-7)


def test_what_is_left_is_off_everything(system, reference):
    left = (system.base.left_px.reshape(-1)) * reference.root
    assert_allclose(left, off(reference.columns, reference.y), atol=1e-8)


def test_own_step_px_is_what_freeing_the_parameters_gains(system, reference):
    everything = np.sum(off(reference.columns, reference.y) ** 2)
    for camera in own_parameters(system):
        without = np.delete(reference.columns, reference.own[camera.camera_idx], axis=1)
        gain = np.sum(off(without, reference.y) ** 2) - everything
        sigma = np.median(system.observations.sigma_px[camera.image_idxs])
        assert camera.own_step_px == pytest.approx(sigma * np.sqrt(gain / camera.num_observations), rel=1e-5, abs=1e-9)


def test_plain_step_is_without_weights(system, model):
    reference = stacked(model, robust=False)
    step, covariance = solved(reference.columns, reference.y)
    for camera in own_parameters(system):
        own = reference.own[camera.camera_idx]
        assert_allclose(camera.plain_step, step[own], atol=1e-6 * np.sqrt(covariance[own, own]).max(initial=0))


def test_sandwich_is_clustered_by_track(system, reference, model):
    scale = np.linalg.norm(reference.columns, axis=0)
    scale[scale == 0] = 1.0
    influence = np.linalg.pinv(reference.columns / scale, rcond=1e-7) / scale[:, None]  # step = influence y
    left = off(reference.columns, reference.y)
    for camera in own_parameters(system):
        own = influence[reference.own[camera.camera_idx]] * left
        by_track = np.zeros((len(own), len(model.points)))
        np.add.at(by_track.T, np.repeat(reference.point, 2), own.T)
        assert_allclose(camera.sd, np.sqrt((by_track**2).sum(axis=1)), rtol=1e-6)


@pytest.mark.parametrize("images", [[2], [0, 2, 3]])
def test_candidates_in_parts_are_those_of_all_points_at_once(system, images, monkeypatch):
    whole = candidate_scores(system.base, images, lambda image: fields_of(system, image))
    monkeypatch.setattr(candidates, "AT_ONCE", 20)
    monkeypatch.setattr(candidates, "PART", 7)
    asked = []

    def part(image, chosen):
        asked.append(chosen)
        return fields_of(system, image).part(chosen)

    parts = candidate_scores(system.base, images, lambda image: FieldsInParts(partial(part, image)))
    assert len(asked) > 3 * len(images)
    assert parts.num_tracks == whole.num_tracks
    for name in ("sq_length", "gram", "score", "meat", "coupling"):
        found, expected = getattr(parts, name), getattr(whole, name)
        assert_allclose(found, expected, rtol=1e-9, atol=1e-10 * np.abs(expected).max(), err_msg=name)


def test_a_large_image_is_tested_in_parts(system, monkeypatch):
    tau = np.full(len(system.model.images), 0.2)
    whole = joint_misfit(system, alpha=0.01, tau_px=tau)
    for module in (candidates, misfit):
        monkeypatch.setattr(module, "AT_ONCE", 20)
    monkeypatch.setattr(candidates, "PART", 7)
    parts = joint_misfit(system, alpha=0.01, tau_px=tau)
    for found, expected in zip(parts.tests, whole.tests, strict=True):
        assert [test.status for test in found.values()] == [test.status for test in expected.values()]
        assert_allclose([t.px for t in found.values()], [t.px for t in expected.values()], rtol=1e-6, atol=1e-6)


def meat_of(by_track):
    return by_track.T @ by_track


def test_candidates_are_the_fields_projected_off_everything(system, reference):
    own = fields_of(system, 2)
    scores = candidate_scores(system.base, [2], lambda _: own)
    fields = placed(reference, 2, own.fields)
    projected, left = off(reference.columns, fields), off(reference.columns, reference.y)
    length = np.sqrt(scores.sq_length)
    unit = np.where(length > 0, length, 1.0)
    assert_allclose(length, np.linalg.norm(fields, axis=0), rtol=1e-12)
    assert_allclose(scores.gram / unit / unit[:, None], projected.T @ projected / unit / unit[:, None], atol=1e-8)
    assert_allclose(scores.score / unit, projected.T @ left / unit, atol=1e-7)
    by_track = np.zeros((system.observations.num_points, len(unit)))
    np.add.at(by_track, np.repeat(reference.point, 2), projected * left[:, None])
    seen = np.unique(system.observations.point_idx[system.observations.rows(2)])
    assert_allclose(scores.meat / unit / unit[:, None], meat_of(by_track[seen] / unit), atol=1e-7)


def test_the_test_is_hotelling_s(system):
    own = fields_of(system, 0)
    scores = candidate_scores(system.base, [0], lambda _: own)
    columns = GROUP_COLUMNS[MisfitGroup.ROLLING_SHUTTER]
    root = group_root(scores, columns)
    found = judge_group(scores, columns, root, sigma_px=0.7, rms_px=100.0)
    z, meat = root @ scores.score[columns], root @ scores.meat[columns, columns] @ root.T
    statistic, r, c = z @ np.linalg.solve(meat, z), len(root), scores.num_tracks
    expected = stats.f.sf(statistic / r * (c - r) / c / (1 - statistic / c), r, c - r)
    assert found.p == pytest.approx(expected, rel=1e-6)
    n = system.observations.num_of(0)
    assert found.px == pytest.approx(0.7 * np.sqrt(max(0.0, z @ z - np.trace(meat)) / n), rel=1e-9)
    scores = dataclasses.replace(scores, score=3.0 * scores.score)
    assert judge_group(scores, columns, root, sigma_px=0.7, rms_px=1.0).status is MisfitStatus.TESTED
    assert judge_group(scores, columns, root, sigma_px=0.7, rms_px=1e-3).status is MisfitStatus.NOT_ESTIMABLE


@pytest.mark.parametrize(("share", "is_lost"), [(1e-9, True), (1e-2, False)])
def test_what_rounding_makes_of_an_eigenvalue_identifies_nothing(share, is_lost):
    """A column of which the elimination of points leaves little: an eigenvalue of 1e-8 is rounding of it."""
    matrix = np.array([[1.0, 1.0 - 1e-8], [1.0 - 1e-8, 1.0]])
    before = np.full(2, 1.0 / share)
    inverse = joint_inverse(sparse.csr_array(matrix), before, np.zeros((2, 0)))
    assert inverse.unidentified.tolist() == [is_lost] * 2
    assert inverse.num_null == int(is_lost)


def test_inclusion_is_the_same_as_columns_more(system, reference):
    base, columns = system.base, reference.columns
    for images in ([1, 3], [4]):
        candidates = []
        for image in images:
            own = fields_of(system, image)
            group = GROUP_COLUMNS[MisfitGroup.AFFINE if image != 3 else MisfitGroup.ROLLING_SHUTTER]
            candidates.append(Candidate(image, own.fields[:, :, group], own.nuisance.__getitem__))
        base = include(base, candidates)
        extra = [placed(reference, image, base.included[image].fields) for image in images]
        columns = np.hstack([columns, *extra])
    left = base.left_px.reshape(-1) * reference.root
    assert_allclose(left, off(columns, reference.y), atol=1e-7)
    for image in (0, 3):  # a neighbour, and one that has fields of its own in the base
        own = fields_of(system, image)
        scores = candidate_scores(base, [image], lambda _, own=own: own)
        projected = off(columns, placed(reference, image, own.fields))
        unit = np.sqrt(np.maximum(scores.sq_length, 1e-300))
        assert_allclose(scores.gram / unit / unit[:, None], projected.T @ projected / unit / unit[:, None], atol=1e-7)
        assert_allclose(scores.score / unit, projected.T @ left / unit, atol=1e-6)
        by_track = np.zeros((system.observations.num_points, len(unit)))
        np.add.at(by_track, np.repeat(reference.point, 2), projected * left[:, None])
        seen = np.unique(system.observations.point_idx[system.observations.rows(image)])
        assert_allclose(scores.meat / unit / unit[:, None], meat_of(by_track[seen] / unit), atol=1e-6)


def test_worth_is_how_far_inclusion_moves_the_image(system, model):
    own, group = fields_of(system, 2), GROUP_COLUMNS[MisfitGroup.ROLLING_SHUTTER]
    scores = candidate_scores(system.base, [2], lambda _: own)
    root = group_root(scores, group)
    worth = worth_of(system, 2, scores, group, root, depth=system.median_depth(2))
    base = include(system.base, [Candidate(2, own.fields[:, :, group] @ root.T, own.nuisance.__getitem__)])
    columns = system.observations.layout.columns[2]
    moved = (base.step[: len(system.base.step)] - system.base.step)[columns]
    image = model.image(2)
    depth = np.median(image.cam_from_world(model.points.xyz_world[np.unique(model.observations.point_idx)])[:, 2])
    assert worth.rotation_deg == pytest.approx(np.degrees(np.linalg.norm(moved[:3])), rel=1e-6)
    assert worth.centre_rel == pytest.approx(np.linalg.norm(moved[3:6]) / system.median_depth(2), rel=1e-6)
    assert system.median_depth(2) == pytest.approx(depth, rel=0.5)
    focal = moved[6] / image.camera.params[0]
    if image.camera.model.name != "OPENCV":
        assert worth.focal_rel == pytest.approx(focal, rel=1e-6)


def test_inclusion_leaves_the_base_system_as_it_was(system):
    before = system.base.inverse.main.array.copy(), system.base.step.copy()
    joint_misfit(system, alpha=0.999, tau_px=np.full(7, 1e-9))
    assert_allclose(system.base.inverse.main.array, before[0], rtol=0)
    assert_allclose(system.base.step, before[1], rtol=0)


def test_seven_directions_of_the_gauge_and_no_others(system):
    reduced = reduced_systems(system.observations)[0]
    matrix = reduced.matrix.toarray()
    scale = np.sqrt(matrix.diagonal())
    values = np.linalg.eigvalsh(matrix / scale / scale[:, None])
    assert values[6] < 1e-11 < values[7]
    assert system.base.inverse.num_null == 0
    assert not system.base.inverse.unidentified.any()


def test_pseudo_inverse_is_one(system):
    matrix = reduced_systems(system.observations)[0].matrix.toarray()
    inverse = system.base.inverse.main.array
    scale = np.sqrt(matrix.diagonal())
    unit, back = matrix / scale / scale[:, None], inverse * scale * scale[:, None]
    assert_allclose(unit @ back @ unit, unit, atol=1e-9)
    assert_allclose(back @ unit @ back, back, atol=1e-9 * np.abs(back).max())


def test_a_further_null_direction_is_found_and_said(system):
    """A column twice: neither of the two is known, all others are what they were without the second."""
    reduced = reduced_systems(system.observations)[0]
    matrix = reduced.matrix.toarray()
    size, twice = len(matrix), int(system.observations.layout.own_of_camera(0)[0])
    index = np.append(np.arange(size), twice)
    doubled = sparse.csr_array(matrix[np.ix_(index, index)])
    gauge = np.zeros((size + 1, 7))
    values, vectors = np.linalg.eigh(matrix / np.sqrt(np.outer(matrix.diagonal(), matrix.diagonal())))
    gauge[:size] = vectors[:, :7] / np.sqrt(matrix.diagonal())[:, None]
    inverse = joint_inverse(doubled, reduced.before[index], gauge)
    assert values[7] > 1e-11
    assert inverse.num_null == 1
    assert np.flatnonzero(inverse.unidentified).tolist() == [twice, size]
    others = np.setdiff1d(np.arange(size), [twice])
    scale = np.sqrt(matrix.diagonal())[others]
    expected = system.base.inverse.main.block(others) * scale * scale[:, None]
    assert_allclose(inverse.main.block(others) * scale * scale[:, None], expected, atol=1e-6 * expected.max())
    right = reduced.right[index]
    step = joint_solution(doubled, reduced.before[index], gauge, right)
    assert_allclose(step, inverse.main.apply(right), atol=1e-9 * np.abs(step).max())


def test_points_that_are_independent_leave_nothing_to_eliminate():
    model = model_of(SPEC, seed=2)
    system, reference = system_of(model, points_independent=True), stacked(model)
    width = min(own.min() for own in reference.own), max(own.max() for own in reference.own) + 1
    columns = reference.columns[:, : width[1]]
    assert_allclose(system.base.left_px.reshape(-1) * reference.root, off(columns, reference.y), atol=1e-8)
    own = fields_of(system, 1)
    scores = candidate_scores(system.base, [1], lambda _: own)
    projected = off(columns, placed(reference, 1, own.fields))
    unit = np.sqrt(scores.sq_length)
    assert_allclose(scores.gram / unit / unit[:, None], projected.T @ projected / unit / unit[:, None], atol=1e-8)


def test_frames_move_their_images_together():
    """Two images per frame, half a unit apart: as stacking columns through the same 6 x 6 matrices."""
    model = model_of(dataclasses.replace(SPEC, num_images=8, shared_camera=True), seed=3)
    rng = np.random.default_rng(0)
    frame = np.arange(8) // 2
    transforms = np.array(
        [
            image_from_frame(Rotation.from_rotvec(0.1 * rng.normal(size=3)).as_matrix(), rng.normal(size=3))
            for _ in frame
        ]
    )
    system = system_of(model, frame_idx=frame, image_from_frame=transforms)
    reference = in_order_of(stacked(model), system.observations)
    fold = np.zeros((48, 24))
    for i in range(8):
        fold[6 * i : 6 * i + 6, 6 * frame[i] : 6 * frame[i] + 6] = transforms[i]
    columns = np.hstack([reference.columns[:, :48] @ fold, reference.columns[:, 48:]])
    assert_allclose(system.base.left_px.reshape(-1) * reference.root, off(columns, reference.y), atol=1e-7)
    assert system.observations.layout.num_columns == 24 + 2


def test_image_from_frame_is_the_derivative():
    rng = np.random.default_rng(4)
    rotation, shift = Rotation.from_rotvec(rng.normal(size=3)), rng.normal(size=3)
    matrix, point = image_from_frame(rotation.as_matrix(), shift), rng.normal(size=3)
    for k in range(6):
        step = 1e-6 * np.eye(6)[k]
        moved = Rotation.from_rotvec(step[:3]).apply(point) + step[3:]
        difference = (rotation.apply(moved) - rotation.apply(point)) / 1e-6
        xc = rotation.apply(point) + shift
        assert_allclose(np.cross(matrix[:3, k], xc) + matrix[3:, k], difference, atol=1e-5)


def test_images_that_cannot_take_part_have_no_columns():
    model = model_of(SPEC, seed=5)
    auditor = ModelAuditor(model)
    sigma = auditor.sigma_constant_px.copy()
    sigma[2] = np.nan
    left_out = np.arange(7) == 4
    system = joint_system(model, auditor.residuals, sigma, left_out=left_out)
    assert np.flatnonzero(~system.observations.layout.has_columns).tolist() == [2, 4]
    assert not np.isin(system.observations.image_idx, [2, 4]).any()
    found = joint_misfit(system, alpha=0.05, tau_px=np.full(7, 0.2), excluded=np.arange(7) == 5)
    assert {t.status for t in found.tests[4].values()} == {MisfitStatus.NO_COLUMNS}
    assert {t.status for t in found.tests[5].values()} == {MisfitStatus.EXCLUDED}
    assert np.flatnonzero(np.isnan(found.effect_px)).tolist() == [2, 4, 5]
    covariances = system.image_covariances([0, 2])
    assert covariances[0].shape == (8, 8)
    assert np.isfinite(covariances[0]).all()
    assert np.isnan(covariances[1]).all()
    assert set(found.tests[0]) == set(GROUPS)


def test_a_moved_pose_is_the_pose_s_gain_and_a_wrong_focal_length_the_camera_s():
    model = model_of(dataclasses.replace(SPEC, num_images=10, points_per_image=200), seed=6, adjusted=True)
    quat, shift = model.images.quat_cam_from_world_wxyz.copy(), model.images.translation_cam_from_world.copy()
    turn = Rotation.from_rotvec([3e-3, -2e-3, 4e-3])
    quat[3] = (turn * Rotation.from_quat(quat[3], scalar_first=True)).as_quat(scalar_first=True)
    shift[3] = turn.apply(shift[3])
    (gains,) = image_gains(system_of(with_poses(model, quat, shift)), [3])
    assert gains.pose >= 0.9 * gains.both
    assert gains.camera < 0.5 * gains.both
    focal = model.cameras.params[model.cameras.param_offsets[3]]
    (gains,) = image_gains(system_of(with_param(model, 3, 0, 1.02 * focal)), [3])
    assert gains.camera >= 0.9 * gains.both
