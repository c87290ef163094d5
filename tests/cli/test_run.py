"""What a run says when it has ended: which cells failed, which came from the store, how long."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any


def cell(**known: Any) -> Any:
    plain = {
        "address": "wall",
        "status": "ok",
        "cached_from": "",
        "started": "2026-01-02T03:04:05.000Z",
        "wall_s": 75.0,
        "warnings": (),
        "error_message": "",
        "log": "",
    }
    return SimpleNamespace(**{**plain, **known})


SKIPPED = cell(status="skipped", started="", error_message="needs plane, which failed")
