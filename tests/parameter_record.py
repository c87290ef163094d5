"""Every parameter of the built-in methods as text: `python tests/parameter_record.py`.

Writes `docs/parameters.txt`. A default or a bound that moves changes the results of everybody who
left it alone: whoever moves one does it on purpose, and the record shows it.
"""

from __future__ import annotations

import sys
from pathlib import Path

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from orthoflow.catalog.discovery import discover_catalog

RECORD = Path(__file__).resolve().parents[1] / "docs" / "parameters.txt"


def parameters() -> list[str]:
    """One line per parameter: method, name, type, default, bounds."""
    lines = []
    for method_id, entry in sorted(discover_catalog().methods.items()):
        if entry.distribution.name == "orthoflow-tls":
            fields = entry.load().Params.model_fields
            lines += [f"{method_id} {_described(name, field)}" for name, field in fields.items()]
    return lines


def _described(name: str, field: FieldInfo) -> str:
    annotation = field.annotation
    kind = annotation.__name__ if isinstance(annotation, type) else str(annotation)
    default = (
        "required" if field.is_required() else _shown(field.get_default(call_default_factory=True))
    )
    bounds = ", ".join(map(str, field.metadata))
    return f"{name}: {kind.replace('typing.', '')} = {default}" + (f" ({bounds})" if bounds else "")


def _shown(value: object) -> str:
    return value.model_dump_json() if isinstance(value, BaseModel) else repr(value)


if __name__ == "__main__":
    RECORD.write_text("\n".join(parameters()) + "\n", encoding="utf-8")
    sys.stdout.write(f"wrote {RECORD}\n")
