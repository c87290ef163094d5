"""Shared fixtures of the tests of matching: key points and matches of a few pictures."""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Callable
from typing import Any, Final

import pytest
from orthoflow_plugins.match import key_points as matching
from orthoflow_plugins.match import placing, ties

from orthoflow.geometry import key_points

# Each result takes some megabytes.
MAX_KNOWN: Final = 60


# The types are Any, since functions have any arguments and results.
def remembered(function: Callable[..., Any]) -> Callable[..., Any]:
    """Cache a function's results for the same pictures or key points."""
    known: dict[bytes, Any] = {}

    def call(*given: Any, **settings: Any) -> Any:
        key = hashlib.sha256(pickle.dumps((given, settings))).digest()
        if key not in known:
            if len(known) >= MAX_KNOWN:
                known.clear()
            known[key] = function(*given, **settings)
        return known[key]

    return call


FIND, MATCH = remembered(key_points.find_features), remembered(key_points.mutual_matches)


@pytest.fixture(autouse=True)
def _key_points_found_once(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (matching, placing, ties):
        monkeypatch.setattr(module, "find_features", FIND)
    monkeypatch.setattr(matching, "mutual_matches", MATCH)
