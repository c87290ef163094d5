"""Where an orthoimage stretches its photos, so that one pixel is drawn over several cells.

A surface that a photo sees nearly edge on has few pixels there, however many cells it has: the
stretches and smears that skarlatos2012 describes along vertical surfaces. Which pixel a cell takes
follows from the wall's depths and the photo's camera, so how far apart the pixels of neighbouring
cells lie is known exactly, whatever the picture shows.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import WallFrame
from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.products import Cameras, Finding, Orthoimage, OrthoMask, Wall

# A pixel drawn over more cells than this, in the direction where it is widest.
STRETCHED_CELLS: Final = 2.0
SMEARED_CELLS: Final = 5.0
# Cells of a photo that are asked; more say nothing else.
_CELLS_MOST: Final = 200_000


def stretch_findings(image: Orthoimage, wall: Wall, cameras: Cameras | None) -> list[Finding]:
    """Shares of painted cells whose photo is stretched or smeared there; none without cameras.

    `stretch_share` are cells of which one pixel covers more than two in some direction,
    `smear_share` those where it covers more than five, or that show the surface from behind.

    Args:
        image: the orthoimage.
        wall: the wall it is of, on the same cells.
        cameras: of its photos.
    """
    if cameras is None:
        return []
    spread = np.concatenate(
        [np.zeros(0), *(cells_per_pixel(image, wall, camera) for camera in _known(cameras))]
    )
    if not len(spread):
        return []
    return [
        Finding(name=name, value=float(np.mean(spread > most)), unit="1", wall=image.wall)
        for name, most in (("stretch_share", STRETCHED_CELLS), ("smear_share", SMEARED_CELLS))
    ]


def cells_per_pixel(
    image: Orthoimage, wall: Wall, camera: tuple[str, ViewingCamera]
) -> NDArray[np.float64]:
    """How many cells one pixel of a photo covers where it is widest, at cells that it painted.

    Args:
        image: the orthoimage.
        wall: the wall it is of, on the same cells.
        camera: name of the photo, and its camera.

    Returns:
        (n,) cells per pixel, of at most some hundred thousand cells spread evenly; infinite where
        the surface shows its back.
    """
    name, viewing = camera
    if name not in image.sources:
        return np.zeros(0)
    painted = (image.mask == OrthoMask.PAINTED) & np.isfinite(wall.depth_m)
    cells = np.flatnonzero(painted & (image.source == image.sources.index(name)))
    cells = cells[:: max(1, len(cells) // _CELLS_MOST)]
    rows, columns = np.divmod(cells, image.frame.width)
    # Survey coordinates would cost digits.
    near = replace(image.frame, origin_world=np.zeros(3))
    moved = viewing.shifted(image.frame.origin_world)
    depth = wall.depth_m[rows, columns].astype(np.float64)
    places = np.column_stack([columns + 0.5, rows + 0.5])
    at = moved.project(near.world_from_wall(places, depth))[:, :2]
    along = [
        moved.project(_neighbours(near, wall, places, depth, step))[:, :2] - at
        for step in ((1, 0), (0, 1))
    ]
    jacobian = np.stack(along, axis=2)
    with np.errstate(divide="ignore", invalid="ignore"):
        spread = 1.0 / np.linalg.svd(np.nan_to_num(jacobian), compute_uv=False)[:, 1]
        # The image of a surface seen from the front runs as the wall does: u right, v down.
        spread[np.linalg.det(jacobian) <= 0.0] = np.inf
    known: NDArray[np.float64] = spread[np.isfinite(jacobian).all(axis=(1, 2))]
    return known


def _known(cameras: Cameras) -> list[tuple[str, ViewingCamera]]:
    return [(item.photo, item.viewing()) for item in cameras.cameras if item.status == "ok"]


def _neighbours(
    frame: WallFrame,
    wall: Wall,
    places: NDArray[np.float64],
    depth: NDArray[np.float64],
    step: tuple[int, int],
) -> NDArray[np.float64]:
    """Points one cell further (column, row) on the surface, which goes on as it does at the cell.

    Of the slopes on both sides the smaller one counts: at a depth step the other is the step's.
    """
    rows, columns = (places[:, 1] - 0.5).astype(np.int64), (places[:, 0] - 0.5).astype(np.int64)
    after = _depth_at(wall, rows + step[1], columns + step[0]) - depth
    before = depth - _depth_at(wall, rows - step[1], columns - step[0])
    with np.errstate(invalid="ignore"):
        is_after = np.isnan(before) | (np.abs(after) <= np.abs(before))
    slope = np.nan_to_num(np.where(is_after & ~np.isnan(after), after, before))
    points: NDArray[np.float64] = frame.world_from_wall(places + step, depth + slope)
    return points


def _depth_at(
    wall: Wall, rows: NDArray[np.int64], columns: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Depths (n,) of cells; NaN outside the wall."""
    height, width = wall.depth_m.shape
    inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    found = np.full(len(rows), np.nan)
    found[inside] = wall.depth_m[rows[inside], columns[inside]]
    return found
