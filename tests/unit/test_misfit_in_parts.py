"""Score tests of large images, a part at a time, against one dense problem and against the tests of small images."""

from __future__ import annotations

import math
from functools import partial

import numpy as np
import pytest
from misfit_reference import camera, columns_of, interleaved, planar_points, points, slow_tests
from model_writer import noisy_model, write_binary
from numpy.testing import assert_allclose
from pooled_samples import CASES, NUM_TRACKS, dense, designs_of
from pooled_samples import assert_same as assert_equals_dense

from sfm_audit import open_model
from sfm_audit.audit.camera_quality.identifiability import covariance_of_sums, parameter_covariance
from sfm_audit.audit.config import AuditConfig
from sfm_audit.audit.engine import camera as engine_camera
from sfm_audit.audit.engine import quality as engine_quality
from sfm_audit.audit.engine.model import audit_model
from sfm_audit.audit.joint import candidates, design, misfit, neighbourhood, normal, observations
from sfm_audit.audit.kernels import numpy_only
from sfm_audit.audit.misfit import (
    ImageDesign,
    MisfitGroup,
    MisfitStatus,
    camera_tests,
    cause,
    image_retest,
    in_parts,
    prepare,
)
from sfm_audit.audit.misfit import sums as misfit_sums
from sfm_audit.audit.misfit.in_parts import (
    PartedImage,
    camera_tests_in_parts,
    column_sums,
    column_triangle,
    image_tests_in_parts,
)


@pytest.fixture(autouse=True)
def _small_parts(monkeypatch):
    monkeypatch.setattr(in_parts, "PART", 64)
    monkeypatch.setattr(in_parts, "_CLUSTERS", 130)


def parted(design):
    def part(chosen):
        columns = (each[:, :, chosen] for each in (design.pose, design.intrinsics, design.fields))
        return ImageDesign(*columns, design.residuals_px[:, chosen], design.track[chosen])

    return PartedImage(design.track, lambda chosen: part(chosen).pose, part)


def pooled(designs):
    return camera_tests_in_parts([parted(design) for design in designs], NUM_TRACKS)


@pytest.mark.parametrize("case", sorted(CASES))
def test_cameras_equal_one_dense_problem(case):
    cam, where = CASES[case]
    designs = designs_of(cam, np.random.default_rng(1), where=where, field=0.01)
    found, whole = pooled(designs), camera_tests(designs.__getitem__, len(designs), NUM_TRACKS)
    assert_equals_dense(found, dense(designs))
    assert (found.num_images, found.num_observations, found.num_tracks) == (4, 833, whole.num_tracks)
    assert_same(found.tests, whole.tests)


IMAGES = {
    "simple radial": (camera(), points, False),
    "opencv": (camera("OPENCV"), points, True),
    "k1 = 0": (camera("SIMPLE_RADIAL", (0.0,)), points, False),
    "planar pinhole": (camera("SIMPLE_PINHOLE"), planar_points, True),
    "far away": (camera(), lambda rng, n: points(rng, n, depths=(4000.0, 4000.5)), False),
    "one row": (camera(), lambda rng, n: points(rng, n) * np.array([1.0, 0.0, 1.0]), False),
}


@pytest.mark.parametrize("case", sorted(IMAGES))
def test_images_are_tested_as_small_ones(case):
    cam, where, clustered = IMAGES[case]
    rng = np.random.default_rng(3)
    nuisance, fields = columns_of(cam, where(rng, 500))
    y = rng.standard_normal((2, 500))
    track = rng.permutation(np.arange(500) // 2) if clustered else np.arange(500)
    found = image_tests_in_parts(parted(ImageDesign(nuisance, nuisance[:0], fields, y, track)), int(track.max()) + 1)
    assert_same(found, prepare(nuisance, fields, clusters=track if clustered else None).test(y))
    reference = slow_tests(interleaved(nuisance), interleaved(fields), y.T.ravel(), np.repeat(track, 2))
    for group, slow in reference.items():
        assert found[group].rank == slow.rank, group
        assert_allclose(found[group].p, slow.p, rtol=1e-6, err_msg=group)


def test_what_cannot_be_tested_says_why():
    rng = np.random.default_rng(4)
    assert {t.status for t in pooled([]).tests.values()} == {MisfitStatus.NOT_ENOUGH_EVIDENCE}
    panorama = pooled(designs_of(camera("EQUIRECTANGULAR"), rng, counts=(30,)))
    assert {t.status for t in panorama.tests.values()} == {MisfitStatus.NO_FIELDS}
    designs = designs_of(camera(), rng)
    designs[1].pose[2, 1, 70] = np.nan
    assert {t.status for t in pooled(designs).tests.values()} == {MisfitStatus.NOT_FINITE}
    designs = designs_of(camera(), rng)
    designs[1].fields[-1, 0, 70] = np.nan
    tests = pooled(designs).tests
    assert tests[MisfitGroup.SMOOTH].status is MisfitStatus.NOT_FINITE
    assert tests[MisfitGroup.RADIAL].status is MisfitStatus.TESTED
    alone = designs[1]
    alone = ImageDesign(alone.pose, alone.intrinsics[:0], alone.fields, alone.residuals_px, np.zeros(250, dtype=int))
    tests = image_tests_in_parts(parted(alone), 1)
    assert tests[MisfitGroup.SMOOTH].status is MisfitStatus.NOT_FINITE
    assert tests[MisfitGroup.RADIAL].status is MisfitStatus.NOT_ENOUGH_EVIDENCE


@pytest.mark.parametrize("where", [points, partial(points, depths=(4000.0, 4000.5))])
def test_the_covariance_is_that_of_all_columns_at_once(where):
    rng = np.random.default_rng(5)
    nuisance, fields = columns_of(camera("OPENCV"), where(rng, 300))
    nuisance[3] = 0.0
    image = parted(ImageDesign(nuisance, nuisance[:0], fields, nuisance[0], np.arange(300)))
    names = tuple("abcdefghijkl"[: len(nuisance)])
    sums = column_sums(image)
    found = covariance_of_sums(names, sums, 0.5, lambda: column_triangle(image, sums.norms))
    expected = parameter_covariance(nuisance, names, 0.5)
    assert found.names == expected.names
    assert_allclose(found.singular_share, expected.singular_share, rtol=1e-6)
    assert_allclose(found.covariance, expected.covariance, rtol=1e-5)


@pytest.mark.parametrize("config", [AuditConfig(), AuditConfig(points="independent", noise="constant")])
def test_a_model_of_large_images_gets_the_same_tables(tmp_path, monkeypatch, config):
    model = open_model(write_binary(tmp_path, noisy_model(num_images=4, num_points=90)))
    expected = audit_model(model, config)
    asked = []
    monkeypatch.setattr(misfit_sums, "AT_ONCE", 50)
    for module, name in ((engine_camera, "camera_tests_in_parts"), (engine_quality, "image_sums_in_parts")):
        monkeypatch.setattr(module, "AT_ONCE", 50)
        function = getattr(module, name)
        monkeypatch.setattr(module, name, lambda *a, f=function, **k: asked.append(f) or f(*a, **k))
    for module in (design, observations, candidates, misfit, neighbourhood, normal):
        monkeypatch.setattr(module, "AT_ONCE", 50)
    monkeypatch.setattr(neighbourhood, "_VIEWS_OF_LARGE", 40)
    for module in (design, observations, candidates):
        monkeypatch.setattr(module, "PART", 30)
    with numpy_only():  # kernels have no columns in memory
        found = audit_model(model, config)
    assert len(asked) > 4
    for table in ("images", "cameras", "models"):
        for row, other in zip(getattr(found, table).to_pylist(), getattr(expected, table).to_pylist(), strict=True):
            assert_same_row(row, other)


def assert_same_row(found, expected, name=""):
    if isinstance(expected, float):
        assert_allclose(found, expected, rtol=1e-6 if name.startswith("implied") else 1e-8, atol=1e-12, err_msg=name)
    elif isinstance(expected, dict):
        for key, value in expected.items():
            assert_same_row(found[key], value, key)
    elif isinstance(expected, list):
        for one, other in zip(found, expected, strict=True):
            assert_same_row(one, other, name)
    else:
        assert found == expected, name


def assert_same(found, expected):
    for group, test in expected.items():
        assert (found[group].rank, found[group].status) == (test.rank, test.status), group
        if not math.isnan(test.p):
            assert_allclose([found[group].p, found[group].px], [test.p, test.px], rtol=1e-6, atol=1e-9, err_msg=group)


@pytest.mark.parametrize("name", ["SIMPLE_RADIAL", "OPENCV", "EQUIRECTANGULAR"])
def test_a_larger_camera_is_tried_in_parts_as_at_once(monkeypatch, name):
    rng = np.random.default_rng(6)
    xyz_cam, y = points(rng, 300), rng.standard_normal((2, 300))
    retest = image_retest(xyz_cam, y)
    expected = retest(camera(name))
    monkeypatch.setattr(cause, "AT_ONCE", 100)
    assert_same(retest(camera(name)), expected)
