"""Locks between processes that share a store or a run folder; a dead holder's lock is free."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from orthoflow.engine.durability import writing_to
from orthoflow.errors import StoreError
from orthoflow.system import FileLock, file_lock, flags


@contextmanager
def shared_lock(path: Path) -> Iterator[None]:
    """Hold a lock that many may hold at once; waits while one holds it exclusively.

    Raises:
        StoreError: the lock file cannot be made, or the file system has no locks.
    """
    with _waited_for(path, is_shared=True):
        yield


@contextmanager
def taking_turns(path: Path) -> Iterator[None]:
    """Hold a lock alone; waits while somebody else holds it.

    Raises:
        StoreError: the lock file cannot be made, or the file system has no locks.
    """
    with _waited_for(path, is_shared=False):
        yield


@contextmanager
def exclusive_lock(path: Path, busy: str) -> Iterator[None]:
    """Hold a lock alone; never waits.

    Args:
        path: lock file, made when missing.
        busy: the sentence for the case that somebody holds it.

    Raises:
        StoreError: somebody holds it, or it cannot be made.
    """
    with _opened(path) as lock:
        if not _taken(lock, path, is_shared=False, waits=False):
            raise StoreError(busy)
        yield


def is_locked(path: Path) -> bool:
    """Whether a living process holds the lock file, shared or alone."""
    if not path.exists():
        return False
    with _opened(path) as lock:
        return not _taken(lock, path, is_shared=False, waits=False)


@contextmanager
def _waited_for(path: Path, *, is_shared: bool) -> Iterator[None]:
    with _opened(path) as lock:
        _taken(lock, path, is_shared=is_shared, waits=True)
        yield


@contextmanager
def _opened(path: Path) -> Iterator[FileLock]:
    with writing_to(path.parent):
        path.parent.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(path, flags("O_RDWR", "O_CREAT"), 0o666)
    lock = file_lock(path, descriptor)
    try:
        yield lock
    finally:
        lock.close()
        os.close(descriptor)


def _taken(lock: FileLock, path: Path, *, is_shared: bool, waits: bool) -> bool:
    try:
        return lock.take(is_shared=is_shared, waits=waits)
    except OSError as error:
        raise StoreError(
            f"cannot lock {path}: {error.strerror or error}; the store must lie on a file system "
            "with locks"
        ) from error
