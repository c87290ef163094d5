"""Finished runs: writing the record, and the read API."""

from __future__ import annotations

from orthoflow_provenance.document import (
    COSTS,
    Metric,
    RecordedCell,
    RecordedEnvironment,
    RecordedFigure,
    RecordedFile,
    RecordedInput,
    RecordedProduct,
    RunRecord,
)

# Names from the record format, re-exported for the packages above.
__all__ = [
    "COSTS",
    "Metric",
    "RecordedCell",
    "RecordedEnvironment",
    "RecordedFigure",
    "RecordedFile",
    "RecordedInput",
    "RecordedProduct",
    "RunRecord",
]
