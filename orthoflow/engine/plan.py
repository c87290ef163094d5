"""The immutable plan of a run: which cells have stored results, which will run, and why."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Final, Literal

from orthoflow.catalog.catalog import Catalog
from orthoflow.engine.file_digests import FileRef
from orthoflow.engine.keys import (
    CellKey,
    MethodFacts,
    cell_key,
    input_digest,
    method_facts,
    read_preimage,
)
from orthoflow.engine.results import CellResult, ProductRef, ProductTarget
from orthoflow.engine.store import Store
from orthoflow.errors import ArgumentError, InputError, StoreError
from orthoflow.products.input_files import InputFiles
from orthoflow.untrusted_text import first_few
from orthoflow.workflow.expand import (
    Cell,
    CellOutput,
    Selection,
    WorkflowInput,
    check_step_names,
    select_cells,
)
from orthoflow.workflow.inputs import resolve_input_files
from orthoflow.workflow.model import Workflow

ExecutorName = Literal["local", "inline", "dask"]
CellPlan = Literal["cached", "will run", "unknown yet", "skipped"]
_MOST_NAMED: Final = 4
_LONGEST_VALUE: Final = 40
_ABSENT: Final = "absent"
_FORCED: Final = "forced"
# These files contain camera parameters or image positions, which may be the same for several
# images.
_SIDECARS: Final = frozenset({".aae", ".jgw", ".pgw", ".prj", ".tfw", ".wld", ".xmp"})
# Estimated time to start a process, read its inputs and store its outputs.
_START_S: Final = 1.0


@dataclass(frozen=True, kw_only=True)
class RunOptions(Selection):
    """Options for planning and executing a run.

    Attributes:
        jobs: number of concurrent cells, which share the cores.
        executor: `local` (each cell in a child process), `inline` (all cells in this process, for
            debugging) or `dask` (each cell in a child process of a cluster's worker).
        scheduler: address of the Dask scheduler; if empty, `jobs` local workers are created.
        retries: how many times a cell is repeated, at most, if its Dask worker is lost.
        force: steps to run even if their results are in the store.
    """

    jobs: int = 1
    executor: ExecutorName = "local"
    scheduler: str = ""
    retries: int = 2
    force: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.jobs < 1:
            raise ArgumentError(f"--jobs must be 1 or more, got {self.jobs}")
        if self.executor not in ("local", "inline", "dask"):
            raise ArgumentError(f"--executor must be local, inline or dask, got {self.executor}")
        if self.scheduler and self.executor != "dask":
            raise ArgumentError("--scheduler requires --executor dask")
        if self.retries < 0:
            raise ArgumentError(f"--retries must be 0 or more, got {self.retries}")


@dataclass(frozen=True, kw_only=True)
class PlannedCell:
    """A cell, and what the run will do with it.

    Attributes:
        cell: the cell.
        status: `cached`, `will run`, `skipped`, or `unknown yet` if the inputs are not yet known.
        reason: why the cell has this status, such as the changes since the most similar earlier
            result.
        key: cache key; None if its inputs are not known.
        inputs: port -> product, as far as known.
        result: stored result of a cached cell.
        took_s: expected duration in seconds, taken from the earlier call with the most similar
            parameters; 0 if the cell will not run, None if unknown.
    """

    cell: Cell
    status: CellPlan
    reason: str
    key: CellKey | None = None
    inputs: Mapping[str, ProductRef] | None = None
    result: CellResult | None = None
    took_s: float | None = None


@dataclass(frozen=True, kw_only=True)
class PlannedInput:
    """A workflow input, with the digests of its files.

    Attributes:
        ref: reference to the input as a product of type `files`, with its digest.
        files: files of the input, in order.
    """

    ref: ProductRef
    files: tuple[FileRef, ...]

    @property
    def paths(self) -> tuple[Path, ...]:
        """Return the paths of the files."""
        return tuple(file.path for file in self.files)


@dataclass(frozen=True, kw_only=True)
class RunPlan:
    """Everything that is decided before a run starts.

    Attributes:
        name: name of the workflow.
        cells: selected cells in topological order.
        inputs: workflow input -> files; None for an optional input that is not given.
        methods: method id -> properties.
        products: type name -> import strings.
        options: options of the run.
    """

    name: str
    cells: tuple[PlannedCell, ...]
    inputs: Mapping[str, PlannedInput | None]
    methods: Mapping[str, MethodFacts]
    products: Mapping[str, ProductTarget]
    options: RunOptions


def plan_run(
    cells: Sequence[Cell],
    workflow: Workflow,
    catalog: Catalog,
    store: Store,
    options: RunOptions | None = None,
) -> RunPlan:
    """Plan a run: hash the inputs, compute cache keys, and look up results; no cell runs.

    Raises:
        ArgumentError: an option refers to a step that does not exist.
        InputError: an input file is missing or cannot be read.
        PluginError: a method or product type cannot be loaded.
    """
    options = options or RunOptions()
    check_step_names(workflow, options.force, "--force")
    selected = select_cells(workflow, tuple(cells), options)
    methods = {
        method: method_facts(method, catalog)
        for method in dict.fromkeys(cell.method for cell in selected if not cell.skip_reason)
    }
    inputs = _digest_inputs(resolve_input_files(workflow), store)
    _require_distinct(selected, inputs, methods)
    planner = _Planner(inputs=inputs, methods=methods, store=store, force=options.force)
    for cell in selected:
        planner.add(cell)
    return RunPlan(
        name=workflow.name,
        cells=tuple(planner.planned.values()),
        inputs=inputs,
        methods=methods,
        products=_product_targets(methods, catalog),
        options=options,
    )


def _require_distinct(
    cells: Sequence[Cell],
    inputs: Mapping[str, PlannedInput | None],
    methods: Mapping[str, MethodFacts],
) -> None:
    for cell in cells:
        for port, source in cell.inputs.items():
            given = inputs[source.name] if isinstance(source, WorkflowInput) else None
            if cell.skip_reason or given is None or port in methods[cell.method].repeatable:
                continue
            seen: dict[str, Path] = {}
            for file in given.files:
                if file.path.suffix.lower() in _SIDECARS:
                    continue
                first = seen.setdefault(file.sha256, file.path)
                if first != file.path:
                    raise InputError(
                        f"{first} and {file.path}, which step {cell.step} reads on port {port}, "
                        "have the same content, which would be counted twice; remove one file"
                    )


def known_inputs(
    cell: Cell,
    inputs: Mapping[str, PlannedInput | None],
    results: Mapping[str, CellResult],
) -> dict[str, ProductRef]:
    """Return port -> product for a cell whose upstream results are known."""
    known: dict[str, ProductRef] = {}
    for port, source in cell.inputs.items():
        if isinstance(source, CellOutput):
            known[port] = results[source.address].outputs[source.port]
        else:
            given = inputs[source.name]
            if given is None:
                raise InputError(
                    f"step {cell.step} needs the input {source.name}, which was not given; pass "
                    f"--input {source.name}=PATH"
                )
            known[port] = given.ref
    return known


@dataclass(kw_only=True)
class _Planner:
    inputs: Mapping[str, PlannedInput | None]
    methods: Mapping[str, MethodFacts]
    store: Store
    force: tuple[str, ...]
    planned: dict[str, PlannedCell] = field(default_factory=dict)
    _earlier: dict[str, tuple[CellResult, ...]] = field(default_factory=dict)

    def add(self, cell: Cell) -> None:
        planned = self._without_inputs(cell) or self._with_inputs(cell)
        is_run = planned.status in ("will run", "unknown yet")
        took_s = self._took_s(cell) if is_run else 0.0
        if planned.status == "unknown yet" and cell.step in self.force:
            planned = replace(planned, status="will run", reason=_FORCED)
        elif planned.status == "unknown yet" and took_s is None:
            # If the store contains no results of a method, the cell will run, whatever its inputs
            # are.
            reason = "no result of this method is stored"
            planned = replace(planned, status="will run", reason=reason)
        self.planned[cell.address] = replace(planned, took_s=took_s)

    def _without_inputs(self, cell: Cell) -> PlannedCell | None:
        if cell.skip_reason:
            return PlannedCell(cell=cell, status="skipped", reason=cell.skip_reason)
        for earlier in (self.planned[address] for address in cell.sources):
            if earlier.status != "cached":
                what = "will run" if earlier.status == "will run" else "is not known yet"
                reason = f"needs {earlier.cell.address}, which {what}"
                return PlannedCell(cell=cell, status="unknown yet", reason=reason)
        return None

    def _with_inputs(self, cell: Cell) -> PlannedCell:
        before = (self.planned[address] for address in cell.sources)
        results = {item.cell.address: item.result for item in before if item.result is not None}
        refs = known_inputs(cell, self.inputs, results)
        key = cell_key(cell, self.methods[cell.method], refs)
        is_forced = cell.step in self.force
        result = None if is_forced else self.store.result(key.key)
        if result is None:
            reason = _FORCED if is_forced else explain(key, self._before(cell.method))
            return PlannedCell(cell=cell, status="will run", reason=reason, key=key, inputs=refs)
        reason = f"in the store since {result.ended}"
        return PlannedCell(
            cell=cell, status="cached", reason=reason, key=key, inputs=refs, result=result
        )

    def _took_s(self, cell: Cell) -> float | None:
        params = {
            f"params.{name}": json.dumps(value, ensure_ascii=False, sort_keys=True)
            for name, value in cell.params.items()
        }

        def n_changed(earlier: CellResult) -> int:
            before = _ingredients(earlier.key_preimage)
            return sum(before.get(name) != value for name, value in params.items())

        # If several calls are equally similar, the most recent one is used.
        nearest = min(self._before(cell.method), key=n_changed, default=None)
        return None if nearest is None else nearest.wall_s + _START_S

    def _before(self, method: str) -> tuple[CellResult, ...]:
        if method not in self._earlier:
            self._earlier[method] = self.store.earlier_results(method)
        return self._earlier[method]


def remember_places(inputs: Mapping[str, PlannedInput | None], store: Store) -> None:
    """Record the paths of input files in the store, where replays and exports look them up."""
    digests = store.file_digests()
    for given in inputs.values():
        for file in given.files if given else ():
            digests.note_place(file.sha256, file.path)
    with contextlib.suppress(StoreError):
        digests.save()


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
        ref = ProductRef(type_name="files", encoding_version=0, digest=input_digest(refs))
        planned[name] = PlannedInput(ref=ref, files=refs)
    if store.folder.is_dir():
        # Planning must also work on a full or read-only disk, and the digests are only a cache.
        with contextlib.suppress(StoreError):
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
        spec = catalog.products[type_name].spec
        targets[type_name] = ProductTarget(
            type_name=type_name, target=spec.target, publisher=spec.publisher
        )
    return targets


def explain(key: CellKey, earlier: Sequence[CellResult]) -> str:
    """Return the changes since the most similar earlier result of the same method.

    Args:
        key: key of the cell.
        earlier: results of the method, most recently used first.
    """
    if not earlier:
        return "has never been run"
    if any(result.key == key.key for result in earlier):
        return "its stored result is incomplete or damaged"
    now = _ingredients(key.preimage)
    before = min(
        (_ingredients(result.key_preimage) for result in earlier),
        key=lambda ingredients: len(_changed(ingredients, now)),
    )
    changes = _changed(before, now)
    if not changes:
        return "the way its cache key is computed has changed"
    named = list(dict.fromkeys(_sentence(name, before, now) for name in changes))
    return first_few(named, most=_MOST_NAMED)


@lru_cache(maxsize=1024)
def _ingredients(text: str) -> Mapping[str, str]:
    """Flatten a preimage by one level to keys such as `params.cell_m`, with values as JSON."""
    flat: dict[str, str] = {}
    for name, value in read_preimage(text).items():
        prefix, items = (f"{name}.", value) if isinstance(value, dict) else ("", {name: value})
        for key, item in items.items():
            flat[prefix + key] = json.dumps(item, ensure_ascii=False, sort_keys=True)
    return flat


def _changed(before: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    names = dict.fromkeys([*now, *before])
    return [name for name in names if before.get(name) != now.get(name)]


def _sentence(name: str, before: Mapping[str, str], now: Mapping[str, str]) -> str:
    group, _, inner = name.partition(".")
    if group == "inputs":
        if name not in before:
            return f"input {inner} added"
        return f"input {inner} changed" if name in now else f"input {inner} removed"
    if group == "code":
        return "code changed"
    change = f"{_shown(before, name)} -> {_shown(now, name)}"
    if group == "params":
        return f"{name}: {change}"
    return f"{inner if group == 'tools' else name} {change}"


def _shown(ingredients: Mapping[str, str], name: str) -> str:
    text = ingredients.get(name, _ABSENT)
    return text if len(text) <= _LONGEST_VALUE else text[: _LONGEST_VALUE - 3] + "..."
