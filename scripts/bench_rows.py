"""What do decisions, rows and tables of a model cost? CPU microseconds per image: python scripts/bench_rows.py FOLDER.

Everything that is measured is measured before; each step is done ten times in a row and its fastest time counts.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from threadpoolctl import threadpool_limits

from sfm_audit import open_model
from sfm_audit.audit.decision.decide import decide_all
from sfm_audit.audit.engine.camera import images_advice
from sfm_audit.audit.engine.error_summary import error_summary
from sfm_audit.audit.engine.image_table import KnownImages, image_columns
from sfm_audit.audit.engine.known import measured_of
from sfm_audit.audit.engine.model import ModelAuditor
from sfm_audit.audit.engine.noise_columns import noise_columns
from sfm_audit.audit.engine.tables import ImagesPart
from sfm_audit.audit.table import ModelLabels

_TIMES: Final = 10


def main() -> None:
    """Parse arguments, audit, time the steps, say what they cost."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    with threadpool_limits(limits=1, user_api="blas"), np.errstate(all="ignore"):
        auditor = ModelAuditor(open_model(folder))
        auditor.tables()
        print_steps(auditor)


def print_steps(auditor: ModelAuditor) -> None:
    """Print the cost of each step, in the order in which they are made."""
    every, config, labels = range(len(auditor.model.images)), auditor.config, ModelLabels("", "", "0", "")
    tracks = auditor.tracks if config.noise == "track" else None
    noise = timed(
        "noise and tests",
        len(every),
        partial(noise_columns, auditor.residuals, tracks, every, auditor.constant_fits, auditor.noise),
    )
    errors = timed("reprojection errors", len(every), partial(error_summary, auditor.residuals, every))
    known = partial(measured_of, auditor, every, noise.measured, errors.longest_px)
    measured = timed("what decides", len(every), known)
    decisions = timed("decisions", len(every), partial(decide_all, measured, config))
    advice = images_advice(auditor.quality, decisions, None, alpha=config.alpha)
    images = KnownImages(auditor, every, errors, noise, measured, decisions, advice)
    length = auditor.tracks.statistics.track_length
    columns = timed("columns", len(every), partial(image_columns, images, labels, config.noise, length))
    timed("table", len(every), partial(ImagesPart.of, columns, images, config.column_groups))


def timed(name: str, num_images: int, step: Callable[[], Any]) -> Any:
    """Do a step some times, print the CPU time of the fastest, and return what it gives."""
    seconds, found = [], None
    for _ in range(_TIMES):
        start = time.process_time()
        found = step()
        seconds.append(time.process_time() - start)
    print(f"{name:20s} {1e6 * min(seconds) / num_images:8.1f} us per image")
    return found


if __name__ == "__main__":
    main()
