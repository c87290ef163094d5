"""The limits of what files may ask for stand in one table, which agrees with the constants."""

from __future__ import annotations

import re
from importlib import import_module
from pathlib import Path

_ROOT = Path(__file__).resolve().parents[1]
_ROW = re.compile(r"\| ([\d,]+) \| [^|]+ \| `([\w.]+)\.(\w+)` \|")
_LIMIT = re.compile(r"^((?:MOST|DEEPEST|FARTHEST)\w*): Final", re.MULTILINE)
_FILES = ("orthoflow/files", "orthoflow/workflow", "provenance/orthoflow_provenance")


def _rows() -> dict[tuple[str, str], int]:
    found = _ROW.findall((_ROOT / "docs" / "limits.md").read_text())
    return {(module, name): int(number.replace(",", "")) for number, module, name in found}


def test_the_table_of_limits_says_what_the_constants_are() -> None:
    rows = _rows()
    assert len(rows) > 20
    assert {place: getattr(import_module(place[0]), place[1]) for place in rows} == rows


def test_every_limit_of_a_reader_stands_in_the_table() -> None:
    rows = _rows()
    for folder in _FILES:
        for path in sorted((_ROOT / folder).rglob("*.py")):
            parts = path.relative_to(_ROOT).with_suffix("").parts
            module = ".".join(parts[1:] if parts[0] == "provenance" else parts)
            for name in _LIMIT.findall(path.read_text()):
                assert (module, name) in rows, f"{module}.{name} is missing in docs/limits.md"
