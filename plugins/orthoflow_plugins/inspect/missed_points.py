"""Check points that no picture shows, and why."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from orthoflow.products import CheckPoints, Walls
from orthoflow_plugins.inspect.point_places import Picture, ShownPoint

_NAMED: Final = 4
_NEAR_M: Final = 1.0
# The reason for points that a larger wall would include.
_BESIDE: Final = re.compile(r" (?:left of|right of|above|below) ")


def missed_points(
    points: Sequence[ShownPoint],
    surveyed: CheckPoints,
    pictures: Sequence[Picture],
    walls: Walls,
    *,
    is_simulated: bool = False,
) -> dict[str, str]:
    """Name the points that are not used, each with the reason, in the order of the survey.

    Args:
        points: expected and shown position of each.
        surveyed: the points.
        pictures: the pictures that were searched; at least one.
        walls: those of the pictures.
        is_simulated: points were searched with the scene's truth, not as targets.
    """
    sought = "nothing like it" if is_simulated else "no black and white quadrant target"
    names = {picture.wall: picture.image.name for picture in pictures}
    found: dict[str, str] = {}
    for index, point in enumerate(points):
        if np.isfinite(point.place).all():
            continue
        if point.how != "outside":
            found[surveyed.names[index]] = f"{sought} was recognised on {names[point.wall]}"
            continue
        number = int(surveyed.wall[index])
        found[surveyed.names[index]] = (
            f"there is no orthoimage of wall {number}"
            if number >= 0
            else min(_beside(surveyed, index, picture, walls) for picture in pictures)[1]
        )
    return found


def with_reasons(missed: Mapping[str, str]) -> str:
    """Name the first few results of `missed_points`, each with its reason."""
    named = [f"{name} ({reason})" for name, reason in list(missed.items())[:_NAMED]]
    more = f" and {len(missed) - _NAMED} more, see the log" if len(missed) > _NAMED else ""
    return f"{', '.join(named)}{more}"


def ways_to_count(missed: Mapping[str, str]) -> str:
    """Return what would make unused points usable."""
    ways = ["measure them in an orthoimage"]
    if any(_BESIDE.search(reason) for reason in missed.values()):
        ways.append("let {step[raster.grid]}.margin_m make walls larger")
    return ", or ".join(ways)


def _beside(surveyed: CheckPoints, index: int, picture: Picture, walls: Walls) -> tuple[float, str]:
    """Return how far a point is outside a picture in metres, and on which side."""
    frame, slab = picture.frame, walls.slab(picture.wall)
    column, row, depth_m = frame.wall_from_world(surveyed.points_world[index][None])[0]
    off_m = {
        "left of": -column * frame.gsd_m,
        "right of": (column - frame.width) * frame.gsd_m,
        "above": -row * frame.gsd_m,
        "below": (row - frame.height) * frame.gsd_m,
        "before": depth_m - slab.front_m,
        "behind": -depth_m - slab.behind_m,
    }
    side = max(off_m, key=off_m.__getitem__)
    far_m = float(np.linalg.norm([max(0.0, value) for value in off_m.values()]))
    said = f"{1e3 * off_m[side]:.3g} mm" if off_m[side] < _NEAR_M else f"{off_m[side]:.3g} m"
    limit = ", beyond its buffer" if side in {"before", "behind"} else ""
    return far_m, f"{said} {side} {picture.image.name}{limit}"
