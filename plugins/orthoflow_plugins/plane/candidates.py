"""What detectors propose and what becomes of it: candidates, the rules they meet, found planes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import Plane
from orthoflow_plugins.plane.adjustment import AdjustedPlane
from orthoflow_plugins.plane.fitting import Freedom
from orthoflow_plugins.plane.footprints import Footprint, SurfaceRaster

# What a detector may mean by a candidate: a wall or a level within the tilt allowed, or anything.
Family = Literal["wall", "level", "any"]


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """A plane that a detector proposes.

    Attributes:
        plane: in the cloud's offsets, a few centimetres or a degree off.
        family: what it may be.
        support: the points that speak for it, by the detector's own count.
        own_tolerance_m: the tolerance that the detector found by itself, or None.
        start: where the common fit starts, if not from the plane itself.
    """

    plane: Plane
    family: Family
    support: float
    own_tolerance_m: float | None = None
    start: Plane | None = None


@dataclass(frozen=True, kw_only=True)
class Rules:
    """When a plane counts, and when the search ends.

    Attributes:
        find_m: points this near to a plane belong to it.
        fit_m: points this near to a plane take part in its fit.
        n_planes_most: the search ends with so many planes.
        least_share: share of all points that a plane must hold.
        stop_unclassified_share: the search ends when fewer points remain.
        stop_rest_share: the search ends at a plane with a smaller share of those that remain.
        tilt_most_deg: walls and floors may be off vertical and level by this.
        is_exact: keep walls exactly vertical and floors exactly level.
        joins_parts: parts that do not touch are one plane.
    """

    find_m: float
    fit_m: float
    n_planes_most: int
    least_share: float
    stop_unclassified_share: float
    tilt_most_deg: float
    stop_rest_share: float = 0.0
    is_exact: bool = False
    joins_parts: bool = True


@dataclass(frozen=True, kw_only=True)
class FoundPlane:
    """A plane that holds its share of the points.

    Attributes:
        raster: its cells; `raster.plane` is the plane, in the cloud's offsets.
        footprint: which cells belong, parts, rectangle.
        adjusted: the fit.
        candidate: what the detector proposed.
        freedom: what the fit could change.
    """

    raster: SurfaceRaster
    footprint: Footprint
    adjusted: AdjustedPlane
    candidate: Candidate
    freedom: Freedom

    def label_bounds(self, find_m: float) -> NDArray[np.float64]:
        """(5,) find tolerance, and the rectangle in (u, v) in which points belong to the plane."""
        grown = self.footprint.bounds_m + find_m * np.array([-1.0, 1.0, -1.0, 1.0])
        return np.concatenate([[find_m], grown])


def freedom_of(candidate: Candidate, up: NDArray[np.float64], rules: Rules) -> Freedom:
    """What the fit of a candidate may change."""
    if not rules.is_exact:
        return "free"
    tilt_deg = math.degrees(math.asin(min(1.0, abs(float(candidate.plane.normal @ up)))))
    if candidate.family == "wall" or tilt_deg <= rules.tilt_most_deg:
        return "vertical"
    return "level" if tilt_deg >= 90.0 - rules.tilt_most_deg else "free"
