"""Comparison of two runs: differences of products, and of everything else."""

from __future__ import annotations

import difflib
import math
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any, Final, Generic, Literal, TypeVar

import numpy as np
from orthoflow_provenance.arrays import ArrayDifference, measure_payloads
from orthoflow_provenance.document import (
    COSTS,
    MethodIdentity,
    RecordedCell,
    RecordedFile,
    RecordedProduct,
    RunRecord,
    canonical_json,
    shared_fields,
)

from orthoflow.engine.keys import read_preimage, stated_versions
from orthoflow.errors import OrthoflowError
from orthoflow.geometry.levels import DEEPER
from orthoflow.products.product import JsonValue, Payload, Product, Tolerance
from orthoflow.records.runs import Run, cell_metrics, is_rounding
from orthoflow.workflow.model import DATA, SEED

if TYPE_CHECKING:
    import pandas as pd

    from orthoflow.catalog.catalog import Catalog
    from orthoflow.engine.store import Store

Verdict = Literal["identical", "within tolerance", "different", "not measured"]


@dataclass(frozen=True, kw_only=True)
class Distance:
    """The largest difference among all fields of one unit.

    Attributes:
        unit: `m`, `px`, `grey`, `deg`, or `1` for plain numbers.
        largest: largest absolute difference in that unit; None if values cannot be subtracted
            (another shape or type, missing, NaN against a number).
        limit: tolerance of the type in the field with the largest difference.
        field: that field, e.g. `walls/0/depth_m`.
        n_values: number of values of the unit beyond their limit.
    """

    unit: str
    largest: float | None
    limit: float
    field: str
    n_values: int


@dataclass(frozen=True, kw_only=True)
class ProductDistance:
    """Two products that ought to be equal.

    Attributes:
        cell: address of their cell.
        port: its output port.
        type_name: product type.
        verdict: `identical` (same bits), `within tolerance`, `different`, or `not measured` if the
            digests differ and the arrays of one of them are not available.
        left: digest of the first, empty when it has none.
        right: digest of the second, empty when it has none.
        distances: one per unit in which they differ.
        reason: one sentence for `different` and `not measured`, else empty.
    """

    cell: str
    port: str
    type_name: str
    verdict: Verdict
    left: str
    right: str
    distances: tuple[Distance, ...] = ()
    reason: str = ""


@dataclass(frozen=True, kw_only=True)
class RunProducts:
    """The products of a run, from its record or a store.

    Attributes:
        run: the run.
        stores: stores that may have arrays which the record names by digest only.
        own: requested address of a cell -> its own one, if the two differ.
    """

    run: Run
    stores: tuple[Store, ...] = ()
    own: Mapping[str, str] = field(default_factory=dict)

    def outputs(self, address: str) -> Mapping[str, RecordedProduct]:
        """Return outputs of a cell by port; empty if the run has no such cell."""
        cell = self.run.cells.get(self.own.get(address, address))
        return {} if cell is None else cell.outputs

    def payload(self, address: str, port: str, cls: type[Product]) -> Payload | None:
        """Return arrays and metadata of an output; None if they are not available."""
        output = self.outputs(address)[port]
        if output.embedded:
            return self.run.payload(self.own.get(address, address), port)
        for store in self.stores:
            if store.product_file(output.digest) is not None:
                return store.get_product(output.digest, cls).to_payload()
        return None


def product_distances(
    left: RunProducts, right: RunProducts, addresses: Sequence[str], catalog: Catalog
) -> tuple[ProductDistance, ...]:
    """Compare the outputs of cells that both runs have.

    Args:
        left: one run.
        right: the other.
        addresses: the cells, each in both runs.
        catalog: has the product types and their tolerances.
    """
    return tuple(
        _distance(left, right, address, port, catalog)
        for address in addresses
        for port in dict.fromkeys((*left.outputs(address), *right.outputs(address)))
    )


def _distance(
    left: RunProducts, right: RunProducts, address: str, port: str, catalog: Catalog
) -> ProductDistance:
    outputs = [side.outputs(address).get(port) for side in (left, right)]
    digests = ["" if output is None else output.digest for output in outputs]
    type_name = next(output.type_name for output in outputs if output is not None)
    distance = partial(
        ProductDistance,
        cell=address,
        port=port,
        type_name=type_name,
        left=digests[0],
        right=digests[1],
    )
    if not all(digests):
        return distance(verdict="different", reason="only one of the runs has it")
    if digests[0] == digests[1]:
        return distance(verdict="identical")
    try:
        cls = catalog.product_class(type_name)
        ours, theirs = (side.payload(address, port, cls) for side in (left, right))
    except OrthoflowError as error:
        return distance(verdict="not measured", reason=f"the digests differ, and {error}")
    if ours is None or theirs is None:
        reason = (
            "the digests differ, and its arrays are in no record and no store at hand; run with "
            "--embed to keep them"
        )
        return distance(verdict="not measured", reason=reason)
    limits = {
        name: (_limit(name, tolerance, ours), tolerance.unit)
        for name, tolerance in cls.tolerances.items()
    }
    differences = [_named(found, ours) for found in measure_payloads(ours, theirs, limits)]
    distances = _by_unit(differences)
    beyond = [difference for difference in differences if difference.n_values]
    if not beyond:
        verdict: Verdict = "within tolerance" if differences else "identical"
        return distance(verdict=verdict, distances=distances)
    others = f"; {len(beyond) - 1} more fields differ" if len(beyond) > 1 else ""
    reason = f"{beyond[0].name}: {beyond[0].problem}{others}"
    return distance(verdict="different", reason=reason, distances=distances)


def _named(difference: ArrayDifference, payload: Payload) -> ArrayDifference:
    """Identify a value in a list by the name and the unit beside it."""
    path = difference.name.split("/")
    beside: JsonValue = dict(payload.metadata)
    for part in path[:-1]:
        if isinstance(beside, dict):
            beside = beside.get(part)
        elif isinstance(beside, list) and part.isdecimal() and int(part) < len(beside):
            beside = beside[int(part)]
    if path[-1] != "value" or not isinstance(beside, dict) or "name" not in beside:
        return difference
    unit = beside.get("unit", difference.unit)
    return replace(difference, name=f"{beside['name']}, {difference.name}", unit=str(unit))


def _limit(name: str, tolerance: Tolerance, payload: Payload) -> float:
    """Return the tolerance of values of a field; grey levels of 16 bits count in steps of 257."""
    is_deep = tolerance.unit == "grey" and any(
        array.dtype == np.uint16 and path.rpartition("/")[2] == name
        for path, array in payload.arrays.items()
    )
    return tolerance.limit * (DEEPER if is_deep else 1)


def _by_unit(differences: Sequence[ArrayDifference]) -> tuple[Distance, ...]:
    """Return the largest difference of each unit."""
    units: dict[str, list[ArrayDifference]] = {}
    for difference in differences:
        units.setdefault(difference.unit, []).append(difference)
    found = []
    for unit, same in units.items():
        worst = max(same, key=lambda difference: difference.largest)
        found.append(
            Distance(
                unit=unit,
                largest=worst.largest if math.isfinite(worst.largest) else None,
                limit=worst.limit,
                field=worst.name,
                n_values=sum(difference.n_values for difference in same),
            )
        )
    return tuple(found)


Side = TypeVar("Side")
# Seconds and memory measured by methods depend on the machine, too.
_COST_UNITS: Final = frozenset(cost.unit for cost in COSTS.values())


@dataclass(frozen=True, kw_only=True)
class Pair(Generic[Side]):
    """The values of two runs for one item.

    Attributes:
        cell: address of the cell it belongs to, empty for what belongs to the whole run.
        name: name of an input, a parameter, a metric or a package.
        left: value of the first run, None without one.
        right: value of the second run, None without one.
    """

    cell: str = ""
    name: str
    left: Side | None
    right: Side | None

    @property
    def is_same(self) -> bool:
        """Whether both are equal."""
        return self.left == self.right

    @property
    def is_shared(self) -> bool:
        """Whether both have a value."""
        return self.left is not None and self.right is not None

    @property
    def is_rounded(self) -> bool:
        """Whether both are values of a metric that differ by rounding only."""
        left, right = self.left, self.right
        return (
            isinstance(left, ComparedMetric)
            and isinstance(right, ComparedMetric)
            and left != right
            and left.is_near(right)
        )

    @property
    def is_moved(self) -> bool:
        """Whether they differ by more than rounding."""
        return not (self.is_same or self.is_rounded)

    @property
    def either(self) -> Side:
        """One of the values, preferably the first."""
        side = self.right if self.left is None else self.left
        if side is None:
            raise AssertionError("a pair stands for something that a run has")
        return side


@dataclass(frozen=True, kw_only=True)
class Difference:
    """Numbers of differing rows of two runs.

    Attributes:
        n_different: rows with values in both runs that differ by more than rounding.
        n_shared: rows with values in both runs.
        n_left: rows with a value in the first run only.
        n_right: rows with a value in the second run only.
        n_rounded: rows that differ by rounding only.
    """

    n_different: int
    n_shared: int
    n_left: int
    n_right: int
    n_rounded: int = 0

    @classmethod
    def of(cls, rows: Iterable[Pair[Any]]) -> Difference:
        """Count rows."""
        rows = tuple(rows)
        shared = [row for row in rows if row.is_shared]
        return cls(
            n_different=sum(row.is_moved for row in shared),
            n_shared=len(shared),
            n_left=sum(row.right is None and row.left is not None for row in rows),
            n_right=sum(row.left is None and row.right is not None for row in rows),
            n_rounded=sum(row.is_rounded for row in shared),
        )


@dataclass(frozen=True, kw_only=True)
class ParameterValue:
    """The resolved value of a parameter.

    Attributes:
        value: JSON.
        is_set: set in the workflow or on the command line; otherwise it is the method's default.
    """

    value: JsonValue
    is_set: bool


@dataclass(frozen=True, kw_only=True)
class CellFacts:
    """What determines a cell's results besides inputs and parameters.

    Attributes:
        status: ok, failed or skipped.
        method: method id.
        distribution: name and version of the method's distribution.
        result_version: result version of the method.
        determinism: exact, seeded or loose.
        seed: None if the method uses none.
        code: digests of code that was not a released install; empty if all was.
        tools: versions of libraries that affect results.
        error: why it failed or was skipped, otherwise empty.
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

    @property
    def parts(self) -> tuple[str, ...]:
        """Each of them in words, status and method first."""
        parts = (
            self.status,
            f"{self.method} result version {self.result_version}"
            if self.result_version
            else self.method,
            self.distribution,
            *(f"code of {name} {digest[:8]}" for name, digest in self.code.items()),
            *(f"{name} {version}" for name, version in self.tools.items()),
            "" if self.seed is None else f"seed {self.seed}",
            self.error,
        )
        return tuple(part for part in parts if part)

    def __str__(self) -> str:
        return ", ".join(self.parts)


@dataclass(frozen=True, kw_only=True)
class ComparedMetric:
    """One number of one cell; equal if value and unit are.

    Attributes:
        value: the number.
        unit: its unit.
        is_cost: a time or memory, which depend on the machine and its load.
        is_cached: of a cell that an earlier run computed; its cost is that run's.
        environment: id of the environment it was computed in.
        better: which values are better; empty where none are.
        headline: it states how good the result is.
    """

    value: float
    unit: str
    is_cost: bool = field(compare=False)
    is_cached: bool = field(compare=False)
    environment: str = field(compare=False)
    better: str = field(compare=False, default="")
    headline: bool = field(compare=False, default=False)

    def is_near(self, other: ComparedMetric | None) -> bool:
        """Whether it is equal to another one apart from rounding."""
        return (
            other is not None and self.unit == other.unit and is_rounding(self.value, other.value)
        )


@dataclass(frozen=True, kw_only=True, repr=False)
class RunComparison:
    """Two runs compared; rows that are equal on both sides are included.

    Attributes:
        left: record of the first run.
        right: record of the second.
        workflow: unified diff of the workflow texts; empty if equal.
        overrides: options that changed the workflow.
        inputs: files of every input, without folders.
        cells: method, version, seed and status of every cell, named as in the first run that has
            it.
        readdressed: address in the second run -> that of its counterpart in the first, if the two
            differ: e.g. a step alone, and a variant with the same parameters.
        parameters: resolved parameters of every cell.
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
    readdressed: Mapping[str, str] = field(default_factory=dict)
    parameters: tuple[Pair[ParameterValue], ...]
    environment: tuple[Pair[str], ...]
    metrics: tuple[Pair[ComparedMetric], ...]
    products: tuple[ProductDistance, ...]

    def __repr__(self) -> str:
        rows = {
            "inputs": Difference.of(self.inputs),
            "parameters": Difference.of(self.shared(self.parameters)),
            "metrics": Difference.of(self.measured),
        }
        parts = [f"{one.n_different} of {one.n_shared} {name}" for name, one in rows.items()]
        verdicts = Counter(item.verdict for item in self.products)
        parts.append(f"{verdicts['different']} of {len(self.products)} products differ")
        parts.append(f"{verdicts['not measured']} products not measured")
        parts.append(f"{sum(not row.is_shared for row in self.cells)} steps in one run only")
        runs = f"{self.left.run_id!r} and {self.right.run_id!r}"
        return f"<RunComparison of {runs}: {', '.join(parts)}>"

    @property
    def measured(self) -> tuple[Pair[ComparedMetric], ...]:
        """Numbers of the cells that both runs have, without times and memory."""
        return tuple(row for row in self.shared(self.metrics) if not row.either.is_cost)

    @property
    def step_of(self) -> dict[str, str]:
        """Return the step of each cell of either run."""
        return {cell.address: cell.step for side in (self.left, self.right) for cell in side.cells}

    @property
    def of_shared_steps(self) -> str:
        """Return to which steps the rows of `shared` belong; empty if both runs have all."""
        n_shared = sum(row.is_shared for row in self.cells)
        all_shared = n_shared == len(self.cells)
        counted = "step" if n_shared == 1 else f"{n_shared} steps"
        return "" if all_shared else f", of the {counted} that both have"

    def shared(self, rows: Sequence[Pair[Side]]) -> tuple[Pair[Side], ...]:
        """Leave out rows of cells that only one of the runs has: they cannot differ."""
        alone = {row.cell for row in self.cells if not row.is_shared}
        return tuple(row for row in rows if row.cell not in alone)

    def metric_table(self) -> pd.DataFrame:
        """Return every number of both runs side by side.

        Returns:
            Columns `cell`, `metric`, `left`, `right`, `difference` (right - left; NaN if one is
            missing) and `unit`.
        """
        import pandas as pd  # noqa: PLC0415 - takes a second, and few ask

        rows = []
        for row in self.metrics:
            left, right = (
                math.nan if side is None else side.value for side in (row.left, row.right)
            )
            rows.append((row.cell, row.name, left, right, right - left, row.either.unit))
        columns = ["cell", "metric", "left", "right", "difference", "unit"]
        return pd.DataFrame(rows, columns=columns)


def compare_runs(left: Run, right: Run, *, stores: Sequence[Store] = ()) -> RunComparison:
    """Compare two runs.

    Cells correspond if they have the same step, dataset and seed, and each step that varies before
    them has the same method and parameters; otherwise if their addresses are equal.

    Args:
        left: the first run.
        right: the second run.
        stores: stores that may have arrays which a record names by digest only.

    Raises:
        RecordError: a record is damaged.
    """
    from orthoflow.catalog.discovery import discover_catalog  # noqa: PLC0415 - loads plugins

    readdressed = _readdressed(left, right)
    # Name of the second run's cells here -> name in the run itself.
    own = {_label(right, address, readdressed): address for address in right.cells}
    both = [address for address in left.cells if address in own]
    sides = (left.record, right.record)
    return RunComparison(
        left=left.record,
        right=right.record,
        workflow=_text_differences(left.record, right.record),
        overrides=Pair(name="overrides", left=left.record.overrides, right=right.record.overrides),
        inputs=_pairs("", *({entry.name: entry.files for entry in side.inputs} for side in sides)),
        cells=_per_cell(left, right, own, lambda cell: {cell.step: _facts(cell)}),
        readdressed=readdressed,
        parameters=_per_cell(left, right, own, _parameters),
        environment=_pairs("", *(_environment(side) for side in sides)),
        metrics=_per_cell(left, right, own, _metrics),
        products=product_distances(
            RunProducts(run=left, stores=tuple(stores)),
            RunProducts(run=right, stores=tuple(stores), own=own),
            both,
            discover_catalog(),
        ),
    )


def compare_metrics(left: Run, right: Run) -> tuple[Pair[ComparedMetric], ...]:
    """Return the numbers side by side of cells that both runs have; no times, no memory."""
    both = [address for address in left.cells if address in right.cells]
    rows = (
        row
        for address in both
        for row in _pairs(address, *(_metrics(run.cells[address]) for run in (left, right)))
    )
    # A number that only one side calls a time is not a time.
    return tuple(
        row for row in rows if not all(side.is_cost for side in (row.left, row.right) if side)
    )


def _pairs(
    cell: str, left: Mapping[str, Side], right: Mapping[str, Side]
) -> tuple[Pair[Side], ...]:
    return tuple(
        Pair(cell=cell, name=name, left=left.get(name), right=right.get(name))
        for name in dict.fromkeys((*left, *right))
    )


def _per_cell(
    left: Run,
    right: Run,
    own: Mapping[str, str],
    values: Callable[[RecordedCell], Mapping[str, Side]],
) -> tuple[Pair[Side], ...]:
    found: list[Pair[Side]] = []
    for address in dict.fromkeys((*left.cells, *own)):
        ours, theirs = left.cells.get(address), right.cells.get(own.get(address, address))
        sides = [{} if cell is None else values(cell) for cell in (ours, theirs)]
        found += _pairs(address, *sides)
    return tuple(found)


def _readdressed(left: Run, right: Run) -> dict[str, str]:
    """Find cells of the second run that the first has under another address.

    Names of variants are labels, not identity: cells with the same methods and parameters
    correspond, then those with the same address.
    """
    varied = {
        step for run in (left, right) for cell in run.cells.values() for step in cell.assignment
    }
    # A skipped cell has no inputs, so its origin is unknown.
    ours, theirs = (
        {
            address: _identity(run, cell, varied)
            for address, cell in run.cells.items()
            if cell.status != "skipped"
        }
        for run in (left, right)
    )
    found = {address: address for address, one in theirs.items() if ours.get(address) == one}
    free: dict[tuple[object, ...], list[str]] = {}
    for address, one in ours.items():
        if address not in found:
            free.setdefault(one, []).append(address)
    for address, one in theirs.items():
        if address not in found and free.get(one):
            found[address] = free[one].pop(0)
    return {theirs: ours for theirs, ours in found.items() if theirs != ours}


def _label(right: Run, address: str, readdressed: Mapping[str, str]) -> str:
    """Return the name of a cell of the second run: that of its counterpart in the first run."""
    if address not in readdressed and address in readdressed.values():
        # It has no counterpart, and its address means another cell in the first run.
        return f"{address} ({right.record.run_id})"
    return readdressed.get(address, address)


def _identity(run: Run, cell: RecordedCell, varied: Collection[str]) -> tuple[object, ...]:
    """Return what a cell is, without the names of its variants.

    Args:
        run: the run of the cell.
        cell: the cell.
        varied: steps that vary in either run; they count with their method and parameters, a step
            without variants as its only variant.
    """
    called = {
        one.step: (one.method, canonical_json(dict(one.params)))
        for one in run.upstream(cell.address)
        if one.step in varied
    }
    factors = tuple(cell.assignment.get(factor) for factor in (DATA, SEED))
    return cell.step, cell.repeat, factors, tuple(sorted(called.items()))


def _text_differences(left: RunRecord, right: RunRecord) -> tuple[str, ...]:
    ours, theirs = (side.workflow_source.splitlines() for side in (left, right))
    return tuple(difflib.unified_diff(ours, theirs, left.run_id, right.run_id, n=1, lineterm=""))


def _facts(cell: RecordedCell) -> CellFacts:
    if cell.status == "skipped":
        # A skipped method decides nothing, and has versions only if another cell has loaded it.
        unloaded = MethodIdentity(method=cell.method)
        cell = replace(cell, seed=None, **shared_fields(unloaded, MethodIdentity))
    preimage = read_preimage(cell.key_preimage)
    return CellFacts(
        status=cell.status,
        method=cell.method,
        distribution=f"{cell.distribution} {cell.distribution_version}".strip(),
        result_version=cell.result_version,
        determinism=cell.determinism,
        seed=cell.seed,
        code=stated_versions(preimage, "code"),
        tools=stated_versions(preimage, "tools"),
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
            is_cost=row.metric in COSTS or row.unit in _COST_UNITS,
            is_cached=bool(cell.cached_from),
            environment=cell.environment,
            better=row.better,
            headline=row.headline,
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
