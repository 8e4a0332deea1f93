"""Image-matching benchmarks on MegaDepth: the scene_info files of LoFTR, D2-Net and glue-factory.

Two containers: a raw pickle of a dict (LoFTR's, called .npz in spite of that), and a real .npz (D2-Net's). Two ways to
name pairs: ``pair_infos``, a list of (pair, overlap, central matches), and ``overlap_matrix``, -1 where no pair is.
Both may hold pickled objects, so nothing here is read by numpy's or Python's own unpickler.
"""

from __future__ import annotations

import re
import struct
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, Final, Literal

import numpy as np
import numpy.typing as npt

from sfm_audit.loaders.errors import MalformedFileError
from sfm_audit.loaders.paths.files import open_input, reading
from sfm_audit.loaders.scene_info.inert_pickle import (
    NEW_CORE,
    OLD_CORE,
    InertPickle,
    array_from_bytes,
    dtype_of_code,
    load_inert,
)
from sfm_audit.loaders.scene_info.pickle_walk import RefusedPickleError

Array = npt.NDArray[Any]
PER_IMAGE: Final = ("image_paths", "depth_paths", "intrinsics", "poses", "fact_x", "fact_y")
MATRICES: Final = ("overlap_matrix", "scale_ratio_matrix")

_SUFFIX: Final = ".npy"
_ZIP_MAGIC: Final = b"PK\x03\x04"
_MAX_PICKLE_BYTES: Final = 4 * 2**30  # a pickle is read as a whole; those of MegaDepth have some 100 MB
_EXPANSION: Final = (64 << 20, 64)  # bytes of all members once decompressed: this much, and so many times the file
_NPY_LENGTHS: Final = {b"\x93NUMPY\x01\x00": "<H", b"\x93NUMPY\x02\x00": "<I"}
_NPY_HEADER: Final = re.compile(
    rb"\{'descr': '([^'\\]{1,20})', 'fortran_order': (True|False), "
    rb"'shape': \(((?:[0-9]{1,18}L?(?:, [0-9]{1,18}L?)*,?)?)\), \}[ \n]*"
)
_MAX_HEADER: Final = 4096
_FETCH: Final = "fetch the file again from a source that you trust"


@dataclass(frozen=True, slots=True)
class NpzMember:
    """One member of a .npz: its entry in the archive, its bytes, and the protocol and package names of its pickle."""

    entry: zipfile.ZipInfo
    content: bytes
    protocol: int = 4
    numpy_core: str = OLD_CORE


@dataclass(frozen=True, slots=True, eq=False)
class SceneInfo:
    """A scene_info file.

    container : "pickle" or "npz".
    values : everything in a pickle; of a .npz what says which images and pairs there are.
    image_paths, depth_paths : one per image, None where the file has none; index = the one that pairs use.
    pairs : (P, 2) indices of ``pair_infos``, or None where the file names its pairs by ``overlap_matrix``.
    members : the files of a .npz by name, in their order.        protocol, numpy_core : how the pickle was written.
    """

    container: Literal["pickle", "npz"]
    values: Mapping[str, Any]
    image_paths: tuple[str | None, ...]
    depth_paths: tuple[str | None, ...]
    pairs: npt.NDArray[np.int64] | None
    members: Mapping[str, NpzMember] = field(default_factory=dict)
    protocol: int = 4
    numpy_core: str = OLD_CORE


def read_scene_info(path: str | Path) -> SceneInfo:
    """Read a scene_info file; nothing in it is executed.

    Raises
    ------
    LoadError
        The file cannot be read, is not a scene_info file, or asks for code to be run; the message names that code.
    """
    file, num_bytes = open_input(Path(path))
    try:
        with file, reading(Path(path)):
            if file.peek(len(_ZIP_MAGIC)).startswith(_ZIP_MAGIC):
                members, values = _read_npz(file, num_bytes)
                return _scene_info("npz", values, members=members)
            _check_pickle_size(num_bytes)
            inert = load_inert(file.read())
        return _scene_info("pickle", inert.value, protocol=inert.protocol, numpy_core=inert.numpy_core)
    except RefusedPickleError as error:
        wanted = "a scene_info file of numpy arrays and builtin containers"
        raise MalformedFileError(str(path), None, wanted, str(error), f"nothing in it was run; {_FETCH}") from error
    except _NotSceneInfoError as error:
        wanted = "LoFTR's or D2-Net's scene_info"
        advice = "name a scene_info file of MegaDepth"
        raise MalformedFileError(str(path), None, wanted, str(error), advice) from error


def _check_pickle_size(num_bytes: int) -> None:
    if num_bytes > _MAX_PICKLE_BYTES:
        raise RefusedPickleError(f"a pickle of {num_bytes} bytes, more than {_MAX_PICKLE_BYTES}")


class _NotSceneInfoError(Exception):
    """The content is harmless, and not that of a scene_info file."""


def _scene_info(container: Literal["pickle", "npz"], values: Any, **how: Any) -> SceneInfo:
    """Check what the filter will rely on: one entry per image in every table, indices that exist."""
    if type(values) is not dict or not all(type(name) is str for name in values):
        raise _NotSceneInfoError(f"a {type(values).__name__} and no dict by names")
    if "image_paths" not in values or not {"pair_infos", "overlap_matrix"} & values.keys():
        names = ", ".join(sorted(repr(name) for name in values)[:8])
        raise _NotSceneInfoError(f"no image_paths with pair_infos or overlap_matrix, only {names or 'nothing'}")
    image_paths = _paths("image_paths", values["image_paths"])
    num_images = len(image_paths)
    depth_paths = _paths("depth_paths", values.get("depth_paths", [None] * num_images))
    for name in PER_IMAGE:
        if name in values and _length(values[name]) != num_images:
            raise _NotSceneInfoError(f"{name} of another length than image_paths ({num_images})")
    for name in MATRICES:
        if name in values:
            _check_matrix(name, values[name], num_images)
    pairs = _pairs(values["pair_infos"], num_images) if "pair_infos" in values else None
    return SceneInfo(container, values, image_paths, depth_paths, pairs, **how)


def _length(value: Any) -> int | None:
    if type(value) in {list, tuple}:
        return len(value)
    return len(value) if isinstance(value, np.ndarray) and value.ndim else None


def _paths(name: str, value: Any) -> tuple[str | None, ...]:
    if _length(value) is None:
        raise _NotSceneInfoError(f"{name} that is no list of paths")
    items = value.tolist() if isinstance(value, np.ndarray) else value
    out = []
    for item in items:
        if item is not None and not isinstance(item, str):
            raise _NotSceneInfoError(f"{name} with an entry that is no path")
        out.append(None if item is None else str(item))
    return tuple(out)


def _check_matrix(name: str, value: Any, num_images: int) -> None:
    is_matrix = isinstance(value, np.ndarray) and value.shape == (num_images, num_images) and value.dtype.kind == "f"
    if not is_matrix:
        raise _NotSceneInfoError(f"{name} that is no floating-point matrix of {num_images} x {num_images}")


def _pairs(pair_infos: Any, num_images: int) -> npt.NDArray[np.int64]:
    """Return (P, 2) indices of images."""
    if _length(pair_infos) is None:
        raise _NotSceneInfoError("pair_infos that is no list")
    out = np.empty((len(pair_infos), 2), dtype=np.int64)
    for position, info in enumerate(pair_infos):
        pair: Any = info[0] if _length(info) else None
        indices: Any = pair.tolist() if isinstance(pair, np.ndarray) else pair
        is_pair = type(indices) in {list, tuple} and len(indices) == 2
        if not is_pair or not all(isinstance(index, (int, np.integer)) for index in indices):
            raise _NotSceneInfoError(f"pair_infos whose entry {position} does not begin with two indices")
        if not all(0 <= index < num_images for index in indices):
            raise _NotSceneInfoError(f"pair_infos whose entry {position} names none of the {num_images} images")
        out[position] = indices
    return out


def _read_npz(file: BinaryIO, num_bytes: int) -> tuple[dict[str, NpzMember], dict[str, Any]]:
    """Return the members of a .npz, and the values of those that say which images and pairs there are.

    Every member with objects is read, so that none is copied that would run code in the programs that load it.
    """
    members: dict[str, NpzMember] = {}
    values: dict[str, Any] = {}
    try:
        with zipfile.ZipFile(file) as archive:
            expanded = sum(entry.file_size for entry in archive.infolist())
            most = _EXPANSION[0] + _EXPANSION[1] * num_bytes
            if expanded > most:
                raise RefusedPickleError(f"an archive of {num_bytes} bytes that holds {expanded}, more than {most}")
            for entry in archive.infolist():
                name = entry.filename.removesuffix(_SUFFIX)
                if name in members or not entry.filename.endswith(_SUFFIX):
                    raise RefusedPickleError(f"an archive with {entry.filename!r} in it, twice or no array")
                content = archive.read(entry)
                value, inert = _read_npy(content)
                members[name] = NpzMember(entry, content)
                if inert:
                    members[name] = NpzMember(entry, content, inert.protocol, inert.numpy_core)
                if name in {*PER_IMAGE, *MATRICES, "pair_infos"}:
                    values[name] = value
    except (
        *(zipfile.BadZipFile, zlib.error, EOFError),
        *(ValueError, NotImplementedError, RuntimeError, MemoryError, OverflowError),  # sizes that the file makes up
    ) as error:
        raise RefusedPickleError(f"a damaged archive ({' '.join(str(error).split())[:120]})") from error
    return members, values


def _read_npy(content: bytes) -> tuple[Array, InertPickle | None]:
    """Return the array of a .npy file, and how its pickle was written where it holds objects."""
    shape, order, dtype, start = _npy_header(content)
    if not dtype.hasobject:
        return array_from_bytes(memoryview(content)[start:], dtype, shape, order), None
    inert = load_inert(content[start:])
    array = inert.value
    if not isinstance(array, np.ndarray) or array.dtype != object or array.shape != shape:
        raise RefusedPickleError("an array of objects that is none, or has another shape than its header says")
    return array, inert


def _npy_header(content: bytes) -> tuple[tuple[int, ...], str, np.dtype[Any], int]:
    """Return shape, order, dtype and the first byte of the content; numpy's own reader would evaluate an expression."""
    layout = _NPY_LENGTHS.get(content[:8])
    if layout is None:
        raise RefusedPickleError(f"an array that begins with {content[:8]!r}, no .npy of version 1 or 2")
    at = 8 + struct.calcsize(layout)
    length = struct.unpack(layout, content[8:at])[0] if len(content) >= at else 0
    match = _NPY_HEADER.fullmatch(content[at : at + length]) if length <= _MAX_HEADER else None
    if match is None:
        raise RefusedPickleError("an array with a header that numpy does not write")
    sides = match[3].replace(b"L", b"").split(b",")
    shape = tuple(int(side) for side in sides if side.strip())
    return shape, "F" if match[2] == b"True" else "C", dtype_of_code(match[1].decode("latin1")), at + length


__all__ = [
    "MATRICES",
    "NEW_CORE",
    "OLD_CORE",
    "PER_IMAGE",
    "NpzMember",
    "SceneInfo",
    "read_scene_info",
]
