"""Camera models are one record per list: names and parameters in loaders, mathematics in audit.cameras."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from sfm_audit.audit.camera_quality.plausibility import folds_over
from sfm_audit.audit.cameras import project, project_with_jacobians, unproject
from sfm_audit.audit.cameras.functions import Family, Term, perspective
from sfm_audit.audit.cameras.models import CAMERA_FUNCTIONS, FUNCTIONS
from sfm_audit.audit.cameras.warps import radial
from sfm_audit.audit.misfit.capabilities import extended_params, larger_models, undistorted_model
from sfm_audit.loaders.assembly.consistency import principal_points
from sfm_audit.loaders.camera_models import BY_ID, BY_NAME, CAMERA_MODELS, CameraModel
from sfm_audit.loaders.model import CameraRecord, CameraTable

TOY = CameraModel(40, "TOY_RADIAL_3", ("f", "cx", "cy", "k1", "k2", "k3"))
PARAMS = np.array([900.0, 640.0, 360.0, 0.05, -0.01, 0.002])


def test_both_lists_hold_the_same_models_in_the_same_order():
    assert [model.name for model in CAMERA_MODELS] == [functions.name for functions in CAMERA_FUNCTIONS]
    assert len(BY_ID) == len(BY_NAME) == len(FUNCTIONS) == len(CAMERA_MODELS) == 25


def test_the_records_agree_about_what_the_parameters_mean():
    for model, functions in zip(CAMERA_MODELS, CAMERA_FUNCTIONS, strict=True):
        assert model.is_spherical == (functions.distort is None)
        assert (Term.ASPECT in functions.terms) == (len(model.focal_idxs) == 2 or "b1" in model.param_names)
        has_tangential = any(name[0] == "p" for name in model.param_names)
        assert (Term.TANGENTIAL in functions.terms) == has_tangential
        assert (functions.undistorted is None) == (not model.extra_idxs)
        if functions.undistorted is not None:
            plain = BY_NAME[functions.undistorted]
            assert FUNCTIONS[plain.name].is_fisheye == functions.is_fisheye
            assert len(plain.focal_idxs) == len(model.focal_idxs)


@pytest.fixture
def toy(monkeypatch) -> CameraModel:
    """One record per list; the dicts are made from the lists."""
    terms = (Term.RADIAL_2, Term.RADIAL_4, Term.RADIAL_6)
    monkeypatch.setitem(FUNCTIONS, TOY.name, perspective(TOY.name, radial, terms, "SIMPLE_PINHOLE"))
    monkeypatch.setitem(BY_ID, TOY.model_id, TOY)
    monkeypatch.setitem(BY_NAME, TOY.name, TOY)
    return TOY


def test_a_new_model_is_one_record_in_each_list(toy: CameraModel):
    rng = np.random.default_rng(0)
    xyz = rng.uniform((-2.0, -1.5, 4.0), (2.0, 1.5, 6.0), (50, 3))
    xy = project(toy, PARAMS, xyz)
    u, v = (xyz[:, :2] / xyz[:, 2:]).T
    r2 = u * u + v * v
    gain = 1.0 + 0.05 * r2 - 0.01 * r2**2 + 0.002 * r2**3
    assert_allclose(xy, np.column_stack([900.0 * u * gain + 640.0, 900.0 * v * gain + 360.0]), rtol=1e-13)

    rays = unproject(toy, PARAMS, xy)
    assert_allclose(rays / rays[:, 2:], xyz / xyz[:, 2:], atol=1e-10)

    found = project_with_jacobians(toy, PARAMS, xyz)
    for idx in range(toy.num_params):
        step = np.zeros(toy.num_params)
        step[idx] = 1e-5
        numeric = (project(toy, PARAMS + step, xyz) - project(toy, PARAMS - step, xyz)) / 2e-5
        assert_allclose(found.d_xy_d_params[:, :, idx], numeric, atol=1e-5)

    assert not folds_over(CameraRecord(1, toy, 1280, 720, PARAMS))
    assert undistorted_model(toy) == BY_NAME["SIMPLE_PINHOLE"]
    assert FUNCTIONS[toy.name].family is Family.POLYNOMIAL
    assert BY_NAME["FULL_OPENCV"] in larger_models(toy)
    larger = extended_params(toy, PARAMS, BY_NAME["FULL_OPENCV"])
    assert_allclose(project(BY_NAME["FULL_OPENCV"], larger, xyz), xy, rtol=1e-13)

    table = CameraTable(*(np.array([value]) for value in (1, toy.model_id, 1280, 720)), PARAMS, np.array([0, 6]))
    assert principal_points(table).tolist() == [[640.0, 360.0]]
