"""Where numba keeps compiled kernels: in a private folder of the user, and nowhere else.

What numba keeps are pickles, and to read one is to run it. So they never lie in a store or in a
working folder, which people hand on, and nothing is ever copied from there. The folder belongs to
the user (or to root) and nobody else may write to it; where there is none, kernels are kept in a
temporary folder of this process.

Numba notices an edit of the file of a kernel, and not of what the kernel calls in other files. So
there is a folder for each state of all modules with kernels and of all that these import.
"""

from __future__ import annotations

import os
import re
import shutil
import stat
import sys
import tempfile
from collections import defaultdict
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Final

VARIABLE: Final = "NUMBA_CACHE_DIR"
_MAY_COMPILE: Final = re.compile(r"numba|jit|vectorize|stencil|geometry(\.| import )compiling")
_IMPORT: Final = re.compile(
    r"(?:^|[:;])[ \t]*(?:from\s+([\w.]+)\s+import\s*(\([^)]*\)|[^\n;]+)|import\s+([^\n;]+))",
    re.MULTILINE,
)
_COMMENT_OR_JOINT: Final = re.compile(r"#[^\n]*|\\\n")
_NAME: Final = re.compile(r"[\w.]+")
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


def kernel_folder(digest: str) -> Path:
    """Return the folder for the kernels of a state of the code, see `all_kernels`.

    Of earlier states the last ones are kept.
    """
    root = all_kernels()
    if str(root) == os.environ.get(VARIABLE):
        return root
    folder = root / digest[:32]
    if not folder.exists():
        with suppress(OSError):
            states = sorted(root.iterdir(), key=lambda path: path.stat().st_mtime)
            for state in states[:-_MAX_STATES]:
                shutil.rmtree(state, ignore_errors=True)
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
    if not hasattr(os, "getuid"):
        return stat.S_ISDIR(state.st_mode)
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


def kernel_sources(files: Collection[Path], third_party: Collection[Path] = ()) -> frozenset[Path]:
    """Return those files whose content decides compiled code: kernels, and what these import.

    Imports are read from the text, since a plan loads no compiler.

    Args:
        files: Python files of the framework and of a plugin.
        third_party: those among them that may compile by decorators of their own: where one of them
            may compile at all, each of them counts.
    """
    texts = {path: path.read_text(encoding="utf-8", errors="replace") for path in files}
    found = {path for path, text in texts.items() if _MAY_COMPILE.search(text)}
    if not found.isdisjoint(third_party):
        found.update(third_party)
    by_last_name: defaultdict[str, list[tuple[tuple[str, ...], Path]]] = defaultdict(list)
    for path in files:
        parts = path.parent.parts if path.stem == "__init__" else path.with_suffix("").parts
        by_last_name[parts[-1]].append((parts, path))
    waiting = list(found)
    while waiting:
        path = waiting.pop()
        for wanted in _imported_names(texts[path], path):
            for parts, file in by_last_name.get(wanted[-1], ()):
                if parts[-len(wanted) :] == wanted and file not in found:
                    found.add(file)
                    waiting.append(file)
    return frozenset(found)


def _imported_names(text: str, path: Path) -> Iterator[tuple[str, ...]]:
    """Yield the parts of dotted names that a file imports, or that may be names of modules."""
    for module, names, modules in _IMPORT.findall(_COMMENT_OR_JOINT.sub(" ", text)):
        joint = "" if module.endswith(".") else "."
        found = [f"{module}{joint}{name}" for name in _NAME.findall(names)] if module else []
        for name in [module, *found] if module else _NAME.findall(modules):
            inner = name.lstrip(".")
            n_up = len(name) - len(inner)
            parts = tuple(part for part in inner.split(".") if part)
            if n_up:
                parts = path.parents[min(n_up, len(path.parents)) - 1].parts + parts
            if parts:
                yield parts
