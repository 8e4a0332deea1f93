"""Linked 2D points of many images in one place, whatever the order and the number of the images."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from sfm_audit.loaders.assembly import raw
from sfm_audit.loaders.assembly.raw import UNLINKED, LinkedPoints, RawImage, image_columns
from sfm_audit.loaders.colmap import binary_points

SIZES = (3, 0, 5, 1, 8)


def fields_of(rng, size):
    """POINTS2D (n, 3) as bits, a third of them not linked."""
    fields = np.column_stack([rng.random(size), rng.random(size), np.zeros(size)]).view(np.uint64)
    fields[:, 2] = np.where(rng.random(size) < 1 / 3, UNLINKED, rng.integers(1, 99, size, dtype=np.uint64))
    return fields


@pytest.mark.parametrize("most_at_once", [1, 4, 1 << 21])
@pytest.mark.parametrize("ids", [(1, 2, 3, 4, 5), (4, 2, 5, 1, 3)])
def test_images_keep_their_points(monkeypatch, most_at_once, ids):
    monkeypatch.setattr(raw, "_MOST_AT_ONCE", most_at_once)
    rng = np.random.default_rng(0)
    linked, images, expected = LinkedPoints(sum(SIZES)), [], {}
    for image_id, size in zip(ids, SIZES, strict=True):
        fields = fields_of(rng, size)
        expected[image_id] = fields[fields[:, 2] != UNLINKED]
        kept = linked.add(fields)
        assert_array_equal(kept[0], np.flatnonzero(fields[:, 2] != UNLINKED))
        images.append(RawImage(image_id, (1.0, *[0.0] * 6), 1, "a", size, *kept))
    columns = image_columns(images, linked)
    assert columns.image_id.tolist() == sorted(ids)
    wanted = np.concatenate([expected[image_id] for image_id in sorted(ids)])
    assert_array_equal(columns.xy_px.view(np.uint64), wanted[:, :2])
    assert_array_equal(columns.point3d_id, wanted[:, 2])
    assert_array_equal(np.diff(columns.offsets), [len(expected[image_id]) for image_id in sorted(ids)])
    plain = image_columns(images)
    assert_array_equal(plain.point2d_idx, columns.point2d_idx)
    assert_array_equal(plain.xy_px, columns.xy_px)


def records(lengths):
    """Points3D.bin without its count, tracks of so many elements."""
    return b"".join(
        struct.pack("<Q3d3BdQ", i, 0.5, 0.5, 0.5, 7, 7, 7, 0.25, length) + b"\xff" * (8 * length)
        for i, length in enumerate(lengths)
    )


def point_starts(data, max_count):
    starts, end = binary_points._point_starts(data, max_count)
    return starts.tolist(), end


LENGTHS = ((), (2,), (300,), (255, 256, 257), (2, 3) * 40, (2,) * 40 + (1000,) + (3,) * 40, (300,) * 5, (0, 0, 65536))


@pytest.mark.parametrize("lengths", LENGTHS, ids=lambda lengths: str(lengths[-3:]))
@pytest.mark.parametrize("many", [1, 16, 1 << 14])
def test_records_begin_where_tracks_of_any_length_end(monkeypatch, lengths, many):
    monkeypatch.setattr(binary_points, "_MANY", many)
    data = records(lengths)
    ends = np.cumsum([51 + 8 * length for length in lengths], dtype=np.int64).tolist()
    starts = [0, *ends][:-1] if ends else []
    assert point_starts(data, 10**9) == (starts, ends[-1] if ends else 0)
    assert point_starts(data, 1) == (starts[:1], ends[0] if ends else 0)
    for cut in (*range(1, min(60, len(data))), len(data) // 2):
        num_whole = int(np.searchsorted(ends, len(data) - cut, side="right"))
        at = [0, *ends][num_whole]
        assert point_starts(data[: len(data) - cut], 10**9) == (starts[:num_whole], at)


def test_a_length_of_many_digits_is_no_record():
    data = bytearray(records((2, 2)))
    data[51 + 16 + 43 + 7] = 0x80
    assert point_starts(bytes(data), 10) == ([0], 67)
