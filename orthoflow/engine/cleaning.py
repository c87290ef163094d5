"""Cleaning of a store: removal of damaged and unneeded files."""

from __future__ import annotations

import re
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from orthoflow.engine.durability import exclusive_lock, remove_tree, shared_lock, size_of
from orthoflow.engine.store import Store, is_store, require_store
from orthoflow.errors import ArgumentError

_DAY_S: Final = 86_400.0


@dataclass(frozen=True, kw_only=True)
class Damage:
    """A damaged file or result that was removed.

    Attributes:
        name: path relative to the store's folder.
        what: name of the damaged file; for a result, names of the damaged or missing files that it
            refers to.
    """

    name: str
    what: str


@dataclass(frozen=True, kw_only=True)
class Soundness:
    """Result of checking a store.

    Attributes:
        n_results: number of intact results.
        n_objects: number of intact products and figures.
        damaged: damaged files and results, which have been removed.
    """

    n_results: int
    n_objects: int
    damaged: tuple[Damage, ...]


def check_store(store: Store) -> Soundness:
    """Check all objects and results. Other processes may use the store at the same time.

    Damaged files, and results whose products or figures are missing, are removed.

    Raises:
        ArgumentError: the folder is not a store.
        StoreError: the store cannot be read, or a damaged file cannot be removed.
    """
    require_store(store.folder)
    if not is_store(store.folder):
        return Soundness(n_results=0, n_objects=0, damaged=())
    with shared_lock(store.lock_file):
        names = _named_by_digest(store.objects)
        files = {name: store.damage(name) for name in names}
        keys = _named_by_digest(store.results)
        reasons = {key: store.remove_unusable(key) for key in keys}
    objects = [Damage(name=f"objects/{n}", what=file) for n, file in files.items() if file]
    results = [Damage(name=f"results/{key}.json", what=why) for key, why in reasons.items() if why]
    return Soundness(
        n_results=len(keys) - len(results),
        n_objects=len(names) - len(objects),
        damaged=(*objects, *results),
    )


def _named_by_digest(folder: Path) -> tuple[str, ...]:
    names = (path.name.removesuffix(".json") for path in folder.glob("*"))
    return tuple(sorted(name for name in names if re.fullmatch("[0-9a-f]{64}", name)))


@dataclass(frozen=True, kw_only=True)
class GarbageReport:
    """Result of a garbage collection, or of a dry run.

    Attributes:
        n_results: number of results removed.
        n_objects: number of products and figures removed.
        freed_bytes: total size of the removed files.
    """

    n_results: int
    n_objects: int
    freed_bytes: int


def collect_garbage(
    store: Store, *, older_than_days: float | None = None, dry_run: bool = False
) -> GarbageReport:
    """Remove incomplete results, products without results, and leftovers of interrupted runs.

    Args:
        store: the store; it must not be in use by a run.
        older_than_days: also remove results that no run has used for this many days; 0 removes all
            results.
        dry_run: only report what would be removed.

    Raises:
        ArgumentError: the number of days is negative, or the folder is not a store.
        StoreError: the store is in use by a run.
    """
    if older_than_days is not None and older_than_days < 0:
        raise ArgumentError(f"days must be 0 or more, got {older_than_days:g}")
    require_store(store.folder)
    if not is_store(store.folder):
        return GarbageReport(n_results=0, n_objects=0, freed_bytes=0)
    busy = f"the store {store.folder} is in use by a run; wait until it has ended"
    with exclusive_lock(store.lock_file, busy):
        return _collect(store, older_than_days, is_dry=dry_run)


def _collect(store: Store, older_than_days: float | None, *, is_dry: bool) -> GarbageReport:
    results: list[Path] = []
    kept: set[str] = set()
    for path in sorted(store.results.glob("*.json")):
        age_days = (time.time() - path.lstat().st_mtime) / _DAY_S
        result = store.result(path.stem)
        if result is None or (older_than_days is not None and age_days >= older_than_days):
            results.append(path)
        else:
            kept |= result.objects
    objects = [path for path in _children(store.objects) if path.name not in kept]
    half_written = store.results.glob(".*-*")
    # Remove the results before their objects: if the process is killed in between, no result lacks
    # its objects.
    unneeded = (*results, *objects, *_children(store.scratch), *half_written)
    freed_bytes = sum(size_of(path) for path in unneeded)
    for path in () if is_dry else unneeded:
        remove_tree(path)
    return GarbageReport(n_results=len(results), n_objects=len(objects), freed_bytes=freed_bytes)


def _children(folder: Path) -> tuple[Path, ...]:
    return tuple(sorted(folder.iterdir())) if folder.is_dir() else ()
