"""Object stores through pyarrow.fs: what lies in a folder, bytes in large pieces, and one-line errors.

Nothing is stored on this machine. A request that fails is repeated by pyarrow's own retry strategy, a bounded number
of times. gs:// takes the same way and is not tested here.
"""

from __future__ import annotations

import io
import os
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final, Literal

import pyarrow.fs as pafs

from sfm_audit.loaders.errors import LoadError, MissingFileError, UnreadableFileError
from sfm_audit.loaders.paths.locations import Entry, RemotePath

if TYPE_CHECKING:
    from _typeshed import WriteableBuffer
    from pyarrow import NativeFile

HEAD_BYTES: Final = 4096  # of a file whose first bytes say enough; more than a Git LFS pointer's first line
PIECE_BYTES: Final = 8 << 20  # of one request: large beside the latency of a store, small beside a model
_ATTEMPTS: Final = 3
_CONNECT_SECONDS: Final = 10.0
_REQUEST_SECONDS: Final = 60.0
_DETAIL: Final = re.compile(r"AWS Error (\w+)|curlCode: \d+, ([^;(]*)|Status\((\w+)")


def list_folder(path: RemotePath) -> Mapping[str, Entry]:
    """Return what lies in a folder, by name; nothing where there is no such folder.

    Raises
    ------
    LoadError
        The bucket does not exist, or the store refuses or does not answer.
    """
    with _asking(path):
        try:
            infos = _filesystem(path).get_file_info(pafs.FileSelector(path.key, recursive=False))
        except FileNotFoundError:
            return {}
    return {
        info.base_name: Entry(info.type == pafs.FileType.Directory, info.size or 0, info.mtime_ns or 0)
        for info in infos
    }


def kind_of(path: RemotePath) -> Literal["file", "folder"] | None:
    """Return what lies at ``path``; None for nothing. LoadError where the store refuses or does not answer."""
    with _asking(path):
        info = _filesystem(path).get_file_info(path.key)
    if info.type == pafs.FileType.NotFound:
        return None
    return "folder" if info.type == pafs.FileType.Directory else "file"


def open_remote(path: RemotePath, piece_bytes: int = PIECE_BYTES) -> tuple[io.BufferedReader, int]:
    """Open a file for reading in pieces of that many bytes; return it and its size. Reading raises LoadErrors."""
    with _asking(path):
        file = _filesystem(path).open_input_file(path.key)
        size = file.size()
    return io.BufferedReader(_RawFile(path, file), max(HEAD_BYTES, min(piece_bytes, size))), size


def entity_tag(path: RemotePath) -> tuple[int, str | None]:
    """Return a file's size in bytes and the store's entity tag of its content, None without one."""
    with _asking(path), _filesystem(path).open_input_file(path.key) as file:
        metadata: dict[str, bytes] = file.metadata()  # type: ignore[assignment]
        size = file.size()
    tag = metadata.get("ETag")
    return size, tag.decode().strip('"') if tag else None


class _RawFile(io.RawIOBase):
    """A file of an object store as io.BufferedReader wants it."""

    def __init__(self, path: RemotePath, file: NativeFile) -> None:
        self._path = path
        self._file = file

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = os.SEEK_SET, /) -> int:
        return int(self._file.seek(offset, whence))

    def tell(self) -> int:
        return int(self._file.tell())

    def readinto(self, buffer: WriteableBuffer, /) -> int:
        with _asking(self._path, is_read=True):
            return int(self._file.readinto(buffer))

    def readall(self) -> bytes:
        with _asking(self._path, is_read=True):
            return bytes(self._file.read())

    def close(self) -> None:
        if not self.closed:
            self._file.close()
        super().close()


def _filesystem(path: RemotePath) -> pafs.FileSystem:
    return _connect(path.scheme, path.parts[0], path.options)


@lru_cache(maxsize=64)
def _connect(scheme: str, bucket: str, options: tuple[tuple[str, str], ...]) -> pafs.FileSystem:
    """Return the connection to a bucket, the same for all files of a process."""
    given: dict[str, Any] = dict(options)
    given["anonymous"] = given.get("anonymous") == "true"
    return _STORES[scheme](bucket, given)


def _s3(bucket: str, given: dict[str, Any]) -> pafs.FileSystem:
    if not given.keys() & {"region", "endpoint_override"}:
        given["region"] = pafs.resolve_s3_region(bucket)
    return pafs.S3FileSystem(
        **given,
        connect_timeout=_CONNECT_SECONDS,
        request_timeout=_REQUEST_SECONDS,
        retry_strategy=pafs.AwsStandardS3RetryStrategy(max_attempts=_ATTEMPTS),
    )


def _gs(_bucket: str, given: dict[str, Any]) -> pafs.FileSystem:
    return pafs.GcsFileSystem(**given, retry_time_limit=timedelta(seconds=_REQUEST_SECONDS))


_STORES: Final[Mapping[str, Callable[[str, dict[str, Any]], pafs.FileSystem]]] = {"s3": _s3, "gs": _gs}


@contextmanager
def _asking(path: RemotePath, *, is_read: bool = False) -> Iterator[None]:
    """Turn errors of the store or of the connection into a LoadError."""
    try:
        yield
    except ImportError as error:  # pyarrow without this kind of store
        got, advice = f"a pyarrow without support for {path.scheme}://", "install pyarrow's own wheel"
        raise UnreadableFileError(str(path), None, "a location that can be read", got, advice) from error
    except OSError as error:
        raise _load_error(path, error, is_read=is_read) from error


@dataclass(frozen=True, slots=True)
class _Complaint:
    """How an error of a store is reported. markers: any of them in its message; the rest as of `LoadError`."""

    markers: tuple[str, ...]
    kind: type[LoadError]
    wanted: str
    got: str
    advice: str


_COMPLAINTS: Final = (
    _Complaint(
        (
            *("NETWORK_CONNECTION", "curlCode", "TIMEOUT", "SLOW_DOWN", "THROTTLING", "UNAVAILABLE", "DEADLINE"),
            "HTTP status 5",  # a server's own failure, of a request whose answer has no body to say more
        ),
        UnreadableFileError,
        "an answer of the object store",
        "none",
        "check the network, region and endpoint_override, then give the same command again",
    ),
    _Complaint(
        ("NO_SUCH_BUCKET", "Bucket '", "bucket does not exist"),
        MissingFileError,
        "a bucket",
        "no bucket of that name",
        "check its name, and endpoint_override",
    ),
    _Complaint(
        ("PERMANENT_REDIRECT", "PermanentRedirect", "AuthorizationHeaderMalformed", "HTTP status 301"),
        UnreadableFileError,
        "the region of the bucket",
        "another one",
        "say ?region=... (see the documentation of the data set)",
    ),
    _Complaint(
        (
            *("ACCESS_DENIED", "INVALID_ACCESS_KEY", "SIGNATURE", "TOKEN", "UNRECOGNIZED_CLIENT", "AccessDenied"),
            *("HTTP status 401", "HTTP status 403", "PERMISSION_DENIED", "UNAUTHENTICATED"),
        ),
        UnreadableFileError,
        "a readable location",
        "access denied",
        "",  # depends on how it was asked
    ),
)


def _load_error(path: RemotePath, error: OSError, *, is_read: bool) -> LoadError:
    where, text = str(path), str(error)
    if isinstance(error, FileNotFoundError):
        return _vanished(where)
    for complaint in _COMPLAINTS:
        if any(marker in text for marker in complaint.markers):
            got = f"{complaint.got}{_detail(text)}"
            return complaint.kind(where, None, complaint.wanted, got, complaint.advice or _permission(path))
    if is_read and kind_of(path) is None:
        return _vanished(where)
    got = " ".join(text.split())[:200]
    return UnreadableFileError(where, None, "a readable location", got, "give the same command again")


def _detail(text: str) -> str:
    """Return the store's own names for what went wrong, in brackets."""
    names = [name.strip() for groups in _DETAIL.findall(text) for name in groups if name]
    return f" ({', '.join(names)})" if names else ""


def _vanished(where: str) -> MissingFileError:
    advice = "it was removed since the folder was listed: copy it there again, or give the same command again"
    return MissingFileError(where, None, "a file", "nothing", advice)


def _permission(path: RemotePath) -> str:
    if dict(path.options).get("anonymous") == "true":
        return "the location is not public: leave out anonymous=true and give credentials"
    where = "AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or ~/.aws/credentials"
    keys = where if path.scheme == "s3" else "GOOGLE_APPLICATION_CREDENTIALS"
    return f"check the credentials ({keys}), or say ?anonymous=true for a public bucket"
