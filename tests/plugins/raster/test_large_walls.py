"""Walls too large for the memory: what is made of them lies in files, and bands are the whole."""

from __future__ import annotations

import dataclasses
import mmap
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.mosaic.seams import MosaicSeams
from orthoflow_plugins.ortho.dsm_backward import DsmBackward
from orthoflow_plugins.ortho.pointcloud_direct import PointcloudDirect

from orthoflow.geometry import bands
from orthoflow.geometry.bands import count_cells, count_known, holds_cells
from orthoflow.products import Layer, LayerMask, Layers, Orthoimage, PointCloud, Walls
from tests import inspect_scenes, ortho_scenes, raster_scenes
from tests.long_loops import long_only
from tests.plugins.ortho.test_direct import bare_walls
from tests.raster_scenes import context

BAND_CELLS = 1 << 17
SHAPE = (1500, 1000)
N_CELLS = SHAPE[0] * SHAPE[1]


@pytest.fixture
def small_bands(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let walls of a megacell count as large."""
    monkeypatch.setattr(bands, "_BAND_CELLS", BAND_CELLS)
    monkeypatch.setattr("orthoflow_plugins.ortho.surfaces._BAND_CELLS", BAND_CELLS)
    monkeypatch.setattr("orthoflow_plugins.ortho.painting.TILE_CELLS", 128)
    monkeypatch.setattr("orthoflow_plugins.mosaic.agreement._ROWS_AT_ONCE", 64)
    monkeypatch.setattr("orthoflow_plugins.mosaic.joining._BAND_CELLS", BAND_CELLS)
    monkeypatch.setattr("orthoflow_plugins.mosaic.seams._LONGEST_PX", 100)
    monkeypatch.setattr("orthoflow_plugins.ortho.pointcloud_direct._BAND_CELLS", BAND_CELLS)
    monkeypatch.setattr("orthoflow_plugins.raster.walls._BAND_CELLS", 2 * BAND_CELLS)
    monkeypatch.setattr("orthoflow_plugins.raster.reporting._CELLS_ASKED", BAND_CELLS)


@contextmanager
def peak_bytes() -> Iterator[Callable[[], int]]:
    """The most memory that arrays took meanwhile; mapped files do not count."""
    tracemalloc.start()
    try:
        yield lambda: tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def mapped(path: Path, values: NDArray[np.generic]) -> NDArray[np.generic]:
    array = np.memmap(path, dtype=values.dtype, mode="w+", shape=values.shape)
    array[...] = values
    return array.view(np.ndarray)


def in_files(walls: Walls, folder: Path) -> Walls:
    (wall,) = walls.walls
    names = ("depth_m", "sigma_m", "count", "mask")
    arrays = {name: mapped(folder / f"given_{name}", getattr(wall, name)) for name in names}
    return dataclasses.replace(walls, walls=(dataclasses.replace(wall, **arrays),))


def large_inputs(folder: Path, n: int = 5) -> DsmBackward.In:
    """The wall of `ortho_scenes` in cells of an nth, its rasters in files, and two photos."""
    where = ortho_scenes.frame()
    fine = dataclasses.replace(where, gsd_m=where.gsd_m / n, width=n * 320, height=n * 240)
    depths = np.repeat(np.repeat(ortho_scenes.depth_m(), n, axis=0), n, axis=1)
    walls = in_files(ortho_scenes.walls(fine, depths), folder)
    asides_m = (-0.7, 0.3)
    photos = [ortho_scenes.rendered(aside_m=aside) for aside in asides_m]
    cameras = [ortho_scenes.camera(where, aside_m=aside) for aside in asides_m]
    return DsmBackward.In(
        walls=walls, photos=ortho_scenes.photos(*photos), cameras=ortho_scenes.cameras(*cameras)
    )


@pytest.mark.usefixtures("small_bands")
def test_layers_are_painted_and_reported_without_memory_per_cell(
    tmp_path: Path,
) -> None:
    (tmp_path / "small").mkdir()
    small, inputs = large_inputs(tmp_path / "small", 2), large_inputs(tmp_path)
    method, n_cells = DsmBackward, inputs.walls.walls[0].mask.size
    method().run(small, method.Params(), context(tmp_path))  # compiled and loaded, in files too
    with peak_bytes() as peak_of_small:
        method().run(small, method.Params(), context(tmp_path))
        of_bands = peak_of_small()
    with peak_bytes() as peak:
        layers = method().run(inputs, method.Params(), context(tmp_path)).layers
        # A layer holds eight bytes per cell, what hides cells two more.
        assert peak() - of_bands < 0.5 * n_cells, (peak(), of_bands)
    assert len(layers.layers) == 2
    assert all(holds_cells(layer.mask, LayerMask.PAINTED) for layer in layers.layers)


@pytest.mark.usefixtures("small_bands")
def test_walls_are_painted_from_a_cloud_without_memory_per_cell(tmp_path: Path) -> None:
    known, cloud = tall_wall()
    small = bare_walls(raster_scenes.leaning_wall(shape=(40, 10)))
    ready = PointcloudDirect.In(walls=small, cloud=cloud)
    PointcloudDirect().run(ready, PointcloudDirect.Params(), context(tmp_path))  # compiled
    inputs = PointcloudDirect.In(walls=in_files(bare_walls(known), tmp_path), cloud=cloud)
    with peak_bytes() as peak:
        found = PointcloudDirect().run(inputs, PointcloudDirect.Params(), context(tmp_path))
        (layer,) = found.layers.layers
        # A layer holds nine bytes per cell, and the winners of a wall sixteen.
        assert peak() < 4.0 * layer.mask.size, peak()
    assert holds_cells(layer.mask, LayerMask.PAINTED)


def test_a_wall_that_no_photo_paints_lies_in_files(tmp_path: Path) -> None:
    given = large_inputs(tmp_path, 2)
    (wall,) = given.walls.walls
    far = wall.frame.origin_world + 60.0 * wall.frame.u_world
    away = dataclasses.replace(wall.frame, origin_world=far)
    both = (wall, dataclasses.replace(wall, frame=away, name="away"))
    walls = dataclasses.replace(given.walls, walls=both)
    inputs = DsmBackward.In(walls=walls, photos=given.photos, cameras=given.cameras)
    layers = DsmBackward().run(inputs, DsmBackward.Params(), context(tmp_path)).layers.layers
    bare = layers[-1]
    assert (bare.source, bare.wall) == ("no photo", 1)
    for name in ("rgb", "mask", "quality"):
        assert isinstance(getattr(bare, name).base, np.memmap | mmap.mmap), name
    assert not bare.rgb.any()


def tall_wall() -> tuple[raster_scenes.KnownWall, PointCloud]:
    known = raster_scenes.leaning_wall(shape=(4000, 1000))
    places = np.random.default_rng(7).uniform([0, 0], [1000, 4000], (80_000, 2))
    points = known.world(*places.T, np.zeros(len(places)))
    intensity = places[:, 0].astype(np.float32) / 1000.0
    return known, raster_scenes.cloud_of(points, intensity=intensity)


def large_layers(folder: Path, shape: tuple[int, int]) -> tuple[Layer, ...]:
    """Two photos whose quality falls from left to right, and the other way, in files."""
    rng = np.random.default_rng(2)
    ramp = np.broadcast_to(np.linspace(1.0, 2.0, shape[1], dtype=np.float32), shape)
    layers = []
    for k, quality in enumerate((ramp, ramp[:, ::-1])):
        mask = np.full(shape, LayerMask.PAINTED, dtype=np.uint8)
        mask[:, : shape[1] // 4] = LayerMask.OUTSIDE if k else LayerMask.PAINTED
        is_painted = mask == LayerMask.PAINTED
        rgb = rng.integers(1, 255, (*shape, 3), dtype=np.uint8) * is_painted[..., None]
        arrays = {"rgb": rgb.astype(np.uint8), "mask": mask, "quality": quality * is_painted}
        stored = {name: mapped(folder / f"{k}_{name}", values) for name, values in arrays.items()}
        where = inspect_scenes.frame(shape=shape)
        layers.append(Layer(frame=where, wall=0, source=f"photo {k}", **stored))
    return tuple(layers)


def mosaic(
    layers: tuple[Layer, ...], folder: Path, **params: object
) -> tuple[Orthoimage, dict[str, float]]:
    inputs, ctx = MosaicSeams.In(layers=Layers(layers=layers)), context(folder)
    chosen = MosaicSeams.Params.model_validate({"island_cells_min": 4} | params)
    (image,) = MosaicSeams().run(inputs, chosen, ctx).orthoimages.images
    return image, raster_scenes.numbers(ctx)


@pytest.mark.usefixtures("small_bands")
def test_mosaics_are_joined_and_reported_without_memory_per_cell(
    tmp_path: Path,
) -> None:
    layers = large_layers(tmp_path, SHAPE)
    params: dict[str, object] = {"seams": "graph-cut"}
    mosaic(tuple(crop(layer, 100) for layer in layers), tmp_path, **params)  # libraries loaded
    with peak_bytes() as peak:
        mosaic(layers, tmp_path, **params)
        # The layers hold sixteen bytes per cell, the orthoimage six; a cut is that of 30 000 cells.
        assert peak() < 4.0 * N_CELLS + 30e6, peak()


def crop(layer: Layer, n_rows: int) -> Layer:
    return dataclasses.replace(
        layer,
        frame=dataclasses.replace(layer.frame, height=n_rows),
        rgb=layer.rgb[:n_rows],
        mask=layer.mask[:n_rows],
        quality=layer.quality[:n_rows],
    )


@pytest.mark.parametrize("seams", ["graph-cut", *long_only("best-view", "priority", "voronoi")])
def test_bands_show_neither_in_mosaics_nor_in_their_metrics(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seams: str
) -> None:
    layers = large_layers(tmp_path, (333, 270))
    params = {"seams": seams, "priority": ["photo 1"], "gains": "global"}
    found = []
    for band_cells in (1 << 24, 270 * 70):
        monkeypatch.setattr(bands, "_BAND_CELLS", band_cells)
        for name in ("_BAND_CELLS", "_BALANCED_AT_ONCE"):
            monkeypatch.setattr(f"orthoflow_plugins.mosaic.joining.{name}", band_cells)
        found.append(mosaic(layers, tmp_path, **params))
    (whole, metrics), (banded, others) = found
    assert metrics == others
    for name in ("rgb", "mask", "source"):
        np.testing.assert_array_equal(getattr(whole, name), getattr(banded, name))


@pytest.mark.usefixtures("small_bands")
def test_walls_are_rastered_and_reported_in_the_memory_of_a_band(tmp_path: Path) -> None:
    known, cloud = tall_wall()
    params = {"gsd_m": known.gsd_m, "buffer_m": 0.3}
    with peak_bytes() as peak:
        walls, _ = raster_scenes.rastered(cloud, known.planes(), tmp_path, **params)
        # A wall keeps 13 bytes per cell without colours, and a band has a fifteenth of the cells.
        assert peak() < 10.0 * walls.walls[0].mask.size, peak()


def test_cells_are_counted_in_bands_as_in_the_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(1)
    mask = rng.integers(0, 4, (103, 37), dtype=np.uint8)
    depths = np.where(mask == 2, np.nan, 1.0)
    monkeypatch.setattr(bands, "_BAND_CELLS", 37 * 10)
    parts = list(bands.row_bands(mask.shape, multiple=4))
    assert [part.stop - part.start for part in parts] == [8] * 12 + [7]
    assert [part.start for part in parts[1:]] == [part.stop for part in parts[:-1]]
    assert count_cells(mask, 3) == np.count_nonzero(mask == 3)
    assert count_known(depths) == np.count_nonzero(mask != 2)
    assert holds_cells(mask, 3)
    assert not holds_cells(mask, 4)
