"""Outside numbers: what pycolmap's bundle adjustment does when it is let (pycolmap 4.1, Ceres), and its covariance."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from joint_reference import model_of, system_of, with_param
from numpy.testing import assert_allclose

from sfm_audit.audit.engine.model import ModelAuditor
from sfm_audit.audit.joint import implied_parameters, joint_misfit, joint_system, own_parameters
from sfm_audit.audit.simulate.adjust import adjust_scene, sparse_model
from sfm_audit.audit.simulate.colmap_files import write_colmap_binary
from sfm_audit.audit.simulate.defects import DefectKind, DefectSpec
from sfm_audit.audit.simulate.noise import NoiseSpec
from sfm_audit.audit.simulate.scene import SceneSpec, simulate_scene
from sfm_audit.loaders import open_model

SPEC = SceneSpec(num_images=12, points_per_image=250, noise=NoiseSpec(sigma_px=0.5))


@pytest.fixture(scope="module")
def model():
    return model_of(SPEC, seed=7, adjusted=True)


def adjusted(model, folder, *, refine):
    """The model after pycolmap's adjustment: poses and points, intrinsics as well if ``refine``."""
    write_colmap_binary(model, folder, np.random.default_rng(0))
    reconstruction = pycolmap.Reconstruction(str(folder))
    options = pycolmap.BundleAdjustmentOptions(print_summary=False)
    options.refine_focal_length = options.refine_extra_params = refine
    options.refine_principal_point = False
    solver = options.ceres.solver_options
    solver.num_threads, solver.max_num_iterations = 1, 200
    solver.function_tolerance = solver.parameter_tolerance = 0.0
    solver.gradient_tolerance = 1e-4
    pycolmap.bundle_adjustment(reconstruction, options)
    out = Path(folder) / "out"
    out.mkdir()
    reconstruction.write(str(out))
    return open_model(str(out))


def params_of(model):
    return model.cameras.params.reshape(len(model.cameras), -1)


@pytest.mark.parametrize(("param", "change"), [(0, 1.01), (3, 1.2)])
def test_step_is_what_releasing_a_frozen_parameter_does(model, tmp_path, param, change):
    """Frozen at a wrong value, adjusted around, then released: the step says beforehand where it goes."""
    value = params_of(model)[4, param]
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    frozen = adjusted(with_param(model, 4, param, change * value), tmp_path / "a", refine=False)
    released = adjusted(frozen, tmp_path / "b", refine=True)
    steps = own_parameters(system_of(frozen))
    moved = params_of(released) - params_of(frozen)
    own = steps[4]
    k = 0 if param == 0 else 1
    assert moved[4, param] == pytest.approx(value - params_of(frozen)[4, param], rel=0.05)
    assert own.plain_step[k] == pytest.approx(moved[4, param], rel=0.03)
    assert own.implied[k] == pytest.approx(params_of(released)[4, param], abs=5 * own.sd[k])
    for other in np.delete(np.arange(12), 4).tolist():
        assert_allclose(steps[other].plain_step, moved[other, [0, 3]], atol=0.3 * steps[other].sd.max())
        assert steps[other].own_step_px < 0.02 < own.own_step_px


def test_own_covariance_is_pycolmap_s(model, tmp_path):
    """estimate_ba_covariance has unit weights and a gauge of its own; own parameters do not depend on the gauge."""
    write_colmap_binary(model, tmp_path, np.random.default_rng(0))
    reconstruction = pycolmap.Reconstruction(str(tmp_path))
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in reconstruction.images:
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    options = pycolmap.BundleAdjustmentOptions(print_summary=False, refine_principal_point=False)
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, reconstruction)
    wanted = pycolmap.BACovarianceOptions()
    wanted.params = pycolmap.BACovarianceOptionsParams.ALL
    covariance = pycolmap.estimate_ba_covariance(wanted, reconstruction, adjuster)
    unit = 100.0  # px: so much noise that no observation loses weight
    system = joint_system(model, ModelAuditor(model).residuals, np.full(12, unit))
    for camera in range(12):
        own = system.observations.layout.own_of_camera(camera)
        expected = covariance.get_other_params_cov(reconstruction.cameras[camera + 1].params)
        scale = np.sqrt(expected.diagonal())
        found = system.base.inverse.main.block(own) / unit**2
        assert_allclose(found / scale / scale[:, None], expected / scale / scale[:, None], atol=1e-5)


@pytest.mark.parametrize(
    ("kind", "groups"),
    [
        (DefectKind.RADIAL_K2, {"radial"}),
        (DefectKind.ROLLING_SHUTTER, {"rolling_shutter", "affine"}),
        (DefectKind.TANGENTIAL, {"principal_point", "tangential"}),
    ],
)
def test_the_planted_image_alone_is_found(kind, groups):
    spec = dataclasses.replace(SPEC, num_images=16, defects=(DefectSpec(5, kind, 1.0),))
    scene = simulate_scene(spec, np.random.default_rng(8))
    system = system_of(sparse_model(scene, adjust_scene(scene)))
    found = joint_misfit(system, alpha=0.05, tau_px=np.full(16, 0.2))
    assert np.flatnonzero(found.effect_px > 0.2).tolist() == [5]
    assert found.effect_px[5] == pytest.approx(1.0, abs=0.35)
    assert found.included[5]
    assert found.cause[5] in groups
    assert not found.most_are_wrong


def test_inclusion_clears_the_neighbours_and_includes_nobody_else():
    """3 px of rolling shutter in one of eight images: a neighbour shows 0.45 px of it until the fields are free."""
    spec = dataclasses.replace(SPEC, num_images=8, defects=(DefectSpec(3, DefectKind.ROLLING_SHUTTER, 3.0),))
    scene = simulate_scene(spec, np.random.default_rng(5))
    system = system_of(sparse_model(scene, adjust_scene(scene)))
    never = joint_misfit(system, alpha=0.05, tau_px=np.full(8, 100.0), excluded=np.arange(8) == 3)
    assert np.nanmax(never.effect_px) > 0.3
    found = joint_misfit(system, alpha=0.05, tau_px=np.full(8, 0.2))
    assert np.flatnonzero(found.included).tolist() == [3]
    assert np.delete(found.effect_px, 3).max() == 0.0
    assert found.effect_px[3] > 2.0
    worth = found.tests[3][found.cause[3]].worth
    assert worth.rotation_deg > 0.02
    assert abs(worth.focal_rel) < 0.05


def shifted(shift_px, num_images=14):
    """A scene whose principal points are all off by so much in x, adjusted without freeing them."""
    defects = tuple(
        DefectSpec(i, DefectKind.PRINCIPAL_POINT, values=(shift_px, 0.0)) for i in range(num_images if shift_px else 0)
    )
    spec = dataclasses.replace(SPEC, num_images=num_images, points_per_image=500, defects=defects, shared_camera=True)
    scene = simulate_scene(spec, np.random.default_rng(9))
    system = system_of(sparse_model(scene, adjust_scene(scene)))
    return implied_parameters(system, own_parameters(system))


@pytest.mark.parametrize(("shift_px", "found"), [(8.0, True), (5.0, False)])
def test_a_principal_point_off_in_all_images_is_implied(shift_px, found):
    """Poses and points adjusted around it: residuals keep hundredths of a pixel. Below 0.4 % of the width: silence."""
    principal_point = shifted(shift_px)[0]
    assert principal_point.parameter == "principal_point"
    assert_allclose(principal_point.step, [shift_px, 0.0], atol=5 * principal_point.sd.max())
    assert principal_point.step[0] > 5 * principal_point.sd[0]
    assert principal_point.found is found


def test_nothing_is_implied_of_a_healthy_model():
    assert not any(parameter.found for parameter in shifted(0.0))
