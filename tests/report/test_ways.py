"""Which cells stand in the page's own sections, and which behind a row of the comparison."""

from __future__ import annotations

from pathlib import Path

from orthoflow.report.combinations import improved_on, ways
from tests.report_runs import HeldRun, cell, compared_run, given, record


def test_every_cell_stands_in_one_place(tmp_path: Path) -> None:
    run = compared_run(tmp_path)
    fine, coarse, broken = ways(run, "r1-")
    assert fine.cells == ()
    assert "check@plane=coarse" in coarse.cells
    assert coarse.name == "plane=coarse"
    assert (coarse.anchor, broken.cells) == ("r1-way-2", ("plane@plane=broken",))


def test_what_combinations_share_stands_with_the_first(tmp_path: Path) -> None:
    cells = [
        cell("plane@plane=a"),
        cell("plane@plane=b"),
        *(cell(f"orient@plane={p},orient={o}") for p in "ab" for o in "xy"),
    ]
    run = HeldRun(path=tmp_path / "run.h5", record=record(cells))
    found = {way.name: way for way in ways(run, "")}
    assert found["plane=b, orient=x"].cells == ("plane@plane=b", "orient@plane=b,orient=x")
    assert found["plane=b, orient=y"].cells == ("orient@plane=b,orient=y",)


def test_a_first_orientation_is_improved_on_by_the_second(tmp_path: Path) -> None:
    cells = [
        cell("first", method="orient.pnp"),
        cell("reties", method="match.guided", inputs={"c": given("first.cameras", "1", "cameras")}),
        cell("orient", method="orient.dlt", inputs={"t": given("reties.ties", "2", "ties")}),
    ]
    run = HeldRun(path=tmp_path / "run.h5", record=record(cells))
    assert improved_on(run, [one.address for one in cells]) == {"first"}
    assert improved_on(run, ["first", "reties"]) == frozenset()
