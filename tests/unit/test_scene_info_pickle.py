"""Pickles from strangers: what is allowed comes out as Python's own unpickler has it, what runs code did not run."""

import builtins
import collections
import copyreg
import io
import os
import pickle
import struct
import zipfile
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import numpy._core.multiarray as numpy_multiarray
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from sfm_audit.loaders import LoadError
from sfm_audit.loaders.scene_info.file import read_scene_info
from sfm_audit.loaders.scene_info.inert_pickle import load_inert
from sfm_audit.loaders.scene_info.pickle_walk import RefusedPickleError

PROTOCOLS = range(pickle.HIGHEST_PROTOCOL + 1)


class Calls:
    """Pickles as a call of anything."""

    def __init__(self, function, *args: Any, state=None) -> None:
        self.reduced = (function, args) if state is None else (function, args, state)

    def __reduce__(self) -> tuple:
        return self.reduced


def assert_same(one, other):
    assert type(one) is type(other)
    if isinstance(one, np.ndarray):
        assert (one.dtype, one.shape) == (other.dtype, other.shape)
        if one.dtype == object:
            for a, b in zip(one.ravel().tolist(), other.ravel().tolist(), strict=True):
                assert_same(a, b)
        else:
            np.testing.assert_array_equal(one, other)
    elif isinstance(one, (list, tuple)):
        assert len(one) == len(other)
        for a, b in zip(one, other, strict=True):
            assert_same(a, b)
    elif isinstance(one, dict):
        assert list(one) == list(other)
        for key in one:
            assert_same(one[key], other[key])
    else:
        assert one == other or one != one  # noqa: PLR0124 - NaN


def objects(*items: Any):
    out = np.empty(len(items), dtype=object)
    for index, item in enumerate(items):
        out[index] = item
    return out


SAMPLES = [
    {"a": [1, 2.5, None, True, "x\ny", b"\x00\xff", 10**30, (), {}, [], set(), frozenset({1}), {2, 3}]},
    np.arange(12.0).reshape(3, 4),
    np.asfortranarray(np.arange(12, dtype=">i2").reshape(3, 4)),
    np.array(3.5),
    np.zeros((0, 3)),
    np.array(["a", "längere", ""]),
    np.array([b"a", b"bc"]),
    np.array([True, False]),
    np.array([1 + 2j]),
    objects(None, "p", np.eye(3), [np.arange(2)], {"k": np.float32(2)}),
    objects(*([None] * 4)).reshape(2, 2),
    [np.float64(0.5), np.int32(-3), np.bool_(True), np.str_("s"), np.uint8(200)],
    [(np.array([3, 4]), np.float64(0.3), np.ones(4, np.float32))] * 3,
]


@pytest.mark.parametrize("protocol", PROTOCOLS)
@pytest.mark.parametrize("value", SAMPLES)
def test_what_is_allowed_comes_out_as_it_went_in(value, protocol):
    data = pickle.dumps(value, protocol)
    inert = load_inert(data)
    assert_same(inert.value, value)
    assert inert.protocol == (protocol if protocol >= 2 else 0)
    if b"numpy._core" in data:
        assert inert.numpy_core == "numpy._core"


@given(
    hnp.arrays(st.sampled_from(["<f8", ">f4", "<i8", "|u1", "?", "<U3", "|S2", "<c8"]), hnp.array_shapes(min_side=0))
)
def test_any_array_comes_out(array):
    for protocol in (2, 4, 5):
        for one in (array, np.asfortranarray(array), array.T):
            assert_same(load_inert(pickle.dumps(one, protocol)).value, one)


def test_one_array_in_two_places_stays_one():
    array = np.arange(3)
    value = load_inert(pickle.dumps([array, array])).value
    assert value[0] is value[1]
    value[0][0] = 7


def harmful(tmp_path):
    """Return pickles that would leave a file behind, or change this process, in Python's own unpickler."""
    mark = tmp_path / "ran"
    touch = f"touch {mark}"
    write = f"open({str(mark)!r}, 'w')"
    array_of = Calls(numpy_multiarray._reconstruct, np.ndarray, (0,), b"b")
    array_of.reduced += ((1, (1,), np.dtype("O"), False, [Calls(os.system, touch)]),)
    state = {"k": Calls(os.system, touch)}
    return mark, {
        "os.system": pickle.dumps(Calls(os.system, touch)),
        "os.system, protocol 0": pickle.dumps(Calls(os.system, touch), 0),
        "os.system in an INST": b"(S" + repr(touch).encode() + b"\nios\nsystem\n.",
        "os.system in an OBJ": b"(cos\nsystem\nS" + repr(touch).encode() + b"\no.",
        "eval": pickle.dumps(Calls(builtins.eval, write)),
        "exec": pickle.dumps(Calls(builtins.exec, write)),
        "getattr": pickle.dumps(Calls(builtins.getattr, Calls(builtins.__import__, "os"), "system")),
        "open": pickle.dumps(Calls(builtins.open, str(mark), "w")),
        "in a list in a dict": pickle.dumps({"pair_infos": [(1, [Calls(os.system, touch)])]}),
        "in an object array": pickle.dumps(objects(None, Calls(os.system, touch))),
        "in an array in an object array": pickle.dumps(objects(objects(Calls(os.system, touch)))),
        "in the state of an array": pickle.dumps(array_of),
        "as a key": pickle.dumps({Calls(os.system, touch): 1}),
        "in a state of a dtype": pickle.dumps(Calls(np.dtype, "f8", False, True, state=(3, "<", None, None, state))),
        "copyreg._reconstructor": pickle.dumps(Calls(copyreg._reconstructor, type(mark), object, None)),
        "copyreg.add_extension": pickle.dumps(Calls(copyreg.add_extension, "os", "system", 77)),
        "copyreg.__newobj__": b"ccopyreg\n__newobj__\n(cos\n_wrap_close\nt(N.",
        "numpy.load": pickle.dumps(Calls(np.load, str(mark), None, True)),
        "numpy.fromfile": pickle.dumps(Calls(np.fromfile, "/etc/hostname", "u1")),
        "numpy.save": pickle.dumps(Calls(np.save, str(mark), 1)),
        "functools.partial": b"cfunctools\npartial\n(cos\nsystem\nS" + repr(touch).encode() + b"\ntR.",
        "operator.attrgetter": b"coperator\nattrgetter\n(S'system'\ntR.",
        "dotted through an allowed module": b"\x80\x04\x8c\x05numpy\x8c\x12ndarray.__class__.x\x93.",
        "numpy's os": b"\x80\x04\x8c\x05numpy\x8c\x0cf2py.os.name\x93.",
        "an ndarray subclass": pickle.dumps(np.ma.masked_array([1], [0])),
        "a record array": pickle.dumps(np.rec.array([(1,)], dtype=[("x", "i4")])),
        "collections.OrderedDict": pickle.dumps(collections.OrderedDict(a=1)),
    }


KINDS = sorted(harmful(Path("/nowhere"))[1])


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("container", ["pickle", "npz", "npz, member that is only copied"])
def test_a_pickle_that_runs_code_is_refused_and_did_not_run(kind, container, tmp_path):
    mark, pickles = harmful(tmp_path)
    data = pickles[kind]
    if container == "pickle":
        (tmp_path / "s.npz").write_bytes(data)
    else:
        member = "image_paths" if container == "npz" else "points3D_id_to_2D"
        with zipfile.ZipFile(tmp_path / "s.npz", "w") as archive:
            header = io.BytesIO()
            np.lib.format.write_array_header_1_0(header, {"descr": "|O", "fortran_order": False, "shape": (1,)})
            archive.writestr(f"{member}.npy", header.getvalue() + data)
    before = dict(copyreg._extension_registry)
    with pytest.raises(LoadError) as caught:
        read_scene_info(tmp_path / "s.npz")
    assert not mark.exists()
    assert copyreg._extension_registry == before
    assert "\n" not in str(caught.value)
    assert "nothing in it was run" in str(caught.value)


@pytest.mark.parametrize(
    ("kind", "name"),
    [("os.system", "posix.system"), ("eval", "builtins.eval"), ("in an object array", "posix.system")],
)
def test_the_error_names_what_the_pickle_asks_for(kind, name, tmp_path):
    (tmp_path / "s.npz").write_bytes(harmful(tmp_path)[1][kind])
    with pytest.raises(LoadError, match=f"asks for '{name}'"):
        read_scene_info(tmp_path / "s.npz")


def test_extension_codes_and_persistent_ids_are_refused():
    copyreg.add_extension("os", "system", 0x77)
    try:
        with pytest.raises(RefusedPickleError, match=r"os\.system"):
            load_inert(b"\x80\x02\x82\x77U\x04true\x85R.")
    finally:
        copyreg.remove_extension("os", "system", 0x77)
    for data in (b"\x80\x02\x82\x77.", b"\x80\x02X\x01\x00\x00\x00aQ.", b"Pid\n."):
        with pytest.raises(RefusedPickleError):
            load_inert(data)


def raw_array(dtype_args, dtype_state, shape, content):
    """A pickle of an array whose dtype and content say what they like."""
    dtype = Calls(np.dtype, *dtype_args)
    dtype.reduced += (dtype_state,)
    array = Calls(numpy_multiarray._reconstruct, np.ndarray, (0,), b"b")
    array.reduced += ((1, shape, dtype, False, content),)

    return pickle.dumps(array, 4)


OBJECT_STATE = (3, "|", None, None, None, -1, -1, 63)


@pytest.mark.parametrize(
    ("dtype_args", "dtype_state", "shape", "content"),
    [
        pytest.param(
            ("O8", False, True),
            (3, "|", None, None, None, -1, -1, 0),
            (1,),
            struct.pack("<Q", 0x41414141),
            id="pointers",
        ),
        pytest.param(
            ("O8", False, True), OBJECT_STATE, (1,), struct.pack("<Q", 0x41414141), id="pointers, honest flags"
        ),
        pytest.param(
            ("V8", False, True),
            (3, "|", None, ("a",), {"a": (np.dtype("O"), 0)}, 8, 8, 0),
            (1,),
            b"A" * 8,
            id="pointers in a field",
        ),
        pytest.param(
            ("V8", False, True),
            (3, "|", None, ("a",), {"a": (np.dtype("f8"), 1 << 40)}, 8, 8, 0),
            (1,),
            b"A" * 8,
            id="field far outside",
        ),
        pytest.param(("f8", False, True), (3, "<", None, None, None, 1 << 40, 1, 0), (2,), b"A" * 8, id="too little"),
        pytest.param(("f8", False, True), (3, "<", None, None, None, -1, -1, 0), (1 << 61, 8), b"", id="overflow"),
        pytest.param(("f8", False, True), (3, "<", None, None, None, -1, -1, 0), (-1,), b"A" * 8, id="negative"),
        pytest.param(("O8", False, True), OBJECT_STATE, (5,), [1], id="fewer objects"),
        pytest.param(("U1", False, True), (3, "<", None, None, None, 4, 4, 8), (1,), b"\xff" * 4, id="no character"),
        pytest.param(("U0", False, True), (3, "<", None, None, None, 0, 4, 8), (1 << 50,), b"", id="empty texts"),
        pytest.param(
            ("M8", False, True), (4, "<", None, None, None, -1, -1, 0, ({}, (b"ns", 1, 1, 1))), (0,), b"", id="M8"
        ),
        pytest.param((Calls(np.dtype, "f8"), False, True), None, (1,), b"A" * 8, id="dtype of a dtype"),
    ],
)
def test_arrays_that_lie_about_themselves_are_refused(dtype_args, dtype_state, shape, content):
    with pytest.raises(RefusedPickleError):
        load_inert(raw_array(dtype_args, dtype_state, shape, content))


def test_stand_ins_cannot_be_changed_or_kept():
    state_of_function = b"\x80\x02cnumpy\ndtype\n}U\x08__code__K\x01sb."
    slots_of_function = b"\x80\x02cnumpy\ndtype\nN}U\x05_nameK\x01s\x86b."
    stored = b"\x80\x02cnumpy\nndarray\n."
    called = b"\x80\x02cnumpy\nndarray\nK\x01\x85R."
    made = b"\x80\x02cnumpy\nndarray\n)\x81."
    appended = b"\x80\x02cnumpy\nndarray\n(K\x01e."
    for data in (state_of_function, slots_of_function, stored, called, made, appended):
        with pytest.raises(RefusedPickleError):
            load_inert(data)
    assert_same(load_inert(pickle.dumps(np.arange(3))).value, np.arange(3))


def test_deep_and_circular_containers_are_refused():
    circle = []
    circle.append(circle)
    deep = b"]" * 100_000 + b"a" * 99_999 + b"."
    for data in (pickle.dumps(circle), deep):
        with pytest.raises(RefusedPickleError):
            load_inert(data)


def test_a_pickle_that_doubles_itself_costs_no_time():
    value = []
    for _ in range(40):
        value = [value, value]
    assert len(load_inert(pickle.dumps(value)).value) == 2


@given(st.data())
def test_damaged_pickles_are_refused_or_read_and_never_crash(data):
    content = bytearray(pickle.dumps(SAMPLES[9], 4))
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    cut = bytes(content[: data.draw(st.integers(0, len(content)))])
    with suppress(RefusedPickleError):
        load_inert(cut)
