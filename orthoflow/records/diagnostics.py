"""Diagnostics of cells as JSON: what `run --json-log` and `show --json` give."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Final

from orthoflow_provenance.document import CellOutcome, JsonValue

_WORD: Final = re.compile(r"(?<!^)(?=[A-Z])")


def diagnostics_of(cell: CellOutcome, step: str, address: str) -> Iterator[dict[str, JsonValue]]:
    """Return what a cell reported, and why it failed where it did.

    The code of a failure is the class of its error in lower case: `InputError` is `input-error`.
    """
    if cell.status == "failed":
        yield {
            "code": _WORD.sub("-", cell.error_type).lower() or "failed",
            "severity": "error",
            "step": step,
            "cell": address,
            "subject": address,
            "values": {},
            "text": cell.error_message,
            "remedy": "",
        }
    for one in cell.diagnostics:
        yield {
            "code": one.code,
            "severity": one.severity,
            "step": step,
            "cell": address,
            "subject": one.subject,
            "values": dict(one.values),
            "text": one.text,
            "remedy": one.remedy,
        }
