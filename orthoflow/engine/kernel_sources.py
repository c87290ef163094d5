"""The files that decide what is compiled: modules with kernels, and all that these import.

A kernel holds what it calls and the constants that it names, so a change in either makes it another
one; a change next door does not. Imports are read from the text, since a plan loads no compiler:
whatever looks like one counts, wherever it stands.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from typing import Final

_MAY_COMPILE: Final = re.compile(r"numba|jit|vectorize|stencil|geometry(\.| import )compiling")
_IMPORT: Final = re.compile(
    r"(?:^|[:;])[ \t]*(?:from\s+([\w.]+)\s+import\s*(\([^)]*\)|[^\n;]+)|import\s+([^\n;]+))",
    re.MULTILINE,
)
# What may stand between the names of an import.
_BETWEEN: Final = re.compile(r"#[^\n]*|\\\n")
_NAME: Final = re.compile(r"[\w.]+")
_PACKAGE: Final = "__init__"


def kernel_sources(files: Collection[Path], strangers: Collection[Path]) -> frozenset[Path]:
    """Give those files whose content decides compiled code.

    Args:
        files: Python files of the framework and of a plugin.
        strangers: those among them that may compile in ways that their text does not show, by a
            decorator of their own: where one of them may compile at all, each of them counts.
    """
    texts = {path: path.read_text(encoding="utf-8", errors="replace") for path in files}
    beginning = {path for path, text in texts.items() if _MAY_COMPILE.search(text)}
    if not beginning.isdisjoint(strangers):
        beginning.update(strangers)
    modules, found, waiting = _Modules(files), set(beginning), list(beginning)
    while waiting:
        path = waiting.pop()
        imported = {file for name in _imported(texts[path]) for file in modules.named(name, path)}
        waiting += imported - found
        found |= imported
    return frozenset(found)


def _imported(text: str) -> Iterator[str]:
    """Give dotted names that a text imports, or that may be names of modules."""
    for module, names, modules in _IMPORT.findall(_BETWEEN.sub(" ", text)):
        if not module:
            yield from _NAME.findall(modules)
            continue
        yield module
        joint = "" if module.endswith(".") else "."
        yield from (f"{module}{joint}{name}" for name in _NAME.findall(names))


class _Modules:
    """Finds the files of modules; names need not begin where a package does."""

    def __init__(self, files: Iterable[Path]) -> None:
        self._ending_with: dict[str, list[tuple[tuple[str, ...], Path]]] = defaultdict(list)
        for path in files:
            parts = path.with_suffix("").parts
            parts = parts[:-1] if parts[-1] == _PACKAGE else parts
            self._ending_with[parts[-1]].append((parts, path))

    def named(self, name: str, importer: Path) -> Iterator[Path]:
        """Give the files that a dotted name may mean in the file that imports it."""
        inner = name.lstrip(".")
        n_up = len(name) - len(inner)
        parts = tuple(part for part in inner.split(".") if part)
        if n_up:
            parts = importer.parents[min(n_up, len(importer.parents)) - 1].parts + parts
        if parts:
            for known, path in self._ending_with.get(parts[-1], ()):
                if known[-len(parts) :] == parts:
                    yield path
