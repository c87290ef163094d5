"""What results a store has, for whoever lists them."""

from __future__ import annotations

from dataclasses import dataclass

from orthoflow.engine.clock import time_of_file
from orthoflow.engine.results import result_from_json
from orthoflow.engine.store import Store
from orthoflow.errors import StoreError


@dataclass(frozen=True, kw_only=True)
class StoredResult:
    """A result in the store.

    Attributes:
        key: cache key.
        method: method id.
        run_id: the run that computed it.
        ended: ISO 8601 UTC.
        last_used: ISO 8601 UTC, when a run last took or made it.
        size_bytes: of its products with their published files; equal products of several results
            count for each.
        is_complete: all its products and figures are there.
    """

    key: str
    method: str
    run_id: str
    ended: str
    last_used: str
    size_bytes: int
    is_complete: bool


def list_results(store: Store) -> tuple[StoredResult, ...]:
    """List the results of a store, last used first; unreadable ones are left out."""
    found: list[StoredResult] = []
    for path in store.results.glob("*.json"):
        try:
            result = result_from_json(path.read_text(encoding="utf-8"), path.name)
            used = time_of_file(path.stat().st_mtime)
        except (StoreError, OSError, UnicodeDecodeError):
            continue
        found.append(
            StoredResult(
                key=path.stem,
                method=result.method,
                run_id=result.run_id,
                ended=result.ended,
                last_used=used,
                size_bytes=store.size_bytes(result),
                is_complete=store.result(path.stem) is not None,
            )
        )
    return tuple(sorted(found, key=lambda item: (item.last_used, item.key), reverse=True))
