"""The baseline, headline numbers, and all that differs between two runs, in groups and order."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
from orthoflow_provenance.document import RecordedFile
from syrupy.assertion import SnapshotAssertion

from orthoflow.records.compare import (
    CellFacts,
    ComparedMetric,
    Distance,
    Pair,
    ParameterValue,
    RunComparison,
)
from orthoflow.report.combinations import (
    baseline_cells,
    baseline_of,
    combinations_of,
    wanted_metrics,
)
from orthoflow.report.differences import differences, grouped_rows, moved_first
from orthoflow.report.rendering import environment
from orthoflow.report.summaries import answers
from tests.compared_runs import compared
from tests.compared_runs import number as metric
from tests.report_runs import (
    cell,
    compared_resolved,
    distance,
    metrics,
    record,
    run_of,
)

# --- combinations ---


def test_the_baseline_is_what_the_workflow_says() -> None:
    cells = [cell("plane@plane=fine"), cell("plane@plane=coarse"), cell("plane@plane=fine#1")]
    named = run_of(*cells, workflow_resolved=compared_resolved("*.wall_s", "a.b"))
    assert baseline_of(named) == {"plane": "fine"}
    assert wanted_metrics(named) == ("*.wall_s", "a.b")
    assert [one.is_baseline for one in combinations_of(named)] == [True, False]
    assert [item.address for item in baseline_cells(named)] == ["plane@plane=fine"]
    for resolved in ("{}", "no JSON", "[]", '{"compare": 3}', '{"compare": {"metrics": 1}}'):
        silent = run_of(*reversed(cells), workflow_resolved=resolved)
        assert (baseline_of(silent), wanted_metrics(silent)) == ({}, ())
        assert [one.is_baseline for one in combinations_of(silent)] == [False, False]
        assert [item.address for item in baseline_cells(silent)] == ["plane@plane=fine"]
    assert baseline_cells(run_of()) == ()


# --- differences ---

NAMES = ("status", "method", "distribution", "result_version", "determinism", "seed", "error")
FACTS, OTHER_FACTS = (
    CellFacts(**dict(zip(NAMES, values, strict=True)), code=code, tools=tools)
    for values, code, tools in (
        (("ok", "plane.a", "", 1, "exact", None, ""), {}, {}),
        (
            ("failed", "plane.b", "toys 1.0", 2, "seeded", 0, "no plane"),
            {"toys": "abcdef0123456789"},
            {"colmap": "4.2"},
        ),
    )
)


def test_all_that_differs_between_two_runs_is_in_tables(snapshot: SnapshotAssertion) -> None:
    file = RecordedFile(name="a.e57", size_bytes=3, sha256="0123456789abcdef" * 4)
    tables = differences(
        RunComparison(
            left=record([], run_id="r1"),
            right=record([], run_id="r2"),
            workflow=("--- a", "+++ b", "@@ -1 +1 @@", "-x", "+y"),
            overrides=Pair(name="options", left=("a=1", "b=2"), right=()),
            inputs=(
                Pair(name="scan", left=(file, file), right=()),
                Pair(name="photos", left=(file,), right=(file,)),
            ),
            cells=(Pair(name="a", left=FACTS, right=OTHER_FACTS),),
            parameters=(
                Pair(
                    cell="a",
                    name="cell_m",
                    left=ParameterValue(value="ä", is_set=True),
                    right=ParameterValue(value=None, is_set=False),
                ),
            ),
            environment=(
                Pair(name="python", left="3.11", right=None),
                Pair(name="cpu", left="x", right="x"),
            ),
            metrics=(
                Pair(cell="a", name="wall_s", left=metric(1, is_cost=True), right=None),
                Pair(cell="a", name="rms_mm", left=metric(1.5), right=metric(1.25)),
                Pair(cell="a", name="max_mm", left=None, right=metric(2.0)),
                Pair(cell="a", name="min_mm", left=metric(2.0), right=None),
                Pair(cell="a", name="same_mm", left=metric(2.0), right=metric(2.0)),
            ),
            products=(),
        )
    )
    assert tables == snapshot


def test_products_that_differ_stand_first_with_their_distances() -> None:
    far = Distance(unit="m", largest=0.25, limit=0.1, field="offset", n_values=3)
    odd = Distance(unit="", largest=None, limit=0.0, field="names", n_values=3)
    rows = Pair(cell="a", name="rms_mm", left=metric(1.0), right=metric(1.0))
    products = (distance("one", "identical"), distance("two", "different", "shapes", far, odd))
    page = environment().get_template("sections/differences.html.j2")
    html = page.render(compared=replace(compared(rows), products=products), differences=())
    words = "0.25 m at most in offset; names cannot be compared numerically; shapes"
    assert html.index("two (planes)") < html.index(words) < html.index("one (planes)")


def test_checks_answer_first_then_the_last_of_the_other_steps() -> None:
    whole_run = run_of(
        cell("plane", metrics=metrics(rms_mm=1.25)),
        cell("plane#1", metrics=metrics(rms_mm=1.75)),
        cell("first", metrics=metrics(check_rmse_mm_worst=2.0, n_oriented=9.0)),
        cell("second", metrics=metrics(check_rmse_mm_worst=7.0, n_oriented=8.0)),
        cell("check", metrics=metrics(completeness_seen_by_both=0.75, main_found=1.0)),
        cell("other", metrics=metrics(depth_rmse_mm=2.0, main_found=0.0)),
    )
    found = answers(whole_run)
    assert [(one.cell, one.value) for one in found] == [
        ("other", "no"),
        ("check", "0.75"),
        ("other", "2 mm"),
        ("second", "7 mm"),
        ("plane", "1.5 mm"),
    ]
    assert found[4].remark == "mean over the repeats"
    assert found[3].remark.endswith("photos oriented: 8")


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
        (metric(0.5), metric(0.5 + 1e-9, unit="m"), False),
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
