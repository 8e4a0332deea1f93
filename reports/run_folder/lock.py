"""Who writes into a run folder? One process at a time, and a process that died holds nothing.

The operating system's lock on ``.lock`` ends with the process that holds it. Where a file system has no such locks,
``.lock-owner`` takes its place: made exclusively, it names host, process and when that process started, so that one
that is gone (or whose number another process has now) is recognised.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import platform
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

from sfm_audit.reports.run_folder.disk import read_plain

LOCK: Final = ".lock"
OWNER: Final = ".lock-owner"
_BUSY: Final = frozenset({errno.EACCES, errno.EAGAIN, errno.EDEADLK})
_NO_LOCKS: Final = frozenset({errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOTSUP, errno.EINVAL})
_MAX_BYTES: Final = 10_000
_TRIES: Final = 3


class LockedError(Exception):
    """Another process holds the lock; the message says which."""


@dataclass(frozen=True, slots=True)
class _Owner:
    """A process: host, number, and when it started, in the words of its operating system ("" where that is unknown)."""

    host: str
    pid: int
    started: str

    def is_gone(self) -> bool:
        """Whether it has certainly ended; of another machine nobody knows."""
        if self.host != platform.node() or os.name == "nt":
            return False
        try:
            os.kill(self.pid, 0)
        except ProcessLookupError:
            return True
        except OSError:
            return False
        return bool(self.started) and _started(self.pid) not in {"", self.started}

    def __str__(self) -> str:
        where = "" if self.host == platform.node() else f" on {self.host}"
        return f"process {self.pid}{where}"


class RunLock:
    """The lock of a run folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._handle: int | None = None
        self._owns_file = False

    def acquire(self) -> None:
        """Take the lock without waiting.

        Raises
        ------
        LockedError
            Another process has it.
        OSError
            The folder cannot be written.
        """
        flags = os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
        handle = os.open(self._folder / LOCK, flags, 0o644)
        try:
            if _lock(handle):
                os.ftruncate(handle, 0)
                os.pwrite(handle, _own_words(), 0) if hasattr(os, "pwrite") else None
                self._handle = handle
                return
        except OSError as error:
            os.close(handle)
            if error.errno not in _NO_LOCKS:
                raise
            self._acquire_by_file()
            return
        os.close(handle)
        raise LockedError(str(_owner_in(self._folder / LOCK) or "another process"))

    def release(self) -> None:
        """Let others in."""
        if self._handle is not None:
            with contextlib.suppress(OSError):
                os.ftruncate(self._handle, 0)  # a run folder that is sent to others names no host
            os.close(self._handle)  # the lock ends with it
            self._handle = None
        if self._owns_file:
            (self._folder / OWNER).unlink(missing_ok=True)
            self._owns_file = False

    def _acquire_by_file(self) -> None:
        path = self._folder / OWNER
        for _ in range(_TRIES):
            try:
                handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644)
            except FileExistsError:
                owner = _owner_in(path)
                if owner is None or not owner.is_gone():
                    who = owner or f"a process that {path} does not name; remove that file if none runs"
                    raise LockedError(str(who)) from None
                self._set_aside(path, owner)
                continue
            with os.fdopen(handle, "wb") as file:
                file.write(_own_words())
            self._owns_file = True
            return
        raise LockedError("another process")

    def _set_aside(self, path: Path, gone: _Owner) -> None:
        """Take away the file of a process that is gone; of several that try, one does."""
        aside = path.with_name(f".tmp-{OWNER}-{os.getpid()}")
        with contextlib.suppress(FileNotFoundError):
            path.rename(aside)
            if _owner_in(aside) != gone:  # in between, another process had set it aside and taken its place
                with contextlib.suppress(FileExistsError):
                    os.link(aside, path)
            aside.unlink()


def _own_words() -> bytes:
    return json.dumps(asdict(_Owner(platform.node(), os.getpid(), _started(os.getpid())))).encode()


def _owner_in(path: Path) -> _Owner | None:
    try:
        said = json.loads(read_plain(path, _MAX_BYTES, follow_links=False))
        return _Owner(str(said["host"]), int(said["pid"]), str(said["started"]))
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None


def _started(pid: int) -> str:
    """Return when a process started, as /proc has it: boot, and ticks since then; "" where there is no /proc."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
        stat = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""
    return f"{boot} {stat.rpartition(')')[2].split()[19]}"


if sys.platform == "win32":
    import msvcrt

    def _lock(handle: int) -> bool:
        try:
            msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
        except OSError as error:
            if error.errno in _BUSY:
                return False
            raise
        return True

else:
    import fcntl

    def _lock(handle: int) -> bool:
        """Lock an open file for this process alone; False where another process has it."""
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno in _BUSY:
                return False
            raise
        return True
