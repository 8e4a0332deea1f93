"""The scores of many images in one call are those of one after the other; the order of sight is numpy's."""

from __future__ import annotations

import dataclasses
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from joint_reference import SPEC, model_of, system_of, with_rig
from numpy.testing import assert_allclose, assert_array_equal

from sfm_audit.audit.engine.model import ModelAuditor
from sfm_audit.audit.inliers.frames import claimed_frames
from sfm_audit.audit.joint import image_scores as image_score_module
from sfm_audit.audit.joint import joint_misfit, misfit
from sfm_audit.audit.joint.banded_inverse import BandedInverse
from sfm_audit.audit.joint.candidates import candidate_scores
from sfm_audit.audit.joint.group_test import group_root
from sfm_audit.audit.joint.image_scores import ScoresOfMany, sums_of_base
from sfm_audit.audit.joint.implied import ImpliedBeside
from sfm_audit.audit.joint.inclusion import Candidate, include
from sfm_audit.audit.joint.observations import _in_order_of_sight, joint_observations
from sfm_audit.audit.joint.own import own_parameters
from sfm_audit.audit.joint.system import joint_system
from sfm_audit.audit.kernels import kernels_in_use, numpy_only
from sfm_audit.audit.kernels.joint import SCALAR, JointIndex
from sfm_audit.audit.kernels.joint_parts import in_order_of_sight, two_informations
from sfm_audit.audit.kernels.joint_scores import Asked, IncludedArrays, JointScores, SeenArrays
from sfm_audit.audit.kernels.threads import over_ranges, threads
from sfm_audit.audit.misfit.fields import GROUP_COLUMNS
from sfm_audit.audit.table.words import MisfitGroup

pytestmark = pytest.mark.skipif(not kernels_in_use(), reason="no compiled kernels here: nothing to compare")
STREET = dataclasses.replace(SPEC, num_images=60, points_per_image=60, max_neighbours=3, max_track_length=4)
SMALL = ("SIMPLE_RADIAL", "OPENCV", "SIMPLE_RADIAL_FISHEYE", "FULL_OPENCV", "shared", "rig", "twice")
KINDS = (*SMALL, "street", "shared street")


def model_named(name):
    if name.endswith("street"):
        return model_of(dataclasses.replace(STREET, shared_camera=name.startswith("shared")), seed=2)
    if name == "rig":
        return with_rig(model_of(dataclasses.replace(SPEC, num_images=8), seed=3))
    spec = dataclasses.replace(SPEC, shared_camera=True) if name in {"shared", "twice"} else SPEC
    spec = dataclasses.replace(spec, camera_model=name) if name.isupper() else spec
    return model_of(spec, seed=3)


def seen_twice(model):
    """The first observation of each image once more, half a pixel beside."""
    table = model.observations
    order = np.sort(np.concatenate([np.arange(table.offsets[-1]), table.offsets[:-1]]))
    again = np.diff(order, prepend=-1) == 0
    observations = dataclasses.replace(
        table,
        offsets=table.offsets + np.arange(len(table.offsets)),
        point2d_idx=table.point2d_idx[order] + 1000 * again,
        xy_px=table.xy_px[order] + 0.5 * again[:, None],
        point_idx=table.point_idx[order],
    )
    return dataclasses.replace(model, observations=observations)


@pytest.fixture(scope="module", params=KINDS)
def asked(request):
    model = model_named(request.param)
    model = seen_twice(model) if request.param == "twice" else model
    auditor, options = ModelAuditor(model), {}
    if request.param == "rig":
        frames = claimed_frames(model)
        options = {"frame_idx": frames.frame_idx, "image_from_frame": frames.image_from_frame}
    system = joint_system(model, auditor.residuals, auditor.sigma_constant_px, **options)
    sums = sums_of_base(system.base)
    assert sums.repeats_follow
    return SimpleNamespace(
        name=request.param,
        system=system,
        sums=sums,
        many=ScoresOfMany(system, system.base, sums),
        beside=ImpliedBeside(system, own_parameters(system)),
        images=list(range(len(model.images))),
    )


@pytest.fixture(scope="module", params=[False, True], ids=["as it was", "with included fields"])
def beside(asked, request):
    """A base, its sums, and who asks it about many images."""
    base = asked.system.base
    if not request.param:
        return base, asked.sums, asked.many
    group, candidates = GROUP_COLUMNS[MisfitGroup.ROLLING_SHUTTER], []
    for image in (3, 1, 4):
        fields = misfit._fields_of(asked.system, image)
        root = group_root(candidate_scores(base, [image], lambda _, own=fields: own), group)
        nuisance = partial(asked.system.observations.nuisance, image)
        candidates.append(Candidate(image, fields.fields[:, :, group] @ root.T, nuisance))
    base = include(include(base, candidates[:2]), candidates[2:])
    sums = sums_of_base(base)
    return base, sums, ScoresOfMany(asked.system, base, sums)


def has_both(found):
    """(c,) whether a field has both components; the others are along one axis."""
    return (found.fields[2 * SCALAR :] != 0).any(axis=0)


def test_many_images_have_the_scores_that_numpy_has_of_one(asked, beside):
    base, _, many = beside
    powers = [asked.beside.power(image) for image in asked.images]
    layout = asked.system.observations.layout
    assert isinstance(base.inverse.main, BandedInverse) == asked.name.endswith("street")
    for image, power, found in zip(asked.images, powers, many.scores(asked.images, powers), strict=True):
        assert (found is None) == (asked.name == "FULL_OPENCV")
        if found is None:
            continue
        with numpy_only():
            fields = misfit._fields_of(asked.system, image, asked.beside if power else None)
            expected = candidate_scores(base, [image], lambda _, own=fields: own)
        unit = np.sqrt(expected.sq_length)
        assert_allclose(found.sq_length, expected.sq_length, rtol=1e-10)
        for name in ("gram", "meat"):
            scale = unit * unit[:, None] * (1.0 if name == "gram" else expected.meat.max() / unit.min() ** 2)
            of_one_kind = has_both(found) == has_both(found)[:, None]  # no group has fields of both kinds
            assert_allclose(getattr(found, name) / scale, of_one_kind * getattr(expected, name) / scale, atol=1e-9)
        assert_allclose(found.score / unit, expected.score / unit, atol=1e-9 * np.abs(expected.score / unit).max())
        own = np.sort(layout.columns[image][layout.columns[image] < layout.num_columns])
        assert_array_equal(found.support, own)
        at = np.searchsorted(expected.support, own)
        for name in ("coupling", "solution"):
            mine, theirs = getattr(found, name) / unit, getattr(expected, name)[at] / unit
            assert_allclose(mine, theirs, atol=1e-9 * np.abs(theirs).max())
        assert (found.num_tracks, found.num_observations) == (expected.num_tracks, expected.num_observations)


def test_the_bits_of_an_image_do_not_depend_on_those_beside_it(asked, beside):
    powers, many = [asked.beside.power(image) for image in asked.images], beside[2]
    together = many.scores(asked.images, powers)
    for image, power, one in zip(asked.images, powers, together, strict=True):
        (alone,) = many.scores([image], [power])
        if one is not None:
            for name in ("sq_length", "gram", "score", "meat", "solution"):
                assert getattr(alone, name).tobytes() == getattr(one, name).tobytes(), name


def test_threads_change_nothing(asked, monkeypatch):
    monkeypatch.setattr(misfit, "over_ranges", lambda of, number, weights: over_ranges(of, number, weights, 100.0))
    tau = np.full(len(asked.images), 0.2)
    alone = joint_misfit(asked.system, alpha=0.05, tau_px=tau)
    with threads(3):
        together = joint_misfit(asked.system, alpha=0.05, tau_px=tau)
    assert repr(together.tests) == repr(alone.tests)


def test_a_rolling_shutter_over_no_rows_is_left_to_numpy(asked):
    model = asked.system.model
    cameras = dataclasses.replace(model.cameras, height=np.zeros_like(model.cameras.height))
    flat = dataclasses.replace(asked.system, model=dataclasses.replace(model, cameras=cameras))
    many = ScoresOfMany(flat, asked.system.base, asked.sums)
    assert many.scores(asked.images, [0] * len(asked.images)) == [None] * len(asked.images)
    assert many.scores([], []) == []


@pytest.mark.parametrize("least", [0.0, 10.0])
def test_fields_whose_functions_all_but_cancel_are_left_to_numpy(asked, least, monkeypatch):
    """No model here has any: every field has less than ten times its functions' squares, and none less than nothing."""
    monkeypatch.setattr(image_score_module, "_LEFT_OF_TERMS", least)
    found = asked.many.scores(asked.images, [0] * len(asked.images))
    is_none = least > 0.0 or asked.name == "FULL_OPENCV"
    assert [each is None for each in found] == [is_none] * len(asked.images)


def test_a_band_that_does_not_reach_is_left_to_numpy(asked):
    if not asked.name.endswith("street"):
        return
    main, observations = asked.system.base.inverse.main, asked.system.observations
    arrays = main.arrays()
    rows = np.diff(arrays.first)
    near = np.concatenate([block[:, :own].ravel() for block, own in zip(main.near, rows.tolist(), strict=True)])
    short = dataclasses.replace(arrays, near=near, columns=rows, starts=np.cumsum([0, *rows**2]))
    given, behind = (asked.sums, observations.layout.columns, observations.transform), behind_of(asked.system)
    asked.many._kernel = JointScores(*given, short, **behind)
    found = asked.many.scores(asked.images, [0] * len(asked.images))
    asked.many._kernel = JointScores(*given, arrays, **behind)
    assert any(each is None for each in found)
    longer, later = arrays.first.copy(), arrays.first + 1
    longer[-1] = len(arrays.place) + 1
    too_many = {"first": longer}
    others = ({"first": later}, {"place": arrays.place + 1}, {"near": near}, {"starts": arrays.starts + 1})
    for changes in (*others, too_many):
        with pytest.raises(ValueError, match="another band"):
            JointScores(*given, dataclasses.replace(arrays, **changes), **behind)


def behind_of(system):
    inverse = system.base.inverse
    first = np.full(len(system.model.images), -1)
    included = IncludedArrays(inverse.update, inverse.border, inverse.corner, first)
    return {"included": included, "seen": seen_of(system)}


def seen_of(system, **changes):
    given = {
        "xyz_world": system.model.points.xyz_world,
        "xy_px": system.model.observations.xy_px,
        "residuals_px": system.residuals.residuals_px,
        "observation_row": system.residuals.observation_row,
        "points": system.observations.points,
        "source": system.observations.source,
    }
    return SeenArrays(**(given | changes))


def test_indices_that_lead_outside_never_reach_the_kernel():
    system = system_of(model_of(SPEC, seed=1))
    sums, layout = sums_of_base(system.base), system.observations.layout
    inverse = system.base.inverse.main.arrays()
    included = behind_of(system)["included"]
    given = sums, layout.columns, system.observations.transform, inverse
    for name in ("observation_row", "points", "source"):
        index = getattr(seen_of(system), name)
        for bad in (-1, 10**9):
            with pytest.raises(ValueError, match=f"{name}: expected 0"):
                JointScores(
                    *given,
                    included=included,
                    seen=seen_of(system, **{name: np.where(np.arange(index.size) == 3, bad, index)}),
                )
    with pytest.raises(ValueError, match="expected an array of shape"):
        JointScores(*given, included=included, seen=seen_of(system, residuals_px=np.zeros((2, 3))))
    with pytest.raises(ValueError, match="columns: expected 0"):
        JointScores(sums, layout.columns + 1000, *given[2:], included=included, seen=seen_of(system))
    outside = dataclasses.replace(included, update=np.zeros((3, 1)))
    with pytest.raises(ValueError, match="expected an array of shape"):
        JointScores(*given, included=outside, seen=seen_of(system))
    kernel = JointScores(*given, included=included, seen=seen_of(system))
    one = np.zeros(1, dtype=np.int64)
    assert kernel.of(Asked(one - 1, np.zeros((1, 27)), one, one)) is None
    assert kernel.of(Asked(one + len(layout.columns), np.zeros((1, 27)), one, one)) is None
    assert not kernel.of(Asked(one, np.full((1, 27), np.nan), one, one)).done.any()


@pytest.mark.parametrize("seed", range(4))
def test_the_order_of_sight_is_numpy_s(seed):
    rng = np.random.default_rng(seed)
    counts = rng.integers(0, 30, size=9)
    image_idx, point_idx = np.repeat(np.arange(9), counts), rng.integers(0, 25, size=counts.sum())
    offsets = np.concatenate([[0], np.cumsum(counts)])
    found = in_order_of_sight(image_idx, point_idx, offsets, 40)
    with numpy_only():
        expected = _in_order_of_sight(image_idx, point_idx, offsets, 40)
    for name in found._fields:
        assert_array_equal(getattr(found, name), getattr(expected, name), err_msg=name)
    assert_array_equal(found.points[found.point_idx], point_idx[found.order])
    assert_array_equal(image_idx[found.order], image_idx)
    first_seen = [int(np.flatnonzero(point_idx == p)[0]) for p in found.points]
    assert first_seen == sorted(first_seen)
    assert in_order_of_sight(image_idx, point_idx + 40, offsets, 40) is None
    assert in_order_of_sight(image_idx, point_idx, offsets[:-2], 40) is None


def test_two_weights_at_once_give_the_information_and_the_pull_of_each():
    rng = np.random.default_rng(0)
    design, weight, plain, values = rng.normal(size=(30, 2, 8)), rng.random(30), rng.random(4), rng.normal(size=(30, 2))
    offsets = np.array([0, 11, 11, 25, 30])
    image_idx, point_idx = np.repeat(np.arange(4), np.diff(offsets)), rng.integers(0, 7, size=30)
    by_point = np.argsort(point_idx, kind="stable")
    point_offsets = np.concatenate([[0], np.cumsum(np.bincount(point_idx, minlength=8))])
    index = JointIndex(offsets, image_idx, point_idx, by_point, point_offsets)
    found = two_informations(index, design, weight, plain, values)
    for k, each in enumerate((weight, plain[image_idx])):
        information, pull = np.zeros((8, 3, 3)), np.zeros((8, 3))
        jacobian = design[:, :, 3:6]
        np.add.at(information, point_idx, np.einsum("nai,naj,n->nij", jacobian, jacobian, each))
        np.add.at(pull, point_idx, np.einsum("nai,na,n->ni", jacobian, values, each))
        assert_allclose(found.informations[k], information, atol=1e-12)
        assert_allclose(found.pulls[k], pull, atol=1e-12)
    with pytest.raises(ValueError, match="expected an array of shape"):
        two_informations(index, design, weight, plain[:3], values)
    with numpy_only():
        assert two_informations(index, design, weight, plain, values) is None


def test_points_are_numbered_in_the_order_of_sight_on_both_paths():
    model = model_of(SPEC, seed=2)
    auditor = ModelAuditor(model)
    given = model, auditor.residuals, auditor.sigma_constant_px
    found = joint_observations(*given)
    with numpy_only():
        expected = joint_observations(*given)
    for name in ("source", "points", "point_idx", "by_point", "point_offsets"):
        assert_array_equal(getattr(found, name), getattr(expected, name), err_msg=name)
    assert_array_equal(found.points[found.point_idx], auditor.residuals.point_idx[found.source])
    assert (np.diff(found.point_idx) >= 0)[np.diff(found.image_idx) == 0].all()
