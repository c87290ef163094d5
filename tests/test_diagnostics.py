"""Diagnostics are data: grouped by code, ordered by harm, settled by later steps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from orthoflow.diagnostics import (
    Diagnostic,
    DiagnosticSpec,
    grouped,
    placement,
    standing,
)
from orthoflow.errors import ProductError
from tests.report_runs import cell, given

APART = DiagnosticSpec(
    code="scans-apart",
    severity="warning",
    text="{subject}: scans lie {apart_mm:.0f} mm apart",
    remedy="register them, or set {step[raster]}.buffer_m={buffer_m:g} for {step}",
    rank_by="apart_mm",
)
FEW = DiagnosticSpec(
    code="few-points", severity="warning", text="{n} points", rank_by="-n", settled_by=("face.a",)
)


def apart(wall: int, apart_mm: float) -> Diagnostic:
    return APART.of(f"wall {wall}", {"apart_mm": apart_mm, "buffer_m": 0.1})


def test_a_group_shows_its_worst_value_and_how_many_there_are() -> None:
    reported = [("w@a", apart(0, 60)), ("w@b", apart(3, 430)), ("w@c", apart(4, 61))]
    (group,) = grouped(reported)
    assert (group.worst.values["apart_mm"], group.count) == (430, 3)
    assert (group.subjects, group.places) == (("wall 0", "wall 4"), ("w@b", "w@a", "w@c"))
    assert "430 mm" in group.sentence
    assert "60 mm" not in group.sentence


def test_smaller_is_worse_where_the_rank_has_a_minus() -> None:
    (group,) = grouped([("a", FEW.of("", {"n": 5})), ("a", FEW.of("", {"n": 2}))])
    assert group.worst.values == {"n": 2}


def test_groups_are_ordered_by_severity_then_remedy_then_count() -> None:
    def one(code: str, severity: str, remedy: str = "") -> Diagnostic:
        spec = DiagnosticSpec(code=code, severity=severity, text="it is so", remedy=remedy)  # type: ignore[arg-type]
        return spec.of("", {})

    reported = [
        ("a", one("said", "note", "do this")),
        ("a", one("once", "warning")),
        ("a", one("often", "warning")),
        ("b", one("often", "warning")),
        ("b", one("helps", "warning", "do this")),
        ("c", one("wrong", "error")),
    ]
    assert [group.worst.code for group in grouped(reported)] == [
        *("wrong", "helps", "often", "once", "said"),
    ]


def test_values_are_plain_and_texts_one_printable_line() -> None:
    spec = DiagnosticSpec(code="odd", severity="note", text="{name}\n {n} {much}")
    one = spec.of("a\x1b", {"name": "x\n\x1b[2J", "n": np.int64(3), "much": float("nan")})
    assert one.values == {"name": "x \\x1b[2J", "n": 3, "much": None}
    assert (one.subject, one.text) == ("a\\x1b", "x \\x1b[2J 3 nan")


@pytest.mark.parametrize(
    ("values", "named"),
    [({}, "KeyError"), ({"n": [1]}, "must be a number or text"), ({"n": "few"}, "ranked by -n")],
)
def test_values_that_do_not_fit_are_refused_with_the_code(
    values: dict[str, object], named: str
) -> None:
    with pytest.raises(ProductError, match=f"few-points.*{named}"):
        FEW.of("", values)


@pytest.mark.parametrize("code", ["", "Few", "few points", "-few", "few_points"])
def test_codes_are_words_with_dashes(code: str) -> None:
    with pytest.raises(ProductError, match="lower-case words"):
        DiagnosticSpec(code=code, severity="note", text="")


def test_settings_are_named_by_the_steps_of_the_workflow() -> None:
    steps = [("wall", "raster.grid"), ("a", "plane.x"), ("b", "plane.y")]
    placed = placement(steps)
    assert placed(apart(0, 60), "plane.ransac").remedy == (
        "register them, or set wall.buffer_m=0.1 for plane.ransac"
    )
    again = DiagnosticSpec(code="a", text="", remedy="{unless[match.b]:use match.b, or }ask").of(
        "", {}
    )
    assert placed(again, "").remedy == "use match.b, or ask"
    assert placement([*steps, ("ties", "match.b")])(again, "").remedy == "ask"
    # If two steps have a kind, it is unknown which one is meant.
    named = DiagnosticSpec(code="a", text="{step[plane]} {step[plane.x]} {step[ortho]}").of("", {})
    assert placed(named, "").text == "plane a ortho"


def test_a_later_step_settles_what_names_its_method_or_code() -> None:
    few, wide = FEW.of("", {"n": 5}), apart(0, 60)
    made = given("", "a", "planes")
    plane = replace(cell("plane", outputs={"planes": made}), diagnostics=(few, wide))
    taken = {"planes": given("plane.planes", "a", "planes")}
    later = replace(cell("sides", inputs=taken), method="face.a")
    assert standing([plane, later]) == (("plane", wide),)
    by_code = replace(plane, diagnostics=(replace(few, settled_by=("scans-apart",)),))
    assert standing([by_code, replace(later, diagnostics=(wide,))]) == (("sides", wide),)
    # Not by another method, nor by one that failed or was given the product of another cell.
    other = {"planes": given("ransac.planes", "b", "planes")}
    for left in (
        replace(later, method="raster.grid"),
        replace(later, status="failed"),
        replace(later, inputs=other),
    ):
        assert standing([plane, left]) == (("plane", few), ("plane", wide))
