"""Cells: what a workflow's steps and variants become, one per method call that really differs.

All of them first; `--only`, `--from` and `--until` then choose among them.
"""

from __future__ import annotations

import hashlib
import itertools
import json
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Final

from orthoflow.catalog.catalog import Catalog
from orthoflow.catalog.wording import did_you_mean
from orthoflow.errors import ArgumentError
from orthoflow.products.product import JsonValue
from orthoflow.workflow.comparison import (
    Assignment,
    check_cell_count,
    combinations,
    is_excluded,
    require_few_cells,
)
from orthoflow.workflow.format import DATA, StepVariant, Workflow, WorkflowStep
from orthoflow.workflow.inputs import present_inputs
from orthoflow.workflow.methods import MethodInfo, describe_method
from orthoflow.workflow.shapes import Reference
from orthoflow.workflow.wiring import StepGraph, step_graph, topological_steps

# The kind whose methods say how good what others made is.
_JUDGING: Final = "inspect"
# How the reason of a cell begins that lacks optional data, unlike one behind a failure.
NOT_ASKED_FOR: Final = "only "
_SEED_BITS: Final = 53  # exact in every JSON reader, also those that only know doubles


@dataclass(frozen=True, kw_only=True)
class CellOutput:
    """An output of another cell."""

    address: str
    port: str

    def __str__(self) -> str:
        return f"{self.address}.{self.port}"


@dataclass(frozen=True, kw_only=True)
class WorkflowInput:
    """One of the workflow's inputs, by its own name: `scan`, or `scan@hall` of a dataset."""

    name: str

    def __str__(self) -> str:
        return f"inputs.{self.name}"


@dataclass(frozen=True, kw_only=True)
class Cell:
    """One method call of a run.

    Attributes:
        address: `step`, or `step@step=variant,...` with the variants that reach it in graph
            order, `data=name` in front where it hangs on the data, and `#n` behind it for repeats
            1, 2, ...
        step: name of the step.
        assignment: step -> variant for every varied step that reaches this cell, itself included,
            and `data` -> dataset in front.
        repeat: 0 for the first, which downstream cells use; but inspections of what has randomness
            are repeated with it.
        method: method id.
        params: resolved parameters, defaults included, JSON.
        params_set: parameters as written in the file or set on the command line, JSON.
        inputs: port -> where it comes from; ports that the method ignores and optional ones that
            are absent are left out.
        seed: derived from (workflow seed, method id, repeat).
        cores: cores asked for in `resources`, or None for all.
        timeout_s: seconds, or None.
        skip_reason: why the cell will not run (optional data absent), empty when it will.
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

    @property
    def setting(self) -> str:
        """How its parameters are named where they are set: `step`, or `step.variant`."""
        variant = self.assignment.get(self.step)
        return f"{self.step}.{variant}" if variant else self.step


def compared_cells(cells: Iterable[Cell]) -> frozenset[str]:
    """Give the addresses of cells whose times stand beside each other: variants and repeats.

    Those of one step on one dataset; what differs in its data alone is no comparison of methods.
    """
    alike: defaultdict[tuple[str, str], list[str]] = defaultdict(list)
    for cell in cells:
        alike[cell.step, cell.assignment.get(DATA, "")].append(cell.address)
    return frozenset(
        address for addresses in alike.values() if len(addresses) > 1 for address in addresses
    )


@dataclass(frozen=True, kw_only=True)
class Selection:
    """Names of steps; what is given together narrows the selection.

    Attributes:
        only: these steps.
        from_: these steps and what follows from them.
        until: these steps and what they are made from.

    Whatever the chosen steps need comes along, from the cache where it is there.
    """

    only: tuple[str, ...] = ()
    from_: tuple[str, ...] = ()
    until: tuple[str, ...] = ()

    @property
    def options(self) -> tuple[str, ...]:
        """The options that say so, each as given; none where nothing is left out."""
        options = {"--only": self.only, "--from": self.from_, "--until": self.until}
        return tuple(f"{option} {name}" for option, names in options.items() for name in names)


EVERYTHING: Final = Selection()


def expand_cells(
    workflow: Workflow, catalog: Catalog, *, selection: Selection = EVERYTHING
) -> tuple[Cell, ...]:
    """Expand a workflow into cells, each behind all it needs.

    Looks at the files of optional inputs, because absent data decide which cells can run.

    Raises:
        ArgumentError: the selection names steps that are not there, or leaves nothing.
        InputError: an optional input was named on the command line and is not there.
        PluginError: a method cannot be loaded.
    """
    expansion = _Expansion(
        workflow=workflow,
        present=present_inputs(workflow),
        methods={
            variant.method: describe_method(catalog, variant.method)
            for step in workflow.steps.values()
            for variant in step.variants
        },
        rank={name: index for index, name in enumerate(topological_steps(workflow.steps))},
    )
    return select_cells(workflow, expansion.expand(), selection)


def derive_seed(workflow_seed: int, method_id: str, repeat: int) -> int:
    """Derive the seed of a cell: the same method gets the same seed wherever it stands."""
    preimage = json.dumps(["orthoflow/seed", 1, workflow_seed, method_id, repeat])
    digest = hashlib.sha256(preimage.encode()).digest()
    return int.from_bytes(digest[:8], "big") >> (64 - _SEED_BITS)


def is_plain(cells: Iterable[Cell]) -> bool:
    """Whether nothing varies, so that each step is its only cell."""
    return all(cell.address == cell.step for cell in cells)


def variants_text(assignment: Mapping[str, str]) -> str:
    """Say which variants are chosen, `plane=ransac, orient=pnp`; empty for none."""
    return ", ".join(f"{step}={variant}" for step, variant in assignment.items())


def check_step_names(workflow: Workflow, names: Iterable[str], option: str) -> None:
    """Refuse names of steps that are not there, e.g. of `--force`.

    Raises:
        ArgumentError: a name is unknown.
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
    """Keep the cells of the chosen steps and the cells that those need.

    Raises:
        ArgumentError: a step is unknown, or nothing is left.
    """
    chosen = _chosen_steps(workflow, selection)
    by_address = {cell.address: cell for cell in cells}
    kept: set[str] = set()
    waiting = [cell.address for cell in cells if cell.step in chosen]
    while waiting:
        address = waiting.pop()
        if address in kept:
            continue
        kept.add(address)
        waiting.extend(
            source.address
            for source in by_address[address].inputs.values()
            if isinstance(source, CellOutput)
        )
    return tuple(cell for cell in cells if cell.address in kept)


@dataclass(frozen=True, kw_only=True)
class _Node:
    """A cell together with what decides whether it is there.

    Attributes:
        cell: the cell.
        dependence: the variants that its product depends on; for a skipped cell, those that its
            being skipped depends on, which may be fewer than its address names.
        causes: with or without which inputs it would not be skipped.
    """

    cell: Cell
    dependence: Assignment
    causes: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class _Choice:
    """What a port takes: the first candidate that is present, or none."""

    source: CellOutput | WorkflowInput | None
    dependence: Assignment
    causes: tuple[str, ...] = ()


class _ExcludedError(Exception):
    """The combination is left out of the comparison."""


@dataclass(frozen=True, kw_only=True)
class _Expansion:
    workflow: Workflow
    present: frozenset[str]
    methods: Mapping[str, MethodInfo]
    rank: Mapping[str, int]
    nodes: dict[str, dict[frozenset[tuple[str, str]], _Node]] = field(default_factory=dict)

    def expand(self) -> tuple[Cell, ...]:
        """Give all cells in topological order, the first of each repeat in front of the others."""
        graph = step_graph(self.workflow.steps)
        steps_of = {name: self._relevant(graph, name) for name in self.rank}
        by_data = {name for name, steps in steps_of.items() if any(map(self._takes_data, steps))}
        check_cell_count(self.workflow, steps_of, by_data)
        cells: dict[str, Cell] = {}
        for name, relevant in steps_of.items():
            step = self.workflow.steps[name]
            made: dict[frozenset[tuple[str, str]], _Node] = {}
            self.nodes[name] = made
            for assignment in self._assignments(relevant, is_by_data=name in by_data):
                try:
                    node = self._node(step, assignment)
                except _ExcludedError:
                    continue
                made[frozenset(assignment.items())] = node
                if node.cell.address not in cells:
                    repeats = self._repeats(step, node.cell, cells)
                    cells.update({cell.address: cell for cell in repeats})
                    require_few_cells(self.workflow, len(cells))
        return tuple(cells.values())

    def _takes_data(self, name: str) -> bool:
        """Whether datasets change something of a step itself."""
        step = self.workflow.steps[name]
        names = step.asked_inputs | {
            reference.name
            for references in step.inputs.values()
            for reference in references
            if reference.is_input
        }
        calls = ((name, variant.name) for variant in step.variants)
        return not (
            names.isdisjoint(self.workflow.data_inputs)
            and self.workflow.data_calls.isdisjoint(calls)
        )

    def _assignments(self, relevant: list[str], *, is_by_data: bool) -> Iterator[Assignment]:
        """Give the combinations that reach a step, per dataset where it may hang on the data."""
        if not is_by_data:
            yield from combinations(self.workflow, relevant)
            return
        for dataset in self.workflow.chosen_data:
            for assignment in combinations(self.workflow, relevant):
                yield {DATA: dataset.name, **assignment}

    def _relevant(self, graph: StepGraph, name: str) -> list[str]:
        """The steps that lie before a step and itself, in graph order."""
        before = graph.before(name) | {name}
        return sorted(before, key=self.rank.__getitem__)

    def _repeats(self, step: WorkflowStep, cell: Cell, before: Mapping[str, Cell]) -> list[Cell]:
        count = 1 if cell.skip_reason else step.variant(_variant_name(step, cell)).repeat
        repeats = [
            replace(
                cell,
                address=f"{cell.address}#{repeat}",
                repeat=repeat,
                seed=derive_seed(self.workflow.seed, cell.method, repeat),
            )
            for repeat in range(1, count)
        ]
        return [cell, *(repeats or self._judged_repeats(cell, before))]

    def _judged_repeats(self, cell: Cell, before: Mapping[str, Cell]) -> Iterator[Cell]:
        """Give the inspections of the other repeats of what an inspection looks at.

        Without them nobody would know how far what they find scatters. That takes a method with
        randomness, whose products it takes itself, and nothing that followed from the first only.
        """
        if cell.skip_reason or cell.method.partition(".")[0] != _JUDGING:
            return
        sources = {given.address for given in cell.inputs.values() if isinstance(given, CellOutput)}
        repeated = [
            name
            for name in sources
            if f"{name}#1" in before
            and self.methods[before[name].method].method.determinism != "exact"
        ]
        if len(repeated) != 1:
            return
        (source,) = repeated
        if any(source in _all_before(name, before) for name in sources):
            return
        for repeat in itertools.count(1):
            again = f"{source}#{repeat}"
            if again not in before:
                return
            inputs = {
                port: replace(given, address=again)
                if isinstance(given, CellOutput) and given.address == source
                else given
                for port, given in cell.inputs.items()
            }
            yield replace(cell, address=f"{cell.address}#{repeat}", repeat=repeat, inputs=inputs)

    def _node(self, step: WorkflowStep, full: Mapping[str, str]) -> _Node:
        variant = step.variant(full.get(step.name, ""))
        own = {step.name: variant.name} if step.is_varied else {}
        by_data = {DATA: full[DATA]} if DATA in full else {}
        if (step.name, variant.name) in self.workflow.data_calls:
            own |= by_data
            calls = self.workflow.datasets[full[DATA]].calls
            variant = calls.get((step.name, variant.name), variant)
        # Whether a step is needed may hang on the data too.
        always = {} if step.asked_inputs.isdisjoint(self.workflow.data_inputs) else by_data
        own |= always
        if is_excluded(self.workflow, own):
            raise _ExcludedError
        if cause := self._stopped_by(step, full):
            cell = self._cell(step, variant, own, {}, _reason(cause))
            return _Node(cell=cell, dependence=always, causes=(cause,))
        choices = {
            port: self._choose(step.inputs[port], full)
            for port in self.methods[variant.method].takes
            if port in step.inputs
        }
        assignment = dict(own)
        for choice in choices.values():
            assignment |= choice.dependence
        if is_excluded(self.workflow, assignment):
            raise _ExcludedError
        inputs = {port: choice.source for port, choice in choices.items() if choice.source}
        missing = next((port for port in choices if self._is_missing(variant, port, choices)), "")
        if not missing:
            cell = self._cell(step, variant, assignment, inputs, "")
            return _Node(cell=cell, dependence=assignment)
        choice = choices[missing]
        dependence = dict(choice.dependence) | always
        if not self._all_require(step, missing):
            dependence |= own
        cell = self._cell(step, variant, assignment, inputs, _reason(*choice.causes))
        return _Node(cell=cell, dependence=dependence, causes=choice.causes)

    def _stopped_by(self, step: WorkflowStep, full: Mapping[str, str]) -> str:
        """Why a step is skipped, whatever it takes; empty where it is not."""
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
                    return _Choice(source=WorkflowInput(name=name), dependence=dependence)
                causes[f"with the input {reference.name}"] = None
                continue
            node = self._upstream(reference.source, full)
            # What a passed-over candidate depends on decides this choice as well.
            dependence |= node.dependence
            if not node.cell.skip_reason:
                output = CellOutput(address=node.cell.address, port=reference.name)
                return _Choice(source=output, dependence=dependence)
            causes.update(dict.fromkeys(node.causes))
        return _Choice(source=None, dependence=dependence, causes=tuple(causes))

    def _input_name(self, name: str, full: Mapping[str, str]) -> str:
        """The own name of an input: that of the dataset, where it names files for it."""
        dataset = self.workflow.datasets.get(full.get(DATA, ""))
        return dataset.inputs[name].name if dataset and name in dataset.inputs else name

    def _upstream(self, step: str, full: Mapping[str, str]) -> _Node:
        made = self.nodes[step]
        names = {name for name, _ in next(iter(made), ())}
        node = made.get(frozenset((name, chosen) for name, chosen in full.items() if name in names))
        if node is None:
            raise _ExcludedError
        return node

    def _is_missing(self, variant: StepVariant, port: str, choices: Mapping[str, _Choice]) -> bool:
        return choices[port].source is None and self.methods[variant.method].takes[port].required

    def _all_require(self, step: WorkflowStep, port: str) -> bool:
        takes = (self.methods[variant.method].takes for variant in step.variants)
        return all(port in ports and ports[port].required for ports in takes)

    def _cell(
        self,
        step: WorkflowStep,
        variant: StepVariant,
        assignment: Mapping[str, str],
        inputs: Mapping[str, CellOutput | WorkflowInput],
        skip_reason: str,
    ) -> Cell:
        # Only a dataset has no rank among the steps, and it stands first.
        ordered = dict(sorted(assignment.items(), key=lambda item: self.rank.get(item[0], -1)))
        listed = ",".join(f"{name}={chosen}" for name, chosen in ordered.items())
        return Cell(
            address=f"{step.name}@{listed}" if listed else step.name,
            step=step.name,
            method=variant.method,
            assignment=ordered,
            params=variant.params,
            params_set=variant.params_set,
            inputs=inputs,
            seed=derive_seed(self.workflow.seed, variant.method, 0),
            cores=variant.cores,
            timeout_s=variant.timeout_s,
            skip_reason=skip_reason,
        )


def _all_before(address: str, cells: Mapping[str, Cell]) -> set[str]:
    """Addresses of all that a cell comes from."""
    found: set[str] = set()
    waiting = [address]
    while waiting:
        for given in cells[waiting.pop()].inputs.values():
            if isinstance(given, CellOutput) and given.address not in found:
                found.add(given.address)
                waiting.append(given.address)
    return found


def _reason(*causes: str) -> str:
    """Say why a cell is skipped: any of the causes would do."""
    return f"{NOT_ASKED_FOR}{' or '.join(causes)}"


def _variant_name(step: WorkflowStep, cell: Cell) -> str:
    return cell.assignment.get(step.name, "")


def _chosen_steps(workflow: Workflow, selection: Selection) -> set[str]:
    check_step_names(workflow, selection.only, "--only")
    check_step_names(workflow, selection.from_, "--from")
    check_step_names(workflow, selection.until, "--until")
    graph = step_graph(workflow.steps)
    chosen = set(workflow.steps)
    if selection.from_:
        chosen &= {step for name in selection.from_ for step in (name, *graph.after(name))}
    if selection.until:
        chosen &= {step for name in selection.until for step in (name, *graph.before(name))}
    if selection.only:
        chosen &= set(selection.only)
    if not chosen:
        raise ArgumentError(
            f"no step of workflow {workflow.name} is left by {' '.join(selection.options)} together"
        )
    return chosen
