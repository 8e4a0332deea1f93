"""Files that somebody made to hurt: each costs one line or is a model, and little memory, whatever it declares."""

import gc
import importlib
import json
import os
import tracemalloc
from pathlib import Path

import foreign_openmvg_binary as mvg
import foreign_scene as fs
import numpy as np
import pytest
from model_promises import assert_is_a_model

from sfm_audit.loaders import LoadError, open_model
from sfm_audit.loaders.datasets.input_state import read_input_state

importlib.import_module("pyarrow.csv")  # an import is no memory that a file takes
MADE = fs.scene({"k1": -0.08, "k2": 0.0}, num_images=2, num_points=3)
MAX_BYTES = 96 << 20
"""Of memory that Python takes for a file of at most 10 MB."""
MILLIONS = b"2000000000"
DIGITS = b"9" * 10_000
LONG = b"x" * (10 << 20)


def answer_of(folder: Path) -> str:
    """The error's line, or "" for a model that keeps its promises; fails where it took much memory."""
    gc.collect()
    tracemalloc.start()
    try:
        found: object = open_model(folder)
    except LoadError as error:
        found = error
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < MAX_BYTES
    if isinstance(found, LoadError):
        assert "\n" not in str(found)
        assert len(str(found)) < 2500
        return str(found)
    assert_is_a_model(found)
    return ""


def replaced(files: dict[str, bytes], name: str, old: bytes, new: bytes) -> dict[str, bytes]:
    assert old in files[name]
    return files | {name: files[name].replace(old, new, 1)}


XML = fs.blocks_exchange_files(MADE)["BlocksExchange.xml"].decode()
HEAD, _, REST = XML.partition("\n")
LAUGHS = "".join(f'<!ENTITY l{k} "{f"&l{k - 1};" * 10}">' for k in range(1, 10))
ELSEWHERE = '<!DOCTYPE b [<!ENTITY x SYSTEM "file:///etc/hostname">]>'
XML_ATTACKS = {
    "billion laughs": (f'{HEAD}<!DOCTYPE b [<!ENTITY l0 "ha">{LAUGHS}]>{REST}', "without a document type"),
    "an entity elsewhere": (HEAD + ELSEWHERE + REST.replace("0.jpg", "&x;"), "without a document type"),
    "a document type elsewhere": (f'{HEAD}<!DOCTYPE b SYSTEM "http://127.0.0.1:9/x">{REST}', "document type"),
    "an entity that nobody declared": (HEAD + REST.replace("0.jpg", "&x;"), "found undefined entity"),
    "depth": (HEAD + "<BlocksExchange>" + "<a>" * 100_000, "elements inside each other"),
    "a comment": (f"{HEAD}<BlocksExchange><!--{LONG.decode()}", "tags and comments of at most"),
    "an attribute": (f'{HEAD}<BlocksExchange a="{LONG.decode()}', "tags and comments of at most"),
    "a text": (f"{HEAD}<BlocksExchange>{LONG.decode()}", "characters in <BlocksExchange>"),
    "an encoding": (XML.replace("utf-8", "rot13"), "expected XML"),
    "another encoding": (XML.replace("0.jpg", "\u00e9\u4e00.jpg"), ""),
    "infinity": (XML.replace("<M_00>", "<M_00>1e999", 1), "expected a number"),
    "many digits": (XML.replace("<PhotoId>", f"<PhotoId>{DIGITS.decode()}", 1), "a whole number below 2^32"),
    "a negative id": (XML.replace("<PhotoId>", "<PhotoId>-", 1), "a whole number below 2^32"),
}


@pytest.mark.parametrize("attack", XML_ATTACKS)
def test_xml(tmp_path: Path, attack: str):
    content, message = XML_ATTACKS[attack]
    assert message in answer_of(fs.write(tmp_path, {"BlocksExchange.xml": content.encode()}))


def test_xml_elements_that_have_no_end_do_not_fill_the_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("sfm_audit.loaders.foreign.xml_file.MAX_KEPT", 1000)
    inner = "<Measurement>" + "<a/>" * 20 + "</Measurement>"
    for start in ("<TiePoint>" + inner * 60, "<Block>" + "<Other>" * 3 + "<a/>" * 1100):
        content = f"{HEAD}<BlocksExchange>{start}"
        assert "at most 1000 elements" in answer_of(fs.write(tmp_path, {"BlocksExchange.xml": content.encode()}))
    many = REST.replace(
        "</TiePoints>", REST[REST.index("<TiePoint>") : REST.index("</TiePoints>")] * 50 + "</TiePoints>"
    )
    assert many.count("<Measurement>") > 200
    assert answer_of(fs.write(tmp_path, {"BlocksExchange.xml": (HEAD + many).encode()})) == ""


OPENSFM = fs.opensfm_files(MADE)
OPENMVG = fs.openmvg_files(MADE)
JSON_ATTACKS = {
    "nan": (OPENMVG, "sfm_data.json", b'"focal_length": 620.0', b'"focal_length": NaN', ""),
    "infinity": (OPENMVG, "sfm_data.json", b'"focal_length": 620.0', b'"focal_length": -Infinity', ""),
    "a number for text": (OPENMVG, "sfm_data.json", b'"0.jpg"', b"1", "a string at views.0.value"),
    "a negative id": (OPENMVG, "sfm_data.json", b'"id_pose": 0', b'"id_pose": -1', "a whole number below 4294967296"),
    "an id of 2^64": (OPENMVG, "sfm_data.json", b'"id_pose": 0', b'"id_pose": 18446744073709551616', "a whole number"),
    "an id that is true": (OPENMVG, "sfm_data.json", b'"id_pose": 0', b'"id_pose": true', "a whole number below"),
    "an id of many digits": (OPENMVG, "sfm_data.json", b'"id_pose": 0', b'"id_pose": ' + DIGITS, "JSON in UTF-8"),
    "a key twice": (OPENMVG, "sfm_data.json", b'"id_pose": 0', b'"id_pose": 0, "id_pose": 0', "twice in one object"),
    "half a surrogate": (OPENMVG, "sfm_data.json", b'"0.jpg"', b'"\\ud800.jpg"', ""),
    "a name of controls": (OPENMVG, "sfm_data.json", b'"0.jpg"', b'"\\u0000\\u001b[2J\\n"', ""),
    "no end": (OPENMVG, "sfm_data.json", b'"0.jpg"', b'"0.jpg', "expected JSON"),
    "an observation of nothing": (OPENMVG, "sfm_data.json", b'"x": [', b'"x": [[], ', "numbers"),
    "a view of many digits": (
        OPENMVG,
        "sfm_data.json",
        b'{"key": 1, "value": {"id_',
        b'{"key": 1e400, "value": {"id_',
        "ids",
    ),
    "deep": (OPENSFM, "reconstruction.json", b"[{", b'{"a":' * 100_000, "values nested too deeply"),
    "pose of infinity": (OPENSFM, "reconstruction.json", b'"translation": [', b'"translation": [1e999, ', "3 numbers"),
    "coordinates of text": (OPENSFM, "reconstruction.json", b'"coordinates": [', b'"coordinates": ["1", ', "3 numbers"),
    "latin": (OPENSFM, "reconstruction.json", b"0.jpg", b"\xe9.jpg", "JSON in UTF-8"),
    "tracks of many digits": (OPENSFM, "tracks.csv", b"\t100\t0\t", b"\t100\t0\t" + DIGITS, ""),
    "a track's long line": (OPENSFM, "tracks.csv", b"\t100\t", b"\t" + LONG, "lines of 11 values"),
    "tracks of nan": (OPENSFM, "tracks.csv", b"\t100\t0\t", b"\t100\t0\tnan", "lines of 11 values"),
    "a version of many digits": (OPENSFM, "tracks.csv", b"_v2", b"_v" + DIGITS, "version 0, 1 or 2"),
}


@pytest.mark.parametrize("attack", JSON_ATTACKS)
def test_json_and_tracks(tmp_path: Path, attack: str):
    files, name, old, new, message = JSON_ATTACKS[attack]
    assert message in answer_of(fs.write(tmp_path, replaced(files, name, old, new)))


def test_many_reconstructions_of_many_tracks_cost_their_sum(tmp_path: Path):
    empty = {"cameras": {}, "shots": {}, "points": {}}
    real = json.loads(OPENSFM["reconstruction.json"])
    more = b"".join(b"other.jpg\t%d\t0\t0\t0\t0\t1\t2\t3\t-1\t-1\n" % (1000 + row) for row in range(4000))
    files = {"reconstruction.json": json.dumps(real + [empty] * 4000).encode()}
    assert answer_of(fs.write(tmp_path, files | {"tracks.csv": OPENSFM["tracks.csv"] + more})) == ""


TEXT_ATTACKS = {
    "bundler cameras": (fs.bundler_files(MADE), "bundle.out", b"\n2 3\n", b"\n%b 3\n" % MILLIONS, "2000000000 cameras"),
    "bundler points": (fs.bundler_files(MADE), "bundle.out", b"\n2 3\n", b"\n2 %b\n" % MILLIONS, "2000000000 points"),
    "bundler views": (fs.bundler_files(MADE), "bundle.out", b"20 30\n2 ", b"20 30\n%b " % MILLIONS, "the observations"),
    "bundler digits": (fs.bundler_files(MADE), "bundle.out", b"\n2 3\n", b"\n%b 3\n" % DIGITS, "a number of cameras"),
    "bundler negative": (
        fs.bundler_files(MADE),
        "bundle.out",
        b"20 30\n2 0",
        b"20 30\n2 -1",
        "the position of a camera",
    ),
    "bundler nan": (fs.bundler_files(MADE), "bundle.out", b"20 30\n2 0", b"20 30\n2 nan", "the position of a camera"),
    "bundler line": (fs.bundler_files(MADE), "bundle.out", b"20 30", b"20 " + LONG, "expected numbers"),
    "bal counts": (fs.bal_files(MADE), "problem-6-80-pre.txt", b"2 3 ", b"%b 3 " % MILLIONS, "found the end"),
    "bal links": (fs.bal_files(MADE), "problem-6-80-pre.txt", b"2 3 ", b"2 3 %b " % MILLIONS, "found the end"),
    "nvm cameras": (fs.nvm_files(MADE), "scene.nvm", b"\n\n2\n", b"\n\n%b\n" % MILLIONS, "expected"),
    "nvm points": (fs.nvm_files(MADE), "scene.nvm", b"\n\n3\n", b"\n\n%b\n" % MILLIONS, "expected"),
    "nvm digits": (fs.nvm_files(MADE), "scene.nvm", b"\n\n2\n", b"\n\n%b\n" % DIGITS, "expected"),
    "kapture outside": (
        fs.kapture_files(MADE),
        "reconstruction/observations.txt",
        b"SIFT",
        b"../..",
        "inside the folder",
    ),
    "kapture digits": (
        fs.kapture_files(MADE),
        "reconstruction/observations.txt",
        b"0, SIFT",
        DIGITS + b", SIFT",
        "row",
    ),
    "kapture negative": (fs.kapture_files(MADE), "reconstruction/observations.txt", b"jpg, 0", b"jpg, -1", "position"),
    "kapture size": (fs.kapture_files(MADE), "sensors/sensors.txt", b"RADIAL, ", b"RADIAL, 1e300, ", "parameters"),
    "kapture nan": (fs.kapture_files(MADE), "sensors/trajectories.txt", b"\n0, cam0, ", b"\n0, cam0, nan, ", "QW"),
}


@pytest.mark.parametrize("attack", TEXT_ATTACKS)
def test_numbers_and_names_in_text(tmp_path: Path, attack: str):
    files, name, old, new, message = TEXT_ATTACKS[attack]
    below = "reconstruction" if "kapture" in attack else ""
    assert message in answer_of(fs.write(tmp_path, replaced(files, name, old, new)) / below)


GROWN = {
    "bundler": (fs.bundler_files(MADE), ["bundle.out", "list.txt"]),
    "bal": (fs.bal_files(MADE), ["problem-6-80-pre.txt"]),
    "nvm": (fs.nvm_files(MADE), ["scene.nvm"]),
    "opensfm": (OPENSFM, list(OPENSFM)),
    "openmvg": (OPENMVG, list(OPENMVG)),
    "openmvg_binary": (mvg.openmvg_binary_files(MADE), ["sfm_data.bin"]),
    "blocks_exchange": (fs.blocks_exchange_files(MADE), ["BlocksExchange.xml"]),
    "kapture": (fs.kapture_files(MADE), list(fs.kapture_files(MADE))),
}


@pytest.mark.parametrize(("name", "file"), [(name, file) for name, (_, files) in GROWN.items() for file in files])
def test_a_file_grown_by_a_terabyte_of_zeros_is_neither_read_nor_hashed_to_its_end(
    tmp_path: Path, name: str, file: str
):
    files, _ = GROWN[name]
    folder = fs.write(tmp_path, files) / ("reconstruction" if name == "kapture" else "")
    try:
        os.truncate(tmp_path / file, 1 << 40)
    except OSError:
        pytest.skip("no files with holes here")
    assert answer_of(folder)
    with pytest.raises(LoadError):
        read_input_state(str(folder))


def test_observations_of_zeros_are_refused_a_piece_at_a_time(tmp_path: Path):
    content = mvg.openmvg_binary_files(MADE)["sfm_data.bin"]
    last = content[:-8]  # without the number of control points
    num_seen = int(np.count_nonzero(MADE.point_idx == 2))
    at = len(last) - 32 * num_seen - 8
    assert int.from_bytes(last[at : at + 8], "little") == num_seen
    path = fs.write(tmp_path, {"sfm_data.bin": last[:at] + (1 << 34).to_bytes(8, "little") + last[at + 8 :]})
    try:
        os.truncate(path / "sfm_data.bin", 1 << 40)
    except OSError:
        pytest.skip("no files with holes here")
    assert "2 coordinates of an observation, found 0" in answer_of(path)
