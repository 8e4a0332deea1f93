"""Runs for tests of the report: rows with names that no page should stumble over, and a page in a real browser."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from run_samples import STATE, make_ref, sample_table, sample_tables, settings

from sfm_audit.reports.run_folder.reader import RunReader
from sfm_audit.reports.run_folder.store import RunStore

NASTY_NAMES = [
    "<script>window.hacked = true</script>.jpg",
    '</script><img src=x onerror="window.hacked = true">.jpg',
    "\"quotes' & ampersand.jpg",
    "two\nlines.jpg",
    "שלום-عالم.jpg",
    "\u202egpj.reversed",
    "東京タワー.jpg",
    "x" * 300 + ".jpg",
    "{{ 7 * 7 }}.jpg",
    "",
]
CONFIG = {"policy": "full", "min_effect": "0.2px"}
CHROMIUM = shutil.which("chromium")
# Debian's chromium as root, without a graphics card, and without a word to anybody
CHROMIUM_FLAGS = [
    *("--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-component-update"),
    *("--disable-sync", "--no-first-run"),
]


def write_run(folder: Path, num_images: int, names=(), seed: int = 0, model: str = "data/a/sparse/0", **given) -> Path:
    """Write a run of one model with random numbers, and reasons that go with the verdicts."""
    rng = np.random.default_rng(seed)
    verdicts = tuple(rng.choice(["accepted", "rejected", "undetermined"], num_images))
    misfit = rng.lognormal(-2, 1, num_images)
    said = {
        "accepted": [],
        "rejected": [
            "misfit_radial: 0.42 px, q = 1e-05 (also smooth 0.40 px)",
            "ks_rejected: p = 0.01 < 0.05, D = 0.1, 9 values",
        ],
        "undetermined": ["low_coverage: 8.0% < 20% of the image"],
    }
    columns = {
        "image_name": [*names, *(f"IMG_{i:05d}.jpg" for i in range(len(names), num_images))],
        "image_id": np.arange(num_images) + 1,
        "reasons": [said[verdict] for verdict in verdicts],
        "verdict_misfit": list(verdicts),
        "misfit_px": misfit,
        "misfit_group": ["radial"] * num_images,
        "num_inliers": rng.integers(50, 5000, num_images),
        "camera_model": ["SIMPLE_RADIAL"] * num_images,
        "params": [[800.0, 320.0, 240.0, 0.1]] * num_images,
        "width": np.full(num_images, 640),
        "height": np.full(num_images, 480),
        "advised_camera_model": ["RADIAL" if verdict == "rejected" else None for verdict in verdicts],
        "noise_model": ["track"] * num_images,
        **{name: rng.lognormal(-1, 0.5, num_images) for name in ("rms_px", "sigma_predicted_px", "sigma_constant_px")},
        **{name: rng.uniform(0, 1, num_images) for name in ("ks_p", "ks_constant_p", "ks_stat", "coverage")},
        **{name: rng.normal(0, 1, num_images) for name in ("kurtosis_excess", "kurtosis_constant")},
        **given,
    }
    ref = make_ref(model)
    with RunStore(folder, settings(**CONFIG)) as store:
        tables = sample_tables(ref, verdicts, {"findings": [[]]}, **columns)
        tables["cameras"] = sample_table("cameras", 3, misfit_group=["radial", None, "smooth"])
        store.write(ref, STATE, tables, 0.1)
        store.finish(None, [("data/<b>broken", "data/<b>broken: cannot be read")], 1.0)
    return folder


def read_sample(folder: Path, num_images: int, **given) -> RunReader:
    return RunReader.open(write_run(folder, num_images, **given))


needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason="needs a browser: apt-get install chromium")


@contextmanager
def browser() -> Iterator:
    """A running chromium."""
    from playwright.sync_api import sync_playwright  # noqa: PLC0415 - only where there is a browser

    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=CHROMIUM, args=CHROMIUM_FLAGS)
        yield chromium
        chromium.close()


def screenshot_folder() -> Path:
    """Where CI keeps pictures of pages: $SFM_AUDIT_SCREENSHOTS, or build/screenshots."""
    folder = Path(
        os.environ.get("SFM_AUDIT_SCREENSHOTS", Path(__file__).resolve().parents[1] / "build" / "screenshots")
    )
    folder.mkdir(parents=True, exist_ok=True)
    return folder
