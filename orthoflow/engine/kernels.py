"""Where numba keeps compiled kernels: in a private folder of the user, and nowhere else.

What numba keeps are pickles, and to read one is to run it. So they never lie in a store or in a
working folder, which people hand on, and nothing is ever copied from there. The folder belongs to
the user (or to root) and nobody else may write to it; where there is none, kernels are kept in a
temporary folder of this process.

Our own kernels are found there by their content, see `geometry.compiling`. Those that numba itself
keeps for a plugin are found by the file of the kernel, whatever it calls in other files: a plugin
has a folder for each state of its code.
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
# Some 60 MB each.
_MAX_STATES: Final = 8


def private_folder(name: str) -> Path:
    """Return a folder of the user's cache that nobody else can write to; made when missing.

    It is `$XDG_CACHE_HOME/orthoflow/<name>`, else `~/.cache/orthoflow/<name>`. Where that cannot be
    made, or others may write there, it is a temporary folder that ends with this process.
    """
    with suppress(OSError, RuntimeError):
        own = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "orthoflow"
        for folder in (own, own / name):
            folder.mkdir(mode=0o700, parents=folder == own, exist_ok=True)
        if own.is_absolute() and is_private(own) and is_private(own / name):
            return own / name
    return Path(_temporary().name)


def kernel_folder(state: str) -> Path:
    """Return the folder for kernels, see `all_kernels`.

    Args:
        state: digest of the code of a plugin, whose last states are kept; empty for our own.
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
    """Return the folder of all kernels of this user.

    `NUMBA_CACHE_DIR` in the environment names another one, which is used as it is, without a folder
    for each state, where it is private.
    """
    named = Path(os.environ.get(VARIABLE, ""))
    if named.is_absolute():
        with suppress(OSError):
            named.mkdir(mode=0o700, parents=True, exist_ok=True)
            if is_private(named):
                return named
    return private_folder("numba")


def is_private(folder: Path) -> bool:
    """Whether a folder is one, belongs to this user or to root, and no one else may write to it.

    Raises:
        OSError: it is not there.
    """
    state = folder.lstat()
    is_own = state.st_uid in (os.getuid(), 0)
    return stat.S_ISDIR(state.st_mode) and is_own and not state.st_mode & 0o022


@cache
def _temporary() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="orthoflow-numba-", ignore_cleanup_errors=True)


@contextmanager
def kernels_in(folder: Path) -> Iterator[None]:
    """Let numba keep what it compiles in a folder, in this process, while the block runs."""
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
    """Let numba, where it is loaded, read the environment again."""
    if "numba" in sys.modules:
        from numba.core import config  # noqa: PLC0415 - only where it is loaded anyway

        config.reload_config()  # type: ignore[no-untyped-call]
