"""Writing HDF5 so that a full disk is an ordinary error.

HDF5 cannot close a file that cannot be written to: the library keeps it open, complains again from
destructors, and may crash the process at exit. It therefore writes through a sink that always
succeeds, remembers the first error, and raises it once HDF5 is out of the way.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final

import h5py

# Readable by HDF5 1.10 and newer; from 1.10 on all of HDF5's own structures carry checksums.
_LIBRARY_VERSIONS: Final = (h5py.h5f.LIBVER_V110, h5py.h5f.LIBVER_V110)
# Arrays that are worth mapping start at a multiple of this, so that mapped arrays are aligned.
_ALIGNMENT_BYTES: Final = 64
_ALIGNED_FROM_BYTES: Final = 2048
# After a failed write, data blocks are dropped, but HDF5 must be able to read its structures back.
_KEPT_AFTER_FAILURE_BYTES: Final = 64 << 10


def _read_at(descriptor: int, n_bytes: int, position: int) -> bytes:
    if hasattr(os, "pread"):
        return os.pread(descriptor, n_bytes, position)
    # Windows has no such call; a sink has one thread.
    os.lseek(descriptor, position, os.SEEK_SET)
    return os.read(descriptor, n_bytes)


def _write_at(descriptor: int, data: memoryview, position: int) -> int:
    if hasattr(os, "pwrite"):
        return os.pwrite(descriptor, data, position)
    os.lseek(descriptor, position, os.SEEK_SET)
    return os.write(descriptor, data)


class FileSink:
    """A file that HDF5 writes to; writing never raises.

    Attributes:
        failure: the first error of the operating system, None while all is well.
    """

    def __init__(self, path: Path) -> None:
        # Through a link it would be another's file that is emptied.
        flags = os.O_RDWR | os.O_CREAT | os.O_TRUNC
        for name in ("O_NOFOLLOW", "O_CLOEXEC", "O_BINARY"):
            flags |= int(getattr(os, name, 0))
        if not hasattr(os, "O_NOFOLLOW") and path.is_symlink():
            raise OSError(errno.ELOOP, os.strerror(errno.ELOOP), str(path))
        self._descriptor = os.open(path, flags, 0o666)
        self._position = 0
        self._kept: list[tuple[int, bytes]] = []
        self._kept_end = 0
        self.failure: OSError | None = None

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Move the position; HDF5 uses it to ask for the size as well."""
        if whence == os.SEEK_END:
            size = os.fstat(self._descriptor).st_size
            self._position = max(size, self._kept_end) + offset
        elif whence == os.SEEK_CUR:
            self._position += offset
        else:
            self._position = offset
        return self._position

    def tell(self) -> int:
        """Give the position."""
        return self._position

    def write(self, data: memoryview) -> int:
        """Write all of the data at the position."""
        view = memoryview(data).cast("B")
        if self.failure is None:
            try:
                self._write_all(view)
            except OSError as error:
                self.failure = error
        if self.failure is not None and len(view) <= _KEPT_AFTER_FAILURE_BYTES:
            self._kept.append((self._position, bytes(view)))
            self._kept_end = max(self._kept_end, self._position + len(view))
        self._position += len(view)
        return len(view)

    def readinto(self, buffer: memoryview) -> int:
        """Read at the position; what was never written is zeros."""
        view = memoryview(buffer).cast("B")
        stored = _read_at(self._descriptor, len(view), self._position)
        view[: len(stored)] = stored
        view[len(stored) :] = bytes(len(view) - len(stored))
        for offset, data in self._kept:
            start = max(offset, self._position)
            stop = min(offset + len(data), self._position + len(view))
            if start < stop:
                view[start - self._position : stop - self._position] = data[
                    start - offset : stop - offset
                ]
        self._position += len(view)
        return len(view)

    def truncate(self, size: int) -> int:
        """Set the length of the file."""
        if self.failure is None:
            try:
                os.ftruncate(self._descriptor, size)
            except OSError as error:
                self.failure = error
        return size

    def flush(self) -> None:
        """Do nothing: `close` brings the data to the disk, once."""

    def close(self) -> None:
        """Bring the data to the disk and close the file.

        Raises:
            OSError: writing failed now or before.
        """
        try:
            if self.failure is None:
                os.fsync(self._descriptor)
        finally:
            os.close(self._descriptor)
        if self.failure is not None:
            raise self.failure

    def _write_all(self, view: memoryview) -> None:
        done = 0
        while done < len(view):
            done += _write_at(self._descriptor, view[done:], self._position + done)


@contextmanager
def create_file(path: Path) -> Iterator[h5py.File]:
    """Create an HDF5 file and bring it to the disk; what stood at `path` before is lost.

    A file that could not be completed is removed.

    Raises:
        OSError: the file cannot be created or written, e.g. because the disk is full.
    """
    sink = FileSink(path)
    try:
        file = _open_through(sink, path)
        try:
            yield file
        finally:
            file.close()
    except BaseException as error:
        failure = sink.failure
        with suppress(OSError):
            sink.close()
        path.unlink(missing_ok=True)
        if failure is not None and isinstance(error, Exception):
            raise failure from error
        raise
    try:
        sink.close()
    except OSError:
        path.unlink(missing_ok=True)
        raise


def create_group(parent: h5py.Group, name: str) -> h5py.Group:
    """Create a group without time stamps: equal content gives equal files."""
    properties = h5py.h5p.create(h5py.h5p.GROUP_CREATE)
    properties.set_obj_track_times(False)
    return h5py.Group(h5py.h5g.create(parent.id, name.encode("utf-8"), gcpl=properties))


def _open_through(sink: FileSink, path: Path) -> h5py.File:
    access = h5py.h5p.create(h5py.h5p.FILE_ACCESS)
    access.set_fclose_degree(h5py.h5f.CLOSE_STRONG)
    access.set_libver_bounds(*_LIBRARY_VERSIONS)
    access.set_alignment(_ALIGNED_FROM_BYTES, _ALIGNMENT_BYTES)
    access.set_fileobj_driver(h5py.h5fd.fileobj_driver, sink)
    creation = h5py.h5p.create(h5py.h5p.FILE_CREATE)
    creation.set_obj_track_times(False)
    name = os.fsencode(path)
    return h5py.File(h5py.h5f.create(name, h5py.h5f.ACC_TRUNC, fapl=access, fcpl=creation))
