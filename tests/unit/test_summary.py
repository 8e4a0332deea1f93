from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.cells import cell_len
from run_samples import STATE, make_ref, sample_tables, settings

from loaders.model import Finding, FindingCode
from reports.drawing import Page
from reports.reader import RunReader
from reports.store import RunStore
from reports.summary import CAVEATS, MAX_IMAGES_OF_ONE, MAX_MODELS, render_summary
from reports.wording import natural_key, number, plain, probability, px, shorten

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
@pytest.mark.parametrize("page", [Page(80), Page(80, unicode=False), Page(132)], ids=str)
def test_every_line_fits_the_page(run_folder, models, images, page):
    name = "a scene whose name is far too long for one line {:04d}" if models == 3 else "{:04d}"
    text = render_summary(make_run(run_folder, models, images, name), page)
    assert max(cell_len(line) for line in text.splitlines()) <= page.width
    assert "ac-" in text
    assert "KS" in text


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
    run = make_run(run_folder, 1, 3, ks_p=nothing, rms_px=nothing, kurtosis_excess=nothing, pose_offset_px=nothing)
    line = next(line for line in render_summary(run, Page(80)).splitlines() if line.startswith("IMG_"))
    assert line.split().count("-") == 4


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
