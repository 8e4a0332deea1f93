"""What is done to a sound input: changes of bytes, tokens and fields, in a list that can be written and shortened."""

from __future__ import annotations

import dataclasses
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from sfm_audit.loaders.camera_models import BY_ID

EXTREME: Final = (
    *(0.0, -0.0, 1.0, -1.0, 1e-320, 1e-310, 1e-300, 1e-160, 1e-30, 1e-12, 1e9, -1e9, 1e10, 1e12, 1e19, 1e30, 1e60),
    *(1e100, 1e154, 1e155, 1e200, 1e308, -1e308, float("inf"), float("-inf"), float("nan"), 2.0**53, 2.0**64),
)
"""Values of a number of 8 bytes."""

WHOLE: Final = (0, 1, 2, 3, 127, 255, 2**15, 2**31 - 1, 2**31, 2**32 - 1, 2**32, 2**53, 2**63 - 1, 2**63, 2**64 - 1)
TOKENS: Final = (
    *(b"", b"0", b"-0", b"-1", b"1", b"nan", b"inf", b"-inf", b"1e400", b"1e-320", b"1e308", b"0x10", b"1_0", b"1.0"),
    *(b"4294967295", b"4294967296", b"9223372036854775808", b"18446744073709551615", b"99999999999999999999999"),
    *(b"\xd9\xa1", b"\xef\xbc\x91", b"#", b",", b"\t", b"\r", b"\xff", b"\0", b"CAMERA", b"9" * 5000),
)


@dataclass(frozen=True, slots=True)
class Edit:
    """One change. what: a key of `APPLY`, or ``field``; file: which file, or path of the field; value: as text."""

    what: str
    file: str
    at: int = 0
    value: str = ""


def applied(edits: Sequence[Edit], files: dict[str, bytes]) -> dict[str, bytes]:
    """Return the files after all edits of bytes and tokens; an edit that no longer fits changes nothing."""
    out = dict(files)
    for edit in edits:
        if edit.what != "field" and edit.file in out:
            out[edit.file] = _edited(edit, out[edit.file])
    return out


def _edited(edit: Edit, data: bytes) -> bytes:
    return APPLY[edit.what](data, min(edit.at, len(data)), edit.value)


def _flip(data: bytes, at: int, value: str) -> bytes:
    changed = bytearray(data)
    if at < len(changed):
        changed[at] ^= 1 << int(value)
    return bytes(changed)


def _put(data: bytes, at: int, value: str) -> bytes:
    new = bytes.fromhex(value)
    return data[:at] + new[: len(data) - at] + data[at + len(new) :]


def _with_token(data: bytes, number: int, new: bytes) -> bytes:
    """Replace a token, counted from 0; tokens are separated by one blank or line end each."""
    start, count = 0, 0
    for end, byte in enumerate(data):
        if byte in b" \n,":
            if count == number:
                return data[:start] + new + data[end:]
            start, count = end + 1, count + 1
    return data


APPLY: Final[Mapping[str, Callable[[bytes, int, str], bytes]]] = {
    "flip": _flip,
    "put": _put,
    "insert": lambda data, at, value: data[:at] + bytes.fromhex(value) + data[at:],
    "delete": lambda data, at, value: data[:at] + data[at + int(value) :],
    "cut": lambda data, at, _: data[:at],
    "repeat": lambda data, at, value: data[:at] + data[at : at + int(value)] * 2 + data[at + int(value) :],
    "token": lambda data, at, value: _with_token(data, at, bytes.fromhex(value)),
}


def random_bytes_edits(rng: np.random.Generator, name: str, size: int) -> list[Edit]:
    """Draw one to four changes of the bytes of a file."""
    edits = []
    for _ in range(int(rng.integers(1, 5))):
        at = int(rng.integers(0, max(size, 1)))
        kind = str(rng.choice(["flip"] * 4 + ["u32", "u64", "f64", "f64", "insert", "delete", "cut", "repeat"]))
        if kind == "flip":
            edits += [Edit("flip", name, int(rng.integers(0, max(size, 1))), str(rng.integers(8))) for _ in range(8)]
            del edits[len(edits) - int(rng.integers(0, 8)) :]
        elif kind in {"u32", "u64"}:
            value, bits = int(rng.choice(np.array(WHOLE, dtype=object))), 32 if kind == "u32" else 64
            edits.append(Edit("put", name, at, (value % 2**bits).to_bytes(bits // 8, "little").hex()))
        elif kind == "f64":
            edits.append(Edit("put", name, at, struct.pack("<d", rng.choice(EXTREME)).hex()))
        elif kind == "insert":
            edits.append(Edit("insert", name, at, rng.bytes(int(rng.integers(1, 17))).hex()))
        elif kind == "cut":
            edits.append(Edit("cut", name, at))
        else:
            edits.append(Edit(kind, name, at, str(rng.integers(1, 64))))
    return edits or [Edit("cut", name, size // 2)]


def random_token_edits(rng: np.random.Generator, name: str, data: bytes) -> list[Edit]:
    """Draw one to three tokens that become others."""
    num = sum(data.count(byte) for byte in (b" ", b"\n", b","))
    draws = [
        (int(rng.integers(0, max(num, 1))), TOKENS[int(rng.integers(len(TOKENS)))]) for _ in range(rng.integers(1, 4))
    ]
    return [Edit("token", name, at, token.hex()) for at, token in draws]


def random_field_edits(rng: np.random.Generator, model: Any) -> list[Edit]:
    """Draw one to four fields of a model that get extreme values."""
    return [_field_edit(rng, model) for _ in range(int(rng.integers(1, 5)))]


def _field_edit(rng: np.random.Generator, model: Any) -> Edit:
    tables = ["cameras", "images", "points", *(name for name in ("rigs", "frames") if getattr(model, name))]
    table = str(rng.choice(tables + ["cameras"] * 2 + ["images"] * 2))
    row = "*" if rng.random() < 0.2 else str(rng.integers(len(getattr(model, table))))
    return _FIELDS[table](rng, f"{table}.{row}")


def _value(rng: np.random.Generator) -> str:
    return repr(float(rng.choice(EXTREME)))


def _whole_number(rng: np.random.Generator, below: int = 2**32) -> str:
    values = [each for each in WHOLE if each < below]
    return str(values[int(rng.integers(len(values)))])


def _camera_edit(rng: np.random.Generator, row: str) -> Edit:
    kind = str(rng.choice(["params", "params", "params", "width", "height", "model_id"]))
    if kind == "params":
        return Edit("field", f"{row}.params.{rng.integers(0, 8)}", 0, _value(rng))
    return Edit("field", f"{row}.{kind}", 0, str(rng.integers(0, 18)) if kind == "model_id" else _whole_number(rng))


def _image_edit(rng: np.random.Generator, row: str) -> Edit:
    kind = str(rng.choice(["pose", "pose", "xy", "xy", "camera_id", "link"]))
    if kind == "pose":
        return Edit("field", f"{row}.pose.{rng.integers(7)}", 0, _value(rng))
    if kind == "camera_id":
        return Edit("field", f"{row}.camera_id", 0, _whole_number(rng))
    column = rng.integers(2) if kind == "xy" else 2
    which = "*" if rng.random() < 0.3 else str(rng.integers(60))
    value = _value(rng) if kind == "xy" else _whole_number(rng, 2**63)
    return Edit("field", f"{row}.points2d.{which}.{column}", 0, value)


def _point_edit(rng: np.random.Generator, row: str) -> Edit:
    if rng.random() < 0.5:
        return Edit("field", f"{row}.xyz.{rng.integers(3)}", 0, _value(rng))
    if rng.random() < 0.7:
        return Edit("field", f"{row}.error", 0, _value(rng))
    return Edit("field", f"{row}.point_id", 0, _whole_number(rng, 2**63))


def _rig_edit(rng: np.random.Generator, row: str) -> Edit:
    return Edit("field", f"{row}.sensors.{rng.integers(3)}.{rng.integers(2)}", 0, _whole_number(rng, 2**31))


def _frame_edit(rng: np.random.Generator, row: str) -> Edit:
    if rng.random() < 0.5:
        return Edit("field", f"{row}.pose.{rng.integers(7)}", 0, _value(rng))
    return Edit("field", f"{row}.data.{rng.integers(3)}.{rng.integers(3)}", 0, _whole_number(rng, 2**31))


_FIELDS: Final[Mapping[str, Callable[[np.random.Generator, str], Edit]]] = {
    "cameras": _camera_edit,
    "images": _image_edit,
    "points": _point_edit,
    "rigs": _rig_edit,
    "frames": _frame_edit,
}


def with_fields(model: Any, edits: Sequence[Edit]) -> Any:
    """Return a model of tests/model_writer.py after the edits of fields; those that do not fit change nothing."""
    for edit in edits:
        if edit.what == "field":
            model = _set(model, edit.file.split("."), edit.value)
    return model


def _set(thing: Any, path: list[str], text: str) -> Any:
    if not path:
        return type(thing)(float(text)) if isinstance(thing, float) else _whole(text, thing)
    name, *rest = path
    if isinstance(thing, tuple):
        indices = range(len(thing)) if name == "*" else [int(name)]
        return tuple(_set(each, rest, text) if i in indices else each for i, each in enumerate(thing))
    if thing is None or not hasattr(thing, name):
        return thing
    new = {name: _set(getattr(thing, name), rest, text)}
    if name == "model_id":  # as many parameters as the model has
        kinds = BY_ID[new[name]].param_names
        new["params"] = tuple(500.0 if kind[0] == "f" else 320.0 if kind[0] == "c" else 0.01 for kind in kinds)
    return dataclasses.replace(thing, **new)


def _whole(text: str, old: Any) -> Any:
    try:
        value = int(float(text)) if "." in text or "e" in text else int(text)
    except (ValueError, OverflowError):
        return old
    return max(0, min(value, 2**64 - 1)) if isinstance(old, int) else old
