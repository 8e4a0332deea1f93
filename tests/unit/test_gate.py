import math
import tomllib
from itertools import permutations

import numpy as np
import pytest
from gate_samples import NASTY, but, failed, failures, rejected, run, scene, without
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sfm_audit.reports.compare.comparison import compare
from sfm_audit.reports.compare.gate import judge
from sfm_audit.reports.compare.gate_policy import Band, GatePolicy
from sfm_audit.reports.compare.keys import Scope
from sfm_audit.reports.compare.learning import gate_toml, learn_bands

EMPTY = GatePolicy()


@pytest.fixture(autouse=True)
def _folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("os.fsync", lambda _: None)


def policy(text: str) -> GatePolicy:
    return GatePolicy.model_validate(tomllib.loads(text))


SOUND = {"a": scene(40), "b": scene(40)}


def changed(**changes):
    return {**SOUND, **changes}


@pytest.mark.parametrize(
    ("after", "models", "wanted"),
    [
        ({"a": scene(40)}, None, {"lost_scenes", "lost_models", "lost_images"}),
        (changed(a=without(scene(40), 3, 17)), None, {"lost_images"}),  # 5 %
        (changed(a=scene(40, sigma_constant_px=np.full(40, 0.39))), None, {"median_sigma"}),  # 30 %
        (changed(b=but(scene(40), 7, camera_model="OPENCV")), None, {"camera_model_changed"}),
        (changed(a=but(scene(40), 7, verdict_misfit="rejected", misfit_px=0.6)), None, {"systematic_px"}),
        (changed(a=but(scene(40), 7, verdict_pose="rejected", pose_offset_px=0.6)), None, {"systematic_px"}),
        (
            changed(a=rejected(scene(40), 1, 2, 3)),
            None,
            {"newly_rejected", "share_rejected", "share_rejected_by_reason"},
        ),
        (changed(a=but(scene(40), 1, 2, 3, 4, 5, verdict="undetermined")), None, {"share_accepted"}),
        (SOUND, {"recomputed_point_error_px": [0.7]}, {"recomputed_error"}),
        (SOUND, {"noise_s0_px": [0.4]}, {"noise_s0"}),
        (SOUND, {"noise_s0_px": [np.nan]}, {"noise_s0"}),
    ],
    ids=(
        *("scene lost", "5 % lost", "sigma + 30 %", "camera model", "misfit 0.6 px", "pose 0.6 px", "rejected"),
        "undetermined",
        *("recomputed error", "noise s0", "not measured any more"),
    ),
)
def test_every_fault_is_caught_by_an_empty_gate(after, models, wanted):
    before = run(SOUND)
    found = failed(before, run(after, models=models))
    assert wanted <= found
    assert found <= wanted | {"share_accepted", "share_rejected"}


@pytest.mark.parametrize(
    "after",
    [
        SOUND,
        changed(c=scene(3)),
        changed(a=scene(45)),
        changed(a=scene(40, sigma_constant_px=np.full(40, 0.34))),
        changed(a=rejected(scene(40), 1, 2)),
        changed(a=but(scene(40), 7, verdict_misfit="rejected", misfit_px=0.24)),
        changed(a=but(scene(40), 7, verdict_misfit="accepted", misfit_px=0.9)),
    ],
    ids=("same", "new scene", "new images", "sigma + 13 %", "5 % rejected", "misfit 0.24 px", "not significant"),
)
def test_what_is_within_the_bands_or_better_passes(after):
    assert failed(run(SOUND), run(after)) == set()


def test_limits_of_a_scene_that_is_lost_are_not_met():
    text = '[[scene]]\nmatch = "b"\nlimits = {min_images = 1, min_share_accepted = 0.1, max_median_sigma_px = 5}'
    assert failures(run(SOUND), run({"a": scene(40)}), policy(text)) >= {
        "data/b limits.min_images",
        "data/b limits.min_share_accepted",
        "data/b limits.max_median_sigma_px",
    }


def test_of_several_sections_each_reason_has_the_limit_that_was_said_last():
    text = """
    [[scene]]
    match = "*"
    limits.max_share_rejected_by_reason = {ks_rejected = 0, misfit_radial = 0}
    [[scene]]
    match = "b"
    limits.max_share_rejected_by_reason = {ks_rejected = 0.05}
    """
    radial = rejected(scene(40), 2, reason="misfit_radial: 1 px")
    one = run({"a": rejected(scene(40), 1), "b": rejected(radial, 1)})
    assert failures(None, one, policy(text)) == {
        "data/a limits.max_share_rejected_by_reason.ks_rejected",
        "data/b limits.max_share_rejected_by_reason.misfit_radial",
    }


def test_of_a_defect_that_was_there_before_only_the_growth_counts():
    old = but(scene(40), 7, verdict_misfit="rejected", misfit_px=1.0)
    new = but(scene(40), 7, verdict_misfit="rejected", misfit_px=1.2)
    assert failed(run({"a": old}), run({"a": new})) == set()
    assert failed(run({"a": new}), run({"a": but(new, 7, misfit_px=1.8)})) == {"systematic_px"}


@pytest.mark.parametrize(
    ("scenes", "told"), [({"b": scene(3)}, True), ({"a": scene(3)}, False), ({"a": scene(0)}, False)]
)
def test_two_runs_have_nothing_in_common_where_both_hold_images(scenes, told):
    one, other = run({"a": scene(3)}), run(scenes)
    assert compare(one, other).nothing_in_common == told
    assert compare(other, one).nothing_in_common == told


_scene = st.integers(0, 6).flatmap(
    lambda n: st.fixed_dictionaries(
        {
            "verdict": st.lists(st.sampled_from(["accepted", "rejected", "undetermined"]), min_size=n, max_size=n),
            "sigma_constant_px": st.lists(st.floats(0, 9) | st.just(math.nan), min_size=n, max_size=n),
            "misfit_px": st.lists(st.floats(0, 9), min_size=n, max_size=n),
            "verdict_misfit": st.lists(st.sampled_from(["accepted", "rejected"]), min_size=n, max_size=n),
        }
    ).map(lambda columns: scene(n, **columns))
)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=30, deadline=None)
@given(st.dictionaries(st.sampled_from(["a", "b", "d/e/0", "d/e/1"]), _scene))
def test_a_run_never_fails_against_itself(scenes):
    one = run(scenes)
    assert failures(one, one) == set()
    nothing_allowed = GatePolicy(band=Band(**dict.fromkeys(Band.model_fields, 0)))
    assert failures(one, one, nothing_allowed) == set()


def test_without_limits_and_baseline_nothing_is_checked():
    assert judge(EMPTY, run(SOUND), None) == []


@pytest.mark.parametrize(
    ("limits", "passes"),
    [
        ("min_share_accepted = 0.9", True),
        ("min_share_accepted = 0.91", False),
        ("max_share_rejected = 0.05", True),
        ("max_share_rejected = 0.04", False),
        ("max_share_undetermined = 0.05", True),
        ("max_share_undetermined = 0.049", False),
        ("max_share_rejected_by_reason = {ks_rejected = 0.05}", True),
        ("max_share_rejected_by_reason = {ks_rejected = 0.04}", False),
        ("max_share_rejected_by_reason = {misfit_radial = 0}", True),
        ("max_share_by_reason = {ks_rejected = 0.10}", True),
        ("max_share_by_reason = {ks_rejected = 0.09}", False),
        ("max_share_by_reason = {priors_disagree = 0}", True),
        ("max_median_sigma_px = 0.3", True),
        ("max_median_sigma_px = 0.29", False),
        ("max_noise_s0_px = 0.3", True),
        ("max_noise_s0_px = 0.2", False),
        ("max_recomputed_error_px = 0.5", True),
        ("max_recomputed_error_px = 0.4", False),
        ("min_images = 20", True),
        ("min_images = 21", False),
    ],
)
def test_limits_are_inclusive(limits, passes):
    # of 20 images one is rejected, one undetermined; its reasons count only where they reject
    columns = but(rejected(scene(20), 0), 1, verdict="undetermined", reasons=["ks_rejected: p"])
    one = run({"a": columns})
    key = limits.split(" =")[0]
    for text in (f"[limits]\n{limits}", f'[[scene]]\nmatch = "a"\n[scene.limits]\n{limits}'):
        found = failures(None, one, policy(text))
        assert bool(found) != passes
        assert all(key in name for name in found)


def test_lost_images_are_limited_by_count():
    before, after = run({"a": scene(100)}), run({"a": without(scene(100), 4)})
    assert failed(before, after, policy("limits.max_lost_images = 1")) == set()
    assert "limits.max_lost_images" in failed(before, after, policy("limits.max_lost_images = 0"))


def test_a_limit_on_what_was_not_measured_fails():
    one = run({"a": scene(3, sigma_constant_px=np.full(3, np.nan))})
    checks = judge(policy("limits.max_median_sigma_px = 5"), one, None)
    assert [(check.passed, check.value) for check in checks] == [(False, None)]
    assert "not measured" in checks[0].message


def test_sections_match_scenes_by_name_with_or_without_dataset_and_the_last_one_decides():
    one = run({"x/a/0": rejected(scene(4), 0), "y/a/0": rejected(scene(4), 0), "y/b/0": scene(4)})
    text = """
    [[scene]]
    match = "*"
    limits.max_share_rejected = 0.1
    limits.min_images = 4
    [[scene]]
    match = "y/*"
    limits.max_share_rejected = 0.5
    [[scene]]
    match = "a"
    limits.min_images = 5
    [[dataset]]
    match = "y"
    limits.max_share_rejected = 0.1
    """
    assert failures(None, one, policy(text)) == {
        "x/a limits.max_share_rejected",
        "x/a limits.min_images",
        "y/a limits.min_images",
        "y limits.max_share_rejected",
    }


def test_a_section_about_nothing_fails():
    gate = policy('[[scene]]\nmatch = "0022"\nlimits.min_images = 1')
    [check] = [check for check in judge(gate, run(SOUND), None) if not check.passed]
    assert "'0022'" in check.message


def test_bands_can_be_narrower_wider_and_off():
    before, after = run(SOUND), run(changed(a=without(scene(40), 3)))
    assert failed(before, after, policy("band.lost_images = 0.03")) == set()
    assert "lost_images" in failed(before, after, policy("band.lost_images = 0"))
    off = "\n".join(f"{key} = inf" for key in Band.model_fields)
    assert judge(policy(f"[band]\n{off}"), after, compare(before, after)) == []
    wide = '[[scene]]\nmatch = "a"\nband.lost_images = 0.5'
    assert failures(before, after, policy(wide)) == set()


def test_one_scene_is_judged_once_and_many_also_together():
    one, several = run({"a": scene(3)}), run({"d/a/0": scene(3), "d/b/0": scene(3), "e/c/0": scene(3)})
    scopes = {check.scope for check in judge(EMPTY, one, compare(one, one))}
    assert scopes == {Scope("data", "a")}
    scopes = {check.scope for check in judge(EMPTY, several, compare(several, several))}
    assert scopes == {Scope(), Scope("d"), Scope("d", "a"), Scope("d", "b"), Scope("e", "c")}


def test_nothing_is_said_of_a_scene_that_the_baseline_has_not():
    after = run(changed(c=rejected(scene(3), 0, 1, 2)))
    checks = judge(EMPTY, after, compare(run(SOUND), after))
    assert {check.scope.scene for check in checks} == {None, "a", "b"}


def test_learnt_bands_pass_what_they_were_learnt_from_and_catch_the_rest():
    rng = np.random.default_rng(3)

    def again(num_lost=0):
        columns = scene(40, sigma_constant_px=0.3 * (1 + 0.01 * rng.standard_normal(40)))
        columns = rejected(columns, *rng.choice(40, 2, replace=False).tolist())
        return run(changed(a=without(columns, *range(num_lost))))

    runs = [again(), again(), again()]
    gate = policy(gate_toml(learn_bands(runs), ["R1", "R2", "R3"]))
    for before, after in permutations(runs, 2):
        assert failures(before, after, gate) == set()
    assert failures(runs[0], again(), gate) == set()
    assert "lost_images" in failed(runs[0], again(num_lost=2), gate)
    faulty = changed(a=scene(40, sigma_constant_px=np.full(40, 0.39)))
    assert "median_sigma" in failed(runs[0], run(faulty), gate)


def test_a_scene_that_varies_more_gets_its_own_band():
    steady = scene(200)
    runs = [run({"steady": steady, "a*[wild]": scene(20, sigma_constant_px=np.full(20, s))}) for s in (0.3, 0.33, 0.36)]
    learnt = learn_bands(runs)
    assert set(learnt.scenes) == {Scope("data", "a*[wild]")}
    assert learnt.scenes[Scope("data", "a*[wild]")]["median_sigma"] == pytest.approx(3 * 0.2)
    assert learnt.common["median_sigma"] == Band().median_sigma / 2
    gate = policy(gate_toml(learnt, ["R"] * 3))
    assert gate.band_of(Scope("data", "a*[wild]")).median_sigma == pytest.approx(0.6)
    assert gate.band_of(Scope("data", "steady")).median_sigma == 0.075
    assert gate.band_of(Scope("data", "another")).median_sigma == 0.075


@pytest.mark.parametrize(("num_runs", "margin"), [(2, 4), (3, 3), (4, 3), (5, 2), (6, 2)])
def test_fewer_runs_leave_more_room(num_runs, margin):
    runs = [run({"a": scene(40, sigma_constant_px=np.full(40, 0.3 + 0.06 * (k == 0)))}) for k in range(num_runs)]
    assert learn_bands(runs).common["median_sigma"] == pytest.approx(0.2 * margin)


def test_one_image_with_another_verdict_is_within_a_learnt_band_and_one_lost_is_not():
    runs = [run({"a": scene(10)}) for _ in range(3)]
    gate = policy(gate_toml(learn_bands(runs), ["R"] * 3))
    assert failures(runs[0], run({"a": rejected(scene(10), 4)}), gate) == set()
    assert "newly_rejected" in failed(runs[0], run({"a": rejected(scene(10), 4, 5)}), gate)
    assert failed(runs[0], run({"a": without(scene(10), 4)}), gate) == {"lost_images"}


def test_one_run_teaches_nothing():
    with pytest.raises(ValueError, match="two runs"):
        learn_bands([run(SOUND)])


@pytest.mark.parametrize("name", [*(name for name in NASTY if "/" not in name), "\x7f", "a\\b"])
def test_any_scene_name_survives_in_the_gate_file(name):
    runs = [
        run({f"d/{name}/0": scene(3, sigma_constant_px=np.full(3, sigma)), "d/steady/0": scene(300)})
        for sigma in (0.1, 0.2)
    ]
    gate = policy(gate_toml(learn_bands(runs), ["a\nb", "c"]))
    assert gate.band_of(Scope("d", name)).median_sigma == pytest.approx(4.0)
    assert gate.band_of(Scope("d", "steady")).median_sigma == pytest.approx(0.075)
