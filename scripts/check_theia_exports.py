"""Compare residuals of files that Theia's exporters wrote with Theia's own, on a scene that is made here.

Theia (pytheia, not a dependency: ``pip install pytheia`` beside this program) projects the points, noise of 0.5 px is
added, and its exporters write the scene as Bundler's and VisualSFM's files; the RMS residual of what is read back must
be that of the noise to the digits that were written. Numbers in docs/datasets.md, of pytheia 1.2.1.

    scripts/check_theia_exports.py
"""

from __future__ import annotations

import argparse
import importlib
import sys
import tempfile
from pathlib import Path
from typing import Any, Final

import numpy as np

from sfm_audit.audit.engine.model import ModelAuditor
from sfm_audit.loaders import open_model

SIZE: Final = (800, 600)
LENSES: Final = {"no distortion": (0.0, 0.0), "k1, k2": (-0.08, 0.02)}
MAX_PX: Final = 1e-5
"""NVM's numbers are written with six digits."""


def prior(theia: Any, k1: float, k2: float) -> Any:
    """Return what Theia calls the prior of a camera: here all of it."""
    found = theia.sfm.CameraIntrinsicsPrior()
    found.image_width, found.image_height = SIZE
    values = {"focal_length": [700.0], "principal_point": [SIZE[0] / 2, SIZE[1] / 2], "aspect_ratio": [1.0]}
    for name, value in (values | {"radial_distortion": [k1, k2, 0.0, 0.0]}).items():
        getattr(found, name).value = value
        getattr(found, name).is_set = True
    return found


def scene(theia: Any, k1: float, k2: float, rng: np.random.Generator) -> tuple[Any, float]:
    """Return Theia's reconstruction of 5 images and 60 points, and the RMS length of its noise, px."""
    made = theia.sfm.Reconstruction()
    points = np.column_stack([rng.uniform(-1, 1, (60, 3)), np.ones(60)])
    views = [made.AddView(f"{row}.jpg", row, float(row)) for row in range(5)]
    for row, view_id in enumerate(views):
        view = made.MutableView(view_id)
        view.SetCameraIntrinsicsPrior(prior(theia, k1, k2))
        camera = view.MutableCamera()
        camera.SetFromCameraIntrinsicsPriors(prior(theia, k1, k2))
        camera.SetOrientationFromAngleAxis([0.05 * row, 0.3 * (row - 2), 0.1])
        camera.SetPosition(-camera.GetOrientationAsRotationMatrix().T @ [0.1 * row, -0.2, 5.0])
        view.SetIsEstimated(True)
    tracks = [made.AddTrack() for _ in points]
    for track, point in zip(tracks, points, strict=True):
        made.MutableTrack(track).SetPoint(point)
        made.MutableTrack(track).SetIsEstimated(True)
    noise = rng.normal(0.0, 0.5, (len(views), len(points), 2))
    for row, view_id in enumerate(views):
        camera = made.View(view_id).Camera()
        for column, (track, point) in enumerate(zip(tracks, points, strict=True)):
            xy = np.ravel(camera.ProjectPoint(point)[1]) + noise[row, column]
            made.AddObservation(view_id, track, theia.sfm.Feature(xy))
    return made, float(np.sqrt((noise**2).sum(axis=2).mean()))


def rms_of(folder: Path) -> float:
    """Return the RMS residual of the model in a folder, px."""
    residuals = ModelAuditor(open_model(folder)).residuals.residuals_px
    return float(np.sqrt((residuals**2).sum(axis=0).mean()))


def check(theia: Any, name: str, folder: Path) -> bool:
    """Print and compare both formats; NVM's lens is another one, so only without distortion."""
    k1, k2 = LENSES[name]
    made, wanted = scene(theia, k1, k2, np.random.default_rng(3))
    (folder / "bundler").mkdir()
    theia.io.WriteBundlerFiles(made, str(folder / "bundler" / "list.txt"), str(folder / "bundler" / "bundle.out"))
    found = {"bundler": rms_of(folder / "bundler")}
    if k1 == 0:
        (folder / "nvm").mkdir()
        theia.io.WriteNVMFile(str(folder / "nvm" / "scene.nvm"), made)
        found["nvm"] = rms_of(folder / "nvm")
    for kind, rms in found.items():
        print(f"{kind}\t{name}\trms {rms:.9f} px, Theia's {wanted:.9f}, difference {abs(rms - wanted):.2g}")
    return all(abs(rms - wanted) <= MAX_PX for rms in found.values())


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    pytheia = importlib.import_module("pytheia")
    good = []
    for lens in LENSES:
        with tempfile.TemporaryDirectory() as scratch:
            good.append(check(pytheia, lens, Path(scratch)))
    sys.exit(0 if all(good) else 1)
