"""The graph of a run: a box per step below all that it depends on, an arrow per product."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

from orthoflow_provenance.document import RecordedCell

from orthoflow.report.figures import graph_file, run_graph
from tests.report_runs import HeldRun, cell, given, record

CLOUD = given("scan.cloud", "1", "cloud")


def run(*cells: RecordedCell) -> HeldRun:
    return HeldRun(path=Path("run.h5"), record=record(cells))


def test_boxes_are_below_all_that_they_depend_on() -> None:
    held = run(
        cell("scan", wall_s=125.0),
        cell("plane", inputs={"cloud": CLOUD}, cached_from="r0"),
        cell("failing", inputs={"cloud": CLOUD}, status="failed"),
        cell("w", inputs={"c": CLOUD, "p": given("plane.p", "2", "planes")}, status="skipped"),
    )
    graph = run_graph(held)
    assert [tuple(about.values()) for _, about in graph.nodes(data=True)] == [
        ("ok", "scan.toy, 2 min 05 s", 0, 0.0),
        ("cached", "plane.toy, 1.00 s", 1, -0.5),
        ("failed", "failed", 1, 0.5),
        ("skipped", "skipped", 2, 0.0),
    ]
    assert set(graph.edges) == {
        ("scan", "plane"),
        ("scan", "failing"),
        ("scan", "w"),
        ("plane", "w"),
    }
    assert ET.fromstring(graph_file(held)).tag == "{http://www.w3.org/2000/svg}svg"


def test_wide_levels_continue_below_and_what_was_skipped_alone_is_last() -> None:
    skipped = [cell(f"read{index}", status="skipped") for index in range(7)]
    planes = [cell(f"plane{index}", inputs={"cloud": CLOUD}) for index in range(6)]
    graph = run_graph(run(cell("scan"), *skipped, *planes))
    rows = [row for _, row in graph.nodes(data="row")]
    assert [rows.count(row) for row in range(5)] == [1, 5, 1, 5, 2]
    assert rows[0] == 0
    assert rows[1:8] == [3] * 5 + [4] * 2


def test_cells_of_a_step_are_one_box() -> None:
    cells = [cell(f"plane@plane=v{k}", status="failed" if k < 3 else "ok") for k in range(25)]
    (about,) = (about for _, about in run_graph(run(*cells)).nodes(data=True))
    assert about["state"] == "failed"
    assert about["about"] == "run 25 times, 22.0 s, 3 failed"
    for froms, state in ((("r0",), "cached"), (("r0", ""), "ok")):
        cells = [cell(f"p@p=v{k}", cached_from=froms[k % len(froms)]) for k in range(4)]
        assert run_graph(run(*cells)).nodes["p"]["state"] == state
