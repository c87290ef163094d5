"""What a workflow that is right may still not mean: inputs nobody takes, cells of three metres."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from orthoflow.workflow.format import StepVariant, Workflow

_CELL: Final = "gsd_m"
_CROP: Final = "crop"
# The kind whose methods find photos on walls.
_MATCHING: Final = "match."
# Cells of walls and plans: finer than any scan, coarser than anything that is drawn of a building.
_LEAST_GSD_M: Final = 0.0001
_MOST_GSD_M: Final = 0.5
_MILLIMETRES: Final = 1000.0


def doubts_about(workflow: Workflow) -> tuple[str, ...]:
    """Say in a sentence each what is allowed and can hardly be meant."""
    return (
        *_unused_inputs(workflow),
        *_idle_datasets(workflow),
        *_cell_sizes(workflow),
        *_cropped_matching(workflow),
    )


def _unused_inputs(workflow: Workflow) -> Iterator[str]:
    taken = _taken_inputs(workflow)
    for name in workflow.inputs:
        if name not in taken:
            yield f"no step takes the input {name}: wire it as inputs.{name}, or remove it"


def _taken_inputs(workflow: Workflow) -> set[str]:
    taken = {
        reference.name
        for step in workflow.steps.values()
        for references in step.inputs.values()
        for reference in references
        if reference.is_input
    }
    return taken.union(*(step.asked_inputs for step in workflow.steps.values()))


def _idle_datasets(workflow: Workflow) -> Iterator[str]:
    is_idle = not workflow.data_calls and workflow.data_inputs.isdisjoint(_taken_inputs(workflow))
    if workflow.datasets and is_idle:
        yield "the datasets change nothing: they name no input that a step takes, and no parameter"


def _cell_sizes(workflow: Workflow) -> Iterator[str]:
    for whose, step, variant in _calls(workflow, _CELL):
        gsd_m = variant.params.get(_CELL)
        if isinstance(gsd_m, int | float) and not _LEAST_GSD_M <= gsd_m <= _MOST_GSD_M:
            place = ".".join(part for part in (step, variant.name, _CELL) if part)
            meant_m = gsd_m / _MILLIMETRES
            hint = ""
            if _LEAST_GSD_M <= meant_m <= _MOST_GSD_M:
                hint = f"; {gsd_m:g} mm are written {_CELL}: {meant_m:g}"
            yield (
                f"{place}{whose} is {gsd_m:g} m, which can hardly be meant: cells are "
                f"{_LEAST_GSD_M:g} to {_MOST_GSD_M:g} m wide{hint}"
            )


def _cropped_matching(workflow: Workflow) -> Iterator[str]:
    cropped = {
        step
        for _, step, variant in _calls(workflow, _CROP)
        if variant.params.get(_CROP) is not None
    }
    matching = [
        step
        for step in workflow.steps.values()
        if any(variant.method.startswith(_MATCHING) for variant in step.variants)
    ]
    # Whose cameras are given needs no matching.
    if any(step.unless and workflow.inputs[step.unless].files for step in matching):
        return
    for first in matching[:1]:
        for wall in cropped.intersection(first.upstream()):
            yield (
                f"{wall}.{_CROP} leaves {first.name} less to match photos to: fewer are oriented, "
                "and less well; run without it first, and hand on the cameras which that run "
                "found: --input cameras=RUN/products/orient/cameras.json"
            )


def _calls(workflow: Workflow, parameter: str) -> Iterator[tuple[str, str, StepVariant]]:
    """Whose, of which step and how: all calls, of datasets those that set the parameter."""
    for step in workflow.steps.values():
        for variant in step.variants:
            yield "", step.name, variant
    for dataset in workflow.chosen_data:
        if parameter in {key.rpartition(".")[2] for key in dataset.sets}:
            for (name, _), variant in dataset.calls.items():
                yield f" of dataset {dataset.name}", name, variant
