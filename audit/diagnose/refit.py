"""What would adjusting the model again do, as it is and with other camera models? pycolmap's bundle adjustment."""

from __future__ import annotations

import dataclasses
import os
import re
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import pycolmap

from sfm_audit.audit.config import AuditConfig
from sfm_audit.audit.diagnose.summary import summary_numbers
from sfm_audit.audit.engine.model import audit_model
from sfm_audit.audit.misfit.capabilities import extended_params
from sfm_audit.audit.simulate.colmap_files import write_colmap_binary
from sfm_audit.loaders import LoadError, SparseModel, open_model
from sfm_audit.loaders.camera_models import BY_NAME

_PLACE_IN_COLMAP: Final = re.compile(r"^\[[^\]]*\] ")
LARGER: Final = ("RADIAL", "OPENCV", "FULL_OPENCV")
"""Camera models that are tried where nothing particular is advised, the smallest first."""


@dataclass(frozen=True, slots=True)
class Refit:
    """One refit. camera_model: None for the control, each camera as the model it has.

    numbers: `summary_numbers` of the audit afterwards, empty where it failed.    problem: why, None where it did not.
    """

    camera_model: str | None
    numbers: dict[str, float]
    problem: str | None = None


def refit(model: SparseModel, camera_model: str | None, config: AuditConfig, out: Path | None = None) -> Refit:
    """Adjust a model with another camera model and audit it again.

    Parameters
    ----------
    camera_model : for all cameras, new terms starting at zero; None: as they are, the control
    out : a folder for the adjusted model, which exists; None to forget it

    Notes
    -----
    All points and poses, focal lengths and distortion are free, principal points fixed: COLMAP's defaults. What the
    control changes is adjusting; only what a larger camera model changes beyond it speaks for that model.
    """
    wanted = model if camera_model is None else with_cameras(model, camera_model)
    if wanted is None:
        return Refit(camera_model, {}, "cannot express the present cameras")
    with tempfile.TemporaryDirectory() as before, tempfile.TemporaryDirectory() as after:
        folder = Path(after) if out is None else out
        try:
            write_colmap_binary(wanted, Path(before), np.random.default_rng(0))
            _adjust(Path(before), folder)
            audited = audit_model(open_model(str(folder)), config)
        except (LoadError, ValueError, RuntimeError) as error:  # pycolmap refuses what cannot be adjusted
            said = _PLACE_IN_COLMAP.sub("", " ".join(str(error).split()))
            return Refit(camera_model, {}, said[:200])
        return Refit(camera_model, summary_numbers(audited.images.to_pylist()))


def _adjust(before: Path, after: Path) -> None:
    reconstruction = pycolmap.Reconstruction(before)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    with _without_stderr():
        pycolmap.bundle_adjustment(reconstruction, options)
    reconstruction.write(after)


@contextmanager
def _without_stderr() -> Iterator[None]:
    """Keep COLMAP's progress off stderr: it writes there whatever pycolmap.logging is told (4.2.1)."""
    sys.stderr.flush()
    kept = os.dup(2)
    try:
        with Path(os.devnull).open("wb") as nowhere:
            os.dup2(nowhere.fileno(), 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


def candidates(model: SparseModel, advised: Sequence[str]) -> list[str]:
    """Return the camera models worth a refit: those advised, else all larger ones that can express the cameras."""
    names = [name for name in advised if name in BY_NAME]
    present = {model.camera(i).model.name for i in range(len(model.cameras))}
    tried = names or [name for name in LARGER if name not in present]
    return [name for name in tried if with_cameras(model, name) is not None]


def with_cameras(model: SparseModel, name: str) -> SparseModel | None:
    """Return the model with all cameras as those of a larger camera model, new terms zero; None if one cannot be."""
    larger = BY_NAME[name]
    params = []
    for i in range(len(model.cameras)):
        camera = model.camera(i)
        extended = camera.params if camera.model is larger else extended_params(camera.model, camera.params, larger)
        if extended is None:
            return None
        params.append(extended)
    if not params:
        return None
    cameras = dataclasses.replace(
        model.cameras,
        model_id=np.full(len(params), larger.model_id, dtype=np.int64),
        params=np.concatenate(params),
        param_offsets=np.arange(len(params) + 1, dtype=np.int64) * larger.num_params,
    )
    return dataclasses.replace(model, cameras=cameras)
