"""Cleaning a store: damaged objects are set aside, and unneeded ones are removed."""

from __future__ import annotations

import contextlib
import re
import shutil
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from orthoflow.engine.durability import exclusive_lock, shared_lock, size_of
from orthoflow.engine.objects import WHOLE
from orthoflow.engine.store import Store, is_store, require_store
from orthoflow.errors import ArgumentError


@dataclass(frozen=True, kw_only=True)
class Damage:
    """A damaged object that was set aside.

    Attributes:
        name: its path below the store's folder.
        what: the damaged part; for a result, why it is unusable.
    """

    name: str
    what: str


@dataclass(frozen=True, kw_only=True)
class Aside:
    """Objects set aside until garbage collection removes them: number and size."""

    count: int
    size_bytes: int


@dataclass(frozen=True, kw_only=True)
class Soundness:
    """The result of checking a store.

    Attributes:
        n_results: intact results.
        n_objects: intact products and figures.
        damaged: what was set aside now.
        aside: everything that was set aside.
    """

    n_results: int
    n_objects: int
    damaged: tuple[Damage, ...]
    aside: Aside


def check_store(store: Store) -> Soundness:
    """Check every object and every result; runs may use the store meanwhile.

    A result with missing products or figures is set aside too.

    Raises:
        ArgumentError: the folder has other content.
        StoreError: the store cannot be read, or something damaged cannot be set aside.
    """
    require_store(store.folder)
    if not is_store(store.folder):
        return Soundness(n_results=0, n_objects=0, damaged=(), aside=Aside(count=0, size_bytes=0))
    with shared_lock(store.lock_file):
        names = _named_by_digest(store.objects)
        objects = tuple(_damaged_objects(store, names))
        keys = _named_by_digest(store.results)
        results = tuple(_damaged_results(store, keys))
    return Soundness(
        n_results=len(keys) - len(results),
        n_objects=len(names) - len(objects),
        damaged=(*objects, *results),
        aside=lying_aside(store),
    )


def lying_aside(store: Store) -> Aside:
    """Count what was set aside before and now."""
    paths = tuple(store.damaged.iterdir()) if store.damaged.is_dir() else ()
    return Aside(count=len(paths), size_bytes=sum(size_of(path) for path in paths))


def _named_by_digest(folder: Path) -> tuple[str, ...]:
    """Yield names, without suffix, of the store's own files; others are not ours."""
    names = (path.name.removesuffix(".json") for path in folder.glob("*"))
    return tuple(sorted(name for name in names if re.fullmatch("[0-9a-f]{64}", name)))


def _damaged_objects(store: Store, names: Iterable[str]) -> Iterator[Damage]:
    for name in names:
        part = store.damage(name, with_published=True, again=True)
        # A missing one was replaced by a run, or removed by somebody: results will show it.
        if part and part != WHOLE:
            yield Damage(name=f"objects/{name}", what=part)


def _damaged_results(store: Store, keys: Iterable[str]) -> Iterator[Damage]:
    for key in keys:
        reason = store.damage_of_result(key)
        if reason:
            yield Damage(name=f"results/{key}.json", what=reason)


_DAY_S: Final = 86_400.0


@dataclass(frozen=True, kw_only=True)
class GarbageReport:
    """What garbage collection removed, or would remove.

    Attributes:
        n_results: results.
        n_objects: products and figures.
        n_damaged: number of damaged objects that had been set aside.
        freed_bytes: bytes of everything removed.
    """

    n_results: int
    n_objects: int
    n_damaged: int
    freed_bytes: int


def collect_garbage(
    store: Store, *, older_than_days: float | None = None, dry_run: bool = False
) -> GarbageReport:
    """Remove incomplete results, products without results, damaged objects and leftovers.

    Args:
        store: the store; no run may use it meanwhile.
        older_than_days: also remove results that no run used for this many days; 0 removes all.
        dry_run: only report what would be removed.

    Raises:
        ArgumentError: the number of days is negative, or the folder has other content.
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
    failures = _children(store.failures)
    rest = (
        *damaged,
        *failures,
        *_children(store.scratch),
        *_half_written(store),
    )
    freed = sum(size_of(path) for path in (*results, *objects, *preimages, *rest))
    if not is_dry:
        # Results first: after a kill in between, no result remains whose objects are gone.
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
