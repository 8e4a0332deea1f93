"""What determines no camera is refused, and says why."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from calibrate_samples import FOCAL, FORWARD, LENS, SIZE, board, room, with_outliers

from sfm_audit.audit.calibrate.degenerate import check_camera
from sfm_audit.audit.calibrate.estimate import Degeneracy, DegenerateInputError, estimate_of
from sfm_audit.audit.calibrate.estimators import ESTIMATORS
from sfm_audit.loaders.correspondences.records import Correspondences

NAMES = sorted(ESTIMATORS)
NUM_PARAMETERS = {"D1": 8, "D3": 10, "pnprf": 10, "colmap": 9}


def refusal(name, correspondences):
    with pytest.raises(DegenerateInputError) as error:
        ESTIMATORS[name](correspondences, np.random.default_rng(0))
    assert error.value.detail
    return error.value.degeneracy


def scene(name="D3", seed=0):
    return room(LENS[name], np.random.default_rng(seed))[0]


@pytest.mark.parametrize("name", NAMES)
def test_fewer_points_than_parameters(name):
    full, n = scene(name), NUM_PARAMETERS[name]

    def first(k):
        return Correspondences(SIZE, SIZE, full.xy_px[:k], full.xyz_world[:k])

    for k in (0, 1, 4, n - 1):
        assert refusal(name, first(k)) is Degeneracy.TOO_FEW_POINTS
    again = np.arange(24) % (n - 1)
    repeated = Correspondences(SIZE, SIZE, full.xy_px[again], full.xyz_world[again])
    assert refusal(name, repeated) is Degeneracy.TOO_FEW_POINTS


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("value", [np.nan, np.inf, 1e200])
@pytest.mark.parametrize("field", ["xy_px", "xyz_world"])
def test_coordinates_that_are_not_finite(name, value, field):
    changed = getattr(scene(), field).copy()
    changed[3, 1] = value
    assert refusal(name, dataclasses.replace(scene(), **{field: changed})) is Degeneracy.NOT_FINITE


@pytest.mark.parametrize("name", NAMES)
def test_one_spot(name):
    full, rng = scene(), np.random.default_rng(1)
    world = np.array([5e5, 4e6, 100.0]) + 1e-9 * rng.standard_normal(full.xyz_world.shape)
    assert refusal(name, dataclasses.replace(full, xyz_world=world)) in {Degeneracy.ONE_SPOT, Degeneracy.TOO_FEW_POINTS}
    for size_px in (0.0, 2.0):  # within the inlier threshold
        image = np.array([812.0, 640.0]) + size_px * rng.standard_normal((24, 2))
        assert refusal(name, dataclasses.replace(full, xy_px=image)) is Degeneracy.ONE_SPOT


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("noise_px", [0.0, 0.5])
def test_collinear(name, noise_px):
    rng = np.random.default_rng(2)
    xyz = np.linspace([-2.0, 1.0, 5.0], [3.0, -1.0, 8.0], 24)
    xy = LENS[name].project(xyz).xy_px.T + noise_px * rng.standard_normal((24, 2))
    assert refusal(name, Correspondences(SIZE, SIZE, xy, xyz)) is Degeneracy.COLLINEAR
    line = dataclasses.replace(scene(), xy_px=np.linspace([100.0, 200.0], [1300.0, 1500.0], 24))
    assert refusal(name, line) is Degeneracy.COLLINEAR


@pytest.mark.parametrize("name", NAMES)
def test_a_small_scene_far_from_the_origin_is_no_spot(name):
    """Half a metre in metres of a map grid: rounding is 1e-9 m there."""
    full = room(LENS[name], np.random.default_rng(6), noise_px=0.05)[0]
    small = dataclasses.replace(full, xyz_world=0.05 * full.xyz_world + np.array([5e5, 5.4e6, 300.0]))
    assert abs(ESTIMATORS[name](small, np.random.default_rng(6)).camera.focal_px[0] - FOCAL) < 2.0


@pytest.mark.parametrize("name", NAMES)
def test_a_plane_parallel_to_the_image_without_noise(name):
    """Focal length and distance cannot be told apart: any f is as good."""
    facing = board(LENS[name], np.random.default_rng(3), 0.0, half=0.6, noise_px=0.0)[0]
    assert refusal(name, facing) is Degeneracy.FRONTO_PARALLEL


def focal_length_of_a_board(name, tilt_deg, seed):
    """f and its sd; NaN where it is refused as parallel to the image."""
    rng = np.random.default_rng([seed, int(10 * tilt_deg)])
    try:
        estimate = ESTIMATORS[name](board(LENS[name], rng, tilt_deg)[0], rng)
    except DegenerateInputError as error:
        if error.degeneracy is not Degeneracy.FRONTO_PARALLEL:
            raise
        return np.nan, np.nan
    return estimate.camera.focal_px[0], estimate.covariance.sd_of("f")


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(
    ("tilt_deg", "num_boards", "num_sure"), [(0.0, 2, {0}), (0.1, 2, {0}), (1.0, 5, {0, 1}), (15.0, 5, {5})]
)
def test_a_plane_nearly_parallel_is_never_sure_and_wrong(name, tilt_deg, num_boards, num_sure):
    """Where sd_f / f <= 1 %, f is within 4 sd of the truth; 0.03 px of noise."""
    found = np.array([focal_length_of_a_board(name, tilt_deg, seed) for seed in range(num_boards)])
    sure = found[found[:, 1] <= 0.01 * found[:, 0]]
    assert len(sure) in num_sure
    assert (np.abs(sure[:, 0] - FOCAL) < 4.0 * sure[:, 1]).all()


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("num_points", [12, 24, 60])
def test_chance_is_no_consensus(name, num_points):
    rng = np.random.default_rng(num_points)
    chance = Correspondences(SIZE, SIZE, rng.uniform(0.0, SIZE, (num_points, 2)), rng.uniform(-1, 1, (num_points, 3)))
    assert refusal(name, chance) is Degeneracy.NO_CONSENSUS


@pytest.mark.parametrize("name", NAMES)
def test_a_minority_is_no_consensus(name):
    """45 of 100 would be enough for an estimate, but not for trusting it."""
    rng = np.random.default_rng(5)
    mixed, _ = with_outliers(room(LENS[name], rng, num_points=100)[0], 55, rng)
    assert refusal(name, mixed) is Degeneracy.NO_CONSENSUS


@pytest.mark.parametrize("name", ["D1", "D3", "pnprf"])
@pytest.mark.parametrize("signs", [(-1, 1), (-1, -1)])
def test_a_mirror_image_and_points_behind_the_camera(name, signs):
    """Half a turn about the axis and a negative depth are the same picture; a mirrored one has negative depths, too."""
    centre = np.full(2, SIZE / 2)
    mirrored = dataclasses.replace(scene(name), xy_px=centre + np.array(signs) * (scene(name).xy_px - centre))
    expected = Degeneracy.NOT_A_CAMERA if signs == (-1, 1) else None
    if expected is None:  # the true scene, turned by half a turn: a camera again
        assert ESTIMATORS[name](mirrored, np.random.default_rng(0)).inliers.all()
    else:
        assert refusal(name, mirrored) is expected


def test_a_camera_that_folds_or_looks_away_is_none():
    correspondences, rotation, translation = room(FORWARD, np.random.default_rng(4))
    inliers = np.ones(24, dtype=bool)

    def check(**changes):
        arguments = {"camera": FORWARD, "rotation": rotation, "translation": translation, "inliers": inliers} | changes
        estimate = estimate_of(
            "D3",
            arguments["camera"],
            arguments["rotation"],
            arguments["translation"],
            correspondences,
            inliers=arguments["inliers"],
        )
        return check_camera(estimate, correspondences.xyz_world)

    assert check().covariance.sd_of("f") < 5.0
    folded = dataclasses.replace(FORWARD, coefficients=np.array([-0.6, 0.0, 0.0]))
    negative = dataclasses.replace(FORWARD, focal_px=(-800.0, -800.0))
    away = {"rotation": np.diag([1.0, -1.0, -1.0]) @ rotation, "translation": np.diag([1.0, -1.0, -1.0]) @ translation}
    for changes in ({"camera": folded}, {"camera": negative}, away):
        with pytest.raises(DegenerateInputError) as error:
            check(**changes)
        assert error.value.degeneracy is Degeneracy.NOT_A_CAMERA
