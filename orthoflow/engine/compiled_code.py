"""Compiled kernels that a store begins with, where `orthoflow warm` has left some."""

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


def warm_folder() -> Path:
    """Where kernels lie that every store of this user begins with: a folder per state of the code.

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
    another user may be read-only. Whatever stands in the way, kernels are compiled instead.
    """
    warm = warm_folder() / folder.name
    if folder.exists() or not warm.is_dir():
        return folder
    aside = folder.with_name(f".{folder.name}-{uuid.uuid4().hex}")
    try:
        # Not their times: they are as young as the store.
        shutil.copytree(warm, aside, copy_function=shutil.copyfile)
        place_folder(aside, folder)
    except (OSError, shutil.Error, StoreError):
        with suppress(OSError):
            remove_tree(aside)
    return folder
