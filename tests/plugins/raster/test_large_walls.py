"""Walls too large for memory: results are in files, and bands give the same result as the whole."""

from __future__ import annotations

import dataclasses
import mmap
import os
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.mosaic.seams import MosaicSeams
from orthoflow_plugins.ortho.dsm_backward import DsmBackward
from orthoflow_plugins.ortho.pointcloud_direct import PointcloudDirect
from orthoflow_plugins.raster.walls import bytes_needed, require_memory

from orthoflow.errors import MethodError
from orthoflow.geometry import bands
from orthoflow.geometry.bands import IN_MEMORY_CELLS, holds_cells
from orthoflow.geometry.rows import raster_rows
from orthoflow.products import Layer, LayerMask, Layers, PointCloud, Walls
from tests import inspect_scenes, ortho_scenes, raster_scenes, samples
from tests.plugins.ortho.test_direct import bare_walls
from tests.raster_scenes import context, peak_bytes

BAND_CELLS = 1 << 17


@pytest.fixture
def small_bands(monkeypatch: pytest.MonkeyPatch) -> None:
    """Treat walls of a million cells as large."""
    monkeypatch.setattr(bands, "BAND_CELLS", BAND_CELLS)
    monkeypatch.setattr("orthoflow_plugins.ortho.surfaces.BAND_CELLS", BAND_CELLS)
    monkeypatch.setattr("orthoflow_plugins.ortho.painting.TILE_CELLS", 128)
    monkeypatch.setattr("orthoflow_plugins.mosaic.agreement.ROWS_AT_ONCE", 64)
    monkeypatch.setattr("orthoflow_plugins.mosaic.joining.BAND_CELLS", BAND_CELLS)
    monkeypatch.setattr("orthoflow_plugins.mosaic.seams.LONGEST_PX", 100)
    monkeypatch.setattr("orthoflow_plugins.ortho.pointcloud_direct.BAND_CELLS", BAND_CELLS)
    monkeypatch.setattr("orthoflow_plugins.raster.walls.BAND_CELLS", 2 * BAND_CELLS)
    monkeypatch.setattr("orthoflow_plugins.raster.reporting.CELLS_ASKED", BAND_CELLS)


def mapped(path: Path, values: NDArray[np.generic]) -> NDArray[np.generic]:
    array = np.memmap(path, dtype=values.dtype, mode="w+", shape=values.shape)
    array[...] = values
    return array.view(np.ndarray)


def in_files(walls: Walls, folder: Path) -> Walls:
    (wall,) = walls.walls
    names = ("depth_m", "sigma_m", "count", "mask")
    arrays = {name: mapped(folder / f"given_{name}", getattr(wall, name)) for name in names}
    return dataclasses.replace(walls, walls=(dataclasses.replace(wall, **arrays),))


def large_inputs(folder: Path, n: int = 4) -> DsmBackward.In:
    """Return the wall of `ortho_scenes` with n times smaller cells, in files, and two photos."""
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
def test_layers_are_painted_and_reported_without_memory_per_cell(tmp_path: Path) -> None:
    (tmp_path / "small").mkdir()
    small, inputs = large_inputs(tmp_path / "small", 2), large_inputs(tmp_path)
    method, n_cells = DsmBackward, inputs.walls.walls[0].mask.size
    method().run(small, method.Params(), context(tmp_path))  # compiled and loaded, also with files
    with peak_bytes() as peak_of_small:
        method().run(small, method.Params(), context(tmp_path))
        of_bands = peak_of_small()
    with peak_bytes() as peak:
        layers = method().run(inputs, method.Params(), context(tmp_path)).layers
        # A layer has eight bytes per cell, the occluding surface two more.
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
        # A layer has nine bytes per cell, and the selected points of a wall sixteen.
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


def large_layers(folder: Path) -> tuple[Layer, ...]:
    """Return two photos in files, with quality falling to the right and to the left."""
    shape, rng = (1500, 1000), np.random.default_rng(2)
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


@pytest.mark.usefixtures("small_bands")
def test_mosaics_are_joined_and_reported_without_memory_per_cell(tmp_path: Path) -> None:
    layers = large_layers(tmp_path)
    params = MosaicSeams.Params(seams="graph-cut", island_cells_min=4)
    few = Layers(layers=tuple(raster_rows(layer, slice(0, 100)) for layer in layers))
    MosaicSeams().run(MosaicSeams.In(layers=few), params, context(tmp_path))  # libraries loaded
    inputs = MosaicSeams.In(layers=Layers(layers=layers))
    with peak_bytes() as peak:
        MosaicSeams().run(inputs, params, context(tmp_path))
        # The layers have 16 bytes per cell, the orthoimage 6; a cut has 30,000 cells.
        assert peak() < 4.0 * layers[0].mask.size + 30e6, peak()


@pytest.mark.usefixtures("small_bands")
def test_walls_are_rastered_and_reported_in_the_memory_of_a_band(tmp_path: Path) -> None:
    known, cloud = tall_wall()
    params = {"gsd_m": known.gsd_m, "buffer_m": 0.3}
    with peak_bytes() as peak:
        walls, _ = raster_scenes.rastered(cloud, known.planes(), tmp_path, **params)
        # A wall without colours has 13 bytes per cell, and a band has a fifteenth of the cells.
        assert peak() < 10.0 * walls.walls[0].mask.size, peak()


def test_walls_may_take_three_quarters_of_the_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    def give_memory(n_bytes: float) -> None:
        pages = {"SC_PHYS_PAGES": int(n_bytes), "SC_PAGE_SIZE": 1}
        monkeypatch.setattr(os, "sysconf", pages.__getitem__)

    one = samples.facing_south(0.01, 3000, 2000)
    give_memory(1.01 * bytes_needed([one.shape]) / 0.75)
    require_memory([one])
    give_memory(0.99 * bytes_needed([one.shape]) / 0.75)
    with pytest.raises(MethodError, match=r"gsd_m = 0.01 m gives 6e\+06 cells \(3000 x 2000"):
        require_memory([one])
    huge, larger = (8000, 20_000), (8000, 40_000)
    assert huge[0] * huge[1] > IN_MEMORY_CELLS
    assert bytes_needed([huge]) == bytes_needed([larger])
    tins = [bytes_needed([shape], is_tin=True) for shape in (huge, larger)]
    assert tins[1] - tins[0] == 790 * 8000 * 20_000
    # With any amount of memory, cells are numbered with 32 bits.
    give_memory(1e15)
    require_memory([samples.facing_south(0.01, (1 << 16) - 1, 1 << 15)])
    with pytest.raises(MethodError, match=r"gsd_m = 0.01 m gives 2\.15e\+09 cells"):
        require_memory([samples.facing_south(0.01, 1 << 16, 1 << 15)])
