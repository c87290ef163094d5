"""Writing that survives a kill, JSON with its own digest, and locks between processes."""

from __future__ import annotations

import errno
import hashlib
import os
import re
import shutil
import subprocess
import uuid
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import Final

from orthoflow.errors import StoreError
from orthoflow.system import file_lock, flags

_REASONS = {
    errno.ENOSPC: "No space left on the disk; free some, or choose another folder",
    errno.EDQUOT: "the disk quota is used up; free some space, or choose another folder",
    errno.EFBIG: "the file would be larger than allowed here; choose another folder",
    errno.EIO: "Input/output error, the disk or its connection fails; choose another folder",
    errno.ESTALE: "Stale file handle, the disk is not connected any more; reconnect it",
    errno.EROFS: "the disk is read-only; choose another folder",
    errno.EACCES: "permission is denied; choose another folder",
    errno.EPERM: "permission is denied; choose another folder",
    errno.ENOTDIR: "a file stands where a folder is needed; choose another folder",
}

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
    reason = _REASONS.get(error.errno or 0, error.strerror or str(error))
    failure = StoreError(f"cannot write to {folder}: {reason}")
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


def sync_folder(folder: Path) -> None:
    """Make renames in a folder survive a power cut, if the system can sync folders."""
    if not hasattr(os, "O_DIRECTORY"):
        return
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sync_file(path: Path) -> None:
    """Make the content of a closed file survive a power cut."""
    # Windows only syncs files opened for writing.
    descriptor = os.open(path, flags("O_RDWR" if os.name == "nt" else "O_RDONLY"))
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sync_tree(folder: Path) -> None:
    """Make everything below a folder survive a power cut, except its own name."""
    folders = [folder]
    for path in folder.rglob("*"):
        if path.is_dir():
            folders.append(path)
        else:
            sync_file(path)
    for path in folders:
        sync_folder(path)


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
        sync_folder(path.parent)


def place_folder(aside: Path, final: Path) -> bool:
    """Rename a finished folder into place.

    Returns:
        False if another writer was first; the new folder is then removed.

    Raises:
        StoreError: the disk cannot be written.
    """
    with writing_to(final.parent):
        final.parent.mkdir(parents=True, exist_ok=True)
        sync_folder(aside)
        try:
            aside.rename(final)
        except OSError as error:
            if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
                raise
            remove_tree(aside)
            return False
        sync_folder(final.parent)
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
    try:
        shutil.rmtree(folder, ignore_errors=True)
    except RecursionError:
        # Before Python 3.13 it recurses for every level, and there may be thousands.
        subprocess.run(["rm", "-rf", "--", folder], stderr=subprocess.DEVNULL, check=False)


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


@contextmanager
def shared_lock(path: Path) -> Iterator[None]:
    """Hold a shared lock; waits while another process holds it exclusively.

    Raises:
        StoreError: the lock file cannot be created, or the file system has no locks.
    """
    with _lock(path, is_shared=True, waits=True):
        yield


@contextmanager
def exclusive_lock(path: Path, busy: str) -> Iterator[None]:
    """Hold an exclusive lock; never waits.

    Args:
        path: lock file, created if missing.
        busy: the sentence in case another process holds it.

    Raises:
        StoreError: another process holds it, or it cannot be created.
    """
    with _lock(path, is_shared=False, waits=False) as is_held:
        if not is_held:
            raise StoreError(busy)
        yield


def is_locked(path: Path) -> bool:
    """Whether a living process holds the lock file, shared or exclusively."""
    if not path.exists():
        return False
    with _lock(path, is_shared=False, waits=False) as is_held:
        return not is_held


@contextmanager
def _lock(path: Path, *, is_shared: bool, waits: bool) -> Iterator[bool]:
    with writing_to(path.parent):
        path.parent.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(path, flags("O_RDWR", "O_CREAT"), 0o666)
    with ExitStack() as stack:
        stack.callback(os.close, descriptor)
        lock = stack.enter_context(closing(file_lock(path, descriptor)))
        try:
            is_held = lock.take(is_shared=is_shared, waits=waits)
        except OSError as error:
            raise StoreError(
                f"cannot lock {path}: {error.strerror or error}; the store must lie on a file "
                "system with locks"
            ) from error
        yield is_held
