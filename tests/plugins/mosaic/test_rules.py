"""`mosaic.seams`: where seams lie by each rule."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from orthoflow_plugins.mosaic.seams import MosaicSeams

from orthoflow.products import Layer, Layers, Orthoimage, Wall, Walls
from tests import inspect_scenes
from tests import raster_scenes as scenes

SHAPE = (40, 120)


def layer(
    name: str, columns: tuple[int, int], rgb: NDArray[np.uint8] | int, quality: float = 1.0
) -> Layer:
    """A layer that paints some columns of the wall."""
    colour = np.broadcast_to(np.asarray(rgb, dtype=np.uint8), (*SHAPE, 3))
    return inspect_scenes.painted_layer(name, slice(*columns), colour, quality)


def mosaic(
    folder: Path, *layers: Layer, walls: Walls | None = None, **params: object
) -> tuple[Orthoimage, dict[str, float], dict[str, object]]:
    ctx = scenes.context(folder)
    out = MosaicSeams().run(
        MosaicSeams.In(layers=Layers(layers=layers), walls=walls),
        MosaicSeams.Params.model_validate({"island_cells_min": 1, "gains": "none"} | params),
        ctx,
    )
    metrics = {metric.name: metric.value for metric in ctx.metrics}
    return out.orthoimages.images[0], metrics, dict(out.orthoimages.details)


def seam_columns(image: Orthoimage) -> NDArray[np.int64]:
    """First column of the second source in each row."""
    return np.argmax(image.source == 1, axis=1)


def textures() -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Two pictures that agree in columns 64 to 67 only."""
    rng = np.random.default_rng(4)
    one, other = (rng.integers(0, 256, (*SHAPE, 3)).astype(np.uint8) for _ in range(2))
    other[:, 64:68] = one[:, 64:68]
    return one, other


def test_a_graph_cut_runs_where_the_photos_agree(tmp_path: Path) -> None:
    one, other = textures()
    left, right = layer("left", (0, 100), one), layer("right", (20, 120), other)
    image, cut, _ = mosaic(tmp_path, left, right, seams="graph-cut")
    columns = seam_columns(image)
    assert ((columns >= 65) & (columns <= 67)).all()
    assert cut["seam_step_rms_grey"] == 0.0
    assert cut["seam_step_mean_delta_e"] == 0.0
    assert (image.source[:, :65] == 0).all()
    _, middle, _ = mosaic(tmp_path, left, right, seams="voronoi")
    assert middle["seam_step_rms_grey"] > 40.0


def test_a_graph_cut_keeps_off_depth_edges(tmp_path: Path) -> None:
    left, right = layer("left", (0, 100), 10), layer("right", (20, 120), 10)
    depth = np.zeros(SHAPE, dtype=np.float32)
    depth[:, 60:63] = 0.1
    wall = inspect_scenes.walls().walls[0]
    small = {
        field.name: getattr(wall, field.name)[: SHAPE[0], : SHAPE[1]]
        for field in dataclasses.fields(Wall)
        if isinstance(getattr(wall, field.name), np.ndarray)
    }
    stepped = dataclasses.replace(
        wall, frame=left.frame, **(small | {"depth_m": depth, "intensity": None})
    )
    walls = dataclasses.replace(inspect_scenes.walls(), walls=(stepped,))
    _, cut, _ = mosaic(tmp_path, left, right, walls=walls, seams="graph-cut")
    assert cut["seam_on_depth_edge_share"] == 0.0
    # The first photo is better up to where it ends, and that is where the edge is moved to.
    depth[:] = 0.0
    depth[:, 100:] = 0.1
    _, best, _ = mosaic(tmp_path, left, right, walls=walls)
    assert best["seam_on_depth_edge_share"] == 1.0
