"""Which processes a process has started, by itself and through others."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path


def descendants(process_id: int) -> tuple[int, ...]:
    """Processes that another has started, itself or through others, the oldest branches first.

    Zombies do not count: they hold nothing any more.
    """
    children: dict[int, list[int]] = {}
    for child, parent in _parents():
        children.setdefault(parent, []).append(child)
    found = list(children.get(process_id, ()))
    for child in found:
        # Grows while it is walked: a tree level by level.
        found += children.get(child, ())
    return tuple(found)


def _parents() -> Iterator[tuple[int, int]]:
    """(process, parent) of every living process."""
    for entry in os.scandir("/proc"):
        if not entry.name.isdigit():
            continue
        try:
            text = Path(entry.path, "stat").read_text(encoding="utf-8", errors="replace")
        except OSError:
            continue
        # The name in front may hold anything, brackets and blanks too.
        state, parent = text.rpartition(")")[2].split()[:2]
        if state != "Z":
            yield int(entry.name), int(parent)
