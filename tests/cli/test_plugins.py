"""What `plugins check` tells of the checks that it was given, and how it ends."""

from __future__ import annotations

import json
import sys
from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import pytest
from click.testing import CliRunner, Result

from orthoflow import scaffold, testing
from orthoflow.cli import plugins as module
from orthoflow.cli.program import program


def case(name: str, problem: str = "", *, is_quick: bool = True) -> Any:
    check = SimpleNamespace(name=name, rule=f"The rule of {name}.", is_quick=is_quick)
    return SimpleNamespace(check=check, problem=lambda: problem)


LEFT: list[str] = []
CASES = [
    case("fine"),
    case("stopped", "the method raised"),
    case("also-fine"),
    case("as-well", "the method raised"),
    case("other", "too far", is_quick=False),
    case("slow", is_quick=False),
]


def checked(monkeypatch: pytest.MonkeyPatch, cases: list[Any], *options: str) -> Result:
    monkeypatch.setattr(testing, "conformance_cases", lambda _id, **_known: cases)
    monkeypatch.setattr(module, "_sharing_kernels", lambda _id: nullcontext())
    monkeypatch.setattr(scaffold, "unwritten", lambda *_: LEFT)
    return CliRunner().invoke(program, ["plugins", "check", "plane.toy", *options])


def test_words_of_the_scaffold_are_named_and_break_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    left = ["the summary of kind mark", "the docstring of A"]
    monkeypatch.setattr(sys.modules[__name__], "LEFT", left)
    done = checked(monkeypatch, CASES[:1])
    assert done.exit_code == 0
    assert done.output.splitlines()[-2:] == [
        "plane.toy keeps 1 rule",
        f"warning: as `plugins new` wrote it, write your own: {', '.join(left)}",
    ]
    told = json.loads(checked(monkeypatch, CASES[:1], "--json").output)
    assert told["unwritten"] == left
