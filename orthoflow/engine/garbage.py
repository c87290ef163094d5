"""Garbage collection: what no result needs, what is damaged, and what was not used for long."""

from __future__ import annotations

import contextlib
import shutil
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from orthoflow.engine.durability import size_of
from orthoflow.engine.failures import Failures
from orthoflow.engine.locks import exclusive_lock
from orthoflow.engine.store import Store
from orthoflow.engine.store_folder import is_store, require_store
from orthoflow.errors import ArgumentError

_DAY_S: Final = 86_400.0


@dataclass(frozen=True, kw_only=True)
class GarbageReport:
    """What garbage collection removed, or would remove.

    Attributes:
        n_results: results.
        n_objects: products and figures.
        n_damaged: what had been set aside because it was damaged.
        freed_bytes: bytes of everything removed.
    """

    n_results: int
    n_objects: int
    n_damaged: int
    freed_bytes: int


def collect_garbage(
    store: Store, *, older_than_days: float | None = None, dry_run: bool = False
) -> GarbageReport:
    """Remove incomplete results, products without results, what is damaged or left by killed runs.

    Args:
        store: the store; no run may use it meanwhile.
        older_than_days: also remove results that no run used for so many days; 0 removes all.
        dry_run: only say what would go.

    Raises:
        ArgumentError: the number of days is negative, or something else lies in the folder.
        StoreError: a run uses the store.
    """
    if older_than_days is not None and older_than_days < 0:
        raise ArgumentError(f"days must be 0 or more, got {older_than_days:g}")
    require_store(store.folder)
    if not is_store(store.folder):
        return GarbageReport(n_results=0, n_objects=0, n_damaged=0, freed_bytes=0)
    busy = f"the store {store.folder} is in use by a run; wait until it has ended"
    with exclusive_lock(store.lock_file, busy):
        return _collect(store, older_than_days, is_dry=dry_run)


def _collect(store: Store, older_than_days: float | None, *, is_dry: bool) -> GarbageReport:
    results = tuple(_useless_results(store, older_than_days))
    gone = {path.stem for path in results}
    kept = _kept_objects(store, gone)
    objects = tuple(path for path in _children(store.objects) if path.name not in kept)
    preimages = tuple(
        path
        for path in store.preimages.glob("*/*.json")
        if path.stem in gone or not (store.results / path.name).exists()
    )
    damaged = _children(store.damaged)
    failures = _children(Failures.of_store(store.folder).folder)
    rest = (
        *damaged,
        *failures,
        *_children(store.scratch),
        *_half_written(store),
    )
    freed = sum(size_of(path) for path in (*results, *objects, *preimages, *rest))
    if not is_dry:
        # Results first: killed in between, no result is left whose objects are gone.
        for path in (*results, *preimages, *objects, *rest):
            _remove(path)
    return GarbageReport(
        n_results=len(results),
        n_objects=len(objects),
        n_damaged=len(damaged),
        freed_bytes=freed,
    )


def _useless_results(store: Store, older_than_days: float | None) -> Iterator[Path]:
    for path in sorted(store.results.glob("*.json")):
        age_days = (time.time() - path.lstat().st_mtime) / _DAY_S
        is_old = older_than_days is not None and age_days >= older_than_days
        if is_old or store.result(path.stem) is None:
            yield path


def _kept_objects(store: Store, gone: set[str]) -> set[str]:
    kept: set[str] = set()
    for path in store.results.glob("*.json"):
        result = None if path.stem in gone else store.result(path.stem)
        if result is not None:
            kept |= result.objects
    return kept


def _half_written(store: Store) -> Iterator[Path]:
    for folder in (store.results, store.preimages):
        yield from (path for path in folder.glob("**/.*-*") if path.is_file())


def _children(folder: Path) -> tuple[Path, ...]:
    return tuple(sorted(folder.iterdir())) if folder.is_dir() else ()


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with contextlib.suppress(FileNotFoundError):
            path.unlink()
