"""Locks between processes that share a store or a run folder; a dead holder's lock is free."""

from __future__ import annotations

import errno
import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from orthoflow.engine.durability import writing_to
from orthoflow.errors import StoreError


@contextmanager
def shared_lock(path: Path) -> Iterator[None]:
    """Hold a lock that many may hold at once; waits while one holds it exclusively.

    Raises:
        StoreError: the lock file cannot be made, or the file system has no locks.
    """
    with _waited_for(path, fcntl.LOCK_SH):
        yield


@contextmanager
def taking_turns(path: Path) -> Iterator[None]:
    """Hold a lock alone; waits while somebody else holds it.

    Raises:
        StoreError: the lock file cannot be made, or the file system has no locks.
    """
    with _waited_for(path, fcntl.LOCK_EX):
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
    descriptor = _open(path)
    try:
        if not _lock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB, path):
            raise StoreError(busy)
        yield
    finally:
        os.close(descriptor)


def is_locked(path: Path) -> bool:
    """Whether a living process holds the lock file, shared or alone."""
    try:
        descriptor = os.open(path, os.O_RDWR)
    except FileNotFoundError:
        return False
    try:
        return not _lock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB, path)
    finally:
        os.close(descriptor)


@contextmanager
def _waited_for(path: Path, operation: int) -> Iterator[None]:
    descriptor = _open(path)
    try:
        _lock(descriptor, operation, path)
        yield
    finally:
        os.close(descriptor)


def _open(path: Path) -> int:
    with writing_to(path.parent):
        path.parent.mkdir(parents=True, exist_ok=True)
        return os.open(path, os.O_RDWR | os.O_CREAT, 0o666)


def _lock(descriptor: int, mode: int, path: Path) -> bool:
    try:
        fcntl.flock(descriptor, mode)
    except OSError as error:
        if error.errno == errno.EWOULDBLOCK:
            return False
        raise StoreError(
            f"cannot lock {path}: {error.strerror}; the store must lie on a file system with locks"
        ) from error
    return True
