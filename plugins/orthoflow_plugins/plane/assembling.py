"""Found planes turned into products: sides, order, names, rectangles in the world, labels."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import Plane, wall_axes
from orthoflow.geometry.frames import LEVEL_LIMIT_DEG
from orthoflow.products import JsonValue, Planes, PointCloud
from orthoflow_plugins.plane.candidates import Candidate, FoundPlane
from orthoflow_plugins.plane.deviations import Deviations
from orthoflow_plugins.plane.facing import (
    Viewpoint,
    known_viewpoint,
    side_of_remaining,
    side_of_stations,
)
from orthoflow_plugins.plane.normality import Normality, normality
from orthoflow_plugins.plane.remainders import Remainder
from orthoflow_plugins.plane.uncertainty import Stated

_VOTERS_MOST: Final = 5000
_WITNESSES_MOST: Final = 40_000
# Cosine of 20 degrees.
_PARALLEL: Final = 0.94


@dataclass(frozen=True, kw_only=True)
class Assembly:
    """The products of a detector, and what else is known about them.

    Attributes:
        planes: ordered by support.
        labels_from_claims: (k + 1,) int16 label of each claim; the last entry is for -1.
        deviations: of the planes in their final order.
        n_guessed: planes whose side was guessed.
        own_tolerances_m: of each plane the tolerance that the detector found itself, or None.
        normalities: of each plane how normal its deviations are, None where it has too few points.
        n_independent: of each plane, how many cells without common errors would fix it as well.
    """

    planes: Planes
    labels_from_claims: NDArray[np.int16]
    deviations: Deviations
    n_guessed: int
    own_tolerances_m: tuple[float | None, ...]
    normalities: tuple[Normality | None, ...]
    n_independent: tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class _Faced:
    """A found plane with its normal towards the viewer, in offsets."""

    plane: Plane
    stated: Stated
    corners_m: NDArray[np.float64]
    part_corners_m: NDArray[np.float64]
    is_guessed: bool


def assemble(
    found: list[FoundPlane], remainder: Remainder, deviations: Deviations, cloud: PointCloud
) -> Assembly:
    """Give planes their side, order and names."""
    order = np.argsort(-deviations.n_find, kind="stable")
    ordered = deviations.reordered(order)
    faced = [_faced(found, int(i), remainder, cloud, deviations) for i in order]
    # Histograms and means follow the normal when it was turned.
    flips = np.array(
        [
            float(item.plane.normal @ found[i].raster.plane.normal) < 0.0
            for item, i in zip(faced, order, strict=True)
        ]
    )
    ordered.histogram[flips] = ordered.histogram[flips][:, ::-1]
    ordered.mean_fit_m[flips] *= -1.0
    normalities = tuple(
        normality(row, find_m=ordered.find_m, fit_m=ordered.fit_m) for row in ordered.histogram
    )
    viewpoint: Viewpoint = known_viewpoint(cloud)
    if all(item.is_guessed for item in faced):
        viewpoint = "guess"
    planes = Planes(
        normal=np.array([item.plane.normal for item in faced]),
        offset=np.array([_world_offset(item.plane, cloud) for item in faced]),
        corners=np.array([cloud.origin + item.corners_m for item in faced]),
        covariance=np.array([_world_covariance(item.stated.covariance, cloud) for item in faced]),
        n_points=ordered.n_find,
        rms_m=ordered.rms_find_m,
        up=cloud.up.copy(),
        names=plane_names(
            np.array([item.plane.normal for item in faced]),
            np.array([item.corners_m.mean(axis=0) @ cloud.up for item in faced]),
            cloud.up,
        ),
        part_corners=np.concatenate([cloud.origin + item.part_corners_m for item in faced]),
        part_plane=np.repeat(
            np.arange(len(faced), dtype=np.int32), [len(item.part_corners_m) for item in faced]
        ),
        viewpoint=viewpoint,
        details={
            "fit_n_points": [int(n) for n in ordered.n_fit],
            "fit_rms_m": [float(value) for value in ordered.rms_fit_m],
            "n_independent": [item.stated.n_independent for item in faced],
            "normality": [None if item is None else item.to_json() for item in normalities],
            "find_tolerance_m": ordered.find_m,
            "fit_tolerance_m": ordered.fit_m,
            "raw": [
                _raw(found[i].candidate, item, cloud) for i, item in zip(order, faced, strict=True)
            ],
            "guessed_sides": [index for index, item in enumerate(faced) if item.is_guessed],
        },
    )
    labels = np.full(len(found) + 1, -1, dtype=np.int16)
    labels[order] = np.arange(len(found), dtype=np.int16)
    return Assembly(
        planes=planes,
        labels_from_claims=labels,
        deviations=ordered,
        n_guessed=sum(item.is_guessed for item in faced),
        own_tolerances_m=tuple(found[i].candidate.own_tolerance_m for i in order),
        normalities=normalities,
        n_independent=tuple(item.stated.n_independent for item in faced),
    )


def plane_names(
    normals: NDArray[np.float64], heights_m: NDArray[np.float64], up: NDArray[np.float64]
) -> tuple[str, ...]:
    """Name planes by what they are: `wall 0`, `floor`, `ceiling`, `level 4`, `slope 5`.

    The number is the plane's position in the product, as in the files wall_<k>_*.tif. The floor is
    the lowest level plane that is seen from above, the ceiling the highest that is seen from below.

    Args:
        normals: (k, 3) towards the viewer.
        heights_m: (k,) along up.
        up: (3,) unit vector.
    """
    rises = normals @ up
    level = np.abs(rises) > math.cos(math.radians(LEVEL_LIMIT_DEG))
    names = [
        f"level {i}" if level[i] else f"wall {i}" if abs(rises[i]) < 0.5 else f"slope {i}"
        for i in range(len(normals))
    ]
    seen_from_above = np.flatnonzero(level & (rises > 0.0))
    seen_from_below = np.flatnonzero(level & (rises < 0.0))
    if len(seen_from_above):
        names[int(seen_from_above[np.argmin(heights_m[seen_from_above])])] = "floor"
    if len(seen_from_below):
        names[int(seen_from_below[np.argmax(heights_m[seen_from_below])])] = "ceiling"
    return tuple(names)


def rectangle_m(
    plane: Plane, axes: NDArray[np.float64], bounds_m: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Corners (4, 3) on a plane: top-left first, counter-clockwise for the viewer.

    Args:
        plane: the plane, normal towards the viewer.
        axes: (2, 3) u to the viewer's right and v down (`wall_axes`).
        bounds_m: (4,) smallest and largest u, smallest and largest v.
    """
    left, right, top, bottom = bounds_m
    around = np.array([[left, top], [left, bottom], [right, bottom], [right, top]])
    corners: NDArray[np.float64] = around @ axes + plane.offset_m * plane.normal
    return corners


def enclosing(
    corners_m: NDArray[np.float64], plane: Plane, axes: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Give the rectangle along other axes of a plane that encloses one; for a flip the same one."""
    placed = corners_m @ axes.T
    low, high = placed.min(axis=0), placed.max(axis=0)
    return rectangle_m(plane, axes, np.array([low[0], high[0], low[1], high[1]]))


def _faced(
    found: list[FoundPlane],
    claim: int,
    remainder: Remainder,
    cloud: PointCloud,
    deviations: Deviations,
) -> _Faced:
    raster, place = found[claim].raster, found[claim].footprint
    plane, axes = raster.plane, raster.axes
    extent_m = deviations.extents_m[claim]
    corners_m = rectangle_m(plane, axes, extent_m)
    claims = remainder.sample_claims
    members = remainder.sample.index[claims == claim]
    # Evenly thinned, since a plane's first points may all be from one scan.
    members = members[:: max(1, len(members) // _VOTERS_MOST)]
    side = side_of_stations(plane, corners_m.mean(axis=0), cloud, members)
    is_guessed = side == 0
    if is_guessed:
        # The last entry stands for points on no plane: a claim of -1 picks it.
        parallel = [
            abs(float(item.raster.plane.normal @ plane.normal)) > _PARALLEL for item in found
        ]
        every = max(1, len(claims) // _WITNESSES_MOST)
        side = side_of_remaining(
            plane,
            corners_m,
            remainder.sample.offsets_m[::every],
            np.array([*parallel, False])[claims[::every]],
            clear_m=deviations.find_m,
        )
    # Parts are known to a cell; none reaches beyond the points that are there.
    parts_m = [
        rectangle_m(plane, axes, np.clip(bounds, extent_m[[0, 0, 2, 2]], extent_m[[1, 1, 3, 3]]))
        for bounds in place.parts_m
    ]
    stated = found[claim].adjusted.stated()
    if side < 0:
        # Normal and offset change sign together, so their covariance stays as it is.
        plane = plane.flipped()
    turned = wall_axes(plane.normal, cloud.up)
    return _Faced(
        plane=plane,
        stated=stated,
        corners_m=enclosing(corners_m, plane, turned),
        part_corners_m=np.array([enclosing(part, plane, turned) for part in parts_m]),
        is_guessed=is_guessed,
    )


def _raw(candidate: Candidate, faced: _Faced, cloud: PointCloud) -> dict[str, JsonValue]:
    """What the detector itself said about a plane, before the common fit; world."""
    plane = candidate.plane
    if float(plane.normal @ faced.plane.normal) < 0.0:
        plane = plane.flipped()
    return {
        "normal": [float(value) for value in plane.normal],
        "offset_m": _world_offset(plane, cloud),
        "support": float(candidate.support),
        "own_tolerance_m": candidate.own_tolerance_m,
    }


def _world_offset(plane: Plane, cloud: PointCloud) -> float:
    return plane.offset_m + float(plane.normal @ cloud.origin)


def _world_covariance(covariance: NDArray[np.float64], cloud: PointCloud) -> NDArray[np.float64]:
    """Covariance of (normal, offset) with the offset counted from the world's origin."""
    shift = np.eye(4)
    shift[3, :3] = cloud.origin
    moved: NDArray[np.float64] = shift @ covariance @ shift.T
    return 0.5 * (moved + moved.T)
