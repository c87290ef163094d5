"""Two runs side by side: inputs, workflow, parameters, versions, environment, metrics, products."""

from __future__ import annotations

import difflib
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Generic, TypeVar

from orthoflow_provenance.model import COSTS, RecordedCell, RecordedFile, RunRecord

from orthoflow.products.product import JsonValue
from orthoflow.records.metrics import cell_metrics
from orthoflow.records.product_distances import ProductDistance, RunProducts, product_distances
from orthoflow.records.runs import Run

if TYPE_CHECKING:
    from orthoflow.engine import Store

Side = TypeVar("Side")


@dataclass(frozen=True, kw_only=True)
class Pair(Generic[Side]):
    """What two runs say about one thing.

    Attributes:
        cell: address of the cell it belongs to, empty for what belongs to the whole run.
        name: what it is: name of an input, a parameter, a metric, a package.
        left: what the first run says, None when it says nothing.
        right: what the second run says, None when it says nothing.
    """

    cell: str = ""
    name: str
    left: Side | None
    right: Side | None

    @property
    def is_same(self) -> bool:
        """Whether both say the same."""
        return self.left == self.right


@dataclass(frozen=True, kw_only=True)
class ParameterValue:
    """A parameter as resolved.

    Attributes:
        value: JSON.
        is_set: written in the workflow or on the command line; else it is the method's default.
    """

    value: JsonValue
    is_set: bool


@dataclass(frozen=True, kw_only=True)
class CellFacts:
    """What decides a cell's results besides inputs and parameters.

    Attributes:
        status: ok, failed or skipped.
        method: method id.
        distribution: name and version of what brought the method.
        result_version: the method's own counter.
        determinism: exact, seeded or loose.
        seed: None when the method uses none.
        code: digests of code that was not a released install; empty when all was.
        tools: versions of libraries that decide results.
        error: why it failed or was skipped, else empty.
    """

    status: str
    method: str
    distribution: str
    result_version: int
    determinism: str
    seed: int | None
    code: Mapping[str, str]
    tools: Mapping[str, str]
    error: str


@dataclass(frozen=True, kw_only=True)
class ComparedMetric:
    """One number of one cell; equal when value and unit are.

    Attributes:
        value: the number.
        unit: its unit.
        is_cost: time or memory, which depend on the machine and its load.
        is_cached: of a cell that an earlier run computed; its cost is that run's.
        environment: id of the environment it was computed in.
    """

    value: float
    unit: str
    is_cost: bool = field(compare=False)
    is_cached: bool = field(compare=False)
    environment: str = field(compare=False)


@dataclass(frozen=True, kw_only=True)
class RunComparison:
    """Two runs side by side; rows that say the same on both sides are among them.

    Attributes:
        left: record of the first run.
        right: record of the second.
        workflow: the first text against the second as a unified diff; empty when equal.
        overrides: options that changed the workflow.
        inputs: files of every input, without folders.
        cells: method, version, seed and status of every cell.
        parameters: resolved parameters of every cell that is in both runs.
        environment: Python, system, processor and packages; several values are joined by commas.
        metrics: numbers of every cell.
        products: distance of every product of the cells that are in both runs.
    """

    left: RunRecord
    right: RunRecord
    workflow: tuple[str, ...]
    overrides: Pair[tuple[str, ...]]
    inputs: tuple[Pair[tuple[RecordedFile, ...]], ...]
    cells: tuple[Pair[CellFacts], ...]
    parameters: tuple[Pair[ParameterValue], ...]
    environment: tuple[Pair[str], ...]
    metrics: tuple[Pair[ComparedMetric], ...]
    products: tuple[ProductDistance, ...]


def compare_runs(left: Run, right: Run, *, stores: Sequence[Store] = ()) -> RunComparison:
    """Lay two runs side by side; cells are the same when their addresses are.

    Args:
        left: the first run.
        right: the second run.
        stores: where arrays may lie that a record names by digest only.

    Raises:
        RecordError: a record is damaged.
    """
    from orthoflow.catalog import discover_catalog  # noqa: PLC0415 - loads plugins

    both = [address for address in left.cells if address in right.cells]
    sides = (left.record, right.record)
    return RunComparison(
        left=left.record,
        right=right.record,
        workflow=_text_differences(left.record, right.record),
        overrides=Pair(name="overrides", left=left.record.overrides, right=right.record.overrides),
        inputs=_pairs("", *({entry.name: entry.files for entry in side.inputs} for side in sides)),
        cells=_per_cell(left, right, lambda cell: {cell.step: _facts(cell)}),
        parameters=_per_cell(left, right, _parameters),
        environment=_pairs("", *(_environment(side) for side in sides)),
        metrics=_per_cell(left, right, _metrics),
        products=product_distances(
            RunProducts(run=left, stores=tuple(stores)),
            RunProducts(run=right, stores=tuple(stores)),
            both,
            discover_catalog(),
        ),
    )


def _pairs(
    cell: str, left: Mapping[str, Side], right: Mapping[str, Side]
) -> tuple[Pair[Side], ...]:
    return tuple(
        Pair(cell=cell, name=name, left=left.get(name), right=right.get(name))
        for name in dict.fromkeys((*left, *right))
    )


def _per_cell(
    left: Run, right: Run, values: Callable[[RecordedCell], Mapping[str, Side]]
) -> tuple[Pair[Side], ...]:
    found: list[Pair[Side]] = []
    for address in dict.fromkeys((*left.cells, *right.cells)):
        sides = [
            values(run.cells[address]) if address in run.cells else {} for run in (left, right)
        ]
        found += _pairs(address, *sides)
    return tuple(found)


def _text_differences(left: RunRecord, right: RunRecord) -> tuple[str, ...]:
    ours, theirs = (side.workflow_source.splitlines() for side in (left, right))
    return tuple(difflib.unified_diff(ours, theirs, left.run_id, right.run_id, n=1, lineterm=""))


def _facts(cell: RecordedCell) -> CellFacts:
    preimage = json.loads(cell.key_preimage) if cell.key_preimage else {}
    return CellFacts(
        status=cell.status,
        method=cell.method,
        distribution=f"{cell.distribution} {cell.distribution_version}".strip(),
        result_version=cell.result_version,
        determinism=cell.determinism,
        seed=cell.seed,
        code=preimage.get("code") or {},
        tools=preimage.get("tools") or {},
        error=cell.error_message,
    )


def _parameters(cell: RecordedCell) -> dict[str, ParameterValue]:
    return {
        name: ParameterValue(value=value, is_set=name in cell.params_set)
        for name, value in cell.params.items()
    }


def _metrics(cell: RecordedCell) -> dict[str, ComparedMetric]:
    return {
        row.metric: ComparedMetric(
            value=row.value,
            unit=row.unit,
            is_cost=row.metric in COSTS,
            is_cached=bool(cell.cached_from),
            environment=cell.environment,
        )
        for row in cell_metrics(cell)
    }


def _environment(record: RunRecord) -> dict[str, str]:
    found: dict[str, set[str]] = {}
    for entry in record.environments:
        stated = {
            "python": entry.python,
            "os": entry.os,
            "cpu": entry.cpu,
            "cores": str(entry.cores),
            "threads": str(entry.threads),
            "commit": entry.git_commit,
            **entry.packages,
        }
        for name, value in stated.items():
            found.setdefault(name, set()).add(value)
    return {name: _joined(values) for name, values in found.items()}


def _joined(values: Iterable[str]) -> str:
    return ", ".join(sorted(values))
