"""Small words of workflow files: times, sources, and the line under a problem."""

from __future__ import annotations

import math

import pytest

from orthoflow.files.yaml_positions import Scalar
from orthoflow.workflow.cells import CellOutput, WorkflowInput
from orthoflow.workflow.problems import Problem
from orthoflow.workflow.shapes import seconds_in


@pytest.mark.parametrize(
    ("written", "seconds"),
    [
        ("90s", 90.0),
        ("1.5 s", 1.5),
        ("30min", 1800.0),
        ("2h", 7200.0),
        ("0.5  h", 1800.0),
        (1, 1.0),
        (0.25, 0.25),
        *((wrong, None) for wrong in (0, -1, True, None, math.inf, math.nan, 0.0)),
        *((wrong, None) for wrong in ("0s", "s", "5", "5m", "5 hours", "-5s", "1.s", "1,5s", "")),
    ],
)
def test_times_have_a_number_and_a_unit(written: Scalar, seconds: float | None) -> None:
    assert seconds_in(written) == seconds


def test_sources_are_said_as_they_are_written() -> None:
    assert str(CellOutput(address="plane@plane=a", port="planes")) == "plane@plane=a.planes"
    assert str(WorkflowInput(name="scan")) == "inputs.scan"


def problem(text: str, column: int, *, line: int = 3, path: str = "steps.a") -> str:
    return str(
        Problem(file="a.yaml", line=line, column=column, path=path, message="odd", text=text)
    )


def test_a_problem_stands_over_the_line_that_it_is_about() -> None:
    assert problem("  use: plane", 8) == ("a.yaml:3:8: steps.a: odd\n    use: plane\n         ^")
    assert problem("x\ty", 3) == "a.yaml:3:3: steps.a: odd\n    x y\n      ^"
    assert problem("", 1, path="") == "a.yaml:3:1: odd"
    assert problem("  \t ", 1) == "a.yaml:3:1: steps.a: odd"
    assert problem("a: b", 1, line=0) == "a.yaml: steps.a: odd\n    a: b\n    ^"


@pytest.mark.parametrize(
    ("n_letters", "column"),
    [(120, 1), (120, 61), (120, 120), (121, 61), (121, 62), (121, 121), (300, 100), (300, 300)],
)
def test_of_a_long_line_what_is_around_the_column_is_shown(n_letters: int, column: int) -> None:
    text = "".join(chr(ord("a") + k % 26) for k in range(n_letters))
    _, shown, caret = problem(text, column).splitlines()
    start = 0 if n_letters == 120 else max(0, column - 61)
    assert shown == f"    {text[start : start + 120]}"
    assert shown[caret.index("^")] == text[column - 1]
    assert caret == " " * (caret.index("^")) + "^"
