"""What balancing does to colours: steps along seams, colours against one exposure, sharpness.

    orthoflow run quickstart.yaml -o one --store store --set room.photo_vignetting_share=0
    orthoflow run quickstart.yaml -o many --store store \\
        --set room.photo_exposure_share=0.3 --set room.photo_vignetting_share=0.3
    python benchmarks/balanced_colours.py many --against one --store store

`--exposure 0.3 --against RUN` with a run of real photos gives these 0.7 to 1.3 times their light.

Joins the layers of a run anew, untouched and balanced. Steps along a seam are told between the
means of two cells on either side, averaged over stretches of 24 cells: what is left of texture then
is what the same measure gives along lines 8 cells aside.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from orthoflow_plugins.mosaic.depth_edges import depth_edges
from orthoflow_plugins.mosaic.light import light_of_levels
from orthoflow_plugins.mosaic.seams import MosaicSeams

from orthoflow.engine.store import Store
from orthoflow.products import Cameras, Layers, Orthoimage, OrthoMask, Walls
from orthoflow.records import Run, open_run
from orthoflow.sdk import StepContext

STRETCH, ASIDE, NEAR = 24, 8, 4
BLOCK = 8


def product(run: Run, store: Store, step: str, cls: type) -> object:
    """The product of a type that a step of a run gave."""
    return next(
        store.get_product(output.digest, cls)
        for output in run.cells[step].outputs.values()
        if output.type_name == cls.type_name
    )


def lab(rgb: NDArray[np.floating]) -> NDArray[np.float32]:
    """CIE L*a*b* of levels 0 to 1."""
    return np.asarray(cv2.cvtColor(rgb.astype(np.float32), cv2.COLOR_RGB2Lab), np.float32)


def steps(image: Orthoimage, is_edge: NDArray[np.bool_], aside: int) -> NDArray[np.float64]:
    """Mean steps of stretches of seams off depth edges, or of lines so many cells aside."""
    colours = lab(image.rgb / 255.0)
    found = []
    for turned in (False, True):
        source, levels, edge = (
            (values.swapaxes(0, 1) if turned else values)
            for values in (image.source, colours, is_edge)
        )
        here = (source[:, :-1] != source[:, 1:]) & (source[:, :-1] >= 0) & (source[:, 1:] >= 0)
        rows, columns = np.nonzero(here & ~edge[:, 1:] & ~edge[:, :-1])
        kept = (columns >= ASIDE + 2) & (columns + ASIDE + 3 < source.shape[1])
        for cell in range(1, NEAR + 1):
            kept &= source[rows, columns + 1 - cell] == source[rows, columns]
            after = np.minimum(columns + cell, source.shape[1] - 1)
            kept &= source[rows, after] == source[rows, np.minimum(columns + 1, after)]
        rows, columns = rows[kept], columns[kept] + aside
        before, behind = (
            0.5 * (levels[rows, columns + first] + levels[rows, columns + first + 1])
            for first in (-1, 1)
        )
        stretch = rows // STRETCH * source.shape[1] + (columns - aside) // STRETCH
        _, of, counts = np.unique(stretch, return_inverse=True, return_counts=True)
        sums = np.zeros((len(counts), 3))
        np.add.at(sums, of, before - behind)
        found.append(np.linalg.norm(sums / counts[:, None], axis=1)[counts >= STRETCH // 2])
    return np.concatenate(found)


def blocks(values: NDArray[np.floating]) -> NDArray[np.float64]:
    """Means of blocks of 8 x 8 cells (rows, cols, channels)."""
    rows, columns = (size // BLOCK for size in values.shape[:2])
    cut = values[: rows * BLOCK, : columns * BLOCK]
    return np.asarray(cut.reshape(rows, BLOCK, columns, BLOCK, -1).mean((1, 3)), np.float64)


def levels(light: NDArray[np.floating]) -> NDArray[np.floating]:
    """Levels 0 to 1 of light."""
    bright = np.clip(light, 0.0, 1.0)
    return np.where(bright <= 0.0031308, 12.92 * bright, 1.055 * bright ** (1 / 2.4) - 0.055)


def against(image: Orthoimage, reference: Orthoimage) -> str:
    """Colours of blocks up to one factor per channel, and gradients near seams and elsewhere."""
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
    """Layers of photos that had so much more or less light, neighbours as unlike as can be."""
    factors = 1.0 + share * np.linspace(-1.0, 1.0, len(layers.layers))
    factors = np.concatenate([factors[::2], factors[1::2]])
    table = light_of_levels(255)
    changed = tuple(
        replace(layer, rgb=np.rint(255.0 * levels(factor * table[layer.rgb])).astype(np.uint8))
        for layer, factor in zip(layers.layers, factors, strict=True)
    )
    return replace(layers, layers=changed)


def main() -> None:
    """Print a line for untouched, balanced, and balanced along graph cuts."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--against", type=Path)
    parser.add_argument("--exposure", type=float, default=0.0)
    parser.add_argument("--store", type=Path, default=Path(".orthoflow"))
    chosen = parser.parse_args()
    store = Store(chosen.store)

    def mosaic(
        run: Run, exposure: float = 0.0, **params: object
    ) -> tuple[Orthoimage, NDArray[np.bool_], dict]:
        walls = product(run, store, "wall", Walls)
        inputs = MosaicSeams.In(
            layers=exposed(product(run, store, "ortho", Layers), exposure),
            walls=walls,
            cameras=product(run, store, "orient", Cameras),
        )
        with tempfile.TemporaryDirectory() as folder:
            ctx = StepContext(rng=np.random.default_rng(0), cores=2, scratch=Path(folder))
            out = MosaicSeams().run(inputs, MosaicSeams.Params.model_validate(params), ctx)
        depth_m = walls.walls[0].depth_m
        is_edge = (depth_edges(depth_m) | np.isnan(depth_m)).astype(np.uint8)
        is_near = cv2.dilate(is_edge, np.ones((2 * NEAR + 1,) * 2)) > 0
        return out.orthoimages.images[0], is_near, {item.name: item.value for item in ctx.metrics}

    run = open_run(chosen.run)
    one = mosaic(open_run(chosen.against), gains="none")[0] if chosen.against else None
    for params in ({"gains": "none"}, {}, {"seams": "graph-cut"}):
        image, is_edge, metrics = mosaic(run, chosen.exposure, **params)
        seam = steps(image, is_edge, 0).mean()
        texture = np.mean([steps(image, is_edge, side).mean() for side in (-ASIDE, ASIDE)])
        print(
            f"{params or 'default'}: same cells {metrics['seam_step_mean_delta_e']:.2f}, "
            f"stretches {seam:.2f} at seams, {texture:.2f} aside"
            + (f"; {against(image, one)}" if one is not None else "")
        )


if __name__ == "__main__":
    main()
