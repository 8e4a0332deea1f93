"""Say how far the observations of models lie from their projections: a reader that is wrong gives no pixels and less.

For files that other programs wrote and that lie in public repositories; which ones, and their numbers, stand in
docs/datasets.md. Where a format stores errors of points, they are compared as well.

    scripts/check_public_models.py PATH...
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from sfm_audit.audit.engine.model import ModelAuditor
from sfm_audit.loaders import LoadError, SparseModel, discover, open_model


def line_of(model: SparseModel) -> str:
    """Return counts and the lengths of residuals of one model, px."""
    residuals = ModelAuditor(model).residuals.residuals_px
    lengths = np.linalg.norm(residuals, axis=0)
    finite = lengths[np.isfinite(lengths)]
    lenses = sorted({model.camera(row).model.name for row in range(len(model.cameras))})
    numbers = [np.sqrt((finite**2).mean()), *np.quantile(finite, [0.5, 0.99, 1.0])] if len(finite) else [np.nan] * 4
    said = ", ".join(
        f"{name} {value:.6g}" for name, value in zip(("rms", "median", "99 %", "max"), numbers, strict=True)
    )
    counts = f"{len(model.images)} images, {len(model.points)} points, {len(model.observations)} observations"
    left_out = f", {len(lengths) - len(finite)} not projected" if len(finite) < len(lengths) else ""
    findings = ", ".join(finding.code.value for finding in model.findings)
    return f"{model.file_format}\t{counts}{left_out}\t{'/'.join(lenses)}\t{said} px\t{findings}"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("paths", nargs="+", type=Path)
    for ref in discover(parser.parse_args().paths).refs:
        try:
            print(f"{ref.location}\t{line_of(open_model(ref.location))}")
        except LoadError as error:
            print(error)
