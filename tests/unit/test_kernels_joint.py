"""The compiled sums of the joint system are numpy's, whatever the images see."""

from __future__ import annotations

import dataclasses
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from joint_reference import SPEC, model_of, with_rig
from numpy.testing import assert_allclose
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from sfm_audit.audit.engine.model import ModelAuditor
from sfm_audit.audit.inliers.frames import claimed_frames
from sfm_audit.audit.joint import audit_jointly, misfit
from sfm_audit.audit.joint import common_scores as common_score_module
from sfm_audit.audit.joint.candidates import FieldsInParts, candidate_scores
from sfm_audit.audit.joint.common_scores import common_scores
from sfm_audit.audit.joint.gauge import components_of
from sfm_audit.audit.joint.group_test import group_root
from sfm_audit.audit.joint.image_scores import scores_of_many
from sfm_audit.audit.joint.implied import ImpliedBeside, _missing_fields, _shift_fields, next_power
from sfm_audit.audit.joint.inclusion import Candidate, include
from sfm_audit.audit.joint.normal import reduced_systems, score_meat
from sfm_audit.audit.joint.observations import joint_observations
from sfm_audit.audit.joint.own import own_parameters
from sfm_audit.audit.joint.system import joint_system
from sfm_audit.audit.kernels import kernels_in_use, numpy_only
from sfm_audit.audit.kernels.joint import SCALAR, JointArrays, JointIndex, JointSums
from sfm_audit.audit.kernels.joint_normal import OtherSystem, meats, normals
from sfm_audit.audit.kernels.joint_parts import (
    components,
    point_information,
    unit_determinants,
)
from sfm_audit.audit.misfit.fields import GROUP_COLUMNS
from sfm_audit.audit.table.words import MisfitGroup

pytestmark = pytest.mark.skipif(not kernels_in_use(), reason="no compiled kernels here: nothing to compare")
TOLERANCE = 1e-9
KINDS = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "PINHOLE", "OPENCV", "FULL_OPENCV", "SIMPLE_RADIAL_FISHEYE", "RADIAL")
SHAPES = ("shared", "rig", "twice")


def seen_twice(model, count=6):
    """The first observations of each image once more, a pixel beside."""
    table = model.observations
    rows, shift = [], []
    for start, stop in zip(table.offsets[:-1].tolist(), table.offsets[1:].tolist(), strict=True):
        rows += [*range(start, stop), *range(start, min(start + count, stop))]
        shift += [0.0] * (stop - start) + [0.3] * min(count, stop - start)
    added = np.minimum(np.diff(table.offsets), count)
    observations = dataclasses.replace(
        table,
        offsets=table.offsets + np.concatenate([[0], np.cumsum(added)]),
        point2d_idx=table.point2d_idx[rows] + 1000 * (np.array(shift) > 0),
        xy_px=table.xy_px[rows] + np.array(shift)[:, None],
        point_idx=table.point_idx[rows],
    )
    return dataclasses.replace(model, observations=observations)


@pytest.fixture(scope="module", params=[*KINDS, *SHAPES])
def both(request):
    """The system of a model by both paths, from the same residuals."""
    name = request.param
    spec = dataclasses.replace(SPEC, shared_camera=True) if name == "shared" else SPEC
    spec = dataclasses.replace(spec, camera_model=name) if name in KINDS else spec
    model = model_of(spec, seed=3)
    model = (
        with_rig(model_of(dataclasses.replace(SPEC, num_images=8), seed=3))
        if name == "rig"
        else seen_twice(model)
        if name == "twice"
        else model
    )
    auditor = ModelAuditor(model)
    given = model, auditor.residuals, auditor.sigma_constant_px
    options = {}
    if name == "rig":
        frames = claimed_frames(model)
        options = {"frame_idx": frames.frame_idx, "image_from_frame": frames.image_from_frame}
    compiled = joint_system(*given, **options)
    with numpy_only():
        plain = joint_system(*given, **options)
    return SimpleNamespace(name=name, model=model, given=given, options=options, compiled=compiled, plain=plain)


def close(found, expected, scale=None, tolerance=TOLERANCE):
    found, expected = np.asarray(found), np.asarray(expected)
    scale = np.abs(expected).max(initial=1e-300) if scale is None else scale
    assert_allclose(found / scale, expected / scale, atol=tolerance, rtol=0)


def of_one_kind(found):  # no group has fields along an axis and fields with both components
    both = np.zeros(len(found.gram), bool) if found.fields is None else (found.fields[2 * SCALAR :] != 0).any(axis=0)
    return both == both[:, None]


def same_scores(found, expected, tolerance=TOLERANCE):
    unit = np.sqrt(np.maximum(expected.sq_length, 1e-300))
    assert_allclose(found.sq_length, expected.sq_length, rtol=TOLERANCE, atol=1e-300)
    both_units, asked = unit * unit[:, None], of_one_kind(found)
    close(found.gram / both_units, asked * expected.gram / both_units, 1.0, tolerance)
    close(found.score / unit, expected.score / unit, tolerance=tolerance)
    close(found.meat / both_units, asked * expected.meat / both_units, tolerance=tolerance)
    np.testing.assert_array_equal(found.support, expected.support)
    close(found.coupling / unit, expected.coupling / unit)
    close(found.solution / unit, expected.solution / unit, tolerance=tolerance)
    assert (found.num_tracks, found.num_observations) == (expected.num_tracks, expected.num_observations)


def test_the_observations_are_the_same(both):
    found = joint_observations(*both.given, frame_idx=both.options.get("frame_idx"))
    with numpy_only():
        expected = joint_observations(*both.given, frame_idx=both.options.get("frame_idx"))
    np.testing.assert_array_equal(found.source, expected.source)
    scale = np.maximum(np.abs(expected.design.kept).max(axis=(0, 1)), 1e-300)
    close(found.design.kept / scale, expected.design.kept / scale, 1.0)


def test_the_normal_equations_are_the_same(both):
    observations = both.plain.observations
    found = reduced_systems(observations)
    with numpy_only():
        expected = reduced_systems(observations)
    for mine, theirs in zip(found, expected, strict=True):
        unit = np.sqrt(np.maximum(theirs.before, 1e-300))
        close(mine.matrix.toarray() / unit / unit[:, None], theirs.matrix.toarray() / unit / unit[:, None], 1.0)
        close(mine.right / unit, theirs.right / unit)
        assert_allclose(mine.before, theirs.before, rtol=TOLERANCE)
        length = np.sqrt(np.maximum(np.einsum("pii->pi", theirs.point_inverse), 1e-300))
        length = length[:, :, None] * length[:, None, :]
        assert_allclose(mine.point_inverse / length, theirs.point_inverse / length, atol=1e-7)


def test_step_and_what_is_left_are_the_same(both):
    """Eight parameters of a lens from 90 points: the last digits of the step are lost in solving for it."""
    tolerance = 1e-6 if both.name == "FULL_OPENCV" else TOLERANCE
    close(both.compiled.base.step, both.plain.base.step, tolerance=tolerance)
    close(both.compiled.base.left_px, both.plain.base.left_px, tolerance=tolerance)
    close(both.compiled.plain_step, both.plain.plain_step, tolerance=tolerance)
    close(both.compiled.base.point_step, both.plain.base.point_step, tolerance=tolerance)


def test_the_meat_is_the_same(both):
    base = both.plain.base
    found = score_meat(base.observations, base.left_px).toarray()
    with numpy_only():
        expected = score_meat(base.observations, base.left_px).toarray()
    unit = np.sqrt(np.maximum(expected.diagonal(), 1e-300))
    close(found / unit / unit[:, None], expected / unit / unit[:, None], 1.0)


def by_both(both, base, image, beside):
    """Scores of an image by the kernel and by numpy, this at the image's own columns alone: what the kernel has."""
    power = beside.power(image)
    [found] = scores_of_many(both.plain, base).scores([image], [power])
    with numpy_only():
        fields = misfit._fields_of(both.plain, image, beside if power else None)
        expected = candidate_scores(base, [image], lambda _: fields)
    if found is not None:
        rows = np.searchsorted(expected.support, found.support)
        at = {f"basis_{name}": getattr(expected, f"basis_{name}")[rows] for name in ("coupling", "solution")}
        expected = dataclasses.replace(expected, support=found.support, **at)
    return found, expected


def test_an_image_has_the_same_scores(both):
    beside = ImpliedBeside(both.plain, own_parameters(both.plain))
    for image in range(len(both.model.images)):
        found, expected = by_both(both, both.plain.base, image, beside)
        if both.name == "FULL_OPENCV":  # its radial group is its own derivatives
            assert found is None
        else:
            same_scores(found, expected)
            columns = slice(4, 9)
            same_scores(found.only(columns), expected.only(columns))


def test_an_image_with_fields_that_are_not_finite_is_left_to_numpy(both):
    """A rolling shutter over no rows: the other groups are tested all the same."""
    if both.name != "SIMPLE_RADIAL":
        return
    cameras = dataclasses.replace(both.model.cameras, height=np.zeros_like(both.model.cameras.height))
    flat = dataclasses.replace(both.plain, model=dataclasses.replace(both.model, cameras=cameras))
    assert scores_of_many(flat, flat.base).scores([0], [0]) == [None]


def test_beside_included_fields_too(both):
    if both.name == "FULL_OPENCV":
        return
    base, system = both.plain.base, both.plain
    group = GROUP_COLUMNS[MisfitGroup.ROLLING_SHUTTER]
    candidates = []
    with numpy_only():
        for image in (3, 1):
            fields = misfit._fields_of(system, image)
            scores = candidate_scores(base, [image], lambda _, own=fields: own)
            root = group_root(scores, group)
            own = fields.fields[:, :, group] @ root.T
            candidates.append(Candidate(image, own, partial(system.observations.nuisance, image)))
        base = include(base, candidates)
    beside = ImpliedBeside(system, own_parameters(system))
    for image in range(len(both.model.images)):
        found, expected = by_both(both, base, image, beside)
        same_scores(found, expected)
    with_included = dataclasses.replace(system, base=base)
    everybody = np.arange(len(both.model.images))
    assert (common_scores(with_included, everybody, None, 1) is None) == bool(base.included)


@pytest.mark.parametrize("images", [[0, 1, 2, 3, 4, 5, 6], [1, 2, 4]])
@pytest.mark.parametrize("columns", [_shift_fields, _missing_fields])
def test_what_many_images_have_in_common_has_the_same_scores(both, images, columns):
    system, camera = both.plain, None
    if columns is _missing_fields:
        if both.name == "FULL_OPENCV":
            return  # does not follow its lens: never asked
        camera = both.model.image(images[0]).camera
        images = images if len(both.model.cameras) == 1 else images[:1]
    power = next_power(both.model.camera(0))
    found = common_scores(system, np.array(images), camera, power)
    with numpy_only():
        expected = candidate_scores(system.base, images, lambda image: FieldsInParts(partial(columns, system, image)))
        assert common_scores(system, np.array(images), camera, power) is None
    place = np.searchsorted(found.support, expected.support)
    outside = np.setdiff1d(found.support, expected.support)
    assert np.abs(found.coupling[outside]).max(initial=0.0) <= 1e-12 * np.abs(found.coupling).max()
    of_found = dataclasses.replace(
        found,
        basis_coupling=found.basis_coupling[place],
        basis_solution=found.basis_solution[place],
        support=expected.support,
    )
    same_scores(of_found, expected, 1e-6 if both.name == "FULL_OPENCV" else TOLERANCE)


def test_few_images_are_gone_through_alone(both, monkeypatch):
    monkeypatch.setattr(common_score_module, "_MIN_SHARE", 0.5)
    assert common_scores(both.plain, np.array([1]), None, 1) is None


def test_verdicts_are_the_same(both):
    tau = np.full(len(both.model.images), 0.2)
    found = audit_jointly(*both.given, alpha=0.05, tau_px=tau, **both.options)
    with numpy_only():
        expected = audit_jointly(*both.given, alpha=0.05, tau_px=tau, **both.options)
    for mine, theirs in zip(found.misfit.tests, expected.misfit.tests, strict=True):
        for group, test in theirs.items():
            assert (mine[group].status, mine[group].rank) == (test.status, test.rank)
            assert_allclose([mine[group].p, mine[group].px], [test.p, test.px], rtol=1e-5, atol=1e-9)


# what C is given


INDICES = "offsets", "image_idx", "point_idx", "by_point", "point_offsets"


def small_arrays(**changes):
    rng = np.random.default_rng(0)
    design = rng.normal(size=(6, 2, 8))
    given = {
        "offsets": np.array([0, 3, 6]),
        "image_idx": np.repeat([0, 1], 3),
        "point_idx": np.array([0, 1, 2, 0, 1, 2]),
        "by_point": np.array([0, 3, 1, 4, 2, 5]),
        "point_offsets": np.array([0, 2, 4, 6]),
        "design": design,
        "left_px": rng.normal(size=(6, 2)),
        "weight": np.ones(6),
        "inverse": np.tile(np.eye(3), (3, 1, 1)),
        "extra": {},
    } | changes
    index = JointIndex(*(given.pop(name) for name in INDICES))
    return JointArrays(index, **given)


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"image_idx": np.array([0, 0, 0, 1, 1, 2])}, "image_idx: expected 0 .. 1, found 0 .. 2"),
        ({"point_idx": np.array([0, 1, 2, 0, -1, 2])}, "point_idx: expected 0 .. 2"),
        ({"by_point": np.array([0, 3, 1, 4, 2, 6])}, "by_point: expected 0 .. 5"),
        ({"offsets": np.array([0, 7, 6])}, "offsets: expected to rise from 0 to 6"),
        ({"point_offsets": np.array([0, 2, 4, 9])}, "point_offsets: expected to rise"),
        ({"left_px": np.zeros((5, 2))}, "expected an array of shape"),
        ({"point_idx": np.zeros(5, int)}, "expected 6 indices"),
        ({"point_idx": np.full(6, 2**40)}, "32 bits"),
    ],
)
def test_indices_that_lead_outside_never_reach_the_kernel(changes, told):
    with pytest.raises(ValueError, match=told):
        JointSums(small_arrays(**changes))


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e300, 0.0])
def test_extreme_numbers_come_through_as_numbers(value):
    arrays = small_arrays(design=np.full((6, 2, 8), value), weight=np.full(6, value))
    sums = JointSums(arrays)
    steps = sums.off_points(arrays.left_px.copy())
    with pytest.raises(ValueError, match="other observations"):
        sums.off_points(arrays.left_px[::-1])
    one, first, turn = np.array([1]), np.array([0]), np.stack([np.eye(8)] * 2)
    other = OtherSystem(np.full(2, value), np.tile(np.eye(3), (3, 1, 1)), (steps, steps))
    assert normals(sums, one, turn, other).pairs.around.tolist() == [1]
    assert meats(sums, first, turn).slabs.shape == (1, 2, 8, 8)


def test_an_image_without_observations_has_nothing_around():
    sums = JointSums(small_arrays(offsets=np.array([0, 0, 6]), image_idx=np.ones(6, int)))
    assert sums.index.is_first.tolist() == [True] * 3 + [False] * 3
    assert not sums.repeats_follow
    assert JointSums(small_arrays()).repeats_follow


@pytest.mark.parametrize("seed", range(4))
def test_images_that_hang_together_are_those_of_the_graph(seed):
    """Points of one view and of several, frames of two images, images that see nothing."""
    rng = np.random.default_rng(seed)
    image_idx, point_idx = np.sort(rng.integers(0, 30, 40)), rng.integers(0, 25, 40)
    by_point = np.argsort(point_idx, kind="stable")
    offsets, point_offsets = (
        np.concatenate([[0], np.cumsum(np.bincount(of, minlength=n))]) for of, n in ((image_idx, 32), (point_idx, 25))
    )
    index = JointIndex(offsets, image_idx, point_idx, by_point, point_offsets)
    together = np.arange(32)
    together[[5, 9, 31]] = [2, 5, 30]
    edges = np.concatenate([image_idx, np.arange(32)]), np.concatenate([32 + point_idx, together])
    graph = sparse.coo_array((np.ones(72), edges), shape=(57, 57))
    expected = connected_components(graph, directed=False)[1][:32]
    found = components(index, together)
    assert found.tolist() == [int(np.flatnonzero(expected == label)[0]) for label in expected]
    with pytest.raises(ValueError, match="not behind"):
        components(index, together + 1)


def test_components_of_a_model_are_the_same(both):
    found = components_of(both.plain.observations)
    with numpy_only():
        expected = components_of(both.plain.observations)
    assert (found[:, None] == found).tolist() == (expected[:, None] == expected).tolist()
    assert ((found < 0) == (expected < 0)).all()


def test_points_whose_weight_is_zero_add_nothing_whatever_they_are():
    jacobian = np.ones((2, 3, 4))
    jacobian[:, :, 3] = np.nan
    found, views = point_information(jacobian, np.array([1.0, 2.0, 0.5, 0.0]), np.array([0, 0, 2, 2]), 3)
    assert views.tolist() == [2, 0, 1]
    assert_allclose(found, np.ones((3, 3, 3)) * np.array([6.0, 0.0, 1.0])[:, None, None])
    assert point_information(jacobian, np.ones(3), np.array([0, 0, 2]), 3) is None
    assert point_information(jacobian, np.ones(4), np.array([0, 0, 2, 3]), 3) is None


def test_inverses_of_points_and_their_determinants():
    rng = np.random.default_rng(1)
    root = rng.normal(size=(20, 3, 5)) * np.array([1e-6, 1.0, 1e6])[:, None]
    matrices = root @ root.swapaxes(1, 2)
    matrices[3] = 0.0
    found = matrices.copy()
    determinants = unit_determinants(found, smallest=1e-300, invert=True)
    length = np.sqrt(np.maximum(np.einsum("pii->pi", matrices), 1e-300))
    unit = matrices / length[:, :, None] / length[:, None, :]
    assert_allclose(determinants, np.linalg.det(unit), atol=1e-12)
    regular = np.arange(20) != 3
    expected = np.linalg.inv(unit[regular])
    assert_allclose(found[regular] * (length[:, :, None] * length[:, None, :])[regular], expected, rtol=1e-7, atol=1e-8)
    assert not found[3].any()
    assert unit_determinants(np.full((1, 3, 3), np.nan), smallest=1e-300, invert=True)[0] != 0
