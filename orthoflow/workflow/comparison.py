"""The comparison of a workflow: reading it, and which combinations of variants it consists of."""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from fnmatch import fnmatchcase
from typing import Final, TypeAlias

from orthoflow.catalog.wording import did_you_mean
from orthoflow.errors import WorkflowError
from orthoflow.files.yaml_positions import Entry, Position, Table, Text, Value, join
from orthoflow.sdk.context import MEASURED_BY_THE_ENGINE
from orthoflow.workflow.format import (
    BASELINE,
    COMPARE,
    COMPARISON,
    DATA,
    DESIGN,
    EXCLUDE,
    METRICS,
    Comparison,
    Workflow,
)
from orthoflow.workflow.inputs import some_of
from orthoflow.workflow.problems import ProblemLog
from orthoflow.workflow.shapes import TEXT, place_of
from orthoflow.workflow.steps import DraftStep

Assignment: TypeAlias = dict[str, str]
MOST_CELLS: Final = 20_000
MOST_EXCLUDED: Final = 500


def read_compare(
    value: Value,
    steps: Sequence[DraftStep],
    step_names: Sequence[str],
    datasets: Sequence[str],
    log: ProblemLog,
) -> Comparison | None:
    """Read the section `compare` against the steps and the names of the datasets."""
    path = COMPARE.name
    table = COMPARISON.read(value, path, log)
    if table is None:
        return None
    design = DESIGN.read(table, path, log) or "product"
    baseline = BASELINE.read(table, path, log)
    excluded = EXCLUDE.read(table, path, log) or ()
    if len(excluded) > MOST_EXCLUDED:
        log.add(
            value.position,
            join(path, EXCLUDE.name),
            f"expected at most {MOST_EXCLUDED} combinations to leave out, got {len(excluded)}",
        )
        excluded = ()
    names = {
        step.name: [variant.call.name for variant in step.variants]
        for step in steps
        if step.is_varied
    }
    families = {step.name: _families(step) for step in steps}
    # A variant that was swept is still known by its own name.
    names = {name: [*known, *families[name]] for name, known in names.items()}
    with_data = {DATA: list(datasets), **names} if datasets else names
    unswept = _unswept(steps)
    combinations = [
        _read_assignment(item, here, with_data, log)
        for here, item in excluded
        if not _names_unswept(item, unswept)
    ]
    chosen: Assignment = {}
    if baseline:
        here = join(path, BASELINE.name)
        chosen = _read_assignment(_without_values(baseline, unswept), here, names, log)
    return Comparison(
        design=design,
        baseline=_complete(next(_spelt_out(chosen, families)), steps),
        exclude=tuple(
            one
            for combination in combinations
            if combination
            for one in _spelt_out(combination, families)
        ),
        metrics=_read_metrics(table, steps, step_names, log),
    )


def _families(step: DraftStep) -> dict[str, tuple[str, ...]]:
    """Of variants that were swept: name -> the variants that its values became."""
    found: dict[str, tuple[str, ...]] = {}
    for variant in step.variants:
        if variant.family:
            found[variant.family] = (*found.get(variant.family, ()), variant.call.name)
    return found


def _unswept(steps: Sequence[DraftStep]) -> dict[str, tuple[str, ...]]:
    """Names of the calls to which the command line gives one value of what the file sweeps."""
    found = {
        step.name: tuple(variant.call.name for variant in step.variants if variant.is_unswept)
        for step in steps
    }
    return {step: names for step, names in found.items() if names}


def _call_of(entry: Entry, unswept: Mapping[str, Sequence[str]]) -> str | None:
    """The call whose swept value an entry names, though it is not swept now; None for others."""
    text = entry.value.value if isinstance(entry.value, Text) else ""
    names = unswept.get(entry.key, ())
    fitting = [name for name in names if not name or str(text).startswith(f"{name}-")]
    return max(fitting, key=len, default=None)


def _names_unswept(table: Table, unswept: Mapping[str, Sequence[str]]) -> bool:
    return any(_call_of(entry, unswept) is not None for entry in table)


def _without_values(table: Table, unswept: Mapping[str, Sequence[str]]) -> Table:
    """A baseline with calls in the place of values of theirs that are not swept now."""
    entries = []
    for entry in table:
        call = _call_of(entry, unswept)
        if call is None:
            entries.append(entry)
        elif call and isinstance(entry.value, Text):
            entries.append(replace(entry, value=replace(entry.value, value=call)))
        # A step that is its only call has no variants to choose from.
    return replace(table, entries=tuple(entries))


def _spelt_out(
    assignment: Mapping[str, str], families: Mapping[str, Mapping[str, tuple[str, ...]]]
) -> Iterator[Assignment]:
    """Give an assignment for each value of a swept variant that it names, in their order."""
    several = [
        families.get(step, {}).get(variant, (variant,)) for step, variant in assignment.items()
    ]
    for names in itertools.product(*several):
        yield dict(zip(assignment, names, strict=True))


def check_baseline(comparison: Comparison, position: Position, log: ProblemLog) -> None:
    """Report a baseline that the comparison itself leaves out."""
    for combination in comparison.exclude:
        if combination.items() <= comparison.baseline.items():
            listed = ", ".join(f"{step}: {variant}" for step, variant in combination.items())
            log.add(
                position,
                "compare.exclude",
                f"the baseline contains the excluded combination {{{listed}}}; name another "
                f"baseline",
            )


def check_cell_count(
    workflow: Workflow, steps_of: Mapping[str, Sequence[str]], by_data: Collection[str]
) -> None:
    """Count the cells of a workflow before there are any, those that are left out included.

    Args:
        workflow: the workflow.
        steps_of: per step the steps that matter to it, in graph order, itself last.
        by_data: steps that run once per dataset.

    Raises:
        WorkflowError: there are more than anybody can run.
    """
    n_data = len(workflow.chosen_data)
    count = sum(
        _count_cells(workflow, steps) * (n_data if name in by_data else 1)
        for name, steps in steps_of.items()
    )
    require_few_cells(workflow, count)


def require_few_cells(workflow: Workflow, count: int) -> None:
    """Refuse more cells than anybody can run.

    Raises:
        WorkflowError: there are.
    """
    if count > MOST_CELLS:
        n_data = len(workflow.chosen_data)
        of_what = "datasets, combinations" if n_data else "combinations"
        fewer = "fewer datasets (--only-data), fewer variants" if n_data else "fewer variants"
        raise WorkflowError(
            f"the comparison of {workflow.name} runs its steps {count} times ({of_what} of "
            f"variants, and repeats), more than {MOST_CELLS}; use design: one-at-a-time, {fewer} "
            "or a smaller repeat"
        )


def _count_cells(workflow: Workflow, steps: Sequence[str]) -> int:
    *before, name = steps
    step = workflow.steps[name]
    repeats = {variant.name: variant.repeat for variant in step.variants}
    first = repeats[workflow.baseline[name] if step.is_varied else step.variants[0].name]
    if workflow.compare is None:
        return first
    others = [
        len(workflow.steps[other].variants) for other in before if workflow.steps[other].is_varied
    ]
    if workflow.compare.design == "product":
        return math.prod(others) * sum(repeats.values())
    return sum(count - 1 for count in others) * first + sum(repeats.values())


def combinations(workflow: Workflow, steps: Sequence[str]) -> Iterator[Assignment]:
    """Give the combinations of variants that reach a step, each once, the last step fastest.

    Args:
        workflow: the workflow.
        steps: the steps that matter, in graph order: the step itself and what lies before it.

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
        yield from _one_at_a_time(varied, baseline)


def _one_at_a_time(
    varied: Mapping[str, tuple[str, ...]], baseline: Assignment
) -> Iterator[Assignment]:
    yield dict(baseline)
    for step, names in varied.items():
        for name in names:
            if name != baseline[step]:
                yield {**baseline, step: name}


def is_excluded(workflow: Workflow, assignment: Mapping[str, str]) -> bool:
    """Whether an assignment contains a combination that the comparison leaves out."""
    excluded = workflow.compare.exclude if workflow.compare else ()
    return any(combination.items() <= assignment.items() for combination in excluded)


def _read_assignment(
    table: Table, path: str, varied: Mapping[str, Sequence[str]], log: ProblemLog
) -> Assignment:
    """Read a mapping from varied steps, and `data`, to one of the names that each has."""
    chosen: Assignment = {}
    for entry in table:
        here = join(path, entry.key)
        known = varied.get(entry.key)
        if known is None:
            log.add(
                entry.position,
                here,
                f"there is no step {entry.key} with variants{did_you_mean(entry.key, varied)}; "
                f"with variants: {', '.join(varied) or 'none'}",
            )
            continue
        text = TEXT.read(entry.value, here, log)
        if text is not None and text in known:
            chosen[entry.key] = text
        elif text is not None:
            what = (
                "there is no dataset" if entry.key == DATA else f"step {entry.key} has no variant"
            )
            have = "datasets:" if entry.key == DATA else "it has"
            log.add(
                entry.value.position,
                here,
                f"{what} {text}{did_you_mean(text, known)}; {have} {some_of(known)}",
            )
    return chosen


def first_variants(steps: Sequence[DraftStep]) -> Assignment:
    """The first variant of every varied step."""
    return _complete({}, steps)


def _complete(baseline: Mapping[str, str], steps: Sequence[DraftStep]) -> Assignment:
    return {
        step.name: baseline.get(step.name, step.variants[0].call.name)
        for step in steps
        if step.is_varied and step.variants
    }


def _read_metrics(
    table: Table, steps: Sequence[DraftStep], step_names: Sequence[str], log: ProblemLog
) -> tuple[str, ...]:
    patterns = METRICS.read(table, COMPARE.name, log) or ()
    entry = table.get(METRICS.name)
    for pattern in patterns if entry else ():
        step, _, metric = pattern.partition(".")
        problem = ""
        if not _has_wildcard(step) and step not in step_names:
            problem = f"there is no step {step} for {pattern}{did_you_mean(step, step_names)}"
        elif not _has_wildcard(metric):
            problem = _unknown_metric(metric, [one for one in steps if fnmatchcase(one.name, step)])
        if entry and problem:
            place = place_of(pattern, entry.value)
            log.add(place, join(COMPARE.name, METRICS.name), problem)
    return patterns


def _unknown_metric(metric: str, steps: Sequence[DraftStep]) -> str:
    """Say that no method of the steps reports a metric; empty where one does, or may."""
    calls = [variant for step in steps for variant in step.variants]
    methods = [variant.info.method for variant in calls if variant.info is not None]
    if metric in MEASURED_BY_THE_ENGINE or len(methods) < len(calls) or not methods:
        return ""
    if any(method.may_report(metric) for method in methods):
        return ""
    known = dict.fromkeys(
        spec.name
        for method in methods
        for spec in method.metric_specs()
        if not _has_wildcard(spec.name)
    )
    names = " and ".join(step.name for step in steps)
    ids = ", ".join(dict.fromkeys(variant.call.method for variant in calls))
    hint = did_you_mean(metric, [*known, *MEASURED_BY_THE_ENGINE])
    return (
        f"step {names} reports no metric {metric}{hint}; `orthoflow plugins show METHOD` lists "
        f"those of {ids}"
    )


def _has_wildcard(text: str) -> bool:
    return bool(set(text) & set("*?["))
