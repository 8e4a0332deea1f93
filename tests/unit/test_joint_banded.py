"""Block Cholesky and selected inverse against the dense way and numpy's pseudo-inverse."""

from __future__ import annotations

import dataclasses
from itertools import pairwise

import numpy as np
import pytest
from joint_reference import SPEC, model_of, system_of
from numpy.testing import assert_allclose, assert_array_equal
from scipy import sparse

from sfm_audit.audit.joint import band as band_module
from sfm_audit.audit.joint import banded
from sfm_audit.audit.joint import inverse as joint_inverses
from sfm_audit.audit.joint.band import _starts, band_blocks, band_of, dense_of
from sfm_audit.audit.joint.banded import banded_factor
from sfm_audit.audit.joint.banded_inverse import BandedInverse
from sfm_audit.audit.joint.banded_sandwich import banded_sandwiches
from sfm_audit.audit.joint.gauge import gauge_directions
from sfm_audit.audit.joint.inverse import (
    NULL_EIGENVALUE,
    DenseInverse,
    _cannot_be_null,
    joint_inverse,
    joint_solution,
)
from sfm_audit.audit.joint.matrix import csr_of
from sfm_audit.audit.joint.normal import reduced_systems, score_meat
from sfm_audit.audit.joint.own import _walds, walds
from sfm_audit.audit.kernels.threads import threads

STREET = dataclasses.replace(SPEC, num_images=60, points_per_image=60, max_neighbours=3, max_track_length=4)


SHARED = dataclasses.replace(STREET, shared_camera=True)


@pytest.fixture(scope="module", params=[STREET, SHARED], ids=["own cameras", "one camera"])
def street(request):
    """A model whose images see what their neighbours see, and nothing else; or share a camera besides."""
    return system_of(model_of(request.param, seed=4))


@pytest.fixture(scope="module")
def reduced(street):
    return reduced_systems(street.observations)[0]


@pytest.fixture(scope="module")
def scale(reduced):
    return np.sqrt(reduced.matrix.diagonal())


def inverted(system, *, dead=(), matrix=None):
    reduced, _ = reduced_systems(system.observations)
    matrix = reduced.matrix if matrix is None else matrix
    before = reduced.before.copy()
    before[list(dead)] *= 1e20
    return joint_inverse(matrix, before, gauge_directions(system.model, system.observations))


@pytest.fixture
def dense(street, monkeypatch):
    monkeypatch.setattr(joint_inverses, "band_of", lambda _: None)
    return inverted(street)


def own_of(system, image):
    """Columns of the camera of an image."""
    return system.observations.layout.own_of_image(image)


def test_a_street_is_a_band_and_a_room_is_none(street, reduced):
    band = band_of(reduced.matrix)
    row, column = (band.place[each] for each in csr_of(reduced.matrix).nonzero())
    within = (row < band.num_banded) & (column < band.num_banded)
    assert np.abs(row[within] - column[within]).max() == band.width
    assert np.abs(band.number(row[within]) - band.number(column[within])).max() == 1
    assert np.diff(band.starts).max() <= band.width
    inner = band.order[: band.num_banded]
    pattern = (abs(csr_of(reduced.matrix)) > 0)[inner][:, inner]
    row, column = (pattern @ pattern).nonzero()  # both couple with the same column
    behind = row <= column
    furthest = np.zeros(len(band.ends), dtype=np.int64)
    np.maximum.at(furthest, band.number(row[behind]), column[behind] + 1)
    assert (band.ends >= furthest).all()
    assert (band.ends == np.maximum(np.maximum.accumulate(furthest), [*band.starts[2:], band.starts[-1]])).all()
    assert (band.order[band.place] == np.arange(len(band.order))).all()
    is_shared = len(street.model.cameras) == 1
    assert np.sort(band.order[band.num_banded :]).tolist() == (own_of(street, 0).tolist() if is_shared else [])
    assert band.num_border == (2 if is_shared else 0)
    room = system_of(model_of(dataclasses.replace(SPEC, num_images=12), seed=1))
    assert band_of(reduced_systems(room.observations)[0].matrix) is None
    assert isinstance(street.base.inverse.main, BandedInverse)
    assert isinstance(room.base.inverse.main, DenseInverse)


def test_it_is_the_pseudo_inverse(street, reduced, scale):
    """In units of unit diagonal, by numpy's eigendecomposition; whatever is asked for."""
    unit = reduced.matrix.toarray() / scale / scale[:, None]
    expected = np.linalg.pinv(unit, rcond=1e-11, hermitian=True)
    main, size = street.base.inverse.main, len(scale)
    tolerance = {"atol": 1e-8 * np.abs(expected).max()}
    rng = np.random.default_rng(0)
    near = np.unique(street.observations.layout.columns[20:24])
    for columns in (np.arange(size), near, rng.permutation(near), np.array([0, size - 1, 7]), near[:0]):
        both = scale[columns] * scale[columns][:, None]
        assert_allclose(main.block(columns) * both, expected[np.ix_(columns, columns)], **tolerance)
        both_sides = main.within(columns, np.eye(len(columns)) * scale[columns]) * scale[columns][:, None]
        assert_allclose(both_sides, expected[np.ix_(columns, columns)], **tolerance)
        rows = main.rows(columns) * scale * scale[columns][:, None]
        assert_allclose(rows, expected[columns], **tolerance)
    right = rng.normal(size=(size, 3))
    assert_allclose(scale[:, None] * main.apply(right * scale[:, None]), expected @ right, atol=1e-6)
    assert_allclose(scale * main.apply(right[:, 0] * scale), expected @ right[:, 0], atol=1e-6)


def test_it_is_the_dense_inverse(street, scale, dense):
    both = scale * scale[:, None]
    everything = np.arange(len(scale))
    expected = dense.main.block(everything) * both
    found = street.base.inverse
    assert_allclose(found.main.block(everything) * both, expected, atol=1e-9 * np.abs(expected).max())
    assert found.num_null == dense.num_null == 0
    assert (found.unidentified == dense.unidentified).all()


def test_a_solution_needs_no_inverse(street, reduced):
    gauge = gauge_directions(street.model, street.observations)
    found = joint_solution(reduced.matrix, reduced.before, gauge, reduced.right)
    assert_allclose(found, street.base.inverse.main.apply(reduced.right), rtol=1e-9, atol=1e-12 * np.abs(found).max())
    assert joint_solution(reduced.matrix, reduced.before[:0], gauge[:0], reduced.right[:0]).shape == (0,)


def test_both_sides_of_the_middle_in_two_threads_say_the_same(street, monkeypatch):
    """To the last bit; also where all blocks are on one side of it."""
    blocks = [*street.observations.layout.columns]
    meat, main = score_meat(street.observations, street.base.left_px), street.base.inverse.main
    monkeypatch.setattr(banded, "_WORTH_A_THREAD", 0.0)
    by_two: list[int] = []
    original = banded.together
    monkeypatch.setattr(banded, "together", lambda *both: (by_two.append(len(both)), original(*both)))
    with threads(2):
        found = inverted(street).main
        covariances = banded_sandwiches(found, meat, blocks)
    assert len(by_two) == 4
    assert_array_equal(found.flat, main.flat)
    assert_array_equal(found.pull, main.pull)
    for one, other in zip(covariances, banded_sandwiches(main, meat, blocks), strict=True):
        assert_array_equal(one, other)
    monkeypatch.setattr(band_module, "_MORE_BEHIND", 10**6)
    one_way = inverted(street).main
    assert one_way.factor.band.middle == 0
    assert_allclose(one_way.flat, main.flat, atol=1e-9 * np.abs(main.flat).max())
    for one, other in zip(banded_sandwiches(one_way, meat, blocks), covariances, strict=True):
        assert_allclose(one, other, atol=1e-8 * np.abs(other).max())


@pytest.mark.parametrize("in_a_band", [True, False])
def test_the_trace_rules_null_directions_out_where_there_are_none(street, reduced, scale, monkeypatch, in_a_band):
    """No direction is looked for then; where it says nothing the search finds as many."""
    unit = reduced.matrix.toarray() / scale / scale[:, None]
    expected = np.trace(np.linalg.pinv(unit, rcond=1e-11, hermitian=True))
    if in_a_band:
        assert_allclose(street.base.inverse.main.trace, expected, rtol=1e-8)
    else:
        monkeypatch.setattr(joint_inverses, "band_of", lambda _: None)
    searches: list[int] = []
    traces: list[float] = []
    search, rule_out = joint_inverses._null_directions, joint_inverses._cannot_be_null
    monkeypatch.setattr(joint_inverses, "_null_directions", lambda *given: (searches.append(1), search(*given))[1])
    monkeypatch.setattr(
        joint_inverses, "_cannot_be_null", lambda *given: (traces.append(given[0]), rule_out(*given))[1]
    )
    assert inverted(street).num_null == 0
    assert not searches
    assert_allclose(traces, [expected], rtol=1e-8)
    monkeypatch.setattr(joint_inverses, "_cannot_be_null", lambda *_: False)
    assert inverted(street).num_null == 0
    assert searches == [1]
    gauge = gauge_directions(street.model, street.observations)
    given = reduced.matrix, reduced.before, gauge, reduced.right
    step = joint_solution(*given)
    assert searches == [1, 1]  # too many columns for an inverse that nobody needs
    monkeypatch.setattr(joint_inverses, "_TINY", len(reduced.right))
    monkeypatch.setattr(joint_inverses, "_cannot_be_null", rule_out)
    assert_array_equal(joint_solution(*given), step)
    assert searches == [1, 1]


@pytest.mark.parametrize(
    ("trace", "rounding", "ruled_out"),
    [
        (0.49 / NULL_EIGENVALUE, 0.0, True),
        (0.51 / NULL_EIGENVALUE, 0.0, False),
        (0.49 / 512 / np.finfo(float).eps / 1e8, 1e4, True),
        (0.51 / 512 / np.finfo(float).eps / 1e8, 1e4, False),
        (-1.0, 0.0, False),
        (0.0, 0.0, False),
        (np.nan, 0.0, False),
    ],
)
def test_what_a_trace_says(trace, rounding, ruled_out):
    """Rounding counts by the sum of squares, in both places."""
    assert _cannot_be_null(trace, np.array([0.6, 0.8]) * rounding) is ruled_out


def test_a_dead_column_is_zero_and_leaves_the_others_alone(street, monkeypatch):
    dead = int(own_of(street, 30)[1])
    found = inverted(street, dead=[dead])
    monkeypatch.setattr(joint_inverses, "band_of", lambda _: None)
    expected = inverted(street, dead=[dead])
    columns = street.observations.layout.columns[30]
    assert isinstance(found.main, BandedInverse)
    assert np.flatnonzero(found.unidentified).tolist() == [dead]
    assert not found.main.rows(np.array([dead])).any()
    assert_allclose(found.main.block(columns), expected.main.block(columns), rtol=1e-6, atol=1e-30)


def test_a_further_null_direction_is_found_in_a_band_too(street, reduced):
    """A parameter made a copy of another one of its camera: S of x_a + x_b alone."""
    first, second = own_of(street, 30)
    merge = np.eye(len(reduced.right))
    merge[second] = merge[first]
    matrix = sparse.csr_array(merge @ reduced.matrix.toarray() @ merge.T)
    found = inverted(street, matrix=matrix)
    assert isinstance(found.main, BandedInverse)
    assert found.num_null == 1
    assert {int(first), int(second)} <= set(np.flatnonzero(found.unidentified).tolist())
    unit = np.sqrt(matrix.diagonal())
    expected = np.linalg.pinv(matrix.toarray() / unit / unit[:, None], rcond=1e-11, hermitian=True)
    columns = street.observations.layout.columns[30]
    both = unit[columns] * unit[columns][:, None]
    assert_allclose(found.main.block(columns) * both, expected[np.ix_(columns, columns)], atol=1e-7)


def test_covariances_are_the_sandwich_by_numpy(street, reduced, scale):
    """S^+ M S^+ at the columns of every image, of every camera and on both sides of every border between two blocks."""
    meat = score_meat(street.observations, street.base.left_px).toarray() / scale / scale[:, None]
    unit = np.linalg.pinv(reduced.matrix.toarray() / scale / scale[:, None], rcond=1e-11, hermitian=True)
    expected, layout = unit @ meat @ unit, street.observations.layout
    band = street.base.inverse.main.factor.band
    on_both_sides = [band.order[start - 4 : start + 5] for start in band.starts[1:-1].tolist()]
    blocks = [*layout.columns, *(layout.own_of_camera(k) for k in range(len(street.model.cameras))), *on_both_sides]
    found = banded_sandwiches(street.base.inverse.main, score_meat(street.observations, street.base.left_px), blocks)
    for block, own, public in zip(blocks, found, street.covariances(blocks), strict=True):
        both = scale[block] * scale[block][:, None]
        assert_allclose(own * both, expected[np.ix_(block, block)], atol=1e-8 * np.abs(expected).max())
        assert_allclose(public, own, rtol=1e-9, atol=1e-12 * np.abs(own).max())


def test_blocks_of_columns_that_lie_apart_have_the_same_covariance(street):
    apart = np.unique(street.observations.layout.columns[[3, 50]])
    own = np.searchsorted(apart, street.observations.layout.columns[3])
    (both,), (first,) = street.covariances([apart]), street.covariances([street.observations.layout.columns[3]])
    assert_allclose(both[np.ix_(own, own)], first, rtol=1e-6)


def test_blocks_of_many_images_are_those_of_one(street, dense):
    columns = street.observations.layout.columns[:, :8]
    band = street.base.inverse.main.factor.band
    far = np.concatenate([band.order[:4], band.order[band.num_banded - 4 : band.num_banded]])[None]
    assert all(street.base.inverse.main._is_near(each) for each in columns)
    edge = np.array(
        [[band.order[band.starts[1] - 1], band.order[band.ends[0] + k], *band.order[4:10]] for k in (-1, 0)]
    )
    assert [street.base.inverse.main._is_near(each) for each in edge] == [True, False]
    assert not street.base.inverse.main._is_near(far[0])
    asked = np.concatenate([columns, far, edge])  # the last column that is at hand, and the first that is not
    for main in (street.base.inverse.main, dense.main):
        for found, each in zip(main.blocks(asked), asked, strict=True):
            expected = main.block(each)
            unit = np.sqrt(expected.diagonal())
            assert_allclose(found / unit / unit[:, None], expected / unit / unit[:, None], atol=1e-12)


def test_what_a_step_gains_is_its_wald_statistic(street):
    rng, columns = np.random.default_rng(0), street.observations.layout.columns[[3, 8, 20]]
    steps = rng.normal(size=columns.shape) * np.sqrt(np.abs(street.base.inverse.main.blocks(columns)[:, 0, :1]))
    blocks = street.base.inverse.main.blocks(columns)
    expected = [step @ np.linalg.solve(block, step) for block, step in zip(blocks, steps, strict=True)]
    assert_allclose(walds(street, columns, steps), expected, rtol=1e-6)
    lost = street.base.inverse.unidentified.copy()
    lost[columns[1, 2:5]] = True
    less = dataclasses.replace(
        street,
        base=dataclasses.replace(street.base, inverse=dataclasses.replace(street.base.inverse, unidentified=lost)),
    )
    left = np.delete(np.arange(8), [2, 3, 4])
    own = steps[1, left] @ np.linalg.solve(blocks[1][np.ix_(left, left)], steps[1, left])
    assert_allclose(walds(less, columns, steps), [expected[0], own, expected[2]], rtol=1e-6)
    assert walds(street, columns[:0], steps[:0]).shape == (0,)


def test_a_direction_that_nothing_holds_gains_nothing():
    """Two parameters that only move together: rounding must not make a direction of their difference."""
    blocks = np.array([[[1.0, 1.0], [1.0, 1.0]]])
    found = _walds(np.repeat(blocks, 2, axis=0), np.ones((2, 2), dtype=bool), np.array([[1.0, 1.0], [1.0, -1.0]]))
    assert_allclose(found, [1.0, 0.0], atol=1e-9)


def test_cameras_of_a_street_each_for_a_part_of_it_are_its_border():
    """Three cameras, one after the other along the way: the band of the poses alone is the narrowest."""
    model = model_of(STREET, seed=4)
    thirds = np.arange(60) * 3 // 60
    images = dataclasses.replace(model.images, camera_idx=thirds)
    matrix = reduced_systems(system_of(dataclasses.replace(model, images=images)).observations)[0].matrix
    band = band_of(matrix)
    layout = system_of(dataclasses.replace(model, images=images)).observations.layout
    assert set(band.order[band.num_banded :]) >= {int(c) for k in (0, 20, 59) for c in layout.own_of_image(k)}


def test_a_border_that_is_not_positive_definite_makes_no_factor(street, reduced):
    """Below the rest of the diagonal by more than the elimination leaves: the dense way finds out what it is."""
    band = band_of(reduced.matrix)
    matrix = reduced.matrix.toarray()
    matrix[own_of(street, 0), own_of(street, 0)] *= 1e-3
    gauge = np.zeros((len(matrix), 0))
    assert banded_factor(sparse.csr_array(matrix), band, gauge, np.ones(len(matrix))) is None


def test_the_blocks_of_a_band_are_the_matrix_in_its_order(reduced, scale):
    """From blocks of pairs of images and from a sparse matrix; a column of scale zero is zero."""
    band, unit = band_of(reduced.matrix), 1.0 / scale
    unit[7] = 0.0
    expected = (reduced.matrix.toarray() * unit * unit[:, None])[np.ix_(band.order, band.order)]
    for matrix in (reduced.matrix, csr_of(reduced.matrix)):
        found = band_blocks(matrix, band, unit)
        parts = list(band.blocks())
        for own, block in zip(parts, found.diagonal, strict=True):
            assert_allclose(block, expected[own, own], atol=1e-14)
        for (own, following), block in zip(pairwise(parts), found.below, strict=True):
            assert_allclose(block, expected[following, own], atol=1e-14)
        assert_allclose(found.border, expected[:, band.num_banded :], atol=1e-14)
        assert_allclose(dense_of(matrix, unit)[np.ix_(band.order, band.order)], expected, atol=1e-14)


def test_columns_in_groups_make_a_band_as_columns_alone_do(reduced):
    found, alone = band_of(reduced.matrix), band_of(csr_of(reduced.matrix))
    assert found.num_border == alone.num_border
    assert found.width <= 1.5 * alone.width
    row, column = (found.place[each] for each in csr_of(reduced.matrix).nonzero())
    within = (row < found.num_banded) & (column < found.num_banded)
    assert np.abs(row[within] - column[within]).max() == found.width


def test_blocks_end_behind_what_the_one_before_couples_with():
    """As short as that allows, but no shorter than half the width: places that couple with nothing do not make many."""
    reach = np.array([2, 3, 3, 5, 6, 6, 9, 9, 9, 9, *range(10, 20)])
    starts = _starts(reach, 3).tolist()
    assert starts == [0, 3, 5, 7, 10, 12, 14, 16, 18, 20]
    assert _starts(np.arange(9), 1).tolist() == list(range(10))
    for here, following in pairwise(starts):
        end = starts[min(starts.index(following) + 1, len(starts) - 1)]
        assert reach[:following].max() < max(end, following)
        assert following - here <= 3


def test_a_column_that_reaches_far_is_taken_out_of_a_band_that_would_do_without():
    """A band either way, but a narrower one with a border."""
    places = np.arange(400)
    near = np.abs(places[:, None] - places) <= 4
    near[200, 150:251] = near[150:251, 200] = True
    band = band_of(sparse.csr_array(near.astype(np.float64)))
    assert band.order[band.num_banded :].tolist() == [200]
    assert band.width == 4
