"""In simulated rooms, count cells that show a passer-by although another photo shows the wall.

    python benchmarks/passers_by.py [--rooms 10] [--first 1] [--people 3] [--layout variant2]

Each room is photographed twice from the same positions, with and without people in front of the
main wall; differences between the two photos are people. Photos are projected with their true
cameras, so that nothing else is measured.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from orthoflow_plugins.mosaic.seams import MosaicSeams
from orthoflow_plugins.ortho.dsm_backward import DsmBackward
from orthoflow_plugins.ortho.photos_on_walls import PhotosOnWalls
from orthoflow_plugins.raster.grid import RasterGrid
from orthoflow_plugins.simulate.room import SimulateRoom

from orthoflow.products import LayerMask, Layers, Orthoimages, Walls
from orthoflow.sdk import StepContext

# Minimum difference of levels; noise and JPEG compression cause smaller ones.
_LEVELS = 30


def main() -> None:
    """Print a row for each room, with and without the robust selection."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rooms", type=int, default=10)
    parser.add_argument("--first", type=int, default=1)
    parser.add_argument("--people", type=int, default=3)
    parser.add_argument("--layout", default="variant2")
    parser.add_argument("--gsd", type=float, default=0.008)
    given = parser.parse_args()
    print("seed, share of cells that show people: in the only photo; though another shows the wall")
    for seed in range(given.first, given.first + given.rooms):
        with tempfile.TemporaryDirectory() as folder:
            walls, empty = laid(seed, 0, given, Path(folder))
            walls, crowded = laid(seed, given.people, given, Path(folder))
            people = [
                (one.mask == LayerMask.PAINTED)
                & (np.abs(one.rgb.astype(int) - other.rgb).max(axis=2) > _LEVELS)
                for one, other in zip(crowded.layers, empty.layers, strict=True)
            ]
            row = [
                shown(joined(crowded, walls, Path(folder), robust=robust), crowded, people)
                for robust in (False, True)
            ]
        shares = [f"{only:.3%} {avoidable:.3%}" for only, avoidable in row]
        print(f"{seed}: not robust {shares[0]}, robust {shares[1]}", flush=True)


def context(seed: int, folder: Path) -> StepContext:
    """Return a context for a step."""
    scratch = Path(tempfile.mkdtemp(dir=folder))
    return StepContext(rng=np.random.default_rng(seed), cores=2, scratch=scratch)


def laid(seed: int, n_people: int, given: argparse.Namespace, folder: Path) -> tuple[Walls, Layers]:
    """Return the main wall of a room and its photos projected onto it."""
    params = SimulateRoom.Params(
        scan_step_m=0.8 * given.gsd,
        panorama_step_m=0.05,
        photo_layout=given.layout,
        photo_gsd_m=given.gsd,
        photo_supersample=1,
        decoration="drawn",
        n_passers_by=n_people,
    )
    room = SimulateRoom().run(SimulateRoom.In(), params, context(seed, folder))
    rastering = RasterGrid.Params(gsd_m=given.gsd, ranks=(0,))
    inputs = RasterGrid.In(cloud=room.cloud, planes=room.truth.planes)
    walls = RasterGrid().run(inputs, rastering, context(seed, folder)).walls
    on_walls = PhotosOnWalls(
        walls=walls, photos=room.photos, cameras=room.truth.cameras, cloud=room.cloud
    )
    layers = DsmBackward().run(on_walls, DsmBackward.Params(), context(seed, folder)).layers
    return walls, layers


def joined(layers: Layers, walls: Walls, folder: Path, *, robust: bool) -> Orthoimages:
    """Return the orthoimage of the wall."""
    inputs = MosaicSeams.In(layers=layers, walls=walls)
    params = MosaicSeams.Params(robust=robust)
    return MosaicSeams().run(inputs, params, context(1, folder)).orthoimages


def shown(
    images: Orthoimages, layers: Layers, people: list[NDArray[np.bool_]]
) -> tuple[float, float]:
    """Return the shares of cells that show people, if one photo or several photos show the cell."""
    image = images.images[0]
    painters = {layer.source: place for place, layer in enumerate(layers.layers)}
    shows = np.zeros(image.mask.shape, dtype=np.bool_)
    for index, name in enumerate(image.sources):
        shows |= (image.source == index) & people[painters[name]]
    better = np.logical_or.reduce(
        [
            (layer.mask == LayerMask.PAINTED) & ~passed
            for layer, passed in zip(layers.layers, people, strict=True)
        ]
    )
    n_painted = max(1, int(np.count_nonzero(image.source >= 0)))
    return np.count_nonzero(shows & ~better) / n_painted, np.count_nonzero(
        shows & better
    ) / n_painted


if __name__ == "__main__":
    main()
