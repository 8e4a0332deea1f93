"""The filtered benchmark: a scene_info file without the pairs of rejected images, otherwise as it was.

Indices of images hold. ``pair_infos`` (LoFTR) loses entries and nothing else changes. In files with an
``overlap_matrix`` (D2-Net, glue-factory) a removed image becomes what the format's own script makes of an absent one:
-1 in its row and column of the matrices, None for its paths, intrinsics and pose. The -1 alone would not do:
glue-factory draws negative pairs from whatever has a path and no overlap.
"""

from __future__ import annotations

import copy
import io
import pickle
import zipfile
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import PurePosixPath
from typing import Any, Final

import numpy as np

from sfm_audit.loaders.arrays import BoolArray
from sfm_audit.loaders.scene_info.file import MATRICES, NEW_CORE, PER_IMAGE, SceneInfo
from sfm_audit.reports.export.selection import COLUMNS, AuditedImage, Keep, csv_text

_ABSENT: Final = -1.0
_MIN_PROTOCOL: Final = 2
Value = Any


class Match(StrEnum):
    """What the run says of an image of the file. Unknown and ambiguous ones are kept, and said to be."""

    KEPT = "kept"
    REMOVED = "removed"
    UNKNOWN = "kept_unknown"
    AMBIGUOUS = "kept_ambiguous"


@dataclass(frozen=True, slots=True)
class MatchedImage:
    """An image of the file: its index and path, and the images of the run that it may be."""

    index: int
    path: str
    match: Match
    images: tuple[AuditedImage, ...]


@dataclass(frozen=True, slots=True, eq=False)
class FilteredSceneInfo:
    """What is left: the values that changed by name, and how many pairs there were and are."""

    changed: Mapping[str, Value]
    num_pairs_before: int
    num_pairs: int


def match_images(info: SceneInfo, images: Sequence[AuditedImage], keep: Keep) -> tuple[MatchedImage, ...]:
    """Find the images of the file in the run.

    An image is looked for in the scene whose name is a folder of its path (``Undistorted_SfM/0022/images/a.jpg``: scene
    0022), by its name: the file's name, with its folders as far as run and path both give them. Where no path names a
    scene of the run and the run has only one, that one is meant. Of several components, the one that the depth path
    names (``0022/dense0/depths``) decides; images that still cannot be told apart are ambiguous if their verdicts
    differ in whether they stay.
    """
    by_name: dict[str, list[AuditedImage]] = defaultdict(list)
    for image in images:
        by_name[_parts(image.image_name)[-1]].append(image)
    scenes = {image.scene for image in images}
    is_named = any(not scenes.isdisjoint(_parts(path)) for path in info.image_paths if path)
    out = []
    for index, path in enumerate(info.image_paths):
        if path is None:
            continue
        found = [
            image
            for image in by_name[_parts(path)[-1]]
            if (image.scene in _parts(path) if is_named else len(scenes) == 1) and _same_tail(path, image.image_name)
        ]
        found = _of_component(found, info.depth_paths[index])
        decisions = {image.is_kept(keep) for image in found}
        match = {0: Match.UNKNOWN, 2: Match.AMBIGUOUS}.get(len(decisions))
        match = match or (Match.KEPT if True in decisions else Match.REMOVED)
        out.append(MatchedImage(index, path, match, tuple(found)))
    return tuple(out)


def _parts(path: str) -> tuple[str, ...]:
    return PurePosixPath(path.replace("\\", "/")).parts or ("",)


def _same_tail(path: str, image_name: str) -> bool:
    """Whether the folders that both give are the same, from the file's name backwards."""
    return all(one == other for one, other in zip(reversed(_parts(path)), reversed(_parts(image_name)), strict=False))


def _of_component(found: list[AuditedImage], depth_path: str | None) -> list[AuditedImage]:
    if len(found) < 2 or depth_path is None:
        return found
    folders = set(_parts(depth_path))
    return [image for image in found if f"dense{image.component}" in folders] or found


def drop_images(info: SceneInfo, is_removed: BoolArray) -> FilteredSceneInfo:
    """Remove the pairs of some images.

    Parameters
    ----------
    info : the file
    is_removed : (n,) per entry of ``image_paths``

    Returns
    -------
    FilteredSceneInfo
        New values; nothing of ``info`` is edited.
    """
    if not is_removed.any():
        return FilteredSceneInfo({}, *(2 * [_num_pairs(info.values, info)]))
    changed: dict[str, Value] = {}
    if info.pairs is not None:
        stays = np.logical_not(is_removed[info.pairs].any(axis=1)).astype(np.bool_)
        old = info.values["pair_infos"]
        if isinstance(old, np.ndarray):
            changed["pair_infos"] = old[stays]
        else:
            changed["pair_infos"] = type(old)(
                item for item, is_kept in zip(old, stays.tolist(), strict=True) if is_kept
            )
    if "overlap_matrix" in info.values:
        for name in MATRICES:
            if name in info.values:
                matrix = info.values[name].copy()
                matrix[is_removed] = matrix[:, is_removed] = _ABSENT
                changed[name] = matrix
        for name in PER_IMAGE:
            if name in info.values:
                changed[name] = _without(info.values[name], is_removed)
    before, after = _num_pairs(info.values, info), _num_pairs({**info.values, **changed}, info)
    return FilteredSceneInfo(changed, before, after)


def _without(values: Value, is_removed: BoolArray) -> Value:
    """Return one entry per image with None for some; an array of numbers becomes one of objects, as with any None."""
    if not isinstance(values, np.ndarray):
        return type(values)(None if gone else value for value, gone in zip(values, is_removed, strict=True))
    if values.dtype == object and values.ndim == 1:
        out = values.copy()
    else:
        out = np.empty(len(values), dtype=object)
        for index, value in enumerate(values):
            out[index] = str(value) if isinstance(value, str) else value
    out[is_removed] = None
    return out


def _num_pairs(values: Mapping[str, Value], info: SceneInfo) -> int:
    """Count pairs: entries of ``pair_infos``, or pairs of images that overlap."""
    if info.pairs is not None:
        return len(values["pair_infos"])
    overlaps = values["overlap_matrix"] > 0
    return int(np.count_nonzero(np.triu(overlaps | overlaps.T, 1)))


def scene_info_bytes(info: SceneInfo, filtered: FilteredSceneInfo) -> bytes:
    """Return the file with the changed values in it: the same container, order, protocol and compression.

    Pickles name numpy's functions as the file did, so that whatever could read it can read the result.
    """
    if info.container == "pickle":
        values = {name: filtered.changed.get(name, value) for name, value in info.values.items()}
        return _pickled(values, info.protocol, info.numpy_core)
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for name, member in info.members.items():
            content = member.content
            if name in filtered.changed:
                content = _npy_bytes(filtered.changed[name], member.protocol, member.numpy_core)
            entry = copy.copy(member.entry)
            archive.writestr(entry, content, compress_type=entry.compress_type)
    return out.getvalue()


def _npy_bytes(array: np.ndarray, protocol: int, numpy_core: str) -> bytes:
    out = io.BytesIO()
    if array.dtype.hasobject:
        header = {"descr": "|O", "fortran_order": False, "shape": array.shape}
        np.lib.format.write_array_header_1_0(out, header)
        out.write(_pickled(array, protocol, numpy_core))
    else:
        np.lib.format.write_array(out, array, allow_pickle=False)
    return out.getvalue()


def _pickled(value: Value, protocol: int, numpy_core: str) -> bytes:
    out = io.BytesIO()
    _Pickler(out, max(protocol, _MIN_PROTOCOL), numpy_core).dump(value)
    return out.getvalue()


class _Pickler(pickle._Pickler):  # noqa: SLF001 - Python's, because C's looks up the names of globals by itself
    """Writes numpy's globals under the package name that a file used: NumPy 1 does not know ``numpy._core``."""

    save: Callable[[object], None]
    write: Callable[[bytes], object]
    memoize: Callable[[object], None]

    def __init__(self, file: io.BytesIO, protocol: int, numpy_core: str) -> None:
        super().__init__(file, protocol)
        self._protocol = protocol
        self._numpy_core = numpy_core

    def save_global(self, obj: Any, name: str | None = None) -> None:
        """Write one global; only numpy's four and those that builtin containers need get here."""
        package = str(obj.__module__)
        if package.startswith(f"{NEW_CORE}."):
            package = self._numpy_core + package.removeprefix(NEW_CORE)
        qualified = name or str(obj.__qualname__)
        if self._protocol >= 4:
            self.save(package)
            self.save(qualified)
            self.write(pickle.STACK_GLOBAL)
        else:
            self.write(pickle.GLOBAL + f"{package}\n{qualified}\n".encode())
        self.memoize(obj)


def removed_table(matched: Iterable[MatchedImage]) -> str:
    """Return a CSV table of the file's images that are not simply kept, with what the run says of them."""
    columns = ("action", "index", "image_path", *COLUMNS)
    rows: list[dict[str, object]] = []
    for item in matched:
        if item.match is Match.KEPT:
            continue
        own: dict[str, object] = {"action": item.match.value, "index": item.index, "image_path": item.path}
        said = [{**{name: getattr(i, name) for name in COLUMNS}, "reasons": "; ".join(i.reasons)} for i in item.images]
        rows += [{**own, **about} for about in said or [{}]]
    return csv_text(rows, columns)
