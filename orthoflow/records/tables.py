"""Tables from records: CSV files, joined runs, diagnostics as JSON, and common check points."""

from __future__ import annotations

import json
import math
import re
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Final, TypeAlias

import numpy as np
from orthoflow_provenance.document import (
    COSTS,
    CellOutcome,
    RecordedCell,
    RecordedDiagnostic,
    RunRecord,
    sha256_text,
)

from orthoflow.engine.journal import RECORD_FILE
from orthoflow.errors import ArgumentError
from orthoflow.products import Inspection
from orthoflow.products.product import JsonValue
from orthoflow.records.runs import METRICS_FILE, MetricRow, Run, cell_metrics, write_metrics_csv
from orthoflow.untrusted_text import Value, csv_text
from orthoflow.workflow.model import DATA, SEED

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, kw_only=True)
class CommonPoints:
    """Statistics of one inspection over the check points found by all comparable inspections.

    Attributes:
        cell: address of the inspection.
        step: step of the inspection.
        kind: class of the points; empty for all points.
        n_found: number of points that this inspection found.
        n_common: number of points that all inspections found.
        rms_u_mm: root mean square of the displacements along u over the common points.
        rms_v_mm: the same along v.
        rms_mm: root mean square of the lengths of the displacements (u, v).
    """

    cell: str
    step: str
    kind: str
    n_found: int
    n_common: int
    rms_u_mm: float
    rms_v_mm: float
    rms_mm: float

    @property
    def n_lost(self) -> int:
        """Number of points that this inspection found but another one did not."""
        return self.n_found - self.n_common


def common_points(run: Run) -> tuple[CommonPoints, ...]:
    """Compare the inspections of each step over their common points.

    Inspections are compared if they have the same dataset, seed and repeat. Inspections without
    common points, such as those that match features, are omitted, and so are inspections whose
    products are not in the record.

    Raises:
        RecordError: the record is damaged.
    """
    groups: dict[tuple[str, ...], list[tuple[str, str]]] = defaultdict(list)
    for cell in run.record.cells:
        for port, output in cell.outputs.items():
            if output.type_name == Inspection.type_name and output.embedded:
                conditions = (cell.assignment.get(DATA, ""), cell.assignment.get(SEED, ""))
                groups[cell.step, port, *conditions, str(cell.repeat)].append((cell.address, port))
    compared = {key: places for key, places in groups.items() if len(places) > 1}
    payloads = run.payloads([place for places in compared.values() for place in places])
    rows: list[CommonPoints] = []
    for (step, *_), places in compared.items():
        found = {cell: Inspection.from_payload(next(payloads)) for cell, _ in places}
        rows += over_common_points(found, step=step)
    return tuple(rows)


def over_common_points(
    inspections: Mapping[str, Inspection], *, step: str = ""
) -> Iterator[CommonPoints]:
    """Yield the statistics of inspections over the points found by all of them, for each class.

    Args:
        inspections: address of the cell -> inspection. Points of two inspections are the same if
            their coordinates and classes are equal.
        step: step of the cells.
    """
    places = {cell: _rows_of_points(found) for cell, found in inspections.items()}
    common = set.intersection(*(set(rows) for rows in places.values()))
    if not common:
        return
    kinds = sorted({kind for kind, _ in common})
    for kind in ["", *(kinds if len(kinds) > 1 else ())]:
        for cell, inspection in inspections.items():
            rows = places[cell]
            mine = [point for point in rows if kind in ("", point[0])]
            shared = [rows[point] for point in mine if point in common]
            squares = (1e3 * inspection.displacement_m[shared]) ** 2
            along_u, along_v = squares.mean(axis=0).tolist()
            yield CommonPoints(
                cell=cell,
                step=step,
                kind=kind,
                n_found=len(mine),
                n_common=len(shared),
                rms_u_mm=math.sqrt(along_u),
                rms_v_mm=math.sqrt(along_v),
                rms_mm=math.sqrt(along_u + along_v),
            )


def _rows_of_points(inspection: Inspection) -> dict[tuple[str, bytes], int]:
    kinds = [inspection.kinds[index] for index in inspection.kind]
    points = np.ascontiguousarray(inspection.points_world)
    return {
        (kind, point.tobytes()): row
        for row, (kind, point) in enumerate(zip(kinds, points, strict=True))
    }


Row: TypeAlias = Sequence[Value]


def write_csv_tables(run: Run, folder: Path) -> tuple[Path, ...]:
    """Write the tables of a run as CSV files, with headers and in full precision.

    Args:
        run: the run.
        folder: existing folder.

    Returns:
        The paths of the files: cells, metrics, parameters, inputs, products and environments, and
        also statistics over common check points if several inspections found such points.
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


# The method and parameters (as JSON) of a step with variants.
Choice: TypeAlias = tuple[str, str]
_BEHIND: Final = ("unit", "better", "step", "cell", "repeat", "runs", "environments")
_RANGE: Final = ("lowest", "highest")


@dataclass(frozen=True, kw_only=True)
class JoinedCell:
    """A cell in all records that contain it.

    Attributes:
        found: each run with its entry of the cell, in the order of the runs.
        choices: step with variants -> method and parameters used for this cell.
        settings: parameters (`step.name`), methods (`step.use`) and result versions
            (`method.result_version`) of this step and all upstream steps; only the result version
            for steps with variants.
        dataset: name of the dataset; empty if the run has only one.
        seed: seed of the workflow, or value of a sweep over seeds.
    """

    found: tuple[tuple[Run, RecordedCell], ...]
    choices: Mapping[str, Choice]
    settings: Mapping[str, Value]
    dataset: str
    seed: str

    @property
    def cell(self) -> RecordedCell:
        """The cell in the first record that contains it."""
        return self.found[0][1]

    @property
    def n_environments(self) -> int:
        """Number of environments in which the cell was computed; results may differ by rounding."""
        return len({cell.environment for _, cell in self.found})

    def values(self) -> Iterator[tuple[MetricRow, list[float]]]:
        """Yield each metric of the first record together with its values in all records."""
        rows = [cell_metrics(cell) for _, cell in self.found]
        first = {row.metric: row for found in reversed(rows) for row in found}
        for name in dict.fromkeys(row.metric for found in rows for row in found):
            stated = [row.value for found in rows for row in found if row.metric == name]
            yield first[name], stated


@dataclass(frozen=True, kw_only=True)
class RunSet:
    """Several runs whose cells are joined into one table.

    Two cells are the same if they and their upstream cells have the same method, result version,
    parameters, seed and repeat, and if the input files have the same content. The names of
    variants, inputs and datasets may differ. Variants are named as in the first record that
    contains them.

    Attributes:
        runs: the runs, in the order given.
    """

    runs: tuple[Run, ...]
    _identities: dict[tuple[Path, str], str] = field(default_factory=dict, compare=False)

    def __repr__(self) -> str:
        return f"<RunSet of {len(self.runs)} runs: {len(self.cells)} cells>"

    @cached_property
    def steps(self) -> tuple[str, ...]:
        """Steps with variants in any of the runs."""
        factors = (name for run in self.runs for one in run.record.cells for name in one.assignment)
        return tuple(name for name in dict.fromkeys(factors) if name not in (DATA, SEED))

    @cached_property
    def cells(self) -> tuple[JoinedCell, ...]:
        """The cells that have a result in any of the runs, without duplicates."""
        found: dict[str, list[tuple[Run, RecordedCell]]] = {}
        for run in self.runs:
            for cell in run.record.cells:
                if cell.status == "ok":
                    found.setdefault(self._identity(run, cell), []).append((run, cell))
        return tuple(self._joined(tuple(same)) for same in found.values())

    @cached_property
    def differing(self) -> tuple[str, ...]:
        """Names of the settings in which the runs differ.

        Differences between datasets of one run do not count.
        """
        in_runs: dict[str, dict[Path, set[Value]]] = defaultdict(lambda: defaultdict(set))
        by_dataset: dict[str, dict[str, set[Value]]] = defaultdict(lambda: defaultdict(set))
        used: dict[str, dict[Path, set[str]]] = defaultdict(lambda: defaultdict(set))
        for one in self.cells:
            for run, cell in one.found:
                used[cell.step][run.path].update(
                    name for name in one.settings if name.endswith(".use")
                )
                for name, value in one.settings.items():
                    in_runs[name][run.path].add(value)
                    by_dataset[name][one.dataset].add(value)
        found: set[str] = set()
        for names in used.values():
            every = list(names.values())
            found |= set[str]().union(*every) - every[0].intersection(*every)
        for name, runs in in_runs.items():
            is_of_dataset = any(len(values) > 1 for values in runs.values())
            groups = by_dataset[name].values() if is_of_dataset else [set.union(*runs.values())]
            if any(len(values) > 1 for values in groups):
                found.add(name)
        return tuple(name for name in in_runs if name in found)

    def metrics(self) -> pd.DataFrame:
        """Return one row per cell and metric.

        Returns:
            A table with these columns: `run` (the first run that contains the cell), `dataset` and
            `seed`; `variant.<step>` for each step with variants; one column for each other setting
            in which the runs differ, such as `wall.gsd_m`, or `wall.use` for the method (empty if
            the setting does not apply); `method`, `metric`, `value` (in the first record), `unit`,
            `better`, `step`, `cell` (address in the first record) and `repeat`; `runs` and
            `environments` (numbers of records that contain the cell, and of environments in which
            it was computed); and `lowest` and `highest` (extreme values in these records).
        """
        import pandas as pd  # noqa: PLC0415 - takes a second, and few ask

        header, *rows = self.rows()
        return pd.DataFrame(rows, columns=header)

    def statistics(self) -> pd.DataFrame:
        """Return statistics over the datasets, seeds and repeats of all records.

        Returns:
            A table with one row for each combination of variants, differing settings, step, method
            and metric, and with the columns `n`, `median`, `mean`, `standard_deviation` (NaN for a
            single value), `lowest` and `highest`. A cell that is in several records counts once.
        """
        names = [f"variant.{step}" for step in self.steps]
        keys = [*names, *self.differing, "step", "method", "metric", "unit", "better"]
        table = self.metrics().astype({"value": float})
        values = table.groupby(keys, sort=False, dropna=False)["value"]
        return values.agg(
            n="count",
            median="median",
            mean="mean",
            standard_deviation="std",
            lowest="min",
            highest="max",
        ).reset_index()

    def rows(self) -> Iterator[tuple[Value, ...]]:
        """Yield the rows of `metrics`, beginning with the header."""
        variants = tuple(f"variant.{step}" for step in self.steps)
        varied = (*variants, *self.differing)
        yield ("run", "dataset", "seed", *varied, "method", "metric", "value", *_BEHIND, *_RANGE)
        names = self._variant_names
        for one in self.cells:
            chosen = (
                names[step, one.choices[step]] if step in one.choices else "" for step in self.steps
            )
            settings = (one.settings.get(name) for name in self.differing)
            front: tuple[Value, ...] = (
                *(_place(one.found[0][0]), one.dataset, int(one.seed)),
                *(*chosen, *settings, one.cell.method),
            )
            for row, values in one.values():
                yield (
                    *front,
                    *(row.metric, row.value, row.unit, row.better, one.cell.step),
                    *(one.cell.address, one.cell.repeat, len(one.found), one.n_environments),
                    *(min(values), max(values)),
                )

    @cached_property
    def _variant_names(self) -> dict[tuple[str, Choice], str]:
        """Return the name of each choice, with differing parameters if the name is not unique."""
        first: dict[tuple[str, Choice], str] = {}
        for run in self.runs:
            for cell in run.record.cells:
                if cell.step in self.steps:
                    name = cell.assignment.get(cell.step, cell.method)
                    first.setdefault((cell.step, _choice(cell)), name)
        names: dict[tuple[str, Choice], str] = {}
        for (step, choice), name in first.items():
            others = [two for (one, two), other in first.items() if (one, other) == (step, name)]
            names[step, choice] = name + _distinction(choice, others)
        return names

    def _joined(self, same: tuple[tuple[Run, RecordedCell], ...]) -> JoinedCell:
        run, cell = same[0]
        upstream = list(run.upstream(cell.address))
        factors = {
            name: value for one in reversed(upstream) for name, value in one.assignment.items()
        }
        return JoinedCell(
            found=same,
            choices={
                one.step: _choice(one) for one in reversed(upstream) if one.step in self.steps
            },
            settings={
                name: value
                for one in reversed(upstream)
                for name, value in _settings(one, is_varied=one.step in self.steps)
            },
            dataset=factors.get(DATA, ""),
            seed=factors.get(SEED, str(run.record.seed)),
        )

    def _identity(self, run: Run, cell: RecordedCell) -> str:
        known = self._identities.get((run.path, cell.address))
        if known is not None:
            return known
        # This entry ends the recursion if a cell of a forged record depends on itself.
        self._identities[run.path, cell.address] = ""
        inputs: dict[str, JsonValue] = {}
        for port, given in cell.inputs.items():
            owner, _, name = given.source.rpartition(".")
            before = run.cells.get(owner)
            inputs[port] = given.digest if before is None else [self._identity(run, before), name]
        content = {
            "step": cell.step,
            "method": cell.method,
            "result_version": cell.result_version,
            "params": dict(cell.params),
            "seed": cell.seed,
            "repeat": cell.repeat,
            "inputs": inputs,
        }
        identity = sha256_text(json.dumps(content, sort_keys=True))
        self._identities[run.path, cell.address] = identity
        return identity


def join_runs(runs: Sequence[Run]) -> RunSet:
    """Join runs into one table.

    Raises:
        ArgumentError: no runs are given.
    """
    if not runs:
        raise ArgumentError("give at least one run, a run folder or its run.h5")
    return RunSet(runs=tuple(runs))


def _place(run: Run) -> str:
    return str(run.folder if run.path.name == RECORD_FILE else run.path)


def _settings(cell: RecordedCell, *, is_varied: bool) -> Iterator[tuple[str, Value]]:
    """Yield the settings of a cell; values that are neither text nor numbers as JSON."""
    yield f"{cell.method}.result_version", cell.result_version
    if not is_varied:
        yield f"{cell.step}.use", cell.method
        for name, value in cell.params.items():
            known = value if isinstance(value, str | int | float) else json.dumps(value)
            yield f"{cell.step}.{name}", known


def _choice(cell: RecordedCell) -> Choice:
    return cell.method, json.dumps(dict(cell.params), sort_keys=True)


def _distinction(choice: Choice, others: Sequence[Choice]) -> str:
    if len(set(others)) < 2:
        return ""
    params = json.loads(choice[1])
    differing = [
        f"{name}={json.dumps(value)}"
        for name, value in params.items()
        if any(json.loads(other).get(name) != value for _, other in others)
    ]
    methods = {method for method, _ in others}
    parts = [*([choice[0]] if len(methods) > 1 else []), *differing]
    return f" ({', '.join(parts)})"


_WORD: Final = re.compile(r"(?<!^)(?=[A-Z])")


def diagnostics_of(cell: CellOutcome, step: str, address: str) -> Iterator[dict[str, JsonValue]]:
    """Yield the diagnostics of a cell, beginning with the error if the cell failed.

    The code of an error is derived from its class: `input-error` for `InputError`.
    """
    found = list(cell.diagnostics)
    if cell.status == "failed":
        code = _WORD.sub("-", cell.error_type).lower() or "failed"
        failure = RecordedDiagnostic(
            code=code, severity="error", subject=address, values={}, text=cell.error_message
        )
        found.insert(0, failure)
    for one in found:
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
