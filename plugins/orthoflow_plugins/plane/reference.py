"""Stated planes laid over a cloud: rectangles, the viewer's side of each, and the points on it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import Plane, basis_from_up, omega_phi_deg, wall_axes
from orthoflow.products import Planes, PointCloud
from orthoflow.sdk import StepContext
from orthoflow_plugins.plane.assembling import (
    enclosing,
    known_viewpoint,
    plane_names,
    rectangle_m,
    side_of_remaining,
    side_of_stations,
    warn_of_guesses,
)
from orthoflow_plugins.plane.measuring import Deviations, measure_planes
from orthoflow_plugins.plane.sample import Claim, PreparedCloud, prepare
from orthoflow_plugins.plane.support import (
    PART_SHARE,
    Support,
    SurfaceRaster,
    cell_for,
    measure_cells,
    support_of,
    surface_raster,
)

_PLAN_CELL_M: Final = 0.05
# Of so small a share of the points per side the extent does not depend: stray echoes.
_STRAY_SHARE: Final = 0.002
_EVERYWHERE_M: Final = 1e9


@dataclass(frozen=True, kw_only=True)
class Reference:
    """A stated plane with its rectangle.

    Attributes:
        plane: in the cloud's offsets, normal towards the viewer.
        corners_m: (4, 3) offsets, top-left first, counter-clockwise for the viewer.
        part_corners_m: (p, 4, 3) the same of each connected part.
        viewpoint: how the side was chosen.
        n_beside: points beside its rectangle, where every point could have spanned it.
    """

    plane: Plane
    corners_m: NDArray[np.float64]
    part_corners_m: NDArray[np.float64]
    viewpoint: str
    n_beside: int


def prepare_for_references(
    cloud: PointCloud, *, parts: int, part_share: float = PART_SHARE
) -> PreparedCloud:
    """Prepare a cloud that planes are laid over; with a `part_share` of 0 no point is stray.

    Raises:
        MethodError: the points of the cloud coincide or lie on one line.
    """
    return prepare(
        cloud,
        basis_from_up(cloud.up),
        cell_m=_PLAN_CELL_M,
        least_share=_STRAY_SHARE if part_share else 0.0,
        parts=parts,
    )


def place_reference(
    plane: Plane,
    cloud: PointCloud,
    prepared: PreparedCloud,
    *,
    buffer_m: float | None,
    keeps_side: bool,
    part_share: float = PART_SHARE,
) -> Reference | None:
    """Put a rectangle about the points near a plane, and turn its normal to the viewer.

    Args:
        plane: the plane, in the cloud's offsets.
        cloud: the cloud.
        prepared: the same; its claims are overwritten.
        buffer_m: points this near span the rectangle; None for all points.
        keeps_side: leave the normal as it is.
        part_share: parts that cover a smaller share of what all cover do not count.

    Returns:
        The plane with its rectangle, or None where no point is near.
    """
    raster, place, n_near = _rectangle(plane, prepared, buffer_m, part_share)
    if place is None:
        return None
    extent_m, n_inside = _extent(raster, place, prepared, buffer_m)
    corners_m = rectangle_m(plane, raster.axes, extent_m)
    parts_m = [
        rectangle_m(
            plane, raster.axes, np.clip(part, extent_m[[0, 0, 2, 2]], extent_m[[1, 1, 3, 3]])
        )
        for part in place.parts_m
    ]
    viewpoint = "given"
    if not keeps_side:
        members = prepared.sample.offsets_m
        near = np.abs(plane.distances_m(members)) <= (buffer_m or _EVERYWHERE_M)
        index = prepared.sample.index[near]
        side = side_of_stations(plane, corners_m.mean(axis=0), cloud, index)
        viewpoint = known_viewpoint(cloud) if side else "guess"
        if side == 0:
            nowhere = np.zeros(len(members), dtype=bool)
            side = side_of_remaining(
                plane, corners_m, members, nowhere, clear_m=(buffer_m or 0.0) / 3.0
            )
        plane = plane.flipped() if side < 0 else plane
    axes = wall_axes(plane.normal, cloud.up)
    return Reference(
        plane=plane,
        corners_m=enclosing(corners_m, plane, axes),
        part_corners_m=np.array([enclosing(part, plane, axes) for part in parts_m]),
        viewpoint=viewpoint,
        n_beside=max(0, n_near - n_inside) if buffer_m is None else 0,
    )


def lay_references(
    references: Sequence[Reference],
    cloud: PointCloud,
    prepared: PreparedCloud,
    labels: NDArray[np.int16],
    *,
    tolerance_m: float,
    ctx: StepContext,
) -> Planes:
    """Label the points on placed planes, and report how they lie about them.

    Args:
        references: the planes.
        cloud: the cloud.
        prepared: the same; its claims are overwritten.
        labels: (n,) filled with the place of a point's plane, the nearest of several, and -1 where
            there is none.
        tolerance_m: how near a point must be.
        ctx: takes metrics and warnings.

    Returns:
        The planes, the one with the most points first.
    """
    slabs = np.array([_slab(reference, cloud) for reference in references])
    everywhere = _EVERYWHERE_M * np.array([-1.0, 1.0, -1.0, 1.0])
    claims = _nearest_claims(references, prepared, slabs, np.append(tolerance_m, everywhere))
    counts = np.bincount(claims[claims >= 0], minlength=len(references))
    order = np.argsort(-counts, kind="stable")
    place = np.append(np.argsort(order), -1).astype(np.int8)
    prepared.claims[:] = place[claims]
    labels[:] = prepared.claims
    deviations = measure_planes(
        prepared,
        slabs[order],
        np.tile(everywhere, (len(references), 1)),
        find_m=tolerance_m,
        fit_m=tolerance_m,
    )
    ordered = [references[at] for at in order.tolist()]
    planes = _planes(ordered, cloud, deviations, tolerance_m)
    n_guessed = sum(reference.viewpoint == "guess" for reference in ordered)
    _report(ctx, planes, deviations, n_points=len(cloud), n_guessed=n_guessed)
    return planes


def _planes(
    ordered: Sequence[Reference], cloud: PointCloud, deviations: Deviations, tolerance_m: float
) -> Planes:
    normals = np.array([reference.plane.normal for reference in ordered])
    corners_m = np.array([reference.corners_m for reference in ordered])
    n_parts = [len(reference.part_corners_m) for reference in ordered]
    viewpoints = [reference.viewpoint for reference in ordered]
    return Planes(
        normal=normals,
        offset=np.array(
            [
                reference.plane.offset_m + float(reference.plane.normal @ cloud.origin)
                for reference in ordered
            ]
        ),
        corners=cloud.origin + corners_m,
        covariance=np.zeros((len(ordered), 4, 4)),
        n_points=deviations.n_find,
        rms_m=deviations.rms_find_m,
        up=cloud.up.copy(),
        names=plane_names(normals, corners_m.mean(axis=1) @ cloud.up, cloud.up),
        part_corners=cloud.origin + np.concatenate([item.part_corners_m for item in ordered]),
        part_plane=np.repeat(np.arange(len(ordered), dtype=np.int32), n_parts),
        # One word for all of them: the least certain.
        viewpoint="guess" if "guess" in viewpoints else viewpoints[0],
        tolerance_m=tolerance_m,
    )


def _slab(reference: Reference, cloud: PointCloud) -> NDArray[np.float64]:
    """A plane as the passes over the points take it (12,)."""
    plane = reference.plane
    axes = wall_axes(plane.normal, cloud.up)
    return np.concatenate([plane.normal, [plane.offset_m], axes[0], [0.0], axes[1], [0.0]])


def _nearest_claims(
    references: Sequence[Reference],
    prepared: PreparedCloud,
    slabs: NDArray[np.float64],
    bounds_m: NDArray[np.float64],
) -> NDArray[np.int8]:
    """Index (n,) of the nearest plane of each point that one claims, else -1."""
    claims = np.full(len(prepared.claims), -1, dtype=np.int8)
    for index, reference in enumerate(references):
        prepared.claim_alone(Claim(slab=slabs[index], bounds_m=bounds_m))
        taken = prepared.claims == 0
        disputed = np.flatnonzero(taken & (claims >= 0))
        if len(disputed):
            points = prepared.points
            points_m = np.column_stack(
                [axis[disputed].astype(np.float64) for axis in (points.x, points.y, points.z)]
            )
            own_m = np.abs(reference.plane.distances_m(points_m))
            others_m = np.abs(
                np.einsum("ni,ni->n", points_m, slabs[claims[disputed], :3])
                - slabs[claims[disputed], 3]
            )
            taken[disputed[own_m >= others_m]] = False
        claims[taken] = index
    return claims


def _rectangle(
    plane: Plane, prepared: PreparedCloud, buffer_m: float | None, part_share: float
) -> tuple[SurfaceRaster, Support | None, int]:
    """Cells of the points near a plane that hang together, and how many points are near."""
    reach_m = _EVERYWHERE_M if buffer_m is None else buffer_m
    points_m = prepared.sample.offsets_m
    near = points_m[np.abs(plane.distances_m(points_m)) <= reach_m]
    corners = prepared.box_corners()
    placed = near @ wall_axes(plane.normal, prepared.up).T
    # Not the full range: three echoes far away would make the cells as large as the scene.
    low, high = np.quantile(placed, (0.01, 0.99), axis=0) if len(near) else np.zeros((2, 2))
    area_m2 = float(np.prod(high - low))
    n_near = len(near) * prepared.sample.n_represented
    raster = surface_raster(plane, corners, prepared.up, cell_m=cell_for(n_near, area_m2))
    sums = measure_cells(
        prepared.points,
        raster,
        find_m=reach_m,
        fit_m=reach_m,
        parts=prepared.parts,
    )
    n_points = int(sums.n_find.sum())
    return raster, support_of(raster, sums.n_find > 0, sums, part_share=part_share), n_points


def _extent(
    raster: SurfaceRaster, place: Support, prepared: PreparedCloud, buffer_m: float | None
) -> tuple[NDArray[np.float64], int]:
    """(4,) smallest and largest u and v of the points in the cells' rectangle, and how many."""
    reach_m = _EVERYWHERE_M if buffer_m is None else buffer_m
    slab = raster.slab()
    bounds_m = np.concatenate([[reach_m], place.bounds_m])
    prepared.claim_alone(Claim(slab=slab, bounds_m=bounds_m))
    deviations = measure_planes(
        prepared, slab[None], place.bounds_m[None], find_m=reach_m, fit_m=reach_m
    )
    extent_m: NDArray[np.float64] = deviations.extents_m[0]
    return extent_m, int(deviations.n_find[0])


def _report(
    ctx: StepContext, planes: Planes, deviations: Deviations, *, n_points: int, n_guessed: int
) -> None:
    omega_deg, phi_deg = omega_phi_deg(planes.normal[0], planes.up)
    ctx.metric("n_planes", len(planes), "1")
    ctx.metric("labelled_share", float(deviations.n_find.sum()) / n_points, "1")
    ctx.metric("rms_mm", 1000.0 * float(planes.rms_m[0]), "mm")
    ctx.metric("omega_deg", omega_deg, "deg")
    ctx.metric("phi_deg", phi_deg, "deg")
    ctx.metric("offset_m", float(planes.offset[0]), "m")
    if n_guessed:
        warn_of_guesses(ctx, n_guessed, len(planes))
