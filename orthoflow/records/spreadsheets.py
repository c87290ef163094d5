"""A record as CSV tables, for spreadsheets and statistics programs."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TypeAlias

from orthoflow_provenance.document import COSTS, RunRecord

from orthoflow.foreign_text import Value, csv_text
from orthoflow.records.common_points import CommonPoints, common_points
from orthoflow.records.metrics import write_metrics_csv
from orthoflow.records.published import METRICS_FILE
from orthoflow.records.runs import Run

Row: TypeAlias = Sequence[Value]


def write_csv_tables(run: Run, folder: Path) -> tuple[Path, ...]:
    """Write the tables of a run, each with a header; numbers with every digit that they have.

    Args:
        run: the run.
        folder: existing folder.

    Returns:
        The files: cells, metrics, parameters, inputs, products, environments, and where cells of a
        comparison found the same check points, what each gives over those that all found.
    """
    tables = {
        "cells.csv": _cells(run.record),
        "parameters.csv": _parameters(run.record),
        "inputs.csv": _inputs(run.record),
        "products.csv": _products(run.record),
        "environments.csv": _environments(run.record),
    }
    if shared := common_points(run):
        tables["common_points.csv"] = _common_points(shared)
    write_metrics_csv(folder / METRICS_FILE, run.metric_rows())
    for name, rows in tables.items():
        (folder / name).write_text(
            csv_text(rows), encoding="utf-8", errors="backslashreplace", newline=""
        )
    return tuple(folder / name for name in (METRICS_FILE, *tables))


def _cells(record: RunRecord) -> Iterator[Row]:
    plain = (
        *("status", "method", "distribution", "distribution_version", "result_version"),
        *("determinism", "seed", "started", "ended", *COSTS),
        *("environment", "cached_from", "key", "error_type", "error_message"),
    )
    yield ("cell", "step", "variants", "repeat", *plain, "warnings")
    for cell in record.cells:
        variants = ",".join(f"{step}={variant}" for step, variant in cell.assignment.items())
        values = [getattr(cell, name) for name in plain]
        yield (cell.address, cell.step, variants, cell.repeat, *values, "; ".join(cell.warnings))


def _parameters(record: RunRecord) -> Iterator[Row]:
    yield ("cell", "method", "parameter", "value", "is_set")
    for cell in record.cells:
        for name, value in cell.params.items():
            text = value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
            yield (cell.address, cell.method, name, text, int(name in cell.params_set))


def _inputs(record: RunRecord) -> Iterator[Row]:
    yield ("input", "file", "size_bytes", "sha256")
    for entry in record.inputs:
        for file in entry.files:
            yield (entry.name, file.name, file.size_bytes, file.sha256)


def _products(record: RunRecord) -> Iterator[Row]:
    yield ("cell", "direction", "port", "type", "encoding_version", "digest", "source")
    for cell in record.cells:
        for direction, products in (("in", cell.inputs), ("out", cell.outputs)):
            for port, product in products.items():
                what = (product.type_name, product.encoding_version, product.digest)
                yield (cell.address, direction, port, *what, product.source)


def _common_points(found: Sequence[CommonPoints]) -> Iterator[Row]:
    numbers = ("n_found", "n_common", "n_lost", "rms_u_mm", "rms_v_mm", "rms_mm")
    yield ("cell", "step", "class", *numbers)
    for row in found:
        yield (row.cell, row.step, row.kind, *(getattr(row, name) for name in numbers))


def _environments(record: RunRecord) -> Iterator[Row]:
    yield ("environment", "name", "version")
    for entry in record.environments:
        for name in ("python", "os", "cpu", "cores", "threads", "git_commit"):
            yield (entry.id, name, getattr(entry, name))
        for package, version in entry.packages.items():
            yield (entry.id, package, version)
