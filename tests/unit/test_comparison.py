import statistics
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from gate_samples import NASTY, but, rejected, scene, without, write_run
from hypothesis import given
from hypothesis import strategies as st
from rich.cells import cell_len

from sfm_audit.reports.compare.comparison import ImageState, RunSnapshot, Systematic, compare
from sfm_audit.reports.compare.keys import ImageKey, Scope
from sfm_audit.reports.compare.page import MAX_NAMES, render_comparison
from sfm_audit.reports.text.drawing import Page

MODEL = ("d", "s", "0", "d/s/0")


@pytest.fixture(autouse=True)
def _folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("os.fsync", lambda _: None)


def snapshot(name: str, scenes, **options) -> RunSnapshot:
    return RunSnapshot.read(write_run(Path(name), scenes, **options))


def names(noted) -> list[str]:
    return [key.image_name for key, _ in noted]


_numbers = st.none() | st.floats(0, 10)


@st.composite
def snapshots(draw) -> RunSnapshot:
    chosen = draw(st.sets(st.tuples(st.sampled_from("dD"), st.sampled_from("st"), st.sampled_from("abcdef"))))
    images = {}
    for key in map(ImageKey._make, chosen):
        px = draw(st.floats(0, 5))
        images[key] = ImageState(
            key,
            (key.dataset, key.scene, "0", "somewhere"),
            draw(st.integers(0, 9)),
            draw(st.sampled_from(["accepted", "rejected", "undetermined"])),
            tuple(draw(st.lists(st.sampled_from(["ks_rejected: 1", "misfit_radial: 2"]), max_size=2))),
            draw(st.sampled_from([None, "PINHOLE", "OPENCV"])),
            draw(_numbers),
            draw(_numbers),
            draw(_numbers),
            Systematic((px * draw(st.booleans()), 0.0, 0.0), (px, 0.0, 0.0)),
        )
    models = {(*scene_key, "0", "somewhere"): frozenset() for scene_key in {key[:2] for key in images}}
    members = {model: frozenset(k for k in images if k[:2] == model[:2]) for model in models}
    return RunSnapshot(images, members)


@given(snapshots())
def test_a_run_does_not_differ_from_itself(run):
    assert not any(change.anything for change in compare(run, run).changes)


@given(snapshots(), snapshots())
def test_what_is_lost_one_way_is_added_the_other_way(one, two):
    there, back = compare(one, two), compare(two, one)
    for a, b in zip(there.changes, back.changes, strict=True):
        assert names(a.lost) == names(b.added)
        assert names(a.newly_rejected) == names(b.fixed)
        assert names(a.remodelled) == names(b.remodelled)
        assert (a.before, a.num_common) == (b.after, b.num_common)


@given(snapshots(), snapshots())
def test_scenes_add_up_to_the_whole(one, two):
    comparison = compare(one, two)
    scenes = [change for change in comparison.changes if change.scope.kind == "scene"]
    for field in ("lost", "added", "newly_rejected", "fixed", "remodelled"):
        together = [item for change in scenes for item in getattr(change, field)]
        assert sorted(together) == sorted(getattr(comparison.whole, field))


def test_images_are_found_again_by_name_in_other_components_and_order():
    first, second = scene(10), scene(5, image_name=[f"B_{i}" for i in range(5)])
    one = snapshot("R0", {"data/a/0": first, "data/a/1": second})
    shuffled = {name: list(values)[::-1] for name, values in first.items()}
    two = snapshot("R1", {"data/a/0": {**second, "image_id": [77, 5, 6, 7, 8]}, "data/a/1": shuffled})
    assert not any(change.anything for change in compare(one, two).changes)


def test_the_order_of_parts_does_not_matter():
    scenes = {f"{i}": rejected(scene(6), i) for i in range(4)}
    run = write_run(Path("R"), scenes)
    backwards = replace(run, contents=replace(run.contents, lines=run.contents.lines[::-1]))
    assert dict(RunSnapshot.read(backwards).images) == dict(RunSnapshot.read(run).images)
    assert not any(change.anything for change in compare(RunSnapshot.read(run), RunSnapshot.read(backwards)).changes)


def test_every_kind_of_change_is_listed():
    before = rejected(scene(10), 0, 1)
    after = rejected(but(scene(11), 5, camera_model="OPENCV"), 1, 2, reason="misfit_radial: 0.6 px")
    after = without(but(after, 2, verdict_misfit="rejected", misfit_px=0.6), 9)
    change = compare(snapshot("R0", {"a": before}), snapshot("R1", {"a": after})).whole
    assert names(change.newly_rejected) == ["IMG_0002.jpg"]
    assert names(change.fixed) == ["IMG_0000.jpg"]
    assert names(change.lost) == ["IMG_0009.jpg"]
    assert names(change.added) == ["IMG_0010.jpg"]
    assert names(change.remodelled) == ["IMG_0005.jpg"]
    assert dict(change.newly_rejected)[ImageKey("data", "a", "IMG_0002.jpg")] == "misfit_radial: 0.6 px"
    assert dict(change.remodelled)[ImageKey("data", "a", "IMG_0005.jpg")] == "SIMPLE_RADIAL -> OPENCV"
    assert change.grown_px == ((ImageKey("data", "a", "IMG_0002.jpg"), 0.6),)


def test_numbers_are_medians_over_images_each_counted_once():
    rng = np.random.default_rng(0)
    sigma, extra = rng.uniform(0, 1, 9), rng.uniform(0, 1, 9)
    # the second component has the same images with fewer inliers: it says nothing
    run = snapshot(
        "R",
        {
            "data/a/0": scene(9, sigma_constant_px=sigma),
            "data/a/1": scene(9, sigma_constant_px=extra, num_inliers=[3] * 9),
        },
    )
    numbers = compare(run, run).whole.after
    assert numbers.num_images == 9
    assert numbers.sigma_px == statistics.median(sigma)


def test_a_model_is_lost_when_none_of_its_images_is_left():
    main, small = scene(10), scene(3, image_name=["x", "y", "z"])
    before = snapshot("R0", {"data/a/0": main, "data/a/1": small})
    merged = {name: [*main[name], *small[name]] for name in main}
    assert compare(before, snapshot("R1", {"data/a/0": merged})).whole.lost_models == ()
    assert compare(before, snapshot("R2", {"data/a/0": main})).whole.lost_models == ("data/a/1",)


def test_a_scene_of_a_camera_that_bends_is_a_systematic_error_of_its_images():
    state = ImageState(
        ImageKey("d", "s", "a"), MODEL, 5, "accepted", (), None, None, None, None, Systematic((0.0,), (0.1,))
    )
    worse = replace(state, systematic=Systematic((0.7,), (0.7,)))
    runs = [RunSnapshot({each.key: each}, {MODEL: frozenset([each.key])}) for each in (state, worse)]
    [(_, growth)] = compare(*runs).whole.grown_px
    assert growth == pytest.approx(0.6)


def test_scopes_are_called_as_people_call_them():
    assert [scope.name for scope in (Scope(), Scope("d"), Scope("d", "s"))] == ["all", "d", "d/s"]


@pytest.mark.parametrize("page", [Page(80), Page(80, unicode=False), Page(120)], ids=str)
def test_every_line_of_the_page_fits_and_names_stay_on_theirs(page):
    n = len(NASTY)
    before = snapshot("R0", {"a": scene(image_name=list(NASTY)), "b" * 200: scene(30), "lost\nscene": scene(2)})
    after = snapshot(
        "R1", {"a": rejected(scene(image_name=list(NASTY)), *range(n)), "b" * 200: rejected(scene(30), *range(30))}
    )
    text = render_comparison(compare(before, after), ("R0", "R1"), page)
    assert max(cell_len(line) for line in text.splitlines()) <= page.width
    assert "\x1b" not in text
    assert "\u202e" not in text
    assert f"... and {30 + n - MAX_NAMES} more" in text
    assert "lost\\nscene" in text


def test_runs_that_share_no_image_say_why():
    before, after = snapshot("R0", {"night1/a/0": scene(3)}), snapshot("R1", {"night2/a/0": scene(3)})
    assert "base name of the PATH" in " ".join(render_comparison(compare(before, after), ("R0", "R1"), Page()).split())
