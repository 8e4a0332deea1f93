"""A TOML file that somebody else may have written: bounded in size, nesting and number of keys before it is parsed.

tomllib follows nested values and dotted keys by recursion and copies, so that a few kilobytes take seconds or end in a
RecursionError. The limits are far from what any gate file or config needs.
"""

from __future__ import annotations

import os
import re
import tomllib
from pathlib import Path
from typing import Any, Final

from sfm_audit.audit.cli.errors import ExitCode, KnownError
from sfm_audit.reports.run_folder.disk import read_plain

MAX_BYTES: Final = 500_000
MAX_DEPTH: Final = 20
MAX_KEY_PARTS: Final = 20
MAX_KEYS: Final = 20_000
_SHOWN: Final = 120
_DEPTH: Final = {"[": 1, "{": 1, "]": -1, "}": -1}

# a text that is not closed goes on to the end of its line or of the file, so that no place is looked at twice
_WORDS: Final = re.compile(
    r'"""(?:[^\\"]|\\.|"(?!""))*+(?:""")?'
    r"|'''(?:[^']|'(?!''))*+(?:''')?"
    r'|"(?:[^\\"\n]|\\.)*+"?'
    r"|'[^'\n]*+'?"
    r"|\#[^\n]*+"
    r"|[A-Za-z0-9_-]++"
    r"|[^ \t]",
    re.DOTALL,
)


def read_toml(file: Path) -> dict[str, Any]:
    """Read a TOML file; an empty device such as /dev/null is an empty file.

    Raises
    ------
    KnownError
        It cannot be read, is no plain file, no TOML, or larger, deeper or longer than such files are.
    """
    try:
        content = b"" if _is_null(file) else read_plain(file, MAX_BYTES)
        text = content.decode("utf-8-sig")  # some editors begin a file with a byte order mark
        problem = _too_much(text)
        if problem:
            raise KnownError(f"{file}: {problem}; write a smaller file", ExitCode.USAGE)
        return tomllib.loads(text)
    except OSError as error:
        raise KnownError(f"{file}: cannot be read ({error.strerror or error})", ExitCode.USAGE) from error
    except UnicodeDecodeError as error:
        problem = f"byte {error.start} is not UTF-8; save it as UTF-8"
        raise KnownError(f"{file}: not a TOML file: {problem}", ExitCode.USAGE) from error
    except (ValueError, RecursionError) as error:  # TOMLDecodeError, numbers of too many digits
        raise KnownError(f"{file}: not a TOML file: {str(error)[:_SHOWN]}", ExitCode.USAGE) from error


def shown(value: object) -> str:
    """Return a value as a message shows it, cut short."""
    text = repr(value)
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}..."


def _too_much(text: str) -> str | None:
    """Say which limit a text exceeds; None where it keeps within all of them."""
    depth = num_keys = num_parts = 0
    last = ""
    for match in _WORDS.finditer(text):
        word = match.group()
        depth += _DEPTH.get(word, 0)
        num_keys += word == "="
        if word == ".":
            num_parts += 1
        elif last != ".":
            num_parts = 1
        last = word
        if depth > MAX_DEPTH or num_parts > MAX_KEY_PARTS or num_keys > MAX_KEYS:
            break
    else:
        return None
    if depth > MAX_DEPTH:
        return f"values nested more than {MAX_DEPTH} deep"
    return f"a key of more than {MAX_KEY_PARTS} parts" if num_parts > MAX_KEY_PARTS else f"more than {MAX_KEYS} keys"


def _is_null(file: Path) -> bool:
    try:
        return os.path.samefile(file, os.devnull)  # noqa: PTH121 - compares devices without opening them
    except OSError:
        return False
