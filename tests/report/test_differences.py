"""Two runs in tables: what differs, in words, and what was only compared."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from orthoflow.records.compare import ComparedMetric, Pair
from orthoflow.report import differences
from orthoflow.report.differences import Difference
from tests.compared_runs import compared


def metric(value: float, unit: str = "mm", *, is_cost: bool = False) -> ComparedMetric:
    return ComparedMetric(
        value=value,
        unit=unit,
        is_cost=is_cost,
        is_cached=False,
        environment="e",
        headline=unit == "mm",
    )


def test_metrics_that_differ_say_by_how_much_and_costs_are_left_aside() -> None:
    pairs: list[Any] = [
        Pair(cell="a", name="rms_mm", left=metric(1.5), right=metric(1.25)),
        Pair(cell="a", name="same_mm", left=metric(1.5), right=metric(1.5)),
        Pair(cell="a", name="wall_s", left=metric(9.0, "s", is_cost=True), right=None),
        Pair(cell="b", name="new", left=None, right=metric(3.0, "1")),
        Pair(cell="c", name="old", left=metric(3.0, "1"), right=None),
    ]
    table = differences.differences(compared(*pairs)).tables[-1]
    assert (table.n_compared, table.n_different, table.n_alone) == (2, 1, 2)
    assert table.rows == (
        Difference(cell="a", name="rms_mm", left="1.5 mm", right="1.25 mm", change="-0.25"),
        Difference(cell="b", name="new", left="-", right="3"),
        Difference(cell="c", name="old", left="3", right="-"),
    )


def test_a_parameter_of_many_cells_that_changes_alike_is_one_row() -> None:
    cells = [f"plane@data={room}#{repeat}" for room in "ab" for repeat in (1, 2)]
    pairs = [Pair(cell=cell, name="angle_deg", left=10, right=14) for cell in cells]
    pairs.append(Pair(cell="wall", name="angle_deg", left=10, right=14))
    table = differences._table("Parameters", pairs, str, dict.fromkeys(cells, "plane"))
    assert table.rows == (
        Difference(cell="", name="plane.angle_deg, 4 steps", left="10", right="14"),
        Difference(cell="wall", name="angle_deg", left="10", right="14"),
    )
    assert table.n_different == 5


def test_a_product_says_how_far_each_field_lies_apart_and_why() -> None:
    distance: Any = SimpleNamespace(
        cell="wall",
        port="walls",
        type_name="walls",
        verdict="apart",
        reason="another encoding",
        distances=(
            SimpleNamespace(field="depth_m", largest=0.0123, unit="m"),
            SimpleNamespace(field="mask", largest=None, unit="1"),
        ),
    )
    row = differences._product_row(distance)
    assert (row.name, row.verdict) == ("walls (walls)", "apart")
    assert row.words == ("0.0123 m at most in depth_m; mask cannot be subtracted; another encoding")
    distance.reason = ""
    assert differences._product_row(distance).words == (
        "0.0123 m at most in depth_m; mask cannot be subtracted"
    )
