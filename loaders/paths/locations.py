"""What does a location string name? A local path, or a place in an object store: s3://bucket/key, gs://bucket/key.

What follows the last ``?`` of an object store's location are options of the connection: ``?anonymous=true&region=...``.
Keys stand as they are, nothing in them is percent-decoded. Secrets are refused here: locations go into tables.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final
from urllib.parse import parse_qsl, urlencode

from sfm_audit.loaders.errors import UnreadableFileError

OPTIONS: Final[Mapping[str, tuple[str, ...]]] = {
    "s3": ("anonymous", "region", "endpoint_override", "scheme"),
    "gs": ("anonymous", "endpoint_override", "scheme"),
}
"""Kinds of object stores, and the options of a connection to them."""

_URI: Final = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+)://(.*)", re.DOTALL)
_QUERY: Final = re.compile(r"(.*)\?([a-z_]+=[^&]*(?:&[a-z_]+=[^&]*)*)", re.DOTALL)
_SECRETS: Final = "never in a location: set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or write ~/.aws/credentials"


@dataclass(frozen=True, slots=True)
class Entry:
    """One name in a folder: a file with its size and time of change, or a folder."""

    is_folder: bool
    num_bytes: int
    mtime_ns: int


@dataclass(frozen=True, slots=True)
class RemotePath:
    """A file or folder in an object store; has of `pathlib.Path` what the loaders use of it.

    scheme: a key of `OPTIONS`.    parts: the bucket, then the names that lead to the file or folder.
    options: of the connection, sorted by name.    folder: where it was reached from.
    listings: of this folder, none or one: `files.listing_of` asks the store only once.
    """

    scheme: str
    parts: tuple[str, ...]
    options: tuple[tuple[str, str], ...] = ()
    folder: RemotePath | None = field(default=None, compare=False, repr=False)
    listings: list[Mapping[str, Entry]] = field(default_factory=list, init=False, compare=False, repr=False)

    def __truediv__(self, name: str) -> RemotePath:
        return RemotePath(self.scheme, (*self.parts, name), self.options, self)

    def __str__(self) -> str:
        return f"{self.scheme}://{self.key}{_query(self.options)}"

    @property
    def key(self) -> str:
        """Bucket and key, as pyarrow names the place."""
        return "/".join(self.parts)

    @property
    def name(self) -> str:
        """The last of the names."""
        return self.parts[-1]

    @property
    def stem(self) -> str:
        """The last of the names without its suffix."""
        return Path(self.name).stem


InputPath = Path | RemotePath


def parse_location(location: str | Path) -> InputPath:
    """Return what ``location`` names.

    Raises
    ------
    UnreadableFileError
        A URI of another kind, with unknown options, without a bucket, or with a secret in it.
    """
    uri = None if isinstance(location, Path) else _URI.fullmatch(location)
    if uri is None:
        return Path(location)
    scheme, rest = uri[1], uri[2]
    if scheme not in OPTIONS:
        raise _refused(f"{scheme}://...", "a path of this machine, s3:// or gs://", f"{scheme}://", "copy the data")
    match = _QUERY.fullmatch(rest)
    place, options = (match[1], parse_qsl(match[2], keep_blank_values=True)) if match else (rest, [])
    parts = tuple(part for part in place.split("/") if part)
    if "@" in place.partition("/")[0]:
        raise _refused(f"{scheme}://...", "a bucket", "a name or a secret before it", _SECRETS)
    if not parts:
        raise _refused(str(location), f"{scheme}://bucket/path", "no bucket", "name the bucket")
    for name, value in options:
        known = OPTIONS[scheme]
        if name not in known:
            advice = f"known are {', '.join(known)}; secrets are {_SECRETS}"
            raise _refused(f"{scheme}://{place}", "options of the connection", f"{name}=", advice)
        if name == "anonymous" and value not in {"true", "false"}:
            raise _refused(f"{scheme}://{place}", "anonymous=true or =false", f"anonymous={value}", "choose one")
    return RemotePath(scheme, parts, tuple(sorted(dict(options).items())))


def below(given: str, parts: Sequence[str]) -> str:
    """Return the location as given, joined with the names below it."""
    uri = _URI.fullmatch(given)
    if uri is None or uri[1] not in OPTIONS:
        return os.path.join(given, *parts)  # noqa: PTH118 - Path would drop a leading "./"
    match = _QUERY.fullmatch(given)
    place, query = (match[1], f"?{match[2]}") if match else (given, "")
    joined = "/".join([place.rstrip("/"), *parts]) if parts else place
    return joined + query


def real_location(location: str | Path) -> str:
    """Return the one string that stands for the place: a real path, or a URI with its options in a fixed order.

    Raises
    ------
    UnreadableFileError
        As of `parse_location`.
    """
    path = parse_location(location)
    return str(path) if isinstance(path, RemotePath) else os.path.realpath(path)


def _query(options: Sequence[tuple[str, str]]) -> str:
    return f"?{urlencode(options, safe=':/')}" if options else ""


def _refused(location: str, wanted: str, got: str, advice: str) -> UnreadableFileError:
    return UnreadableFileError(location, None, wanted, got, advice)
