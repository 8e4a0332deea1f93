"""Cost of the page of ``sfm-audit report``: drawing its figures, writing it, and opening it in Chromium.

    python scripts/bench_report.py            1000 simulated images
    python scripts/bench_report.py --quick    100 images; fails where a ratio leaves its bound

Figures: CPU seconds for the seven pictures of an image as the page draws them (`reports.charts`) and as matplotlib does
(`reports.figures`, saved as SVG), in turns in one process. Page: CPU seconds of the whole command with twelve
images drawn, residuals recomputed from the model. Opening: from the request to a page that answers, the best of three.
"""

from __future__ import annotations

import argparse
import io
import os
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

import numpy as np

if __package__ in (None, ""):  # called by its path
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from sfm_audit.audit.simulate.adjust import true_claim, write_model
from sfm_audit.audit.simulate.noise import NoiseKind, NoiseSpec
from sfm_audit.audit.simulate.scene import SceneSpec, simulate_scene
from sfm_audit.reports import figures
from sfm_audit.reports.charts import Residuals
from sfm_audit.reports.html import draw_image

MIN_RATIO: Final = 10.0
MAX_SECONDS_TO_OPEN: Final = 2.0
FLAGS: Final = ("--no-sandbox", "--disable-gpu", "--disable-background-networking", "--no-first-run")
GROUPS: Final = ("radial", "tangential", "affine", "principal_point", "rolling_shutter", "smooth")
ROW: Final = {f"misfit_{group}_{kind}": 0.1 for group in GROUPS for kind in ("px", "p", "rank")}


def main() -> int:
    """Measure, print, compare with the bounds."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="100 images, for CI")
    quick = parser.parse_args().quick
    ratio = draw(repetitions=2 if quick else 5)
    with tempfile.TemporaryDirectory() as folder:
        page = write_page(Path(folder), num_images=100 if quick else 1000)
        seconds = None if quick else open_page(page)
    problems = [f"figures cost one {ratio:.0f}th of matplotlib's, expected {MIN_RATIO:g}"] if ratio < MIN_RATIO else []
    if seconds is not None and seconds > MAX_SECONDS_TO_OPEN:
        problems.append(f"the page opens in {seconds:.2f} s, expected {MAX_SECONDS_TO_OPEN:g}")
    for problem in problems:
        print(f"bench_report: {problem}", file=sys.stderr)
    return 1 if problems else 0


def draw(repetitions: int) -> float:
    """Draw an image's pictures both ways in turns; return how many times more CPU matplotlib takes."""
    rng = np.random.default_rng(0)
    residuals = Residuals.build(rng.uniform(0, 1, (2000, 2)) * (1600, 1200), rng.normal(0, 0.5, (2000, 2)))

    def as_svg() -> None:
        draw_image(residuals, ROW, photo_url=None, tau_px=0.2, alpha=0.05)

    def by_matplotlib() -> None:
        one = (figures.residual_vectors, figures.residual_field, figures.radial_profile, figures.standardised_histogram)
        for make in (*one, figures.qq_plot, figures.scale_comparison):
            make(residuals).savefig(io.StringIO(), format="svg")
        figures.misfit_groups(ROW, tau_px=0.2).savefig(io.StringIO(), format="svg")

    as_svg()
    by_matplotlib()  # once each, for what is imported and cached
    pairs = [(cpu_seconds(as_svg), cpu_seconds(by_matplotlib)) for _ in range(repetitions)]
    mine, theirs = (float(statistics.median(column)) for column in zip(*pairs, strict=True))
    print(
        f"pictures of an image: {1000 * mine:.0f} ms, by matplotlib {1000 * theirs:.0f} ms CPU ({theirs / mine:.0f} x)"
    )
    return theirs / mine


def cpu_seconds(work: Callable[[], None]) -> float:
    """CPU seconds of this process."""
    start = time.process_time()
    work()
    return time.process_time() - start


def write_page(folder: Path, num_images: int) -> Path:
    """Simulate and audit a model, write its page, say what the page costs."""
    noise = NoiseSpec(NoiseKind.PER_TRACK_LOGNORMAL, sigma_px=0.5)
    spec = SceneSpec(num_images=num_images, points_per_image=100, noise=noise, track_decay=0.7, max_neighbours=24)
    scene = simulate_scene(spec, np.random.default_rng(0))
    write_model(scene, true_claim(scene), folder / "model")
    command(["run", str(folder / "model"), "-o", str(folder / "run"), "--quiet"])
    page = folder / "report.html"
    seconds = command(["report", str(folder / "run"), "-o", str(page), "--quiet"])
    print(f"report of {num_images} images, twelve drawn: {seconds:.1f} s CPU, {page.stat().st_size / 1e6:.1f} MB")
    return page


def command(args: list[str]) -> float:
    """Run ``sfm-audit`` in a process of its own, single-threaded; return its CPU seconds."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, "-m", "sfm_audit", *args], check=True, env=os.environ | {"OMP_NUM_THREADS": "1"})
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def open_page(page: Path) -> float | None:
    """Return the seconds until the page answers, the best of three; None without a browser."""
    chromium = shutil.which("chromium")
    if chromium is None:
        print("no chromium here: opening was not measured")
        return None
    from playwright.sync_api import sync_playwright  # noqa: PLC0415 - only where there is a browser

    seconds = []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=list(FLAGS))
        for _ in range(3):
            opened = browser.new_context(offline=True).new_page()
            start = time.perf_counter()
            opened.goto(page.as_uri())
            opened.wait_for_selector("html[data-ready]")
            seconds.append(time.perf_counter() - start)
        browser.close()
    print(f"opens in {min(seconds):.2f} s ({', '.join(f'{each:.2f}' for each in seconds)})")
    return min(seconds)


if __name__ == "__main__":
    sys.exit(main())
