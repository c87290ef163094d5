"""Curves over parameters: what is a sweep, and where its points lie."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import replace
from xml.etree import ElementTree as ET

import pytest
from orthoflow_provenance.document import RecordedCell

from orthoflow.report.comparisons import comparison_table
from orthoflow.report.curves import Curve, curve_files, curves, sweeps
from orthoflow.report.rankings import Mark
from tests.report_runs import HeldRun, cell, compared_resolved, metrics, run_of


def swept(*values: float, other: object = 1) -> list[RecordedCell]:
    """Cells of `plane` with values of a tolerance, whose error is a tenth of it."""
    return [
        cell(
            f"plane@plane=tolerance_m-{value:g}",
            params={"tolerance_m": value, "seed": other},
            metrics=metrics(rms_mm=0.1 * value),
        )
        for value in values
    ]


def points(curve: Curve) -> list[tuple[float, float]]:
    return [(point.x, point.y) for line in curve.lines.values() for point in line]


def bars(curve: Curve) -> list[float]:
    found = [point.spread for line in curve.lines.values() for point in line]
    return [spread for spread in found if math.isfinite(spread)]


def test_one_value_other_differences_and_words_are_none() -> None:
    mixed = [*swept(0.02), *swept(0.1, other=2)]
    assert list(sweeps(run_of(*mixed).record.cells)) == []
    words = [cell(f"plane@plane={word}", params={"mode": word}) for word in "abc"]
    assert list(sweeps(run_of(*words).record.cells)) == []


def test_where_no_quality_hangs_on_a_sweep_what_differs_is_drawn() -> None:
    cells = [cell("plane", metrics=metrics(rms_mm=11.5))]
    cells += [
        cell(
            f"wall@wall=v{value}",
            method="raster.toy",
            params={"gsd_m": value},
            metrics=metrics(
                empty_share=0.001 / value, scan_step_mm=7.0, sigma_median_mm=100 * value
            ),
        )
        for value in (0.005, 0.01, 0.02)
    ]
    run = run_of(*cells)
    names = [curve.name for curve in curves([run])]
    assert names == ["wall.empty_share_over_wall.gsd_m", "wall.sigma_median_mm_over_wall.gsd_m"]
    table = comparison_table([run])
    assert table is not None
    marks = {value.mark for row in table.rows for value in row.values}
    assert marks == {Mark.NONE}
    # Where quality differs, the rest is not shown.
    judged = [*cells, cell("check@wall=v0.005", metrics=metrics(rmse_u_mm=1.0))]
    judged += [cell("check@wall=v0.01", metrics=metrics(rmse_u_mm=2.0))]
    assert [curve.name for curve in curves([run_of(*judged)])] == [
        "check.rmse_u_mm_over_wall.gsd_m"
    ]


def test_what_is_asked_for_is_drawn_and_what_hangs_on_no_sweep_is_not() -> None:
    cells = [
        *(
            replace(one, metrics=metrics(rms_mm=1.0, n_planes=9.0))
            for one in swept(0.02, 0.05, 0.1)
        ),
        cell("apart", metrics=metrics(rms_mm=2.0)),
    ]
    asked = compared_resolved("*.rms_mm", "*.n_planes")
    runs = run_of(*cells), run_of(*cells, workflow_resolved=asked)
    titles = [[one.title.partition(" against ")[0] for one in curves([run])] for run in runs]
    error = "points to the first plane, RMS / mm (plane)"
    assert titles == [[], [error, "planes found (plane)"]]


def test_the_baseline_of_a_sweep_is_the_filled_point() -> None:
    resolved = json.dumps({"compare": {"baseline": {"plane": "tolerance_m-0.05"}}})
    (curve,) = curves([run_of(*swept(0.02, 0.05, 0.1), workflow_resolved=resolved)])
    assert [point.x for point in curve.lines[""] if point.is_filled] == [0.05]
    (plain,) = curves([run_of(*swept(0.02, 0.05, 0.1))])
    assert not any(point.is_filled for point in plain.lines[""])


# Of rooms a value per tolerance and repeat, None where the repeat has none.
_Rooms = Mapping[str, Mapping[float, tuple[float | None, ...]]]


def curve_over(values: _Rooms, metric: str) -> Curve:
    cells = {
        room: [
            cell(
                f"plane@data={room},plane=v{x}" + (f"#{repeat}" if repeat else ""),
                params={"tolerance_m": x},
                metrics=() if y is None else metrics(**{metric: y}),
            )
            for x, found in by_x.items()
            for repeat, y in enumerate(found)
        ]
        for room, by_x in values.items()
    }
    asked = compared_resolved(f"*.{metric}")
    (curve,) = curves([run_of(*own, workflow_resolved=asked) for own in cells.values()])
    return curve


def test_a_line_is_over_the_rooms_that_all_its_points_have() -> None:
    values = {
        "calm": {1.0: (1.0, 2.0), 2.0: (2.0, 2.0)},
        # Where the hard room fails, the rest looks better.
        "dark": {1.0: (9.0, 9.0), 2.0: (None, None)},
        "wide": {1.0: (3.0, 4.0), 2.0: (4.0, 4.0)},
    }
    curve = curve_over(values, "rms_mm")
    assert points(curve) == [(1.0, 2.5), (2.0, 3.0)]
    assert curve.caption.startswith(
        "Points are medians of 2 of 3 datasets. Absolute values of errors are used. "
        "Bars are 1.4826 times the median absolute deviation. Lower is better."
    )
    # Repeats of one room are no spread of rooms.
    alone = {"calm": values["calm"], "dark": {1.0: (None,), 2.0: (None,)}}
    curve = curve_over(alone, "rms_mm")
    assert "Points are medians of 1 of 2 datasets. " in curve.caption
    assert "Bars" not in curve.caption
    assert bars(curve) == []


def test_of_what_is_found_or_not_a_curve_has_the_share_of_rooms() -> None:
    found = {
        "calm": {0.02: (1.0,) * 4, 0.05: (1.0,) * 4, 0.1: (1.0,) * 4},
        "dark": {0.02: (0.0,) * 4, 0.05: (1.0,) * 4, 0.1: (1.0,) * 4},
        "wide": {0.02: (1.0,) * 4, 0.05: (1.0,) * 4, 0.1: (1.0, 0.0, 0.0, 0.0)},
    }
    curve = curve_over(found, "main_found")
    assert points(curve) == [(0.02, pytest.approx(2 / 3)), (0.05, 1.0), (0.1, 0.75)]
    assert curve.bounds == (0.0, 1.0)
    assert bars(curve) == []
    assert "share of yes over 3 of 3 datasets" in curve.caption


def test_signed_errors_over_datasets_do_not_make_each_other_small() -> None:
    signs = {"hall": 1.0, "tower": -1.0}
    signed = {room: {x: (s * x,) for x in (0.02, 0.05, 0.1)} for room, s in signs.items()}
    curve = curve_over(signed, "plane_offset_mm")
    assert [y for _, y in points(curve)] == [0.02, 0.05, 0.1]


def test_a_page_has_twelve_curves_of_six_lines() -> None:
    def many(n_metrics: int, n_lines: int) -> HeldRun:
        names = [f"rmse_{k}_mm" for k in range(n_metrics)]
        cells = [
            cell(
                f"plane@plane=v{index}-{other}",
                params={"tolerance_m": float(index), "mode": f"m{other}"},
                metrics=metrics(**dict.fromkeys(names, float(index))),
            )
            for other in range(n_lines)
            for index in range(3)
        ]
        asked = compared_resolved("plane.rmse_*")
        return run_of(*cells, workflow_resolved=asked)

    assert len(curves([many(13, 1)])) == 12
    for n_lines, n_drawn in ((6, 6), (7, 6)):
        (curve,) = curves([many(1, n_lines)])
        assert list(curve.lines) == [f"mode=m{k}" for k in range(n_drawn)]


def test_a_drawing_stands_alone_as_a_file() -> None:
    cells = [replace(one, step="a/b") for one in swept(0.02, 0.05)]
    cells = [replace(one, assignment={"a/b": one.assignment["plane"]}) for one in cells]
    [(name, data)] = curve_files(run_of(*cells)).items()
    assert name == "01_a_b.rms_mm_over_a_b.tolerance_m.svg"
    assert ET.fromstring(data).tag.endswith("}svg")
    # The same numbers give the same bytes, in every format.
    assert curve_files(run_of(*cells)) == {name: data}
    for suffix, begin in (("pdf", b"%PDF"), ("png", b"\x89PNG")):
        [(name, data)] = curve_files(run_of(*cells), suffix).items()
        assert (name.rpartition(".")[2], data[:4]) == (suffix, begin)
