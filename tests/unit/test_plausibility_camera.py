"""Which cameras fold, and which are no cameras at all (method.md sections 6 and 7)."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from corpus import CORPUS, needs_corpus
from decision_samples import CAMERA, sound
from hypothesis import assume, given
from hypothesis import strategies as st

from sfm_audit.audit.camera_quality.plausibility import camera_plausibility, folds_over
from sfm_audit.audit.cameras import unproject
from sfm_audit.audit.config import AuditConfig
from sfm_audit.audit.decision.decide import decide
from sfm_audit.audit.table.words import ReasonCode
from sfm_audit.loaders import open_model
from sfm_audit.loaders.camera_models import BY_NAME, CAMERA_MODELS
from sfm_audit.loaders.model import CameraRecord


def camera_of(name, params, width=1600, height=1200):
    return CameraRecord(1, BY_NAME[name], width, height, np.array(params, dtype=np.float64))


def folds_by_roots(coefficients, reach):
    """Exactly: whether the smallest positive root r of d/dr (r + k1 r^3 + ..) comes before r_d = reach."""
    slope = np.zeros(2 * len(coefficients) + 1)
    slope[0] = 1.0
    slope[2::2] = [(2 * i + 3) * k for i, k in enumerate(coefficients)]
    roots = np.roots(slope[::-1])
    real = roots.real[(np.abs(roots.imag) < 1e-9 * np.abs(roots)) & (roots.real > 0)]
    if not real.size:
        return False, np.inf
    r = real.min()
    at_fold = r * (1.0 + sum(k * r ** (2 * i + 2) for i, k in enumerate(coefficients)))
    return at_fold < reach, at_fold


FOCALS = st.floats(5.0, 2e4)
CENTRES = st.tuples(st.floats(100.0, 1500.0), st.floats(100.0, 1100.0))


COEFFICIENTS = st.floats(-10.0, 10.0).map(lambda k: round(k, 6))


@given(focal=FOCALS, centre=CENTRES, k1=COEFFICIENTS, k2=COEFFICIENTS, power=st.integers(-4, 4))
def test_radial_folds_as_its_polynomial_says(focal, centre, k1, k2, power):
    k1, k2 = k1 * 10.0**power, k2 * 10.0 ** (2 * power)
    corners = np.array([[x, y] for x in (0, 1600) for y in (0, 1200)])
    reach = np.hypot(*(corners - centre).T).max() / focal
    expected, at_fold = folds_by_roots([k1, k2], reach)
    assume(abs(at_fold / reach - 1.0) > 0.02)  # which side of the corner is not ours to tell within rounding of a grid
    assert folds_over(camera_of("RADIAL", (focal, *centre, k1, k2))) == expected
    if k2 == 0.0 or power == 0:
        simple, at_fold = folds_by_roots([k1], reach)
        assume(abs(at_fold / reach - 1.0) > 0.02)
        assert folds_over(camera_of("SIMPLE_RADIAL", (focal, *centre, k1))) == simple


@given(
    focal=st.floats(500.0, 3000.0),
    k=st.tuples(*[st.floats(-0.6, 0.6)] * 2),
    # Real lenses stay below 0.005; beyond 0.03 a wide corner folds by decentring alone, between the rays we try.
    p=st.tuples(*[st.floats(-0.02, 0.02)] * 2),
    more=st.tuples(*[st.floats(-0.3, 0.3)] * 4),
    name=st.sampled_from(["OPENCV", "FULL_OPENCV", "THIN_PRISM_FISHEYE", "OPENCV_FISHEYE"]),
)
def test_agrees_with_the_way_back_from_every_border_pixel(focal, k, p, more, name):
    """Independent of the rays: a pixel beyond the fold has no ray, one before it has one."""
    extra = {
        "OPENCV": (*k, *p),
        "FULL_OPENCV": (*k, *p, *more),
        "THIN_PRISM_FISHEYE": (*k, *p, more[0], more[1], p[0], p[1]),
        "OPENCV_FISHEYE": (*k, *more[:2]),
    }[name]
    camera = camera_of(name, (focal, focal, 800.0, 600.0, *extra))
    t = np.linspace(0.0, 1.0, 41)
    border = np.concatenate(
        [np.column_stack([t * 1600, np.full(41, y)]) for y in (0.0, 1200.0)]
        + [np.column_stack([np.full(41, x), t * 1200]) for x in (0.0, 1600.0)]
    )
    lost = np.isnan(unproject(camera.model, camera.params, border)).mean()
    if name.endswith("FISHEYE"):
        assume(np.hypot(800, 600) / focal < 1.2)  # else rays beyond 90 degrees, which are no folds, have no way back
    if folds_over(camera):
        # A dip of the radius that ends before the border leaves every border pixel a ray: unproject may find it.
        within = border[:, None, :] * np.linspace(0.02, 1.0, 50)[:, None] + np.array([800.0, 600.0]) * (
            1.0 - np.linspace(0.02, 1.0, 50)[:, None]
        )
        seen = np.isfinite(unproject(camera.model, camera.params, within.reshape(-1, 2)))
        assert not seen.all() or lost > 0 or has_two_rays(camera)
    else:
        assert lost < 0.05 or not has_two_rays(camera)  # near a pole of a rational model the way back gives up


def has_two_rays(camera):
    """Whether the distorted radius is not monotonic along some direction, on a dense grid, by pycolmap alone."""
    theirs = pycolmap.Camera(model=camera.model.name, width=1600, height=1200, params=camera.params)
    angle = np.linspace(0, 2 * np.pi, 73)[:-1, None]
    t = (
        np.tan(np.linspace(1e-4, 1.5, 2000))
        if not camera.model.name.endswith("FISHEYE")
        else np.tan(np.linspace(1e-4, 1.55, 2000))
    )
    rays = np.stack([t * np.cos(angle), t * np.sin(angle), np.ones((72, 2000))], axis=-1)
    xy = theirs.img_from_cam(rays.reshape(-1, 3)).reshape(72, 2000, 2) - [800.0, 600.0]
    inside = (np.abs(xy) <= [800.0, 600.0]).all(axis=-1)
    radius = np.hypot(*np.moveaxis(xy, -1, 0))
    first_exit = np.where(inside.all(axis=1), 2000, np.argmin(inside, axis=1))
    falling = np.diff(radius, axis=1) < 0
    first_fall = np.where(falling.any(axis=1), np.argmax(falling, axis=1), 2000)
    return bool((first_fall < first_exit).any())


@pytest.mark.parametrize(
    ("name", "params", "expected"),
    [
        ("SIMPLE_PINHOLE", (1000, 800, 600), False),
        ("PINHOLE", (1000, 1000, 800, 600), False),
        ("SIMPLE_RADIAL", (1000, 800, 600, -0.05), False),
        ("SIMPLE_RADIAL", (1000, 800, 600, -0.2), True),  # r_d at the fold 0.86, corner at 1
        ("SIMPLE_RADIAL", (1000, 800, 600, -1e12), True),  # both signs turned before the first step of the grid
        ("RADIAL", (1000, 800, 600, 1.25, -5.85), True),
        ("FOV", (600, 600, 800, 600, 1.5), False),  # asymptote inside the image: an image circle
        ("SIMPLE_DIVISION", (1000, 800, 600, -2.0), False),
        ("SIMPLE_DIVISION", (1000, 800, 600, 0.9), False),
        ("SIMPLE_DIVISION", (1000, 800, 600, 1.1), True),  # r_d = 1 / sqrt(k) at the rim
        ("EUCM", (1000, 1000, 800, 600, 0.6, 1.1), False),
        ("EUCM", (400, 400, 800, 600, 1.6, 1.0), True),
        ("SIMPLE_FISHEYE", (300, 800, 600), False),  # 90 degrees well inside the image: an image circle
        ("SIMPLE_RADIAL_FISHEYE", (1000, 800, 600, -0.2), True),
        ("SIMPLE_RADIAL_FISHEYE", (700, 800, 600, -0.13), False),  # folds at 92 degrees, where nothing is seen
        ("SIMPLE_RADIAL_FISHEYE", (700, 800, 600, -0.14), True),  # folds at 88 degrees
        ("OPENCV_FISHEYE", (700, 700, 800, 600, 0.03, -0.01, 0.002, -0.0001), False),
        ("RAD_TAN_THIN_PRISM_FISHEYE", (900, 900, 800, 600, *[0.0] * 12), False),
        ("EQUIRECTANGULAR", (1600, 1200), False),
    ],
)
def test_known_cameras(name, params, expected):
    assert folds_over(camera_of(name, params)) is expected


@pytest.mark.parametrize("model", CAMERA_MODELS, ids=lambda model: model.name)
def test_every_model_without_distortion_is_plausible(model):
    known = {"f": 1300.0, "fx": 1300.0, "fy": 1310.0, "cx": 800.0, "cy": 600.0, "w": 1600.0, "h": 1200.0}
    params = [known.get(name, 0.1 if name in {"omega", "beta", "alpha"} else 0.0) for name in model.param_names]
    found = camera_plausibility(camera_of(model.name, params))
    assert not found.folds_over
    assert not is_outside(principal_point_px=found.principal_point_px)
    assert np.isnan(found.focal_over_size) if model.is_spherical else found.focal_over_size == 1300.0 / 1600.0


@pytest.mark.parametrize(
    ("centre", "outside"),
    [((0, 0), False), ((1600, 1200), False), ((-1, 600), True), ((800, 1200.5), True), ((1601, 600), True)],
)
def test_principal_point(centre, outside):
    found = camera_plausibility(camera_of("SIMPLE_PINHOLE", (1000, *centre)))
    assert found.principal_point_px == centre
    assert is_outside(principal_point_px=found.principal_point_px, size_px=found.size_px) is outside


def is_outside(**measured):
    reasons = decide(sound(camera=replace(CAMERA, **measured)), AuditConfig()).all_reasons
    return ReasonCode.PRINCIPAL_POINT_OUTSIDE in {reason.code for reason in reasons}


def test_degenerate_numbers_do_not_raise():
    assert not camera_plausibility(camera_of("SIMPLE_RADIAL", (0, 800, 600, 1.0))).folds_over
    assert np.isnan(camera_plausibility(camera_of("SIMPLE_RADIAL", (100, 0, 0, 1.0), 0, 0)).focal_over_size)
    assert camera_plausibility(camera_of("SIMPLE_RADIAL", (-1000, 800, 600, 0.0))).focal_over_size < 0


FOLDING = {"pratikk_sfm_7": 14, "yifr": 14, "yinsy_A": 1}
ABSURD_FOCAL = {"pratikk_sfm_7": 14, "yoojuno_r1_1": 1, "gtsfm_astrovision_vesta": 1}


@needs_corpus
@pytest.mark.corpus
@pytest.mark.parametrize("name", ["pratikk_sfm_7", "yifr", "yinsy_A", "yoojuno_r1_1", "gtsfm_astrovision_vesta"])
def test_implausible_corpus_models(name):
    model = open_model(CORPUS / "models" / name)
    used = Counter(model.images.camera_idx.tolist())
    found = [camera_plausibility(model.camera(idx)) for idx in used]
    assert sum(camera.folds_over for camera in found) == FOLDING.get(name, 0)
    assert sum(not 0.3 <= camera.focal_over_size <= 10.0 for camera in found) == ABSURD_FOCAL.get(name, 0)


@needs_corpus
@pytest.mark.corpus
@pytest.mark.parametrize(
    "name", ["softmurata", "yowsitian_sparse", "flaugusto_rigs0", "fobdor_0", "own_sceaux_castle_opencv"]
)
def test_strange_corpus_models_that_do_not_fold(name):
    model = open_model(CORPUS / "models" / name)
    assert not any(folds_over(model.camera(idx)) for idx in range(len(model.cameras)))
