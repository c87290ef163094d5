"""Reading the sections `inputs` and `compare`."""

from __future__ import annotations

import typing
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

from orthoflow.catalog import did_you_mean
from orthoflow.files.yaml_positions import Entry, Listing, Position, Table, Value, describe, join
from orthoflow.workflow.expectations import (
    expect_flag,
    expect_named,
    expect_table,
    expect_text,
    expect_texts,
)
from orthoflow.workflow.model import Comparison, Design, WorkflowInputSpec
from orthoflow.workflow.problems import ProblemLog
from orthoflow.workflow.steps import DraftStep

_COMPARE_KEYS: Final = ("design", "baseline", "exclude", "metrics")


def read_inputs(value: Value, folder: Path, log: ProblemLog) -> dict[str, WorkflowInputSpec]:
    """Read the section `inputs`.

    Args:
        value: the section.
        folder: folder of the workflow file.
        log: takes the problems.
    """
    specs: dict[str, WorkflowInputSpec] = {}
    for entry in expect_named(value, "inputs", log):
        path = join("inputs", entry.key)
        spec = WorkflowInputSpec(name=entry.key, folder=folder)
        specs[entry.key] = spec
        table = expect_table(entry.value, path, log, ("files", "optional"))
        if table is None:
            continue
        if files := table.get("files"):
            spec = replace(spec, files=expect_texts(files.value, join(path, "files"), log))
        if optional := table.get("optional"):
            flag = expect_flag(optional.value, join(path, "optional"), log)
            spec = replace(spec, optional=flag)
        specs[entry.key] = spec
    return specs


def read_compare(
    value: Value, steps: Sequence[DraftStep], step_names: Sequence[str], log: ProblemLog
) -> Comparison | None:
    """Read the section `compare` against the steps."""
    table = expect_table(value, "compare", log, _COMPARE_KEYS)
    if table is None:
        return None
    design = table.get("design")
    baseline = table.get("baseline")
    exclude = table.get("exclude")
    metrics = table.get("metrics")
    return Comparison(
        design=_design(design.value, log) if design else "product",
        baseline=_complete(
            _assignment(baseline.value, "compare.baseline", steps, log) if baseline else {}, steps
        ),
        exclude=_exclude(exclude, steps, log) if exclude else (),
        metrics=_metrics(metrics.value, step_names, log) if metrics else (),
    )


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


def _design(value: Value, log: ProblemLog) -> Design:
    text = expect_text(value, "compare.design", log)
    known: tuple[Design, ...] = typing.get_args(Design)
    for design in known:
        if text == design:
            return design
    if text is not None:
        log.add(
            value.position,
            "compare.design",
            f"unknown design {text}{did_you_mean(text, known)}; known: {', '.join(known)}",
        )
    return "product"


def _assignment(
    value: Value, path: str, steps: Sequence[DraftStep], log: ProblemLog
) -> dict[str, str]:
    """Read a mapping from varied steps to their variants."""
    varied = {step.name: step for step in steps if step.is_varied}
    chosen: dict[str, str] = {}
    for entry in expect_table(value, path, log) or ():
        here = join(path, entry.key)
        step = varied.get(entry.key)
        if step is None:
            log.add(
                entry.position,
                here,
                f"there is no step {entry.key} with variants{did_you_mean(entry.key, varied)}; "
                f"with variants: {', '.join(varied) or 'none'}",
            )
            continue
        text = expect_text(entry.value, here, log)
        names = [variant.name for variant in step.variants]
        if text in names:
            chosen[entry.key] = text
        elif text is not None:
            log.add(
                entry.value.position,
                here,
                f"step {entry.key} has no variant {text}{did_you_mean(text, names)}; it has "
                f"{', '.join(names)}",
            )
    return chosen


def _complete(baseline: Mapping[str, str], steps: Sequence[DraftStep]) -> dict[str, str]:
    return {
        step.name: baseline.get(step.name, step.variants[0].name)
        for step in steps
        if step.is_varied and step.variants
    }


def _exclude(
    entry: Entry, steps: Sequence[DraftStep], log: ProblemLog
) -> tuple[Mapping[str, str], ...]:
    path = "compare.exclude"
    if not isinstance(entry.value, Listing):
        log.add(
            entry.value.position,
            path,
            f"expected a list of mappings step: variant, got {describe(entry.value)}",
        )
        return ()
    combinations: list[Mapping[str, str]] = []
    for index, item in enumerate(entry.value.items):
        here = f"{path}[{index}]"
        if isinstance(item, Table) and not item.entries:
            log.add(item.position, here, "expected step: variant, got an empty mapping")
        combination = _assignment(item, here, steps, log)
        if combination:
            combinations.append(combination)
    return tuple(combinations)


def _metrics(value: Value, step_names: Sequence[str], log: ProblemLog) -> tuple[str, ...]:
    path = "compare.metrics"
    patterns = expect_texts(value, path, log)
    for pattern in patterns:
        step, dot, metric = pattern.partition(".")
        if not (step and dot and metric):
            log.add(value.position, path, f"expected step.metric, * allowed, got {pattern}")
        elif not set(step) & set("*?[") and step not in step_names:
            log.add(
                value.position,
                path,
                f"there is no step {step} for {pattern}{did_you_mean(step, step_names)}",
            )
    return patterns
