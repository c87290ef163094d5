"""A workflow as a Mermaid flowchart: plain text that Markdown pages show as a picture."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from orthoflow.catalog.catalog import Catalog
from orthoflow.workflow.format import StepVariant, Workflow, WorkflowStep
from orthoflow.workflow.methods import describe_method
from orthoflow.workflow.shapes import INPUTS_NAME


@dataclass(frozen=True, kw_only=True)
class _Wire:
    """An edge between two nodes, with the ports that it carries."""

    source: str
    target: str
    is_certain: bool


def mermaid(workflow: Workflow, catalog: Catalog) -> str:
    """Draw inputs, steps with their variants, and what flows between them.

    Dotted edges may stay empty: the port has several candidates, or the input switches the step
    off. Ports that all methods of a step ignore are not drawn.
    """
    # Names may be words that Mermaid reserves, such as `end`; only the labels show them.
    inputs = {name: f"input{index}" for index, name in enumerate(workflow.inputs)}
    steps = {name: f"step{index}" for index, name in enumerate(workflow.steps)}
    lines = ["flowchart LR"]
    for name, node in inputs.items():
        note = "<br/>optional" if workflow.inputs[name].optional else ""
        if name in workflow.data_inputs:
            note = f"<br/>of {len(workflow.chosen_data)} datasets"
        lines.append(f'    {node}[/"{name}{note}"/]')
    for name, node in steps.items():
        lines.append(f'    {node}["{_label(workflow.steps[name])}"]')
    for step in workflow.steps.values():
        labels: dict[_Wire, list[str]] = {}
        for wire, label in _wires(step, catalog):
            labels.setdefault(wire, []).append(label)
        for wire, ports in labels.items():
            source_name, _, port = wire.source.partition(".")
            source = inputs[port] if source_name == INPUTS_NAME else steps[source_name]
            arrow = "-->" if wire.is_certain else "-.->"
            text = ", ".join(dict.fromkeys(ports))
            lines.append(f'    {source} {arrow}|"{text}"| {steps[wire.target]}')
    return "\n".join(lines) + "\n"


def _label(step: WorkflowStep) -> str:
    lines = [f"<b>{step.name}</b>", *(_call_label(variant) for variant in step.variants)]
    return "<br/>".join(lines)


def _call_label(variant: StepVariant) -> str:
    name = f"{variant.name}: " if variant.name else ""
    repeat = f", {variant.repeat} times" if variant.repeat > 1 else ""
    return f"{name}{variant.method}{repeat}"


def _wires(step: WorkflowStep, catalog: Catalog) -> Iterator[tuple[_Wire, str]]:
    taken = {
        port for variant in step.variants for port in describe_method(catalog, variant.method).takes
    }
    for port, references in step.inputs.items():
        if port not in taken:
            continue
        for reference in references:
            source = str(reference) if reference.is_input else f"{reference.source}."
            wire = _Wire(source=source, target=step.name, is_certain=len(references) == 1)
            yield wire, port
    for name, word in ((step.only_if, "if"), (step.unless, "unless")):
        if name:
            wire = _Wire(source=f"{INPUTS_NAME}.{name}", target=step.name, is_certain=False)
            yield wire, word
