"""Measure colour balancing: steps along seams, deviation from constant exposure, and sharpness.

    orthoflow run quickstart.yaml -o one --store store --set room.photo_vignetting_share=0
    orthoflow run quickstart.yaml -o many --store store \\
        --set room.photo_exposure_share=0.3 --set room.photo_vignetting_share=0.3
    python benchmarks/balanced_colours.py many --against one --store store
    python benchmarks/balanced_colours.py --room 9021
    python benchmarks/balanced_colours.py RUN --exposure 0.3 --store store

The second command uses a smaller room that is determined by a seed, with true planes and cameras.
The third command multiplies the brightness of real photos by 0.7 to 1.3 and compares the result
with the balanced original photos.

The layers of a run are joined again, without and with balancing. A step is the difference between
the means of two cells on either side of a seam, averaged over stretches of 24 cells along the seam.
Part of a step is the change of the wall itself, which is measured as the difference that each
single photo shows between the same four cells, averaged over both photos. The excess is the
remaining part, caused by the use of two photos.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray
from orthoflow_plugins.mosaic.balance import Balance, balance_of, with_seams
from orthoflow_plugins.mosaic.joining import coloured
from orthoflow_plugins.mosaic.seams import MosaicSeams
from orthoflow_plugins.ortho.dsm_backward import DsmBackward
from orthoflow_plugins.raster.grid import RasterGrid
from orthoflow_plugins.simulate.room import SimulateRoom

from orthoflow.engine.store import Store
from orthoflow.geometry.bands import in_memory
from orthoflow.geometry.levels import light_of_levels
from orthoflow.products import (
    Cameras,
    Layer,
    LayerMask,
    Layers,
    Orthoimage,
    OrthoMask,
    Wall,
    Walls,
)
from orthoflow.records.open import open_run
from orthoflow.records.runs import Run
from orthoflow.sdk import StepContext

STRETCH = 24
BLOCK = 8

Cells: TypeAlias = NDArray[np.int64]


def product(run: Run, store: Store, step: str, cls: type) -> object:
    """Return the product of a given type from a step of a run."""
    return next(
        store.get_product(output.digest, cls)
        for output in run.cells[step].outputs.values()
        if output.type_name == cls.type_name
    )


def lab(rgb: NDArray[np.floating]) -> NDArray[np.float32]:
    """Convert levels 0 to 1 to CIE L*a*b*."""
    return np.asarray(cv2.cvtColor(rgb.astype(np.float32), cv2.COLOR_RGB2Lab), np.float32)


@dataclass(frozen=True, kw_only=True)
class Mosaic:
    """An orthoimage, and the balanced photos on its wall.

    Attributes:
        image: the orthoimage.
        painters: layers in the order of its sources.
        balance: balance of the layers, or None.
        metrics: metrics of the step.
    """

    image: Orthoimage
    painters: tuple[Layer, ...]
    balance: Balance | None
    metrics: dict[str, float]

    def __str__(self) -> str:
        return f"same cells {self.metrics['seam_step_mean_delta_e']:.2f}, {steps(self)}"

    def is_painted(
        self, photo: NDArray[np.int16], rows: Cells, columns: Cells, *, turned: bool
    ) -> NDArray[np.bool_]:
        """Return a mask of cells (n,) that photos (n,) show; `turned` swaps rows and columns."""
        found = np.zeros(len(rows), dtype=np.bool_)
        places = (columns, rows) if turned else (rows, columns)
        for index, layer in enumerate(self.painters):
            mine = np.flatnonzero(photo == index)
            found[mine] = layer.mask[places[0][mine], places[1][mine]] == LayerMask.PAINTED
        return found

    def colours(
        self, photo: NDArray[np.int16], rows: Cells, columns: Cells, *, turned: bool
    ) -> NDArray[np.float32]:
        """Return the colours (n, 3) of cells in photos, CIE L*a*b*; see `is_painted`."""
        found = np.zeros((len(rows), 3), dtype=self.image.rgb.dtype)
        down, right = (columns, rows) if turned else (rows, columns)
        for index, layer in enumerate(self.painters):
            mine = np.flatnonzero(photo == index)
            rgb = layer.rgb[down[mine], right[mine]]
            if self.balance is not None and len(mine):
                rgb = self.balance.shown(index, rgb, down[mine], right[mine])
            found[mine] = rgb
        return lab(found[None] / np.iinfo(found.dtype).max)[0]


@dataclass(frozen=True, kw_only=True)
class Steps:
    """Steps (n, 3), in CIE L*a*b*, of stretches along seams.

    Attributes:
        seen: steps from one photo to the other.
        wall: steps that each single photo shows across the same line, mean of both photos.
        share: share of seam cells where both photos show two cells on either side.
    """

    seen: NDArray[np.float64]
    wall: NDArray[np.float64]
    share: float

    def __str__(self) -> str:
        seen, wall, excess = (
            np.linalg.norm(values, axis=1).mean()
            for values in (self.seen, self.wall, self.seen - self.wall)
        )
        return (
            f"stretches {seen:.2f}, of the wall {wall:.2f}, excess {excess:.2f} "
            f"({self.share:.0%} of seams)"
        )


def steps(mosaic: Mosaic) -> Steps:
    """Measure steps where both photos show two cells on either side of a seam."""
    seen, wall = [], []
    n_seam = n_counted = 0
    for turned in (False, True):
        source = mosaic.image.source.T if turned else mosaic.image.source
        here = (source[:, :-1] != source[:, 1:]) & (source[:, :-1] >= 0) & (source[:, 1:] >= 0)
        n_seam += np.count_nonzero(here)
        rows, columns = np.nonzero(here)
        kept = (columns >= 1) & (columns + 2 < source.shape[1])
        rows, columns = rows[kept], columns[kept]
        both = source[rows, columns], source[rows, columns + 1]
        kept = np.ones(len(rows), dtype=np.bool_)
        for cell in range(-1, 3):
            for photo in both:
                kept &= mosaic.is_painted(photo, rows, columns + cell, turned=turned)
        rows, columns, both = rows[kept], columns[kept], [photo[kept] for photo in both]
        n_counted += len(rows)
        cells = [
            [mosaic.colours(photo, rows, columns + cell, turned=turned) for cell in range(-1, 3)]
            for photo in both
        ]
        # (photo, side, n, 3): means of two cells.
        shown = np.reshape(cells, (2, 2, 2, -1, 3)).mean(axis=2)
        # All cells of a stretch have the same two photos in the same order, so that steps from one
        # to the other and back do not cancel out.
        stretch = np.stack([rows // STRETCH, columns // STRETCH, *both])
        _, of, counts = np.unique(stretch, axis=1, return_inverse=True, return_counts=True)
        for found, values in (
            (seen, shown[0, 0] - shown[1, 1]),
            (wall, (shown[:, 0] - shown[:, 1]).mean(axis=0)),
        ):
            sums = np.zeros((len(counts), 3))
            np.add.at(sums, of, values)
            found.append((sums / counts[:, None])[counts >= STRETCH // 2])
    return Steps(
        seen=np.concatenate(seen), wall=np.concatenate(wall), share=n_counted / max(1, n_seam)
    )


def blocks(values: NDArray[np.floating]) -> NDArray[np.float64]:
    """Average blocks of 8 x 8 cells (rows, cols, channels)."""
    rows, columns = (size // BLOCK for size in values.shape[:2])
    cut = values[: rows * BLOCK, : columns * BLOCK]
    return np.asarray(cut.reshape(rows, BLOCK, columns, BLOCK, -1).mean((1, 3)), np.float64)


def levels(light: NDArray[np.floating]) -> NDArray[np.floating]:
    """Convert light to levels 0 to 1."""
    bright = np.clip(light, 0.0, 1.0)
    return np.where(bright <= 0.0031308, 12.92 * bright, 1.055 * bright ** (1 / 2.4) - 0.055)


def against(image: Orthoimage, reference: Orthoimage) -> str:
    """Compare block colours, up to a factor per channel, and gradients near seams and elsewhere."""
    both = (image.mask == OrthoMask.PAINTED) & (reference.mask == OrthoMask.PAINTED)
    whole = blocks(both[..., None].astype(float))[..., 0] == 1.0
    table = light_of_levels(255)
    mine, theirs = (blocks(table[item.rgb]) for item in (image, reference))
    factor = np.exp(np.median(np.log(theirs[whole] / mine[whole]), axis=0))
    off = np.linalg.norm(lab(levels(mine * factor)) - lab(levels(theirs)), axis=2)[whole]
    is_seam = np.zeros(both.shape, dtype=np.uint8)
    for axis in (0, 1):
        part = (slice(None, -1), slice(None)) if axis == 0 else (slice(None), slice(None, -1))
        is_seam[part] |= np.diff(image.source, axis=axis) != 0
    detail = []
    for item in (image, reference):
        light = lab(item.rgb / 255.0)[..., 0]
        detail.append(np.abs(np.diff(light, axis=1))[1:] + np.abs(np.diff(light, axis=0))[:, 1:])
    inner = cv2.erode(both.astype(np.uint8), np.ones((3, 3)))[1:, 1:] > 0
    about = {side: cv2.dilate(is_seam, np.ones((side, side)))[1:, 1:] > 0 for side in (3, 17, 65)}
    places = (about[17] & ~about[3] & inner, ~about[65] & inner)
    near, far = (detail[0][place].mean() / detail[1][place].mean() for place in places)
    return (
        f"off by {off.mean():.2f} on average, {np.percentile(off, 95):.2f} at 95 %; gradients "
        f"{near:.3f} near seams, {far:.3f} elsewhere"
    )


def exposed(layers: Layers, share: float) -> Layers:
    """Change the exposures of photos, with the largest differences between neighbours."""
    factors = 1.0 + share * np.linspace(-1.0, 1.0, len(layers.layers))
    factors = np.concatenate([factors[::2], factors[1::2]])
    table = light_of_levels(255)
    changed = tuple(
        replace(layer, rgb=np.rint(255.0 * levels(factor * table[layer.rgb])).astype(np.uint8))
        for layer, factor in zip(layers.layers, factors, strict=True)
    )
    return replace(layers, layers=changed)


def inputs_of_run(folder: Path, store: Store, exposure: float) -> MosaicSeams.In:
    """Return the inputs of a run's mosaic, with changed exposures."""
    run = open_run(folder)
    return MosaicSeams.In(
        layers=exposed(product(run, store, "ortho", Layers), exposure),
        walls=product(run, store, "wall", Walls),
        cameras=product(run, store, "orient", Cameras),
    )


def inputs_of_room(seed: int, share: float) -> MosaicSeams.In:
    """Generate a room from a seed, with true planes and cameras, varied exposure and vignetting."""
    with tempfile.TemporaryDirectory() as folder:

        def ctx() -> StepContext:
            return StepContext(
                rng=np.random.default_rng(seed), cores=2, scratch=Path(tempfile.mkdtemp(dir=folder))
            )

        params = SimulateRoom.Params(
            decoration="drawn",
            scan_step_m=0.006,
            panorama_step_m=0.03,
            photo_layout="quick",
            photo_gsd_m=0.004,
            photo_exposure_share=share,
            photo_vignetting_share=share,
        )
        room = SimulateRoom().run(SimulateRoom.In(), params, ctx())
        walls = (
            RasterGrid()
            .run(
                RasterGrid.In(cloud=room.cloud, planes=room.truth.planes),
                RasterGrid.Params(gsd_m=0.006, buffer_m=0.3, n_walls_max=1),
                ctx(),
            )
            .walls
        )
        cameras = room.truth.cameras
        seen = DsmBackward.In(walls=walls, cloud=room.cloud, photos=room.photos, cameras=cameras)
        layers = DsmBackward().run(seen, DsmBackward.Params(), ctx()).layers
    return MosaicSeams.In(layers=layers, walls=walls, cameras=cameras)


def mosaic(inputs: MosaicSeams.In, **chosen: object) -> Mosaic:
    """Return the mosaic of the first wall and its photos, balanced as the method balances them."""
    params = MosaicSeams.Params.model_validate(chosen)
    with tempfile.TemporaryDirectory() as folder:
        ctx = StepContext(rng=np.random.default_rng(0), cores=2, scratch=Path(folder))
        image = MosaicSeams().run(inputs, params, ctx).orthoimages.images[0]
    wall: Wall = inputs.walls.walls[0]
    layers = [layer for layer in inputs.layers.layers if layer.wall == image.wall]
    painters = tuple(next(item for item in layers if item.source == name) for name in image.sources)
    balance = None
    if params.gains != "none":
        cameras = {item.photo: item for item in inputs.cameras.cameras if item.status == "ok"}
        seen = [cameras.get(layer.source) for layer in painters]
        balance = balance_of(painters, wall, seen)
        if balance is not None:
            balance = with_seams(balance, image.source, wall)
    made = coloured(painters, image.source, balance, allocate=in_memory)
    np.testing.assert_array_equal(made, image.rgb)
    metrics = {item.name: item.value for item in ctx.metrics}
    return Mosaic(image=image, painters=painters, balance=balance, metrics=metrics)


def main() -> None:
    """Print one line without balancing, one with it, and one with balancing and graph cuts."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path, nargs="?")
    parser.add_argument("--room", type=int, metavar="SEED")
    parser.add_argument("--against", type=Path)
    parser.add_argument("--exposure", type=float, default=0.0)
    parser.add_argument("--store", type=Path, default=Path(".orthoflow"))
    chosen = parser.parse_args()
    store, one = Store(chosen.store), None
    if chosen.room is not None:
        inputs = inputs_of_room(chosen.room, 0.3)
        one = mosaic(inputs_of_room(chosen.room, 0.0), gains="none")
        print(f"one exposure: {one}")
    else:
        inputs = inputs_of_run(chosen.run, store, chosen.exposure)
        if chosen.against:
            one = mosaic(inputs_of_run(chosen.against, store, 0.0), gains="none")
        elif chosen.exposure:
            one = mosaic(inputs_of_run(chosen.run, store, 0.0))
    for params in ({"gains": "none"}, {}, {"seams": "graph-cut"}):
        made = mosaic(inputs, **params)
        print(
            f"{params or 'default'}: {made}"
            + (f"; {against(made.image, one.image)}" if one else "")
        )


if __name__ == "__main__":
    main()
