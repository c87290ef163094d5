"""A file layer that fails at the n-th operation, for the process that puts it in place.

It stands between Python and the system, below everything that writes here: HDF5 too writes through
`os.pwrite` (`orthoflow_provenance.hdf5`). Only what lies in folders below one folder is counted.
"""

from __future__ import annotations

import builtins
import contextlib
import errno
import io
import os
import random
import shutil
import signal
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

FAULTS = ("full disk", "bad disk", "kill", "power loss")
# How a disk fails; the first two also who reads.
_BROKEN = (errno.EIO, errno.ESTALE, errno.EROFS)
_READING = ("read", "look")
_FREEING = ("unlink", "rmdir")
_WRITING = os.O_WRONLY | os.O_RDWR
# Operations that are counted and then done, with what they do to their first argument.
_SIMPLE = {
    **dict.fromkeys(("write", "pwrite", "ftruncate", "sendfile", "posix_fallocate"), "write"),
    "pread": "read",
    "scandir": "look",
    "utime": "sync",
}
_NAMES = ("open", "fsync", "rename", "replace", "mkdir", "unlink", "rmdir", "link", *_SIMPLE)
_REAL = {name: getattr(os, name) for name in _NAMES if hasattr(os, name)}
_REAL_OPEN = io.open


@dataclass
class _Volatile:
    """What a loss of power would take back: bytes and names that nobody brought to the disk."""

    kept: Path
    dirty: set[int] = field(default_factory=set)
    names: list[tuple[Path, Callable[[], object]]] = field(default_factory=list)
    n_kept: int = 0

    def keep(self, path: Path) -> Path | None:
        """Keep what stands at a path, for the case that its going was never on the disk."""
        self.n_kept += 1
        copy = self.kept / str(self.n_kept)
        with contextlib.suppress(OSError):
            _REAL["link"](path, copy)
            return copy
        return None

    def sync(self, descriptor: int, path: Path) -> None:
        self.dirty.discard(os.fstat(descriptor).st_ino)
        if path.is_dir():
            self.names = [item for item in self.names if item[0] != path]

    def lose(self, folder: Path, rng: random.Random) -> None:
        """Take back a random part of it: the latest names, and the bytes of any file."""
        for path in [path for path in folder.rglob("*") if path.is_file()]:
            # What a thread has begun already may still rename a file.
            with contextlib.suppress(FileNotFoundError):
                if path.stat().st_ino in self.dirty and rng.random() < 0.7:
                    os.truncate(path, rng.choice((0, path.stat().st_size // 2)))
        for _, undo in reversed(self.names[rng.randint(0, len(self.names)) :]):
            with contextlib.suppress(OSError):
                undo()


class _File(io.FileIO):
    """A file of Python's own, whose reading and writing counts."""

    layer: FaultyFiles

    def write(self, data: Any) -> int:
        self.layer.step(Path(self.name), "write", self.fileno())
        return super().write(data) or 0

    def readinto(self, buffer: Any) -> int:
        self.layer.step(Path(self.name), "read")
        return super().readinto(buffer) or 0

    def readall(self) -> bytes:
        self.layer.step(Path(self.name), "read")
        return super().readall() or b""


class FaultyFiles:
    """The layer.

    Attributes:
        count: operations so far; those that a fault of this kind cannot befall are left out.
    """

    def __init__(self, folder: Path, fault: str, operation: int, seed: int) -> None:
        assert fault in FAULTS
        self.count = 0
        self._folder = folder
        self._fault = fault
        self._operation = operation
        self._rng = random.Random(seed)
        self._volatile = _Volatile(folder / ".kept")
        # Threads count one after the other, and none goes on while the power is lost.
        self._lock = threading.RLock()

    @contextlib.contextmanager
    def in_place(self) -> Iterator[None]:
        shutil.rmtree(self._volatile.kept, ignore_errors=True)  # of an earlier case
        self._volatile.kept.mkdir()
        for name in _REAL:
            if name in _SIMPLE:
                setattr(os, name, self._counted(name))
            elif hasattr(self, f"_{name}"):
                setattr(os, name, getattr(self, f"_{name}"))
        builtins.open = io.open = self._open_file
        try:
            yield
            if self._fault == "power loss" and self.count < self._operation:
                self._volatile.lose(self._folder, self._rng)
        finally:
            for name, real in _REAL.items():
                setattr(os, name, real)
            builtins.open = io.open = _REAL_OPEN

    def step(self, path: Path, what: str, descriptor: int = -1) -> None:
        """Count an operation on a path, and fail if it is the one.

        Raises:
            OSError: it is, or the disk has been full since.
        """
        if not path.is_relative_to(self._folder) or self._folder in (path, path.parent):
            return
        if what in _READING and self._fault != "bad disk":
            return
        if what in _FREEING and self._fault == "full disk":
            return
        with self._lock:
            self._befall(path, what, descriptor)

    def _befall(self, path: Path, what: str, descriptor: int) -> None:
        self.count += 1
        if what == "write" and descriptor >= 0:
            self._volatile.dirty.add(os.fstat(descriptor).st_ino)
        if self._fault == "full disk" and self.count >= self._operation:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        if self.count != self._operation:
            return
        if self._fault == "bad disk":
            number = self._rng.choice(_BROKEN[:2] if what in _READING else _BROKEN)
            raise OSError(number, os.strerror(number), str(path))
        if self._fault == "power loss":
            self._volatile.lose(self._folder, self._rng)
        os.kill(os.getpid(), signal.SIGKILL)

    def _named(self, path: Path, undo: Callable[[], object]) -> None:
        if path.is_relative_to(self._folder):
            self._volatile.names.append((path.parent, undo))

    def _open(self, path: Any, flags: int, mode: int = 0o777, *, dir_fd: int | None = None) -> int:
        place = _place(path, dir_fd)
        is_new = bool(flags & os.O_CREAT) and not place.exists()
        self.step(place, "create" if flags & _WRITING else "look")
        descriptor: int = _REAL["open"](path, flags, mode, dir_fd=dir_fd)
        if flags & _WRITING:
            self._opened(place, descriptor, is_new=is_new, is_emptied=bool(flags & os.O_TRUNC))
        return descriptor

    def _opened(self, path: Path, descriptor: int, *, is_new: bool, is_emptied: bool) -> None:
        if is_new:
            self._named(path, lambda: _REAL["unlink"](path))
        if is_new or is_emptied:
            self._volatile.dirty.add(os.fstat(descriptor).st_ino)

    # Any: the signature is that of `open`.
    def _open_file(
        self, file: Any, mode: str = "r", buffering: int = -1, *rest: Any, **more: Any
    ) -> Any:
        if (
            isinstance(file, int)
            or "opener" in more
            or not _place(file).is_relative_to(self._folder)
        ):
            return _REAL_OPEN(file, mode, buffering, *rest, **more)
        path = _place(file)
        is_writing = any(letter in mode for letter in "wax+")
        is_new = is_writing and not path.exists()
        self.step(path, "create" if is_writing else "look")
        raw = _File(os.fspath(path), mode.replace("b", "").replace("t", ""))
        raw.layer = self
        if is_writing:
            self._opened(path, raw.fileno(), is_new=is_new, is_emptied="w" in mode)
        # Only one of them: a buffer that is dropped closes what is below it.
        kind = io.BufferedRandom if "+" in mode else io.BufferedWriter
        buffered: Any = kind(raw) if is_writing else io.BufferedReader(raw)
        return buffered if "b" in mode else io.TextIOWrapper(buffered, *rest, **more)

    # Any: the arguments are those of the operation.
    def _counted(self, name: str) -> Callable[..., Any]:
        def call(first: Any = ".", *rest: Any, **more: Any) -> Any:
            path = _place(first)
            self.step(path, _SIMPLE[name], first if isinstance(first, int) else -1)
            return _REAL[name](first, *rest, **more)

        return call

    def _fsync(self, descriptor: int) -> None:
        path = _place_of(descriptor)
        self.step(path, "sync")
        _REAL["fsync"](descriptor)
        self._volatile.sync(descriptor, path)

    # Any: the arguments are those of the operation.
    def _rename(
        self, source: Any, target: Any, *, src_dir_fd: int | None = None, **more: Any
    ) -> None:
        old, new = _place(source, src_dir_fd), _place(target, more.get("dst_dir_fd"))
        self.step(new, "name")
        overwritten = self._volatile.keep(new)
        _REAL["rename"](old, new)

        def undo() -> None:
            _REAL["rename"](new, old)
            if overwritten is not None:
                _REAL["rename"](overwritten, new)

        self._named(new, undo)

    _replace = _rename

    def _mkdir(self, path: Any, mode: int = 0o777, *, dir_fd: int | None = None) -> None:
        place = _place(path, dir_fd)
        if not place.exists():
            self.step(place, "create")
        _REAL["mkdir"](path, mode, dir_fd=dir_fd)
        self._named(place, lambda: shutil.rmtree(place))

    def _unlink(self, path: Any, *, dir_fd: int | None = None) -> None:
        place = _place(path, dir_fd)
        self.step(place, "unlink")
        kept = self._volatile.keep(place)
        _REAL["unlink"](path, dir_fd=dir_fd)
        if kept is not None:
            self._named(place, lambda: _REAL["rename"](kept, place))

    def _rmdir(self, path: Any, *, dir_fd: int | None = None) -> None:
        place = _place(path, dir_fd)
        self.step(place, "rmdir")
        _REAL["rmdir"](path, dir_fd=dir_fd)
        self._named(place, lambda: _REAL["mkdir"](place))


def _place(path: Any, dir_fd: int | None = None) -> Path:
    if isinstance(path, int):
        return _place_of(path)
    inside = Path(os.fsdecode(path))
    return (_place_of(dir_fd) / inside if dir_fd is not None else Path.cwd() / inside).absolute()


def _place_of(descriptor: int) -> Path:
    return Path(f"/proc/self/fd/{descriptor}").readlink()
