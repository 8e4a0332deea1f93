from pathlib import Path

import numpy as np
import pytest
from gate_samples import scene, write_run
from scipy.spatial.transform import Rotation

from sfm_audit.audit.alignment import Poses, align, compare_poses, natural_order, usable_poses
from sfm_audit.audit.cli.poses import aligned
from sfm_audit.reports.compare.comparison import RunSnapshot, compare
from sfm_audit.reports.compare.gate import judge
from sfm_audit.reports.compare.gate_policy import Band, GatePolicy
from sfm_audit.reports.compare.learning import learn_bands

UPRIGHT = np.eye(3)
HALF_TURN = np.diag([-1.0, -1.0, 1.0])
BOW = np.c_[1.8 * np.sin(np.linspace(0, 6.28, 40)), np.zeros((40, 2))]
TURN = Rotation.from_euler("zyx", [40, -70, 15], degrees=True).as_matrix()


def ring(n: int = 40) -> Poses:
    """Cameras on a circle of radius 10 that look inwards."""
    angle = 2 * np.pi * np.arange(n) / n
    centre = np.c_[10 * np.cos(angle), 10 * np.sin(angle), 0.3 * np.sin(5 * angle)]
    rotation = Rotation.from_euler("zy", np.c_[-angle, np.full(n, -1.2)]).as_matrix()
    return Poses(rotation, centre)


def moved(poses: Poses, scale=1.0, rotation=UPRIGHT, shift=(0, 0, 0)) -> Poses:
    return Poses(poses.rotation @ rotation.T, scale * poses.centre @ rotation.T + shift)


def noisy(poses: Poses, sd: float, sd_deg: float, seed: int = 0) -> Poses:
    rng = np.random.default_rng(seed)
    turns = Rotation.from_rotvec(np.radians(rng.normal(0, sd_deg, (len(poses), 3)))).as_matrix()
    return Poses(turns @ poses.rotation, poses.centre + rng.normal(0, sd, (len(poses), 3)))


def joined(one: Poses, other: Poses, from_other) -> Poses:
    pick = np.asarray(from_other)
    return Poses(
        np.where(pick[:, None, None], other.rotation, one.rotation), np.where(pick[:, None], other.centre, one.centre)
    )


def test_a_similarity_is_found_exactly():
    poses = ring()
    found = align(poses, moved(poses, 3.5, TURN, (5, -2, 8)), 10.0)
    assert found.similarity.scale == pytest.approx(3.5, rel=1e-12)
    np.testing.assert_allclose(found.similarity.rotation, TURN, atol=1e-12)
    np.testing.assert_allclose(found.similarity.shift, [5, -2, 8], atol=1e-10)
    assert np.abs(found.centre).max() < 1e-12
    assert found.rotation_deg.max() < 1e-6


def test_noise_is_averaged_and_reported():
    poses = ring(60)
    after = moved(noisy(poses, 0.02, 0.05), 0.5, TURN)
    found = compare_poses(poses, after, 10.0)
    assert found.main.all()
    assert np.sqrt(np.mean(found.centre_error**2)) == pytest.approx(0.02 * np.sqrt(3) / 10, rel=0.15)
    assert np.median(found.rotation_deg) == pytest.approx(0.05 * 1.538, rel=0.25)  # median of a chi of 3
    assert found.bending < 0.002


@pytest.mark.parametrize("share", [0.25, 0.45])
def test_a_fold_is_a_fragment_with_its_turn(share):
    poses = ring()
    turned = np.arange(40) < share * 40
    after = moved(joined(noisy(poses, 0.01, 0.02), moved(poses, 1.0, HALF_TURN), turned), 2.0, TURN)
    [fragment] = compare_poses(poses, after, 10.0).fragments
    np.testing.assert_array_equal(fragment.image_idxs, np.flatnonzero(turned))
    assert fragment.turn_deg == pytest.approx(180, abs=0.1)
    assert fragment.shift == pytest.approx(2.0, rel=0.05)
    assert fragment.stretch == pytest.approx(1.0, rel=0.01)


def test_two_folds_and_a_single_image_are_told_apart():
    poses, idx = ring(), np.arange(40)
    after = joined(poses, moved(poses, 1.0, HALF_TURN), idx < 8)
    after = joined(after, moved(poses, 1.0, np.eye(3), (4, 0, 0)), (idx >= 20) & (idx < 25))
    after.centre[33] += 3
    found = compare_poses(poses, after, 10.0)
    assert [len(one.image_idxs) for one in found.fragments] == [8, 5]
    assert found.fragments[1].turn_deg < 0.1
    assert np.flatnonzero(found.moved).tolist() == [*range(8), *range(20, 25), 33]


def test_a_bent_sequence_is_bent_and_not_torn():
    n = 200
    along = np.linspace(0, 100, n)
    rotation = Rotation.from_rotvec(np.c_[np.zeros(n), np.linspace(0, 0.3, n), np.zeros(n)]).as_matrix()
    poses = Poses(rotation, np.c_[along, np.sin(along / 9), np.zeros(n)])
    bent = Poses(poses.rotation, poses.centre + np.c_[np.zeros((n, 2)), 4e-4 * along**2])  # 4 m at the far end
    found = compare_poses(poses, bent, 10.0)
    assert found.fragments == ()
    assert found.main.all()
    assert 0.02 < found.bending < 0.4
    torn = Poses(poses.rotation, poses.centre + np.c_[np.zeros((n, 2)), np.where(along > 70, 4.0, 0.0)])
    found = compare_poses(poses, torn, 10.0)
    assert [len(one.image_idxs) for one in found.fragments] == [int((along > 70).sum())]


def test_scattered_images_are_no_fragment():
    rng = np.random.default_rng(5)
    poses, after = ring(), noisy(ring(), 0.01, 0.01)
    off = rng.choice(40, 9, replace=False)
    after.centre[off] += rng.normal(0, 0.5, (9, 3))  # about one tolerance
    found = compare_poses(poses, after, 10.0)
    assert found.fragments == ()
    assert 4 <= found.moved.sum() <= 9


def test_cameras_on_a_line_have_a_rotation_too():
    n = 20
    rotation = Rotation.from_rotvec(np.c_[np.linspace(0, 1.5, n), np.zeros((n, 2))]).as_matrix()
    poses = Poses(rotation, np.c_[np.arange(n), np.zeros((n, 2))].astype(float))
    found = align(poses, moved(poses, 1.0, TURN), 5.0)
    np.testing.assert_allclose(found.similarity.rotation, TURN, atol=1e-9)


def test_what_cannot_be_aligned_is_not():
    poses = ring(2)
    assert compare_poses(poses, poses, 1.0) is None
    same_place = Poses(ring(9).rotation, np.ones((9, 3)))
    assert compare_poses(same_place, same_place, 1.0) is None
    assert compare_poses(ring(), ring(), 0.0) is None
    rng = np.random.default_rng(3)
    nowhere = Poses(Rotation.random(30, random_state=1).as_matrix(), rng.normal(0, 100, (30, 3)))
    assert compare_poses(ring(30), nowhere, 0.1) is None


def test_the_answer_does_not_depend_on_the_run():
    before, after = noisy(ring(), 0.1, 0.1), noisy(ring(), 0.1, 0.1, seed=1)
    first, again = (compare_poses(before, after, 10.0) for _ in range(2))
    np.testing.assert_array_equal(first.centre_error, again.centre_error)


def test_poses_that_nobody_can_use_are_found():
    quat = np.array(
        [[1, 0, 0, 0], [0, 0, 0, 0], [np.nan, 0, 0, 1], [2, 0, 0, 0], [1e200, 0, 0, 0], [1, 0, 0, 0]], float
    )
    shift = np.zeros((6, 3))
    shift[5] = np.inf
    assert usable_poses(quat, shift).tolist() == [True, False, False, True, False, False]
    np.testing.assert_allclose(Poses.of(quat[[3]], np.array([[1.0, 2, 3]])).centre, [[-1, -2, -3]])


def test_names_are_sorted_as_photos_are_taken():
    names = ["IMG_10.jpg", "IMG_9.jpg", "b", "IMG_009.jpg", ""]
    assert [names[i] for i in natural_order(names)] == ["", "IMG_009.jpg", "IMG_9.jpg", "IMG_10.jpg", "b"]


@pytest.fixture
def _folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("os.fsync", lambda _: None)


def columns(poses: Poses, depth: float = 10.0):
    """Columns of the images table with these poses."""
    quat = Rotation.from_matrix(poses.rotation).as_quat()[:, [3, 0, 1, 2]]
    shift = -np.einsum("nij,nj->ni", poses.rotation, poses.centre)
    numbers = np.c_[quat, shift, np.full(len(poses), depth)].T
    return dict(zip(("qw", "qx", "qy", "qz", "tx", "ty", "tz", "median_depth"), numbers, strict=True))


def snapshot(name: str, poses: Poses, **changes) -> RunSnapshot:
    return RunSnapshot.read(write_run(Path(name), {"a": scene(len(poses), **{**columns(poses), **changes})}))


def failed(before, after) -> dict[str, str]:
    checks = judge(GatePolicy(), after, compare(before, after, aligned))
    return {check.name.removeprefix("band."): check for check in checks if not check.passed}


@pytest.mark.usefixtures("_folder")
def test_a_gate_fails_on_a_fold_and_names_it():
    poses = ring()
    before = snapshot("R0", poses)
    assert failed(before, snapshot("R1", moved(noisy(poses, 0.01, 0.02), 7.0, TURN))) == {}
    folded = joined(poses, moved(poses, 1.0, HALF_TURN), np.arange(40) < 12)
    checks = failed(before, snapshot("R2", folded))
    assert checks.keys() == {"fragments", "moved_images"}
    message = checks["fragments"].message
    assert message.startswith("fold: 12 images turned together by 180.0 deg and shifted by 2.0")
    assert "IMG_0000.jpg, IMG_0001.jpg, IMG_0002.jpg .. IMG_0011.jpg; 0 allowed" in message
    assert [key.image_name for key, _ in checks["fragments"].images] == [f"IMG_{i:04d}.jpg" for i in range(12)]
    assert checks["moved_images"].value == pytest.approx(0.3)


@pytest.mark.usefixtures("_folder")
@pytest.mark.parametrize(
    ("after", "wanted"),
    [
        (noisy(ring(), 0.2, 0.1), "pose_centre"),
        (noisy(ring(), 0.001, 0.6), "pose_rotation_deg"),
        (
            Poses(ring().rotation, ring().centre + np.c_[1.8 * np.sin(np.linspace(0, 6.28, 40)), np.zeros((40, 2))]),
            "bending",
        ),
    ],
)
def test_each_band_can_fail(after, wanted):
    assert wanted in failed(snapshot("R0", ring()), snapshot("R1", after))


@pytest.mark.usefixtures("_folder")
@pytest.mark.parametrize(("num_common", "num_compared"), [(2, []), (3, [3])])
def test_two_models_are_compared_from_three_images_in_common(num_common, num_compared):
    asked = []
    one = snapshot("R0", ring(num_common))
    compare(one, snapshot("R1", ring(5)), lambda keys, *_: asked.append(len(keys)))
    assert asked == num_compared


@pytest.mark.usefixtures("_folder")
def test_poses_that_are_missing_or_damaged_are_left_out():
    poses = ring()
    damaged = {name: values.copy() for name, values in columns(poses).items()}
    damaged["qw"][3] = damaged["qx"][3] = damaged["qy"][3] = damaged["qz"][3] = 0.0
    damaged["tx"][5] = 1e300
    damaged["ty"][6] = np.nan  # null in the table
    after = snapshot("R1", poses, **damaged)
    [change] = compare(snapshot("R0", poses), after, aligned).whole.poses
    assert len(change.images) == 37
    assert change.moved == ()
    none = snapshot("R2", poses, **{name: np.full(40, np.nan) for name in damaged})
    assert not none.has_poses
    assert after.has_poses
    assert compare(after, none, aligned).whole.poses == ()


@pytest.mark.usefixtures("_folder")
def test_without_depths_the_spread_of_the_cameras_is_the_unit():
    after = noisy(ring(), 0.05, 0.01)
    changes = [
        compare(snapshot(f"R{k}", ring(), median_depth=depth), snapshot(f"S{k}", after), aligned).whole.poses[0]
        for k, depth in enumerate((np.full(40, np.nan), np.full(40, 10.0)))
    ]
    assert changes[0].centre_error == pytest.approx(changes[1].centre_error, rel=0.01)  # a ring of radius 10


@pytest.mark.usefixtures("_folder")
def test_learnt_bands_hold_what_reconstructions_differ_by():
    runs = [snapshot(f"R{k}", noisy(ring(), 0.05, 0.4, seed=k)) for k in range(3)]
    learnt = learn_bands(runs, aligned)
    assert learnt.common["pose_rotation_deg"] > Band().pose_rotation_deg
    assert learnt.common["fragments"] == 0
    gate = GatePolicy(band=Band(**learnt.common))
    night = snapshot("N", noisy(ring(), 0.05, 0.4, seed=9))
    assert all(check.passed for check in judge(gate, night, compare(runs[0], night, aligned)))
