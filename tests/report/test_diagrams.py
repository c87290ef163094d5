"""The graph of a run: a box per cell behind all that it takes from, an arrow per hand-over."""

from __future__ import annotations

from pathlib import Path

import pytest
from orthoflow_provenance.document import RecordedCell

from orthoflow.report.diagrams import BOX, run_diagram
from orthoflow.report.rendering import graph_file
from tests.report_runs import HeldRun, cell, given, record

CLOUD = given("scan.cloud", "1", "cloud")


def run(*cells: RecordedCell) -> HeldRun:
    return HeldRun(path=Path("run.h5"), record=record(cells))


def test_boxes_go_down_behind_all_that_they_take_from() -> None:
    told = run(
        cell("scan", wall_s=125.0),
        cell("plane", inputs={"cloud": CLOUD}, cached_from="r0"),
        cell("a-name-of-thirty-one-characters", inputs={"cloud": CLOUD}, status="failed"),
        cell("w", inputs={"c": CLOUD, "p": given("plane.p", "2", "planes")}, status="skipped"),
    )
    diagram = run_diagram(told)
    scan, plane, failed, last = diagram.boxes
    assert [box[2:] for box in diagram.boxes] == [
        ("ok", "scan", "scan", "scan.toy, 2 min 05 s"),
        ("cached", "plane", "plane", "plane.toy, 1.00 s"),
        ("failed", "a-name-of-thirty-one-characters", "a-name-of-thirty-one…cters", "failed"),
        ("skipped", "w", "w", "skipped"),
    ]
    assert scan[1] < plane[1] == failed[1] < last[1]
    # In the middle of their level, and beside each other.
    assert scan[0] == last[0] == (plane[0] + failed[0]) / 2
    assert failed[0] - plane[0] > BOX[0]
    assert len(diagram.arrows) == 4
    text = graph_file(told).decode()
    assert text.startswith('<svg xmlns="http://www.w3.org/2000/svg"')
    assert (text.count("<rect "), text.count('class="arrow"')) == (4, 4)
    assert "a-name-of-thirty-one-characters: failed</title>" in text


def test_a_level_too_wide_for_a_page_is_drawn_from_left_to_right() -> None:
    cells = [cell(f"plane{index}", inputs={"cloud": CLOUD}) for index in range(6)]
    scan, *planes = run_diagram(run(cell("scan"), *cells)).boxes
    assert {box[0] for box in planes} == {scan[0] + BOX[0] + 44}


def test_what_was_skipped_for_want_of_an_input_stands_below_and_widens_nothing() -> None:
    skipped = [cell(f"read{index}", status="skipped") for index in range(7)]
    diagram = run_diagram(run(cell("scan"), *skipped, cell("plane", inputs={"cloud": CLOUD})))
    tops = [box[1] for box in diagram.boxes]
    # Two levels and, of seven, rows of five and two.
    assert [tops.count(top) for top in sorted(set(tops))] == [1, 1, 5, 2]


@pytest.mark.parametrize(("n_cells", "n_boxes"), [(24, 24), (25, 1)])
def test_more_than_two_dozen_cells_become_a_box_per_step(n_cells: int, n_boxes: int) -> None:
    cells = [cell(f"plane@plane=v{k}", status="failed" if k < 3 else "ok") for k in range(n_cells)]
    boxes = run_diagram(run(*cells)).boxes
    assert len(boxes) == n_boxes
    if n_boxes == 1:
        assert boxes[0][2:] == ("failed", "plane", "plane", "run 25 times, 22.0 s, 3 failed")


def test_a_box_of_some_cached_cells_is_not_cached() -> None:
    def state(*froms: str) -> str:
        cells = [cell(f"p@p=v{k}", cached_from=froms[k % len(froms)]) for k in range(30)]
        return run_diagram(run(*cells)).boxes[0][2]

    assert (state("r0"), state("r0", "")) == ("cached", "ok")
    assert run_diagram(run()).boxes == []


def test_the_only_dataset_is_not_named_in_each_box() -> None:
    cells = [cell("room@data=r1"), cell("plane@data=r1,plane=ransac#2")]
    names = [box[3] for box in run_diagram(run(*cells)).boxes]
    assert names == ["room", "plane@plane=ransac#2"]
