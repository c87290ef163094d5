"""Comparison of two runs: products, metrics, inputs, parameters and versions."""

from __future__ import annotations

import difflib
import math
import re
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

from orthoflow.catalog.distributions import canonical_name, required_distributions
from orthoflow.engine.keys import read_preimage, stated_versions
from orthoflow.errors import OrthoflowError
from orthoflow.geometry.levels import DEEPER
from orthoflow.products.product import JsonValue, Payload, Product, Tolerance
from orthoflow.records.runs import Run, cell_metrics, is_rounding
from orthoflow.version import DISTRIBUTION
from orthoflow.workflow.model import DATA, SEED

if TYPE_CHECKING:
    import pandas as pd

    from orthoflow.catalog.catalog import Catalog
    from orthoflow.engine.store import Store

Verdict = Literal["identical", "within tolerance", "different", "not measured"]


@dataclass(frozen=True, kw_only=True)
class Distance:
    """The largest difference between two products, among all fields with the same unit.

    Attributes:
        unit: `m`, `px`, `grey`, `deg`, or `1` for plain numbers.
        largest: largest absolute difference in `unit`; None if values cannot be subtracted
            (different shapes or types, missing values, or NaN in only one product).
        limit: tolerance of `field`.
        field: name of the field with the largest difference, e.g. `walls/0/depth_m`.
        n_values: number of values with this unit that differ by more than their tolerance.
    """

    unit: str
    largest: float | None
    limit: float
    field: str
    n_values: int


@dataclass(frozen=True, kw_only=True)
class ProductDistance:
    """Comparison of the same output in two runs.

    Attributes:
        cell: address of the cell that has the output.
        port: port of the output.
        type_name: product type.
        verdict: `identical` (same bits), `within tolerance`, `different`, or `not measured` if the
            digests differ and the arrays of one product are not available.
        left: digest of the product in the first run; empty if there is none.
        right: digest of the product in the second run; empty if there is none.
        distances: the largest difference for each unit in which the products differ.
        reason: reason for `different` or `not measured`, as one sentence; otherwise empty.
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
    """The products of a run, from its record or from a store.

    Attributes:
        run: the run.
        stores: stores that may contain arrays that the record references only by digest.
        own: address in the comparison -> address in this run, for cells whose addresses differ.
    """

    run: Run
    stores: tuple[Store, ...] = ()
    own: Mapping[str, str] = field(default_factory=dict)

    def outputs(self, address: str) -> Mapping[str, RecordedProduct]:
        """Return the outputs of a cell by port; empty if the run has no such cell."""
        cell = self.run.cells.get(self.own.get(address, address))
        return {} if cell is None else cell.outputs

    def payload(self, address: str, port: str, cls: type[Product]) -> Payload | None:
        """Return the arrays and metadata of an output; None if they are not available."""
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
    """Compare the outputs of cells that exist in both runs.

    Args:
        left: the first run.
        right: the second run.
        addresses: addresses of cells that exist in both runs.
        catalog: catalog with the product types and their tolerances.
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
        return distance(verdict="different", reason="it exists in only one of the runs")
    if digests[0] == digests[1]:
        return distance(verdict="identical")
    try:
        cls = catalog.product_class(type_name)
        ours, theirs = (side.payload(address, port, cls) for side in (left, right))
    except OrthoflowError as error:
        return distance(
            verdict="not measured",
            reason=f"the digests differ, but the arrays cannot be compared: {error}",
        )
    if ours is None or theirs is None:
        reason = (
            "the digests differ, but the arrays cannot be compared, because they are in no "
            "record or available store; run with --embed to keep the arrays"
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
    """Add the name and unit that the metadata give for a differing value, if any."""
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
    """Return the tolerance of a field, multiplied by 257 for 16-bit grey levels."""
    is_deep = tolerance.unit == "grey" and any(
        array.dtype == np.uint16 and path.rpartition("/")[2] == name
        for path, array in payload.arrays.items()
    )
    return tolerance.limit * (DEEPER if is_deep else 1)


def _by_unit(differences: Sequence[ArrayDifference]) -> tuple[Distance, ...]:
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
_WALL: Final = re.compile(r"wall_(\d{1,5})_depth\.tif$")
# Methods may also report times and memory, which depend on the machine.
_COST_UNITS: Final = frozenset(cost.unit for cost in COSTS.values())


@dataclass(frozen=True, kw_only=True)
class Pair(Generic[Side]):
    """The values of one item, such as a metric or parameter, in two runs.

    Attributes:
        cell: address of the cell; empty for items of the whole run.
        name: name of the item.
        left: value in the first run; None if there is none.
        right: value in the second run; None if there is none.
    """

    cell: str = ""
    name: str
    left: Side | None
    right: Side | None

    @property
    def is_same(self) -> bool:
        """Whether both values are equal."""
        return self.left == self.right

    @property
    def is_shared(self) -> bool:
        """Whether both runs have a value."""
        return self.left is not None and self.right is not None

    @property
    def is_rounded(self) -> bool:
        """Whether the item is a metric whose values differ only by rounding."""
        left, right = self.left, self.right
        return (
            isinstance(left, ComparedMetric)
            and isinstance(right, ComparedMetric)
            and left != right
            and left.is_near(right)
        )

    @property
    def is_moved(self) -> bool:
        """Whether the values differ by more than rounding."""
        return not (self.is_same or self.is_rounded)

    @property
    def either(self) -> Side:
        """The value of the first run or, if there is none, of the second."""
        side = self.right if self.left is None else self.left
        if side is None:
            raise AssertionError("at least one run must have a value")
        return side


@dataclass(frozen=True, kw_only=True)
class ParameterValue:
    """The resolved value of a parameter.

    Attributes:
        value: value as JSON.
        is_set: whether the value was set in the workflow or on the command line; otherwise it is
            the default.
    """

    value: JsonValue
    is_set: bool


@dataclass(frozen=True, kw_only=True)
class CellFacts:
    """Everything besides inputs and parameters that determines the results of a cell.

    Attributes:
        status: ok, failed or skipped.
        method: method id.
        distribution: name and version of the method's distribution.
        result_version: result version of the method.
        determinism: exact, seeded or loose.
        seed: seed; None if the method uses none.
        code: digests of the code of the method and the framework, as far as it is not from a
            release.
        tools: library -> version, for libraries that can affect results.
        error: reason why the cell failed or was skipped, otherwise empty.
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
        """These properties as text, beginning with status and method."""
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
    """A metric of one cell; two metrics are equal if their values and units are equal.

    Attributes:
        value: value of the metric.
        unit: unit of the value.
        is_cost: whether the metric is a time or memory use, which depends on the machine and its
            load.
        is_cached: whether an earlier run computed the cell; if so, costs are those of the earlier
            run.
        environment: id of the environment in which the metric was computed.
        better: which values are better; empty if neither lower nor higher
            values are better.
        headline: whether the metric describes the quality of the result.
    """

    value: float
    unit: str
    is_cost: bool = field(compare=False)
    is_cached: bool = field(compare=False)
    environment: str = field(compare=False)
    better: str = field(compare=False, default="")
    headline: bool = field(compare=False, default=False)

    def is_near(self, other: ComparedMetric | None) -> bool:
        """Whether this metric is equal to another one, apart from rounding."""
        return (
            other is not None and self.unit == other.unit and is_rounding(self.value, other.value)
        )


@dataclass(frozen=True, kw_only=True, repr=False)
class RunComparison:
    """Comparison of two runs, including items that do not differ.

    Attributes:
        left: record of the first run.
        right: record of the second run.
        workflow: unified diff of the workflow texts; empty if they are the same.
        overrides: command-line options that changed the workflow, in each run.
        inputs: files of each input, without folders.
        cells: method, version, seed and status of each cell; cells that exist in the first run have
            their address there.
        readdressed: address in the second run -> address in the first run, for cells whose
            addresses differ, e.g. because a variant in one run has the parameters of the step in
            the other.
        parameters: resolved parameters of each cell.
        environment: versions of Python and packages, system, and processor. If a run has several
            values, they are separated by commas. Packages that only one run recorded are omitted
            unless a method requires them.
        metrics: metrics of each cell.
        products: comparison of each product of the cells that exist in both runs.
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
        rows: dict[str, Sequence[Pair[Any]]] = {
            "inputs": self.inputs,
            "parameters": self.shared(self.parameters),
            "metrics": self.measured,
        }
        both = {name: [row for row in found if row.is_shared] for name, found in rows.items()}
        parts = [
            f"{sum(row.is_moved for row in found)} of {len(found)} {name}"
            for name, found in both.items()
        ]
        verdicts = Counter(item.verdict for item in self.products)
        parts.append(f"{verdicts['different']} of {len(self.products)} products differ")
        parts.append(f"{verdicts['not measured']} products not measured")
        parts.append(f"{sum(not row.is_shared for row in self.cells)} steps in only one run")
        runs = f"{self.left.run_id!r} and {self.right.run_id!r}"
        return f"<RunComparison of {runs}: {', '.join(parts)}>"

    @property
    def measured(self) -> tuple[Pair[ComparedMetric], ...]:
        """Metrics of the cells that exist in both runs, without times and memory."""
        return tuple(row for row in self.shared(self.metrics) if not row.either.is_cost)

    @property
    def step_of(self) -> dict[str, str]:
        """Return the step of each cell of either run."""
        return {cell.address: cell.step for side in (self.left, self.right) for cell in side.cells}

    @property
    def of_shared_steps(self) -> str:
        """Return a phrase for the number of steps that both runs have; empty if they share all."""
        n_shared = sum(row.is_shared for row in self.cells)
        all_shared = n_shared == len(self.cells)
        counted = "step" if n_shared == 1 else f"{n_shared} steps"
        return "" if all_shared else f", of the {counted} that both have"

    @property
    def first_walls(self) -> str:
        """Return which walls the metrics of the first wall refer to, if the runs differ in it."""
        left, right = (
            min(
                (int(found[1]) for file in record.published if (found := _WALL.search(file.path))),
                default=None,
            )
            for record in (self.left, self.right)
        )
        if left is None or right is None or left == right:
            return ""
        return f"; the first wall is wall {left} in A and wall {right} in B"

    def shared(self, rows: Sequence[Pair[Side]]) -> tuple[Pair[Side], ...]:
        """Return the rows without those of cells that exist in only one run."""
        alone = {row.cell for row in self.cells if not row.is_shared}
        return tuple(row for row in rows if row.cell not in alone)

    def parameter_table(self, *, changed: bool = True) -> pd.DataFrame:
        """Return the parameters of both runs next to each other.

        Args:
            changed: whether to return only parameters that differ.

        Returns:
            A table with the columns `cell`, `parameter`, `left` and `right` for the cells that both
            runs have; a value is None if the run does not have the parameter.
        """
        import pandas as pd  # noqa: PLC0415 - takes a second, and few ask

        rows = [
            (row.cell, row.name, row.left and row.left.value, row.right and row.right.value)
            for row in self.shared(self.parameters)
            if not (changed and row.is_same)
        ]
        return pd.DataFrame(rows, columns=["cell", "parameter", "left", "right"], dtype=object)

    def metric_table(self) -> pd.DataFrame:
        """Return all metrics of both runs next to each other.

        Returns:
            A table with the columns `cell`, `metric`, `left`, `right`, `difference` (right minus
            left; NaN if a value is missing) and `unit`.
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

    Two cells correspond if they have the same step, dataset and seed, and if all upstream steps
    with variants have the same method and parameters. The remaining cells correspond if they have
    the same address.

    Args:
        left: the first run.
        right: the second run.
        stores: stores that may contain arrays that a record references only by digest.

    Raises:
        RecordError: a record is damaged.
    """
    from orthoflow.catalog.discovery import discover_catalog  # noqa: PLC0415 - loads plugins

    readdressed = _readdressed(left, right)
    # Map the name of a cell in this comparison to its address in the second run.
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
        environment=_environment_pairs(left.record, right.record),
        metrics=_per_cell(left, right, own, _metrics),
        products=product_distances(
            RunProducts(run=left, stores=tuple(stores)),
            RunProducts(run=right, stores=tuple(stores), own=own),
            both,
            discover_catalog(),
        ),
    )


def compare_metrics(left: Run, right: Run) -> tuple[Pair[ComparedMetric], ...]:
    """Return the metrics of cells that exist in both runs, without times and memory."""
    both = [address for address in left.cells if address in right.cells]
    rows = (
        row
        for address in both
        for row in _pairs(address, *(_metrics(run.cells[address]) for run in (left, right)))
    )
    # Keep metrics that are declared as a cost in only one run.
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
    """Find cells of the second run that have a different address in the first.

    Names of variants are only labels, so cells with the same methods and parameters correspond,
    even if their addresses differ. The remaining cells correspond if their addresses are the same.
    """
    varied = {
        step for run in (left, right) for cell in run.cells.values() for step in cell.assignment
    }
    # The inputs of a skipped cell are not recorded, so its upstream cells are unknown.
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
    """Return the name of a cell of the second run in the comparison.

    This is the address of the corresponding cell of the first run, or its own address if there is
    none.
    """
    if address not in readdressed and address in readdressed.values():
        # The first run has no corresponding cell, and there the address belongs to another cell.
        return f"{address} ({right.record.run_id})"
    return readdressed.get(address, address)


def _identity(run: Run, cell: RecordedCell, varied: Collection[str]) -> tuple[object, ...]:
    """Return the identity of a cell, which does not depend on the names of its variants.

    Args:
        run: run of the cell.
        cell: the cell.
        varied: steps that have variants in either run; in both runs, they are identified by their
            method and parameters.
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
        # Ignore the version of a skipped method, which is known only if another cell used the
        # method.
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


def _environment_pairs(left: RunRecord, right: RunRecord) -> tuple[Pair[str], ...]:
    named = {cell.distribution for side in (left, right) for cell in side.cells} - {""}
    used = required_distributions(frozenset({*named, DISTRIBUTION}))
    rows = _pairs("", *map(_environment, (left, right)))
    packages = {
        name for side in (left, right) for one in side.environments for name in one.packages
    }
    return tuple(
        row
        for row in rows
        if row.is_shared
        or row.name not in packages
        or used is None
        or canonical_name(row.name) in used
    )


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
