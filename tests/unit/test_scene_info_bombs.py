"""Small pickles and archives that would take much time or memory: refused in one line, at once.

Nothing here is ever given to Python's own unpickler.
"""

import io
import os
import resource
import struct
import time
import zipfile
from pathlib import Path

import numpy as np
import pytest

from sfm_audit.loaders import LoadError
from sfm_audit.loaders.scene_info.file import read_scene_info
from sfm_audit.loaders.scene_info.inert_pickle import load_inert
from sfm_audit.loaders.scene_info.pickle_walk import RefusedPickleError, check_opcodes

P4 = b"\x80\x04"


def shared_tuples(depth: int) -> bytes:
    """t = (t, t), ``depth`` times, from memo entry 0 on."""
    return b"".join(b"h" + bytes([level]) + b"\x86\x94" for level in range(depth))


def text(content: bytes) -> bytes:
    return b"\x8c" + bytes([len(content)]) + content


def found_global(module: bytes, name: bytes) -> bytes:
    return text(module) + text(name) + b"\x93"


def one_array_named_often(count: int) -> bytes:
    content = b"\0" * 100_000
    dtype = found_global(b"numpy", b"dtype") + text(b"f8") + b"\x89\x88\x87R\x940"
    use = b"h\x01(h\x00h\x02J" + struct.pack("<i", 12_500) + b"\x85" + text(b"C") + b"tR"
    head = b"}B" + struct.pack("<I", len(content)) + content + b"\x940"
    return (
        P4
        + head
        + found_global(b"numpy.core.numeric", b"_frombuffer")
        + b"\x940"
        + dtype
        + b"("
        + text(b"a")
        + b"]("
        + use * count
        + b"eu."
    )


BOMBS = {
    "a memo entry": (P4 + b"Nr" + struct.pack("<I", 100_000_000) + b".", "memo entry 100000000"),
    "a key of shared tuples": (P4 + b"})\x94" + shared_tuples(40) + b"Ns.", "key that is too large"),
    "an item of shared tuples": (P4 + b"\x8f()\x94" + shared_tuples(40) + b"\x90.", "key that is too large"),
    "a frozen set of shared tuples": (P4 + b"()\x94" + shared_tuples(40) + b"\x91.", "key that is too large"),
    "a deep key": (P4 + b"})" + b"\x85" * 100_000 + b"Ns.", "key that is too large"),
    "keys that collide": (P4 + b"}\x8a\x10" + b"\x01" * 16 + b"Ns.", "key that is too large"),
    "deep lists": (P4 + b"]" * 1_000_000 + b"a" * 999_999 + b".", "MB of objects"),
    "many sets": (P4 + b"(" + b"\x8f" * 2_000_000 + b"l.", "MB of objects"),
    "bytes of 8 GB": (P4 + b"\x8e" + struct.pack("<Q", 8 << 30) + b"abc.", "more bytes than it has"),
    "bytes of 2^63": (P4 + b"\x8e" + struct.pack("<Q", 2**63 - 1) + b"abc.", "more bytes than it has"),
    "a bytearray of 8 GB": (b"\x80\x05\x96" + struct.pack("<Q", 8 << 30) + b"abc.", "more bytes than it has"),
    "a frame of 2^62": (P4 + b"\x95" + struct.pack("<Q", 2**62) + b"N.", "frame of more bytes"),
    "an integer of 1 MB": (P4 + b"\x8b" + struct.pack("<i", 1_000_000) + b"\x7f" * 1_000_000 + b".", "integer of"),
    "an integer of 5 million digits": (b"I" + b"9" * 5_000_000 + b"\n.", "number of 5000000 characters"),
    "a long of 5 million digits": (b"L" + b"9" * 5_000_000 + b"L\n.", "number of 5000001 characters"),
    "one array named 3000 times": (one_array_named_often(3000), "arrays take more memory"),
    "a stack that is empty": (P4 + b"a.", "do not fit together"),
    "a mark that is none": (P4 + b"t.", "do not fit together"),
    "a memo entry that is none": (P4 + b"h\x07.", "do not fit together"),
    "an end that is none": (P4 + b"N", "cut short"),
    "an opcode that is none": (P4 + b"\xff.", "opcode"),
}


@pytest.mark.parametrize("name", BOMBS)
def test_a_pickle_that_costs_more_than_its_size_allows_is_refused_at_once(name: str):
    data, why = BOMBS[name]
    start, peak = time.process_time(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(RefusedPickleError, match=why):
        load_inert(data)
    assert time.process_time() - start < 5.0
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - peak) * 1024
    assert grown < (64 << 20) + 16 * len(data)


def test_keys_that_are_names_pairs_and_small_integers_are_no_bombs():
    import pickle  # noqa: PLC0415 - to write, not to read

    value = {("a", 1, (2.5, None)): 1, "b": {1, 2, 3}, 2**63: frozenset({b"x", 2})}
    for protocol in range(6):
        assert load_inert(pickle.dumps(value, protocol)).value == value


def test_what_python_writes_passes_the_walk():
    import pickle  # noqa: PLC0415 - as above

    shared = [1, "two", 3.0, b"four", None, True, 2**80, -(2**40), ("five",), {"six": [7]}, "ü" * 300, b"x" * 300]
    value = [shared, shared, tuple(range(1000)), {str(i): i for i in range(3000)}, np.arange(5.0), np.float32(2.5)]
    for protocol in range(6):
        check_opcodes(pickle.dumps(value, protocol))


def npy(header: bytes, content: bytes = b"") -> bytes:
    return b"\x93NUMPY\x02\x00" + struct.pack("<I", len(header)) + header + content


def archive(path: Path, members: dict[str, bytes]) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as out:
        for name, content in members.items():
            out.writestr(name, content)
    return path


@pytest.mark.parametrize("head", [b"", b"\x80\x04"], ids=["zeros", "pickle"])
def test_a_file_of_200_gb_is_not_read(tmp_path: Path, head: bytes):
    path = tmp_path / "s.pickle"
    path.write_bytes(head)
    os.truncate(path, 200 * 2**30)
    with pytest.raises(LoadError, match="a pickle of 214748364800 bytes, more than"):
        read_scene_info(path)


def test_an_archive_that_grows_is_refused_before_it_does(tmp_path: Path):
    size = 256 << 20
    head = b"{'descr': '<f8', 'fortran_order': False, 'shape': (%d,), }" % (size // 8)
    path = archive(tmp_path / "bomb.npz", {"image_paths.npy": npy(head, b"\0" * size)})
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(LoadError, match=r"an archive of \d+ bytes that holds 26\d{7}, more than"):
        read_scene_info(path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - peak < 64 << 10


def test_an_archive_that_lies_about_its_size_is_refused(tmp_path: Path):
    path = archive(tmp_path / "lie.npz", {"image_paths.npy": npy(b"{'descr': '<f8', ", b"\0" * 1_000_000)})
    data = path.read_bytes()
    path.write_bytes(data.replace(struct.pack("<I", 1_000_000 + 29), struct.pack("<I", 10)))
    with pytest.raises(LoadError, match=r"archive|array"):
        read_scene_info(path)


@pytest.mark.parametrize(
    "header",
    [
        b"{'descr': '<f8', 'fortran_order': False, 'shape': (" + b"(" * 900 + b")" * 900 + b",), }",
        b"{'descr': '<f8', 'fortran_order': False, 'shape': (" + b"9" * 3000 + b",), }",
        b"{'descr': [('a', '<f8')], 'fortran_order': False, 'shape': (1,), }",
        b"{'descr': '|V8', 'fortran_order': False, 'shape': (1,), }",
        b"{'descr': '<f8', 'fortran_order': False, 'shape': (1,), 'x': __import__('os')}",
        b" " * 5000,
        b"",
    ],
)
def test_a_header_that_numpy_does_not_write_is_refused(tmp_path: Path, header: bytes):
    path = archive(tmp_path / "in.npz", {"image_paths.npy": npy(header)})
    with pytest.raises(LoadError, match="array"):
        read_scene_info(path)


def test_headers_that_numpy_writes_are_read(tmp_path: Path):
    arrays = {
        "image_paths": np.array(["a", "bc"]),
        "overlap_matrix": np.asfortranarray(np.eye(2)),
        "zero": np.float32(1.0),
        "big": np.arange(6, dtype=">i2").reshape(1, 2, 3),
        "empty": np.zeros((0, 4)),
    }
    for save in (np.savez, np.savez_compressed):
        sink = io.BytesIO()
        save(sink, **arrays)
        (tmp_path / "in.npz").write_bytes(sink.getvalue())
        found = read_scene_info(tmp_path / "in.npz")
        assert found.image_paths == ("a", "bc")
        assert (found.values["overlap_matrix"] == np.eye(2)).all()
        assert set(found.members) == set(arrays)
