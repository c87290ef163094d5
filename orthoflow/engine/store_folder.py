"""The folder of a store: made, or refused where something else lies."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from orthoflow.engine.durability import writing_to
from orthoflow.errors import ArgumentError

# Made together when a store is first used. The last one is what a store is known by: a git
# repository has `objects`, and anybody's folder may have `results`.
_MADE: Final = ("scratch", "results", "objects", "preimages")
# What else may come first, as a lock does. A disk of its own has `lost+found`, and systems leave
# hidden files everywhere.
_OURS: Final = frozenset(
    {*_MADE, "failures", "damaged", "digests.json", "lock"} | {"damaged.lock", "lost+found"}
)


def is_store(folder: Path) -> bool:
    """Whether a run has made a store of a folder."""
    return (folder / _MADE[-1]).is_dir()


def require_store(folder: Path) -> None:
    """Refuse a folder of something else, for a store is written to and cleaned up.

    One that is not there, or has nothing but hidden files and what a store has, may become one.

    Raises:
        ArgumentError: other files lie there, and no store.
        StoreError: the folder cannot be read.
    """
    if is_store(folder) or not folder.is_dir():
        return
    with writing_to(folder):
        names = (path.name for path in folder.iterdir())
        foreign = sorted(name for name in names if name[0] != "." and name not in _OURS)
    if foreign:
        raise ArgumentError(
            f"{folder} is no store of orthoflow: it holds {foreign[0]}"
            f"{f' and {len(foreign) - 1} more' if foreign[1:] else ''}; name a store, or a folder "
            "that is empty or not there yet, with --store"
        )


def make_store(folder: Path) -> None:
    """Make the folders of a store, where they are not there yet.

    Raises:
        ArgumentError: something else lies there.
        StoreError: they cannot be made.
    """
    require_store(folder)
    with writing_to(folder):
        for name in _MADE:
            (folder / name).mkdir(parents=True, exist_ok=True)
        ignore = folder / ".gitignore"
        if not ignore.exists():
            ignore.write_text("*\n", encoding="utf-8")
