"""The values of a sweep, as they stand in a file."""

from __future__ import annotations

from typing import Final

from orthoflow.files.yaml_positions import Listing, Value, describe
from orthoflow.workflow.problems import ProblemLog
from orthoflow.workflow.shapes import Schema

# More values than a reader follows in a curve, and more runs than anybody waits for.
MOST_SWEPT: Final = 100


class SweptValues:
    """A list of at least two values, of whatever kind the parameter is."""

    words = "a list of at least two values"

    def schema(self) -> Schema:
        """A list that is long enough."""
        return {"type": "array", "minItems": 2, "maxItems": MOST_SWEPT}

    def read(self, value: Value, path: str, log: ProblemLog) -> tuple[Value, ...]:
        """Take the values as they are written."""
        if not isinstance(value, Listing):
            log.add(value.position, path, f"expected {self.words}, got {describe(value)}")
            return ()
        if not 2 <= len(value.items) <= MOST_SWEPT:
            log.add(
                value.position,
                path,
                f"expected 2 to {MOST_SWEPT} values, got {len(value.items)}",
            )
            return ()
        return tuple(value.items)
