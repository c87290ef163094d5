"""Walls as photos see them: which parts of a surface hide others, and cameras in its axes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import DTypeLike, NDArray

from orthoflow.geometry import WallFrame
from orthoflow.geometry.bands import Allocate, in_memory
from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.geometry.depth_noise import depth_noise_m
from orthoflow.geometry.threads import in_parts
from orthoflow.products import Wall, Walls
from orthoflow.sdk import StepContext
from orthoflow_plugins.ortho.photos_on_walls import VisibilityParams
from orthoflow_plugins.ortho.relief_kernels import bound_blocks, make_occluding
from orthoflow_plugins.ortho.views import BLOCK_CELLS, FINE_CELLS, NOTHING_M, Relief, WallView

# Lookup tables of walls with more cells are kept in files.
_IN_MEMORY_MOST: Final = 1 << 26
# Heights fit into 16 bits with a margin for rounding.
_STEPS: Final = 32_000
# Cells this much lower than a neighbour, in cells, are at an edge: steeper than 79 degrees.
_EDGE_CELLS: Final = 5.0


@dataclass(frozen=True, kw_only=True)
class Surface:
    """A wall prepared for visibility tests.

    Attributes:
        frame: where the cells lie.
        relief: their depths, and which of them hide others.
        front_m: up to this depth the relief holds all points.
        tolerance_m: how far a surface must be above a ray to hide it.
    """

    frame: WallFrame
    relief: Relief
    front_m: float
    tolerance_m: float


def surfaces_of(
    walls: Walls, params: VisibilityParams, ctx: StepContext, *, hides: bool = True
) -> list[Surface]:
    """Each wall as the surface that rays hit; with `hides` false its relief hides nothing."""

    def prepared(index: int, wall: Wall) -> Relief:
        if not hides:
            return transparent_relief_of(wall, threads=ctx.cores)
        return relief_of(wall, threads=ctx.cores, allocate=partial(_allocated, ctx, index))

    return [
        Surface(
            frame=wall.frame,
            relief=prepared(index, wall),
            front_m=walls.slab(index).front_m,
            tolerance_m=params.tolerance_sigma * depth_noise_m(wall.depth_m)
            + params.tolerance_cells * wall.frame.gsd_m,
        )
        for index, wall in enumerate(walls.walls)
    ]


def _allocated(
    ctx: StepContext, wall: int, name: str, shape: tuple[int, ...], dtype: DTypeLike
) -> NDArray[np.generic]:
    """Prepare a wall, in a file if it is large."""
    if math.prod(shape) <= _IN_MEMORY_MOST:
        return np.empty(shape, dtype=dtype)
    return ctx.allocate("relief", f"{wall}.{name}", shape, dtype)


def view_of(
    camera: ViewingCamera, surface: Surface, params: VisibilityParams, *, is_exact: bool = False
) -> WallView:
    """Return a camera in the axes of a wall, without loss of precision at survey coordinates.

    Args:
        camera: of the photo.
        surface: the wall.
        params: when the photo counts as seeing a cell.
        is_exact: project every cell by itself.
    """
    frame = surface.frame
    axes = np.column_stack([frame.u_world, frame.v_world, frame.normal_world])
    near = camera.shifted(frame.origin_world)
    flat = near.flat.copy()
    flat[:9] = (near.rotation @ axes).ravel()
    centre = axes.T @ near.centre_world
    return WallView(
        camera=flat,
        column=float(centre[0]) / frame.gsd_m - 0.5,
        row=float(centre[1]) / frame.gsd_m - 0.5,
        height_m=float(centre[2]),
        gsd_m=float(frame.gsd_m),
        front_m=float(surface.front_m),
        tolerance_m=float(surface.tolerance_m),
        cosine_least=math.cos(math.radians(params.incidence_max_deg)),
        border_px=max(1.0, params.border_share * min(camera.width, camera.height)),
        is_exact=is_exact,
    )


def is_before(view: WallView, surface: Surface) -> bool:
    """Whether a camera is in front of any of a wall; from behind nothing is seen."""
    return view.height_m > float(surface.relief.bottoms.min())


def relief_of(wall: Wall, *, threads: int, allocate: Allocate | None = None) -> Relief:
    """Prepare a wall for views from anywhere.

    Args:
        wall: its depths.
        threads: number of threads.
        allocate: returns the array of the heights that hide, two bytes per cell; None for memory.
    """
    relief = transparent_relief_of(wall, threads=threads)
    step_m = max(1e-6, _largest_m(relief) / _STEPS)
    given = (allocate or in_memory)("occluding", relief.depth.shape, np.int16)
    occluding = np.asarray(given, np.int16)
    fine_tops = np.empty_like(relief.fine_bottoms)
    edge_m = _EDGE_CELLS * wall.frame.gsd_m
    task = partial(make_occluding, relief.depth, step_m, edge_m, occluding, fine_tops)
    in_parts(task, fine_tops.shape[0], threads=threads)
    # Kernels are compiled once, for read-only arrays.
    occluding.flags.writeable = False
    tops = _coarse(fine_tops, np.maximum)
    return relief._replace(
        occluding=occluding.reshape(-1),
        step_m=float(step_m),
        tops=_highest_of_four(tops),
        fine_tops=_highest_of_four(fine_tops),
        highest_m=float(tops.max(initial=NOTHING_M)),
    )


def transparent_relief_of(wall: Wall, *, threads: int) -> Relief:
    """Prepare a wall that hides nothing of itself; it takes no memory per cell."""
    depth = np.asarray(wall.depth_m, dtype=np.float32).view(np.ndarray)[:]
    depth.flags.writeable = False
    shape = tuple(-(-side // FINE_CELLS) for side in depth.shape)
    fine_bottoms = np.empty(shape, dtype=np.float32)
    fine_crests = np.empty_like(fine_bottoms)
    in_parts(partial(bound_blocks, depth, fine_bottoms, fine_crests), shape[0], threads=threads)
    nothing = np.empty(0, dtype=np.int16)
    nothing.flags.writeable = False
    bottoms = _coarse(fine_bottoms, np.minimum)
    return Relief(
        depth=depth,
        occluding=nothing,
        step_m=1.0,
        tops=np.full(bottoms.shape, NOTHING_M, dtype=np.float32),
        bottoms=bottoms,
        crests=_coarse(fine_crests, np.maximum),
        fine_tops=np.full((1, 1), NOTHING_M, dtype=np.float32),
        fine_bottoms=fine_bottoms,
        highest_m=NOTHING_M,
    )


def _largest_m(relief: Relief) -> float:
    """Return the maximum distance of the surface from its plane; 0 without a surface."""
    bounds = np.concatenate([relief.bottoms.ravel(), relief.crests.ravel()])
    return float(np.abs(bounds[np.isfinite(bounds)]).max(initial=0.0))


def _coarse(fine: NDArray[np.float32], reduce: np.ufunc) -> NDArray[np.float32]:
    """Return the extreme of each large block, from its small ones."""
    for _ in range(2):
        fine = _reduced_rows(fine, reduce).T
    return np.ascontiguousarray(fine)


def _reduced_rows(fine: NDArray[np.float32], reduce: np.ufunc) -> NDArray[np.float32]:
    """Return the extreme of the rows in each large block; the last may have fewer."""
    per_block = BLOCK_CELLS // FINE_CELLS
    coarse = fine[::per_block].copy()
    for k in range(1, per_block):
        part = fine[k::per_block]
        reduce(coarse[: len(part)], part, out=coarse[: len(part)])
    return coarse


def _highest_of_four(tops: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the highest in each window of 2 x 2 blocks, beginning before the first block."""
    padded = np.pad(tops, 1, constant_values=NOTHING_M)
    pairs = np.maximum(padded[:-1], padded[1:])
    return np.maximum(pairs[:, :-1], pairs[:, 1:])
