"""Numbers and pictures of an inspection, compared with their definitions for a few values."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.axes import Axes
from orthoflow_plugins.inspect.figures import (
    enlargement,
    vector_map,
)
from orthoflow_plugins.inspect.findings import (
    check_findings,
    displacement_findings,
    length_findings,
    report,
)

from orthoflow.products import Finding
from tests.inspect_scenes import image_of
from tests.raster_scenes import context, numbers

SHIFT_M = np.array([[0.001, 0.002], [-0.003, 0.0], [0.002, -0.001], [0.02, 0.004], [0.0, 0.001]])


def test_displacements_are_summed_up_by_axis_and_length() -> None:
    found = {item.name: item for item in displacement_findings(SHIFT_M, 0.004, 3, prefix="a_")}
    mm = 1e3 * SHIFT_M
    rmse = np.sqrt((mm**2).mean(axis=0))
    expected = {}
    for axis, name in enumerate("xy"):
        values = mm[:, axis]
        middle = np.median(values)
        expected |= {
            f"a_rmse_{name}_mm": (rmse[axis], "mm"),
            f"a_rmse_{name}_cells": (rmse[axis] / 4.0, "cells"),
            f"a_mean_{name}_mm": (values.mean(), "mm"),
            f"a_nmad_{name}_mm": (1.4826 * np.median(np.abs(values - middle)), "mm"),
            f"a_max_{name}_mm": (np.abs(values).max(), "mm"),
            f"a_beyond_2rmse_{name}_share": (np.mean(np.abs(values) > 2 * rmse[axis]), "1"),
        }
    assert found.keys() == expected.keys()
    assert expected["a_beyond_2rmse_x_share"][0] == 0.2
    for name, (value, unit) in expected.items():
        assert found[name].value == pytest.approx(value, rel=1e-4), name
        assert (found[name].unit, found[name].wall) == (unit, 3)


def test_check_points_are_summed_up_by_lengths_and_outliers() -> None:
    found = {item.name: item for item in check_findings(SHIFT_M, 0.004, prefix="flat_")}
    length = 1e3 * np.hypot(*SHIFT_M.T)
    rms = np.sqrt((length**2).mean())
    mean_shift = 1e3 * np.hypot(*SHIFT_M.mean(axis=0))
    out = length > 2.0 * rms
    assert out.sum() == 1
    left = np.sqrt((length[~out] ** 2).mean())
    expected = {
        "n_found": 5.0,
        "rms_mm": rms,
        "sd_mm": length.std(ddof=1),
        "mean_shift_mm": mean_shift,
        "mean_shift_share": mean_shift / rms,
        "n_outliers_once": 1.0,
        "n_outliers_iterated": 1.0,
        "rms_after_once_mm": left,
        "rms_after_iterated_mm": left,
    }
    for name, value in expected.items():
        assert found[f"flat_{name}"].value == pytest.approx(value), name
        assert found[f"flat_{name}"].unit == ("mm" if name.endswith("_mm") else "1")
    assert found["flat_rmse_x_cells"].wall == -1
    alone = {item.name: item.value for item in check_findings(SHIFT_M[:1], 0.004)}
    assert "sd_mm" not in alone
    assert alone["mean_shift_share"] == pytest.approx(1.0)
    still = {item.name: item.value for item in check_findings(np.zeros((3, 2)), 0.004)}
    assert still["mean_shift_share"] == 0.0


def test_a_scale_shows_in_every_length_and_a_shift_in_none() -> None:
    rng = np.random.default_rng(4)
    places_m, wall = rng.uniform(0.0, 5.0, (40, 2)), np.repeat([0, 3], 20)
    # The walls are shifted differently, so lengths between them are meaningless.
    shift_m = 0.002 * places_m + np.where(wall == 0, 0.01, -0.03)[:, None]
    found = {item.name: item.value for item in length_findings(places_m, shift_m, wall)}
    assert found["length_error_rms_share"] == pytest.approx(0.002)
    assert found["length_error_max_share"] == pytest.approx(0.002)
    # Short lengths are ignored, and some of the 2 x 190 pairs are shorter than a quarter of the
    # longest.
    assert 250 < found["n_lengths"] < 380
    one_off = np.zeros_like(shift_m)
    one_off[0, 0] = 0.01
    worst = {item.name: item.value for item in length_findings(places_m, one_off, wall)}
    assert 0.002 < worst["length_error_max_share"] < 0.01
    assert length_findings(places_m[:1], shift_m[:1], wall[:1]) == []


def test_the_main_wall_has_plain_names_and_others_say_whose_they_are(tmp_path: Path) -> None:
    ctx = context(tmp_path)
    values = [
        *(("rmse_u_mm", 1.0, 1), ("rmse_u_mm", 2.0, 0), ("rmse_u_mm", 3.0, -1)),
        *(("p99_mm", 4.0, 1), ("p99_mm", 5.0, 0)),
        *(("n_photos", 6.0, -1), ("n_points[a]", 7.0, -1)),
    ]
    findings = [
        Finding(name=name, value=value, unit="mm", wall=wall) for name, value, wall in values
    ]
    report(findings, 1, {0: 3, 1: 8}, ctx)
    assert numbers(ctx) == {
        "rmse_u_mm": 1.0,
        "wall_3_rmse_u_mm": 2.0,
        "all_rmse_u_mm": 3.0,
        "p99_mm": 4.0,
        "n_photos": 6.0,
    }
    assert {metric.unit for metric in ctx.metrics} == {"mm"}


@pytest.fixture
def arrows(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Any, ...]]:
    """Collect tails, components and colours of drawn arrows, and the reference arrow."""
    kept: list[tuple[Any, ...]] = []
    quiver, key = Axes.quiver, Axes.quiverkey

    def draw(self: Axes, *args: Any, **settings: Any) -> Any:
        kept.append((np.array(args[:2]).T, np.array(args[2:]).T, settings["color"]))
        return quiver(self, *args, **settings)

    def draw_key(self: Axes, *args: Any, **settings: Any) -> Any:
        kept.append(args[3:])
        return key(self, *args, **settings)

    monkeypatch.setattr(Axes, "quiver", draw)
    monkeypatch.setattr(Axes, "quiverkey", draw_key)
    return kept


def test_arrows_point_from_true_to_shown_places(arrows: list[tuple[Any, ...]]) -> None:
    image = image_of(np.full((250, 250), 80.0))
    places = np.array([[50.0, 60.0], [150.0, 100.0], [100.0, 200.0]])
    shift_cells = np.array([[2.0, 0.0], [0.0, 2.0], [-8.0, 0.0]])
    times = enlargement(shift_cells, image)
    # The 95th percentile is drawn with at most 6 % of the side: 15 cells for 7.4 give a factor of
    # 2, not 5.
    assert times == 2.0
    vector_map(image, places, shift_cells)
    (tails, components, colours), (length, label) = arrows
    np.testing.assert_allclose(components, times * shift_cells)
    np.testing.assert_allclose(tails + components, places)
    # An arrow of four times the median is red; those of the median length are green.
    assert colours[0] == colours[1] != colours[2]
    cell_mm = 1e3 * image.frame.gsd_m
    assert label == f"{length / times * cell_mm:g} mm"
    # If there are many arrows, every nth is drawn; those longer than the median are yellow.
    many = np.tile([[1.0, 0.0], [1.0, 0.0], [1.5, 0.0]], (1_100, 1))
    vector_map(image, np.full((3_300, 2), 100.0), many)
    tails, components, colours = arrows[2]
    assert len(tails) == len(components) == 1_650
    assert len(set(colours)) == 2
