"""Walls resampled to the grids of orthoimages."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import DTypeLike, NDArray

from orthoflow.errors import MethodError
from orthoflow.geometry import angle_between_deg
from orthoflow.geometry.bands import IN_MEMORY_CELLS, Allocate, in_memory
from orthoflow.geometry.cameras import to_opencv
from orthoflow.products import Orthoimage, Orthoimages, SurfaceMask, Wall, Walls

if TYPE_CHECKING:
    from orthoflow.sdk import StepContext

_SAME_DIRECTION_DEG: Final = 2.0


def on_walls(images: Orthoimages, walls: Walls) -> Orthoimages:
    """Return orthoimages whose `wall` is the index of their wall among the given walls.

    Orthoimages from other programs, and those of walls that were rasterised in another step,
    contain the index of a plane but not of one of these walls.

    Raises:
        MethodError: none of the walls is on the plane of an orthoimage.
    """
    places = {wall.plane_index: index for index, wall in enumerate(walls.walls)}
    placed = []
    for image in images.images:
        index = image.wall if image.plane_index is None else places.get(image.plane_index, -1)
        if not 0 <= index < len(walls.walls):
            raise MethodError(
                f"orthoimage {image.name} shows wall {image.number}, which is not among the "
                f"connected walls ({', '.join(map(str, sorted(places))) or 'none'}): connect the "
                "walls from which the orthoimages were made"
            )
        number = walls.walls[index].plane_index
        placed.append(replace(image, wall=index, plane_index=number))
    return replace(images, images=tuple(placed))


def in_files(ctx: StepContext, name: str) -> Allocate:
    """Return a function that allocates arrays in files of the scratch folder."""

    def allocate(field: str, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[np.generic]:
        return ctx.allocate("inspection", f"{name}.{field}", shape, dtype).view(np.ndarray)

    return allocate


def wall_of(image: Orthoimage, walls: Walls, allocate: Allocate = in_memory) -> Wall:
    """Return the wall of an orthoimage from `on_walls`, resampled to the grid of the image.

    Orthoimages from other programs have different grids. Each of their cells takes the values of
    the nearest cell of the wall, with the depth relative to the plane of the image. The intensity
    is interpolated between the four nearest cells.

    Args:
        image: the orthoimage.
        walls: all walls.
        allocate: function that allocates the resampled arrays.

    Raises:
        MethodError: the image is not on the wall.
    """
    wall = walls.walls[image.wall]
    if wall.frame.has_cells_of(image.frame):
        return wall
    _require_nearness(image, wall, walls)
    return _laid_onto(image, wall, allocate if image.mask.size > IN_MEMORY_CELLS else in_memory)


def _require_nearness(image: Orthoimage, wall: Wall, walls: Walls) -> None:
    middle = image.frame.corners_world().mean(axis=0)
    if image.frame.bend is not None:
        middle = image.frame.middle_world
    aside = float(wall.frame.wall_from_world(middle[None])[0, 2])
    angle = angle_between_deg(image.frame.facing_world, wall.frame.facing_world)
    slab = walls.slab(image.wall)
    if angle > _SAME_DIRECTION_DEG or not (-slab.behind_m <= aside <= slab.front_m):
        raise MethodError(
            f"orthoimage {image.name} is {abs(aside):.3f} m "
            f"{'behind' if aside < 0.0 else 'in front of'} {wall.name} and rotated by {angle:.2f} "
            "deg: connect the walls that the orthoimages show"
        )


def _laid_onto(image: Orthoimage, wall: Wall, allocate: Allocate) -> Wall:
    """Resample the wall row by row, so that large images need little memory."""
    import cv2

    frame = image.frame
    columns = np.arange(frame.width) + 0.5
    # Fields of the wall, each with its value outside the wall.
    given: dict[str, tuple[NDArray[Any], float]] = {
        "depth_m": (wall.depth_m, np.nan),
        "sigma_m": (wall.sigma_m, np.nan),
        "count": (wall.count, 0),
        "mask": (wall.mask, int(SurfaceMask.VOID)),
    }
    laid = {name: allocate(name, frame.shape, held.dtype) for name, (held, _) in given.items()}
    intensity = None
    if wall.intensity is not None:
        intensity = np.asarray(allocate("intensity", frame.shape, np.float32), np.float32)
    for row in range(frame.height):
        points = frame.world_from_wall(np.column_stack([columns, np.full(frame.width, row + 0.5)]))
        exact = wall.frame.wall_from_world(points)[:, :2]
        if wall.intensity is not None and intensity is not None:
            at = to_opencv(exact).astype(np.float32).T[:, None]
            intensity[row] = cv2.remap(
                wall.intensity, at[0], at[1], cv2.INTER_LINEAR, borderValue=(np.nan,)
            )[0]
        places = np.floor(exact).astype(np.int64)
        inside = np.all((places >= 0) & (places < (wall.frame.width, wall.frame.height)), axis=1)
        right, down = places[inside].T
        for name, (held, nothing) in given.items():
            laid[name][row] = nothing
            laid[name][row, inside] = held[down, right]
        surface = wall.frame.world_from_wall(
            (places[inside] + 0.5).astype(np.float64),
            wall.depth_m[down, right].astype(np.float64),
        )
        laid["depth_m"][row, inside] = frame.wall_from_world(surface)[:, 2]
    arrays: dict[str, Any] = laid
    return replace(wall, frame=frame, **arrays, intensity=intensity, rgb=None, rgb_mask=None)
