"""Parts of a page: the graph of a run, environments, and rows of a comparison."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import pytest

from orthoflow.records import RecordedEnvironment
from orthoflow.report import combinations as module
from orthoflow.report.combinations import group_environments, improved_on, ways
from orthoflow.report.figures import graph_file, run_graph
from tests.report_runs import cell, compared_run, environment, given, run_of

CLOUD = given("scan.cloud", "1", "cloud")


def test_boxes_are_below_all_that_they_depend_on() -> None:
    held = run_of(
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
    graph = run_graph(run_of(cell("scan"), *skipped, *planes))
    rows = [row for _, row in graph.nodes(data="row")]
    assert [rows.count(row) for row in range(5)] == [1, 5, 1, 5, 2]
    assert rows[0] == 0
    assert rows[1:8] == [3] * 5 + [4] * 2


def test_cells_of_a_step_are_one_box() -> None:
    cells = [cell(f"plane@plane=v{k}", status="failed" if k < 3 else "ok") for k in range(25)]
    (about,) = (about for _, about in run_graph(run_of(*cells)).nodes(data=True))
    assert about["state"] == "failed"
    assert about["about"] == "run 25 times, 22.0 s, 3 failed"
    for froms, state in ((("r0",), "cached"), (("r0", ""), "ok")):
        cells = [cell(f"p@p=v{k}", cached_from=froms[k % len(froms)]) for k in range(4)]
        assert run_graph(run_of(*cells)).nodes["p"]["state"] == state


FIRST = environment()


def packages(name: str, **versions: str) -> RecordedEnvironment:
    return replace(FIRST, id=name, packages={**FIRST.packages, **versions})


def first_alike(*others: RecordedEnvironment) -> list[str]:
    run = run_of(cell("a"), environments=(FIRST, *others))
    return [*group_environments([run]).first.values()]


@pytest.mark.parametrize(
    ("used", "other", "is_alike"),
    [
        ({"numpy"}, packages("e2", pytest="9"), True),
        (None, packages("e2", pytest="9"), True),
        ({"numpy"}, packages("e2", numpy="2.2"), False),
        ({"scipy"}, packages("e2", numpy="2.2"), True),
        (None, packages("e2", numpy="2.2"), False),
        ({"numpy"}, replace(FIRST, id="e2", cpu="other"), False),
    ],
    ids=["unrelated", "one has it", "used", "unused", "nobody knows", "machine"],
)
def test_only_what_methods_use_sets_environments_apart(
    monkeypatch: pytest.MonkeyPatch,
    used: set[str] | None,
    other: RecordedEnvironment,
    is_alike: bool,
) -> None:
    monkeypatch.setattr(module, "required_distributions", lambda _: used)
    assert first_alike(other) == ["e1", "e1" if is_alike else "e2"]


def test_every_cell_stands_in_one_place(tmp_path: Path) -> None:
    run = compared_run(tmp_path)
    fine, coarse, broken = ways(run, "r1-")
    assert fine.cells == ()
    assert "check@plane=coarse" in coarse.cells
    assert coarse.name == "plane=coarse"
    assert (coarse.anchor, broken.cells) == ("r1-way-2", ("plane@plane=broken",))


def test_what_combinations_share_stands_with_the_first() -> None:
    cells = [
        cell("plane@plane=a"),
        cell("plane@plane=b"),
        *(cell(f"orient@plane={p},orient={o}") for p in "ab" for o in "xy"),
    ]
    run = run_of(*cells)
    found = {way.name: way for way in ways(run, "")}
    assert found["plane=b, orient=x"].cells == ("plane@plane=b", "orient@plane=b,orient=x")
    assert found["plane=b, orient=y"].cells == ("orient@plane=b,orient=y",)


def test_a_first_orientation_is_improved_on_by_the_second() -> None:
    cells = [
        cell("first", method="orient.pnp"),
        cell("reties", method="match.guided", inputs={"c": given("first.cameras", "1", "cameras")}),
        cell("orient", method="orient.dlt", inputs={"t": given("reties.ties", "2", "ties")}),
    ]
    run = run_of(*cells)
    assert improved_on(run, [one.address for one in cells]) == {"first"}
    assert improved_on(run, ["first", "reties"]) == frozenset()
