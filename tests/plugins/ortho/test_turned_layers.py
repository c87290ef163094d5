"""No direction is favoured: what is turned or mirrored is painted, filled and sampled alike."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.ortho.painting import CellFootprint, sample
from orthoflow_plugins.ortho.parameters import BackwardParams, Resampling
from orthoflow_plugins.ortho.pointcloud_direct import PointcloudDirect
from orthoflow_plugins.ortho.visibility_kernels import TileVisibility

from orthoflow.geometry import frame_over
from orthoflow.products import Layer, LayerMask, Walls
from tests import raster_scenes as scenes
from tests import samples
from tests.turns import OTHER_TURNS, TURNS, Turn

SHAPE = (30, 41)


def bare_walls(known: scenes.KnownWall) -> Walls:
    frame = frame_over(known.planes().corners[0], known.normal, gsd_m=known.gsd_m)
    wall = samples.wall(frame)
    return samples.walls(wall)


def painted(turn: Turn, folder: Path, **params: object) -> Layer:
    rng = np.random.default_rng(5)
    places = rng.uniform((0, 0), SHAPE[::-1], (1000, 2))
    places = places[~(np.abs(places - (12.0, 14.0)) < (5.0, 6.0)).all(axis=1)]
    known = dataclasses.replace(scenes.upright_wall(shape=turn.shape(SHAPE)), gsd_m=2.0**-7)
    shade = 0.5 + 0.25 * np.sin(places[:, 0] / 2) + 0.25 * np.cos(places[:, 1] / 3)
    rgb = np.rint(np.stack([shade, shade**2, 1.0 - shade], axis=1) * 255.0).astype(np.uint8)
    depths_m = np.where(places[:, 0] > 25.0, 0.06, 0.0) + rng.normal(0.0, 0.001, len(places))
    cloud = scenes.cloud_of(known.world(*turn.places(places, SHAPE).T, depths_m), rgb=rgb)
    inputs = PointcloudDirect.In(walls=bare_walls(known), cloud=cloud)
    chosen = PointcloudDirect.Params.model_validate(params)
    return PointcloudDirect().run(inputs, chosen, scenes.context(folder)).layers.layers[0]


@pytest.mark.parametrize("turn", OTHER_TURNS, ids=str)
@pytest.mark.parametrize(
    ("colouring", "inpaint"),
    [
        ("topmost", "between"),
        ("centre", "between"),
        ("gaussian", "between"),
        ("median", "none"),
    ],
)
def test_a_turned_cloud_paints_the_turned_layer(
    tmp_path: Path, colouring: str, inpaint: str, turn: Turn
) -> None:
    params = {"colouring": colouring, "inpaint": inpaint, "void_limits": (8, 24, 47)}
    layer = painted(TURNS[0], tmp_path, **params)
    turned = painted(turn, tmp_path, **params)
    np.testing.assert_array_equal(turned.mask, turn.raster(layer.mask))
    assert layer.filled is not None
    assert turned.filled is not None
    np.testing.assert_array_equal(turned.filled, turn.raster(layer.filled))
    assert (layer.filled.mean() > 0.2) == (inpaint != "none")
    np.testing.assert_allclose(turned.quality, turn.raster(layer.quality), atol=1e-5)
    # Means of places that are float32 from another corner may round to the next level.
    tolerance = 1 if "between" in inpaint or colouring == "gaussian" else 0
    np.testing.assert_allclose(
        turned.rgb.astype(int), turn.raster(layer.rgb).astype(int), atol=tolerance
    )


@pytest.mark.parametrize("turn", OTHER_TURNS, ids=str)
@pytest.mark.parametrize("resampling", ["nearest", "bilinear", "cubic", "lanczos"])
def test_a_turned_photo_is_sampled_alike(resampling: Resampling, turn: Turn) -> None:
    rng = np.random.default_rng(8)
    photo = rng.integers(0, 256, (*SHAPE, 3), dtype=np.uint8)
    places = rng.uniform(8.0, 22.0, (20 * 20, 2))
    # OpenCV takes places to 1/32 of a pixel: none lies between two of these.
    places = np.rint(places * 32.0) / 32.0 + 1.0 / 256.0 * rng.choice([-1.0, 1.0], places.shape)

    def sampled(turn: Turn) -> NDArray[np.uint8]:
        u, v = turn.places(places, SHAPE).T.astype(np.float32).reshape(2, 20, 20)
        footprint = CellFootprint(
            pixels_across=1.7,
            pixels_down=1.7,
            photo_gsd_m=0.001,
            obliquity_deg=0.0,
            n_cells=400,
        )
        bounds = tuple(int(value) for value in (u.min(), u.max(), v.min(), v.max()))
        visible = TileVisibility(u, v, np.ones(u.shape, dtype=np.uint8), np.ones_like(u))
        colours = np.empty((*u.shape, 3), dtype=np.uint8)
        sample(
            turn.raster(photo),
            visible,
            (slice(0, 20), slice(0, 20)),
            bounds,
            footprint,
            BackwardParams(resampling=resampling),
            into=colours,
        )
        return colours

    # The same cells look at the same places, wherever these come to lie; blur and weights are
    # whole numbers, rounded on their way.
    np.testing.assert_allclose(
        sampled(turn).astype(int),
        sampled(TURNS[0]).astype(int),
        atol=0 if resampling == "nearest" else 2,
    )


@pytest.mark.parametrize("inpaint", ["between", "telea", "navier-stokes"])
@pytest.mark.parametrize("cells", [0.6, 1.1, 1.6])
def test_what_is_painted_from_a_cloud_is_where_it_is(
    tmp_path: Path, cells: float, inpaint: str
) -> None:
    known = dataclasses.replace(scenes.leaning_wall(shape=(150, 190)), gsd_m=0.004)
    places = scenes.points_apart(known.shape, cells, seed=round(100 * cells), in_rows=False)
    shade = np.rint(255.0 * scenes.waves(*places.T)).astype(np.uint8)
    cloud = scenes.cloud_of(
        known.world(*places.T, np.zeros(len(places))), rgb=np.repeat(shade[:, None], 3, axis=1)
    )
    layer = (
        PointcloudDirect()
        .run(
            PointcloudDirect.In(walls=bare_walls(known), cloud=cloud),
            PointcloudDirect.Params.model_validate({"inpaint": inpaint}),
            scenes.context(tmp_path),
        )
        .layers.layers[0]
    )
    is_painted = layer.mask == LayerMask.PAINTED
    shown = np.where(is_painted, layer.rgb[..., 0] / 255.0, np.nan)
    # OpenCV's fronts begin at the top left, and shift what they paint: by 0.15 cells here.
    limit_cells = 0.02 if inpaint == "between" or cells < 1.0 else 0.2
    assert np.abs(scenes.shift_of_waves(shown)).max() < limit_cells
