"""Folders for compiled numba kernels, which are private to the user and never shared.

Compiled kernels are pickles, and loading a pickle runs code. Kernels are therefore never written
to, or loaded from, a store or working folder, which several people may share. The folder for
kernels must belong to the user or root, and nobody else may have write permission; if there is no
such folder, kernels are kept in a temporary folder of this process.

orthoflow's own kernels are identified by their content (see `geometry.compiling`). Kernels of
plugins are cached by numba itself. Numba checks the file that contains the kernel for changes, but
not the code in other files that the kernel calls. Each version of a plugin's code therefore has
its own folder.
"""

from __future__ import annotations

import os
import shutil
import stat
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Final

VARIABLE: Final = "NUMBA_CACHE_DIR"
# The kernels of one version of a plugin's code take about 60 MB.
_MAX_STATES: Final = 8


def private_folder(name: str) -> Path:
    """Return a subfolder of the user's cache that nobody else can write to; create it if missing.

    The folder is `$XDG_CACHE_HOME/orthoflow/<name>` or `~/.cache/orthoflow/<name>`. If it cannot
    be created, or others may write to it, the result is a temporary folder, which is removed at
    exit.
    """
    with suppress(OSError, RuntimeError):
        own = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "orthoflow"
        for folder in (own, own / name):
            folder.mkdir(mode=0o700, parents=folder == own, exist_ok=True)
        if own.is_absolute() and is_private(own) and is_private(own / name):
            return own / name
    return Path(_temporary().name)


def kernel_folder(state: str) -> Path:
    """Return a folder for compiled kernels (see `all_kernels`).

    Args:
        state: digest of a plugin's code, or empty for orthoflow's own kernels. Only the folders of
            the most recent versions are kept.
    """
    root = all_kernels()
    if not state or str(root) == os.environ.get(VARIABLE):
        return root
    folder = root / "plugins" / state[:32]
    if not folder.exists():
        with suppress(OSError):
            folder.parent.mkdir(mode=0o700, exist_ok=True)
            states = sorted(folder.parent.iterdir(), key=lambda path: path.stat().st_mtime)
            for old in states[:-_MAX_STATES]:
                shutil.rmtree(old, ignore_errors=True)
            folder.mkdir(mode=0o700, exist_ok=True)
    return folder


def all_kernels() -> Path:
    """Return the folder for all kernels of this user.

    If the environment variable `NUMBA_CACHE_DIR` names a private folder, this folder is used,
    without subfolders for plugins.
    """
    named = Path(os.environ.get(VARIABLE, ""))
    if named.is_absolute():
        with suppress(OSError):
            named.mkdir(mode=0o700, parents=True, exist_ok=True)
            if is_private(named):
                return named
    return private_folder("numba")


def is_private(folder: Path) -> bool:
    """Whether a path is a folder of this user or of root that nobody else may write to.

    Raises:
        OSError: the path does not exist.
    """
    state = folder.lstat()
    is_own = state.st_uid in (os.getuid(), 0)
    return stat.S_ISDIR(state.st_mode) and is_own and not state.st_mode & 0o022


@cache
def _temporary() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="orthoflow-numba-", ignore_cleanup_errors=True)


@contextmanager
def kernels_in(folder: Path) -> Iterator[None]:
    """Make numba cache kernels in a folder while the block runs."""
    before = os.environ.get(VARIABLE)
    os.environ[VARIABLE] = str(folder)
    reload_numba_config()
    try:
        yield
    finally:
        if before is None:
            del os.environ[VARIABLE]
        else:
            os.environ[VARIABLE] = before
        reload_numba_config()


def reload_numba_config() -> None:
    """Make numba read its environment variables again, if numba is loaded."""
    if "numba" in sys.modules:
        from numba.core import config  # noqa: PLC0415 - only where it is loaded anyway

        config.reload_config()  # type: ignore[no-untyped-call]
