"""Functions that check whether a recorded run can be repeated, and plan its replay."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

from orthoflow_provenance.document import RecordedCell
from pydantic import ValidationError

from orthoflow.catalog.catalog import Catalog
from orthoflow.engine.environment import environment
from orthoflow.engine.keys import input_digest, read_preimage, stated_versions
from orthoflow.engine.plan import RunOptions, RunPlan, plan_run
from orthoflow.engine.store import Store
from orthoflow.errors import PluginError, WorkflowError
from orthoflow.records.compare import ComparedMetric, Pair, ProductDistance, compare_metrics
from orthoflow.records.inputs import (
    MissingMethodsError,
    PlacedInputs,
    RefusedRunError,
    find_inputs,
)
from orthoflow.records.runs import Run
from orthoflow.records.verify import verify_run
from orthoflow.workflow.expand import Cell, CellOutput, WorkflowInput
from orthoflow.workflow.inputs import MissingInputsError
from orthoflow.workflow.model import StepVariant, Workflow
from orthoflow.workflow.views import workflow_from_resolved

_ENVIRONMENT: tuple[str, ...] = ("python", "os", "cpu")


@dataclass(frozen=True, kw_only=True)
class Replay:
    """A replay that is ready to start.

    Attributes:
        workflow: workflow read from the record.
        plan: plan of the workflow's cells with the recorded parameters and seeds.
        notes: changes of code, libraries, Python or processor that may affect results.
        changed_methods: ids of methods whose code has changed but whose result version has not.
    """

    workflow: Workflow
    plan: RunPlan
    notes: tuple[str, ...]
    changed_methods: frozenset[str]


def plan_replay(
    run: Run,
    catalog: Catalog,
    store: Store,
    options: RunOptions,
    *,
    inputs: Sequence[str] = (),
    placed: PlacedInputs | None = None,
    earlier: Sequence[Store] = (),
) -> Replay:
    """Check that a run can be repeated, and plan its replay without running any cell.

    Args:
        run: the run.
        catalog: the installed plugins.
        store: store for the results of the replay.
        options: options of the replay.
        inputs: inputs as `NAME=PATH`, as for `--input`.
        placed: extracted and renamed input files, see `embedded_inputs`; None if all files have
            their recorded names.
        earlier: other stores, which may contain paths of the input files.

    Raises:
        RefusedRunError: the record was changed, a method has another result version or other
            parameters, or an input file was changed.
        MissingInputsError: input files are missing, and there is no other problem.
        MissingMethodsError: methods or product types are missing, and there is no other problem.
        InvalidArgumentsError: `inputs` contains a name that is not an input of the workflow.
        InputError: a given path does not exist.
    """
    findings = verify_run(run.path, also_published=False).findings
    if problems := findings or (*_inconsistencies(run), *_loose_ends(run)):
        raise RefusedRunError(
            f"{run.path} has been changed since it was written: {problem}" for problem in problems
        )
    try:
        workflow = workflow_from_resolved(run.record.workflow_resolved, run.record.workflow_source)
    except WorkflowError as error:
        raise RefusedRunError([f"{run.path}: {error}"]) from error
    unknown = [cell.address for cell in run.record.cells if _variant(cell, workflow) is None]
    if unknown:
        raise RefusedRunError(
            f"{run.path}: its workflow has no step {address}" for address in unknown
        )
    missing, others = _method_problems(run, catalog)
    digests = store.file_digests()
    search = find_inputs(
        workflow,
        run.record.inputs,
        run.folder,
        digests,
        given=inputs,
        extracted=placed.extracted if placed else None,
        noted=[one.file_digests() for one in earlier],
    )
    if others or search.is_changed:
        raise RefusedRunError((*others, *missing, *search.problems))
    if search.problems:
        raise MissingInputsError((*missing, *search.problems))
    if missing:
        raise MissingMethodsError(missing)
    if store.folder.is_dir():
        digests.save()
    paths = search.paths
    if placed:
        paths = {entry.name: placed.named(entry, paths[entry.name]) for entry in run.record.inputs}
    found = _with_files(workflow, paths)
    cells = [_cell(cell, workflow) for cell in run.record.cells]
    plan = plan_run(cells, found, catalog, store, options)
    changed, notes = _changes(run, plan)
    return Replay(
        workflow=workflow,
        plan=plan,
        notes=notes,
        changed_methods=changed,
    )


def _variant(cell: RecordedCell, workflow: Workflow) -> StepVariant | None:
    name = cell.assignment.get(cell.step, "")
    step = workflow.steps.get(cell.step)
    return next((item for item in step.variants if item.name == name), None) if step else None


def _with_files(workflow: Workflow, paths: Mapping[str, tuple[Path, ...]]) -> Workflow:
    """Set the files of the inputs; inputs without files were not given in the original run."""
    specs = {
        name: dataclasses.replace(
            spec,
            files=tuple(str(path) for path in paths.get(name, ())),
            optional=spec.optional or not paths.get(name),
        )
        for name, spec in workflow.input_specs.items()
    }
    return workflow.with_input_specs(specs)


def _inconsistencies(run: Run) -> Iterator[str]:
    files = {f"inputs.{entry.name}": input_digest(entry.files) for entry in run.record.inputs}
    for cell in run.record.cells:
        for port, product in cell.inputs.items():
            if files.get(product.source, product.digest) != product.digest:
                yield f"{cell.address}: {port} does not match the files of {product.source}"
        if not cell.key_preimage:
            continue
        preimage = read_preimage(cell.key_preimage)
        stated = {
            "method": cell.method,
            "result_version": cell.result_version,
            "params": dict(cell.params),
            "seed": cell.seed,
            "inputs": {
                port: f"{product.type_name}@{product.encoding_version}:{product.digest}"
                for port, product in cell.inputs.items()
            },
        }
        for name, value in stated.items():
            if preimage.get(name) != value:
                yield f"{cell.address}: {name} does not match the cache key"


def _loose_ends(run: Run) -> Iterator[str]:
    given = {"inputs": {entry.name for entry in run.record.inputs}}
    for cell in run.record.cells:
        for port, product in cell.inputs.items():
            owner, _, name = product.source.rpartition(".")
            # The missing output of an upstream cell may be the reason why this cell was skipped.
            is_lacking = cell.status == "skipped" and owner != "inputs" and owner in given
            if not is_lacking and name not in given.get(owner, ()):
                text = f"no earlier step outputs {product.source!r}, its input {port}"
                yield f"{cell.address}: {text}"
        given.setdefault(cell.address, set(cell.outputs))


def _method_problems(run: Run, catalog: Catalog) -> tuple[tuple[str, ...], tuple[str, ...]]:
    missing: list[str] = []
    others: list[str] = []
    for cell in run.record.cells:
        if cell.status == "skipped":
            continue
        origin = f"{cell.distribution} {cell.distribution_version}".strip()
        try:
            others += _differences(cell, catalog, origin)
        except (WorkflowError, PluginError) as error:
            install = f"; install {origin}" if origin else ""
            missing.append(f"method {cell.method} of {origin}: {error}{install}")
    return tuple(dict.fromkeys(missing)), tuple(dict.fromkeys(others))


def _differences(cell: RecordedCell, catalog: Catalog, origin: str) -> Iterator[str]:
    if cell.seed is not None and cell.seed < 0:
        yield f"step {cell.address}: the seed must not be negative, got {cell.seed}"
    cls = catalog.method(cell.method).load()
    for product in cell.outputs.values():
        found = catalog.product_class(product.type_name).encoding_version
        if found < product.encoding_version:
            yield (
                f"product type {product.type_name}: the installed version has encoding version "
                f"{found}, but the record has {product.encoding_version}"
            )
    if cls.result_version != cell.result_version:
        yield (
            f"method {cell.method}: the installed version has result version "
            f"{cls.result_version}, but the record was made with {cell.result_version} ({origin})"
        )
        return
    try:
        cls.Params.model_validate_json(json.dumps(dict(cell.params)), strict=True)
    except ValidationError as error:
        first = error.errors()[0]
        name = ".".join(str(part) for part in first["loc"])
        yield (
            f"step {cell.address}: the installed {cell.method} does not accept the recorded "
            f"parameter {name}: {first['msg']} (the record was made with {origin})"
        )


def _cell(recorded: RecordedCell, workflow: Workflow) -> Cell:
    variant = _variant(recorded, workflow)
    return Cell(
        address=recorded.address,
        step=recorded.step,
        method=recorded.method,
        assignment=recorded.assignment,
        repeat=recorded.repeat,
        params=recorded.params,
        params_set=recorded.params_set,
        inputs={port: _source(product.source) for port, product in recorded.inputs.items()},
        # A method without a seed is also passed a generator, so any number will do.
        seed=recorded.seed or 0,
        cores=variant.cores if variant else None,
        timeout_s=variant.timeout_s if variant else None,
        skip_reason=recorded.error_message if recorded.status == "skipped" else "",
        skip_type=recorded.error_type if recorded.status == "skipped" else "",
    )


def _source(text: str) -> CellOutput | WorkflowInput:
    owner, _, name = text.rpartition(".")
    if owner == "inputs":
        return WorkflowInput(name=name)
    return CellOutput(address=owner, port=name)


def _changes(run: Run, plan: RunPlan) -> tuple[frozenset[str], tuple[str, ...]]:
    here = environment(1)
    notes = [
        f"{name}: {getattr(here, name)} here, {getattr(recorded, name)} in the record"
        for recorded in run.record.environments
        for name in _ENVIRONMENT
        if getattr(recorded, name) != getattr(here, name)
    ]
    changed: set[str] = set()
    for cell in run.record.cells:
        facts = plan.methods.get(cell.method)
        if facts is None or not cell.key_preimage:
            continue
        preimage = read_preimage(cell.key_preimage)
        if stated_versions(preimage, "code") != dict(facts.code):
            changed.add(cell.method)
            notes.append(
                f"{cell.method}: its code differs from the record, although both have result "
                f"version {cell.result_version}"
            )
        recorded_tools = stated_versions(preimage, "tools")
        for tool in sorted(recorded_tools.keys() | facts.tools.keys()):
            ours, theirs = facts.tools.get(tool), recorded_tools.get(tool)
            if ours != theirs:
                notes.append(f"{cell.method}: {tool} {ours} here, {theirs} in the record")
    return frozenset(changed), tuple(dict.fromkeys(notes))


MetricVerdict = Literal[
    "same", "rounding", "products", "not in the record", "code changed", "different"
]
# With these verdicts, the replay counts as different.
DIFFERING: Final = frozenset({"code changed", "different"})


@dataclass(frozen=True, kw_only=True)
class ReplayedMetric:
    """A metric from a record, from a replay, or from both.

    Attributes:
        cell: address of the cell.
        metric: name of the metric.
        recorded: value in the record; None if there is none.
        recorded_unit: unit in the record.
        replayed: value in the replay; None if there is none.
        replayed_unit: unit in the replay.
        verdict: `same` (same bits); `rounding`; `products` if inputs or outputs of the step differ
            but are within tolerance or not measured; `not in the record`; `code changed` if the
            code of the step or of an upstream step has changed; otherwise `different`.
    """

    cell: str
    metric: str
    recorded: float | None
    recorded_unit: str
    replayed: float | None
    replayed_unit: str
    verdict: MetricVerdict


def replayed_metrics(
    original: Run,
    made: Run,
    distances: Sequence[ProductDistance],
    changed_methods: Collection[str] = (),
) -> tuple[ReplayedMetric, ...]:
    """Compare the metrics of a record and its replay, without times and memory.

    Args:
        original: the run that was replayed.
        made: the replay.
        distances: comparison of the products of both runs.
        changed_methods: ids of methods whose code has changed.
    """
    identical = {f"{item.cell}.{item.port}" for item in distances if item.verdict == "identical"}
    is_changed = {
        address: any(cell.method in changed_methods for cell in original.upstream(address))
        for address in original.cells
    }

    def verdict(pair: Pair[ComparedMetric]) -> MetricVerdict:
        if pair.is_same:
            return "same"
        if pair.left is None:
            return "not in the record"
        if pair.left.is_near(pair.right):
            return "rounding"
        if is_changed[pair.cell]:
            return "code changed"
        return "different" if _is_of_identical(original.cells[pair.cell], identical) else "products"

    return tuple(
        ReplayedMetric(
            cell=pair.cell,
            metric=pair.name,
            recorded=pair.left.value if pair.left else None,
            recorded_unit=pair.left.unit if pair.left else "",
            replayed=pair.right.value if pair.right else None,
            replayed_unit=pair.right.unit if pair.right else "",
            verdict=verdict(pair),
        )
        for pair in compare_metrics(original, made)
    )


def _is_of_identical(cell: RecordedCell, identical: set[str]) -> bool:
    taken = {given.source for given in cell.inputs.values()}
    given = {f"{cell.address}.{port}" for port in cell.outputs}
    return all(one in identical or one.startswith("inputs.") for one in taken | given)
