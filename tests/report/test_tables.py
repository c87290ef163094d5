"""Tables of planes, of papers and of all that differs between two runs; the best value."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from orthoflow_plugins.hooks import orthoflow_methods
from orthoflow_plugins.inspect.truth import InspectTruth
from orthoflow_provenance.document import RecordedCell, RecordedFile
from syrupy.assertion import SnapshotAssertion

from orthoflow.products import Planes, ScanRow, Spread, Thickness
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
from orthoflow.report.paper_tables import bibtex, paper_files
from orthoflow.report.rankings import Value, badness, rank
from orthoflow.report.rendering import environment
from orthoflow.report.summaries import answers
from orthoflow.report.tables import PlaneTables, plane_tables
from tests.compared_runs import compared
from tests.compared_runs import number as metric
from tests.report_runs import (
    cell,
    compared_resolved,
    compared_run,
    distance,
    given,
    metrics,
    record,
    run_of,
)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    return paper_files(compared_run(tmp_path_factory.mktemp("run")))


def test_a_tidy_table_has_a_row_per_value_with_unit_and_better_side(files: dict[str, str]) -> None:
    rows = list(csv.DictReader(io.StringIO(files["results.csv"])))
    [fine] = [row for row in rows if (row["plane"], row["metric"]) == ("fine", "rms_mm")]
    assert (fine["step"], fine["unit"], fine["better"]) == ("plane", "mm", "lower")
    assert (float(fine["value"]), int(fine["n_repeats"])) == (pytest.approx(1.1), 3)
    assert float(fine["standard_deviation"]) == pytest.approx(0.1)


def test_latex_and_markdown_have_the_same_numbers(files: dict[str, str]) -> None:
    assert r"1.10 $\pm$ 0.10" in files["results.tex"]
    # Names to the left, numbers to the right.
    assert r"\begin{tabular}{llrrr}" in files["results.tex"]
    assert "RMS / mm | lower | 1.10 ± 0.10 |" in files["results.md"]
    body = files["results.tex"].partition(r"\midrule")[2].partition(r"\bottomrule")[0]
    assert {line.count("&") for line in body.splitlines() if line} == {4}
    # The name of the run is `toy <run>`, and a record may hold anything.
    assert "&lt;run>" in files["results.md"]
    assert "_" not in files["results.tex"].replace(r"\_", "")


def test_all_citations_of_the_methods_become_entries_with_author_and_year() -> None:
    texts = {text for spec in orthoflow_methods() for text in _citations(spec.target)}
    assert len(texts) > 10
    entries = bibtex({text: ["method"] for text in texts})
    assert entries.count("{") == entries.count("}")
    keys = [line for line in entries.splitlines() if line.startswith("@misc{")]
    # Standards and manuals have no year.
    assert len(keys) == len(set(keys)) == entries.count("  year = {") + 5
    assert entries.count("  author = {") == entries.count("  year = {")


def _citations(target: str) -> tuple[str, ...]:
    from importlib import import_module

    module, _, name = target.partition(":")
    found: tuple[str, ...] = getattr(import_module(module), name).citations
    return found


def test_one_paper_is_one_entry_and_signs_of_latex_mean_nothing() -> None:
    found = bibtex(
        {
            "A_b and C 2001, Title & more, doi:10.1/X": ["m.one: 3"],
            "A_b 2001, doi:10.1/x": ["m.two"],
            "no year at all": ["m.three"],
        }
    )
    assert found.count("@misc") == 2
    assert r"title = {Title \& more}" in found
    assert r"author = {A\_b and C}" in found
    assert "note = {m.one: 3; m.two}" in found
    assert "title = {no year at all}" in found


def test_of_a_run_without_datasets_there_is_no_table_over_them(files: dict[str, str]) -> None:
    assert sorted(files) == ["citations.bib", "results.csv", "results.md", "results.tex"]


FABRIC = Spread(low=0.0, high=0.3, n_points=70, sigma_m=0.004, name="fabric")
PLASTER = Spread(low=0.3, high=1.0, n_points=90, sigma_m=0.001, name="plaster")


def wall_and_floor() -> Planes:
    wall = np.array([[0, 2, 3], [0, 2, 0], [4, 2, 0], [4, 2, 3]], dtype=np.float64)
    covariance = np.zeros((2, 4, 4))
    covariance[0, 3, 3] = 0.0005**2
    return Planes(
        normal=np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0]]),
        offset=np.array([-2.0, 0.0]),
        corners=np.array([wall, wall[:, [0, 2, 1]]]),
        covariance=covariance,
        n_points=np.array([1200, 800]),
        rms_m=np.array([0.002, 0.003]),
        up=np.array([0.0, 0.0, 1.0]),
        names=("wall 0", "floor"),
        viewpoint="stations",
    )


def tables(*made: tuple[RecordedCell, Planes]) -> list[PlaneTables]:
    """The tables of cells that give planes."""
    products = {(cell.address, "planes"): planes for cell, planes in made}
    return list(plane_tables(run_of(*(cell for cell, _ in made), products=products)))


def giving(address: str, digest: str, **more: Any) -> RecordedCell:
    return cell(address, outputs={"planes": given("", digest, "planes")}, **more)


def test_thickness_and_materials_stand_in_the_tables() -> None:
    thickness = Thickness(
        sigma_m=0.002, width_95_m=0.008, scan_step_m=0.005, material=(FABRIC, PLASTER)
    )
    row = ScanRow(row=7, scan=1, n_points=40, sigma_m=0.001, material=(PLASTER,))
    planes = replace(wall_and_floor(), thickness=(thickness, None), scan_row=row)
    (found,) = tables((giving("plane@plane=toy", "a"), planes))
    assert [row[-2:] for row in found.planes.rows] == [("2.00", "5.00"), ("-", "-")]
    assert found.materials.rows == (
        ("wall 0", "fabric", "70", "4.00"),
        ("wall 0", "plaster", "90", "1.00"),
        ("row 7 of scan 1, wall 0", "plaster", "90", "1.00"),
    )


def test_planes_state_where_their_sides_come_from() -> None:
    planes = wall_and_floor()
    # Sides that photos found one by one: a table said `guess`, as the planes began.
    mixed = replace(planes, viewpoint="guess", side_from=("photos", "guess"))
    found = tables(
        (giving("plane", "a"), planes),
        (giving("turned", "b"), replace(planes, viewpoint="photos")),
        (giving("moved", "c"), replace(planes, offset=np.array([-2.5, 0.0]))),
        (giving("mixed", "e"), mixed),
    )
    assert [(table.cell, table.viewpoint) for table in found] == [
        ("plane", "stations"),
        ("turned", "photos"),
        ("moved", "stations"),
        ("mixed", "photos (1), guess (1)"),
    ]
    assert not any(table.taken_further(found) for table in found)


def test_planes_that_a_later_step_changed_are_taken_further() -> None:
    planes = wall_and_floor()
    sides = giving("sides", "b", inputs={"planes": given("plane.planes", "a", "planes")})
    found = tables(
        (giving("plane", "a"), planes),
        (sides, replace(planes, viewpoint="photos")),
    )
    assert [(one.cell, one.taken_further(found)) for one in found] == [
        ("plane", True),
        ("sides", False),
    ]


# A value without repeats, or with repeats of a standard deviation.
_Given = float | tuple[float, float]


def of(given: _Given, group: str = "", n_items: float = math.nan) -> Value:
    sort, spread = given if isinstance(given, tuple) else (given, 0.0)
    return Value(text=str(sort), sort=sort, spread=spread, group=group, n_items=n_items)


def marks(values: Sequence[Value], better: str = "lower", unit: str = "1") -> str:
    """The first letter of each mark: best, near the best, over fewer items, none."""
    letters = {"BEST": "b", "NEAR": "n", "FEWER": "f", "NONE": "-"}
    return "".join(letters[value.mark.name] for value in rank(values, better, unit))


@pytest.mark.parametrize(
    ("values", "found", "better"),
    [
        ((3.0, 1.0, 2.0), "-b-", "lower"),
        ((3.0, 1.0, 2.0), "b--", "higher"),
        # Signed errors count by their size, and a ratio is as bad at half as at double.
        ((-3.0, 1.0, -0.5), "--b", "lower"),
        ((0.5, 1.1, 2.0, 0.0), "-b--", "one"),
        ((0.5, 2.0 + 1e-9, 4.0), "nn-", "one"),
        # Level values have no best, and nobody leads in what several share.
        ((1.0,), "-", "lower"),
        ((1.0, -1.0), "--", "lower"),
        ((1.0, 1.0, 2.0), "nn-", "lower"),
        ((1.0, math.inf, 2.0), "b--", "lower"),
        ((1.0, 2.0), "--", ""),
        # A record may contain anything.
        ((1.0, 2.0), "--", "sideways"),
        # Without scatter 1 % is no difference, nor is rounding, whatever its share.
        ((1.238, 1.239, 2.0), "nn-", "lower"),
        ((1.0, 1.011, 2.0), "b--", "lower"),
        ((500.0, 501.0, 900.0), "nn-", "lower"),
        ((1e-13, 4.5e-13, 0.2), "nn-", "lower"),
        (((7.414482203957, 7e-16), (7.414482243713, 7e-16), (9.0, 7e-16)), "nn-", "lower"),
        # Half apart: 0.3 and 0.4 in quadrature.
        (((1.0, 0.3), (1.5, 0.4), 9.0), "nn-", "lower"),
        (((1.0, 0.3), (1.5, 0.39), 9.0), "b--", "lower"),
        (((1.0, 0.0), (1.5, 0.5), 9.0), "nn-", "lower"),
        (((1.0, 0.49), (1.5, 0.0), 9.0), "b--", "lower"),
        # Where one of two scatters, the larger of both: its spread, and a hundredth.
        ((100.0, (100.9, 0.1), (200.0, 0.1)), "nn-", "lower"),
        (((100.0, 3.0), 102.9, 200.0), "nn-", "lower"),
        (((100.0, 3.0), 103.1, 200.0), "b--", "lower"),
        (((-1.0, 0.1), (1.12, 0.1), (-3.0, 0.1)), "nn-", "lower"),
        # Single runs are not ranked.
        (((1.0, 0.1), (3.0, math.nan), (9.0, 0.1)), "---", "lower"),
    ],
)
def test_the_best_is_marked_where_it_is_shown(
    values: tuple[_Given, ...], found: str, better: str
) -> None:
    assert marks([of(value) for value in values], better) == found


@pytest.mark.parametrize(
    ("unit", "values", "found"),
    [("MiB", (10.0, 10.9, 11.1), "nn-"), ("s", (1.0, 1.29, 1.31), "nn-")],
)
def test_costs_that_another_run_could_turn_round_are_level(
    unit: str, values: tuple[float, ...], found: str
) -> None:
    assert marks([of(value) for value in values], unit=unit) == found
    assert marks([of((value, 0.01)) for value in values], unit=unit) == found


def test_a_value_over_fewer_photos_is_not_ranked() -> None:
    assert marks([of(7.0, "", 2), of(9.0, "", 3), of(11.0, "", 3)]) == "fb-"
    assert marks([of(7.0, "", 2), of(9.0, "", 3)]) == "f-"
    # Of other data there are other photos; and what counts none is ranked.
    assert marks([of(7.0, "a", 2), of(9.0, "b", 3), of(8.0, "a", 2)]) == "b--"
    assert marks([of(7.0), of(9.0, "", 3)]) == "b-"


def test_groups_are_ranked_apart_and_what_is_absent_is_not_ranked() -> None:
    assert marks([of(1.0, "a"), of(9.0, "b"), of(2.0, "a"), of(8.0, "b")]) == "b--b"
    assert marks([of(1.0), Value(), of(2.0)]) == "b--"
    single = of((3.0, math.nan), "b")
    assert marks([of((1.0, 0.1), "a"), of((9.0, 0.1), "a"), single]) == "b--"


def test_methods_declare_what_is_good() -> None:
    found = {spec.name: spec.better for spec in InspectTruth.metric_specs()}
    assert found["pose_error_over_sigma"] == "one"
    assert found["label_f1"] == "higher"
    assert found["wall_[0-9]*_rmse_[uv]_mm"] is found["rmse_[uv]_mm"] == "lower"
    assert found["n_photos"] == ""


def test_badness_is_smaller_the_better_a_value_is() -> None:
    assert badness(-2.0, "lower") == 2.0
    assert badness(2.0, "higher") == -2.0
    assert badness(0.5, "one") == badness(2.0, "one")
    assert badness(0.0, "one") == badness(-1.0, "one") == math.inf
    with pytest.raises(ValueError, match="cannot be ranked"):
        badness(1.0, "")


# The baseline, headline numbers, and all that differs between two runs ----------------------------


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
