"""Walls drawn from a family: cornices, pilasters, niches, panels, and doors that are set back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from orthoflow.geometry.scenes import SurfaceRole
from orthoflow_plugins.simulate.building import Extent, Paint, Side

# How far what is drawn runs on behind the adjoining walls, the floor and the ceiling.
_BEYOND_M: Final = 0.1
# A bay narrower than this stays bare, and so does the wall beside and over what is in it.
_BAY_LEAST_M: Final = 0.7
_BESIDE_M: Final = 0.12


@dataclass(frozen=True, kw_only=True)
class WallPaints:
    """What a drawn wall is painted with.

    Attributes:
        ground: the wall itself, and its niches.
        relief: cornice, pilasters and skirting.
        panel: mouldings of panels.
        door: of doors.
    """

    ground: Paint
    relief: Paint
    panel: Paint
    door: Paint


@dataclass(frozen=True, kw_only=True)
class WallDrawing:
    """How a wall is drawn.

    Attributes:
        full: extent of the wall, a little past the corners of the room.
        shown: extent between the adjoining walls, the floor and the ceiling.
        relief: scale of all that stands out.
        paints: what it is painted with.
    """

    full: Extent
    shown: Extent
    relief: float
    paints: WallPaints


def draw_wall(wall: Side, name: str, drawing: WallDrawing, rng: np.random.Generator) -> None:
    """Build a wall with relief up to 0.3 m before it and recesses up to 0.45 m behind it.

    Niches and doors are announced as planes of their own.

    Args:
        wall: where it stands.
        name: of its plane.
        drawing: how.
        rng: draws what there is.
    """
    plane = wall.true_plane(name, drawing.full)
    top_m = _draw_cornice(wall, drawing, rng)
    bays = _draw_pilasters(wall, drawing, top_m, rng)
    holes = [
        hole
        for bay in bays
        for hole in _draw_bay(wall, f"{name} {len(wall.draft.planes)}", (bay, drawing), rng)
    ]
    wall.place(drawing.full, 0.0, drawing.paints.ground, SurfaceRole.WALL, plane=plane, holes=holes)


def _draw_cornice(wall: Side, drawing: WallDrawing, rng: np.random.Generator) -> float:
    """Build up to three steps under the ceiling, or none; give where they begin."""
    a0, a1, _, _ = drawing.full
    ceiling_m = drawing.shown[3]
    n_steps = int(rng.integers(0, 4))
    height_m, depth_m = rng.uniform(0.12, 0.45), drawing.relief * rng.uniform(0.06, 0.3)
    for step in range(n_steps):
        low_m = ceiling_m - height_m * (1.0 - step / n_steps)
        extent = (a0, a1, low_m, ceiling_m + _BEYOND_M)
        wall.box(extent, depth_m * (step + 1) / n_steps, drawing.paints.relief)
    return ceiling_m - height_m if n_steps else ceiling_m


def _draw_pilasters(
    wall: Side, drawing: WallDrawing, top_m: float, rng: np.random.Generator
) -> list[Extent]:
    """Build pilasters, maybe in the corners too, and a skirting; give the bays between them."""
    a0, a1, floor_m, _ = drawing.shown
    n_inner, is_cornered = int(rng.integers(0, 4)), bool(rng.random() < 0.5)
    width_m, depth_m = rng.uniform(0.16, 0.4), drawing.relief * rng.uniform(0.03, 0.2)
    skirting_m, thick_m = rng.uniform(0.06, 0.25), drawing.relief * rng.uniform(0.01, 0.05)
    middles = np.linspace(a0, a1, n_inner + 2)[1:-1] + rng.uniform(-0.15, 0.15, n_inner)
    ends = [(middle - 0.5 * width_m, middle + 0.5 * width_m) for middle in middles]
    if is_cornered:
        ends = [(a0 - _BEYOND_M, a0 + width_m), *ends, (a1 - width_m, a1 + _BEYOND_M)]
    for left, right in ends:
        wall.box((left, right, floor_m - _BEYOND_M, top_m), depth_m, drawing.paints.relief)
    starts = [right for _, right in ends] if is_cornered else [a0, *(end for _, end in ends)]
    stops = [left for left, _ in ends] if is_cornered else [*(end for end, _ in ends), a1]
    if is_cornered:
        starts, stops = starts[:-1], stops[1:]
    bays = [(a, b, floor_m, top_m) for a, b in zip(starts, stops, strict=True)]
    if rng.random() < 0.6:
        for left, right, _, _ in bays:
            skirting = (left, right, floor_m - _BEYOND_M, floor_m + skirting_m)
            wall.box(skirting, thick_m, drawing.paints.relief)
    return bays


def _draw_bay(
    wall: Side, name: str, where: tuple[Extent, WallDrawing], rng: np.random.Generator
) -> list[Extent]:
    """Build a niche, a door, a panel or nothing between two pilasters; give the wall's holes."""
    (left, right, floor_m, top_m), drawing = where
    kind = str(rng.choice(["niche", "door", "panel", "bare"]))
    width_m = min(rng.uniform(0.6, 1.3), right - left - 2.0 * _BESIDE_M)
    middle_m = 0.5 * (left + right) + rng.uniform(-0.5, 0.5) * (
        right - left - width_m - 2.0 * _BESIDE_M
    )
    low_m, high_m = floor_m + rng.uniform(0.3, 0.7), top_m - rng.uniform(0.15, 0.5)
    depth_m = rng.uniform(0.05, 0.35 if kind == "niche" else 0.45)
    if kind == "bare" or right - left < _BAY_LEAST_M:
        return []
    a0, a1 = middle_m - 0.5 * width_m, middle_m + 0.5 * width_m
    if kind == "panel":
        wall.bars((a0, a1, low_m, high_m), 0.07, 0.03 * drawing.relief, drawing.paints.panel)
        return []
    paint = drawing.paints.ground if kind == "niche" else drawing.paints.door
    low_m = low_m if kind == "niche" else floor_m - _BEYOND_M
    extent = (a0, a1, low_m, high_m)
    plane = wall.true_plane(f"{kind} in {name}", extent, -depth_m)
    return [wall.recess(extent, depth_m, paint, plane=plane)]
