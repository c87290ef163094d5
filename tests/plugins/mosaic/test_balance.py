"""Colour balancing of photos: steps vanish, and detail always comes from a single photo."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.mosaic import balance as balancing
from orthoflow_plugins.mosaic.blocks import BlockLight, Blocks, block_light, common, inside, pairs
from orthoflow_plugins.mosaic.seams import MosaicSeams
from scipy.ndimage import map_coordinates

from orthoflow.geometry.levels import light_of_levels, lit, lit_shares
from orthoflow.products import Camera, Layer, LayerMask, Layers, Orthoimages, Walls
from orthoflow.testing import photographed as ms
from tests import inspect_scenes, samples
from tests import raster_scenes as scenes
from tests.method_runs import run

SHAPE = (120, 240)


def texture(seed: int = 5) -> NDArray[np.float64]:
    """Return the light (rows, cols, 3) of a wall, 0.1 to 0.5, with fine and coarse detail."""
    import cv2

    rng = np.random.default_rng(seed)
    coarse = cv2.resize(rng.uniform(0.0, 1.0, (6, 12, 3)), SHAPE[::-1])
    return np.asarray(0.12 + 0.25 * coarse + 0.13 * rng.uniform(0.0, 1.0, (*SHAPE, 3)))


def levels_of(light: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return shares of the highest level, as in IEC 61966-2-1."""
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1.0 / 2.4) - 0.055)


def layer(name: str, columns: slice, light: NDArray[np.float64], quality: float) -> Layer:
    """Return a 16-bit layer with some painted columns."""
    rgb = np.rint(65535.0 * levels_of(light)).astype(np.uint16)
    return inspect_scenes.painted_layer(name, columns, rgb, quality)


def two_photos(
    right: NDArray[np.float64] | float, wall: NDArray[np.float64] | None = None
) -> tuple[Layer, Layer]:
    """Return two photos of different brightness that overlap in the middle; seam at column 160."""
    light = texture() if wall is None else wall
    return (
        layer("left", slice(0, 160), light, 2.0),
        layer("right", slice(80, SHAPE[1]), light * right, 1.0),
    )


def mosaic(
    folder: Path, layers: tuple[Layer, ...], walls: Walls | None = None
) -> tuple[Orthoimages, dict[str, float]]:
    ctx = scenes.context(folder)
    inputs = {"layers": Layers(layers=layers), "walls": walls}
    return run(MosaicSeams, ctx, inputs, island_cells_min=1).orthoimages, scenes.numbers(ctx)


def factors(images: Orthoimages, layers: tuple[Layer, ...]) -> NDArray[np.float64]:
    """Return the logarithm (rows, cols, 3) of the factor on the light of each cell."""
    (image,) = images.images
    light = light_of_levels(65535)
    own = np.choose(image.source[..., None], [item.rgb for item in layers])
    return np.log(light[image.rgb]).astype(np.float64) - np.log(light[own])


def test_steps_along_seams_vanish_and_colours_are_those_of_one_exposure(tmp_path: Path) -> None:
    columns = np.linspace(-1.0, 1.0, SHAPE[1])[None, :, None]
    images, metrics = mosaic(tmp_path, two_photos(1.3 * (1.0 - 0.15 * columns**2)))
    assert metrics["seam_step_mean_delta_e"] < 0.1 * metrics["seam_step_untouched_delta_e"]
    assert images.images[0].rgb.dtype == np.uint16
    gains = images.details["gains"]
    assert isinstance(gains, dict)
    assert set(gains["wall 0"]) == {"left", "right"}
    images, _ = mosaic(tmp_path, two_photos(1.3 + 0.05 * columns))
    ratio = np.log(light_of_levels(65535)[images.images[0].rgb] / texture()).mean(axis=2)
    # Parts of a field that no overlap shows, a few hundredths at the far border, remain.
    assert np.abs(ratio - np.median(ratio)).max() < 0.04


def test_detail_is_of_one_photo_everywhere(tmp_path: Path) -> None:
    # The correction of a photo is smooth and contains no detail of the other photo.
    rng = np.random.default_rng(8)
    layers = two_photos(0.7 * rng.uniform(0.9, 1.1, (*SHAPE, 1)))
    images, metrics = mosaic(tmp_path, layers)
    assert metrics["gain_max"] / metrics["gain_min"] == pytest.approx(1.0 / 0.7, rel=0.05)
    done = factors(images, layers)
    for axis in (0, 1):
        steps = np.abs(np.diff(done, axis=axis))
        is_seam = np.diff(images.images[0].source, axis=axis)[..., None] != 0
        # It changes by a hundredth from cell to cell, while the detail of the photos differs by a
        # fifth.
        assert steps[~np.broadcast_to(is_seam, steps.shape)].max() < 0.01


def test_photos_that_agree_stay_untouched(tmp_path: Path) -> None:
    layers = two_photos(1.005)
    images, metrics = mosaic(tmp_path, layers)
    assert not factors(images, layers).any()
    assert "gain_max" not in metrics
    assert images.details == {}
    # A single layer needs no balancing.
    pair, cameras = two_photos(0.5), [photographed(900.0)] * 2
    assert balancing.balance_of(pair[:1], None, [None]) is None
    found = balancing.balance_of(pair, None, cameras)
    assert found is not None
    assert len(found.exposures.lenses) == 1


def surface(depth_m: NDArray[np.float32]) -> Walls:
    return samples.walls(samples.wall(inspect_scenes.frame(shape=SHAPE), depth_m=depth_m))


def test_what_parallax_separates_is_not_taken_for_light(tmp_path: Path) -> None:
    # At the seam there is a post in one photo, where the second photo shows the wall.
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
        # If the post were treated as a difference in light, it would change the correction by half
        # of ln 4, 0.7.
        assert pulled.max() < 0.06


def radial(shape: tuple[int, int], at: tuple[float, float]) -> NDArray[np.float32]:
    rows, columns = np.indices(shape)
    return (np.hypot(rows - at[0], columns - at[1]) / 40.0).astype(np.float32)


def nothing_added(n_layers: int) -> balancing.Exposures:
    return balancing.Exposures(
        exposures=np.zeros((n_layers, 3)),
        lenses=np.zeros((0, 2)),
        nodes=np.zeros((n_layers, 4, 4, 3)),
    )


def test_exposures_and_the_loss_of_a_lens_are_found_in_spite_of_outliers() -> None:
    rng = np.random.default_rng(2)
    wall = rng.normal(-1.5, 0.4, (40, 100, 3))
    true = np.array([0.2, -0.3, 0.1])
    seen = radial((40, 50), (19.5, 24.5))
    bent = 0.1 * seen.astype(np.float64) ** 2 + 0.3 * seen.astype(np.float64) ** 4
    lights, radii = [], [balancing.Radii(values=seen, lens=0)] * 3
    for exposure, first in zip(true, (0, 25, 50), strict=True):
        columns = slice(first, first + 50)
        logs = wall[:, columns] + exposure - bent[..., None]
        logs += rng.normal(0.0, 0.01, logs.shape)
        logs[rng.random(logs.shape[:2]) < 0.05] += 0.8
        lights.append(BlockLight(box=(slice(0, 40), columns), log_light=logs.astype(np.float32)))
    found = balancing.estimate(lights, radii)
    apart = found.exposures.mean(axis=1) + true
    np.testing.assert_allclose(apart, apart.mean(), atol=0.02)
    at = np.linspace(0.0, 0.75, 6)
    loss = found.lenses[0, 0] * at**2 + found.lenses[0, 1] * at**4
    np.testing.assert_allclose(loss, 0.1 * at**2 + 0.3 * at**4, atol=0.02)
    balanced = [
        one.log_light + found.logs(k, one, radius)
        for k, (one, radius) in enumerate(zip(lights, radii, strict=True))
    ]
    for i, j, shared in pairs(lights):
        one, other = (balanced[k][inside(shared, lights[k].box)] for k in (i, j))
        assert np.median(np.abs(one - other)) < 0.02
    # Without overlaps, nothing is changed.
    alone = balancing.estimate(lights[:1], radii[:1])
    assert not alone.exposures.any()
    assert not alone.nodes.any()
    assert (alone.lenses.shape, alone.nodes.shape) == ((1, 2), (1, 4, 4, 3))


# --- functions ---


@pytest.mark.parametrize(
    "box",
    [(slice(0, 5), slice(0, 7)), (slice(1, 4), slice(2, 6)), (slice(4, 5), slice(6, 7))],
    ids=["whole", "part", "block"],
)
def test_what_is_added_is_straight_between_the_middles_of_blocks(box: tuple[slice, slice]) -> None:
    blocks = Blocks.over((48, 70), 10)
    assert blocks.shape == (5, 7)
    shape = tuple(part.stop - part.start for part in box)
    logs = np.random.default_rng(1).normal(size=(*shape, 3)).astype(np.float32)
    light = BlockLight(box=box, log_light=np.zeros((*shape, 3), np.float32))
    balance = balancing.Balance(
        blocks=blocks, lights=(light,), logs=(logs,), exposures=nothing_added(1)
    )
    rows, columns = (grid.ravel() for grid in np.indices((48, 70)))
    found = balance.log_gains(0, rows, columns)
    middles = [centres[part] for centres, part in zip(blocks.centres(), box, strict=True)]
    # Beyond the outermost block centres, values are constant.
    places = [
        np.interp(cells + 0.5, at, np.arange(len(at)))
        for cells, at in zip((rows, columns), middles, strict=True)
    ]
    for channel in range(3):
        wanted = map_coordinates(logs[..., channel].astype(np.float64), places, order=1)
        np.testing.assert_allclose(found[:, channel], wanted, atol=1e-5)
    colours = np.random.default_rng(2).integers(0, 65536, (len(rows), 3)).astype(np.uint16)
    np.testing.assert_array_equal(balance.shown(0, colours, rows, columns), lit(colours, found))


@pytest.mark.parametrize(("factor", "differs"), [(1.03, False), (1.05, True), (0.95, True)])
def test_photos_that_differ_by_4_percent_are_balanced(factor: float, *, differs: bool) -> None:
    # Each photo is corrected by half of the difference.
    pair = two_photos(factor)
    found = balancing.balance_of(pair, None, [None, None])
    assert (found is not None) is differs
    if found is not None:
        apart = found.exposures.exposures[0] - found.exposures.exposures[1]
        np.testing.assert_allclose(apart, np.log(factor), atol=2e-3)


def test_near_a_seam_layers_go_over_to_each_other_unless_depths_leap_everywhere() -> None:
    bend = np.ones(SHAPE)
    bend[60:] = 0.8
    found = balancing.balance_of(two_photos(bend[..., None]), None, [None, None])
    assert found is not None
    source = np.zeros(SHAPE, dtype=np.int16)
    source[:, 120:] = 1
    steps = np.add(*np.indices(SHAPE)) % 2 * np.float32(0.5)
    (flat,), (rough,) = (surface(depth).walls for depth in (0.0 * steps, steps))
    plain = balancing.with_seams(found, source, None)
    for wall, expected in ((None, plain), (flat, plain), (rough, found)):
        joined = balancing.with_seams(found, source, wall)
        for logs, wanted in zip(joined.logs, expected.logs, strict=True):
            np.testing.assert_array_equal(logs, wanted)
    assert max(np.abs(a - b).max() for a, b in zip(plain.logs, found.logs, strict=True)) > 0.03


@pytest.mark.parametrize("apart", [0.05, -0.15, 0.3])
def test_layers_are_blended_at_a_seam(apart: float, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(balancing, "FEATHER_CELLS", 40)
    # Two layers cover a wall of 16 x 24 blocks, with the seam in the middle; the second is unknown
    # beyond the fourth block after the seam.
    shape = (16, 24)
    logs = np.zeros((2, *shape, 3), dtype=np.float32)
    logs[1] = apart
    logs[1, :, 16:] = np.nan
    box = (slice(0, 16), slice(0, 24))
    found = balancing.Balance(
        blocks=Blocks.over((160, 240), 10),
        lights=tuple(BlockLight(box=box, log_light=one) for one in logs),
        logs=(np.zeros((*shape, 3), np.float32),) * 2,
        exposures=nothing_added(2),
    )
    source = np.repeat([[0, 1]], 120, axis=1).repeat(160, axis=0).astype(np.int16)
    one, other = balancing.with_seams(found, source, None).logs
    # Blocks are weighted by the probability that both layers show the same object, and by the known
    # share within 1.5 blocks.
    alike = 1.0 / (1.0 + (apart / 0.15) ** 2) ** 2
    offsets = np.arange(-5, 6)
    bell = np.exp(-0.5 * (offsets / 1.5) ** 2)
    for column in (8, 11, 12, 14, 15, 16, 17):
        is_known = column + offsets < 16
        known = alike * bell[is_known].sum() / bell.sum()
        np.testing.assert_allclose(
            one[8, column] - other[8, column], apart * known / (known + 0.02), rtol=1e-4
        )
    # The standard deviation of the shares around a block is half of the width of four blocks.
    offsets = np.arange(-6, 7)
    bell = np.exp(-0.5 * (offsets / 2.0) ** 2)
    for column in (8, 11, 12, 14):
        share = bell[column + offsets >= 12].sum() / bell.sum()
        taken = one[8, column] / (one[8, column] - other[8, column])
        np.testing.assert_allclose(taken, share, rtol=1e-4)
    # Farther from the seam, nothing is changed.
    assert not one[:, :6].any()
    assert not other[:, 18:].any()


def photographed(fx: float, width: int = 400, height: int = 300) -> Camera:
    frame = inspect_scenes.frame(shape=SHAPE)
    middle = frame.world_from_wall(np.array([[120.0, 60.0]]))[0]
    centre = middle + 3.0 * frame.normal_world
    off = {"cx": 0.5 * width - 7.0, "cy": 0.5 * height + 3.0}
    return ms.oriented(samples.aimed(centre, middle, fx, (width, height), **off))


def test_photos_of_one_lens_lose_light_alike_however_it_was_adjusted() -> None:
    lights = [block_light(one, Blocks.over(SHAPE, 8)) for one in two_photos(1.0)] * 3
    cameras = [photographed(fx) for fx in (1000.0, 1010.0, 1200.0)]
    cameras += [photographed(1000.0, width=800), None, cameras[0]]
    frame = inspect_scenes.frame(shape=SHAPE)
    found = balancing.radii_of_blocks(frame, None, cameras, Blocks.over(SHAPE, 8), lights)
    lenses = [None if one is None else one.lens for one in found]
    # A focal length larger by 1 % is the same lens, by 20 % a zoomed one; other sizes are another
    # camera.
    assert lenses == [0, 0, 1, 2, None, 0]


@pytest.mark.parametrize("has_depths", [False, True])
def test_radii_are_told_from_the_middle_of_the_photo(*, has_depths: bool) -> None:
    frame = inspect_scenes.frame(shape=SHAPE)
    blocks = Blocks.over(SHAPE, 8)
    (light, _) = (block_light(one, blocks) for one in two_photos(1.0))
    camera = photographed(900.0)
    depth_m = np.full(SHAPE, 0.4, dtype=np.float32)
    depth_m[:40] = np.nan
    wall = samples.wall(frame, depth_m=depth_m)
    (found,) = balancing.radii_of_blocks(
        frame, wall if has_depths else None, [camera], blocks, [light]
    )
    assert found is not None
    down, right = blocks.centres()
    for row, column in ((0, 0), (7, 3), (14, 19)):
        at = np.array([[right[column], down[row]]])
        depth = 0.4 if has_depths and down[row] >= 40 else 0.0
        pixel = camera.viewing().project(frame.world_from_wall(at, np.array([depth])))[0, :2]
        # With 400 x 300 pixels, the distance from the middle to a corner is 250; beyond, nothing is
        # painted.
        wanted = min(1.0, float(np.hypot(*(pixel - [200.0, 150.0]))) / 250.0)
        assert found.values[row, column] == pytest.approx(wanted, abs=1e-5)


def light(rows: slice, columns: slice, seed: int, unknown: float = 0.0) -> BlockLight:
    rng = np.random.default_rng(seed)
    shape = (rows.stop - rows.start, columns.stop - columns.start)
    logs = rng.normal(-1.0, 0.5, (*shape, 3)).astype(np.float32)
    logs[rng.random(shape) < unknown] = np.nan
    return BlockLight(box=(rows, columns), log_light=logs)


@pytest.mark.parametrize("lens", [1, None])
def test_light_gets_an_exposure_a_field_and_the_loss_of_a_lens(lens: int | None) -> None:
    rng = np.random.default_rng(7)
    given = light(slice(3, 14), slice(5, 20), 2, 0.2)
    rows, columns = given.log_light.shape[:2]
    radii = None
    if lens is not None:
        radii = balancing.Radii(
            values=rng.uniform(0.0, 1.0, (rows, columns)).astype(np.float32), lens=lens
        )
    found = balancing.Exposures(
        exposures=rng.normal(size=(2, 3)),
        lenses=rng.normal(size=(2, 2)),
        nodes=rng.normal(size=(2, 4, 4, 3)),
    )
    logs = found.logs(1, given, radii)
    places = np.linspace(0.0, 1.0, 4)
    for row, column in ((0, 0), (4, 7), (rows - 1, columns - 1)):
        down, across = (row + 0.5) / rows, (column + 0.5) / columns
        for channel in range(3):
            sides = [np.interp(across, places, side) for side in found.nodes[1, :, :, channel]]
            wanted = found.exposures[1, channel] + np.interp(down, places, sides)
            if radii is not None:
                square = float(radii.values[row, column]) ** 2
                wanted += found.lenses[1] @ [square, square**2]
            assert logs[row, column, channel] == pytest.approx(wanted, abs=1e-9)


SMALL_SHAPE = (40, 60)
BLOCKS = Blocks.over(SMALL_SHAPE, 10)


def light_of(levels: NDArray[np.generic], highest: int) -> NDArray[np.float64]:
    share = np.asarray(levels, dtype=np.float64) / highest
    return np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("gain", [0.25, 1.0, 1.7])
def test_light_is_multiplied_and_clipped(dtype: type[np.unsignedinteger], gain: float) -> None:
    highest = int(np.iinfo(dtype).max)
    colours = np.random.default_rng(1).integers(0, highest + 1, (500, 3)).astype(dtype)
    colours[:2] = [[0, 0, 0], [highest] * 3]
    logs = np.full((500, 3), np.log(gain), np.float32)
    found = lit(colours, logs)
    assert found.dtype == dtype
    level = levels_of(np.clip(gain * light_of(colours, highest), 0.0, 1.0))
    # The limit allows rounding errors of whole levels; with 16 bits, they are about one level.
    limit = 0.51 if dtype is np.uint8 else 1.5
    assert np.abs(found - highest * level).max() <= limit
    np.testing.assert_allclose(lit_shares(colours / highest, logs), level, atol=2e-5)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_fully_painted_blocks_have_their_mean_light(dtype: type[np.unsignedinteger]) -> None:
    highest = int(np.iinfo(dtype).max)
    rng = np.random.default_rng(2)
    rgb = rng.integers(highest // 4, highest // 2, (*SMALL_SHAPE, 3)).astype(dtype)
    mask = np.full(SMALL_SHAPE, LayerMask.PAINTED, np.uint8)
    # The outermost blocks are empty, and a cell is missing in an inner block.
    mask[:10] = mask[:, 50:] = LayerMask.OCCLUDED
    mask[25, 15] = LayerMask.NO_SURFACE
    found = block_light(samples.layer(mask, rgb=rgb), BLOCKS)
    assert found.box == (slice(1, 4), slice(0, 5))
    for row, column in np.ndindex(3, 5):
        part = np.s_[10 * row + 10 : 10 * row + 20, 10 * column : 10 * column + 10]
        is_missing = (row, column) == (1, 1)
        assert found.is_known[row, column] == (not is_missing)
        if is_missing:
            assert np.isnan(found.log_light[row, column]).all()
        else:
            wanted = np.log(light_of(rgb[part], highest).mean(axis=(0, 1)))
            np.testing.assert_allclose(found.log_light[row, column], wanted, atol=1e-5)


@pytest.mark.parametrize(
    ("level", "n_cells", "is_known"),
    [
        *((9, 100, False), (10, 100, True), (245, 100, True), (246, 100, False)),
        # A twentieth of the hundred cells of a block may be white.
        *((255, 5, True), (255, 6, False)),
    ],
)
@pytest.mark.parametrize("channel", [0, 2])
@pytest.mark.parametrize("scale", [1, 257])
def test_black_and_white_blocks_are_unknown(
    level: int, n_cells: int, channel: int, scale: int, *, is_known: bool
) -> None:
    rgb = np.full((*SMALL_SHAPE, 3), 100, np.uint16 if scale > 1 else np.uint8) * scale
    # A single channel is sufficient.
    rows, columns = np.divmod(np.arange(n_cells), 10)
    rgb[rows, columns, channel] = level * scale
    found = block_light(samples.layer(SMALL_SHAPE, rgb=rgb), BLOCKS)
    assert found.is_known[0, 0] == is_known
    assert found.is_known.sum() == 24 - (not is_known)


def test_boxes_share_what_lies_in_both() -> None:
    def box(*sides: int) -> tuple[slice, slice]:
        return slice(sides[0], sides[1]), slice(sides[2], sides[3])

    for other, shared in (
        ((3, 8, 0, 4), box(3, 5, 2, 4)),
        ((1, 2, 3, 4), box(1, 2, 3, 4)),
        # Boxes next to each other or touching at a corner have no intersection.
        *(((5, 8, 2, 9), None), ((0, 5, 9, 12), None)),
    ):
        assert common(box(0, 5, 2, 9), box(*other)) == shared
    assert inside(box(3, 5, 4, 6), box(1, 9, 4, 9)) == box(2, 4, 0, 2)
