"""Finished runs: writing the record, and the read API."""

from __future__ import annotations

from orthoflow_provenance.model import (
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

from orthoflow.engine.run_folder import RECORD_FILE
from orthoflow.records.comparison import (
    CellFacts,
    ComparedMetric,
    Pair,
    ParameterValue,
    RunComparison,
    compare_runs,
)
from orthoflow.records.distances import (
    Distance,
    ProductDistance,
    RunProducts,
    Verdict,
    product_distances,
)
from orthoflow.records.metrics import MetricRow, cell_metrics
from orthoflow.records.run_files import figure_files, write_files
from orthoflow.records.runs import REPORT_FILE, Run, open_run
from orthoflow.records.verification import Verification, verify_run
from orthoflow.records.writing import (
    NOT_YET,
    WrittenRun,
    executed_and_written,
    show_unfinished,
    write_run,
)

__all__ = [
    "COSTS",
    "NOT_YET",
    "RECORD_FILE",
    "REPORT_FILE",
    "CellFacts",
    "ComparedMetric",
    "Distance",
    "Metric",
    "MetricRow",
    "Pair",
    "ParameterValue",
    "ProductDistance",
    "RecordedCell",
    "RecordedEnvironment",
    "RecordedFigure",
    "RecordedFile",
    "RecordedInput",
    "RecordedProduct",
    "Run",
    "RunComparison",
    "RunProducts",
    "RunRecord",
    "Verdict",
    "Verification",
    "WrittenRun",
    "cell_metrics",
    "compare_runs",
    "executed_and_written",
    "figure_files",
    "open_run",
    "product_distances",
    "show_unfinished",
    "verify_run",
    "write_files",
    "write_run",
]
