"""Compiled kernels that stores share: each begins with what runs of this user have compiled."""

from __future__ import annotations

import os
import shutil
import uuid
from contextlib import suppress
from pathlib import Path
from typing import Final

from orthoflow.engine.durability import place_folder, remove_tree
from orthoflow.errors import StoreError

VARIABLE: Final = "ORTHOFLOW_KERNELS"
# Our own kernels (`geometry.kept_kernels`), in whose names stands what they hold: no two of these
# have one name, and damage shows. What a plugin keeps past them stays in its store.
CHECKED: Final = ".checked"
_SHARED: Final = f"*{CHECKED}*.nb[ci]"
# All kernels take some 60 MB.
_ROOM_BYTES: Final = 500_000_000
# Of the files that say of a method that its kernels are there; they hold no code.
DONE: Final = ".foretold"
# Written last when a folder begins with warm kernels: what is no younger lies there already.
_BEGUN: Final = ".begun"


def warm_folder() -> Path:
    """Where kernels lie that every store of this user begins with: a folder per state of them.

    That is what `ORTHOFLOW_KERNELS` names, else a folder of the user's cache.
    """
    named = os.environ.get(VARIABLE)
    if named:
        return Path(named).absolute()
    cache = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")  # noqa: PTH111 - raises where there is no home
    return Path(cache).absolute() / "orthoflow" / "kernels"


def begun_with_warm(folder: Path) -> Path:
    """Give a store's folder of kernels; where it is not there yet, it begins with warm ones.

    They are copied, because numba writes beside what it reads, and a folder of an image or of
    another user may be read-only. Where this state of the code has none, those of the state before
    it come first: of these, what an edit left alone is found by what it holds. Whatever stands in
    the way, little room on the disk as well, kernels are compiled instead.
    """
    warm = warm_folder() / folder.name
    if folder.exists() or not _has_room(folder):
        return folder
    aside = folder.with_name(f".{folder.name}-{uuid.uuid4().hex}")
    try:
        # Not their times: they are as young as the store.
        if warm.is_dir():
            shutil.copytree(warm, aside, copy_function=shutil.copyfile)
            (aside / _BEGUN).touch()
        elif not _copy_state_before(aside):
            return folder
        place_folder(aside, folder)
    except (OSError, shutil.Error, StoreError):
        with suppress(OSError):
            remove_tree(aside)
    return folder


def _has_room(folder: Path) -> bool:
    """Whether copies leave room on the disk for what a run makes."""
    there = next(path for path in folder.parents if path.exists())
    return shutil.disk_usage(there).free > _ROOM_BYTES


def _copy_state_before(folder: Path) -> bool:
    """Copy our kernels of the state that was begun last, of each its youngest; False for none."""
    states = [path for path in warm_folder().glob("*") if path.is_dir()]
    if not states:
        return False
    before = max(states, key=lambda path: path.stat().st_mtime)
    youngest: dict[str, Path] = {}
    for index in sorted(before.rglob(f"*{CHECKED}-*.nbi"), key=lambda path: path.stat().st_mtime):
        youngest[f"{index.parent} {index.name.partition(CHECKED)[0]}"] = index
    for index in youngest.values():
        place = folder / index.parent.relative_to(before)
        place.mkdir(parents=True, exist_ok=True)
        for path in (*index.parent.glob(f"{index.stem}.*.nbc"), index):
            shutil.copyfile(path, place / path.name)
    return bool(youngest)


def leave_for_others(folder: Path, since_ns: int) -> None:
    """Copy what was compiled into a store's folder to where every other store begins.

    Files go first that an index will name. Where the folder cannot be written, as in an image,
    nothing is shared, and no run fails for it.

    Args:
        folder: of a store.
        since_ns: what is older was there before, nanoseconds since 1970.
    """
    shared = warm_folder() / folder.name
    with suppress(OSError):
        # Without a home there is no cache; `warm` compiles where they shall stay.
        if "~" in shared.parts or (shared.exists() and shared.samefile(folder)):
            return
        found = [*folder.rglob(_SHARED), *folder.glob(f"*{DONE}")]
        with suppress(FileNotFoundError):
            since_ns = max(since_ns, (folder / _BEGUN).stat().st_mtime_ns + 1)
        new = [path for path in found if path.stat().st_mtime_ns >= since_ns]
        # Kernels, their indices, then what says of a method that all of its kernels are there.
        order = (".nbc", ".nbi", DONE)
        for path in sorted(new, key=lambda path: order.index(path.suffix)):
            place = shared / path.relative_to(folder)
            place.parent.mkdir(parents=True, exist_ok=True)
            aside = place.with_name(f".{uuid.uuid4().hex}")
            try:
                shutil.copyfile(path, aside)
                aside.replace(place)
            finally:
                aside.unlink(missing_ok=True)
