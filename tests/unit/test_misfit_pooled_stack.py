"""Images of a camera with few observations, profiled together, are what each of them is by itself."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from joint_reference import SPEC, model_of
from numpy.testing import assert_array_equal

from sfm_audit.audit.engine.model import ModelAuditor
from sfm_audit.audit.inliers.joined import joined_inliers
from sfm_audit.audit.inliers.projected import image_inliers
from sfm_audit.audit.misfit import camera_tests, projected_design
from sfm_audit.audit.misfit.design import ImageDesign, piece_of
from sfm_audit.audit.misfit.pooled import camera_tests_of_pieces
from sfm_audit.audit.misfit.pooled_stack import in_windows, pieces_of_joined


@pytest.fixture(scope="module")
def auditor():
    return ModelAuditor(
        model_of(dataclasses.replace(SPEC, num_images=40, points_per_image=9, shared_camera=True), seed=5)
    )


@pytest.fixture(scope="module")
def images(auditor):
    alike = np.diff(auditor.residuals.offsets)
    return np.flatnonzero(alike == np.bincount(alike).argmax()).tolist()


def tracks_of(auditor, images):
    return [auditor.residuals.point_idx[auditor.residuals.rows(k)] for k in images]


def joined_design(auditor, images):
    own = joined_inliers(auditor.model, auditor.residuals, images, len(tracks_of(auditor, images)[0]))
    track = np.concatenate(tracks_of(auditor, images))
    return projected_design(own.camera, own.projected, own.residuals_px, track)


def own_design(auditor, image):
    own = image_inliers(auditor.model, auditor.residuals, image)
    track = auditor.residuals.point_idx[auditor.residuals.rows(image)]
    return projected_design(own.camera, own.projected, own.residuals_px, track)


def assert_same(found, expected):
    assert (found.num_intrinsics, found.has_fields) == (expected.num_intrinsics, expected.has_fields)
    assert (found.part is None) == (expected.part is None)
    assert_array_equal(found.track, expected.track)
    for field in dataclasses.fields(expected.part) if expected.part else ():
        assert_array_equal(getattr(found.part, field.name), getattr(expected.part, field.name), err_msg=field.name)


def test_poses_profiled_together_are_each_by_itself(auditor, images):
    assert len(images) > 5
    found = pieces_of_joined(joined_design(auditor, images), tracks_of(auditor, images))
    for image, piece in zip(images, found, strict=True):
        assert_same(piece, piece_of(own_design(auditor, image)))


@pytest.mark.parametrize("spoilt", [0.0, np.nan, 1e200])
@pytest.mark.parametrize("name", ["pose", "intrinsics", "fields"])
def test_what_is_out_of_range_is_left_to_its_image(auditor, images, name, spoilt):
    design, tracks = joined_design(auditor, images), tracks_of(auditor, images)
    num = len(tracks[0])
    getattr(design, name)[1, :, 2 * num : 3 * num] = spoilt
    for b, piece in enumerate(pieces_of_joined(design, tracks)):
        own = slice(b * num, (b + 1) * num)
        parts = (each[:, :, own] for each in (design.pose, design.intrinsics, design.fields))
        assert_same(piece, piece_of(ImageDesign(*parts, design.residuals_px[:, own], tracks[b])))


def test_windows_of_images_give_the_tests_of_the_camera(auditor, images):
    tracks, asked = tracks_of(auditor, images), []

    def make(ahead):
        asked.append(ahead)
        chosen = [images[k] for k in ahead]
        return pieces_of_joined(joined_design(auditor, chosen), tracks[ahead.start : ahead.stop])

    num_tracks = len(auditor.model.points)
    found = camera_tests_of_pieces(in_windows(make, len(images), 7), len(images), num_tracks, exact=False)
    alone = camera_tests(lambda k: own_design(auditor, images[k]), len(images), num_tracks)
    assert repr(found) == repr(alone)
    assert [k for ahead in asked for k in ahead] == list(range(len(images)))


def test_a_camera_without_fields_has_none_together_either(auditor, images):
    design = joined_design(auditor, images)
    bare = dataclasses.replace(design, fields=design.fields[:0])
    assert not any(piece.has_fields for piece in pieces_of_joined(bare, tracks_of(auditor, images)))
