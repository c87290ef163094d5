"""Records of one comparison as one table: the same cells once, paired by what they call."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from orthoflow_provenance.document import Metric, RecordedCell

import orthoflow
from orthoflow.products import Inspection
from orthoflow.records.runs import Run
from orthoflow.records.tables import RunSet, join_runs, over_common_points
from tests.report_runs import cell, given, record
from tests.studios import Studio, open_studio


def plane(
    name: str, tolerance_m: float, rms_mm: float, repeat: int = 0, **more: object
) -> RecordedCell:
    return cell(
        f"plane@plane={name}#{repeat}" if repeat else f"plane@plane={name}",
        repeat=repeat,
        step="plane",
        method="plane.given",
        assignment={"plane": name},
        params={"tolerance_m": tolerance_m},
        inputs={"cloud": given("inputs.scan", "a", "files")},
        outputs={"planes": given("", str(rms_mm), "planes")},
        metrics=(Metric(name="rms_mm", value=rms_mm, unit="mm", better="lower"),),
        **more,
    )


def run_of(name: str, *cells: RecordedCell) -> Run:
    return Run(path=Path(name), record=record(list(cells), run_id=name))


def rms(runs: RunSet) -> list[tuple[object, ...]]:
    table = runs.metrics()
    table = table[table["metric"] == "rms_mm"]
    return list(
        table[["variant.plane", "value", "runs", "environments"]].itertuples(index=False, name=None)
    )


def test_the_same_cell_of_two_records_is_one_whatever_it_is_called() -> None:
    ours = run_of("a", plane("fine", 0.01, 1.0), plane("wide", 0.05, 2.0))
    theirs = run_of("b", plane("wide-1", 0.05, 2.0, environment="e2"), plane("coarse", 0.1, 3.0))
    assert rms(join_runs([ours, theirs])) == [
        ("fine", 1.0, 1, 1),
        ("wide", 2.0, 2, 2),
        ("coarse", 3.0, 1, 1),
    ]
    # Names that two records use for different parameters are distinguished.
    found = rms(join_runs([ours, run_of("b", plane("fine", 0.2, 2.0))]))
    assert found[0][0] == "fine (tolerance_m=0.01)"
    assert found[2][0] == "fine (tolerance_m=0.2)"
    # Variants of one run differ by their names alone, a new version by its number.
    newer = replace(plane("other", 0.1, 1.0), method="plane.other", result_version=7)
    assert join_runs([run_of("a", plane("x", 0.1, 1.0), newer)]).differing == ()
    older = replace(newer, result_version=6)
    versions = join_runs([run_of("a", newer), run_of("b", older)]).differing
    assert versions == ("plane.other.result_version",)


def test_other_data_or_another_version_is_another_cell() -> None:
    first = plane("x", 0.1, 1.0)
    for changes in (
        {"inputs": {"cloud": given("inputs.scan", "b", "files")}},
        {"result_version": first.result_version + 1},
        {"seed": 5},
        {"repeat": 1},
    ):
        other = replace(first, **changes)
        assert len(join_runs([run_of("a", first), run_of("b", other)]).cells) == 2, changes


def test_what_differs_behind_a_cell_makes_it_another_and_its_products_do_not() -> None:
    def chain(tolerance_m: float, digest: str) -> Run:
        before = plane("x", tolerance_m, 1.0)
        outputs = {"planes": given("", digest, "planes")}
        behind = cell(
            "wall@plane=x",
            step="wall",
            assignment={"plane": "x"},
            inputs={"planes": given("plane@plane=x.planes", digest, "planes")},
            metrics=(Metric(name="rms_mm", value=float(len(digest)), unit="mm"),),
        )
        return run_of(f"{tolerance_m}{digest}", replace(before, outputs=outputs), behind)

    one = join_runs([chain(0.1, "p"), chain(0.1, "rounded")])
    assert [len(same.found) for same in one.cells] == [2, 2]
    table = one.metrics().set_index(["step", "metric"])
    assert tuple(table.loc[("wall", "rms_mm"), ["value", "lowest", "highest"]]) == (1.0, 1.0, 7.0)
    assert len(join_runs([chain(0.1, "p"), chain(0.2, "p")]).cells) == 4


def test_statistics_are_over_the_union_each_cell_once() -> None:
    runs = [
        run_of("a", *(plane("x", 0.1, value, repeat=n) for n, value in enumerate((1.0, 2.0)))),
        run_of("b", *(plane("y", 0.1, value, repeat=n + 1) for n, value in enumerate((2.0, 6.0)))),
    ]
    table = join_runs(runs).statistics()
    (row,) = table[table["metric"] == "rms_mm"].to_dict("records")
    assert (row["variant.plane"], row["n"], row["median"], row["mean"]) == ("x", 3, 2.0, 3.0)
    assert (row["lowest"], row["highest"], row["better"]) == (1.0, 6.0, "lower")
    assert row["standard_deviation"] == pytest.approx(7**0.5)


def test_statistics_are_never_over_different_parameters() -> None:
    def chosen(name: str, gsd_m: float, *values: float) -> Run:
        cells = (
            replace(plane("x", 0.1, value, repeat=n), assignment={}, params={"gsd_m": gsd_m})
            for n, value in enumerate(values)
        )
        return run_of(name, *cells)

    runs = join_runs([chosen("a", 0.02, 1.0, 3.0), chosen("b", 0.02, 1.0), chosen("c", 0.008, 7.0)])
    table = runs.metrics()
    found = table[table["metric"] == "rms_mm"][["run", "plane.gsd_m", "value", "runs"]]
    wanted = [("a", 0.02, 1.0, 2), ("a", 0.02, 3.0, 1), ("c", 0.008, 7.0, 1)]
    assert list(found.itertuples(index=False, name=None)) == wanted
    table = runs.statistics()
    found = table[table["metric"] == "rms_mm"][["plane.gsd_m", "n", "mean"]]
    assert list(found.itertuples(index=False, name=None)) == [(0.02, 2, 2.0), (0.008, 1, 7.0)]


def test_the_command_and_the_library_give_one_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    studio: Studio = open_studio(tmp_path, monkeypatch)
    (studio.folder / "n.txt").write_text("1.5")
    studio.run("first", "--input", "number=n.txt")
    studio.run("second", "--input", "number=n.txt", "--set", "paint.grey=131")
    studio("runs", "--table", "all.csv", "first", "second", code=0)
    with Path("all.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    wanted = {"run", "paint.grey", "dataset", "seed", "method", "metric", "value", "unit", "better"}
    assert wanted <= rows[0].keys()
    table = orthoflow.open_runs(["first", "second"]).metrics()
    assert list(table.columns) == list(rows[0])
    assert [float(row["value"]) for row in rows] == list(table["value"])
    # The first step is the same in both, the second is not.
    counts = [(row["step"], row["runs"]) for row in rows if row["metric"] == "wall_s"]
    assert counts == [("survey", "2"), ("paint", "1"), ("paint", "1")]
    assert studio("runs", "--table", "folder.csv", ".").exit_code == 0
    assert Path("folder.csv").read_text() == Path("all.csv").read_text()
    assert studio("runs", "--table", "all.csv", "nowhere").exit_code == 2


# Check points that every method found -------------------------------------------------------------


def inspection(
    shift_mm: dict[int, tuple[float, float]], kinds: tuple[str, ...] = ("flat",)
) -> Inspection:
    """Points by number, each with its displacement; even numbers are of the first kind."""
    names = np.array([*shift_mm], dtype=np.float64)
    return Inspection(
        wall=np.zeros(len(names), dtype=np.int32),
        points_world=np.column_stack([names, np.zeros_like(names), 0.1 * names]),
        displacement_m=1e-3 * np.array([*shift_mm.values()], dtype=np.float64).reshape(-1, 2),
        kind=(names % len(kinds)).astype(np.uint8),
        kinds=kinds,
        findings=(),
    )


def test_methods_are_compared_over_the_points_that_all_of_them_show() -> None:
    found = {
        # The second method loses the point that is far off.
        "points@a": inspection({1: (3.0, 4.0), 2: (0.0, 1.0), 3: (30.0, 0.0)}),
        "points@b": inspection({2: (0.0, 2.0), 1: (-3.0, 0.0), 4: (9.0, 9.0)}),
    }
    a, b = over_common_points(found, step="points")
    assert (a.cell, a.step, a.kind) == ("points@a", "points", "")
    assert (a.n_found, a.n_common, a.n_lost) == (b.n_found, b.n_common, b.n_lost) == (3, 2, 1)
    assert a.rms_u_mm == pytest.approx(np.sqrt(9.0 / 2))
    assert a.rms_v_mm == pytest.approx(np.sqrt(17.0 / 2))
    assert a.rms_mm == pytest.approx(np.sqrt(26.0 / 2))
    assert b.rms_mm == pytest.approx(np.sqrt(13.0 / 2))


def test_classes_of_points_are_compared_apart() -> None:
    kinds = ("flat", "edge")
    found = {
        "a": inspection({0: (1.0, 0.0), 1: (5.0, 0.0), 2: (2.0, 0.0)}, kinds),
        "b": inspection({0: (3.0, 0.0), 1: (4.0, 0.0)}, kinds),
    }
    rows = {(row.kind, row.cell): row for row in over_common_points(found)}
    assert {kind for kind, _ in rows} == {"", "edge", "flat"}
    assert rows["edge", "a"].rms_mm == pytest.approx(5.0)
    assert rows["flat", "b"].rms_mm == pytest.approx(3.0)
    assert rows["flat", "a"].n_lost == 1
