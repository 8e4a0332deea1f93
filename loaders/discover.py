"""Which models lie below the paths a user gives, and what they are called: dataset, scene, component."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from loaders.colmap import REQUIRED, SUFFIX
from loaders.errors import LoadError, MissingFileError, UnreadableFileError

_MODEL_FILES: Final = frozenset(f"{name}{suffix}" for name in REQUIRED for suffix in SUFFIX.values())
_BARE_COMPONENT: Final = "0"


@dataclass(frozen=True, slots=True)
class ModelRef:
    """One model folder and its place in a data set.

    dataset: base name of the path the user gave.    scene, component: by the folder names, see `LAYOUTS`.
    location: real absolute path.    model_path: the path as given, joined with the path below it.
    """

    dataset: str
    scene: str
    component: str
    location: str
    model_path: str

    @property
    def key(self) -> str:
        """Name of the model's part in a run folder: 16 hex digits that depend on the location alone."""
        return hashlib.sha256(os.fsencode(self.location)).hexdigest()[:16]


@dataclass(frozen=True, slots=True)
class Discovery:
    """The models found, sorted by dataset, scene, component and location, and the paths in which there are none."""

    refs: tuple[ModelRef, ...]
    errors: tuple[LoadError, ...]


SceneAndComponent = tuple[str, str]
Layout = Callable[[tuple[str, ...]], SceneAndComponent | None]


def _manhattan(parts: tuple[str, ...]) -> SceneAndComponent | None:
    """MegaDepth: <scene>/sparse/manhattan/<component>."""
    if len(parts) >= 4 and parts[-3:-1] == ("sparse", "manhattan"):
        return parts[-4], parts[-1]
    return None


def _colmap_sparse(parts: tuple[str, ...]) -> SceneAndComponent | None:
    """Automatic reconstructor in a sub-folder: <scene>/colmap/sparse/<component>, <scene>/colmap/sparse."""
    if len(parts) >= 4 and parts[-3:-1] == ("colmap", "sparse"):
        return parts[-4], parts[-1]
    if len(parts) >= 3 and parts[-2:] == ("colmap", "sparse"):
        return parts[-3], _BARE_COMPONENT
    return None


def _dense_sparse(parts: tuple[str, ...]) -> SceneAndComponent | None:
    """Undistorted, phototourism: <scene>/dense/sparse; automatic reconstructor: <scene>/dense/<k>/sparse."""
    if len(parts) >= 3 and parts[-2:] == ("dense", "sparse"):
        return parts[-3], _BARE_COMPONENT
    if len(parts) >= 4 and parts[-3] == "dense" and parts[-1] == "sparse" and parts[-2].isdigit():
        return parts[-4], parts[-2]
    return None


def _sparse(parts: tuple[str, ...]) -> SceneAndComponent | None:
    """COLMAP: <scene>/sparse/<component>, <scene>/sparse."""
    if len(parts) >= 3 and parts[-2] == "sparse":
        return parts[-3], parts[-1]
    if len(parts) >= 2 and parts[-1] == "sparse":
        return parts[-2], _BARE_COMPONENT
    return None


def _bare(parts: tuple[str, ...]) -> SceneAndComponent | None:
    """A model folder of any other name is a scene of its own."""
    return (parts[-1], _BARE_COMPONENT) if parts else None


LAYOUTS: Final[tuple[Layout, ...]] = (_manhattan, _colmap_sparse, _dense_sparse, _sparse, _bare)
"""Asked in this order; the first that knows the folder's names decides."""


def discover(paths: Sequence[str | Path]) -> Discovery:
    """Find all models at and below ``paths``.

    A folder that holds any of COLMAP's model files counts as a model, so that a broken one is reported when it is
    opened instead of vanishing; nothing below it is searched. Hidden folders are skipped, links are followed, loops
    are not. A model that several paths lead to is named once, after the first of them.

    Parameters
    ----------
    paths : model folders, their parents, or data set roots

    Returns
    -------
    Discovery
        The models in a fixed order. A path that does not exist, cannot be searched or holds no model becomes an
        entry of ``errors`` and does not hide the others.
    """
    refs: dict[str, ModelRef] = {}
    errors: list[LoadError] = []
    for path in paths:
        found, problems = _models_below(path)
        errors += problems
        for ref in found:
            refs.setdefault(ref.location, ref)
    order = sorted(refs.values(), key=lambda ref: (ref.dataset, ref.scene, ref.component, ref.location))
    return Discovery(tuple(order), tuple(errors))


def _models_below(given: str | Path) -> tuple[list[ModelRef], list[LoadError]]:
    root = Path(given)
    if not root.exists():
        return [], [MissingFileError(str(given), None, "a folder", "nothing", "check the path")]
    if not root.is_dir():
        advice = "name the folder that holds the model"
        return [], [UnreadableFileError(str(given), None, "a folder", "a file", advice)]
    parts = _named_parts(root)
    dataset = parts[-1] if parts else str(root)
    folders, errors = _model_folders(root)
    refs = []
    for below in folders:
        scene, component = scene_and_component(parts + below)
        model_path = os.path.join(given, *below)  # noqa: PTH118 - Path would drop a leading "./"
        refs.append(ModelRef(dataset, scene, component, os.path.realpath(model_path), model_path))
    if not refs and not errors:
        wanted, got = "a model folder at or below it", "no cameras, images or points3D file"
        errors.append(MissingFileError(str(given), None, wanted, got, "name a folder that holds COLMAP models"))
    return refs, errors


def _named_parts(root: Path) -> tuple[str, ...]:
    """Return the names that lead to ``root`` from the file system's root: as typed, "." and ".." resolved."""
    return Path(os.path.abspath(root)).parts[1:]  # noqa: PTH100 - resolve() would replace a link by what it names


def scene_and_component(parts: tuple[str, ...]) -> SceneAndComponent:
    """Return what the model in the folder with these path parts is called."""
    named = (layout(parts) for layout in LAYOUTS)
    return next((names for names in named if names), ("", _BARE_COMPONENT))


def _model_folders(root: Path) -> tuple[list[tuple[str, ...]], list[LoadError]]:
    """Return the model folders at and below ``root``, as parts of the path below it, and what cannot be searched."""
    found: list[tuple[str, ...]] = []
    errors: list[LoadError] = []
    visited: set[str] = set()

    def note(error: OSError) -> None:
        got = error.strerror or type(error).__name__
        errors.append(UnreadableFileError(str(error.filename), None, "a readable folder", got, "check its permissions"))

    for folder, folders, files in os.walk(root, followlinks=True, onerror=note):
        real = os.path.realpath(folder)
        is_model = not _MODEL_FILES.isdisjoint(files) or not _MODEL_FILES.isdisjoint(folders)
        if is_model and real not in visited:
            found.append(Path(folder).relative_to(root).parts)
        is_searched = not is_model and real not in visited
        folders[:] = sorted(name for name in folders if is_searched and not name.startswith("."))
        visited.add(real)
    return found, errors
