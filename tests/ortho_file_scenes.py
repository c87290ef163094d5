"""Orthoimages in files, as a run publishes them: a wall with a hole and a floor beside it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.publishing import publish_orthoimages
from orthoflow.files.sidecars import OrthoFile, ortho_files
from orthoflow.geometry import WallFrame
from orthoflow.products import Orthoimages
from tests import samples

CORNER = np.array([691_000.25, 5_334_000.5, 523.0])
UP = np.array([0.0, 0.0, 1.0])
GSD_M = 0.005
# Columns and rows: neither fits into tiles.
WALL_SHAPE = (701, 1103)
FLOOR_SHAPE = (300, 1103)


def colours(shape: tuple[int, int]) -> NDArray[np.uint8]:
    """Red grows to the right, green downwards: smooth, so that pictures of any size show it."""
    rows, columns = np.indices(shape)
    red, green = 255 * columns / shape[1], 255 * rows / shape[0]
    return np.dstack([red, green, np.full(shape, 60.0)]).astype(np.uint8)


def room(folder: Path) -> tuple[OrthoFile, ...]:
    """Publish both below a folder and open them."""
    east, south = np.array([1.0, 0.0, 0.0]), np.array([0.0, -1.0, 0.0])
    height_m = WALL_SHAPE[0] * GSD_M
    # Seen from the south; the floor begins at its foot and reaches to the viewer.
    frames = [
        WallFrame(
            origin_world=CORNER,
            u_world=east,
            v_world=-UP,
            normal_world=south,
            gsd_m=GSD_M,
            width=WALL_SHAPE[1],
            height=WALL_SHAPE[0],
        ),
        WallFrame(
            origin_world=CORNER - height_m * UP,
            u_world=east,
            v_world=south,
            normal_world=UP,
            gsd_m=GSD_M,
            width=FLOOR_SHAPE[1],
            height=FLOOR_SHAPE[0],
        ),
    ]
    masks = [np.ones(frame.shape, np.uint8) for frame in frames]
    masks[0][100:300, 200:500] = 0
    images = tuple(
        samples.orthoimage(
            frame,
            wall=k,
            name=("wall </script> 0", "floor 1")[k],
            rgb=colours(frame.shape) * mask[:, :, None],
            mask=mask,
        )
        for k, (frame, mask) in enumerate(zip(frames, masks, strict=True))
    )
    folder.mkdir()
    publish_orthoimages(Orthoimages(images=images), folder, "sha256:" + "1" * 64)
    return ortho_files(sorted(folder.iterdir()))
