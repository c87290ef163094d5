"""A wall with a turned niche, a window looked through, a mirror, and a screen before it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import WallFrame
from orthoflow.products import PointCloud, Walls
from tests import samples
from tests.raster_scenes import SURVEY, cloud_of, leaning_wall

GSD_M = 0.01
SHAPE = (240, 400)
BEHIND_M, FRONT_M = 0.4, 0.15
# Before the middle of the wall, in cells and metres before the plane.
STATION = (200.0, 120.0, 3.0)

# Corners in cells, counter-clockwise for the viewer, none of them on the border of a cell.
_TURN = np.radians(1.5)
NICHE = np.array([80.0, 120.0]) + np.array([[-40, -60], [-40, 60], [40, 60], [40, -60]]) @ np.array(
    [[np.cos(_TURN), np.sin(_TURN)], [-np.sin(_TURN), np.cos(_TURN)]]
)
NICHE_M = 0.2


def rectangle(left: float, top: float, right: float, bottom: float) -> NDArray[np.float64]:
    """Corners of an upright rectangle in cells, in the order of outlines."""
    return np.array([[left, top], [left, bottom], [right, bottom], [right, top]])


WINDOW = rectangle(180.3, 40.4, 259.6, 150.2)
MIRROR = rectangle(300.0, 30.0, 350.0, 90.0)
# What the screen hides, seen from the station.
HIDDEN = rectangle(290.0, 120.0, 370.0, 239.0)


def inside(corners: NDArray[np.float64], places: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which places (..., 2) lie in a convex polygon."""
    is_inside = np.ones(places.shape[:-1], dtype=np.bool_)
    for begin, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        way = end - begin
        to = places - begin
        # Counter-clockwise with rows downwards.
        is_inside &= way[0] * to[..., 1] - way[1] * to[..., 0] <= 0.0
    return is_inside


def frame() -> WallFrame:
    """At survey coordinates, turned and leaning."""
    wall = leaning_wall(shape=SHAPE)
    u, v = wall.axes
    return WallFrame(
        origin_world=SURVEY.copy(),
        u_world=u,
        v_world=v,
        normal_world=wall.normal,
        gsd_m=GSD_M,
        width=SHAPE[1],
        height=SHAPE[0],
    )


def centres() -> NDArray[np.float64]:
    """(rows, cols, 2) column and row of the centres of cells."""
    rows, columns = np.indices(SHAPE)
    return np.stack([columns, rows], axis=2) + 0.5


def walls(*, noise_m: float = 0.002, face_m: float = 0.0, sparse: bool = False) -> Walls:
    """The wall as a laser sees it: its face may lie behind its plane; two points a cell, or few."""
    places = centres()
    rows = np.indices(SHAPE)[0]
    rng = np.random.default_rng(3)
    depth = face_m + noise_m * rng.normal(size=SHAPE)
    depth[inside(NICHE, places)] -= NICHE_M
    is_void = np.zeros(SHAPE, dtype=np.bool_)
    for corners in (WINDOW, MIRROR, HIDDEN):
        is_void |= inside(corners, places)
    # Single holes between points, and a crack: no openings.
    is_void |= rng.random(SHAPE) < 0.02
    is_void[:, 274:277] = True
    depth[is_void] = np.nan
    wall = samples.wall(
        frame(),
        plane_index=4,
        name="wall 4",
        depth_m=depth.astype(np.float32),
        sigma_m=np.full(SHAPE, noise_m, dtype=np.float32),
        count=np.where(is_void, 0, (rows % 3 == 0) if sparse else 2).astype(np.uint32),
        intensity=np.full(SHAPE, 0.5, dtype=np.float32),
    )
    buffers = {"buffer_front_m": FRONT_M, "buffer_behind_m": BEHIND_M}
    return samples.walls(wall, intensity_source="laser", **buffers)


def cloud(*, knows_stations: bool = True) -> PointCloud:
    """Rays of the station that end on the face, on the screen, and two metres behind the window."""
    where, station = frame(), np.array(STATION)
    rows, columns = np.indices((120, 200))
    crossings = np.stack([columns, rows], axis=2).reshape(-1, 2) * 2.0 + 1.0
    on = np.column_stack([crossings, np.zeros(len(crossings))])
    ends = on.copy()
    for corners, depth_m in ((WINDOW, -2.0), (HIDDEN, 0.8)):
        chosen = inside(corners, crossings)
        share = (station[2] - depth_m) / station[2]
        ends[chosen] = station + share * (on[chosen] - station)
    seen = ~inside(MIRROR, crossings)
    ends = ends[seen]
    # A gross error far behind the face, alone.
    ends[17, 2] = -3.0
    bare = cloud_of(where.world_from_wall(ends[:, :2], ends[:, 2]))
    if not knows_stations:
        return bare
    at = where.world_from_wall(station[None, :2], station[2:])
    scan = np.zeros(len(bare), dtype=np.uint16)
    return replace(bare, scan=scan, stations=at, stations_source="file")
