"""Expands a workflow into cells, which are the method calls for its steps and variants.

All cells are created first; `--only`, `--from` and `--until` then select some of them.
"""

from __future__ import annotations

import hashlib
import itertools
import json
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from typing import Final, TypeAlias

from orthoflow.catalog.catalog import Catalog
from orthoflow.errors import ArgumentError, WorkflowError, did_you_mean
from orthoflow.products.product import JsonValue
from orthoflow.sdk.methods import Method, PortSpec, port_specs
from orthoflow.workflow.inputs import present_inputs
from orthoflow.workflow.model import (
    DATA,
    SEED,
    Dataset,
    Reference,
    StepVariant,
    Workflow,
    WorkflowStep,
)
from orthoflow.workflow.parameters import SWEEP

# Factor (dataset, seed or step with variants) -> level.
Assignment: TypeAlias = dict[str, str]
#: cells of a workflow, including excluded combinations
MOST_CELLS: Final = 20_000
# Product type of methods that inspect the quality of results.
_JUDGEMENT: Final = "inspection"
# This is the `error_type` of a cell that is skipped because of optional data and not because of a
# failure.
NOT_ASKED_FOR: Final = "not-asked-for"
_SEED_BITS: Final = 53  # exact in all JSON readers, including those that only use doubles


@dataclass(frozen=True, kw_only=True)
class CellOutput:
    """An output of another cell."""

    address: str
    port: str

    def __str__(self) -> str:
        return f"{self.address}.{self.port}"


@dataclass(frozen=True, kw_only=True)
class WorkflowInput:
    """An input of the workflow; the name is `scan`, or `scan@hall` for the dataset `hall`."""

    name: str

    def __str__(self) -> str:
        return f"inputs.{self.name}"


@dataclass(frozen=True, kw_only=True)
class Cell:
    """One method call of a run.

    Attributes:
        address: `step`, or `step@step=variant,...` with the variants of this step and its upstream
            steps in graph order. If the cell depends on the dataset or seed, the variants are
            preceded by `data=name` and `seed=n`. Repeats 1, 2, ... end with `#n`.
        step: name of the step.
        assignment: step -> variant for each step with variants that affects this cell, including
            its own step; preceded by `data` -> dataset and `seed` -> seed if they affect it.
        repeat: number of the repeat, which is 0 for the first execution. Steps that the workflow
            compares, and the steps between these and a repeated step, use the same repeat of their
            inputs; all other steps use the first execution.
        method: method id.
        params: resolved parameters with defaults, as JSON.
        params_set: parameters set in the file or on the command line, as JSON.
        inputs: port -> source, without ports that the method ignores and optional ports without a
            source.
        seed: seed derived from the seed of the workflow or assignment, the method id and the
            repeat.
        cores: requested number of cores; None for all.
        timeout_s: time limit in seconds; None if there is none.
        skip_reason: reason why the cell will not run, such as missing optional data; empty if it
            will run.
        skip_type: `error_type` of the result if the cell will not run, otherwise empty.
        variant: name of the variant in the workflow file; for a swept variant, the name without the
            values. Empty if the step has no variants there.
    """

    address: str
    step: str
    method: str
    assignment: Mapping[str, str] = field(default_factory=dict)
    repeat: int = 0
    params: Mapping[str, JsonValue] = field(default_factory=dict)
    params_set: Mapping[str, JsonValue] = field(default_factory=dict)
    inputs: Mapping[str, CellOutput | WorkflowInput] = field(default_factory=dict)
    seed: int = 0
    cores: int | None = None
    timeout_s: float | None = None
    skip_reason: str = ""
    skip_type: str = ""
    variant: str = ""

    @property
    def setting(self) -> str:
        """Prefix for the parameters of this cell in `--set`, which is `step` or `step.variant`."""
        return f"{self.step}.{self.variant}" if self.variant else self.step

    @property
    def sources(self) -> tuple[str, ...]:
        """Addresses of the cells whose products this cell uses, without duplicates."""
        sources = (one for one in self.inputs.values() if isinstance(one, CellOutput))
        return tuple(dict.fromkeys(source.address for source in sources))


def is_plain(cells: Iterable[Cell]) -> bool:
    """Whether each step has only one cell."""
    return all(cell.address == cell.step for cell in cells)


def variants_text(assignment: Mapping[str, str]) -> str:
    """Format an assignment as text such as `plane=ransac, orient=pnp`."""
    return ", ".join(f"{step}={variant}" for step, variant in assignment.items())


def swept_indices(workflow: Workflow) -> list[tuple[str, str]]:
    """Return the variants whose name contains an index, each with its swept values as text."""
    return [
        (
            f"{step.name}={variant.name}",
            ", ".join(f"{name} {json.dumps(value)}" for name, value in variant.swept.items()),
        )
        for step in workflow.steps.values()
        for variant in step.variants
        if variant.swept and SWEEP in variant.name.split("-")
    ]


def derive_seed(workflow_seed: int, method_id: str, repeat: int) -> int:
    """Derive the seed of a cell; it is the same for a method in every step."""
    preimage = json.dumps(["orthoflow/seed", 1, workflow_seed, method_id, repeat])
    digest = hashlib.sha256(preimage.encode()).digest()
    return int.from_bytes(digest[:8], "big") >> (64 - _SEED_BITS)


def _reached(edges: Mapping[str, Collection[str]], starts: Iterable[str]) -> set[str]:
    reached: set[str] = set()
    waiting = [name for start in starts for name in edges[start]]
    while waiting:
        name = waiting.pop()
        if name not in reached:
            reached.add(name)
            waiting.extend(edges[name])
    return reached


def topological_steps(steps: Mapping[str, WorkflowStep]) -> tuple[str, ...]:
    """Sort steps so that each follows its upstream steps; keep the order of the file otherwise."""
    waiting = list(steps)
    ordered: dict[str, None] = {}
    while waiting:
        name = next(name for name in waiting if ordered.keys() >= {*steps[name].upstream()})
        waiting.remove(name)
        ordered[name] = None
    return tuple(ordered)


@dataclass(frozen=True, kw_only=True)
class Selection:
    """Names of selected steps; a step is selected if it matches all given options.

    Attributes:
        only: select these steps.
        from_: select these steps and all steps downstream.
        until: select these steps and all steps upstream.

    Steps on which selected steps depend are always included.
    """

    only: tuple[str, ...] = ()
    from_: tuple[str, ...] = ()
    until: tuple[str, ...] = ()

    @property
    def by_option(self) -> Mapping[str, tuple[str, ...]]:
        """Command-line option -> names of steps."""
        return {"--only": self.only, "--from": self.from_, "--until": self.until}

    @property
    def words(self) -> tuple[str, ...]:
        """The options as text, one for each step; empty if all steps are selected."""
        named = self.by_option.items()
        return tuple(f"{option} {name}" for option, names in named for name in names)


def check_step_names(workflow: Workflow, names: Iterable[str], option: str) -> None:
    """Raise an error if the workflow lacks a step that an option such as `--force` names.

    Raises:
        ArgumentError: the workflow lacks a step.
    """
    for name in names:
        if name not in workflow.steps:
            raise ArgumentError(
                f"{option} {name}: workflow {workflow.name} has no step {name}"
                f"{did_you_mean(name, workflow.steps)}; steps: {', '.join(workflow.steps)}"
            )


def select_cells(
    workflow: Workflow, cells: tuple[Cell, ...], selection: Selection
) -> tuple[Cell, ...]:
    """Return the cells of the selected steps and the cells on which they depend.

    Raises:
        ArgumentError: the workflow lacks a named step, or no step matches all options.
    """
    for option, names in selection.by_option.items():
        check_step_names(workflow, names, option)
    graph = {name: step.upstream() for name, step in workflow.steps.items()}
    before = {name: {name, *_reached(graph, [name])} for name in graph}
    chosen = set(workflow.steps)
    if selection.from_:
        chosen = {name for name in chosen if not before[name].isdisjoint(selection.from_)}
    if selection.until:
        chosen &= {step for name in selection.until for step in before[name]}
    if selection.only:
        chosen &= set(selection.only)
    if not chosen:
        raise ArgumentError(
            f"no step of workflow {workflow.name} matches all of {' '.join(selection.words)}"
        )
    sources = {cell.address: cell.sources for cell in cells}
    wanted = [cell.address for cell in cells if cell.step in chosen]
    kept = {*wanted, *_reached(sources, wanted)}
    return tuple(cell for cell in cells if cell.address in kept)


def combinations(workflow: Workflow, steps: Sequence[str]) -> Iterator[Assignment]:
    """Yield the combinations of variants that affect a step; the last factor varies fastest.

    Args:
        workflow: the workflow.
        steps: the step itself and its upstream steps, in graph order.
    """
    varied = {
        name: tuple(variant.name for variant in workflow.steps[name].variants)
        for name in steps
        if workflow.steps[name].is_varied
    }
    baseline = {name: workflow.baseline[name] for name in varied}
    if workflow.compare is None:
        yield baseline
    elif workflow.compare.design == "product":
        for names in itertools.product(*varied.values()):
            yield dict(zip(varied, names, strict=True))
    else:
        yield dict(baseline)
        for step, variants in varied.items():
            for name in variants:
                if name != baseline[step]:
                    yield {**baseline, step: name}


def _require_few(workflow: Workflow, count: int) -> None:
    if count < MOST_CELLS:
        return
    raise WorkflowError(
        f"the comparison of {workflow.name} has {MOST_CELLS} step runs or more, which is too "
        "many; set design: one-at-a-time, or reduce the number of datasets, seeds, variants or "
        "repeats"
    )


def _is_excluded(workflow: Workflow, assignment: Mapping[str, str]) -> bool:
    excluded = workflow.compare.exclude if workflow.compare else ()
    return any(combination.items() <= assignment.items() for combination in excluded)


def expand_cells(workflow: Workflow, catalog: Catalog) -> tuple[Cell, ...]:
    """Expand a workflow into cells in topological order.

    The function also checks which optional input files exist, because this determines which cells
    can run.

    Raises:
        InputError: an optional input was given on the command line, but its files are missing.
        PluginError: a method cannot be loaded.
    """
    expansion = _Expansion(
        workflow=workflow,
        present=present_inputs(workflow),
        methods={
            variant.method: catalog.method(variant.method).load()
            for step in workflow.steps.values()
            for variant in step.variants
        },
        rank={name: index for index, name in enumerate(topological_steps(workflow.steps))},
    )
    return expansion.expand()


@dataclass(frozen=True, kw_only=True)
class _Node:
    """A cell, with the factors on which it depends.

    Attributes:
        cell: the cell.
        dependence: factors on which the products of the cell depend, with their levels. For a
            skipped cell, these are the factors that determine whether it is skipped, which may be
            fewer than those in its address.
        causes: changes of inputs after which the cell would not be skipped, such as `with the input
            scan`.
    """

    cell: Cell
    dependence: Assignment
    causes: tuple[str, ...] = ()


# Three values: the source of a port (the first available candidate, or None); the factors on which
# this choice depends; and the changes of inputs that would make a source available.
_Choice: TypeAlias = tuple[CellOutput | WorkflowInput | None, Assignment, tuple[str, ...]]


class _ExcludedError(Exception):
    """The workflow excludes a combination from the comparison."""


@dataclass(frozen=True, kw_only=True)
class _Expansion:
    workflow: Workflow
    present: frozenset[str]
    methods: Mapping[str, type[Method]]
    rank: Mapping[str, int]
    nodes: dict[str, dict[frozenset[tuple[str, str]], _Node]] = field(default_factory=dict)

    def expand(self) -> tuple[Cell, ...]:
        """Return all cells in topological order; repeats follow their cell."""
        workflow = self.workflow
        graph = {name: step.upstream() for name, step in workflow.steps.items()}
        compared = _compared_steps(workflow, self.methods)
        repeated = compared | _reached(graph, compared)
        cells: dict[str, Cell] = {}
        for name in self.rank:
            step = workflow.steps[name]
            steps = sorted({name, *_reached(graph, [name])}, key=self.rank.__getitem__)
            made: dict[frozenset[tuple[str, str]], _Node] = {}
            self.nodes[name] = made
            for fixed in self._outer(steps):
                for n_before, varied in enumerate(combinations(workflow, steps)):
                    _require_few(workflow, max(n_before, len(cells)))
                    assignment = {**fixed, **varied}
                    try:
                        node = self._node(step, assignment)
                    except _ExcludedError:
                        continue
                    made[frozenset(assignment.items())] = node
                    if node.cell.address not in cells:
                        cells[node.cell.address] = node.cell
                        for cell in self._repeats(node.cell, cells, is_reached=name in repeated):
                            cells[cell.address] = cell
        _require_few(workflow, len(cells))
        # A cell that only skipped inspections use needs no repeats.
        judged = [cell.address for cell in cells.values() if cell.step in compared and cell.repeat]
        needed = {*judged, *_reached({name: cell.sources for name, cell in cells.items()}, judged)}
        return tuple(
            cell
            for cell in cells.values()
            if cell.repeat < self._own_repeats(cell) or cell.address in needed
        )

    def _own_repeats(self, cell: Cell) -> int:
        step = self.workflow.steps[cell.step]
        return step.variant(cell.assignment.get(step.name, "")).repeat

    def _outer(self, steps: Iterable[str]) -> list[Assignment]:
        workflow = self.workflow
        variants = [variant for name in steps for variant in workflow.steps[name].variants]
        is_random = workflow.has_seeds and any(map(self._uses_seed, variants))
        by_data = any(map(self._takes_data, steps)) or (is_random and workflow.has_data_seeds)
        chosen: tuple[Dataset | None, ...] = workflow.chosen_data if by_data else (None,)
        return [
            {**({DATA: dataset.name} if dataset else {}), **by_seed}
            for dataset in chosen
            for by_seed in (
                [{SEED: str(seed)} for seed in workflow.seeds_of(dataset)] if is_random else [{}]
            )
        ]

    def _uses_seed(self, variant: StepVariant) -> bool:
        return self.methods[variant.method].determinism != "exact"

    def _ports(self, variant: StepVariant) -> Mapping[str, PortSpec]:
        return port_specs(self.methods[variant.method].In)

    def _takes_data(self, name: str) -> bool:
        step = self.workflow.steps[name]
        names = step.conditions | {one.name for one in step.references if one.is_input}
        calls = ((name, variant.name) for variant in step.variants)
        return not (
            names.isdisjoint(self.workflow.data_inputs)
            and self.workflow.data_calls.isdisjoint(calls)
        )

    def _repeats(
        self, cell: Cell, before: Mapping[str, Cell], *, is_reached: bool
    ) -> Iterator[Cell]:
        """Yield the repeats 1, 2, ... of a cell.

        A cell is repeated if the file requests it, or if an upstream cell is repeated.

        Repeat n uses repeat n of each upstream cell, or the first execution if there is no such
        repeat.
        """
        if cell.skip_reason:
            return
        own = self._own_repeats(cell)
        for repeat in range(1, MOST_CELLS):
            inputs = {
                port: replace(source, address=again)
                if is_reached
                and isinstance(source, CellOutput)
                and self._differs(again := f"{source.address}#{repeat}", before)
                else source
                for port, source in cell.inputs.items()
            }
            if repeat >= own and inputs == cell.inputs:
                return
            seed = cell.seed
            if repeat < own:
                root = int(cell.assignment.get(SEED, self.workflow.seed))
                seed = derive_seed(root, cell.method, repeat)
            address = f"{cell.address}#{repeat}"
            yield replace(cell, address=address, repeat=repeat, inputs=inputs, seed=seed)

    def _differs(self, address: str, before: Mapping[str, Cell]) -> bool:
        """Whether the repeat with an address exists and may differ from the first execution.

        Repeats of a deterministic method with the same inputs only measure its time.
        """
        cell = before.get(address)
        if cell is None:
            return False
        is_random = self.methods[cell.method].determinism != "exact"
        return is_random or any("#" in source for source in cell.sources)

    def _node(self, step: WorkflowStep, full: Mapping[str, str]) -> _Node:
        workflow = self.workflow
        variant = step.variant(full.get(step.name, ""))
        own = {step.name: variant.name} if step.is_varied else {}
        by_data = {DATA: full[DATA]} if DATA in full else {}
        if (step.name, variant.name) in workflow.data_calls:
            own |= by_data
            calls = workflow.datasets[full[DATA]].calls
            variant = calls.get((step.name, variant.name), variant)
        if workflow.has_seeds and self._uses_seed(variant):
            own |= {SEED: full[SEED], **(by_data if workflow.has_data_seeds else {})}
        # The condition of a step may also depend on the dataset.
        always = {} if step.conditions.isdisjoint(workflow.data_inputs) else by_data
        own |= always
        if _is_excluded(workflow, own):
            raise _ExcludedError
        if cause := self._stopped_by(step, full):
            cell = self._cell(step, variant, own, {}, _reason(cause))
            return _Node(cell=cell, dependence=always, causes=(cause,))
        choices = {
            port: self._choose(step.inputs[port], full)
            for port in self._ports(variant)
            if port in step.inputs
        }
        assignment = dict(own)
        for _, dependence, _ in choices.values():
            assignment |= dependence
        if _is_excluded(workflow, assignment):
            raise _ExcludedError
        inputs = {port: source for port, (source, _, _) in choices.items() if source}
        ports = self._ports(variant)
        missing = next(
            (p for p, choice in choices.items() if not choice[0] and ports[p].required), ""
        )
        if not missing:
            cell = self._cell(step, variant, assignment, inputs, "")
            return _Node(cell=cell, dependence=assignment)
        _, chosen_by, causes = choices[missing]
        dependence = dict(chosen_by) | always
        takes = map(self._ports, step.variants)
        if not all(missing in own_ports and own_ports[missing].required for own_ports in takes):
            dependence |= own
        cell = self._cell(step, variant, assignment, inputs, _reason(*causes))
        return _Node(cell=cell, dependence=dependence, causes=causes)

    def _stopped_by(self, step: WorkflowStep, full: Mapping[str, str]) -> str:
        """Return the change of inputs after which the conditions of a step would be met.

        The result is empty if they are met.
        """
        if step.unless and self._input_name(step.unless, full) in self.present:
            return f"without the input {step.unless}"
        if step.only_if and self._input_name(step.only_if, full) not in self.present:
            return f"with the input {step.only_if}"
        return ""

    def _choose(self, references: tuple[Reference, ...], full: Mapping[str, str]) -> _Choice:
        dependence: Assignment = {}
        causes: dict[str, None] = {}
        for reference in references:
            if reference.is_input:
                if reference.name in self.workflow.data_inputs:
                    dependence[DATA] = full[DATA]
                name = self._input_name(reference.name, full)
                if name in self.present:
                    return WorkflowInput(name=name), dependence, ()
                causes[f"with the input {reference.name}"] = None
                continue
            node = self._upstream(reference.source, full)
            # The choice also depends on the factors of candidates that are not available.
            dependence |= node.dependence
            if not node.cell.skip_reason:
                output = CellOutput(address=node.cell.address, port=reference.name)
                return output, dependence, ()
            causes.update(dict.fromkeys(node.causes))
        return None, dependence, tuple(causes)

    def _input_name(self, name: str, full: Mapping[str, str]) -> str:
        dataset = self.workflow.datasets.get(full.get(DATA, ""))
        return dataset.inputs[name].name if dataset and name in dataset.inputs else name

    def _upstream(self, step: str, full: Mapping[str, str]) -> _Node:
        made = self.nodes[step]
        names = {name for name, _ in next(iter(made), ())}
        node = made.get(frozenset((name, chosen) for name, chosen in full.items() if name in names))
        if node is None:
            raise _ExcludedError
        return node

    def _cell(
        self,
        step: WorkflowStep,
        variant: StepVariant,
        assignment: Mapping[str, str],
        inputs: Mapping[str, CellOutput | WorkflowInput],
        skip_reason: str,
    ) -> Cell:
        # The dataset and the seed come before the steps.
        rank = {DATA: -2, SEED: -1, **self.rank}
        ordered = dict(sorted(assignment.items(), key=lambda item: rank[item[0]]))
        listed = ",".join(f"{name}={chosen}" for name, chosen in ordered.items())
        return Cell(
            address=f"{step.name}@{listed}" if listed else step.name,
            step=step.name,
            method=variant.method,
            assignment=ordered,
            params=variant.params,
            params_set=variant.params_set,
            inputs=inputs,
            seed=derive_seed(int(assignment.get(SEED, self.workflow.seed)), variant.method, 0),
            cores=variant.cores,
            timeout_s=variant.timeout_s,
            skip_reason=skip_reason,
            skip_type=NOT_ASKED_FOR if skip_reason else "",
            variant=variant.family if variant.swept else variant.name,
        )


def _compared_steps(workflow: Workflow, methods: Mapping[str, type[Method]]) -> set[str]:
    """Return the steps that the workflow compares.

    These steps run once per repeat of an upstream step. They are the steps named in
    `compare.metrics`, and the inspections that match its wildcards. Without `metrics`, they are all
    inspections.
    """
    metrics = workflow.compare.metrics if workflow.compare else ()
    patterns = [pattern.partition(".")[0] for pattern in metrics] or ["*"]
    return {
        step.name
        for step in workflow.steps.values()
        if step.name in patterns
        or (
            any(
                {port.type_name for port in port_specs(methods[variant.method].Out).values()}
                == {_JUDGEMENT}
                for variant in step.variants
            )
            and any(fnmatchcase(step.name, pattern) for pattern in patterns)
        )
    }


def _reason(*causes: str) -> str:
    return f"only {' or '.join(causes)}"
