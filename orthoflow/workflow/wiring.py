"""Checking how steps hang together: references, port types, required ports, cycles."""

from __future__ import annotations

import heapq
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from graphlib import CycleError, TopologicalSorter

from orthoflow.catalog.wording import did_you_mean
from orthoflow.files.yaml_positions import join
from orthoflow.sdk.hooks import FILES
from orthoflow.workflow.format import WorkflowStep
from orthoflow.workflow.problems import ProblemLog
from orthoflow.workflow.shapes import INPUTS_NAME, PlacedPort, PlacedReference
from orthoflow.workflow.steps import DraftStep

Edges = Mapping[str, Collection[str]]


@dataclass(frozen=True)
class StepGraph:
    """Which steps take products of which.

    Attributes:
        sources: step -> steps whose products it takes.
        users: step -> steps that take its products.
    """

    sources: Edges
    users: Edges

    def before(self, name: str) -> set[str]:
        """All that a step needs, directly or not."""
        return _reached(self.sources, name)

    def after(self, name: str) -> set[str]:
        """All that need a step, directly or not."""
        return _reached(self.users, name)


def _reached(edges: Edges, start: str) -> set[str]:
    reached: set[str] = set()
    waiting = list(edges[start])
    while waiting:
        name = waiting.pop()
        if name not in reached:
            reached.add(name)
            waiting.extend(edges[name])
    return reached


def step_graph(steps: Mapping[str, WorkflowStep]) -> StepGraph:
    """Give the graph of steps."""
    sources = {name: set(step.upstream()) for name, step in steps.items()}
    users: dict[str, set[str]] = {name: set() for name in steps}
    for name, needed in sources.items():
        for source in needed:
            users[source].add(name)
    return StepGraph(sources, users)


def is_acyclic(sources: Edges) -> bool:
    """Whether no step needs itself, directly or through others."""
    try:
        TopologicalSorter(sources).prepare()
    except CycleError:
        return False
    return True


def topological_steps(steps: Mapping[str, WorkflowStep]) -> tuple[str, ...]:
    """Order steps so that each stands behind all it needs, else in the order of the file."""
    graph, names = step_graph(steps), tuple(steps)
    rank = {name: index for index, name in enumerate(names)}
    n_missing = {name: len(sources) for name, sources in graph.sources.items()}
    ready = [rank[name] for name in names if n_missing[name] == 0]
    ordered: list[str] = []
    while ready:
        ordered.append(names[heapq.heappop(ready)])
        for user in graph.users[ordered[-1]]:
            n_missing[user] -= 1
            if n_missing[user] == 0:
                heapq.heappush(ready, rank[user])
    return tuple(ordered)


def check_wiring(
    steps: Sequence[DraftStep],
    step_names: Collection[str],
    input_names: Collection[str],
    log: ProblemLog,
) -> None:
    """Report everything that is wrong with how steps are wired.

    Args:
        steps: all steps that could be read.
        step_names: names of all steps in the file, readable or not.
        input_names: names of all inputs.
        log: takes the problems.
    """
    checker = _Checker(
        steps={step.name: step for step in steps},
        step_names=step_names,
        input_names=input_names,
        log=log,
    )
    for step in steps:
        checker.check_step(step)
    _check_cycles(steps, log)


@dataclass(frozen=True, kw_only=True)
class _Checker:
    steps: Mapping[str, DraftStep]
    step_names: Collection[str]
    input_names: Collection[str]
    log: ProblemLog

    def check_step(self, step: DraftStep) -> None:
        accepted = _accepted_ports(step)
        for port in step.ports:
            if accepted is None:
                self._check_references(port.references, None)
            elif port.name in accepted:
                self._check_references(port.references, accepted[port.name])
            else:
                self._report_unknown_port(step, port, accepted)
                self._check_references(port.references, None)
        for asked in (step.only_if, step.unless):
            if asked is not None:
                self._type_of(asked)
        self._check_required(step)

    def _report_unknown_port(
        self, step: DraftStep, port: PlacedPort, accepted: Collection[str]
    ) -> None:
        self.log.add(
            port.position,
            port.path,
            f"{step.variants[0].call.method} has no input port {port.name}"
            f"{did_you_mean(port.name, accepted)}; it has {', '.join(accepted) or 'none'}",
        )

    def _check_references(self, references: Sequence[PlacedReference], wanted: str | None) -> None:
        for placed in references:
            found = self._type_of(placed)
            if found is not None and wanted is not None and found != wanted:
                self.log.add(
                    placed.position,
                    placed.path,
                    f"expected {_article(wanted)}, but {placed.reference} gives {_article(found)}",
                )

    def _type_of(self, placed: PlacedReference) -> str | None:
        """Product type behind a reference; None when unknown, which is reported."""
        reference = placed.reference
        if reference.is_input:
            if reference.name in self.input_names:
                return FILES
            known = ", ".join(self.input_names) or "none"
            self.log.add(
                placed.position,
                placed.path,
                f"there is no input {reference.name}"
                f"{did_you_mean(reference.name, self.input_names)}; inputs: {known}",
            )
            return None
        if reference.source not in self.step_names:
            self.log.add(
                placed.position,
                placed.path,
                f"there is no step {reference.source}"
                f"{did_you_mean(reference.source, [*self.step_names, INPUTS_NAME])}; steps: "
                f"{', '.join(self.step_names)}",
            )
            return None
        source = self.steps.get(reference.source)
        given = _given_ports(source) if source else None
        if given is None:
            return None
        if reference.name not in given:
            self.log.add(
                placed.position,
                placed.path,
                f"step {reference.source} has no output port {reference.name}"
                f"{did_you_mean(reference.name, given)}; it has {', '.join(given)}",
            )
        return given.get(reference.name)

    def _check_required(self, step: DraftStep) -> None:
        wired = {port.name for port in step.ports}
        for variant in step.variants:
            if variant.info is None:
                continue
            for port in variant.info.takes.values():
                if port.required and port.name not in wired:
                    self.log.add(
                        variant.position,
                        join(step.path, "in"),
                        f"{variant.call.method} needs port {port.name}, "
                        f"{_article(port.type_name)}, which is not wired",
                    )


def _accepted_ports(step: DraftStep) -> Mapping[str, str] | None:
    """Input port -> product type; None when the step's kind is unknown."""
    for variant in step.variants:
        if variant.kind is not None and not variant.kind.is_source:
            return variant.kind.inputs
        if variant.info is not None:
            return {port.name: port.type_name for port in variant.info.takes.values()}
    return None


def _given_ports(step: DraftStep) -> Mapping[str, str] | None:
    """Output port -> product type; None when the step's kind is unknown."""
    for variant in step.variants:
        if variant.kind is not None and not variant.kind.is_source:
            return variant.kind.outputs
        if variant.info is not None:
            return variant.info.gives
    return None


def _article(type_name: str) -> str:
    return "files of an input" if type_name == FILES else f"the product {type_name}"


def _check_cycles(steps: Sequence[DraftStep], log: ProblemLog) -> None:
    wires: dict[tuple[str, str], PlacedReference] = {}
    names = {step.name for step in steps}
    for step in steps:
        for port in step.ports:
            for placed in port.references:
                if placed.reference.source in names:
                    wires.setdefault((placed.reference.source, step.name), placed)
    sources: dict[str, set[str]] = {}
    for source, user in wires:
        sources.setdefault(user, set()).add(source)
    if is_acyclic(sources):
        return
    import networkx as nx  # noqa: PLC0415 - takes a quarter of a command's start, for a mistake only

    graph: nx.DiGraph[str] = nx.DiGraph(list(wires))
    for members in nx.strongly_connected_components(graph):
        inside = graph.subgraph(members)
        if inside.number_of_edges() == 0:
            continue
        edges = [(str(edge[0]), str(edge[1])) for edge in nx.find_cycle(inside)]
        first = min(range(len(edges)), key=lambda index: wires[edges[index]].position)
        edges = edges[first:] + edges[:first]
        chain = [wires[edge] for edge in edges]
        listed = ", ".join(
            f"{edge[1]} takes {placed.reference} (line {placed.position.line})"
            for edge, placed in zip(edges, chain, strict=True)
        )
        log.add(chain[0].position, chain[0].path, f"the steps form a cycle: {listed}")
