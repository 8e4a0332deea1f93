"""scripts/compare_paths.py sees a kernel that computes something else, and knows rounding when it sees it."""

import dataclasses
import importlib.util
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from model_writer import noisy_model, write_binary
from numpy.testing import assert_allclose

from sfm_audit.loaders import open_model
from sfm_audit.loaders.model import rotation_from_quat

ROOT = Path(__file__).resolve().parents[2]
_spec = importlib.util.spec_from_file_location("compare_paths", ROOT / "scripts" / "compare_paths.py")
compare_paths = importlib.util.module_from_spec(_spec)
sys.modules["compare_paths"] = compare_paths
_path = list(sys.path)
_spec.loader.exec_module(compare_paths)
sys.path[:] = _path


def faults_of(numpy, kernels, nudged):
    out = compare_paths.Compared("some")
    kind = pa.array(numpy).type
    compare_paths._compare_column(
        "x of m", [compare_paths.split(list(each), kind) for each in (numpy, kernels, nudged)], out
    )
    return out


@pytest.mark.parametrize(
    ("numpy", "kernels", "nudged", "faults"),
    [
        ([1.0, 2.0], [1.0, 2.0 + 1e-10], [1.0, 2.0], 0),
        ([1.0, 2.0], [1.0, 2.0 + 1e-8], [1.0, 2.0], 1),
        ([1.0, 2.0], [1.0, 2.0 + 1e-8], [1.0, 2.0 - 1e-8], 0),  # numpy's own rounding
        ([1.0, 2.0], [1.0, None], [1.0, 2.0], 1),
        ([1.0, 2.0], [1.0, None], [1.0, None], 0),
        ([1.0, 2.0], [1.0, None], [1.0, 2.1], 0),  # nothing but rounding
        ([1.0, 1e-9], [1.0, 1e-9 + 1e-14], [1.0, 1e-9], 0),  # zero by cancelling
        ([1.0, np.inf], [1.0, 2.0], [1.0, np.inf], 1),
        (["accepted"], ["rejected"], ["rejected"], 1),
        (["0.12 px, q = 1e-5"], ["0.13 px, q = 1e-5"], ["0.12 px, q = 1e-5"], 0),  # printed as neighbours
        (["0.12 px, q = 1e-5"], ["0.12 px, q = 3e-5"], ["0.12 px, q = 1e-5"], 1),
        (["0.12 px"], ["0.14 px"], ["0.12 px"], 1),
        (["0.12 px"], ["0.14 px"], ["0.11 px"], 0),
        (["0.12 px"], ["nan px"], ["0.12 px"], 1),
        ([["sd = nan"]], [["sd = 1.4e+06"]], [["sd = 1.5e+06"]], 0),
        ([["sd = nan"]], [["sd = 1.4e+06"]], [["sd = nan"]], 1),
        ([True], [False], [False], 1),
        ([3], [4], [3], 1),
        ([["a", "b"]], [["b", "a"]], [["a", "b"]], 1),
        ([{"code": "a", "value": 1.0}], [{"code": "a", "value": 1.0 + 1e-10}], [{"code": "a", "value": 1.0}], 0),
        ([{"code": "a", "value": 1.0}], [{"code": "a", "value": 1.1}], [{"code": "a", "value": 1.0}], 1),
        ([{"code": "a", "value": 1.0}], [{"code": "b", "value": 1.0}], [{"code": "b", "value": 1.0}], 1),
    ],
)
def test_what_counts_as_another_value(numpy, kernels, nudged, faults):
    assert len(faults_of(numpy, kernels, nudged).faults) == faults


def test_the_largest_of_several_nudges_counts():
    kind = pa.float64()
    for values, expected in (([1.0, 2.0], 1), ([1.0, 2.0 - 1e-8], 0)):
        out = compare_paths.Compared("some")
        given = [1.0, 2.0], [1.0, 2.0 + 1e-8], [1.0, 2.0], values
        compare_paths._compare_column("x of m", [compare_paths.split(each, kind) for each in given], out)
        assert len(out.faults) == expected


def test_values_are_counted():
    found = faults_of([1.0, 2.0, 4.0], [1.0, 2.0, 4.0 + 1e-10], [1.0, 2.0, 4.0])
    assert (found.num_values, found.num_equal, found.num_beyond) == (3, 2, 0)
    assert found.worst == (pytest.approx(2.5e-11, rel=1e-4), "x of m")


def test_a_nudged_model_is_the_same_to_rounding(tmp_path):
    model = open_model(str(write_binary(tmp_path, noisy_model())))
    quat = np.random.default_rng(0).normal(size=model.images.quat_cam_from_world_wxyz.shape)
    quat /= np.linalg.norm(quat, axis=1, keepdims=True)
    model = dataclasses.replace(model, images=dataclasses.replace(model.images, quat_cam_from_world_wxyz=quat))
    other = compare_paths.nudged(model)
    one, two = (
        np.einsum(
            "iab,pb->ipa",
            rotation_from_quat(m.images.quat_cam_from_world_wxyz),
            m.points.xyz_world[m.observations.point_idx],
        )
        for m in (model, other)
    )
    assert_allclose(one, two, rtol=0.0, atol=1e-14)
    assert not np.array_equal(one, two)
    assert not np.array_equal(model.observations.xy_px, other.observations.xy_px)
