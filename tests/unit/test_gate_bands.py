"""How far may a run be from its baseline where a gate file says nothing? Both sides of every default band."""

from dataclasses import replace

import pytest
from gate_samples import but, failed, run, scene

from sfm_audit.reports.compare.comparison import compare
from sfm_audit.reports.compare.gate import judge
from sfm_audit.reports.compare.gate_policy import BAND_KEYS, Band, GatePolicy
from sfm_audit.reports.compare.keys import ImageKey
from sfm_audit.reports.compare.motion import PoseChange, PoseFragment

EMPTY = GatePolicy()
SOUND = {"a": scene(40), "b": scene(40)}


@pytest.fixture(autouse=True)
def _folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("os.fsync", lambda _: None)


def counts(before, *, accepted=1000, rejected=0, **others):
    numbers = {"num_images": 1000, "num_accepted": accepted, "num_rejected": rejected}
    return replace(before, **numbers, num_undetermined=1000 - accepted - rejected, **others)


KEYS = tuple(ImageKey("data", "a", f"{i:04d}.jpg") for i in range(1000))
NOTED = tuple((key, "") for key in KEYS)
STILL = PoseChange(KEYS, 0.0, 0.0, (), (), 0.0)


@pytest.mark.parametrize(
    ("key", "within", "beyond", "changes"),
    [
        ("lost_scenes", 0, 1, lambda n, _: {"lost_scenes": ("data/b",) * n}),
        ("lost_models", 0, 1, lambda n, _: {"lost_models": ("data/a/0",) * n}),
        ("lost_images", 20, 21, lambda n, _: {"lost": NOTED[:n]}),
        ("camera_model_changed", 0, 1, lambda n, _: {"remodelled": NOTED[:n]}),
        ("newly_rejected", 50, 51, lambda n, _: {"newly_rejected": NOTED[:n]}),
        ("share_accepted", 900, 899, lambda n, old: {"after": counts(old, accepted=n)}),
        ("share_rejected", 50, 51, lambda n, old: {"after": counts(old, accepted=1000 - n, rejected=n)}),
        ("share_rejected_by_reason", 50, 51, lambda n, old: {"after": counts(old, rejected_by_reason={"x": n})}),
        ("median_sigma", 1.149, 1.151, lambda a, old: {"after": counts(old, sigma_px=a * old.sigma_px)}),
        ("noise_s0", 1.149, 1.151, lambda a, old: {"after": counts(old, noise_s0_px=a * old.noise_s0_px)}),
        (
            *("recomputed_error", 1.149, 1.151),
            lambda a, old: {"after": counts(old, recomputed_error_px=a * old.recomputed_error_px)},
        ),
        ("systematic_px", 0.25, 0.251, lambda a, _: {"grown_px": ((KEYS[0], a),)}),
        ("fragments", 0, 1, lambda n, _: {"poses": (replace(STILL, fragments=(PoseFragment(KEYS, 5, 0.1),) * n),)}),
        ("moved_images", 50, 51, lambda n, _: {"poses": (replace(STILL, moved=NOTED[:n]),)}),
        ("pose_centre", 0.02, 0.0201, lambda a, _: {"poses": (replace(STILL, centre_error=a),)}),
        ("pose_rotation_deg", 0.5, 0.501, lambda a, _: {"poses": (replace(STILL, rotation_deg=a),)}),
        ("bending", 0.1, 0.101, lambda a, _: {"poses": (replace(STILL, bending=a),)}),
    ],
)
def test_without_a_band_of_its_own_a_scene_may_change_as_far_as_the_documentation_says(key, within, beyond, changes):
    one = run({"a": scene(40)})
    same = compare(one, one)
    [of_scene] = [change for change in same.changes if change.scope.kind == "scene"]
    before = counts(of_scene.before)
    found = {}
    for amount in (within, beyond):
        after = replace(of_scene, num_common=1000, **{"before": before, "after": before, **changes(amount, before)})
        checks = judge(EMPTY, one, replace(same, changes=(after,)))
        found[amount] = {check.name for check in checks if not check.passed}
    assert found == {within: set(), beyond: {f"band.{key}"}}


def test_every_band_has_a_case_on_both_sides():
    [mark] = test_without_a_band_of_its_own_a_scene_may_change_as_far_as_the_documentation_says.pytestmark
    assert [case[0] for case in mark.args[1]] == list(BAND_KEYS)


def test_a_band_holds_the_share_that_it_names_whatever_the_rounding():
    undetermined = [but(scene(10), *range(n), verdict="undetermined") for n in (6, 7)]
    before, after = (run({"a": columns}) for columns in undetermined)
    assert Band().share_accepted < 4 / 10 - 3 / 10
    assert failed(before, after) == set()


def test_noise_that_was_zero_may_not_grow():
    nothing, some = (run(SOUND, models={"noise_s0_px": [s0]}) for s0 in (0.0, 1e-6))
    assert failed(nothing, nothing) == set()
    assert failed(nothing, some) == {"noise_s0"}
    assert failed(some, nothing) == set()


def test_of_an_error_that_was_seen_and_not_found_only_the_growth_counts():
    seen = but(scene(40), 7, misfit_px=1.0)  # and accepted
    found = but(scene(40), 7, verdict_misfit="rejected", misfit_px=1.2)
    assert failed(run({"a": seen}), run({"a": found})) == set()
    assert failed(run({"a": scene(40)}), run({"a": found})) == {"systematic_px"}


def test_an_offset_of_the_pose_that_is_accepted_is_no_error():
    assert failed(run({"a": scene(40)}), run({"a": but(scene(40), 7, pose_offset_px=0.6)})) == set()


def test_an_error_of_a_camera_counts_where_it_is_material():
    def shared(misfit_px, *, material):
        return run(SOUND, cameras={"camera_id": [7], "misfit_px": [misfit_px], "misfit_material": [material]})

    before, large, small = shared(0.0, material=False), shared(0.6, material=True), shared(0.2, material=True)
    assert failed(before, large) == {"systematic_px"}
    assert failed(before, small) == set()
    assert failed(before, shared(0.6, material=False)) == set()
    assert failed(shared(0.5, material=False), large) == set()
