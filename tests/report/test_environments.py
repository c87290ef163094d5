"""Environments are one where they differ in nothing that the methods of a run use."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from orthoflow.records import RecordedEnvironment
from orthoflow.report import combinations as module
from orthoflow.report.combinations import group_environments
from tests.report_runs import HeldRun, cell, environment, record

FIRST = environment()


def packages(name: str, **versions: str) -> RecordedEnvironment:
    return replace(FIRST, id=name, packages={**FIRST.packages, **versions})


def first_alike(*others: RecordedEnvironment) -> list[str]:
    recorded = record([cell("a")], environments=(FIRST, *others))
    return [*group_environments([HeldRun(path=Path("r.h5"), record=recorded)]).first.values()]


@pytest.mark.parametrize(
    ("used", "other", "is_alike"),
    [
        ({"numpy"}, packages("e2", pytest="9"), True),
        (None, packages("e2", pytest="9"), True),
        ({"numpy"}, packages("e2", numpy="2.2"), False),
        ({"scipy"}, packages("e2", numpy="2.2"), True),
        (None, packages("e2", numpy="2.2"), False),
        ({"numpy"}, replace(FIRST, id="e2", cpu="other"), False),
    ],
    ids=["unrelated", "one has it", "used", "unused", "nobody knows", "machine"],
)
def test_only_what_methods_use_sets_environments_apart(
    monkeypatch: pytest.MonkeyPatch,
    used: set[str] | None,
    other: RecordedEnvironment,
    is_alike: bool,
) -> None:
    monkeypatch.setattr(module, "required_distributions", lambda _: used)
    assert first_alike(other) == ["e1", "e1" if is_alike else "e2"]
