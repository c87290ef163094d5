"""A wall as triangles: its rectangle, or its relief as the depth raster has it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import InputError
from orthoflow.files.geotiff import RasterParts
from orthoflow.geometry import WallFrame

# Along the longest side of a wall; some 300,000 triangles, which phones still turn.
LONGEST_NODES: Final = 512


@dataclass(frozen=True, kw_only=True)
class WallMesh:
    """Triangles of a wall, from the top-left corner of its raster.

    Attributes:
        vertices: (n, 3) float32 metres: x to the right, y upwards, z towards the viewer.
        places: (n, 2) float32 in the picture of the wall, (0, 0) top-left to (1, 1).
        triangles: (m, 3) vertices, counterclockwise for the viewer; uint16 or uint32.
    """

    vertices: NDArray[np.float32]
    places: NDArray[np.float32]
    triangles: NDArray[np.uint16 | np.uint32]


def flat_mesh(frame: WallFrame) -> WallMesh:
    """Give the rectangle of a wall."""
    places = np.array([[0, 0], [0, 1], [1, 1], [1, 0]], dtype=np.float32)
    return WallMesh(
        vertices=_lifted(frame, places, np.zeros(4)),
        places=places,
        triangles=np.array([[0, 1, 2], [0, 2, 3]], dtype=np.uint16),
    )


def relief_mesh(frame: WallFrame, depth: Path) -> WallMesh:
    """Give the surface of a wall; its rectangle where nothing of its depth is known.

    Nodes are means of cells, at most `LONGEST_NODES` along a side. Triangles with a node of unknown
    depth are left out; steps become slopes one node wide.

    Args:
        frame: of the wall.
        depth: GeoTIFF of its depths in metres, towards the viewer.

    Raises:
        InputError: the file cannot be read, or has other cells than the wall.
    """
    rows, columns = frame.shape
    factor = max(1.0, max(rows, columns) / LONGEST_NODES)
    shape = (max(1, round(rows / factor)), max(1, round(columns / factor)))
    with RasterParts(depth) as raster:
        if raster.shape != frame.shape:
            raise InputError(
                f"{depth} has {raster.shape[1]} x {raster.shape[0]} cells, expected the "
                f"{columns} x {rows} of the orthoimage"
            )
        depths, shown = raster.read((0.0, 0.0, float(columns), float(rows)), shape)
    is_known = (shown & np.isfinite(depths)).ravel()
    node = np.arange(is_known.size, dtype=np.uint32).reshape(shape)
    corners = [
        part.ravel() for part in (node[:-1, :-1], node[1:, :-1], node[1:, 1:], node[:-1, 1:])
    ]
    triangles = np.concatenate([np.stack([corners[k] for k in (0, i, i + 1)], 1) for i in (1, 2)])
    used, triangles = np.unique(triangles[is_known[triangles].all(axis=1)], return_inverse=True)
    if not len(used):
        return flat_mesh(frame)
    down, right = np.meshgrid(*(_places(size) for size in shape), indexing="ij")
    places = np.stack([right.ravel(), down.ravel()], axis=1)[used]
    return WallMesh(
        vertices=_lifted(frame, places, depths.ravel()[used]),
        places=places,
        triangles=triangles.reshape(-1, 3).astype(np.uint32),
    )


def _places(count: int) -> NDArray[np.float32]:
    """Where nodes of a side lie, 0 to 1: in the middle of their cells, the outer at its ends."""
    places = (np.arange(count) + 0.5) / count
    places[0], places[-1] = 0.0, 1.0
    return places.astype(np.float32)


def _lifted(
    frame: WallFrame, places: NDArray[np.float32], depths_m: NDArray[np.generic]
) -> NDArray[np.float32]:
    sides_m = np.array([frame.width, -frame.height]) * frame.gsd_m
    return np.column_stack([places * sides_m, depths_m]).astype(np.float32)
