"""A finished run under another policy, effect, reason or severity: what the verbs say, without an audit."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from scripts.corpus.models import models_of
from scripts.corpus.page import document, without_action
from sfm_audit.audit.cli import again, recompute
from sfm_audit.audit.cli.main import main
from sfm_audit.audit.simulate.adjust import write_adjusted_model
from sfm_audit.audit.simulate.demo import demo_scene
from sfm_audit.audit.simulate.scene import simulate_scene
from sfm_audit.audit.table import TABLES
from sfm_audit.audit.table.words import POLICIES
from sfm_audit.reports.html.story import render_story_page
from sfm_audit.reports.run_folder.reader import RunReader


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Runs of the demo's photos: under standard, under paper."""
    folder = tmp_path_factory.mktemp("again")
    scene = simulate_scene(demo_scene(0), np.random.default_rng([0, 1]))
    write_adjusted_model(scene, folder / "photos" / "sparse" / "0")
    for policy in ("standard", "paper"):
        options = ["--policy", policy, "--quiet", "--jobs", "1"]
        assert main(["run", str(folder / "photos"), "-o", str(folder / policy), *options]) == 0
    return folder


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def rows(run: RunReader, table: str):
    return list(run.rows(table, [column.name for column in TABLES[table]]))


@pytest.mark.parametrize("table", ["images", "cameras", "models"])
def test_a_run_read_under_another_policy_is_a_run_under_it(runs, table):
    read = again.Again(policy="paper").read(RunReader.open(runs / "standard"))
    assert repr(rows(read, table)) == repr(rows(RunReader.open(runs / "paper"), table))
    assert read.info["config"]["policy"] == "paper"
    assert read.info["decided_again"] == "policy paper instead of standard"


def test_with_its_own_settings_a_run_is_itself(runs):
    run = RunReader.open(runs / "standard")
    assert again.Again().read(run) is run
    assert again.Again(policy="standard", min_effect="0.2px").read(run) is run


def test_a_larger_effect_needs_no_audit_and_leaves_cameras_consistent(runs, monkeypatch):
    monkeypatch.setattr(recompute, "open_model", None)
    run = again.Again(min_effect="0.5px").read(RunReader.open(runs / "standard"))
    groups = {row["misfit_group"]: row["verdict"] for row in rows(run, "images")}
    assert groups["radial"] == "rejected"
    assert sum(row["verdict"] == "rejected" for row in rows(run, "images")) == 3
    material = [row for row in rows(run, "cameras") if row["misfit_material"]]
    assert material
    assert all(row["misfit_px"] > 0.5 for row in material)
    lost = [row for row in rows(run, "cameras") if (row["misfit_px"] or 0) > 0.2 and not row["misfit_material"]]
    assert lost
    assert all(row["advised_camera_model"] is None for row in lost)
    (model,) = rows(run, "models")
    assert model["num_rejected"] == 3


def test_filter_under_every_policy_keeps_what_a_run_under_it_would(runs, capsys):
    for policy in POLICIES:
        assert main(["filter", str(runs / "standard"), "--policy", policy, "--list", policy]) == 0
    assert main(["filter", str(runs / "paper"), "--list", "of-run"]) == 0
    assert Path("paper").read_text(encoding="utf-8") == Path("of-run").read_text(encoding="utf-8")
    assert Path("paper").read_text(encoding="utf-8") != Path("standard").read_text(encoding="utf-8")
    assert capsys.readouterr().err == ""


def test_filter_by_reason_and_severity(runs):
    run = str(runs / "standard")
    assert main(["filter", run, "--reason", "misfit_radial", "--list", "radial"]) == 0
    removed = Path("radial.removed.csv").read_text(encoding="utf-8").splitlines()[1:]
    assert len(removed) == 3
    assert all("misfit_radial" in line for line in removed)
    assert main(["filter", run, "--severity", "hard", "--list", "hard"]) == 0
    assert len(Path("hard.removed.csv").read_text(encoding="utf-8").splitlines()[1:]) == 2
    assert main(["filter", run, "--reason", "priors_disagree", "--list", "priors"]) == 0  # a witness that nobody asked
    assert len(Path("priors.removed.csv").read_text(encoding="utf-8").splitlines()[1:]) == 0


def test_check_judges_under_the_settings_asked_for(runs, capsys):
    Path("gate.toml").write_text("[limits]\nmax_share_rejected = 0.06\n", encoding="utf-8")
    run = ["check", str(runs / "standard"), "--policy-file", "gate.toml"]
    assert main(run) == 1
    assert main([*run, "--policy", "paper"]) == 0
    assert main([*run, "--severity", "hard"]) == 0
    out = capsys.readouterr().out
    assert "only rejections of severity hard count" in " ".join(out.split())


def test_a_baseline_of_another_policy_is_decided_as_the_run(runs, capsys):
    Path("gate.toml").touch()
    gate = ["--policy-file", "gate.toml"]
    assert main(["check", str(runs / "standard"), "--baseline", str(runs / "paper"), *gate]) == 0
    assert main(["diff", str(runs / "paper"), str(runs / "standard"), "--exit-code"]) == 0
    assert "policy standard instead of paper" in capsys.readouterr().err


def test_what_a_run_cannot_tell_is_2(runs, capsys):
    run = str(runs / "standard")
    assert main(["filter", run, "--min-effect", "0.1px", "--list", "l"]) == 2
    assert main(["report", run, "--min-effect", "0.1px"]) == 2
    assert main(["filter", run, "--min-effect", "wide", "--list", "l"]) == 2
    assert main(["filter", run, "--reason", "misfit_radal", "--list", "l"]) == 2
    assert main(["filter", run, "--reason", "low_coverage", "--list", "l"]) == 2
    assert main(["explain", run, "IMG_0010.jpg", "-o", "s", "--noise", "constant"]) == 2
    assert main(["explain", run, "IMG_0010.jpg", "-o", "s", "--scene", "elsewhere"]) == 2
    assert main(["explain", run, "nobody.jpg", "-o", "s"]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 8
    assert "did you mean misfit_radial?" in lines[3]
    assert not Path("l").exists()


def test_settings_of_another_version_are_2(runs, tmp_path, capsys):
    folder = shutil.copytree(runs / "standard", tmp_path / "old")
    text = (folder / "run.json").read_text(encoding="utf-8")
    (folder / "run.json").write_text(re.sub(r'"grid": *8', '"grid": 0', text), encoding="utf-8")
    assert main(["filter", str(folder), "--policy", "paper", "--list", "l"]) == 2
    assert "its setting grid is of another version" in capsys.readouterr().err


def test_an_image_is_explained_as_its_run_judged_it(runs, capsys):
    paper = str(runs / "paper")
    assert main(["explain", paper, "id:10", "-o", "story", "--policy", "camera"]) == 0
    out = capsys.readouterr().out
    assert "REJECTED under the policy camera" in out
    assert "policy camera instead of paper" in out
    assert "RADIAL would hold it" in " ".join(out.split())


def test_an_explained_image_on_its_photo_is_one_page(runs):
    Path("photos").mkdir()
    Image.new("RGB", (1600, 1200), "grey").save("photos/IMG_0010.jpg")
    run = str(runs / "standard")
    assert main(["explain", run, "IMG_0010.jpg", "-o", "story", "--images", "photos", "--quiet"]) == 0
    page = Path("story/story.html").read_text(encoding="utf-8")
    assert "data:image/jpeg;base64," in page
    assert not re.search(r"""(?:src|href)=["'](?!data:|#)""", page)
    assert "No photo of this name" in render_story_page({"image_name": "a", "verdict": "accepted"}, "", [], None, None)


def test_without_the_model_the_story_has_no_pictures(runs, capsys):
    (runs / "photos").rename(runs / "away")
    try:
        assert main(["explain", str(runs / "standard"), "IMG_0010.jpg", "-o", "story"]) == 0
    finally:
        (runs / "away").rename(runs / "photos")
    assert "No pictures:" in capsys.readouterr().out
    assert not list(Path("story").glob("*.png"))


def test_the_report_says_that_it_was_decided_again(runs):
    run = str(runs / "standard")
    assert main(["report", run, "--worst", "0", "--policy", "camera", "--severity", "hard", "--quiet"]) == 0
    page = Path("report.html").read_text(encoding="utf-8")
    assert "policy camera instead of standard; only rejections of severity hard count" in page


def test_a_diagnosis_as_json_is_what_the_page_of_the_corpus_is_made_of(runs, capsys):
    run = runs / "standard"
    assert main(["diagnose", str(run), "photos", "--no-refit", "--quiet", "--json", "-"]) == 0
    out, err = capsys.readouterr()
    (found,) = json.loads(out)["models"]
    assert "What is the matter" in err
    assert (found["problem"], found["refits"], found["conclusion"]) == (None, [], "Not refitted.")
    assert found["numbers"]["rejected"] == 5
    models, unread = models_of(run, [found])
    page = document(models, unread)
    assert "### photos" in page
    assert all(each["action"] in " ".join(page.split()) for each in found["diagnoses"])
    assert "\n- nothing\n" in page
    assert without_action(models) == []
    models[0].model["diagnoses"] = found["diagnoses"][1:]
    assert without_action(models) == ["photos: 7 images are not accepted, diagnoses speak of 5"]
    assert without_action(models_of(run, [])[0]) == ["photos: was not diagnosed"]


def test_a_model_that_is_gone_is_said_in_the_json_too(runs, capsys, monkeypatch):
    monkeypatch.setattr(recompute, "allowed_location", lambda *_: "nowhere")
    assert main(["diagnose", str(runs / "standard"), "--json", "found.json"]) == 3
    assert len(capsys.readouterr().err.splitlines()) == 1
    (found,) = json.loads(Path("found.json").read_bytes())["models"]
    assert "the model cannot be read any more (nowhere: " in found["problem"]
    assert (found["numbers"], found["conclusion"]) == ({}, None)
