"""The datasets of a run: a row each, with its picture, its numbers and what limits it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from typing import Final

from orthoflow.records.runs import MetricRow, Run, cell_metrics
from orthoflow.report.combinations import baseline_cells, baseline_of, combinations_of, is_missing
from orthoflow.report.comparisons import comparison_columns
from orthoflow.report.numbers import number
from orthoflow.report.pictures import thumbnail
from orthoflow.report.rankings import Value
from orthoflow.report.summaries import limits
from orthoflow.workflow.expand import variants_text
from orthoflow.workflow.model import DATA

_MOST_COLUMNS: Final = 6
# Pictures of a page with many rooms get smaller, until they show nothing any more.
_PICTURES_PX: Final = 2_000_000
_LARGEST_PX: Final = 220
_SMALLEST_PX: Final = 64


@dataclass(frozen=True, kw_only=True)
class DatasetRow:
    """One dataset, as the baseline has it.

    Attributes:
        name: of the dataset.
        page: where its own page lies, relative to this one; empty without one.
        picture: data URI of its first orthoimage, empty without one.
        failed: its failed cells and why they did, without those that were skipped behind them.
        missing: its cells that the run was interrupted before.
        values: one per column.
        limit: what limits it most, and how much more does.
    """

    name: str
    page: str
    picture: str
    failed: tuple[str, ...]
    missing: tuple[str, ...]
    values: tuple[Value, ...]
    limit: str


@dataclass(frozen=True, kw_only=True)
class DatasetTable:
    """The datasets of a run.

    Attributes:
        columns: what is measured of each: step, and metric with its unit.
        rows: in the order of the run.
        baseline: the variants that the numbers are of; empty where nothing varies.
    """

    columns: tuple[tuple[str, str], ...]
    rows: tuple[DatasetRow, ...]
    baseline: str = ""

    @property
    def n_whole(self) -> int:
        """How many datasets are complete."""
        return sum(not (row.failed or row.missing) for row in self.rows)


def dataset_table(parts: Mapping[str, Run], pages: Mapping[str, str]) -> DatasetTable:
    """Put the datasets of a run below each other.

    Args:
        parts: dataset -> its part of the run.
        pages: dataset -> its own page, relative to the one that is made.
    """
    own = {
        name: {cell.address for cell in part.record.cells if DATA in cell.assignment}
        for name, part in parts.items()
    }
    measured = {name: _measured(part, own[name]) for name, part in parts.items()}
    units = {key: row for values in measured.values() for key, row in values.items()}
    # Those of the comparison, which the workflow may have asked for.
    columns = comparison_columns([one for part in parts.values() for one in combinations_of(part)])
    wanted = [(column.step, column.metric) for column in columns]
    chosen = [key for key in wanted if key in units][:_MOST_COLUMNS]
    return DatasetTable(
        columns=tuple((row.step, row.titled) for row in (units[key] for key in chosen)),
        rows=tuple(
            DatasetRow(
                name=name,
                page=pages.get(name, ""),
                picture=_picture(part, own[name], len(parts)),
                failed=tuple(
                    f"{cell.address}: {cell.error_message}"
                    for cell in part.record.cells
                    if cell.status == "failed"
                ),
                missing=tuple(cell.address for cell in part.record.cells if is_missing(cell)),
                values=tuple(_value(measured[name].get(key)) for key in chosen),
                limit=_limit(part, own[name]),
            )
            for name, part in parts.items()
        ),
        baseline=variants_text(baseline_of(next(iter(parts.values())))) if parts else "",
    )


_Measured = Mapping[tuple[str, str], MetricRow]


def _measured(part: Run, own: AbstractSet[str]) -> _Measured:
    """What the baseline's cells of this dataset measured: (step, metric) -> the number."""
    return {
        (row.step, row.metric): row
        for cell in baseline_cells(part)
        if cell.address in own
        for row in cell_metrics(cell)
    }


def _picture(part: Run, own: AbstractSet[str], n_rows: int) -> str:
    addresses = [cell.address for cell in baseline_cells(part) if cell.address in own]
    side_px = math.isqrt(_PICTURES_PX // n_rows)
    return thumbnail(part, addresses, longest_side_px=min(_LARGEST_PX, max(_SMALLEST_PX, side_px)))


def _value(measured: MetricRow | None) -> Value:
    return Value(text=number(measured.value), sort=measured.value) if measured else Value()


def _limit(part: Run, own: AbstractSet[str]) -> str:
    """What the baseline's steps of this dataset warn of; failures stand beside it."""
    baseline = {cell.address for cell in baseline_cells(part)} & own
    texts = [
        limit.text
        for limit in limits(part)
        if not baseline.isdisjoint(limit.cells) and not limit.is_failure
    ]
    return f"{texts[0]} (and {len(texts) - 1} more)" if len(texts) > 1 else "".join(texts)
