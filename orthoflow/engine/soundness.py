"""Looking at every byte of a store; what is damaged is set aside and computed again when needed."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from orthoflow.engine.durability import size_of
from orthoflow.engine.locks import shared_lock
from orthoflow.engine.objects import WHOLE
from orthoflow.engine.store import Store
from orthoflow.engine.store_folder import is_store, require_store


@dataclass(frozen=True, kw_only=True)
class Damage:
    """Something damaged that was set aside.

    Attributes:
        name: what it was called below the store's folder.
        what: the part that was damaged; for a result, why it is of no use.
    """

    name: str
    what: str


@dataclass(frozen=True, kw_only=True)
class Aside:
    """What lies aside until garbage collection removes it: how many things, and how large."""

    count: int
    size_bytes: int


@dataclass(frozen=True, kw_only=True)
class Soundness:
    """What a look at a store gave.

    Attributes:
        n_results: sound results.
        n_objects: sound products and figures.
        damaged: what was set aside now.
        aside: everything that lies aside.
    """

    n_results: int
    n_objects: int
    damaged: tuple[Damage, ...]
    aside: Aside


def check_store(store: Store) -> Soundness:
    """Look at every object and every result; runs may use the store meanwhile.

    A result whose products or figures are not all there is set aside too.

    Raises:
        ArgumentError: something else lies in the folder.
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
    """Names, without suffix, of what the store puts there; what else lies there is not ours."""
    names = (path.name.removesuffix(".json") for path in folder.glob("*"))
    return tuple(sorted(name for name in names if re.fullmatch("[0-9a-f]{64}", name)))


def _damaged_objects(store: Store, names: Iterable[str]) -> Iterator[Damage]:
    for name in names:
        part = store.damage(name, with_published=True, again=True)
        # One that is gone was exchanged by a run, or removed by somebody: results will tell.
        if part and part != WHOLE:
            yield Damage(name=f"objects/{name}", what=part)


def _damaged_results(store: Store, keys: Iterable[str]) -> Iterator[Damage]:
    for key in keys:
        reason = store.damage_of_result(key)
        if reason:
            yield Damage(name=f"results/{key}.json", what=reason)
