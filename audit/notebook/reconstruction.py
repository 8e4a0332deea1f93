"""From a path, a model or a reconstruction in memory to its audit."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from pydantic import ValidationError

from sfm_audit.audit.config import AuditConfig, NoiseName, PointsName
from sfm_audit.audit.engine.model import ModelAuditor
from sfm_audit.audit.notebook.result import ReconstructionAudit, quietly
from sfm_audit.audit.table import ModelLabels
from sfm_audit.audit.table.words import PolicyName
from sfm_audit.loaders import LoadError, SparseModel, discover, open_model
from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.loaders.formats import format_names, keypoint_scales_of
from sfm_audit.loaders.opening import from_pycolmap

if TYPE_CHECKING:
    import pycolmap

_SHOWN: Final = 3


def audit_reconstruction(
    source: str | Path | SparseModel | pycolmap.Reconstruction,
    config: AuditConfig | None = None,
    *,
    policy: PolicyName | None = None,
    noise: NoiseName | None = None,
    points: PointsName | None = None,
    min_effect: str | None = None,
) -> ReconstructionAudit:
    """Audit all images of one reconstruction.

    Parameters
    ----------
    source : where a model lies (a folder of this machine with one model at or below it, or s3://..., gs://...), a
        model from `open_model`, or a reconstruction in memory
    config : all settings; the defaults when None
    policy, noise, points, min_effect : single settings, before those of ``config``; see docs/config.md

    Returns
    -------
    ReconstructionAudit
        With ``images``, ``cameras`` and ``models`` as data frames, and ``image(name)``.

    Raises
    ------
    LoadError
        There is no model, more than one, or one that cannot be read.
    ValueError
        A setting has no such value, or settings contradict each other; one line says which.

    Examples
    --------
    >>> import numpy as np, sfm_audit
    >>> from sfm_audit.audit.simulate.adjust import adjust_scene, sparse_model
    >>> from sfm_audit.audit.simulate.scene import SceneSpec, simulate_scene
    >>> scene = simulate_scene(SceneSpec(num_images=8, points_per_image=120), np.random.default_rng(1))
    >>> result = sfm_audit.audit_reconstruction(sparse_model(scene, adjust_scene(scene)), policy="camera")
    >>> len(result.images), result.models.num_cameras.item()
    (8, 8)
    >>> image = result.image(result.images.image_name[0])
    >>> print(image.explain().splitlines()[0].split(":")[1].strip())
    ACCEPTED under the policy camera
    """
    settings = _settings(config, {"policy": policy, "noise": noise, "points": points, "min_effect": min_effect})
    model, labels = _model_of(source)
    auditor = ModelAuditor(model, settings, _keypoint_scales(model) if settings.noise == "keypoint" else None)
    with quietly():
        return ReconstructionAudit(auditor, auditor.tables(labels))


def _keypoint_scales(model: SparseModel) -> FloatArray:
    if model.file_format not in format_names():
        raise ValueError("noise: keypoint reads the database beside a model's files, which this model has not")
    return keypoint_scales_of(model, model.location)


def _settings(config: AuditConfig | None, said: dict[str, Any]) -> AuditConfig:
    """Return the settings; ValueError in one line where they are none."""
    given = {} if config is None else config.model_dump()
    try:
        return AuditConfig.model_validate({**given, **{name: each for name, each in said.items() if each is not None}})
    except ValidationError as error:
        first = error.errors()[0]
        name = ".".join(str(part) for part in first["loc"]) or "settings"
        what = first["msg"].removeprefix("Value error, ").replace("Input should be", "expected")
        if first["type"] == "string_pattern_mismatch":
            what = "expected a number and px or sigma, as in 0.2px"
        found = f", found {first['input']!r}" if first["loc"] else ""
        raise ValueError(f"{name}: {what}{found}") from None


def _model_of(source: Any) -> tuple[SparseModel, ModelLabels]:
    if isinstance(source, str | Path):
        return _found(source)
    model = source
    pycolmap = sys.modules.get("pycolmap")  # whoever has a reconstruction has imported it
    if pycolmap is not None and isinstance(source, pycolmap.Reconstruction):
        model = from_pycolmap(source)
    if not isinstance(model, SparseModel):
        raise TypeError(
            f"source: expected a path, a SparseModel or a pycolmap.Reconstruction, found {type(source).__name__}"
        )
    return model, ModelLabels("", "", "0", model.location)


def _found(path: str | Path) -> tuple[SparseModel, ModelLabels]:
    """Read the one model at or below a path."""
    found = discover([path])
    if not found.refs:
        raise found.errors[0]
    if len(found.refs) > 1:
        some = ", ".join(ref.model_path for ref in found.refs[:_SHOWN])
        raise LoadError(str(path), None, "one model", f"{len(found.refs)}: {some} ...", "name one of them")
    ref = found.refs[0]
    return open_model(ref.location), ModelLabels(ref.dataset, ref.scene, ref.component, ref.model_path)
