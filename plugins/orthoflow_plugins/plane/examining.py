"""Is a candidate a plane? Refined on the sample, then judged and fitted on all points.

The same for every detector, so that methods differ in how they look, not in how they fit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import Plane, wall_axes
from orthoflow_plugins.plane.adjustment import SETTLED_M, AdjustedPlane, adjust_plane
from orthoflow_plugins.plane.candidates import Candidate, FoundPlane, Rules, freedom_of
from orthoflow_plugins.plane.fitting import Freedom
from orthoflow_plugins.plane.footprints import (
    CellSums,
    Footprint,
    SurfaceRaster,
    crowded_cells,
    footprint,
    measure_cells,
    surface_raster,
)
from orthoflow_plugins.plane.refining import Refined, refine_on_sample
from orthoflow_plugins.plane.remainders import Remainder

# Share of the points in a plane's slab and rectangle that must lie in crowded cells.
_CROWDED_LEAST: Final = 0.5
# Surfaces rounder than this radius are no planes, when the rounding is what shows in their cells.
_RADIUS_LEAST_M: Final = 5.0
_BENT_SHARE: Final = 0.5
# Passes over all points that one plane may take, and the share of the fit tolerance by which a fit
# may move without asking for another.
_LOOKS_MOST: Final = 3
_SETTLED_SHARE: Final = 0.1
# Planes of a sample are fitted to all points later.
_SETTLED_ON_SAMPLE_M: Final = 2e-5


def examine(candidate: Candidate, remainder: Remainder, rules: Rules) -> FoundPlane | None:
    """Refine a candidate and see whether it is a plane: on the sample first, then on all points."""
    freedom = freedom_of(candidate, remainder.up, rules)
    refined = refine_on_sample(candidate, remainder, rules, freedom)
    if refined is None or not _leans_little(refined, candidate, remainder.up, rules):
        return None
    corners, up = remainder.box_corners(), remainder.up
    rough = surface_raster(refined.plane, corners, up, cell_m=refined.cell_m)
    look = _look(rough, remainder, rules, freedom)
    for _ in range(_LOOKS_MOST - 1):
        # A plane that moved saw its points through a tolerance that lay askew: look again.
        if look is None or look.adjusted.moved_m < _SETTLED_SHARE * rules.fit_m:
            break
        rough = surface_raster(look.adjusted.plane, corners, up, cell_m=rough.cell_m)
        look = _look(rough, remainder, rules, freedom)
    if look is None:
        return None
    return FoundPlane(
        raster=carried(rough, look.adjusted.plane, up),
        footprint=look.footprint,
        adjusted=look.adjusted,
        candidate=candidate,
        freedom=freedom,
    )


@dataclass(frozen=True, kw_only=True)
class Look:
    """What all points say about a plane that is nearly right.

    Attributes:
        footprint: the cells that belong.
        adjusted: the fit to them.
    """

    footprint: Footprint
    adjusted: AdjustedPlane


def _look(
    raster: SurfaceRaster, remainder: Remainder, rules: Rules, freedom: Freedom
) -> Look | None:
    """One pass over all points: the cells that belong, and the fit to them; None for no plane."""
    points, claims = remainder.asked()
    sums = measure_cells(
        points,
        claims,
        raster,
        find_m=rules.find_m,
        fit_m=rules.fit_m,
        parts=remainder.parts,
    )
    return judged(
        raster,
        sums,
        rules,
        freedom,
        n_least=rules.least_share * len(remainder.claims),
        settled_m=_SETTLED_ON_SAMPLE_M,
    )


def judged(
    raster: SurfaceRaster,
    sums: CellSums,
    rules: Rules,
    freedom: Freedom,
    *,
    n_least: float,
    settled_m: float = SETTLED_M,
) -> Look | None:
    """Say which cells belong to a plane and how it fits them; None when it is none."""
    place = footprint(raster, crowded_cells(sums), sums, joins_parts=rules.joins_parts)
    if place is None or place.n_points < n_least:
        return None
    if _is_strip(place, raster) or _is_smear(place, raster, sums):
        return None
    adjusted = adjust_plane(
        raster, sums, place.cells, fit_m=rules.fit_m, freedom=freedom, settled_m=settled_m
    )
    if adjusted is None or _is_bent(adjusted):
        return None
    return Look(footprint=place, adjusted=adjusted)


def _leans_little(
    refined: Refined, candidate: Candidate, up: NDArray[np.float64], rules: Rules
) -> bool:
    tilt_deg = math.degrees(math.asin(min(1.0, abs(float(refined.plane.normal @ up)))))
    if candidate.family == "level":
        return tilt_deg >= 90.0 - rules.tilt_most_deg
    return candidate.family == "any" or tilt_deg <= rules.tilt_most_deg


def _is_strip(place: Footprint, raster: SurfaceRaster) -> bool:
    """Whether the cells form a line, about which a plane may turn as it likes."""
    width_m = min(place.bounds_m[1] - place.bounds_m[0], place.bounds_m[3] - place.bounds_m[2])
    return bool(width_m < 2.5 * raster.cell_m)


def _is_smear(place: Footprint, raster: SurfaceRaster, sums: CellSums) -> bool:
    """Whether most points in the rectangle's slab only pass through it, as on a rounded body."""
    u, v = raster.centres_m()
    left, right, top, bottom = place.bounds_m
    within = (u > left) & (u < right) & (v > top) & (v < bottom)
    return bool(place.n_points < _CROWDED_LEAST * sums.n_find[within].sum())


def _is_bent(adjusted: AdjustedPlane) -> bool:
    """Whether the cells lie on a column or barrel that the plane only touches."""
    return adjusted.bend_per_m > 1.0 / _RADIUS_LEAST_M and adjusted.bend_share > _BENT_SHARE


def carried(raster: SurfaceRaster, plane: Plane, up: NDArray[np.float64]) -> SurfaceRaster:
    """Give the raster on the plane after its last small correction, with the same cells."""
    return SurfaceRaster(
        plane=plane,
        axes=wall_axes(plane.normal, up),
        low_m=raster.low_m,
        cell_m=raster.cell_m,
        shape=raster.shape,
    )


def as_proposed(item: FoundPlane, up: NDArray[np.float64]) -> FoundPlane:
    """Give a plane back as its detector proposed it, with the rectangle that was found for it."""
    plane = item.candidate.plane
    if float(plane.normal @ item.raster.plane.normal) < 0.0:
        plane = plane.flipped()
    return replace(item, raster=carried(item.raster, plane, up))
