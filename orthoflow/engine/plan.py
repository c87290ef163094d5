"""The frozen plan of a run: what is in the store, what will run, and why."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from orthoflow import __version__
from orthoflow.catalog import Catalog
from orthoflow.engine.changes import explain
from orthoflow.engine.file_digests import FileRef
from orthoflow.engine.keys import CellKey, MethodFacts, cell_key, files_digest, method_facts
from orthoflow.engine.options import RunOptions
from orthoflow.engine.results import CellResult, ProductRef
from orthoflow.engine.sources import framework_digest, is_framework_released
from orthoflow.engine.store import Store
from orthoflow.errors import InputError, PluginError
from orthoflow.products.input_files import InputFiles
from orthoflow.workflow import Workflow, check_step_names, resolve_input_files
from orthoflow.workflow.cells import Cell, CellOutput
from orthoflow.workflow.selection import Selection, select_cells

CellPlan = Literal["cached", "will run", "unknown yet", "skipped"]


@dataclass(frozen=True, kw_only=True)
class PlannedCell:
    """A cell and what will happen to it.

    Attributes:
        cell: the cell.
        status: `cached`, `will run`, `unknown yet` (its inputs are not known yet) or `skipped`.
        reason: why; names the ingredient that changed since the nearest earlier result.
        key: its key where its inputs are known, else None.
        inputs: port -> product where they are known.
        result: what the store has, for cached cells.
    """

    cell: Cell
    status: CellPlan
    reason: str
    key: CellKey | None = None
    inputs: Mapping[str, ProductRef] | None = None
    result: CellResult | None = None


@dataclass(frozen=True, kw_only=True)
class PlannedInput:
    """A workflow input by content.

    Attributes:
        ref: its digest, as a product of type `files`.
        paths: the files.
        files: name, size and digest of each, in the same order.
    """

    ref: ProductRef
    paths: tuple[Path, ...]
    files: tuple[FileRef, ...]


@dataclass(frozen=True, kw_only=True)
class ProductTarget:
    """Import strings of a product type: its class, and its publisher or nothing."""

    target: str
    publisher: str


@dataclass(frozen=True, kw_only=True)
class RunPlan:
    """Everything a run needs to know, decided before it starts.

    Attributes:
        name: name of the workflow.
        cells: in topological order; cells that were not selected are left out.
        inputs: workflow input -> files; None when it is optional and absent.
        methods: method id -> facts.
        products: type name -> import strings.
        publisher_tag: version of what writes published files.
        options: as given.
    """

    name: str
    cells: tuple[PlannedCell, ...]
    inputs: Mapping[str, PlannedInput | None]
    methods: Mapping[str, MethodFacts]
    products: Mapping[str, ProductTarget]
    publisher_tag: str
    options: RunOptions


def plan_run(
    cells: Sequence[Cell],
    workflow: Workflow,
    catalog: Catalog,
    store: Store,
    options: RunOptions | None = None,
) -> RunPlan:
    """Plan a run: digest the inputs, make the keys, look into the store. Nothing is computed.

    Raises:
        ArgumentError: an option names a step that does not exist.
        InputError: an input file is missing or cannot be read.
        PluginError: a method or product type cannot be loaded.
    """
    options = options or RunOptions()
    check_step_names(workflow, options.force, "--force")
    selection = Selection(only=options.only, from_=options.from_, until=options.until)
    selected = select_cells(workflow, tuple(cells), selection)
    methods = {
        method: method_facts(method, catalog)
        for method in dict.fromkeys(cell.method for cell in selected if not cell.skip_reason)
    }
    inputs = _digest_inputs(resolve_input_files(workflow), store)
    planned: dict[str, PlannedCell] = {}
    for cell in selected:
        planned[cell.address] = _plan_cell(cell, planned, inputs, methods, store, options)
    return RunPlan(
        name=workflow.name,
        cells=tuple(planned.values()),
        inputs=inputs,
        methods=methods,
        products=_product_targets(methods, catalog),
        publisher_tag=__version__ if is_framework_released() else framework_digest(),
        options=options,
    )


def needed_addresses(cell: Cell) -> tuple[str, ...]:
    """Addresses of the cells whose outputs a cell takes, each once."""
    sources = (source for source in cell.inputs.values() if isinstance(source, CellOutput))
    return tuple(dict.fromkeys(source.address for source in sources))


def known_inputs(
    cell: Cell,
    inputs: Mapping[str, PlannedInput | None],
    results: Mapping[str, CellResult],
) -> dict[str, ProductRef]:
    """Products on a cell's input ports once the cells before it have results."""
    known: dict[str, ProductRef] = {}
    for port, source in cell.inputs.items():
        if isinstance(source, CellOutput):
            known[port] = results[source.address].outputs[source.port]
        else:
            given = inputs[source.name]
            if given is None:
                raise InputError(
                    f"step {cell.step} needs the input {source.name}, which was not given; "
                    f"give it with --input {source.name}=PATH"
                )
            known[port] = given.ref
    return known


def _plan_cell(
    cell: Cell,
    planned: Mapping[str, PlannedCell],
    inputs: Mapping[str, PlannedInput | None],
    methods: Mapping[str, MethodFacts],
    store: Store,
    options: RunOptions,
) -> PlannedCell:
    if cell.skip_reason:
        return PlannedCell(cell=cell, status="skipped", reason=cell.skip_reason)
    before = [planned[address] for address in needed_addresses(cell)]
    for earlier in before:
        if earlier.status == "skipped":
            reason = f"needs {earlier.cell.address}, which is skipped"
            return PlannedCell(cell=cell, status="skipped", reason=reason)
    for earlier in before:
        if earlier.status != "cached":
            what = "will run" if earlier.status == "will run" else "is not known yet"
            reason = f"needs {earlier.cell.address}, which {what}"
            return PlannedCell(cell=cell, status="unknown yet", reason=reason)
    results = {item.cell.address: item.result for item in before if item.result is not None}
    refs = known_inputs(cell, inputs, results)
    key = cell_key(cell, methods[cell.method], refs)
    if cell.step in options.force:
        return PlannedCell(cell=cell, status="will run", reason="forced", key=key, inputs=refs)
    result = store.result(key.key)
    if result is None:
        reason = explain(key, cell.step, store.earlier_preimages(cell.method))
        return PlannedCell(cell=cell, status="will run", reason=reason, key=key, inputs=refs)
    return PlannedCell(
        cell=cell,
        status="cached",
        reason=f"in the store since {result.ended}",
        key=key,
        inputs=refs,
        result=result,
    )


def _digest_inputs(
    given: Mapping[str, InputFiles | None], store: Store
) -> dict[str, PlannedInput | None]:
    digests = store.file_digests()
    planned: dict[str, PlannedInput | None] = {}
    for name, files in given.items():
        if files is None:
            planned[name] = None
            continue
        refs = digests.digest_all(files.paths)
        ref = ProductRef(type_name="files", encoding_version=0, digest=files_digest(refs))
        planned[name] = PlannedInput(ref=ref, paths=files.paths, files=refs)
    if store.folder.is_dir():
        digests.save()
    return planned


def _product_targets(
    methods: Mapping[str, MethodFacts], catalog: Catalog
) -> dict[str, ProductTarget]:
    used = {
        type_name
        for facts in methods.values()
        for type_name in (*facts.inputs.values(), *facts.outputs.values())
    }
    targets: dict[str, ProductTarget] = {}
    for type_name in sorted(used - {"files"}):
        entry = catalog.products.get(type_name)
        if entry is None or entry.state != "fine":
            raise PluginError(
                entry.problem if entry else f"no installed plugin brings the product {type_name}"
            )
        targets[type_name] = ProductTarget(target=entry.spec.target, publisher=entry.spec.publisher)
    return targets
