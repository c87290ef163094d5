"""Curves over parameters: what is a sweep, and where its points lie."""

from __future__ import annotations

import math
import re
from pathlib import Path

import pytest

from orthoflow.report.curves import curves, curves_over, sweeps
from tests.report_runs import HeldRun, cell, metrics, record


def swept(*values: float, repeats: int = 1, other: object = 1, failed: int = -1) -> list[object]:
    """Cells of `plane` with values of a tolerance, whose error is a tenth of it."""
    return [
        cell(
            f"plane@plane=tolerance_m-{value:g}" + (f"#{repeat}" if repeat else ""),
            params={"tolerance_m": value, "seed": other},
            metrics=metrics(rms_mm=0.1 * value + 0.001 * repeat),
            status="failed" if index == failed else "ok",
        )
        for index, value in enumerate(values)
        for repeat in range(repeats)
    ]


def held(folder: Path, cells: list[object]) -> HeldRun:
    return HeldRun(path=folder / "run.h5", record=record(cells))  # type: ignore[arg-type]


def test_variants_that_differ_in_one_number_are_a_sweep(tmp_path: Path) -> None:
    (found,) = sweeps(held(tmp_path, swept(0.02, 0.05, 0.1)).record.cells)
    assert (found.step, found.parameter) == ("plane", "tolerance_m")
    assert list(found.values.values()) == [0.02, 0.05, 0.1]


def test_two_values_other_differences_and_words_are_none(tmp_path: Path) -> None:
    assert list(sweeps(held(tmp_path, swept(0.02, 0.05)).record.cells)) == []
    mixed = [*swept(0.02, 0.05), *swept(0.1, other=2)]
    assert list(sweeps(held(tmp_path, mixed).record.cells)) == []
    words = [cell(f"plane@plane={word}", params={"mode": word}) for word in "abc"]
    assert list(sweeps(held(tmp_path, words).record.cells)) == []


def test_numbers_that_cannot_be_drawn_are_left_out(tmp_path: Path) -> None:
    # A record may hold any; these ended with an error, or with nan for a place.
    values = (0.02, 10**400, math.nan, 0.05, -1e308, 0.1)
    cells: list[object] = [
        cell(f"plane@plane=v{index}", params={"tolerance_m": value})
        for index, value in enumerate(values)
    ]
    (found,) = sweeps(held(tmp_path, cells).record.cells)
    assert sorted(found.values.values()) == [0.02, 0.05, 0.1]


def test_points_lie_in_the_order_of_values_whatever_that_of_the_variants(tmp_path: Path) -> None:
    (curve,) = curves(held(tmp_path, swept(0.1, 0.02, 0.05)))
    assert curve.title == "points to their plane, RMS / mm (plane) over plane.tolerance_m"
    assert "without repeats nobody knows" in curve.caption
    points = [
        (float(x), float(y)) for x, y in re.findall(r'cx="([0-9.]+)" cy="([0-9.]+)"', curve.svg)
    ]
    xs, ys = zip(*points, strict=True)
    assert list(xs) == sorted(xs)
    # A straight line stays one, and more error is higher on the page, whose y runs down.
    slopes = [(ys[i + 1] - ys[i]) / (xs[i + 1] - xs[i]) for i in range(2)]
    assert slopes[0] == pytest.approx(slopes[1], abs=0.01)
    assert slopes[0] < 0


def test_repeats_have_bars_and_what_failed_has_no_point(tmp_path: Path) -> None:
    (curve,) = curves(held(tmp_path, swept(0.02, 0.05, 0.1, 0.2, repeats=3, failed=3)))
    assert curve.svg.count("<circle") == 3
    assert 'class="bar line-0"' in curve.svg
    assert "means of the repeats" in curve.caption


def test_over_datasets_the_points_are_medians(tmp_path: Path) -> None:
    parts = {name: held(tmp_path, swept(0.02, 0.05, 0.1)) for name in ("hall", "stairs")}
    (curve,) = curves_over(parts)
    assert "medians of 2 datasets" in curve.caption
    assert curve.svg.count("<circle") == 3


def test_far_apart_values_lie_on_a_logarithmic_axis(tmp_path: Path) -> None:
    (curve,) = curves(held(tmp_path, swept(0.01, 0.1, 1.0)))
    assert "(logarithmic)" in curve.svg
    xs = [float(x) for x in re.findall(r'cx="([0-9.]+)"', curve.svg)]
    assert xs[1] - xs[0] == pytest.approx(xs[2] - xs[1], abs=0.2)
