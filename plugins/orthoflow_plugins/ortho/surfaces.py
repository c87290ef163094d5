"""Preparation of walls and cameras for visibility tests."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import Bend, WallFrame
from orthoflow.geometry.bands import Allocate, bands_with_reach, in_memory
from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.geometry.depth_buffer_kernels import DepthBuffer
from orthoflow.geometry.robust import depth_noise_m
from orthoflow.products import Wall, Walls
from orthoflow.sdk import StepContext
from orthoflow_plugins.ortho.curved_kernels import look_at_curved_cells
from orthoflow_plugins.ortho.parameters import VisibilityParams
from orthoflow_plugins.ortho.visibility_kernels import (
    BLOCK_CELLS,
    FINE_CELLS,
    AxisView,
    Relief,
    TileVisibility,
    WallView,
    look_at_cells,
)

# A surface blocks a ray if it is above the ray by more than _TOLERANCE_SIGMAS standard deviations
# of depth plus _TOLERANCE_CELLS cells. The second term allows for detail finer than the raster.
_TOLERANCE_SIGMAS: Final = 3.0
_TOLERANCE_CELLS: Final = 0.5
# Width of the border strip of a photo in which quality decreases to 0, relative to the shorter
# side.
_BORDER_SHARE: Final = 0.05
# The occluding surface is computed in bands of this many cells.
BAND_CELLS: Final = 1 << 17
# A cell influences the occluding surface within this distance, in rows.
_REACH_ROWS: Final = 4
# Between neighbouring cells, a height difference of more than this many cells (79 degrees) is an
# edge.
_EDGE_CELLS: Final = 5.0


@dataclass(frozen=True, kw_only=True)
class Surface:
    """A wall prepared for visibility tests.

    Attributes:
        frame: grid of the cells.
        relief: depths of the cells, and the surface that hides other cells.
        front_m: largest depth of the relief; the depth buffer contains only points in front of it.
        tolerance_m: minimum height above a ray at which the surface blocks that ray.
    """

    frame: WallFrame
    relief: Relief
    front_m: float
    tolerance_m: float

    def local(
        self, places: Sequence[tuple[float, float]], depth_m: float
    ) -> list[tuple[float, ...]]:
        """Return positions (u, v, n) in the axes of a `WallView` of (column, row) at a depth."""
        frame = self.frame
        if frame.bend is None:
            return [(u * frame.gsd_m, v * frame.gsd_m, depth_m) for u, v in places]
        points = frame.bend.points(frame.gsd_m * np.array(places), depth_m)
        return [tuple(point) for point in points.tolist()]


def surfaces_of(walls: Walls, ctx: StepContext, *, hides: bool = True) -> list[Surface]:
    """Prepare all walls; if `hides` is false, they cannot hide parts of themselves."""
    return [
        surface_of(walls, index, hides=hides, allocate=_in_file(ctx, index))
        for index in range(len(walls.walls))
    ]


def _in_file(ctx: StepContext, index: int) -> Allocate:
    return lambda name, shape, dtype: ctx.allocate("relief", f"{index}.{name}", shape, dtype)


def surface_of(
    walls: Walls, index: int, *, hides: bool = True, allocate: Allocate = in_memory
) -> Surface:
    """Prepare one wall; `allocate` returns the array for the occluding surface."""
    wall = walls.walls[index]
    noise_m = depth_noise_m(wall.depth_m) if hides else 0.0
    return Surface(
        frame=wall.frame,
        relief=relief_of(wall, hides=hides, allocate=allocate),
        front_m=walls.slab(index).front_m,
        tolerance_m=_TOLERANCE_SIGMAS * noise_m + _TOLERANCE_CELLS * wall.frame.gsd_m,
    )


def view_of(
    camera: ViewingCamera, surface: Surface, params: VisibilityParams, sigma_m: float = 0.0
) -> WallView:
    """Return a camera in the axes of a wall, with full precision for large world coordinates.

    Args:
        camera: the camera.
        surface: the wall.
        params: visibility of cells.
        sigma_m: standard deviation of the camera's projection on the wall.
    """
    frame = surface.frame
    near = camera.shifted(frame.origin_world)
    flat, (right_m, down_m, height_m) = _in_axes(near, frame.axes_world)
    return WallView(
        camera=flat,
        column=right_m / frame.gsd_m - 0.5,
        row=down_m / frame.gsd_m - 0.5,
        height_m=height_m,
        gsd_m=float(frame.gsd_m),
        front_m=float(surface.front_m),
        tolerance_m=float(surface.tolerance_m),
        cosine_least=math.cos(math.radians(params.incidence_max_deg)),
        border_px=max(1.0, _BORDER_SHARE * min(camera.width, camera.height)),
        # Besides the tolerance of the depth, half a cell: colours are averaged over cells.
        outline_m=surface.tolerance_m + 0.5 * frame.gsd_m + _TOLERANCE_SIGMAS * sigma_m,
        **({} if frame.bend is None else _about_axis(near, frame, frame.bend)),
    )


def _in_axes(
    camera: ViewingCamera, axes: NDArray[np.float64]
) -> tuple[NDArray[np.float64], list[float]]:
    """Return the flat camera for points in other axes, rows (3, 3), and its centre in these."""
    flat = camera.flat.copy()
    flat[:9] = (camera.rotation @ axes.T).ravel()
    return flat, (axes @ camera.centre_world).tolist()


def _about_axis(near: ViewingCamera, frame: WallFrame, bend: Bend) -> dict[str, Any]:
    """Return a camera, relative to the corner of a raster, in the axes of its curved surface."""
    own, axes = bend.revolution, frame.axes_world
    flat, (first, second, axial) = _in_axes(near.shifted(own.start @ axes), own.axes @ axes)
    about = AxisView(
        first=first,
        second=second,
        axial=axial,
        radius_m=own.radius_m,
        sine=own.sine,
        cosine=own.cosine,
        side=own.side,
        middle_rad=bend.middle_rad(frame.size_m),
        place_x=float(own.place_m[0]),
        place_y=float(own.place_m[1]),
        along_x=float(own.along[0]),
        along_y=float(own.along[1]),
        aside_x=float(own.aside[0]),
        aside_y=float(own.aside[1]),
        fan=own.fan,
        round=float(own.is_sphere),
    )
    return {"about": about, "axial_camera": flat}


def cells_seen(
    view: WallView, relief: Relief, buffer: DepthBuffer, rows: slice, columns: slice
) -> TileVisibility:
    """Find the cells in a part of a wall that a photo shows, and their positions in the photo."""
    size = (rows.stop - rows.start, columns.stop - columns.start)
    u, v, quality = np.empty((3, *size), dtype=np.float32)
    visible = TileVisibility(u=u, v=v, mask=np.empty(size, dtype=np.uint8), quality=quality)
    look = look_at_cells if view.about.side == 0.0 else look_at_curved_cells
    look(view, relief, buffer, visible, rows.start, columns.start)
    return visible


def is_before(view: WallView, surface: Surface) -> bool:
    """Return whether a camera is in front of any part of a wall."""
    # The cells of a curved wall face different directions.
    return view.about.side != 0.0 or view.height_m > float(surface.relief.bottoms.min())


def relief_of(wall: Wall, *, hides: bool = True, allocate: Allocate = in_memory) -> Relief:
    """Prepare the surface of a wall for visibility tests from any position.

    Args:
        wall: the wall.
        hides: whether the surface can hide parts of itself.
        allocate: function that returns the array for the occluding surface.
    """
    depth = np.asarray(wall.depth_m, dtype=np.float32).view(np.ndarray)[:]
    side = FINE_CELLS if hides else BLOCK_CELLS
    bottoms = _of_blocks(depth, np.fmin, side)
    bottoms[np.isnan(bottoms)] = np.inf
    occluding, tops = np.empty((0, 0), dtype=np.float32), np.full_like(bottoms, -np.inf)
    if hides:
        occluding = np.asarray(allocate("occluding", depth.shape, np.float32), np.float32)
        edge_m = _EDGE_CELLS * wall.frame.gsd_m
        for band in bands_with_reach(depth.shape, cells_most=BAND_CELLS, reach_rows=_REACH_ROWS):
            occluding[band.rows] = _hiding(depth[band.around], edge_m)[band.inner]
        tops = _of_blocks(occluding, np.maximum, side)
    occluding = occluding.view(np.ndarray)
    # Kernels are compiled for read-only arrays only.
    depth.flags.writeable = occluding.flags.writeable = False
    return Relief(
        depth,
        occluding,
        tops=_of_blocks(tops, np.maximum, BLOCK_CELLS // side),
        bottoms=_of_blocks(bottoms, np.minimum, BLOCK_CELLS // side),
        fine_tops=tops,
        fine_bottoms=bottoms,
        highest_m=float(tops.max()),
    )


def _hiding(depth: NDArray[np.float32], edge_m: float) -> NDArray[np.float32]:
    """Return the occluding surface (rows, cols), without spikes and with complete edges.

    Voids of one cell are closed. A cell that is higher than all 2 x 2 patches that contain it is
    lowered, since an outlier in front of a wall would otherwise hide a long strip. The position of
    an edge within its cell is unknown; the lower cell next to a step of more than `edge_m` is
    therefore raised to the height of the higher one.
    """
    import cv2

    square, pair = np.ones((3, 3), dtype=np.uint8), np.ones((2, 2), dtype=np.uint8)
    border, is_void = cv2.BORDER_REPLICATE, np.isnan(depth)
    closed, spare = depth.copy(), np.empty_like(depth)
    np.copyto(closed, np.float32(-np.inf), where=is_void)
    cv2.dilate(closed, square, dst=spare, borderType=border)
    np.copyto(closed, spare, where=is_void)
    cv2.erode(closed, pair, dst=spare, anchor=(0, 0), borderType=border)
    opened = np.asarray(cv2.dilate(spare, pair, anchor=(1, 1), borderType=border), np.float32)
    highest = cv2.dilate(opened, square, dst=spare, borderType=border)
    with np.errstate(invalid="ignore"):
        is_edge = np.subtract(highest, opened, out=closed) > np.float32(edge_m)
    np.copyto(opened, highest, where=is_edge)
    return opened


def _of_blocks(
    values: NDArray[np.float32], reduce: np.ufunc, side_cells: int
) -> NDArray[np.float32]:
    """Reduce each block of cells to its extreme value; the last blocks may be smaller."""
    rows, columns = (range(0, size, side_cells) for size in values.shape)
    # Process bands of rows, since `reduceat` is slow along the first axis of a large array.
    bands = [reduce.reduce(values[row : row + side_cells], axis=0) for row in rows]
    reduced = reduce.reduceat(np.array(bands), columns, axis=1)
    return np.asarray(reduced, dtype=np.float32)
