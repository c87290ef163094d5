"""Running a part of a workflow: `--only`, `--from`, `--until`."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import networkx as nx

from orthoflow.catalog import did_you_mean
from orthoflow.errors import ArgumentError
from orthoflow.workflow.cells import Cell, CellOutput
from orthoflow.workflow.model import Workflow
from orthoflow.workflow.wiring import step_graph


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


EVERYTHING: Final = Selection()


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


def _chosen_steps(workflow: Workflow, selection: Selection) -> set[str]:
    check_step_names(workflow, selection.only, "--only")
    check_step_names(workflow, selection.from_, "--from")
    check_step_names(workflow, selection.until, "--until")
    graph = step_graph(workflow.steps)
    chosen = set(workflow.steps)
    if selection.from_:
        chosen &= {
            step for name in selection.from_ for step in (name, *nx.descendants(graph, name))
        }
    if selection.until:
        chosen &= {step for name in selection.until for step in (name, *nx.ancestors(graph, name))}
    if selection.only:
        chosen &= set(selection.only)
    if not chosen:
        raise ArgumentError(
            f"no step of workflow {workflow.name} is left by {_options(selection)} together"
        )
    return chosen


def _options(selection: Selection) -> str:
    options = {
        "--only": selection.only,
        "--from": selection.from_,
        "--until": selection.until,
    }
    return " ".join(f"{option} {name}" for option, names in options.items() for name in names)
