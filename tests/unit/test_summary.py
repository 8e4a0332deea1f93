import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.cells import cell_len
from run_samples import STATE, make_ref, sample_tables, settings

from sfm_audit.audit.table.words import Member, ReasonCode, Verdict, is_remark
from sfm_audit.loaders.model import Finding, FindingCode
from sfm_audit.reports.run_folder.reader import RunReader
from sfm_audit.reports.run_folder.store import RunStore
from sfm_audit.reports.text.drawing import Page
from sfm_audit.reports.text.legend import legend, settings_words
from sfm_audit.reports.text.summary import CAVEATS, MAX_IMAGES_OF_ONE, MAX_MODELS, render_summary
from sfm_audit.reports.text.wording import natural_key, number, plain, probability, px, shorten

NASTY = [
    "<script>alert(1)</script>.jpg",
    "[red]markup[/red].jpg",
    "two\nlines\x1b[31m.jpg",
    "\u202egpj.txt",
    "東京タワー" * 20 + ".jpg",
    "x" * 300 + ".jpg",
    "quotes\"'.jpg",
    "",
]
FINDING = Finding(FindingCode.DANGLING_POINT_IDS, 3, "3 2D points name 3D points that are not there")


@pytest.fixture(autouse=True)
def run_folder(tmp_path, monkeypatch):
    """A short relative name: a path is never broken, so that it can be copied. Nothing here needs to survive."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("os.fsync", lambda _: None)
    return Path("RUN")


def make_run(folder: Path, models: int, images: int, name: str = "{:04d}", image_names=None, **given: Any) -> RunReader:
    rng = np.random.default_rng(0)
    with RunStore(folder, settings()) as store:
        for i in range(models):
            ref = make_ref(f"data/{i}/sparse/0", scene=name.format(i))
            verdicts = tuple(rng.choice(["accepted", "rejected", "undetermined"], images))
            reasons = [[] if v == "accepted" else [f"ks_rejected: p = 0.01, number {i}"] for v in verdicts]
            columns = {"ks_stat": rng.uniform(0, 1, images), "reasons": reasons, **given}
            if image_names:
                columns["image_name"] = image_names
            findings = {"findings": [[FINDING] * (i > 0)], "share_stale_point_errors": [0.5]}
            store.write(ref, STATE, sample_tables(ref, verdicts, findings, **columns), 0.1)
        store.finish(
            None, [("data/broken", "data/broken/points3D.bin: byte 7: expected more, found less; copy it")], 1.0
        )
    return RunReader.open(folder)


@pytest.mark.parametrize(("models", "images"), [(1, 5), (1, 200), (3, 4), (40, 3), (45, 1)])
def test_every_line_fits_the_page(run_folder, models, images):
    name = "a scene whose name is far too long for one line {:04d}" if models == 3 else "{:04d}"
    run = make_run(run_folder, models, images, name)
    for page in (Page(80), Page(80, unicode=False), Page(132)):
        text = render_summary(run, page)
        assert max(cell_len(line) for line in text.splitlines()) <= page.width
        assert "ac-" in text
        assert "misfit" in text


def test_names_are_text_on_their_line(run_folder):
    text = render_summary(make_run(run_folder, 2, len(NASTY), "ro\nom {}", NASTY), Page(80))
    assert max(cell_len(line) for line in text.splitlines()) <= 80
    assert "\x1b" not in text
    assert "\u202e" not in text
    assert "markup" in text or "[re" in text


def test_without_line_drawing_the_page_is_ascii(run_folder):
    assert render_summary(make_run(run_folder, 3, 4), Page(80, unicode=False)).isascii()


def test_colours_only_when_asked_for(run_folder):
    run = make_run(run_folder, 1, 5)
    assert "\x1b[" not in render_summary(run, Page(80))
    assert "\x1b[31m" in render_summary(run, Page(80, colour=True))


def test_what_a_verdict_does_not_prove_stands_beside_it(run_folder):
    text = " ".join(render_summary(make_run(run_folder, 1, 3), Page(80)).split())
    for caveat in CAVEATS:
        assert caveat in text


def test_one_model_shows_its_images_rejected_first(run_folder):
    text = render_summary(make_run(run_folder, 1, 60), Page(80))
    shown = [line.split()[1] for line in text.splitlines() if line.startswith("IMG_")]
    order = {"rejected": 0, "undetermined": 1, "accepted": 2}
    assert len(shown) == MAX_IMAGES_OF_ONE
    assert shown == sorted(shown, key=order.__getitem__)
    assert f"... and {60 - MAX_IMAGES_OF_ONE} more, see {run_folder}/images" in text


def section(text: str, title: str) -> str:
    """The lines from a title to the next empty line."""
    return text[text.index(title) :].split("\n\n", 1)[0]


def image_lines(text: str) -> list[list[str]]:
    return [line.split() for line in text.splitlines() if line.startswith("IMG_")]


def one_model(folder: Path, verdicts, models=None, cameras=None, **columns: Any) -> str:
    ref = make_ref()
    with RunStore(folder, settings()) as store:
        store.write(ref, STATE, sample_tables(ref, verdicts, models, cameras, **columns), 0.1)
        store.finish(None, [], 1.0)
    return render_summary(RunReader.open(folder), Page(80))


def test_images_are_ordered_by_misfit_and_then_by_ks_distance(run_folder):
    text = one_model(
        run_folder,
        ("accepted", "rejected", "rejected", "rejected", "rejected"),
        misfit_group=["smooth", None, "principal_point", "rolling_shutter", None],
        misfit_px=[9.0, np.nan, 0.42, 1.5, np.nan],
        ks_stat=[0.9, 0.1, 0.8, 0.1, 0.3],
    )
    rows = image_lines(text)
    assert [row[0] for row in rows] == [f"IMG_{i:04d}.jpg" for i in (3, 2, 4, 1, 0)]
    assert [row[6:8] for row in rows[:2]] == [["rolling", "1.50"], ["principal", "0.42"]]
    assert [row[6] for row in rows[2:4]] == ["-", "-"]


def test_coverage_is_shown_where_names_have_room(run_folder):
    assert "cover-" in one_model(run_folder / "short", ("rejected",))
    long = one_model(run_folder / "long", ("rejected",), image_name=["a name of fifty cells" * 3])
    assert "cover-" not in long
    assert max(map(len, long.splitlines())) == 80


def test_remarks_are_not_told_as_reasons(run_folder):
    remark, untested = "k1_not_identified: 0.1, sd = 0.2", "misfit_not_tested: smooth (not enough evidence)"
    text = one_model(
        run_folder,
        ("accepted", "rejected", "undetermined"),
        verdict_misfit=["accepted", "rejected", "undetermined"],
        reasons=[[remark, untested], ["misfit_radial: 0.42 px", untested], [untested, "low_coverage: 2 %", remark]],
    )
    reasons, remarks = section(text, "Why images are not accepted"), section(text, "Remarks (decide nothing)")
    assert reasons.startswith("Why images are not accepted (what to do: sfm-audit explain-code CODE)\n")
    assert "misfit_radial  1 image, IMG_0001.jpg: 0.42 px" in reasons
    assert "misfit_not_tested  1 image, IMG_0002.jpg" in reasons
    assert "low_coverage  1 image" in reasons
    assert "k1_not_identified" not in reasons
    assert "k1_not_identified  2 images, such as IMG_0000.jpg: 0.1, sd = 0.2" in remarks
    assert "misfit_not_tested  2 images, such as IMG_0000.jpg" in remarks


@pytest.mark.parametrize("code", ReasonCode)
@pytest.mark.parametrize("verdict", Verdict)
def test_which_codes_can_be_remarks(code, verdict):
    always = {
        *(ReasonCode.K1_NOT_IDENTIFIED, ReasonCode.FRONTO_PARALLEL),
        *(ReasonCode.MISFIT_WITHOUT_WORTH, ReasonCode.PIXEL_CONVENTION),
    }
    wanted = code in always or (code == ReasonCode.MISFIT_NOT_TESTED and verdict != Verdict.UNDETERMINED)
    assert is_remark(str(code), {"verdict_misfit": str(verdict)}) == wanted


def test_an_image_counts_once_per_reason(run_folder):
    reasons = [["too_few_observations: 9 inliers", "too_few_observations: 3 of 9 inliers tested"]]
    text = one_model(run_folder, ("undetermined",), reasons=reasons)
    assert "too_few_observations  1 image, IMG_0000.jpg: 9 inliers" in text


def test_advice_is_counted_by_what_it_is_for(run_folder):
    fixes = ["OPENCV", "OPENCV", "RADIAL", "none: rolling shutter", "FULL_OPENCV"]
    text = one_model(
        run_folder,
        ("rejected",) * 5 + ("accepted",) * 2,
        verdict_misfit=["rejected"] * 5 + ["accepted"] * 2,
        advised_camera_model=[*fixes, "PINHOLE", None],
    )
    advice = " ".join(section(text, "Advised camera models").split())
    assert (
        "5 images with a misfit that matters: OPENCV (2), RADIAL (1), none: rolling shutter (1), others (1)" in advice
    )
    assert "1 image where less would do: PINHOLE (1)" in advice


def test_only_shared_cameras_with_a_material_misfit_are_listed(run_folder):
    text = one_model(
        run_folder,
        ("rejected",) * 2,
        cameras={
            "camera_id": [7],
            "camera_model": ["SIMPLE_RADIAL"],
            "misfit_group": ["radial"],
            "misfit_px": [0.424],
            "misfit_material": [True],
            "advised_camera_model": ["RADIAL"],
        },
    )
    said = "camera 7  SIMPLE_RADIAL, 2 images: radial 0.42 px; advice: RADIAL"
    assert said in section(text, "Shared cameras")
    for name, change in {"small": {"misfit_material": [False]}, "own": {"num_images": [1]}}.items():
        assert "Shared cameras" not in one_model(run_folder / name, ("rejected",) * 2, cameras=change)


@pytest.mark.parametrize("policy", ["full", "camera", "paper"])
def test_every_verdict_is_counted_and_the_policy_named(run_folder, policy):
    names = [member.short for member in Member]
    counts = {f"num_{v}_{m}": [10 * i + j] for i, m in enumerate(names) for j, v in enumerate(Verdict)}
    ref = make_ref()
    with RunStore(run_folder, settings(policy=policy)) as store:
        store.write(ref, STATE, sample_tables(ref, ("rejected",) * 3, counts), 0.1)
        store.finish(None, [], 1.0)
    text = section(render_summary(RunReader.open(run_folder), Page(80)), "Verdicts")
    rows = {line.split()[0]: line.split()[1:4] for line in text.splitlines() if line.startswith(("verdict_", "plaus"))}
    assert rows == {str(member): [str(10 * i), str(10 * i + 1), str(10 * i + 2)] for i, member in enumerate(Member)}
    assert f"policy {policy}" in text


def test_many_models_show_those_with_the_largest_share_rejected(run_folder):
    text = render_summary(make_run(run_folder, MAX_MODELS + 5, 2), Page(80))
    assert f"{MAX_MODELS + 5} models; the {MAX_MODELS} with the largest share" in text


def test_findings_failures_and_next_steps_are_said(run_folder):
    text = " ".join(render_summary(make_run(run_folder, 3, 4), Page(80)).split())
    assert "dangling_point_ids 0001/0: 3 2D points name 3D points that are not there (and in 1 other model)" in text
    assert "data/broken/points3D.bin: byte 7: expected more" in text
    assert "Stored errors are not the points' errors in 3 models" in text
    assert f'pandas.read_parquet("{run_folder}/images")' in text


def test_numbers_that_are_not_there_are_dashes(run_folder):
    nothing = np.full(3, np.nan)
    missing = dict.fromkeys(("ks_p", "rms_px", "misfit_px", "pose_offset_px", "coverage", "ks_stat"), nothing)
    run = make_run(run_folder, 1, 3, **missing, misfit_group=[None] * 3)
    line = next(line for line in render_summary(run, Page(80)).splitlines() if line.startswith("IMG_"))
    assert line.split().count("-") == 5


def test_a_run_without_models_says_so(run_folder):
    with RunStore(run_folder, settings()) as store:
        store.finish([], [("a", "a: nothing there")], 0.1)
    text = render_summary(RunReader.open(run_folder), Page(80))
    assert "No model was audited." in text
    assert "a: nothing there" in text


@given(st.text(), st.integers(8, 60))
def test_shortened_names_keep_their_width_and_their_ends(text, width):
    name = plain(text)
    short = shorten(name, width)
    assert cell_len(short) <= width
    assert short == name or "..." in short
    assert name.startswith(short.split("...")[0])


@given(st.text())
def test_plain_names_are_printable_and_one_line(text):
    assert plain(text).isprintable()


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        (px(0.12345), "0.123"),
        (px(123456.0), "1.23e+05"),
        (px(None), "-"),
        (number(-0.5), "-0.50"),
        (probability(0.0123), "0.012"),
        (probability(1.91e-35), "2e-35"),
        (probability(2.4e-05), "2e-5"),
        (probability(0.0), "0"),
        (probability(1.0), "1"),
    ],
)
def test_numbers(text, wanted):
    assert text == wanted


def test_scene_9_comes_before_scene_10():
    assert sorted(["10", "9", "a10", "a9", ""], key=natural_key) == ["", "9", "10", "a9", "a10"]


class Repeated(RunReader):
    """The one model of a run, again and again under other names: rows as they are asked for, like those of files."""

    times = 1

    def rows(self, table, columns):
        own = list(super().rows(table, columns))
        for i in range(self.times):
            for row in own:
                name = {"scene": f"{i:05d}", "model_path": f"data/{i:05d}"}
                yield row | {key: value for key, value in name.items() if key in row}


def test_memory_does_not_grow_with_the_number_of_models(run_folder):
    run = make_run(run_folder, 2, 3)
    many = Repeated(run.folder, run.info, run.contents)
    peaks = []
    for times in (200, 1200):
        Repeated.times = times
        render_summary(many, Page(80))  # fills caches of libraries, which would count for whichever comes first
        tracemalloc.start()
        try:
            page = render_summary(many, Page(80))
            peaks.append(tracemalloc.get_traced_memory()[1])
        finally:
            tracemalloc.stop()
        assert f"{2 * times} models; the {MAX_MODELS} with the largest share" in page
        assert f"(and in {times - 1} other models)" in page
    assert peaks[1] < 1.25 * peaks[0]  # 1000 bytes kept of each model would double it


def test_models_are_shown_in_the_order_of_their_names_whatever_the_order_of_the_parts(run_folder):
    run = make_run(run_folder, MAX_MODELS, 1)
    page = render_summary(run, Page(80))
    places = [page.index(f"{i:04d}/0") for i in range(MAX_MODELS)]
    assert places == sorted(places)
    assert f"{FINDING.code} 0001/0: {FINDING.text} (and in 38 other models)" in " ".join(page.split())


STANDARD = {"policy": "standard", "alpha": 0.05, "min_effect": "0.2px", "noise": "track", "points": "in-sample"}


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (
            {},
            "policy standard: lens, camera, pose, plausibility, noise; 5% level; effects below 0.2 px ignored; noise",
        ),
        ({"min_effect": "0.5sigma", "alpha": 0.001}, "0.1% level; effects below 0.5 sigma (the noise of the image)"),
        ({"policy": "paper"}, "policy paper: distribution of the noise (KS); 5% level; noise predicted"),
        ({"noise": "constant", "points": "independent"}, "one noise level per image; 3D points measured independently"),
        ({"policy": "of later", "alpha": None}, "policy of later; level None; noise predicted"),
    ],
)
def test_the_first_lines_say_what_judged_the_images(given, said):
    assert said in settings_words({**STANDARD, **given}, has_witnesses=False)


def test_witnesses_are_named_where_some_were_asked():
    assert "noise, witnesses outside; 5%" in settings_words(STANDARD, has_witnesses=True)


def test_a_legend_of_four_lines_stands_under_the_tables(run_folder):
    text = render_summary(make_run(run_folder, 1, 5), Page(80))
    assert text.startswith("sfm-audit ")
    assert "each image judged by policy" in " ".join(text.split())
    lines = section(text, "error: mean reprojection error").splitlines()
    assert len(lines) == 4
    assert lines[-1].endswith("docs/glossary.md")
    assert "coverage:" in " ".join(lines)
    assert "coverage:" not in legend(80, has_coverage=False)
