"""Config and gate files that somebody else wrote: bounded before they are parsed, never waited for."""

import os
import time
import tomllib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfm_audit.audit.cli.errors import ExitCode, KnownError
from sfm_audit.audit.cli.gate_file import read_gate_file
from sfm_audit.audit.cli.settings import read_config
from sfm_audit.audit.cli.toml_file import MAX_DEPTH, MAX_KEY_PARTS, MAX_KEYS, read_toml
from sfm_audit.audit.config import AuditConfig
from sfm_audit.reports.compare.gate_policy import Band, Limits

BOMBS = {
    "nested": ("a = " + "[" * 20000 + "1" + "]" * 20000, "nested more than 20 deep"),
    "nested tables": ("a = " + "{b = " * 20000 + "1", "nested more than 20 deep"),
    "dotted": (".".join("a" * 20000) + " = 1", "a key of more than 20 parts"),
    "dotted header": ("[" + ".".join("a" * 20000) + "]", "a key of more than 20 parts"),
    "quoted dotted": (".".join(["'a'"] * 20000) + " = 1", "a key of more than 20 parts"),
    "keys": ("".join(f"k{i} = 1\n" for i in range(30000)), "more than 20000 keys"),
    "digits": ("alpha = " + "9" * 5000, "Exceeds the limit"),
    "escapes": ('a = "' + '\\"' * 240_000, "Unterminated string"),
    "quotes": ('"' * 400_000, "not a TOML file"),
    "large": ("#" * 600_000, "larger than 0.5 MB"),
    "not utf-8": ("\udcff", "not a TOML file"),
}


def readers(file):
    return (lambda: read_config(file, {}), lambda: read_gate_file(file, has_baseline=False))


@pytest.mark.parametrize("name", BOMBS)
def test_a_bomb_is_one_short_line_at_once(tmp_path, name):
    text, words = BOMBS[name]
    file = tmp_path / "bomb.toml"
    file.write_text(text, encoding="utf-8", errors="surrogateescape")
    for read in readers(file):
        start = time.process_time()
        with pytest.raises(KnownError) as caught:
            read()
        assert time.process_time() - start < 1.0
        assert caught.value.exit_code == ExitCode.USAGE
        assert words in str(caught.value)
        assert str(caught.value).startswith(f"{file}: ")
        assert len(str(caught.value)) < 400


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("grid = 1000000", "grid: expected less than or equal to 256, found 1000000"),
        ("grid = 1000000000000000000000", "grid: expected"),
        ("alpha = nan", "alpha: expected a finite number, found nan"),
        ("max_focal_over_size = inf", "max_focal_over_size: expected a finite number, found inf"),
        ("min_observations = " + "9" * 4000, "9..."),
        (f'min_effect = "{"9" * 4000}px"', "min_effect: expected"),
        ("x" * 5000 + " = 1", "unknown setting xxx"),
    ],
)
def test_absurd_values_are_bounded(tmp_path, text, words):
    file = tmp_path / "config.toml"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(KnownError) as caught:
        read_config(file, {})
    assert words in str(caught.value)
    assert len(str(caught.value)) < 600


STRANGE = (
    "nan",
    "-inf",
    "-1",
    "1e308",
    "9" * 300,
    "''",
    "[]",
    "[[1]]",
    "{a = 1}",
    "1979-05-27",
    "'\\n\\u001b[31m'",
    '"\\u202e"',
)
SECTIONS = {"limits": Limits, "band": Band}
GATE_KEYS = [f"{section}.{key}" for section, model in SECTIONS.items() for key in model.model_fields]


@pytest.mark.parametrize("value", STRANGE, ids=range(len(STRANGE)))
def test_no_key_takes_what_it_should_not(tmp_path, value):
    """Each key of config and gate files: a short line that names it, or a value that can be calculated with."""
    file = tmp_path / "strange.toml"
    read_settings, read_gate = readers(file)
    keys = dict.fromkeys(AuditConfig.model_fields, read_settings) | dict.fromkeys(GATE_KEYS, read_gate)
    for key, read in keys.items():
        file.write_text(f"{key} = {value}\n", encoding="utf-8")
        if (line := said(read)) is None:
            numbers = key.startswith(("limits.", "band.")) and value in {"1e308", "9" * 300}
            texts = key in {"database", "reference", "priors"} and value.startswith(("'\\", '"'))
            assert numbers or texts, (key, value)
        else:
            assert key.rpartition(".")[2] in line, line
            assert "\n" not in line, key
            assert len(line) < 600, key


def said(read):
    """The line that refuses, None where nothing does."""
    try:
        read()
    except KnownError as error:
        return str(error) if error.exit_code == ExitCode.USAGE else f"exit code {error.exit_code}"
    return None


@pytest.mark.parametrize("kind", ["pipe", "zero", "folder"])
def test_what_is_no_plain_file_is_refused_at_once(tmp_path, kind):
    file = tmp_path / kind
    if kind == "pipe":
        os.mkfifo(file)
    elif kind == "zero":
        file.symlink_to("/dev/zero")
    else:
        file.mkdir()
    for read in readers(file):
        with pytest.raises(KnownError, match=r"cannot be read \(no plain file\)"):
            read()


def test_the_null_device_is_an_empty_file():
    assert read_toml(os.devnull) == {}


def test_what_keeps_within_the_limits_is_read(tmp_path):
    file = tmp_path / "large.toml"
    deep = "[" * (MAX_DEPTH - 1) + "]" * (MAX_DEPTH - 1)
    keys = "".join(f"'k.{i}'=\"[\" #{{a.b\n" for i in range(MAX_KEYS - 3))
    text = f"{'.'.join('a' * MAX_KEY_PARTS)} = 0.5\n{keys}x = {deep}\n"
    file.write_text(text, encoding="utf-8")
    assert read_toml(file) == tomllib.loads(text)


@given(st.text(alphabet="\"'\\[]{}.=#\n \tab1", max_size=60))
def test_every_small_text_is_what_tomllib_says(tmp_path_factory, text):
    file = tmp_path_factory.getbasetemp() / "small.toml"
    file.write_bytes(text.encode())
    try:
        expected = tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        with pytest.raises(KnownError):
            read_toml(file)
    else:
        assert read_toml(file) == expected


def test_a_file_may_begin_with_a_byte_order_mark(tmp_path):
    file = tmp_path / "notepad.toml"
    file.write_bytes(b"\xef\xbb\xbfalpha = 0.1\n")
    assert read_toml(file) == {"alpha": 0.1}
