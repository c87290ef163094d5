"""No direction is favoured: turned or mirrored layers are joined along turned seams."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from orthoflow_plugins.mosaic.seams import MosaicSeams

from orthoflow.products import Layer, LayerMask, Layers, Orthoimage, Walls
from tests import inspect_scenes, samples
from tests import raster_scenes as scenes
from tests.turns import OTHER_TURNS, TURNS, Turn


def layers_and_walls(shape: tuple[int, int], turn: Turn) -> tuple[Layers, Walls]:
    import cv2

    rng = np.random.default_rng(3)
    frame = inspect_scenes.frame(shape=turn.shape(shape))
    rows, columns = np.mgrid[: shape[0], : shape[1]] + 0.5
    layers = []
    for k, (at_row, at_column) in enumerate(rng.uniform(0.2, 0.8, (3, 2)) * shape):
        distance = np.hypot(rows - at_row, columns - at_column)
        is_painted = distance < 0.6 * max(shape)
        grey = cv2.GaussianBlur(rng.normal(0.0, 1.0, (*shape, 3)), (0, 0), 3.0)
        rgb = np.clip(128.0 + 300.0 * grey + 10.0 * k, 0, 255).astype(np.uint8)
        quality = np.where(is_painted, 1.0 / (1.0 + distance), 0.0).astype(np.float32)
        layers.append(
            Layer(
                frame=frame,
                wall=0,
                source=f"photo {k}",
                rgb=turn.raster(np.where(is_painted[..., None], rgb, np.uint8(0))),
                mask=turn.raster(
                    np.where(is_painted, LayerMask.PAINTED, LayerMask.OUTSIDE).astype(np.uint8)
                ),
                quality=turn.raster(quality),
            )
        )
    is_near = np.hypot(rows - 0.5 * shape[0], columns - 0.4 * shape[1]) < 0.2 * min(shape)
    depth_m = np.where(is_near, np.float32(0.05), np.float32(0.0))
    wall = samples.wall(
        frame, depth_m=turn.raster(depth_m), mask=np.ones(frame.shape, dtype=np.uint8)
    )
    walls = samples.walls(wall, buffer_m=0.1)
    return Layers(layers=tuple(layers), names=("wall 0",)), walls


def mosaic(shape: tuple[int, int], turn: Turn, folder: Path, **params: object) -> Orthoimage:
    layers, walls = layers_and_walls(shape, turn)
    chosen = MosaicSeams.Params.model_validate(params)
    inputs = MosaicSeams.In(layers=layers, walls=walls)
    return MosaicSeams().run(inputs, chosen, scenes.context(folder)).orthoimages.images[0]


@pytest.mark.parametrize("turn", OTHER_TURNS, ids=str)
@pytest.mark.parametrize(
    ("seams", "shape"),
    [
        ("best-view", (41, 58)),
        ("voronoi", (41, 58)),
        ("priority", (41, 58)),
        ("graph-cut", (41, 58)),
        # Cut at half and a third of the size, which does not go into the sides.
        ("graph-cut", (205, 170)),
    ],
)
def test_turned_layers_are_joined_along_turned_seams(
    tmp_path: Path, seams: str, shape: tuple[int, int], turn: Turn
) -> None:
    params = {
        "seams": seams,
        "priority": ["photo 2"] if seams == "priority" else [],
        "gains": "none",
    }
    image = mosaic(shape, TURNS[0], tmp_path, **params)
    turned = mosaic(shape, turn, tmp_path, **params)
    assert len(np.unique(image.source)) >= 3
    np.testing.assert_array_equal(turned.source, turn.raster(image.source))
    np.testing.assert_array_equal(turned.mask, turn.raster(image.mask))
    np.testing.assert_array_equal(turned.rgb, turn.raster(image.rgb))
