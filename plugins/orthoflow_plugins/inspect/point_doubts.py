"""Signs that check points refer to another raster, unit or coordinate system."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from orthoflow.products import CheckPoints
from orthoflow.sdk import DiagnosticSpec
from orthoflow_plugins.inspect.findings import rms
from orthoflow_plugins.inspect.point_places import Picture, ShownPoint

# A spec, its subject, and its values.
Doubt: TypeAlias = tuple[DiagnosticSpec, str, dict[str, Any]]
# Errors of an orthoimage are cells, not tens of cells.
_OFF_CELLS: Final = 20.0
# A different cell size, beyond what a photo's pose or a scan's scale can explain.
_SCALE_OFF: Final = 0.02
# Share of the total error that all points have in common.
_ALIKE_SHARE: Final = 0.9
_ALIKE_LEAST: Final = 3
_ANY_CELLS: Final = (
    "measure them in this orthoimage, or give what holds for any cell size: shown_x,shown_y,"
    "shown_z as the report saves them, or map_x,map_y of a map"
)
OWN_POINTS: Final = DiagnosticSpec(
    code="check-points-of-the-image",
    severity="warning",
    text="x, y, z of {n} of {n_points} check points are those of the orthoimage in which they "
    "were clicked, so that nothing is compared",
    remedy="put the surveyed ones there",
    rank_by="n",
)
FAR_POINTS: Final = DiagnosticSpec(
    code="check-points-far",
    severity="warning",
    text="{n} of {n_points} check points lie farther from their wall than it is long{how_far}",
    remedy="check `unit` of read.checkpoints, and that points and scan have one coordinate system",
    rank_by="n",
)
OTHER_CELLS: Final = DiagnosticSpec(
    code="check-points-of-other-cells",
    severity="warning",
    text="{subject}: its {n_points} check points were measured on cells of about {measured_m:.3g} "
    "m, but its own are {gsd_m:.3g} m",
    remedy="{any_cells}",
)
SHIFTED_POINTS: Final = DiagnosticSpec(
    code="check-points-shifted",
    severity="warning",
    text="{subject}: all of its {n_points} check points are shown {right_m:+.4g} m right and "
    "{down_m:+.4g} m down of the survey: was the raster cut or placed otherwise where they were "
    "measured?",
    remedy="{any_cells}",
)


def is_own(surveyed: CheckPoints) -> NDArray[np.bool_]:
    """Report points (n,) whose surveyed coordinates are those shown where they were clicked."""
    if surveyed.shown_world is None:
        return np.zeros(len(surveyed.names), dtype=np.bool_)
    return np.asarray((surveyed.shown_world == surveyed.points_world).all(axis=1), dtype=np.bool_)


def doubts(
    points: Sequence[ShownPoint], surveyed: CheckPoints, pictures: Sequence[Picture]
) -> Iterator[Doubt]:
    """Return diagnostics of implausible check points.

    Args:
        points: expected and shown position of each.
        surveyed: the points.
        pictures: the pictures that show them.
    """
    if n_own := int(np.count_nonzero(is_own(surveyed))):
        yield OWN_POINTS, "", {"n": n_own, "n_points": len(points)}
    by_wall = {picture.wall: picture for picture in pictures}
    beyond_m = np.array([_beyond_m(point, by_wall.get(point.wall)) for point in points])
    if n_far := np.count_nonzero(beyond_m > 0.0):
        farthest_m = float(beyond_m.max())
        how_far = f", up to {farthest_m:.4g} m" if np.isfinite(farthest_m) else ""
        yield FAR_POINTS, "", {"n": n_far, "n_points": len(points), "how_far": how_far}
    for picture in pictures:
        mine = [
            point
            for point, far_m in zip(points, beyond_m, strict=True)
            if point.wall == picture.wall and point.how == "measured" and far_m <= 0.0
        ]
        yield from _doubts_of_places(mine, picture)


def _beyond_m(point: ShownPoint, picture: Picture | None) -> float:
    """Return how far a point is from its wall if that exceeds the wall's length; else 0."""
    if picture is None:
        return 0.0
    frame = picture.frame
    size = np.array([frame.width, frame.height])
    off_m = frame.gsd_m * float(np.max([-point.expected, point.expected - size]))
    return off_m if off_m > frame.gsd_m * size.max() else 0.0


def _doubts_of_places(points: Sequence[ShownPoint], picture: Picture) -> Iterator[Doubt]:
    """Return measured positions that differ by another cell size, or all by the same shift."""
    if len(points) < 2:
        return
    expected = np.array([point.expected for point in points])
    shift = np.array([point.place for point in points]) - expected
    if rms(np.linalg.norm(shift, axis=1)) <= _OFF_CELLS:
        return
    aside = expected - expected.mean(axis=0)
    scale = 1.0 + float((aside * shift).sum() / max(float((aside**2).sum()), 1e-12))
    gsd_m, name = picture.frame.gsd_m, picture.image.name
    if scale > 0.0 and abs(scale - 1.0) > _SCALE_OFF:
        cells = {"measured_m": gsd_m / scale, "gsd_m": gsd_m, "any_cells": _ANY_CELLS}
        yield OTHER_CELLS, name, {"n_points": len(points), **cells}
        return
    alike = shift.mean(axis=0)
    of_all = float(np.linalg.norm(alike)) / rms(np.linalg.norm(shift, axis=1))
    if len(points) >= _ALIKE_LEAST and of_all > _ALIKE_SHARE:
        right_m, down_m = gsd_m * alike
        where = {"right_m": right_m, "down_m": down_m, "any_cells": _ANY_CELLS}
        yield SHIFTED_POINTS, name, {"n_points": len(points), **where}
