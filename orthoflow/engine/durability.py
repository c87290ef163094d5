"""Crash-safe writing of files, JSON that contains its own digest, and locks between processes."""

from __future__ import annotations

import errno
import hashlib
import os
import re
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final

from orthoflow.errors import StoreError
from orthoflow.untrusted_text import open_file

# These errors are caused by the disk, not by a method.
_BROKEN = frozenset({errno.EIO, errno.ESTALE, errno.EROFS, errno.ENODEV, errno.ENXIO})


def is_broken(error: OSError, folder: Path) -> bool:
    """Whether an error means that the disk of a folder has failed, and not that it is full."""
    if error.errno not in _BROKEN:
        return False
    # An error that concerns a file descriptor contains no path.
    named = isinstance(error.filename, str | bytes)
    return not named or Path(os.fsdecode(error.filename)).is_relative_to(folder)


def store_error(error: OSError, folder: Path) -> StoreError:
    """Convert an OSError into a StoreError with a one-sentence message that names the folder."""
    reason = error.strerror or str(error)
    failure = StoreError(f"cannot write to {folder}: {reason}; fix this, or choose another folder")
    failure.errno = error.errno
    return failure


@contextmanager
def writing_to(folder: Path) -> Iterator[None]:
    """Convert any OSError raised in the block into a StoreError that names the folder.

    Raises:
        StoreError: the disk is full or fails, or permission is denied.
    """
    try:
        yield
    except StoreError:
        raise
    except OSError as error:
        raise store_error(error, folder) from error


def sync(path: Path) -> None:
    """Flush a closed file, or the names in a folder, to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sync_tree(folder: Path) -> None:
    """Flush everything in a folder to the disk, but not the name of the folder itself."""
    for path in (*folder.rglob("*"), folder):
        sync(path)


def write_whole(path: Path, content: bytes) -> None:
    """Replace a file atomically, so that readers see either its old or its new content.

    Raises:
        StoreError: the disk cannot be written to.
    """
    aside = path.with_name(f".{path.name[:40]}-{uuid.uuid4().hex}")
    with writing_to(path.parent):
        try:
            with aside.open("wb") as stream:
                stream.write(content)
                stream.flush()
                os.fsync(stream.fileno())
            aside.replace(path)
        except OSError:
            aside.unlink(missing_ok=True)
            raise
        sync(path.parent)


def place_folder(aside: Path, final: Path) -> bool:
    """Rename a finished folder to its final name.

    Returns:
        False if another process has already created the final folder; the new folder then keeps
        its temporary name.

    Raises:
        StoreError: the disk cannot be written to.
    """
    with writing_to(final.parent):
        final.parent.mkdir(parents=True, exist_ok=True)
        sync(aside)
        try:
            aside.rename(final)
        except OSError as error:
            if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
                raise
            return False
        sync(final.parent)
    return True


@contextmanager
def whole_folder(final: Path) -> Iterator[Path]:
    """Yield a path at which the block creates a folder; rename it to `final` at the end.

    If the block fails, no folder exists at `final`.

    Raises:
        StoreError: the disk cannot be written to.
    """
    aside = final.with_name(f".{final.name}.unfinished")
    remove_tree(aside)
    try:
        with writing_to(final):
            if os.path.lexists(aside):
                # Raise an error if a leftover of an earlier attempt cannot be removed, because it
                # would become part of the new folder.
                shutil.rmtree(aside)
            yield aside
            sync_tree(aside)
            if final.is_dir():
                final.rmdir()
        place_folder(aside, final)
    finally:
        remove_tree(aside)


def remove_tree(folder: Path) -> None:
    """Remove a folder or file; it may be missing, or other processes may be removing it."""
    if folder.is_symlink() or folder.is_file():
        folder.unlink(missing_ok=True)
        return
    # Before Python 3.13, `rmtree` recurses once per folder level.
    with suppress(RecursionError):
        shutil.rmtree(folder, ignore_errors=True)


def folder_size(folder: Path) -> int:
    """Return the size of all files in a folder and its subfolders; 0 if it is missing."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def size_of(path: Path) -> int:
    """Return the size of a file, or of all files in a folder; links are not followed."""
    if path.is_dir() and not path.is_symlink():
        return folder_size(path)
    return path.lstat().st_size


_DIGEST: Final = re.compile(r'\{"sha256":"([0-9a-f]{64})",')


def with_digest(text: str) -> str:
    """Insert the SHA-256 of a JSON object's text as its first entry.

    >>> with_digest('{"a":1}')[:24]
    '{"sha256":"015abd7f5cc57'
    """
    return f'{{"sha256":"{_sha256(text)}",{text[1:]}'


def is_checked(text: str) -> bool:
    """Whether a JSON text matches the digest at its beginning; False if there is no digest."""
    found = _DIGEST.match(text)
    return found is not None and found[1] == _sha256(f"{{{text[found.end() :]}")


def _sha256(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def lock_file(path: Path, descriptor: int, *, is_shared: bool = False, waits: bool = False) -> bool:
    """Lock an open file until the file is closed or this process ends.

    Args:
        path: path of the file, for the error message.
        descriptor: file descriptor of the same file.
        is_shared: whether to allow other shared locks at the same time.
        waits: whether to wait until other processes release the file.

    Returns:
        False if another process holds the lock.

    Raises:
        StoreError: the file system does not support locks.
    """
    import fcntl  # noqa: PLC0415 - only of Unix, where runs run

    mode = fcntl.LOCK_SH if is_shared else fcntl.LOCK_EX
    try:
        fcntl.flock(descriptor, mode | (0 if waits else fcntl.LOCK_NB))
    except BlockingIOError:
        return False
    except OSError as error:
        raise StoreError(
            f"cannot lock {path}: {error.strerror or error}; use a file system that supports locks"
        ) from error
    return True


@contextmanager
def shared_lock(path: Path) -> Iterator[None]:
    """Hold a shared lock on a file; wait until no other process holds an exclusive lock.

    Raises:
        StoreError: the lock file cannot be created, or the file system does not support locks.
    """
    with _opened_lock(path) as descriptor:
        lock_file(path, descriptor, is_shared=True, waits=True)
        yield


@contextmanager
def exclusive_lock(path: Path, busy: str) -> Iterator[None]:
    """Hold an exclusive lock on a file; raise an error instead of waiting.

    Args:
        path: lock file, created if missing.
        busy: error message if another process holds the lock.

    Raises:
        StoreError: another process holds the lock, the lock file cannot be created, or the file
            system does not support locks.
    """
    with _opened_lock(path) as descriptor:
        if not lock_file(path, descriptor):
            raise StoreError(busy)
        yield


def is_locked(path: Path) -> bool:
    """Whether a running process holds an exclusive lock on a file; False if the file is missing."""
    with suppress(OSError, StoreError), open_file(path) as file:
        # Use a shared lock, so that two concurrent checks do not each report the other as the
        # holder.
        return not lock_file(path, file.fileno(), is_shared=True)
    return False


@contextmanager
def _opened_lock(path: Path) -> Iterator[int]:
    with writing_to(path.parent):
        path.parent.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        yield descriptor
    finally:
        os.close(descriptor)
