"""Why a cell must run: which ingredient of its key differs from the nearest earlier result."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Final

from orthoflow.engine.keys import CellKey, read_preimage
from orthoflow.engine.store import Preimage
from orthoflow.products.product import JsonValue

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
    now = _ingredients(read_preimage(key.preimage))
    candidates = [preimage for preimage in earlier if preimage.step == step] or list(earlier)
    changes = min(
        (_changes(_ingredients(read_preimage(item.text)), now) for item in candidates), key=len
    )
    if not changes:
        return "its key is made in another way than before"
    named = list(dict.fromkeys(changes))
    more = f" and {len(named) - _MOST_NAMED} more" if len(named) > _MOST_NAMED else ""
    return ", ".join(named[:_MOST_NAMED]) + more


def _ingredients(preimage: Mapping[str, JsonValue]) -> dict[str, JsonValue]:
    """Flatten a preimage by one level: `params.cell_m`, `inputs.cloud`, `seed`."""
    flat: dict[str, JsonValue] = {}
    for name, value in preimage.items():
        if isinstance(value, dict):
            flat |= {f"{name}.{inner}": item for inner, item in value.items()}
        else:
            flat[name] = value
    return flat


def _changes(before: Mapping[str, JsonValue], now: Mapping[str, JsonValue]) -> list[str]:
    names = list(dict.fromkeys([*now, *before]))
    return [
        _sentence(name, before, now)
        for name in names
        if (name in before) != (name in now)
        or json.dumps(before[name], sort_keys=True) != json.dumps(now[name], sort_keys=True)
    ]


def _sentence(name: str, before: Mapping[str, JsonValue], now: Mapping[str, JsonValue]) -> str:
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


def _shown(ingredients: Mapping[str, JsonValue], name: str) -> str:
    if name not in ingredients:
        return _ABSENT
    text = json.dumps(ingredients[name], ensure_ascii=False)
    return text if len(text) <= _LONGEST_VALUE else text[: _LONGEST_VALUE - 3] + "..."
