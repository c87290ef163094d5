"""What a table of combinations says of itself: its baseline, what is whole, what is judged."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from orthoflow.report.comparisons import ComparisonTable, Row
from orthoflow.report.rankings import Mark, Sense, Value


def row(*variants: str, **more: Any) -> Row:
    plain: dict[str, Any] = {
        "run": "hall 1", "variants": variants, "is_baseline": False, "failure": "", "missing": (),
        "values": (), "time": None, "memory": None, "remark": "",
    }  # fmt: skip
    return Row(**(plain | more))


def table(*rows: Row, senses: tuple[Sense, ...] = (), shows_runs: bool = False) -> ComparisonTable:
    columns: Any = tuple(SimpleNamespace(sense=sense) for sense in senses)
    return ComparisonTable(
        steps=("plane", "wall"), columns=columns, rows=rows, shows_runs=shows_runs, groups={}
    )


def test_the_baseline_is_named_where_there_is_just_one() -> None:
    plain, first = row("a", "x"), row("b", "x", is_baseline=True)
    assert table(plain, first).baseline == "plane=b, wall=x"
    assert table(plain, first, shows_runs=True).baseline == "hall 1: plane=b, wall=x"
    assert table(plain).baseline == ""
    assert table(first, plain, row("a", "y", is_baseline=True)).baseline == ""


@pytest.mark.parametrize(
    ("more", "shortfall"),
    [
        ({}, ""),
        ({"failure": "plane: no points"}, "failed"),
        ({"missing": ("wall",)}, "not computed"),
        ({"failure": "plane: no points", "missing": ("wall",)}, "failed"),
    ],
)
def test_what_did_not_come_to_its_end_is_counted(more: dict[str, Any], shortfall: str) -> None:
    short = row("a", "x", **more)
    assert short.shortfall == shortfall
    assert table(short, row("b", "x"), row("c", "x")).n_whole == (2 if shortfall else 3)


def test_time_and_memory_are_judged_besides_what_has_a_good_side() -> None:
    assert table().n_judged == 2
    senses = (Sense.LESS, Sense.NEITHER, Sense.MORE, Sense.NEITHER, Sense.ONE)
    assert table(senses=senses).n_judged == 5


def test_numbers_in_which_nobody_leads_are_counted() -> None:
    def judged(*marks: Mark) -> Row:
        *values, time, memory = (Value(text="1", sort=1.0, mark=mark) for mark in marks)
        return row("a", "x", values=tuple(values), time=time, memory=memory)

    # One is described, not judged; then one that one leads in, one that two share, three level.
    senses = (Sense.NEITHER, Sense.LESS, Sense.MORE, Sense.LESS)
    level = (Mark.NONE, Mark.NONE)
    first = judged(Mark.NONE, Mark.BEST, Mark.NEAR, Mark.NONE, *level)
    other = judged(Mark.NONE, Mark.WORST, Mark.NEAR, Mark.FEWER, *level)
    assert table(first, other, senses=senses).n_undecided == 3
    assert table(first, other, senses=senses).n_judged == 5
    assert table(judged(Mark.BEST, Mark.NEAR), judged(Mark.NONE, Mark.NEAR)).n_undecided == 0
