"""Images that share a camera, and their pooled tests as one dense problem."""

from __future__ import annotations

import math

import numpy as np
from misfit_reference import camera, interleaved, planar_points, points, slow_tests
from numpy.testing import assert_allclose

from sfm_audit.audit.misfit import GROUPS, MisfitStatus, image_design, project_image

NUM_TRACKS = 500


def designs_of(cam, rng, counts=(300, 250, 3, 0, 280), where=points, field=0.0):
    """Images that share a camera; some tracks are seen twice in an image; a missing k2 of size ``field``."""
    out = []
    for n in counts:
        xyz = where(rng, n)
        track = rng.permutation(NUM_TRACKS)[:n]
        track[: n // 50] = track[n // 2 : n // 2 + n // 50]
        u = project_image(cam, xyz).u
        y = 0.5 * rng.standard_normal((2, n)) + field * 1000.0 * u * (u**2).sum(axis=0) ** 2
        out.append(image_design(cam, xyz, y, track))
    return out


def dense(designs):
    """The same as one matrix: poses block by block, intrinsics and fields stacked."""
    used = [design for design in designs if len(design.track)]
    num_values = 2 * sum(len(design.track) for design in used)
    poses = np.zeros((num_values, 6 * len(used)))
    start = 0
    for i, design in enumerate(used):
        stop = start + 2 * len(design.track)
        poses[start:stop, 6 * i : 6 * i + 6] = interleaved(design.pose)
        start = stop
    intrinsics = np.concatenate([interleaved(design.intrinsics) for design in used])
    fields = np.concatenate([interleaved(design.fields) for design in used])
    y = np.concatenate([design.residuals_px.T.ravel() for design in used])
    cluster = np.concatenate([np.repeat(design.track, 2) for design in used])
    return slow_tests(np.hstack([poses, intrinsics]), fields, y, cluster, law="chi2")


def assert_same(found, reference):
    for group in GROUPS:
        test, slow = found.tests[group], reference[group]
        assert test.rank == slow.rank, group
        assert (test.status is MisfitStatus.TESTED) == (not math.isnan(slow.p)), group
        if test.status is MisfitStatus.TESTED:
            assert_allclose(test.p, slow.p, rtol=1e-6, err_msg=group)
            assert_allclose(test.px, slow.px, rtol=1e-6, atol=1e-7, err_msg=group)


CASES = {
    "simple radial": (camera(), points),
    "opencv": (camera("OPENCV"), points),
    "full opencv": (camera("FULL_OPENCV"), points),
    "fisheye": (camera("OPENCV_FISHEYE"), points),
    "rational": (camera("EUCM"), points),
    "k1 = 0": (camera("SIMPLE_RADIAL", (0.0,)), points),
    "pinhole": (camera("SIMPLE_PINHOLE"), points),
    "planar": (camera(), planar_points),
    "a part of the images": (camera(), lambda rng, n: points(rng, n, centre=(0.5, 0.5), spread=0.1)),
}
