"""Compare models that COLMAP's own converter wrote for other programs with the models that it wrote them from.

`colmap model_converter` (3.8 or newer; not a part of pycolmap) writes a COLMAP model as Bundler's and as VisualSFM's
files. Both hold a principal point in the image's centre and one lens per image; so residuals are compared for cameras
of the models that the formats can hold: SIMPLE_PINHOLE, SIMPLE_RADIAL and RADIAL for Bundler, SIMPLE_PINHOLE for NVM.
Numbers in docs/datasets.md.

    scripts/check_foreign_formats.py MODEL... [--colmap colmap]
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from sfm_audit.audit.engine.model import ModelAuditor
from sfm_audit.loaders import SparseModel, open_model

HOLDS = {
    "Bundler": {"SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"},
    "NVM": {"SIMPLE_PINHOLE"},
}
MAX_PX = 1e-3
"""COLMAP 3.8 writes Bundler's and NVM's numbers with six to ten digits."""


def residuals_by_name(model: SparseModel) -> dict[str, np.ndarray]:
    """Return sorted residuals of every image by its name, px: formats keep no order of 2D points."""
    residuals = ModelAuditor(model).residuals
    out = {}
    for row, name in enumerate(model.images.name):
        found = residuals.residuals_px[:, residuals.rows(row)].T
        out[Path(name).name] = found[np.lexsort(np.round(found, 1).T)]
    return out


def convert(colmap: str, source: Path, kind: str, folder: Path) -> SparseModel:
    """Return the model as COLMAP's converter writes it and this program reads it."""
    target = folder / ("bundle" if kind == "Bundler" else "model.nvm")
    command = [colmap, "model_converter", "--input_path", str(source), "--output_path", str(target)]
    subprocess.run([*command, "--output_type", kind], check=True, capture_output=True)
    if kind == "Bundler":
        (folder / "bundle.bundle.out").rename(folder / "bundle.out")
        (folder / "bundle.list.txt").rename(folder / "list.txt")
    else:
        centre_measurements(target, open_model(source))
    return open_model(folder)


def centre_measurements(path: Path, model: SparseModel) -> None:
    """Subtract principal points from the measurements of an NVM file: COLMAP writes px from the image's corner."""
    lines = path.read_text().splitlines()
    num_images = int(lines[2])
    centre_of = {}
    for row, name in enumerate(model.images.name):
        camera = model.image(row).camera
        if camera is not None:
            centre_of[name] = camera.params[list(camera.model.principal_point_idxs)]
    centres = [centre_of[line.split()[0]] for line in lines[3 : 3 + num_images]]
    for row in range(num_images + 3, len(lines)):
        words = lines[row].split()
        for at in range(7, len(words) - 3, 4):
            for axis in (0, 1):
                words[at + 2 + axis] = repr(float(words[at + 2 + axis]) - float(centres[int(words[at])][axis]))
        lines[row] = " ".join(words)
    path.write_text("\n".join(lines) + "\n")


def check(colmap: str, source: Path) -> bool:
    """Print the largest difference of RMS errors of images, per format; return whether all are small."""
    model = open_model(source)
    names = {model.camera(row).model.name for row in range(len(model.cameras))}
    good = True
    for kind, held in HOLDS.items():
        if not names <= held:
            print(f"{source}\t{kind}\tnot asked: it cannot hold {', '.join(sorted(names - held))}")
            continue
        with tempfile.TemporaryDirectory() as folder:
            theirs = residuals_by_name(convert(colmap, source, kind, Path(folder)))
        ours = residuals_by_name(model)
        differences = [abs(_rms(ours[name]) - _rms(theirs[name])) for name in ours if len(ours[name])]
        counts = sum(len(ours[name]) == len(theirs[name]) for name in ours)
        largest = max(differences, default=0.0)
        print(f"{source}\t{kind}\t{len(differences)} images, {counts} with equal counts, rms within {largest:.2g} px")
        good &= largest <= MAX_PX and (counts == len(ours) or kind == "NVM")  # which names an image once per point
    return good


def _rms(residuals: np.ndarray) -> float:
    return float(np.sqrt((residuals**2).sum(axis=1).mean()))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs="+", type=Path)
    parser.add_argument("--colmap", default="colmap")
    asked = parser.parse_args()
    good = [check(asked.colmap, path) for path in asked.models]  # all of them, whatever the first says
    sys.exit(0 if all(good) else 1)
