"""Tables of planes and of papers, and the best value of a column."""

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
from orthoflow_provenance.document import RecordedCell

from orthoflow.products import Planes, ScanRow, Spread, Thickness
from orthoflow.report.paper_tables import bibtex, paper_files
from orthoflow.report.rankings import Value, badness, rank
from orthoflow.report.tables import PlaneTables, plane_tables
from tests.report_runs import cell, compared_run, given, run_of


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
    assert "1.10 ± 0.10" in files["results.md"]
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
