"""Which combinations of variants a comparison consists of."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Final, TypeAlias

from orthoflow.errors import WorkflowError
from orthoflow.workflow.model import Workflow

Assignment: TypeAlias = dict[str, str]
MAX_COMBINATIONS: Final = 20_000


def combinations(workflow: Workflow, steps: Sequence[str]) -> Iterator[Assignment]:
    """Give the combinations of variants that reach a step, each once, the last step fastest.

    Args:
        workflow: the workflow.
        steps: the steps that matter, in graph order: the step itself and what lies before it.

    Raises:
        WorkflowError: there are more combinations than anybody can run.
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
        count = math.prod(len(names) for names in varied.values())
        if count > MAX_COMBINATIONS:
            raise WorkflowError(
                f"the comparison of {workflow.name} has {count} combinations of variants, more "
                f"than {MAX_COMBINATIONS}; use design: one-at-a-time, or fewer variants"
            )
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
