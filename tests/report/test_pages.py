"""What of a run stands in one place of its page."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any

from orthoflow.report.pages import _Part


def test_a_part_of_some_cells_has_all_that_they_made_and_nothing_else() -> None:
    names = [field.name for field in dataclasses.fields(_Part)]
    every: dict[str, Any] = {
        name: tuple(
            SimpleNamespace(cell=cell, address=cell, kind=name)
            for cell in ("scan", "a@b=c", "wall")
        )
        for name in names
    }
    part = _Part(**every).of({"wall", "scan"})
    for name in names:
        found = getattr(part, name)
        assert [(one.cell, one.kind) for one in found] == [("scan", name), ("wall", name)]
    assert _Part(**every).of(()) == _Part()
