"""Which rasters are maps: those of level planes seen from above, in a coordinate system."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Final

import numpy as np

from orthoflow.errors import InputError, MethodError
from orthoflow.geometry import WallFrame
from orthoflow.geometry.frames import LEVEL_LIMIT_DEG
from orthoflow.products import Planes
from orthoflow.sdk import DiagnosticSpec, StepContext

_UP: Final = np.array([0.0, 0.0, 1.0])
# Maximum displacement of a point in the map of a tilted raster.
_OFF_CELLS_MOST: Final = 0.5
TILTED: Final = DiagnosticSpec(
    code="map-of-a-tilted-plane",
    severity="warning",
    text="{subject} is tilted by {tilt_deg:.2g} deg, which would shift points by up to "
    "{off_mm:.2g} mm in a map: its raster stays in its plane",
    remedy="use plane.given with horizontal, or a smaller buffer",
    rank_by="off_mm",
)
NO_MAP: Final = DiagnosticSpec(
    code="map-without-a-level-plane",
    severity="warning",
    text="crs {crs} places no raster: none of the planes is level and seen from above",
    remedy="leave {step}.crs out, or raster a floor",
)


def mapped(
    frames: Mapping[int, WallFrame], planes: Planes, crs: str, *, reach_m: float, ctx: StepContext
) -> dict[int, WallFrame]:
    """Return the grids with level planes placed in the map; the others stay in their planes.

    Args:
        frames: grid of each plane by index.
        planes: the planes.
        crs: coordinate system of the cloud, whose x is east and y north.
        reach_m: maximum distance of points from a plane, which a tilt displaces.
        ctx: receives warnings.

    Raises:
        MethodError: there is no such system, or z is not up.
    """
    from orthoflow.files.geotiff import require_map_crs

    try:
        require_map_crs(crs)
    except InputError as error:
        raise MethodError(f"crs: {error}") from error
    if not np.allclose(planes.up, _UP, atol=1e-9):
        raise MethodError(
            f"crs {crs} needs a cloud whose z is up, x east and y north, got up "
            f"{planes.up.tolist()}: bring it into the coordinate system with register.similarity, "
            "or leave crs out"
        )
    placed = dict(frames)
    for index, frame in frames.items():
        tilt_rad = _tilt_rad(frame)
        if math.degrees(tilt_rad) > LEVEL_LIMIT_DEG:
            continue
        off_m = _off_m(frame, tilt_rad, reach_m)
        if off_m <= _OFF_CELLS_MOST * frame.gsd_m:
            placed[index] = replace(_centred(frame, planes, index), map_crs=crs)
            continue
        name = planes.names[index]
        ctx.report(TILTED, subject=name, tilt_deg=math.degrees(tilt_rad), off_mm=1e3 * off_m)
    if not any(frame.map_crs for frame in placed.values()):
        ctx.report(NO_MAP, crs=crs)
    return placed


def _tilt_rad(frame: WallFrame) -> float:
    east, north, up = frame.normal_world.tolist()
    return math.atan2(math.hypot(east, north), up)


def _off_m(frame: WallFrame, tilt_rad: float, reach_m: float) -> float:
    """Return the maximum displacement of a point, by its depth and by foreshortening of slopes."""
    extent_m = frame.gsd_m * math.hypot(frame.width, frame.height)
    return reach_m * math.sin(tilt_rad) + extent_m * (1.0 - math.cos(tilt_rad))


def _centred(frame: WallFrame, planes: Planes, index: int) -> WallFrame:
    """Distribute the part of whole cells beyond the rectangle evenly to all sides."""
    middle = frame.wall_from_world(planes.corners[index].mean(axis=0)[None])[0, :2]
    off = middle - 0.5 * np.array([frame.width, frame.height])
    return replace(frame, origin_world=frame.world_from_wall(off[None])[0])
