"""Two runs in tables: what differs, in words, and what was only compared."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from orthoflow.records.comparison import ComparedMetric, Pair
from orthoflow.report import differences
from orthoflow.report.differences import Difference
from tests.compared_runs import compared


def test_only_what_differs_has_a_row_and_everything_is_counted() -> None:
    pairs = [
        Pair(cell="a", name="x", left=1, right=1),
        Pair(cell="a", name="y", left=1, right=2),
        Pair(cell="a", name="z", left=1, right=1),
        Pair(cell="b", name="x", left=None, right=2),
        Pair(cell="c", name="x", left=3, right=None),
    ]
    table = differences._table("Things", pairs, str)
    assert (table.title, table.n_compared, table.n_different, table.n_alone) == ("Things", 3, 1, 2)
    assert table.rows == (
        Difference(cell="a", name="y", left="1", right="2"),
        Difference(cell="b", name="x", left="-", right="2"),
        Difference(cell="c", name="x", left="3", right="-"),
    )


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


def test_rounding_has_no_row_and_equal_repeats_have_one() -> None:
    pairs = [
        Pair(cell="a", name="odd_deg", left=metric(1e-13, "deg"), right=metric(4e-13, "deg")),
        Pair(cell="a", name="n_points", left=metric(3e7, "1"), right=metric(3e7 + 1, "1")),
        *(
            Pair(cell=f"a{repeat}", name="rms_mm", left=metric(2.0), right=metric(3.0))
            for repeat in ("", "#1", "#2")
        ),
        Pair(cell="b#1", name="rms_mm", left=metric(2.0), right=metric(3.0)),
    ]
    table = differences._metric_table(pairs, {"a": "a", "a#1": "a", "a#2": "a", "b#1": "b"})
    assert (table.n_compared, table.n_different, table.n_rounded) == (6, 5, 1)
    assert [(row.cell, row.name, row.change) for row in table.rows] == [
        ("b#1", "rms_mm", "1"),
        ("a", "rms_mm, 3 repeats", "1"),
        ("a", "n_points", "1"),
    ]


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


def test_files_are_named_with_the_beginning_of_their_digest() -> None:
    file: Any = SimpleNamespace(name="a.e57", sha256="0123456789abcdef")
    assert differences._files_text([file, file]) == "a.e57 0123456789ab, a.e57 0123456789ab"
    assert differences._files_text([]) == "not given"
