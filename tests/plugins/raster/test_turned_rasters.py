"""No direction is favoured: a cloud that is turned or mirrored gives the raster that is."""

from __future__ import annotations

import dataclasses
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from orthoflow.products import PointCloud, SurfaceMask, Wall
from tests import raster_scenes as scenes
from tests.turns import OTHER_TURNS, TURNS, Turn

SHAPE = (34, 43)
SURFACES = ("median", "denoised", "nearest", "centre", "topmost", "mean", "tin")


@dataclasses.dataclass(frozen=True)
class Scattered:
    """Points on a wall of SHAPE, with a step in depth, a slope and a window."""

    places: NDArray[np.float64]
    depths_m: NDArray[np.float64]

    def cloud(self, turn: Turn) -> tuple[scenes.KnownWall, PointCloud]:
        known = dataclasses.replace(scenes.upright_wall(shape=turn.shape(SHAPE)), gsd_m=2.0**-7)
        at = turn.places(self.places, SHAPE)
        shade = 0.5 + 0.2 * np.sin(self.places[:, 0] / 2) + 0.2 * np.cos(self.places[:, 1] / 3)
        rgb = np.rint(np.stack([shade, shade**2, 1.0 - shade], axis=1) * 255.0)
        cloud = scenes.cloud_of(
            known.world(*at.T, self.depths_m),
            intensity=shade.astype(np.float32),
            rgb=rgb.astype(np.uint8),
        )
        return known, cloud


def in_window(places: NDArray[np.float64]) -> NDArray[np.bool_]:
    inside: NDArray[np.bool_] = (np.abs(places - (12.0, 22.0)) < (5.0, 4.0)).all(axis=1)
    return inside


def relief(places: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    step = np.where(places[:, 0] + 0.3 * places[:, 1] > 30.0, 0.06, 0.0)
    return step + 0.002 * places[:, 1] + rng.normal(0.0, 0.001, len(places))


@cache
def in_any_order(per_cell: float) -> Scattered:
    rng = np.random.default_rng(11)
    places = rng.uniform((0, 0), SHAPE[::-1], (round(per_cell * SHAPE[0] * SHAPE[1]), 2))
    places = places[~in_window(places)]
    return Scattered(places, relief(places, rng))


def rastered(scattered: Scattered, turn: Turn, folder: Path, **params: object) -> Wall:
    known, cloud = scattered.cloud(turn)
    walls, _ = scenes.rastered(cloud, known.planes(), folder, gsd_m=known.gsd_m, **params)
    return walls.walls[0]


def assert_turned(wall: Wall, turned: Wall, turn: Turn) -> None:
    np.testing.assert_array_equal(turned.count, turn.raster(wall.count))
    np.testing.assert_array_equal(turned.mask, turn.raster(wall.mask))
    # Coordinates are float32 from another corner, and sums run in another order: a millionth.
    for name, tolerance in (("depth_m", 2e-6), ("sigma_m", 2e-6), ("intensity", 2e-5)):
        one, other = getattr(wall, name), getattr(turned, name)
        np.testing.assert_allclose(other, turn.raster(one), atol=tolerance, err_msg=name)
    # Rounded to whole levels.
    off = np.abs(turned.rgb.astype(int) - turn.raster(wall.rgb).astype(int))
    assert off.max() <= 1
    assert (off > 0).mean() < 0.001


@pytest.mark.parametrize("turn", OTHER_TURNS, ids=str)
@pytest.mark.parametrize("surface", SURFACES)
def test_a_turned_cloud_gives_the_turned_raster(tmp_path: Path, surface: str, turn: Turn) -> None:
    scattered = in_any_order(0.8)
    wall = rastered(scattered, TURNS[0], tmp_path, surface=surface)
    if surface != "tin":
        assert 0.2 < np.mean(wall.mask == SurfaceMask.RECOVERED) < 0.5
        assert (wall.mask == SurfaceMask.VOID).any()
    assert_turned(wall, rastered(scattered, turn, tmp_path, surface=surface), turn)


@pytest.mark.parametrize("turn", OTHER_TURNS, ids=str)
def test_even_cells_that_are_all_equally_near_are_weighed_evenly(
    tmp_path: Path, turn: Turn
) -> None:
    """Every other cell is measured, in its very centre: each gap has four that are as near."""
    columns, rows = scenes.cell_centres(SHAPE)
    places = np.column_stack([columns, rows])
    places = places[(columns + rows) % 2 > 0.5]
    # Two surfaces side by side: each gap on their border has two that are as near on either.
    scattered = Scattered(places, np.where(places[:, 0] < 21.0, 0.0, 0.0625))
    wall = rastered(scattered, TURNS[0], tmp_path)
    assert_turned(wall, rastered(scattered, turn, tmp_path), turn)
    assert set(np.unique(wall.depth_m[np.isfinite(wall.depth_m)])) == {
        np.float32(0.0),
        np.float32(0.0625),
    }


@pytest.mark.parametrize("surface", ["median", "centre", "nearest"])
@pytest.mark.parametrize("in_rows", [True, False], ids=["rows", "anywhere"])
@pytest.mark.parametrize("cells", [0.6, 1.1, 1.6])
def test_what_a_raster_shows_is_where_it_is(
    tmp_path: Path, cells: float, in_rows: bool, surface: str
) -> None:
    known = dataclasses.replace(scenes.leaning_wall(shape=(150, 190)), gsd_m=0.004)
    places = scenes.points_apart(known.shape, cells, seed=round(100 * cells), in_rows=in_rows)
    shade = scenes.waves(*places.T).astype(np.float32)
    cloud = scenes.cloud_of(known.world(*places.T, np.zeros(len(places))), intensity=shade)
    params: dict[str, object] = {"gsd_m": known.gsd_m, "surface": surface}
    wall = scenes.rastered(cloud, known.planes(), tmp_path, **params)[0].walls[0]
    # A lattice of one scan may lie on one side of many cells of rules that take a point as it is.
    limit = 0.01 if surface == "median" else 0.02
    assert np.abs(scenes.shift_of_waves(wall.intensity)).max() < limit
