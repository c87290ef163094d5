"""What check points say that mean another raster, unit or system than the orthoimage's."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.inspect import point_doubts
from orthoflow_plugins.inspect.checkpoints import InspectCheckpoints
from orthoflow_plugins.inspect.point_doubts import Missed, with_reasons

from orthoflow.errors import MethodError
from orthoflow.products import CheckPoints, Orthoimages
from orthoflow.sdk import StepContext
from tests import inspect_scenes
from tests.inspect_scenes import GSD_M, points_at

PLACES = np.array([[50.0, 40.0], [200.0, 90.0], [300.0, 220.0], [120.0, 150.0]])


def surveyed() -> NDArray[np.float64]:
    return inspect_scenes.frame().world_from_wall(PLACES, 0.01)


def said(folder: Path, points: CheckPoints) -> tuple[list[str], dict[str, float]]:
    ctx = StepContext(rng=np.random.default_rng(0), cores=1, scratch=folder)
    inputs = InspectCheckpoints.In(
        checkpoints=points,
        walls=inspect_scenes.walls(),
        orthoimages=Orthoimages(images=(inspect_scenes.displaced(0, 0),)),
    )
    InspectCheckpoints().run(inputs, InspectCheckpoints.Params(), ctx)
    return ctx.warnings, {item.name: item.value for item in ctx.metrics}


@pytest.mark.parametrize(
    ("n_points", "share", "is_told"),
    [(4, 0.92, True), (4, 0.88, False), (3, 1.0, True), (2, 1.0, False)],
)
def test_three_points_tell_another_raster_where_nine_tenths_of_what_they_are_off_is_alike(
    tmp_path: Path, n_points: int, share: float, is_told: bool
) -> None:
    places = PLACES[:n_points]
    # Turned about their centre, they are off in no direction and on cells of the same size.
    turned = (places - places.mean(axis=0)) @ np.array([[0.0, 1.0], [-1.0, 0.0]])
    size = np.sqrt((turned**2).sum(axis=1).mean())
    off = np.array([24.0, -32.0]) + 40.0 * np.sqrt(1.0 / share**2 - 1.0) / size * turned
    warnings, metrics = said(tmp_path, points_at(surveyed()[:n_points], pixels=places + off))
    assert metrics["rms_mm"] == pytest.approx(1e3 * GSD_M * 40.0 / share)
    assert [("below the survey" in warning) for warning in warnings] == [True] * is_told


def test_points_in_another_unit_are_told(tmp_path: Path) -> None:
    far = inspect_scenes.frame().world_from_wall(100.0 * PLACES, 0.0)
    warnings, _ = said(tmp_path, points_at(far, pixels=PLACES))
    assert len(warnings) == 1
    assert warnings[0].startswith("4 of 4 check points are farther from their wall than it is long")
    assert "check `unit`" in warnings[0]


def test_what_was_shown_holds_for_cells_of_any_size(tmp_path: Path) -> None:
    off = np.array([[1.5, 0.0], [1.5, 0.0], [0.0, -2.0], [0.0, -2.0]])
    shown = inspect_scenes.frame().world_from_wall(PLACES + off, 0.02)
    points = points_at(surveyed(), pixels=np.full((4, 2), np.nan))
    warnings, metrics = said(tmp_path, replace(points, shown_world=shown))
    assert warnings == []
    assert metrics["n_found"] == 4
    assert metrics["mean_x_mm"] == pytest.approx(0.75e3 * GSD_M)
    assert metrics["mean_y_mm"] == pytest.approx(-1e3 * GSD_M)


def test_clicked_points_that_nobody_surveyed_are_no_check(tmp_path: Path) -> None:
    points = points_at(surveyed(), pixels=np.full((4, 2), np.nan))
    own = surveyed()
    with pytest.raises(MethodError, match="enter the surveyed coordinates"):
        said(tmp_path, replace(points, shown_world=own))
    own[3, 0] += 0.001
    (warning,), metrics = said(tmp_path, replace(points, shown_world=own))
    assert warning.startswith(
        "the coordinates x, y, z of 3 of 4 check points were taken from the orthoimage"
    )
    assert metrics["n_found"] == 4


@pytest.mark.parametrize(
    ("factor", "aside", "told"),
    [
        (1.03, 30.0, "measured in an image with cells"),
        (1.015, 30.0, "below the survey"),
        (0.97, 30.0, "measured in an image with cells"),
        (1.0, 15.0, "below the survey"),
    ],
)
def test_cells_of_another_size_are_so_by_two_hundredths(
    tmp_path: Path, factor: float, aside: float, told: str
) -> None:
    middle = PLACES.mean(axis=0)
    (warning,), _ = said(
        tmp_path, points_at(surveyed(), pixels=middle + factor * (PLACES - middle) + aside)
    )
    assert told in warning


@pytest.mark.parametrize("side", [(-1.0, 0.3), (2.0, 0.3), (0.3, -1.0), (0.3, 2.0)])
def test_points_are_far_beyond_the_length_of_their_wall(side: tuple[float, float]) -> None:
    image = inspect_scenes.displaced(0, 0)
    picture: Any = SimpleNamespace(frame=image.frame)
    rows, columns = image.frame.shape
    for further, is_far in ((0.95, False), (1.05, True)):
        off = further * max(rows, columns)
        place = [
            -off if part < 0.0 else size + off if part > 1.0 else part * size
            for part, size in zip(side, (columns, rows), strict=True)
        ]
        point: Any = SimpleNamespace(expected=np.array(place))
        expected = GSD_M * off if is_far else 0.0
        assert point_doubts._beyond_m(point, picture) == pytest.approx(expected)
    assert point_doubts._beyond_m(point, None) == 0.0


def test_four_unused_points_are_named_and_the_others_counted() -> None:
    missed = {f"P{k}": Missed("2 mm below wall") for k in range(6)}
    named = "P0 (2 mm below wall), P1 (2 mm below wall), P2 (2 mm below wall), P3 (2 mm below wall)"
    assert with_reasons(missed) == f"{named} and 2 more, see the log"
    assert with_reasons(dict([*missed.items()][:4])) == named
