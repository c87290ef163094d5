"""How colours of photos are balanced: steps vanish, detail stays of one photo, parallax is kept."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.mosaic.exposures import Radii, estimate
from orthoflow_plugins.mosaic.light import BlockLight, light_of_levels, lit
from orthoflow_plugins.mosaic.seams import MosaicSeams

from orthoflow.products import Layer, Layers, Orthoimages, Walls
from tests import inspect_scenes, samples
from tests import raster_scenes as scenes

SHAPE = (120, 240)
SPLIT = 120


def texture(seed: int = 5) -> NDArray[np.float64]:
    """Light (rows, cols, 3) of a wall, 0.1 to 0.5, with detail of a cell and of many cells."""
    import cv2

    rng = np.random.default_rng(seed)
    coarse = cv2.resize(rng.uniform(0.0, 1.0, (6, 12, 3)), SHAPE[::-1])
    return np.asarray(0.12 + 0.25 * coarse + 0.13 * rng.uniform(0.0, 1.0, (*SHAPE, 3)))


def layer(name: str, columns: slice, light: NDArray[np.float64], quality: float) -> Layer:
    """A layer of 16 bits that paints some columns."""
    level = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1.0 / 2.4) - 0.055)
    rgb = np.rint(65535.0 * level).astype(np.uint16)
    return inspect_scenes.painted_layer(name, columns, rgb, quality)


def two_photos(
    right: NDArray[np.float64] | float, wall: NDArray[np.float64] | None = None
) -> tuple[Layer, Layer]:
    """Two photos that overlap in the middle; the second has another light. Seam at column 160."""
    light = texture() if wall is None else wall
    return (
        layer("left", slice(0, 160), light, 2.0),
        layer("right", slice(80, SHAPE[1]), light * right, 1.0),
    )


def mosaic(
    folder: Path, layers: tuple[Layer, ...], walls: Walls | None = None, **params: object
) -> tuple[Orthoimages, dict[str, float]]:
    ctx = scenes.context(folder)
    chosen = MosaicSeams.Params.model_validate({"island_cells_min": 1} | params)
    out = MosaicSeams().run(MosaicSeams.In(layers=Layers(layers=layers), walls=walls), chosen, ctx)
    return out.orthoimages, {metric.name: metric.value for metric in ctx.metrics}


def factors(images: Orthoimages, layers: tuple[Layer, ...]) -> NDArray[np.float64]:
    """Logarithm (rows, cols, 3) of what became of the light of each cell of its own layer."""
    (image,) = images.images
    light = light_of_levels(65535)
    own = np.choose(image.source[..., None], [item.rgb for item in layers])
    return np.log(light[image.rgb]).astype(np.float64) - np.log(light[own])


def test_light_goes_to_levels_and_back() -> None:
    for dtype in (np.uint8, np.uint16):
        levels = np.arange(np.iinfo(dtype).max + 1, dtype=dtype)
        colours = np.stack([levels] * 3, axis=1)
        np.testing.assert_array_equal(lit(colours, np.zeros((len(levels), 3), np.float32)), colours)
    half = lit(np.array([[188, 188, 188]], np.uint8), np.full((1, 3), np.log(0.5), np.float32))
    # sRGB 188 is light 0.503, and half of that is level 137.
    assert half.tolist() == [[137, 137, 137]]


def test_steps_along_seams_vanish_and_sixteen_bits_stay(tmp_path: Path) -> None:
    columns = np.linspace(-1.0, 1.0, SHAPE[1])[None, :, None]
    layers = two_photos(1.3 * (1.0 - 0.15 * columns**2))
    images, metrics = mosaic(tmp_path, layers)
    assert metrics["seam_step_mean_delta_e"] < 0.1 * metrics["seam_step_untouched_delta_e"]
    assert images.images[0].rgb.dtype == np.uint16
    gains = images.details["gains"]
    assert isinstance(gains, dict)
    assert set(gains["wall 0"]) == {"left", "right"}


def test_detail_is_of_one_photo_everywhere(tmp_path: Path) -> None:
    # What was done to a photo's light is smooth: nothing of the other photo's detail is in it.
    rng = np.random.default_rng(8)
    layers = two_photos(0.7 * rng.uniform(0.9, 1.1, (*SHAPE, 1)))
    images, metrics = mosaic(tmp_path, layers)
    assert metrics["gain_max"] / metrics["gain_min"] == pytest.approx(1.0 / 0.7, rel=0.05)
    done = factors(images, layers)
    for axis in (0, 1):
        steps = np.abs(np.diff(done, axis=axis))
        is_seam = np.diff(images.images[0].source, axis=axis)[..., None] != 0
        # A hundredth from cell to cell, where the photos' own detail differs by a fifth.
        assert steps[~np.broadcast_to(is_seam, steps.shape)].max() < 0.01


def test_colours_are_those_of_one_exposure(tmp_path: Path) -> None:
    columns = np.linspace(-1.0, 1.0, SHAPE[1])[None, :, None]
    layers = two_photos(1.3 + 0.05 * columns)
    images, _ = mosaic(tmp_path, layers)
    light = light_of_levels(65535)[images.images[0].rgb]
    ratio = np.log(light / texture()).mean(axis=2)
    # What no overlap shows of a field, a few hundredths at the far rim, stays as it is.
    assert np.abs(ratio - np.median(ratio)).max() < 0.04


def test_photos_that_agree_stay_untouched(tmp_path: Path) -> None:
    layers = two_photos(1.005)
    images, metrics = mosaic(tmp_path, layers)
    assert not factors(images, layers).any()
    assert "gain_max" not in metrics
    assert images.details == {}


def test_without_gains_colours_stay_untouched(tmp_path: Path) -> None:
    layers = two_photos(0.5)
    images, _ = mosaic(tmp_path, layers, gains="none")
    assert not factors(images, layers).any()


def surface(depth_m: NDArray[np.float32]) -> Walls:
    frame = inspect_scenes.frame(shape=SHAPE)
    wall = samples.wall(frame, depth_m=depth_m, mask=np.ones(SHAPE, dtype=np.uint8))
    return replace(inspect_scenes.walls(), walls=(wall,))


def test_what_parallax_separates_is_not_taken_for_light(tmp_path: Path) -> None:
    # At the seam stands a post that the second photo shows elsewhere: there, it sees the wall.
    wall = texture()
    post = np.s_[40:80, 150:170]
    one, other = wall.copy(), 0.8 * wall
    one[post] *= 0.25
    layers = (layer("left", slice(0, 160), one, 2.0), layer("right", slice(80, 240), other, 1.0))
    depth_m = np.zeros(SHAPE, dtype=np.float32)
    depth_m[post] = 0.2
    plain = two_photos(0.8)
    for walls in (None, surface(depth_m)):
        images, _ = mosaic(tmp_path, layers, walls)
        beside, _ = mosaic(tmp_path, plain, walls)
        pulled = np.abs(factors(images, layers) - factors(beside, plain))
        # Taken for light, the post would pull by half the logarithm of 4, 0.7.
        assert pulled.max() < 0.06


def radial(shape: tuple[int, int], at: tuple[float, float]) -> NDArray[np.float32]:
    rows, columns = np.indices(shape)
    return (np.hypot(rows - at[0], columns - at[1]) / 40.0).astype(np.float32)


def test_exposures_and_the_loss_of_a_lens_are_found_in_spite_of_outliers() -> None:
    rng = np.random.default_rng(2)
    wall = rng.normal(-1.5, 0.4, (40, 100, 3))
    true = np.array([0.2, -0.3, 0.1])
    lights, radii = [], []
    for k, first in enumerate((0, 25, 50)):
        seen = radial((40, 50), (19.5, 24.5))
        bent = 0.1 * seen.astype(np.float64) ** 2 + 0.3 * seen.astype(np.float64) ** 4
        logs = wall[:, first : first + 50] + true[k] - bent[..., None]
        logs += rng.normal(0.0, 0.01, logs.shape)
        logs[rng.random(logs.shape[:2]) < 0.05] += 0.8
        lights.append(
            BlockLight(
                box=(slice(0, 40), slice(first, first + 50)), log_light=logs.astype(np.float32)
            )
        )
        radii.append(Radii(values=seen, lens=0))
    found = estimate(lights, radii)
    apart = found.exposures.mean(axis=1) + true
    np.testing.assert_allclose(apart, apart.mean(), atol=0.02)
    at = np.linspace(0.0, 0.75, 6)
    loss = found.lenses[0, 0] * at**2 + found.lenses[0, 1] * at**4
    np.testing.assert_allclose(loss, 0.1 * at**2 + 0.3 * at**4, atol=0.02)
    # Where nothing overlaps nothing is changed.
    alone = estimate(lights[:1], radii[:1])
    assert not alone.exposures.any()
    assert not alone.nodes.any()
