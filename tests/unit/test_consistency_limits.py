"""Both sides of every limit of belonging together, on hand-made numbers."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sfm_audit.audit.cameras import project
from sfm_audit.audit.consistency import (
    Cause,
    ConsistencyCode,
    Explanation,
    ImageConsistency,
    image_consistency,
    model_consistency,
)
from sfm_audit.audit.consistency.affine import fit_affine, median_of
from sfm_audit.audit.consistency.cause import affine_cause
from sfm_audit.audit.consistency.pose_step import lengths_after_pose_step, residuals_of
from sfm_audit.loaders.camera_models import BY_NAME
from sfm_audit.loaders.model import CameraRecord, ImageRecord

PARTS, BEHIND, SOME = ConsistencyCode.PARTS_DISAGREE, ConsistencyCode.POINTS_BEHIND, ConsistencyCode.IMAGES_DISAGREE
CAMERA = CameraRecord(1, BY_NAME["SIMPLE_PINHOLE"], 1600, 1200, np.array([1000.0, 830.0, 570.0]))


def image(cause=None, *, moved=False, num_linked=100, share=1.0, camera_id=1, known=True):
    inconsistent = (cause is not None and not moved) if known else None
    explanation = None if cause is None else Explanation(cause, f"it is {cause}")
    return ImageConsistency(
        "a.jpg", camera_id, num_linked, share, inconsistent=inconsistent, moved=moved, explanation=explanation
    )


def findings(images):
    found = model_consistency(images)
    return [(finding.code, finding.count, finding.cause) for finding in found.findings]


MODELS = {
    "half": ([image(Cause.SHIFT)] * 3 + [image()] * 3, [(PARTS, 3, Cause.SHIFT)]),
    "fewer": ([image(Cause.SHIFT)] * 3 + [image()] * 4, [(SOME, 3, Cause.SHIFT)]),
    "unknown images do not count": (
        [image(Cause.SHIFT)] * 3 + [image()] * 3 + [image(known=False)] * 9,
        [(PARTS, 3, Cause.SHIFT)],
    ),
    "an image alone": ([image(Cause.SHIFT)], [(PARTS, 1, Cause.SHIFT)]),
    "two causes": (
        [image(Cause.SHIFT), image(Cause.LINKS), image(Cause.SHIFT)] + [image()] * 9,
        [(SOME, 2, Cause.SHIFT), (SOME, 1, Cause.LINKS)],
    ),
    "no common cause": ([image(Cause.SHIFT), image(Cause.LINKS)] * 3, [(PARTS, 6, Cause.POSES_OR_POINTS)]),
    "moved by half": ([image(Cause.POSES, moved=True)] * 3 + [image()] * 3, [(PARTS, 3, Cause.POSES)]),
    "moved by fewer": ([image(Cause.POSES, moved=True)] * 3 + [image()] * 4, []),
    "nothing known": ([image(known=False)] * 5, []),
    "no image": ([], []),
    "a fifth behind": ([image(known=False, num_linked=10, share=0.8)] * 5, []),
    "more behind": ([image(known=False, num_linked=10, share=0.7)] * 5, [(PARTS, 15, Cause.POSES_OR_POINTS)]),
    "all behind": ([image(known=False, num_linked=10, share=0.0)] * 5, [(BEHIND, 50, Cause.POSES_OR_POINTS)]),
    "20 are enough to say behind": (
        [image(known=False, num_linked=20, share=0.0)],
        [(BEHIND, 20, Cause.POSES_OR_POINTS)],
    ),
    "20 are enough to disagree": ([image(known=False, num_linked=20, share=0.7)], [(PARTS, 6, Cause.POSES_OR_POINTS)]),
    "half of the images say scale": (
        [image(Cause.POINT_SCALE)] * 2 + [image()] * 2,
        [(PARTS, 2, Cause.POSES_OR_POINTS)],
    ),
    "more of them do": ([image(Cause.POINT_SCALE)] * 3 + [image()] * 2, [(PARTS, 3, Cause.POINT_SCALE)]),
    "too few to say": ([image(known=False, num_linked=4, share=0.0)] * 4, []),
    "no points": ([image(known=False, num_linked=0, share=np.nan)] * 4, []),
}


@pytest.mark.parametrize("name", MODELS)
def test_model_limits(name):
    images, expected = MODELS[name]
    assert findings(images) == expected
    found = model_consistency(images)
    assert found.parts_disagree == any(code in (PARTS, BEHIND) for code, _, _ in expected)
    assert found.inconsistent.tolist() == [bool(one.inconsistent) for one in images]


def test_a_camera_is_named_where_all_images_have_it():
    one = model_consistency([image(Cause.SHIFT)] * 2).findings[0].text
    two = model_consistency([image(Cause.SHIFT), image(Cause.SHIFT, camera_id=2)]).findings[0].text
    assert one == "camera 1: it is shift; 2 of 2 images"
    assert two == "it is shift; 2 of 2 images"
    behind = model_consistency([image(known=False, share=0.0)]).findings[0].text
    assert behind == "all 100 linked points lie behind their cameras: axes flipped or poses inverted?"


def affine(linear, offset, projected=None):
    projected = np.random.default_rng(0).uniform([0, 0], [1600, 1200], (200, 2)).T if projected is None else projected
    return fit_affine(projected, np.asarray(linear) @ projected + np.reshape(offset, (2, 1)) - projected)


def about(point, factor):
    """The offset of a scale about a point."""
    return (1 - np.asarray(factor)) * np.asarray(point, dtype=float)


PP = (830.0, 570.0)
MAPS = {
    "nothing": (np.eye(2), (0, 0), PP, None),
    "within the tolerance": (np.eye(2) * 1.005, (5, 5), PP, None),
    "shear": ([[1, 0.1], [0, 1]], (0, 0), PP, None),
    "turned by 10 degrees": (Rotation.from_euler("z", 10, degrees=True).as_matrix()[:2, :2], (0, 0), PP, None),
    "half": (0.5 * np.eye(2), (0, 0), PP, Cause.RESOLUTION),
    "1.2 about the corner": (1.2 * np.eye(2), (0, 0), PP, Cause.RESOLUTION),
    "1.2 about the principal point": (1.2 * np.eye(2), about(PP, 1.2), PP, Cause.FOCAL_LENGTH),
    "1.49 about the principal point": (1.49 * np.eye(2), about(PP, 1.49), PP, Cause.FOCAL_LENGTH),
    "1.51 about the principal point": (1.51 * np.eye(2), about(PP, 1.51), PP, Cause.RESOLUTION),
    "0.67 about the principal point": (0.67 * np.eye(2), about(PP, 0.67), PP, Cause.FOCAL_LENGTH),
    "0.66 about the principal point": (0.66 * np.eye(2), about(PP, 0.66), PP, Cause.RESOLUTION),
    "1.2 about another point": (1.2 * np.eye(2), about((300, 300), 1.2), PP, Cause.RESOLUTION),
    "two factors": (np.diag([1.2, 1.3]), about(PP, (1.2, 1.3)), PP, Cause.FOCAL_LENGTH),
    "shift": (np.eye(2), (800, 600), PP, Cause.SHIFT),
    "principal point 0": (np.eye(2), (810, 590), (0, 0), Cause.PRINCIPAL_POINT_ZERO),
    "principal point 0 and a crop": (np.eye(2), (500, 590), (0, 0), Cause.SHIFT),
    "mirrored, half": (np.diag([0.5, -0.5]), (0, 600), PP, Cause.MIRRORED),
    "upside down": (-np.eye(2), (1600, 1200), PP, Cause.TURNED),
    "turned": ([[0, -1], [1, 0]], (1200, 0), PP, Cause.TURNED),
    "exchanged": ([[0, 1], [1, 0]], (0, 0), PP, Cause.MIRRORED),
    "exchanged and mirrored": ([[0, -1], [-1, 0]], (1200, 1600), PP, Cause.MIRRORED),
    "turned by 80 degrees": (Rotation.from_euler("z", 80, degrees=True).as_matrix()[:2, :2], (900, 0), PP, None),
}


@pytest.mark.parametrize("name", MAPS)
def test_what_an_affine_map_says(name):
    linear, offset, principal_point, cause = MAPS[name]
    camera = dataclasses.replace(CAMERA, params=np.array([1000.0, *principal_point]))
    found = affine_cause(affine(linear, offset), camera, 16.0)
    assert (None if found is None else found.cause) == cause


def test_words_of_maps():
    def text(linear, offset):
        return affine_cause(affine(linear, offset), CAMERA, 16.0).text

    assert (
        text(np.diag([1.2, 1.3]), (0, 0))
        == "2D points are (1.200, 1.300) x what the camera says: one resolution is wrong"
    )
    assert text([[0, 1], [-1, 0]], (0, 1600)).endswith("x_observed = y_projected, y_observed = 1600.0 - x_projected")
    assert text(np.diag([-0.5, 0.5]), (800, 3)).endswith(
        "mirrored in x: x_observed = 800.0 - 0.5 x_projected, y_observed = 0.5 y_projected + 3.0"
    )
    assert text(np.eye(2), (-0.01, -312.6)) == "2D points are shifted by (0.0, -312.6) px against the camera"


def scene(seed, n=200, noise=0.5):
    """Points in the camera frame, and where they are observed."""
    rng = np.random.default_rng(seed)
    xyz = np.column_stack([rng.uniform(-3, 3, n), rng.uniform(-2, 2, n), rng.uniform(4, 10, n)])
    return xyz, project(CAMERA.model, CAMERA.params, xyz) + noise * rng.normal(size=(n, 2))


def consistency(xyz_world, xy_px, *, camera=CAMERA, turn=(0, 0, 0), translation=(0, 0, 0)):
    quat = Rotation.from_rotvec(turn).as_quat()[[3, 0, 1, 2]]
    stored = ImageRecord(1, "a.jpg", 1, camera, quat, np.asarray(translation, dtype=float), len(xy_px))
    return image_consistency(stored, xy_px, xyz_world)


def test_half_a_pixel_has_to_be_known_to_five_sd_and_not_to_be_zero():
    xyz, xy = scene(0)
    assert consistency(xyz, xy + 0.5).half_pixel == 1
    assert consistency(xyz, xy - 0.5).half_pixel == -1
    assert consistency(xyz, xy).half_pixel == 0
    xyz, noisy = scene(1, n=30, noise=3.0)
    assert consistency(xyz, noisy + 0.5).half_pixel == 0
    _, exact = scene(1, n=30, noise=0.0)
    assert consistency(xyz, exact + 0.5 + 1e-3).half_pixel == 1
    stretched = (exact - exact.mean(axis=0)) * 1.002 + exact.mean(axis=0)
    assert consistency(xyz, stretched + 0.5).half_pixel == 0
    shrunk = (exact - exact.mean(axis=0)) * 0.998 + exact.mean(axis=0)
    assert consistency(xyz, shrunk + 0.5).half_pixel == 0


def test_what_fits_has_no_explanation():
    xyz, xy = scene(0)
    found = consistency(xyz, xy)
    assert (found.inconsistent, found.moved, found.explanation) == (False, False, None)


@pytest.mark.parametrize(("rest_px", "inconsistent"), [(2.0, True), (4.5, False)])
def test_an_error_below_one_percent_of_the_width_counts_from_20_times_what_an_affine_map_leaves(rest_px, inconsistent):
    """Some 60 px at a width of 16000 px: no pose stretches one axis and shrinks the other."""
    camera = dataclasses.replace(CAMERA, width=16000, height=12000, params=np.array([10000.0, 8000.0, 6000.0]))
    xyz, _ = scene(7, n=400)
    rng = np.random.default_rng(7)
    exact = project(camera.model, camera.params, xyz)
    inside = (np.abs(exact - camera.params[1:]) < [8000, 6000]).all(axis=1)
    observed = exact + (exact - camera.params[1:]) * [0.02, -0.02] + rng.normal(size=exact.shape) * rest_px / np.sqrt(2)
    found = consistency(xyz[inside], observed[inside], camera=camera)
    assert 20 < found.rms_px < 160
    assert found.inconsistent is inconsistent


def test_a_sphere_is_inconsistent_above_one_percent_of_its_width_alone():
    xyz, _ = scene(0)
    sphere = CameraRecord(1, BY_NAME["EQUIRECTANGULAR"], 8000, 4000, np.array([8000.0, 4000.0]))
    xy = project(sphere.model, sphere.params, xyz)
    rng = np.random.default_rng(0)
    for sd_px, inconsistent in ((40.0, False), (80.0, True)):
        found = consistency(xyz, xy + sd_px * rng.normal(size=xy.shape), camera=sphere)
        assert found.stored_rms_px > 50
        assert found.inconsistent is inconsistent


def test_points_behind_are_no_matter_of_the_pose_s_step():
    xyz, xy = scene(3)
    world = xyz - [0, 0, 7]
    world[:60, 2] -= 20  # 30 % behind
    found = consistency(world, xy, turn=(0, 0.06, 0), translation=(0, 0, 7))
    assert found.stored_rms_px > 16
    assert (found.inconsistent, found.moved) == (True, False)


def test_exactly_a_fifth_of_the_links_may_be_wrong():
    xyz, xy = scene(4, n=200, noise=0.1)
    xy[:40] += 500
    assert consistency(xyz, xy).inconsistent is False
    xy[40] += 500
    assert consistency(xyz, xy).inconsistent is True


def test_a_sphere_has_no_half_pixel():
    """It has no affine fit either; the table's column is made of this number, None would be null there."""
    xyz, _ = scene(0)
    sphere = CameraRecord(1, BY_NAME["EQUIRECTANGULAR"], 2000, 1000, np.array([2000.0, 1000.0]))
    found = consistency(xyz, project(sphere.model, sphere.params, xyz) + 0.5, camera=sphere)
    assert found.affine is None
    assert found.half_pixel == 0


def test_a_large_rest_is_no_resolution():
    xyz, xy = scene(2, n=4000)
    noise = np.random.default_rng(2).normal(size=xy.shape)
    assert consistency(xyz, 0.5 * xy + 10 * noise).explanation.cause is Cause.RESOLUTION
    assert consistency(xyz, 0.5 * xy + 18 * noise).explanation.cause is Cause.POSES_OR_POINTS


def test_another_scale_in_one_image_is_its_pose():
    """Moving a pose along its translation is what another scale of the points does."""
    xyz, xy = scene(3)
    world = xyz - [0, 0, 7]  # the true pose: no rotation, translation (0, 0, 7)
    moved = consistency(world, xy, translation=(0, 0, 7 * 1.08))
    far = consistency(world, xy, translation=(0, 0, 7 * 2.5))
    assert [(one.moved, one.inconsistent) for one in (moved, far)] == [(True, False), (False, True)]
    assert [one.explanation.cause for one in (moved, far)] == [Cause.POINT_SCALE] * 2
    sound = image()
    found = model_consistency([moved, far, sound, sound, sound])
    assert [one.explanation.cause for one in found.images[:2]] == [Cause.POSES, Cause.POSES_OR_POINTS]
    assert found.images[0].explanation.text.startswith("poses are off")
    assert "RMS" in found.images[0].explanation.text
    assert [finding.cause for finding in found.findings] == [Cause.POSES_OR_POINTS]
    assert model_consistency([moved, far, sound]).findings[0].cause is Cause.POINT_SCALE


def test_a_pose_that_its_step_brings_home_is_not_read_in_another_way():
    """A reading that fits within the limit has to leave much less than the pose's step does."""
    xyz, xy = scene(3)
    world = xyz - [0, 0, 7]
    found = consistency(world, xy, turn=(0, 0.06, 0), translation=(0, 0, 7))
    assert found.moved
    assert found.explanation.cause is Cause.POSES


def test_a_fifth_of_wrong_links_is_allowed():
    rng = np.random.default_rng(4)
    for share, inconsistent in ((0.19, False), (0.22, True)):
        xyz, xy = scene(4)
        wrong = slice(0, round(share * len(xy)))
        xy[wrong] = rng.uniform([0, 0], [1600, 1200], xy[wrong].shape)
        found = consistency(xyz, xy)
        assert found.stored_rms_px > 100
        assert found.inconsistent is inconsistent
        assert not found.moved


@pytest.mark.parametrize("seed", range(40))
def test_a_pose_step_lowers_the_median_or_is_not_taken(seed):
    rng = np.random.default_rng(seed)
    xyz, xy = scene(seed)
    moved = xyz @ Rotation.from_rotvec(rng.normal(size=3) * rng.choice([0.02, 0.3, 2.0])).as_matrix().T
    moved = moved + rng.normal(size=3) * rng.choice([0.0, 1.0, 4.0])
    in_front = moved[:, 2] > 0
    if not in_front.any():
        return
    residuals = residuals_of(CAMERA, xy[in_front], moved[in_front])
    after = lengths_after_pose_step(CAMERA, xy[in_front], moved[in_front], residuals)
    if after is not None:
        assert after.size >= 0.8 * in_front.sum()
        assert median_of(after) <= median_of(np.hypot(*residuals))


def test_a_pose_step_that_raises_the_median_is_not_taken():
    """Observed points that have nothing to do with the projected ones: the step would leave 664 px for 648."""
    rng = np.random.default_rng(169)
    xyz = np.column_stack([rng.uniform(-3, 3, 200), rng.uniform(-2, 2, 200), rng.uniform(0.3, 10, 200)])
    xy = rng.uniform([0, 0], [1600, 1200], (200, 2))
    assert lengths_after_pose_step(CAMERA, xy, xyz, residuals_of(CAMERA, xy, xyz)) is None


def test_points_that_the_step_brings_behind_the_camera_have_no_residual():
    """A division model projects them: 7 of 200 here."""
    camera = CameraRecord(1, BY_NAME["SIMPLE_DIVISION"], 1600, 1200, np.array([1000.0, 830.0, 570.0, -0.3]))
    rng = np.random.default_rng(50)
    xyz = np.column_stack([rng.uniform(-3, 3, 200), rng.uniform(-2, 2, 200), rng.uniform(0.3, 10, 200)])
    xy = project(camera.model, camera.params, xyz)
    moved = xyz @ Rotation.from_rotvec(rng.normal(size=3) * 0.3).as_matrix().T + rng.normal(size=3)
    in_front = np.flatnonzero(moved[:, 2] > 0)
    residuals = residuals_of(camera, xy[in_front], moved[in_front])
    valid = np.isfinite(residuals).all(axis=0)
    rows = in_front[valid]
    after = lengths_after_pose_step(camera, xy[rows], moved[rows], residuals[:, valid])
    assert (rows.size, after.size) == (200, 193)


def test_a_small_turn_is_undone_by_one_step_also_with_wrong_links():
    """Half a degree, and a fifth of wrong links."""
    xyz, xy = scene(5)
    turned = xyz @ Rotation.from_rotvec([0.006, -0.004, 0.005]).as_matrix().T + [0.01, -0.02, 0.03]
    after = lengths_after_pose_step(CAMERA, xy, turned, residuals_of(CAMERA, xy, turned))
    sound = np.hypot(*residuals_of(CAMERA, xy, xyz))
    assert median_of(np.hypot(*residuals_of(CAMERA, xy, turned))) > 5
    assert np.sqrt((after**2).mean()) == pytest.approx(np.sqrt((sound**2).mean()), rel=0.03)
    xy[:40] += [300, 200]
    after = lengths_after_pose_step(CAMERA, xy, turned, residuals_of(CAMERA, xy, turned))
    assert np.sqrt((after[40:] ** 2).mean()) == pytest.approx(np.sqrt((sound[40:] ** 2).mean()), rel=0.05)
