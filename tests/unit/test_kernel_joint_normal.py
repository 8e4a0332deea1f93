"""Blocks of ranges of images: what room there is and where a range begins change nothing."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from joint_reference import SPEC, model_of, system_of
from numpy.testing import assert_array_equal

from sfm_audit.audit.joint.normal import reduced_systems, score_meat
from sfm_audit.audit.joint.sums import joint_sums
from sfm_audit.audit.kernels import joint_normal, kernels_in_use, numpy_only
from sfm_audit.audit.kernels.joint_normal import OtherSystem, meats, normals

pytestmark = pytest.mark.skipif(not kernels_in_use(), reason="no compiled kernels here: nothing to compare")


@pytest.fixture(scope="module")
def asked():
    """Sums of a small model, its transforms and a second system."""
    system = system_of(model_of(dataclasses.replace(SPEC, num_images=9), seed=5))
    observations, base = system.observations, system.base
    sums = joint_sums(observations, base.left_px, observations.weight, base.point_inverse)
    pull = sums.off_points(observations.residuals_px())
    other = OtherSystem(1.0 / observations.sigma_px**2, 0.5 * base.point_inverse, (pull, 2.0 * pull))
    return system, sums, observations.transform, other


def same(found, expected):
    for one, other in zip(found, expected, strict=True):
        assert_array_equal(one, other)


def test_little_room_is_filled_several_times(asked, monkeypatch):
    """Each image has up to nine around it: room for nine holds two at most."""
    _, sums, transform, other = asked
    images = np.arange(9)
    plenty = normals(sums, images, transform, other), meats(sums, images, transform)
    monkeypatch.setattr(joint_normal, "_PAIRS_AT_ONCE", 1)
    found = normals(sums, images, transform, other), meats(sums, images, transform)
    assert plenty[0].pairs.counts.sum() > 18
    same(found[0].pairs, plenty[0].pairs)
    same(found[0][1:], plenty[0][1:])
    same(found[1], plenty[1])


def test_an_image_has_the_blocks_it_has_alone(asked):
    _, sums, transform, other = asked
    some = np.array([6, 2, 7])
    together, scores = normals(sums, some, transform, other), meats(sums, some, transform)
    ends = np.cumsum(together.pairs.counts)
    for k, image in enumerate(some):
        alone, pairs = (
            normals(sums, some[k : k + 1], transform, other),
            slice(ends[k] - together.pairs.counts[k], ends[k]),
        )
        assert alone.pairs.around[0] == image
        assert (alone.pairs.around >= image).all()
        same(
            alone.pairs,
            (together.pairs.counts[k : k + 1], together.pairs.around[pairs], together.pairs.slabs[:, pairs]),
        )
        same(alone[1:], (together.grams[k : k + 1], together.rights[k : k + 1]))
        assert_array_equal(meats(sums, some[k : k + 1], transform).slabs, scores.slabs[:, pairs])


def test_nobody_has_no_blocks_and_nobody_else_is_asked(asked):
    _, sums, transform, other = asked
    nobody = np.empty(0, dtype=np.int64)
    assert normals(sums, nobody, transform, other).pairs.slabs.shape == (2, 0, 8, 8)
    assert meats(sums, nobody, transform).around.size == 0
    for wrong in (np.array([9]), np.array([-1])):
        with pytest.raises(ValueError, match=r"expected 0 \.\. 8"):
            meats(sums, wrong, transform)
    with numpy_only():
        assert normals(sums, np.arange(9), transform, other) is None
        assert meats(sums, np.arange(9), transform) is None


def test_a_model_of_many_pairs_is_the_same_in_little_room(asked, monkeypatch):
    system = asked[0]
    expected = reduced_systems(system.observations), score_meat(system.observations, system.base.left_px)
    monkeypatch.setattr(joint_normal, "_PAIRS_AT_ONCE", 1)
    found = reduced_systems(system.observations), score_meat(system.observations, system.base.left_px)
    for mine, theirs in zip(found[0], expected[0], strict=True):
        assert_array_equal(mine.matrix.toarray(), theirs.matrix.toarray())
        assert_array_equal(mine.right, theirs.right)
    assert_array_equal(found[1].toarray(), expected[1].toarray())
