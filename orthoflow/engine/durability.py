"""Writing that survives a kill, JSON with its own digest, and locks between processes."""

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

# Errors in the store that are not the fault of a method.
_BROKEN = frozenset({errno.EIO, errno.ESTALE, errno.EROFS, errno.ENODEV, errno.ENXIO})


def is_broken(error: OSError, folder: Path) -> bool:
    """Whether an error means that the disk of a folder fails, and not that it is full."""
    if error.errno not in _BROKEN:
        return False
    # Descriptors have no names.
    named = isinstance(error.filename, str | bytes)
    return not named or Path(os.fsdecode(error.filename)).is_relative_to(folder)


def store_error(error: OSError, folder: Path) -> StoreError:
    """Turn an error of the operating system into one sentence that names the folder."""
    reason = error.strerror or str(error)
    failure = StoreError(
        f"cannot write to {folder}: {reason}; make that possible, or choose another folder"
    )
    failure.errno = error.errno
    return failure


@contextmanager
def writing_to(folder: Path) -> Iterator[None]:
    """Turn every OSError inside into a StoreError that names the folder.

    Raises:
        StoreError: full disk, no permission, or another failure of the disk.
    """
    try:
        yield
    except StoreError:
        raise
    except OSError as error:
        raise store_error(error, folder) from error


def sync(path: Path) -> None:
    """Make the content of a closed file, or the names in a folder, survive a power cut."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sync_tree(folder: Path) -> None:
    """Make everything below a folder survive a power cut, except its own name."""
    for path in (*folder.rglob("*"), folder):
        sync(path)


def write_whole(path: Path, content: bytes) -> None:
    """Write a temporary file and rename it; readers see the old one or the new one.

    Raises:
        StoreError: the disk cannot be written.
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
    """Rename a finished folder into place.

    Returns:
        False if another writer was first; the new folder then stays where it is.

    Raises:
        StoreError: the disk cannot be written.
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
    """Yield the name of a folder to create and fill; it gets its final name if the block succeeds.

    Raises:
        StoreError: the disk cannot be written.
    """
    aside = final.with_name(f".{final.name}.unfinished")
    remove_tree(aside)
    try:
        with writing_to(final):
            if os.path.lexists(aside):
                # A part that could not be removed would be passed on with the rest: this states
                # why.
                shutil.rmtree(aside)
            yield aside
            sync_tree(aside)
            if final.is_dir():
                final.rmdir()
        place_folder(aside, final)
    finally:
        remove_tree(aside)


def remove_tree(folder: Path) -> None:
    """Remove a folder or file that may be gone already, or be removed by another meanwhile."""
    if folder.is_symlink() or folder.is_file():
        folder.unlink(missing_ok=True)
        return
    # Before Python 3.13 it recurses for every level.
    with suppress(RecursionError):
        shutil.rmtree(folder, ignore_errors=True)


def folder_size(folder: Path) -> int:
    """Return the size of all files below a folder, 0 if it is missing."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def size_of(path: Path) -> int:
    """Bytes of a file, or of all files below a folder; a link counts for itself."""
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
    """Whether a text has the digest that it begins with; False without a digest."""
    found = _DIGEST.match(text)
    return found is not None and found[1] == _sha256(f"{{{text[found.end() :]}")


def _sha256(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def lock_file(path: Path, descriptor: int, *, is_shared: bool = False, waits: bool = False) -> bool:
    """Lock an open file until it is closed, or its process ends.

    Args:
        path: of the file, for the message.
        descriptor: the same file, open.
        is_shared: others may hold it too, if theirs is shared.
        waits: until nobody else holds it.

    Returns:
        False if another one holds it.

    Raises:
        StoreError: the file system has no locks.
    """
    import fcntl  # noqa: PLC0415 - only of Unix, where runs run

    mode = fcntl.LOCK_SH if is_shared else fcntl.LOCK_EX
    try:
        fcntl.flock(descriptor, mode | (0 if waits else fcntl.LOCK_NB))
    except BlockingIOError:
        return False
    except OSError as error:
        raise StoreError(
            f"cannot lock {path}: {error.strerror or error}; it must lie on a file system with "
            "locks"
        ) from error
    return True


@contextmanager
def shared_lock(path: Path) -> Iterator[None]:
    """Hold a lock file together with others; waits while another process holds it alone.

    Raises:
        StoreError: the lock file cannot be created, or the file system has no locks.
    """
    with _opened_lock(path) as descriptor:
        lock_file(path, descriptor, is_shared=True, waits=True)
        yield


@contextmanager
def exclusive_lock(path: Path, busy: str) -> Iterator[None]:
    """Hold a lock file alone; never waits.

    Args:
        path: lock file, created if missing.
        busy: the message if another process holds it.

    Raises:
        StoreError: another process holds it, or as for `shared_lock`.
    """
    with _opened_lock(path) as descriptor:
        if not lock_file(path, descriptor):
            raise StoreError(busy)
        yield


def is_locked(path: Path) -> bool:
    """Whether a living process holds a lock file alone; False if there is none."""
    with suppress(OSError, StoreError), open_file(path) as file:
        # Shared, so that two such checks do not mistake each other for holders.
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
