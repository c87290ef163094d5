"""Elevations: the walls of a room or the facades of a building unfolded at their true heights."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.drawings import pens
from orthoflow.files.drawings.papers import Part, View
from orthoflow.files.drawings.sheet_contents import (
    Axes,
    Drawing,
    Picture,
    Placed,
    SheetText,
    up_words,
)
from orthoflow.files.drawings.wall_drawings import draw_raster
from orthoflow.files.drawings.words import Language, Phrase, label
from orthoflow.geometry import WallFrame
from orthoflow.geometry.frames import basis_from_up

_GAP_MM: Final = 8.0
# Below the walls, for their names.
_NAMES_MM: Final = 12.0
# Between heights that have marks of their own.
_LEVELS_MM: Final = 1.5
# Walls this close to parallel follow each other along one facade.
_PARALLEL_DEG: Final = 10.0


@dataclass(frozen=True, kw_only=True)
class ElevationWall:
    """A wall of an elevation.

    Attributes:
        name: what it is called.
        frame: frame of its picture.
        raster: GeoTIFF of the picture.
    """

    name: str
    frame: WallFrame
    raster: Path

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height."""
        return self.frame.width * self.frame.gsd_m, self.frame.height * self.frame.gsd_m


def unfolded(
    walls: Sequence[ElevationWall], up: NDArray[np.float64]
) -> tuple[tuple[ElevationWall, ...], bool]:
    """Sort walls in the order in which a viewer who turns or walks to the right sees them.

    Inside a room the viewer turns clockwise, seen from above; around a building the facades follow
    each other counter-clockwise. The order begins after the widest gap of directions.

    Returns:
        The walls, and whether they form a room seen from inside.
    """
    e1, e2, _ = basis_from_up(up)
    middles = np.array([wall.frame.corners_world().mean(axis=0) for wall in walls])
    normals = np.array([wall.frame.normal_world for wall in walls])
    outwards = np.einsum("wi,wi->w", middles - middles.mean(axis=0), normals)
    is_inside = bool(outwards.sum() <= 0.0)
    looks = -normals
    turn = -1.0 if is_inside else 1.0
    angles = turn * np.degrees(np.arctan2(looks @ e2, looks @ e1)) % 360.0
    order = np.argsort(angles)
    gaps = np.diff(np.append(angles[order], angles[order[0]] + 360.0))
    order = np.roll(order, -(int(np.argmax(gaps)) + 1))
    groups: list[list[int]] = []
    for k in order.tolist():
        first = groups[-1][0] if groups else None
        if first is not None and _turned_deg(angles[k], angles[first]) <= _PARALLEL_DEG:
            groups[-1].append(k)
        else:
            groups.append([k])
    for group in groups:
        right = walls[group[0]].frame.u_world
        group.sort(key=lambda k: float(middles[k] @ right))
    return tuple(walls[k] for group in groups for k in group), is_inside


def _turned_deg(one: float, other: float) -> float:
    return abs(math.remainder(one - other, 360.0))


def elevation(
    walls: Sequence[ElevationWall],
    up: NDArray[np.float64],
    text: SheetText,
    scale: int,
    language: Language = "en",
) -> Drawing:
    """Return walls side by side, each at its height, with level lines at round heights.

    Args:
        walls: from left to right.
        up: (3,) unit vector of the scan.
        text: of its sheets.
        scale: n of 1 : n.
        language: of labels.
    """
    mm = 1e-3 * scale
    heights = np.array([wall.frame.corners_world() @ up for wall in walls])
    top, low = float(heights.max()), float(heights.min())
    lefts = np.cumsum([0.0, *(wall.size_m[0] + mm * _GAP_MM for wall in walls)])

    def draw(placed: Placed) -> None:
        part = placed.view.part
        ends = [-math.inf, -math.inf]
        for number, (wall, left) in enumerate(zip(walls, lefts.tolist(), strict=False)):
            down = top - float(heights[number].max())
            wide, high = wall.size_m
            # What of the wall lies on this part of the drawing.
            own = Part(
                left_m=max(part.left_m - left, 0.0),
                top_m=max(part.top_m - down, 0.0),
                right_m=min(part.right_m - left, wide),
                bottom_m=min(part.bottom_m - down, high),
            )
            if min(own.size_m) <= 1e-9:
                continue
            corner = placed.on_paper([(left + own.left_m, down + own.bottom_m)])[0]
            view = View(kind="", part=own, corner_mm=(float(corner[0]), float(corner[1])))
            draw_raster(replace(placed, view=view), wall.raster)
            outline = placed.on_paper([(left + x, down + y) for x, y in own.corners_m])
            pens.line(placed.canvas, outline, width_mm=pens.THIN_MM, is_closed=True)
            # Names of narrow walls take turns in two rows, inside the frame.
            long = pens.text_width_mm(wall.name) + 2.0
            x, y = placed.on_paper([(left + own.left_m, top - low)])[0].tolist()
            x = min(x, placed.edges_mm[2] - long)
            row = 0 if x >= ends[0] else 1
            if part.bottom_m > top - low and x >= ends[row]:
                ends[row] = x + long
                middle = (x + 0.5 * long, y - 3.0 - 2.2 * pens.TEXT_MM * row)
                pens.write_on_white(placed.canvas, wall.name, middle)

    # Walls that end nearly level share a mark.
    levels: list[float] = []
    for down in sorted({*(top - heights.max(axis=1)), *(top - heights.min(axis=1))}):
        if not levels or down - levels[-1] >= mm * _LEVELS_MM:
            levels.append(float(down))
    return Drawing(
        stem="elevation",
        size_m=(float(lefts[-1]) - mm * _GAP_MM, top - low + mm * _NAMES_MM),
        pictures={label("elevation", language): Picture(draw=draw)},
        axes=Axes(
            across=None,
            down=(top, -1.0),
            phrase=Phrase(key="axes_elevation", values={"up": up_words(up)}),
        ),
        text=text,
        scale=scale,
        language=language,
        heights=tuple(levels),
    )
