"""Checks that concern several parts of a workflow: connections, comparison and plausibility."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from fnmatch import fnmatchcase
from graphlib import CycleError, TopologicalSorter
from typing import Final

from orthoflow.errors import did_you_mean
from orthoflow.files.yaml_positions import Location
from orthoflow.sdk.context import MEASURED_BY_THE_ENGINE
from orthoflow.sdk.hooks import FILES
from orthoflow.sdk.methods import port_specs
from orthoflow.workflow.inputs import some_of
from orthoflow.workflow.model import (
    DATA,
    INPUTS,
    SEED,
    Comparison,
    Reference,
    StepVariant,
    Workflow,
)
from orthoflow.workflow.parameters import DraftStep
from orthoflow.workflow.source import ProblemLog

_WILDCARDS: Final = frozenset("*?[")


def check_wiring(
    steps: Sequence[DraftStep],
    step_names: Collection[str],
    input_names: Collection[str],
    log: ProblemLog,
) -> None:
    """Report all mistakes in the connections between steps.

    Args:
        steps: the steps that could be read.
        step_names: names of all steps in the file, including steps that could not be read.
        input_names: names of all inputs.
        log: log to which problems are added.
    """
    type_of = _types(steps, step_names, input_names, log)
    for step in steps:
        accepted = _ports(step, are_given=False)
        for port in step.inputs if accepted is not None else ():
            if port not in (accepted or {}):
                log.report(
                    (*step.location, "in", port),
                    f"{step.calls[0].id} has no input port "
                    f"{port}{did_you_mean(port, accepted or {})}; its input ports: "
                    f"{', '.join(accepted or {}) or 'none'}",
                    at_key=True,
                )
        for port, location, reference in _placed(step):
            found = type_of(location, reference)
            wanted = (accepted or {}).get(port)
            if found is not None and wanted is not None and found != wanted:
                message = (
                    f"expected {_article(wanted)}, but {reference} refers to {_article(found)}"
                )
                log.report(location, message)
        for key, condition in (("if", step.only_if), ("unless", step.unless)):
            if condition is not None:
                type_of((*step.location, key), condition)
        _check_required(step, log)
    _check_cycles(steps, log)


def _types(
    steps: Sequence[DraftStep],
    step_names: Collection[str],
    input_names: Collection[str],
    log: ProblemLog,
) -> Callable[[Location, Reference], str | None]:
    given = {step.name: _ports(step, are_given=True) for step in steps}

    def type_of(location: Location, reference: Reference) -> str | None:
        """Return the product type of a reference; if it is unknown, add a problem."""
        name, source = reference.name, reference.source
        if reference.is_input and name in input_names:
            return FILES
        if reference.is_input:
            log.report(
                location,
                f"there is no input {name}{did_you_mean(name, input_names)}; inputs: "
                f"{', '.join(input_names) or 'none'}",
            )
            return None
        if source not in step_names:
            log.report(
                location,
                f"there is no step {source}{did_you_mean(source, [*step_names, INPUTS])}; "
                f"steps: {', '.join(step_names)}",
            )
            return None
        ports = given.get(source)
        if ports is not None and name not in ports:
            log.report(
                location,
                f"step {source} has no output port {name}{did_you_mean(name, ports)}; its output "
                f"ports: {', '.join(ports)}",
            )
        return (ports or {}).get(name)

    return type_of


def _check_required(step: DraftStep, log: ProblemLog) -> None:
    # A port whose reference could not be read counts as connected.
    written = log.get((*step.location, "in"))
    wired = written if isinstance(written, dict) else step.inputs
    for call in step.calls:
        for needed in port_specs(call.method.In).values() if call.method else ():
            if needed.required and needed.name not in wired:
                log.report(
                    (*call.location, "use"),
                    f"the required input port {needed.name} of {call.id} "
                    f"({_article(needed.type_name)}) is not connected",
                    shown=(*step.location, "in"),
                )


def _placed(step: DraftStep) -> Iterator[tuple[str, Location, Reference]]:
    for port, references in step.inputs.items():
        for index, reference in enumerate(references):
            yield port, (*step.location, "in", port, index), reference


def _ports(step: DraftStep, *, are_given: bool) -> Mapping[str, str] | None:
    """Return port -> product type for the output or input ports of a step.

    The result is None if the kind of the step is unknown.
    """
    for call in step.calls:
        if call.kind is not None and not call.kind.is_source:
            return call.kind.outputs if are_given else call.kind.inputs
        if call.method is not None:
            ports = port_specs(call.method.Out if are_given else call.method.In)
            return {port.name: port.type_name for port in ports.values()}
    return None


def _article(type_name: str) -> str:
    return "input files" if type_name == FILES else f"a product of type {type_name}"


def _check_cycles(steps: Sequence[DraftStep], log: ProblemLog) -> None:
    wires: dict[tuple[str, str], tuple[Location, Reference]] = {}
    names = {step.name for step in steps}
    for step in steps:
        for _, location, reference in _placed(step):
            if reference.source in names:
                wires.setdefault((reference.source, step.name), (location, reference))
    sources: dict[str, list[str]] = {}
    for source, user in wires:
        sources.setdefault(user, []).append(source)
    while True:
        try:
            TopologicalSorter(sources).prepare()
        except CycleError as error:
            # Each step in this list is a source of the next step, and the last step is equal to the
            # first.
            names_in_cycle: list[str] = error.args[1]
        else:
            return
        edges = list(itertools.pairwise(names_in_cycle))
        places = {edge: log.position(wires[edge][0]) for edge in edges}
        first = min(range(len(edges)), key=lambda index: places[edges[index]])
        edges = edges[first:] + edges[:first]
        listed = ", ".join(
            f"{edge[1]} uses {wires[edge][1]} (line {places[edge].line})" for edge in edges
        )
        log.report(wires[edges[0]][0], f"the steps form a cycle: {listed}")
        for name in names_in_cycle:
            sources.pop(name, None)


def check_comparison(
    section: Comparison | None,
    steps: Sequence[DraftStep],
    step_names: Sequence[str],
    datasets: Sequence[str],
    seeds: Sequence[int],
    log: ProblemLog,
) -> Comparison | None:
    """Check the section `compare` against steps, datasets and seeds.

    Names of swept variants are replaced by the names of the variants for their values.
    """
    if section is None:
        return None
    names = {
        # The name of a swept variant remains valid and refers to the variants for all values.
        step.name: list(dict.fromkeys((*(call.name for call in step.calls), *_families(step))))
        for step in steps
        if step.is_varied
    }
    factors = dict(names)
    if datasets:
        factors[DATA] = list(datasets)
    if seeds:
        factors[SEED] = [str(seed) for seed in seeds]
    baseline = {
        step: variant
        for step, written in section.baseline.items()
        if (variant := _current(steps, step, written)) != ""
    }
    baseline = _known(baseline, ("compare", "baseline"), names, log)
    excluded: list[dict[str, str]] = []
    for index, combination in enumerate(section.exclude):
        if any(_current(steps, step, name) != name for step, name in combination.items()):
            continue  # it names a value that is not swept now
        known = _known(combination, ("compare", "exclude", index), factors, log)
        if known:
            excluded += _spelled_out(known, steps)
    chosen = {**first_variants(steps), **next(_spelled_out(baseline, steps))}
    comparison = section.model_copy(update={"baseline": chosen, "exclude": tuple(excluded)})
    _check_baseline(comparison, log)
    for index, pattern in enumerate(section.metrics):
        if problem := _metric_problem(pattern, steps, step_names):
            log.report(("compare", "metrics", index), problem)
    return comparison


def _check_baseline(comparison: Comparison, log: ProblemLog) -> None:
    for combination in comparison.exclude:
        if combination.items() <= comparison.baseline.items():
            listed = ", ".join(f"{step}: {variant}" for step, variant in combination.items())
            log.report(
                ("compare",),
                f"the baseline contains the excluded combination {{{listed}}}; choose another "
                "baseline",
                at_key=True,
                shown=("compare", "exclude"),
            )


def _current(steps: Sequence[DraftStep], step: str, variant: str) -> str:
    """Return the variant that a name refers to after overrides have been applied.

    If the file sweeps a parameter and the command line sets a single value, the names of the swept
    variants refer to the call with this value. Its name is empty if the step has no other variants.
    """
    draft = next((one for one in steps if one.name == step), None)
    fitting = [
        call.name
        for call in (draft.calls if draft else ())
        if call.is_unswept and (not call.name or variant.startswith(f"{call.name}-"))
    ]
    return max(fitting, key=len, default=variant)


def _families(step: DraftStep) -> dict[str, list[str]]:
    """Return name of a swept variant -> names of the variants for the values."""
    found: dict[str, list[str]] = {}
    for call in step.calls:
        if call.family:
            found.setdefault(call.family, []).append(call.name)
    return found


def _spelled_out(
    assignment: Mapping[str, str], steps: Sequence[DraftStep]
) -> Iterator[dict[str, str]]:
    """Yield an assignment for each value of the swept variants in an assignment."""
    families = {step.name: _families(step) for step in steps}
    several = [
        families.get(step, {}).get(variant, [variant]) for step, variant in assignment.items()
    ]
    for names in itertools.product(*several):
        yield dict(zip(assignment, names, strict=True))


def first_variants(steps: Sequence[DraftStep]) -> dict[str, str]:
    """Return the first variant of each step with variants."""
    return {step.name: step.calls[0].name for step in steps if step.is_varied and step.calls}


def _known(
    assignment: Mapping[str, str],
    location: Location,
    names: Mapping[str, Sequence[str]],
    log: ProblemLog,
) -> dict[str, str]:
    """Return the entries whose factor and level exist; report the others."""
    chosen: dict[str, str] = {}
    for factor, level in assignment.items():
        known = names.get(factor)
        if known is None:
            log.report(
                (*location, factor),
                f"there is no step {factor} with variants{did_you_mean(factor, names)}; steps "
                f"with variants: {', '.join(names) or 'none'}",
                at_key=True,
            )
        elif level in known:
            chosen[factor] = level
        else:
            what, have = {
                DATA: ("there is no dataset", "datasets:"),
                SEED: ("there is no seed", "seeds:"),
            }.get(factor, (f"step {factor} has no variant", "it has"))
            log.report(
                (*location, factor),
                f"{what} {level}{did_you_mean(level, known)}; {have} {some_of(known)}",
            )
    return chosen


def _metric_problem(pattern: str, steps: Sequence[DraftStep], step_names: Sequence[str]) -> str:
    step, _, metric = pattern.partition(".")
    if not _has_wildcard(step) and step not in step_names:
        return (
            f"{pattern} refers to a step {step}, which does not "
            f"exist{did_you_mean(step, step_names)}"
        )
    chosen = [one for one in steps if fnmatchcase(one.name, step)]
    calls = [(one, call) for one in chosen for call in one.calls]
    methods = [(one, call.method) for one, call in calls if call.method is not None]
    if not methods or len(methods) < len(calls):
        return ""
    specs = [(one, spec) for one, method in methods for spec in method.metric_specs()]
    matching = [(one, spec) for one, spec in specs if _may_match(spec.name, metric)]
    if any(not method.metrics for _, method in methods) or any(
        fnmatchcase(name, metric) for name in MEASURED_BY_THE_ENGINE
    ):
        return ""
    names = " and ".join(one.name for one in chosen)
    lacking = [[port for port in spec.needs if port not in one.inputs] for one, spec in matching]
    if lacking and all(lacking):
        ports = " and ".join(lacking[0])
        return (
            f"step {names} reports {metric} only if {ports} is connected; connect {ports} under "
            "in:, or remove the metric"
        )
    if matching:
        return ""
    known = [name for _, spec in specs if not _has_wildcard(name := spec.name)]
    ids = ", ".join(dict.fromkeys(call.id for _, call in calls))
    return (
        f"step {names} reports no metric "
        f"{metric}{did_you_mean(metric, [*dict.fromkeys(known), *MEASURED_BY_THE_ENGINE])}; to "
        f"list its metrics, run `orthoflow plugins show` with {ids}"
    )


def _may_match(declared: str, metric: str) -> bool:
    """Whether a declared and a requested name may be equal; both may contain wildcards."""
    if fnmatchcase(metric, declared) or fnmatchcase(declared, metric):
        return True
    # Assume that two patterns with wildcards can match the same name.
    return _has_wildcard(declared) and _has_wildcard(metric)


def _has_wildcard(text: str) -> bool:
    return not _WILDCARDS.isdisjoint(text)


_GSD: Final = "gsd_m"
_CROP: Final = "crop"
# Prefix of the methods that match photos with walls.
_MATCHING: Final = "match."
# Pixel sizes outside these limits are implausible: smaller than the point spacing of any scan, or
# too large for a drawing of a building.
_MIN_GSD_M: Final = 0.0001
_MAX_GSD_M: Final = 0.5
_MILLIMETRES: Final = 1000.0


def lint_workflow(workflow: Workflow) -> tuple[str, ...]:
    """Return a sentence for each implausible setting."""
    return (*_idle_inputs(workflow), *_cell_sizes(workflow), *_cropped_matching(workflow))


def _idle_inputs(workflow: Workflow) -> Iterator[str]:
    taken = {
        name
        for step in workflow.steps.values()
        for name in (*(one.name for one in step.references if one.is_input), *step.conditions)
    }
    for name in workflow.inputs:
        if name not in taken:
            yield (
                f"no step uses the input {name}: connect inputs.{name} to a step, or remove the "
                "input"
            )
    is_idle = not workflow.data_calls and workflow.data_inputs.isdisjoint(taken)
    if workflow.datasets and is_idle and not workflow.has_data_seeds:
        yield ("the datasets have no effect: they set no parameter and no input that a step uses")


def _cell_sizes(workflow: Workflow) -> Iterator[str]:
    for whose, step, variant in _calls(workflow, _GSD):
        gsd_m = variant.params.get(_GSD)
        if isinstance(gsd_m, int | float) and not _MIN_GSD_M <= gsd_m <= _MAX_GSD_M:
            place = ".".join(part for part in (step, variant.name, _GSD) if part)
            meant_m = gsd_m / _MILLIMETRES
            hint = ""
            if _MIN_GSD_M <= meant_m <= _MAX_GSD_M:
                hint = f"; for {gsd_m:g} mm write {_GSD}: {meant_m:g}"
            yield (
                f"{place}{whose} is {gsd_m:g} m, which is implausible: a cell is usually "
                f"{_MIN_GSD_M:g} to {_MAX_GSD_M:g} m wide{hint}"
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
    # If the input with which matching is skipped is given, no photos are matched.
    if any(step.unless and workflow.inputs[step.unless].files for step in matching):
        return
    for first in matching[:1]:
        for wall in cropped.intersection(first.upstream()):
            yield (
                f"{wall}.{_CROP} reduces the area that {first.name} can use, so fewer photos are "
                "oriented, and less accurately; first run without the crop, then use the cameras "
                "of that run: --input cameras=RUN/products/orient/cameras.json"
            )


def _calls(workflow: Workflow, parameter: str) -> Iterator[tuple[str, str, StepVariant]]:
    for step in workflow.steps.values():
        for variant in step.variants:
            yield "", step.name, variant
    for dataset in workflow.chosen_data:
        if parameter in {key.rpartition(".")[2] for key in dataset.sets}:
            for (name, _), variant in dataset.calls.items():
                yield f" of dataset {dataset.name}", name, variant
