"""Finished runs: writing the record, and the read API."""

from __future__ import annotations

from orthoflow_provenance.model import (
    RecordedCell,
    RecordedEnvironment,
    RecordedFigure,
    RecordedFile,
    RecordedInput,
    Metric,
    RecordedProduct,
    RunRecord,
)

from orthoflow.records.comparison import (
    CellFacts,
    MetricValue,
    Pair,
    ParameterValue,
    RunComparison,
    compare_runs,
)
from orthoflow.records.metrics import MetricRow, cell_metrics
from orthoflow.records.product_distances import (
    Distance,
    ProductDistance,
    RunProducts,
    Verdict,
    product_distances,
)
from orthoflow.records.runs import RECORD_FILE, REPORT_FILE, Run, open_run
from orthoflow.records.verification import Verification, verify_run
from orthoflow.records.writing import write_run

__all__ = [
    "RECORD_FILE",
    "REPORT_FILE",
    "CellFacts",
    "Distance",
    "MetricRow",
    "MetricValue",
    "Pair",
    "ParameterValue",
    "ProductDistance",
    "RecordedCell",
    "RecordedEnvironment",
    "RecordedFigure",
    "RecordedFile",
    "RecordedInput",
    "Metric",
    "RecordedProduct",
    "Run",
    "RunComparison",
    "RunProducts",
    "RunRecord",
    "Verdict",
    "Verification",
    "cell_metrics",
    "compare_runs",
    "open_run",
    "product_distances",
    "verify_run",
    "write_run",
]
