"""What differs between operating systems, behind names that are the same on all of them.

Linux has all of it. Elsewhere, where `fcntl` or `resource` are missing, there is a portable twin:
locks of SQLite's, and no limits.
"""

from __future__ import annotations

import ctypes
import os
import sqlite3
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib import import_module
from pathlib import Path
from typing import Any, BinaryIO, Final, Protocol

_FOREVER_S: Final = 1e6
_ZEROS_BYTES: Final = 1 << 20
_PR_SET_CHILD_SUBREAPER: Final = 36


def _module(name: str) -> Any:
    try:
        return import_module(name)
    except ImportError:
        return None


_fcntl: Final = _module("fcntl")
_resource: Final = _module("resource")


def flags(*names: str) -> int:
    """Flags of `os.open` that this system knows, and that bytes are bytes where it asks."""
    known = 0
    for name in (*names, "O_BINARY"):
        known |= int(getattr(os, name, 0))
    return known


def take_room(file: BinaryIO, size_bytes: int) -> None:
    """Make a new file so long, with room on the disk for all of it.

    Raises:
        OSError: there is no such room.
    """
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(file.fileno(), 0, size_bytes)
        return
    block = bytes(min(size_bytes, _ZEROS_BYTES))
    file.writelines(block[: size_bytes - first] for first in range(0, size_bytes, _ZEROS_BYTES))


def read_at(descriptor: int, n_bytes: int, position: int) -> bytes:
    """Read from a place of a file that nobody else reads or writes meanwhile."""
    if hasattr(os, "pread"):
        return os.pread(descriptor, n_bytes, position)
    os.lseek(descriptor, position, os.SEEK_SET)
    return os.read(descriptor, n_bytes)


def usable_cores() -> int:
    """How many cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def address_space() -> int | None:
    """Bytes of memory that this process may ask for (`ulimit -v`); None without such a limit."""
    if _resource is None:
        return None
    limit = int(_resource.getrlimit(_resource.RLIMIT_AS)[0])
    return None if limit == _resource.RLIM_INFINITY else limit


def children_processor_s() -> float:
    """Processor seconds of all processes that this one started and waited for."""
    if _resource is None:
        times = os.times()
        return times.children_user + times.children_system
    used = _resource.getrusage(_resource.RUSAGE_CHILDREN)
    return float(used.ru_utime + used.ru_stime)


def adopt_orphans() -> None:
    """Make this process the parent of what descendants leave running, where the kernel can.

    A process that was started in a session of its own is then found below the one that is to end
    with it, also when what started it has ended.
    """
    if sys.platform == "linux":
        with suppress(OSError, AttributeError):
            ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)


class FileLock(Protocol):
    """A lock on a file between processes; that of a dead process is free."""

    def take(self, *, is_shared: bool, waits: bool) -> bool:
        """Take it; False where it does not wait and somebody else holds it.

        Raises:
            OSError: the file system has no locks.
        """

    def close(self) -> None:
        """Let it go, before the file is closed."""


class _KernelLock:
    """A lock of the kernel on an open file."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor

    def take(self, *, is_shared: bool, waits: bool) -> bool:
        """See `FileLock`."""
        mode = _fcntl.LOCK_SH if is_shared else _fcntl.LOCK_EX
        try:
            _fcntl.flock(self._descriptor, mode | (0 if waits else _fcntl.LOCK_NB))
        except BlockingIOError:
            return False
        return True

    def close(self) -> None:
        """Do nothing: the kernel lets it go with the file."""


class _DatabaseLock:
    """A lock that SQLite holds on an empty database beside the file, as the system lets it."""

    def __init__(self, path: Path) -> None:
        self._path = path.with_name(f"{path.name}.lock")
        self._connection: sqlite3.Connection | None = None

    def take(self, *, is_shared: bool, waits: bool) -> bool:
        """See `FileLock`."""
        try:
            self._connection = sqlite3.connect(
                self._path,
                timeout=_FOREVER_S if waits else 0.0,
                isolation_level=None,
                check_same_thread=False,
            )
            self._connection.execute("BEGIN" if is_shared else "BEGIN EXCLUSIVE")
            # Read locks are taken with the first look.
            self._connection.execute("SELECT count(*) FROM sqlite_master").fetchone()
        except sqlite3.OperationalError as error:
            self.close()
            if "locked" in str(error):
                return False
            raise OSError(str(error)) from error
        return True

    def close(self) -> None:
        """See `FileLock`."""
        if self._connection is not None:
            self._connection.close()
            self._connection = None


def file_lock(path: Path, descriptor: int) -> FileLock:
    """Return the lock of a file.

    Args:
        path: of the file.
        descriptor: the same file, open; the caller closes it, after the lock.
    """
    return _DatabaseLock(path) if _fcntl is None else _KernelLock(descriptor)


def lock_where_possible(descriptor: int, *, is_shared: bool) -> None:
    """Lock an open file until it is closed, where the kernel has locks for that."""
    if _fcntl is not None:
        _KernelLock(descriptor).take(is_shared=is_shared, waits=True)


@contextmanager
def working_folder_kept() -> Iterator[None]:
    """Come back to the working folder, where the system can, even if it has no name any more."""
    if not hasattr(os, "O_PATH"):
        before = Path.cwd()
        try:
            yield
        finally:
            os.chdir(before)
        return
    folder = os.open(".", os.O_PATH)
    try:
        yield
    finally:
        os.fchdir(folder)
        os.close(folder)
