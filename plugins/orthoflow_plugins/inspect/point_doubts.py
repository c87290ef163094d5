"""Diagnostics of check points that no image shows, or with a wrong unit or coordinate system."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.products import CheckPoints, Walls
from orthoflow.sdk import DiagnosticSpec, StepContext
from orthoflow_plugins.inspect.point_places import Picture, ShownPoint

# Maximum number of unused points that a message lists.
_NAMED: Final = 4
# In messages, distances of at least this are in metres, and shorter ones in millimetres.
_NEAR_M: Final = 1.0
OWN_POINTS: Final = DiagnosticSpec(
    code="check-points-of-the-image",
    severity="warning",
    text="the coordinates x, y, z of {n} of {n_points} check points were taken from the orthoimage "
    "in which they were clicked, so nothing is compared",
    remedy="enter the surveyed coordinates instead",
    rank_by="n",
)
FAR_POINTS: Final = DiagnosticSpec(
    code="check-points-far",
    severity="warning",
    text="{n} of {n_points} check points are farther from their wall than its length{how_far}",
    remedy="check {step[read.checkpoints]}.unit, and the coordinate systems of points and scan",
    rank_by="n",
)


def is_own(surveyed: CheckPoints) -> NDArray[np.bool_]:
    """Return a mask (n,) of points whose surveyed coordinates equal the clicked coordinates."""
    if surveyed.shown_world is None:
        return np.zeros(len(surveyed.names), dtype=np.bool_)
    return np.asarray((surveyed.shown_world == surveyed.points_world).all(axis=1), dtype=np.bool_)


def report_doubts(
    points: Sequence[ShownPoint],
    surveyed: CheckPoints,
    pictures: Sequence[Picture],
    ctx: StepContext,
) -> None:
    """Report implausible check points.

    Args:
        points: expected and shown position of each point.
        surveyed: the check points.
        pictures: the images that show check points.
        ctx: context that receives the diagnostics.
    """
    if n_own := int(np.count_nonzero(is_own(surveyed))):
        ctx.report(OWN_POINTS, n=n_own, n_points=len(points))
    by_wall = {picture.wall: picture for picture in pictures}
    beyond_m = np.array([beyond_wall_m(point, by_wall.get(point.wall)) for point in points])
    if n_far := np.count_nonzero(beyond_m > 0.0):
        farthest_m = float(beyond_m.max())
        how_far = f", up to {farthest_m:.4g} m" if np.isfinite(farthest_m) else ""
        ctx.report(FAR_POINTS, n=n_far, n_points=len(points), how_far=how_far)


def beyond_wall_m(point: ShownPoint, picture: Picture | None) -> float:
    """Return the distance in metres from a wall's raster; 0 if below the length of the wall."""
    if picture is None:
        return 0.0
    frame = picture.frame
    size = np.array([frame.width, frame.height])
    off_m = frame.gsd_m * float(np.max([-point.expected, point.expected - size]))
    return off_m if off_m > frame.gsd_m * size.max() else 0.0


def missed_points(
    points: Sequence[ShownPoint],
    surveyed: CheckPoints,
    pictures: Sequence[Picture],
    walls: Walls,
    *,
    is_simulated: bool = False,
) -> dict[str, str]:
    """Return why points are not used, by name, in the order of the survey.

    Args:
        points: expected and shown position of each point.
        surveyed: the check points.
        pictures: the images that were searched, at least one.
        walls: the walls of these images.
        is_simulated: whether points were searched for by means of the true scene, not as targets.
    """
    sought = "nothing similar" if is_simulated else "no black and white quadrant target"
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
    """Format the first few results of `missed_points` with their reasons."""
    named = [f"{name} ({reason})" for name, reason in list(missed.items())[:_NAMED]]
    more = f" and {len(missed) - _NAMED} more, see the log" if len(missed) > _NAMED else ""
    return f"{', '.join(named)}{more}"


def _beside(surveyed: CheckPoints, index: int, picture: Picture, walls: Walls) -> tuple[float, str]:
    """Return how far a point is outside an image, in metres, and a description of its position."""
    frame, slab = picture.frame, walls.slab(picture.wall)
    column, row, depth_m = frame.wall_from_world(surveyed.points_world[index][None])[0]
    off_m = {
        "left of": -column * frame.gsd_m,
        "right of": (column - frame.width) * frame.gsd_m,
        "above": -row * frame.gsd_m,
        "below": (row - frame.height) * frame.gsd_m,
        "in front of": depth_m - slab.front_m,
        "behind": -depth_m - slab.behind_m,
    }
    side = max(off_m, key=off_m.__getitem__)
    far_m = float(np.linalg.norm([max(0.0, value) for value in off_m.values()]))
    said = f"{1e3 * off_m[side]:.3g} mm" if off_m[side] < _NEAR_M else f"{off_m[side]:.3g} m"
    limit = ", beyond its buffer" if side in {"in front of", "behind"} else ""
    return far_m, f"{said} {side} {picture.image.name}{limit}"
