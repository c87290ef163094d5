"""Why a cell must run: which ingredient of its key differs from the nearest earlier result."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Final

from orthoflow.engine.keys import CellKey, read_preimage
from orthoflow.engine.store import Preimage

_MOST_NAMED: Final = 4
_LONGEST_VALUE: Final = 40
_ABSENT: Final = "absent"


def explain(key: CellKey, step: str, earlier: Sequence[Preimage]) -> str:
    """Say what changed since the most similar earlier result of the same method.

    Args:
        key: of the cell.
        step: name of its step; earlier results of that step are preferred.
        earlier: preimages of the method's earlier results, newest first.
    """
    if not earlier:
        return "never ran before"
    if any(preimage.key == key.key for preimage in earlier):
        return "its result is no longer in the store"
    now = _ingredients(key.preimage)
    candidates = [preimage for preimage in earlier if preimage.step == step] or list(earlier)
    before = min(
        (_ingredients(item.text) for item in candidates),
        key=lambda ingredients: len(_changed(ingredients, now)),
    )
    changes = _changed(before, now)
    if not changes:
        return "its key is made in another way than before"
    named = list(dict.fromkeys(_sentence(name, before, now) for name in changes))
    more = f" and {len(named) - _MOST_NAMED} more" if len(named) > _MOST_NAMED else ""
    return ", ".join(named[:_MOST_NAMED]) + more


@lru_cache(maxsize=1024)
def _ingredients(text: str) -> Mapping[str, str]:
    """Flatten a preimage by one level: `params.cell_m`, `inputs.cloud`, ...; values as JSON."""
    flat: dict[str, str] = {}
    for name, value in read_preimage(text).items():
        prefix, items = (f"{name}.", value) if isinstance(value, dict) else ("", {name: value})
        for key, item in items.items():
            flat[prefix + key] = json.dumps(item, ensure_ascii=False, sort_keys=True)
    return flat


def _changed(before: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    names = dict.fromkeys([*now, *before])
    return [name for name in names if before.get(name) != now.get(name)]


def _sentence(name: str, before: Mapping[str, str], now: Mapping[str, str]) -> str:
    group, _, inner = name.partition(".")
    if group == "inputs":
        if name not in before:
            return f"input {inner} added"
        return f"input {inner} changed" if name in now else f"input {inner} removed"
    if group == "code":
        return "code changed"
    change = f"{_shown(before, name)} -> {_shown(now, name)}"
    if group == "params":
        return f"{name}: {change}"
    return f"{inner if group == 'tools' else name} {change}"


def _shown(ingredients: Mapping[str, str], name: str) -> str:
    text = ingredients.get(name, _ABSENT)
    return text if len(text) <= _LONGEST_VALUE else text[: _LONGEST_VALUE - 3] + "..."
