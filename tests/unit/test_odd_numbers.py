"""One odd number in one model: its image is undetermined, nothing reaches the terminal, no infinity a table."""

import dataclasses
import math
import warnings

import numpy as np
import pytest

from sfm_audit.audit.engine.model import audit_model
from sfm_audit.audit.inliers.sanity import is_sane, is_usable
from sfm_audit.audit.inliers.stationarity import pose_offset_px
from sfm_audit.audit.simulate.adjust import adjust_scene, sparse_model
from sfm_audit.audit.simulate.noise import NoiseKind, NoiseSpec
from sfm_audit.audit.simulate.scene import SceneSpec, simulate_scene
from sfm_audit.audit.table.words import ReasonCode, Verdict

WILD = (1e155, -1e200, 1e308, 1e100, 1e30, 1e-310, 0.0, math.inf, math.nan)


@pytest.fixture(scope="module")
def model():
    spec = SceneSpec(num_images=10, points_per_image=120, noise=NoiseSpec(NoiseKind.GAUSSIAN, 0.5), shared_camera=False)
    scene = simulate_scene(spec, np.random.default_rng(5))
    return sparse_model(scene, adjust_scene(scene))


def changed(model, table, column, index, value):
    rows = getattr(model, table)
    values = getattr(rows, column).copy()
    values[index] = value
    return dataclasses.replace(model, **{table: dataclasses.replace(rows, **{column: values})})


def audited(model):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return audit_model(model)


def assert_no_infinity(audit):
    for table in audit.tables.values():
        for name in table.column_names:
            values = table[name].to_pandas()
            if values.dtype.kind == "f":
                assert not np.isinf(values).any(), name


@pytest.mark.parametrize("value", WILD)
@pytest.mark.parametrize("param", [0, 1, 3], ids=["f", "cx", "k"])
def test_a_parameter_of_one_camera(model, param, value):
    wrong = changed(model, "cameras", "params", int(model.cameras.param_offsets[3]) + param, value)
    audit = audited(wrong)
    rows = audit.images.to_pylist()
    assert_no_infinity(audit)
    assert len(rows) == 10
    if not math.isfinite(value) or abs(value) > 1e12 or (param == 0 and abs(value) < 1e-6):
        assert rows[3]["verdict"] == Verdict.UNDETERMINED
        codes = {reason["code"] for reason in rows[3]["reason_details"]}
        assert codes == {ReasonCode.EXTREME_VALUES if math.isfinite(value) else ReasonCode.NON_FINITE_CAMERA}
    assert sum(row["verdict"] == Verdict.ACCEPTED for row in rows) >= 7  # the others are judged as ever


@pytest.mark.parametrize("value", WILD)
@pytest.mark.parametrize(
    ("table", "column", "index"),
    [
        ("images", "quat_cam_from_world_wxyz", (2, 1)),
        ("images", "translation_cam_from_world", (2, 0)),
        ("points", "xyz_world", (7, 2)),
        ("points", "stored_error_px", 7),
        ("observations", "xy_px", (50, 0)),
    ],
)
def test_one_number_elsewhere(model, table, column, index, value):
    audit = audited(changed(model, table, column, index, value))
    assert_no_infinity(audit)
    assert len(audit.images) == 10


@pytest.mark.parametrize(("column", "index"), [("xy_px", slice(0, 120)), ("xy_px", (slice(0, 120), 1))])
@pytest.mark.parametrize("value", [1e60, 1e155, 1e308])
def test_all_2d_points_of_an_image(model, column, index, value):
    audit = audited(changed(model, "observations", column, index, value))
    assert_no_infinity(audit)
    assert audit.images.to_pylist()[0]["verdict"] != Verdict.ACCEPTED


def test_all_points_in_one_place(model):
    audit = audited(changed(model, "points", "xyz_world", slice(None), 0.0))
    assert_no_infinity(audit)


def test_what_can_be_calculated_with(model):
    assert is_sane(np.array([0.0, 1e12, -1e12])).all()
    assert not is_sane(np.array([1.1e12, math.nan, math.inf])).any()
    camera = model.camera(0)
    assert is_usable(camera)
    for value in (0.0, 9e-7, 1e13, math.nan):
        params = camera.params.copy()
        params[0] = value
        assert not is_usable(dataclasses.replace(camera, params=params))


def test_a_pose_that_moves_no_point_has_no_offset():
    assert math.isnan(pose_offset_px(np.ones((2, 30)), np.zeros((2, 3, 30)), np.ones((30, 3))))
