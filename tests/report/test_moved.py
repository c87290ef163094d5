"""Rows of what differs between two runs: which are grouped, and which come first."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest

from orthoflow.records.compare import ComparedMetric, Pair
from orthoflow.report.differences import grouped_rows, moved_first


def metric(value: float, unit: str = "mm") -> ComparedMetric:
    return ComparedMetric(value=value, unit=unit, is_cost=False, is_cached=False, environment="e")


def moved(cell: str, name: str, left: float, right: float) -> Pair[ComparedMetric]:
    marks: dict[str, Any] = {
        "better": "" if name == "odd" else "lower",
        "headline": name in ("plane_angle_deg", "label_iou_mean"),
    }
    sides = (replace(metric(value), **marks) for value in (left, right))
    return Pair(cell=cell, name=name, left=next(sides), right=next(sides))


@pytest.mark.parametrize(
    ("left", "right", "is_rounded"),
    [
        (metric(1e-13), metric(4e-13), True),
        (metric(0.5), metric(0.500002), False),
        (metric(2e6 + 0.5), metric(2e6 + 1.5), True),
        (metric(2e6), metric(2e6 + 1.0), False),
        (metric(0.5), metric(0.5), False),
        (metric(0.5), metric(0.5 + 1e-9, "m"), False),
        (metric(0.5), None, False),
    ],
)
def test_rounding_is_a_difference_of_a_millionth_and_none_of_counts(
    left: ComparedMetric, right: ComparedMetric | None, is_rounded: bool
) -> None:
    assert Pair(name="x", left=left, right=right).is_rounded is is_rounded


def test_how_good_results_are_comes_first_and_what_moved_most() -> None:
    rooms = [f"check@data={index}" for index in range(3)]
    pairs = [
        *(moved(room, "odd", 1.0, 9.0) for room in rooms),
        moved(rooms[0], "rms_mm", 1.0, 1.0 + 1e-12),
        moved(rooms[0], "colour_rmse_grey", 1.0, 1.5),
        *(moved(room, "plane_angle_deg", 1.0, 2.0 + k) for k, room in enumerate(rooms)),
        moved(rooms[1], "label_iou_mean", 0.9, 0.9024),
        moved(rooms[2], "label_iou_mean", 0.9, math.nan),
    ]
    ordered = moved_first(pairs, dict.fromkeys(rooms, "check"))
    assert [(pair.name, pair.cell[-1]) for pair in ordered] == [
        ("label_iou_mean", "2"),
        ("plane_angle_deg", "2"),
        ("plane_angle_deg", "1"),
        ("plane_angle_deg", "0"),
        ("label_iou_mean", "1"),
        ("colour_rmse_grey", "0"),
        ("odd", "0"),
        ("odd", "1"),
        ("odd", "2"),
        ("rms_mm", "0"),
    ]


def test_a_parameter_of_many_cells_that_changes_equally_is_one_row() -> None:
    cells = [f"plane@data={room}#{repeat}" for room in "ab" for repeat in (1, 2)]
    pairs = [Pair(cell=cell, name="angle_deg", left=10, right=14) for cell in (*cells, "wall")]
    step_of = dict.fromkeys(cells, "plane")
    rows = grouped_rows(pairs, str, step_of)
    assert [(row.label(step_of), row.n) for row in rows] == [
        ("plane.angle_deg, 4 steps", 4),
        ("wall.angle_deg", 1),
    ]
