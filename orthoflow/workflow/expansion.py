"""From steps and variants to cells: one per method call that really differs."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Final

import networkx as nx

from orthoflow.catalog import Catalog
from orthoflow.workflow.cells import Cell, CellOutput, WorkflowInput
from orthoflow.workflow.designs import Assignment, combinations, is_excluded
from orthoflow.workflow.inputs import present_inputs
from orthoflow.workflow.methods import MethodInfo, describe_method
from orthoflow.workflow.model import Reference, StepVariant, Workflow, WorkflowStep
from orthoflow.workflow.selection import EVERYTHING, Selection, select_cells
from orthoflow.workflow.wiring import step_graph, topological_steps

_SEED_BITS: Final = 53  # exact in every JSON reader, also those that only know doubles


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


@dataclass(frozen=True, kw_only=True)
class _Node:
    """A cell together with what decides whether it is there.

    Attributes:
        cell: the cell.
        dependence: the variants that its product depends on; for a skipped cell, those that its
            being skipped depends on, which may be fewer than its address names.
        causes: which inputs, given or not, are why it is skipped.
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
        cells: dict[str, Cell] = {}
        for name in self.rank:
            step = self.workflow.steps[name]
            before = nx.ancestors(graph, name)
            relevant = [other for other in self.rank if other in before or other == name]
            made: dict[frozenset[tuple[str, str]], _Node] = {}
            self.nodes[name] = made
            for assignment in combinations(self.workflow, relevant):
                try:
                    node = self._node(step, assignment)
                except _ExcludedError:
                    continue
                made[frozenset(assignment.items())] = node
                if node.cell.address not in cells:
                    cells.update({cell.address: cell for cell in self._repeats(step, node.cell)})
        return tuple(cells.values())

    def _repeats(self, step: WorkflowStep, cell: Cell) -> list[Cell]:
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
        return [cell, *repeats]

    def _node(self, step: WorkflowStep, full: Mapping[str, str]) -> _Node:
        variant = step.variant(full.get(step.name, ""))
        own = {step.name: variant.name} if step.is_varied else {}
        if is_excluded(self.workflow, own):
            raise _ExcludedError
        if step.unless and step.unless in self.present:
            cause = f"inputs.{step.unless} is given"
            cell = self._cell(step, variant, own, {}, f"not needed, because {cause}")
            return _Node(cell=cell, dependence={}, causes=(cause,))
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
        reason = f"port {missing} stays empty, because {' and '.join(choice.causes)}"
        dependence = dict(choice.dependence)
        if not self._all_require(step, missing):
            dependence |= own
        cell = self._cell(step, variant, assignment, inputs, reason)
        return _Node(cell=cell, dependence=dependence, causes=choice.causes)

    def _choose(self, references: tuple[Reference, ...], full: Mapping[str, str]) -> _Choice:
        dependence: Assignment = {}
        causes: dict[str, None] = {}
        for reference in references:
            if reference.is_input:
                if reference.name in self.present:
                    return _Choice(source=WorkflowInput(name=reference.name), dependence=dependence)
                causes[f"{reference} is not given"] = None
                continue
            node = self._upstream(reference.source, full)
            # What a passed-over candidate depends on decides this choice as well.
            dependence |= node.dependence
            if not node.cell.skip_reason:
                output = CellOutput(address=node.cell.address, port=reference.name)
                return _Choice(source=output, dependence=dependence)
            causes.update(dict.fromkeys(node.causes))
        return _Choice(source=None, dependence=dependence, causes=tuple(causes))

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
        ordered = dict(sorted(assignment.items(), key=lambda item: self.rank[item[0]]))
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


def _variant_name(step: WorkflowStep, cell: Cell) -> str:
    return cell.assignment.get(step.name, "")
