"""Models for misfit tests of many images at once: every lens, quaternions that are not unit, twin keypoints."""

from __future__ import annotations

import dataclasses

import numpy as np
from misfit_reference import PARAMS
from model_writer import Camera, Image, Model, Point, write_binary
from numpy.testing import assert_allclose

from sfm_audit import open_model
from sfm_audit.audit.cameras import project
from sfm_audit.audit.inliers.residuals import model_residuals
from sfm_audit.audit.misfit import GROUPS, MisfitStatus
from sfm_audit.loaders.camera_models import BY_NAME
from sfm_audit.loaders.model import moved

LENSES = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE", "FOV", "EUCM")
LENSES = (*LENSES, "RAD_TAN_THIN_PRISM_FISHEYE", "THIN_PRISM_FISHEYE", "DIVISION")
SURE = LENSES[:3]  # of the others the smooth fields nearly are columns of the image's own fit
NUMBERS = (300, 130, 65)
_SIZE = (640, 480)


def model_of(folder, name, numbers=NUMBERS, *, seed=1, sigma=0.5, shared=False, twins=0, centre=(317.0, 243.5)):
    """A model of images with so many points each; of ``twins`` points the keypoint is that of the point before."""
    rng = np.random.default_rng(seed)
    lens = BY_NAME[name]
    params = np.array([*(500.0, 502.0)[: len(lens.focal_idxs)], *centre, *PARAMS[name]])
    xyz = rng.uniform((-2.0, -1.5, 5.0), (2.0, 1.5, 9.0), (max(numbers), 3))
    images, tracks = [], [[] for _ in xyz]
    for k, number in enumerate(numbers):
        quat = np.array([1.0, *rng.normal(0.0, 0.02, 3)]) * (1.0 + 0.01 * k)  # no unit quaternion, as stored
        shift = np.array([0.3 - 0.3 * k, 0.1 * k, 0.0])
        xy = project(lens, params, moved(quat, shift, xyz)) + rng.normal(0.0, sigma, (len(xyz), 2))
        xy[1 : 2 * twins : 2] = np.floor(xy[0 : 2 * twins : 2]) + 0.5
        seen = np.sort(rng.permutation(len(xyz))[:number])
        points2d = tuple((float(x), float(y), int(p) + 1) for (x, y), p in zip(xy[seen], seen, strict=True))
        for row, point in enumerate(seen.tolist()):
            tracks[point].append((k + 1, row))
        pose = (*map(float, quat), *map(float, shift))
        images.append(Image(k + 1, f"{k}.jpg", points2d, pose, 1 if shared else k + 1))
    cameras = [Camera(k + 1, lens.model_id, *_SIZE, tuple(map(float, params))) for k in range(len(numbers))]
    points = [
        Point(k + 1, tuple(own), tuple(map(float, at)), 0.5)
        for k, (own, at) in enumerate(zip(tracks, xyz, strict=True))
    ]
    written = Model(tuple(cameras[: 1 if shared else len(cameras)]), tuple(images), tuple(points))
    model = open_model(write_binary(folder, written))
    return model, model_residuals(model)


def nearly_flat(folder, numbers, k1, **options):
    """With next to no distortion its column nearly is a polynomial of the predicted point, which is a smooth field."""
    model, _ = model_of(folder, "SIMPLE_RADIAL", numbers, centre=(320.0, 240.0), **options)
    params = model.cameras.params.copy()
    params[3::4] = k1
    model = dataclasses.replace(model, cameras=dataclasses.replace(model.cameras, params=params))
    return model, model_residuals(model)


def assert_same(found, expected):
    assert tuple(found) == GROUPS
    for group in GROUPS:
        test, other = found[group], expected[group]
        assert (test.rank, test.status) == (other.rank, other.status), group
        if test.status is MisfitStatus.TESTED:
            assert_allclose(test.p, other.p, rtol=5e-6, err_msg=group)
            assert_allclose(test.px, other.px, rtol=5e-6, atol=1e-8, err_msg=group)
