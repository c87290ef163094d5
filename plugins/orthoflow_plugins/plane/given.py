"""`plane.given`: reference planes given by the user, as in skarlatos2012."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Final, Self

import numpy as np
from pydantic import Field, model_validator

from orthoflow.errors import GeometryError, MethodError
from orthoflow.geometry import Plane, plane_through, wall_axes
from orthoflow.products import PointCloud, PointLabels, SideSource
from orthoflow.sdk import DiagnosticSpec, Method, MethodParams, StepContext
from orthoflow_plugins.plane.detector import DETECTOR_METRICS, DetectorIn, DetectorOut

if TYPE_CHECKING:
    from orthoflow_plugins.plane.cloud import PreparedCloud
    from orthoflow_plugins.plane.planes import FacedPlane

Vector = tuple[float, float, float]

# Share of the points below the default horizontal plane, which is below the scene but above stray
# points.
_GROUND_SHARE: Final = 0.01
# A warning is reported if a larger share of the points is outside the rectangle.
_STRAY_REPORTED: Final = 1e-3
# Buffer of skarlatos2012: three tolerances on each side of a wall.
_BUFFER_TOLERANCES: Final = 3.0
# Share of points outside the robust box on each side.
_OUTSIDE_SHARE: Final = 0.0005
_METRICS: Final = {"n_planes", "labelled_share", "rms_mm", "omega_deg", "phi_deg", "offset_m"}
_EVERYWHERE_M: Final = 1e9
_NO_BOUNDS_M: Final = (-_EVERYWHERE_M, _EVERYWHERE_M, -_EVERYWHERE_M, _EVERYWHERE_M)

# Sources of the visible side: a normal or a viewpoint set by the user counts as given.
_SIDES: Final[Mapping[str, SideSource]] = {
    "given": "given",
    "view_from": "given",
    "stations": "stations",
    "guess": "guess",
}
_TOO_FAR: Final = (
    "no point of the cloud is within {buffer:g} m of the plane; the points are between {low:.3f} m "
    "and {high:.3f} m from it along its normal: check the definition of the plane "
    "(`normal` and `offset_m`, `points`, or `height_m`), or increase `buffer_m` (plane.given)"
)
STRAY_PARTS: Final = DiagnosticSpec(
    code="points-beside-the-plane",
    severity="warning",
    text="{n} points ({share:.2%}) are outside the rectangle of the plane, in parts that cover "
    "less than {part_share:.0%} of the total area",
    remedy="set {step}.part_min_share=0 to keep them",
    rank_by="share",
)


class StatedPlane(MethodParams):
    """A plane, given in exactly one of three ways."""

    normal: Vector | None = Field(
        None, description="Direction towards the viewer, world axes; any length."
    )
    offset_m: float | None = Field(
        None, description="Distance of the plane from the world origin along the unit normal."
    )
    points: tuple[Vector, Vector, Vector] | None = Field(
        None, description="Three points on the plane in world coordinates, metres."
    )
    horizontal: bool = Field(
        default=False,
        description="The plane perpendicular to `up`, seen from above; the default.",
    )
    height_m: float | None = Field(
        None,
        description="Height of the horizontal plane along `up`, in metres; by default, the "
        "first percentile of the heights of the points.",
    )

    @property
    def ways(self) -> tuple[str, ...]:
        """Return those of the three ways that are used."""
        ways = {
            "normal": self.normal is not None or self.offset_m is not None,
            "points": self.points is not None,
            "horizontal": self.horizontal or self.height_m is not None,
        }
        return tuple(way for way, is_used in ways.items() if is_used)

    @model_validator(mode="after")
    def _one_way_only(self) -> Self:
        if len(self.ways) > 1:
            raise ValueError(
                "plane.given needs exactly one of normal (with offset_m), points "
                f"and horizontal, got {' and '.join(self.ways)}"
            )
        if (self.normal is None) != (self.offset_m is None):
            raise ValueError("plane.given needs normal and offset_m together, got only one")
        if self.normal is not None and math.hypot(*self.normal) < 1e-9:
            raise ValueError("normal must not be (0, 0, 0)")
        return self


class GivenPlane(Method):
    """Use one or more reference planes given by the user.

    Each plane is given in exactly one of three ways: by `normal` and `offset_m` (the normal points
    towards the viewer and is never reversed); by three `points` in world coordinates, in metres
    (the normal is turned towards the viewer); or as `horizontal`, a plane seen from above. By
    default, as in skarlatos2012, the plane is horizontal. If `height_m` is not set, the height of a
    horizontal plane is the first percentile of the heights of the points. Several planes are listed
    in `planes`; a point near several of them belongs to the nearest.

    The rectangle of a plane contains the points within `buffer_m` of the plane (for a horizontal
    plane, all points by default), except small parts, such as stray points outside the scene.
    """

    id = "plane.given"
    determinism = "exact"
    metrics = tuple(metric for metric in DETECTOR_METRICS if metric.name in _METRICS)
    citations = (
        (
            "Skarlatos, Kiparissi, Theodoridou 2012: Direct orthophoto generation from color point "
            "clouds of complex scenes"
        ),
    )

    class Params(StatedPlane):
        """Parameters: one plane, or several."""

        planes: tuple[StatedPlane, ...] = Field(
            (),
            max_length=100,
            description="Several planes instead of one, each with its own normal and offset_m, "
            "points, or horizontal and height_m.",
        )
        tolerance_m: float = Field(
            0.05, gt=0.0, description="Maximum distance of points that are labelled with the plane."
        )
        buffer_m: float | None = Field(
            None,
            gt=0.0,
            description="Maximum distance from the plane of the points that its rectangle "
            "encloses; by default, three times tolerance_m, or unlimited for the horizontal "
            "plane.",
        )
        part_min_share: float = Field(
            0.03,
            ge=0.0,
            lt=1.0,
            description="Connected parts that cover a smaller share of the area of all parts are "
            "treated as stray points and excluded from the rectangle; 0 keeps all parts "
            "except isolated points.",
        )

        @model_validator(mode="after")
        def _one_or_several(self) -> Self:
            if self.planes and self.ways:
                raise ValueError(
                    "plane.given accepts either a single plane or the list `planes`, but both "
                    f"`{self.ways[0]}` and `planes` are set: move the single plane into the list"
                )
            return self

    In = DetectorIn
    Out = DetectorOut

    def run(self, inputs: DetectorIn, params: Params, ctx: StepContext) -> DetectorOut:
        """Determine the rectangles of the planes, and label the points on them."""
        from orthoflow_plugins.plane.cloud import prepare
        from orthoflow_plugins.plane.planes import measure_planes, planes_of, report_planes
        from orthoflow_plugins.plane.support import slab_of

        cloud, tolerance_m = inputs.cloud, params.tolerance_m
        ctx.progress(0.0, "placing the plane")
        # If part_min_share is 0, no points are considered stray.
        outside_share = _OUTSIDE_SHARE if params.part_min_share else 0.0
        reaches_m = (tolerance_m, tolerance_m)
        prepared = prepare(cloud, *reaches_m, parts=ctx.cores, outside_share=outside_share)
        placed_planes = _all_placed(params, cloud, prepared, ctx)
        ctx.progress(0.4, "labelling points")
        planes = [item.plane for item, _ in placed_planes]
        slabs = np.array([slab_of(plane, wall_axes(plane.normal, cloud.up)) for plane in planes])
        everywhere = np.tile(_NO_BOUNDS_M, (len(placed_planes), 1))
        prepared.assign(slabs, np.insert(everywhere, 0, tolerance_m, axis=1))
        counts = np.bincount(prepared.claims[prepared.claims >= 0], minlength=len(placed_planes))
        order = np.argsort(-counts, kind="stable")
        # Sort planes by their numbers of points, largest first; the last entry is for points on no
        # plane.
        prepared.claims[:] = np.append(np.argsort(order), -1).astype(np.int8)[prepared.claims]
        labels = ctx.allocate("labels", "plane_index", (len(cloud),), np.int16).view(np.int16)
        labels[:] = prepared.claims
        deviations = measure_planes(prepared, slabs[order], everywhere)
        faced, viewpoints = zip(*(placed_planes[k] for k in order), strict=True)
        sides = tuple(_SIDES[viewpoint] for viewpoint in viewpoints)
        found = planes_of(
            faced,
            deviations,
            cloud,
            covariances=[np.zeros((4, 4))] * len(placed_planes),
            # There is one value for all planes: the least certain one.
            viewpoint="guess" if "guess" in viewpoints else viewpoints[0],
            side_from=sides if len(set(sides)) > 1 else (),
        )
        report_planes(ctx, found, deviations, n_points=len(cloud))
        return DetectorOut(planes=found, labels=PointLabels(plane_index=labels))


def _all_placed(
    params: GivenPlane.Params, cloud: PointCloud, prepared: PreparedCloud, ctx: StepContext
) -> list[tuple[FacedPlane, str]]:
    placed_planes = []
    for nth, stated in enumerate(params.planes or (params,)):
        try:
            faced, viewpoint, n_beside = _placed(stated, params, cloud, prepared)
        except MethodError as error:
            which = f"planes[{nth}]" if params.planes else "the given plane"
            raise MethodError(f"{which}: {error}") from error
        placed_planes.append((faced, viewpoint))
        if n_beside > _STRAY_REPORTED * len(cloud):
            share = n_beside / len(cloud)
            ctx.report(STRAY_PARTS, n=n_beside, share=share, part_share=params.part_min_share)
    return placed_planes


def _placed(
    stated: StatedPlane, params: GivenPlane.Params, cloud: PointCloud, prepared: PreparedCloud
) -> tuple[FacedPlane, str, int]:
    """Return a plane facing the viewer, how its side is known, and the number of omitted points."""
    from orthoflow_plugins.plane.planes import (
        face,
        known_viewpoint,
        measure_planes,
        rectangle_m,
        side_of_remaining,
        side_of_stations,
    )
    from orthoflow_plugins.plane.support import SurfaceRaster, cell_for, measure_cells, support_of

    plane, is_settled = _plane_of(stated, cloud, prepared)
    members = prepared.sample.offsets_m
    distances_m = plane.distances_m(members)
    buffer_m = params.buffer_m
    if buffer_m is None and (stated.normal is not None or stated.points is not None):
        buffer_m = _BUFFER_TOLERANCES * params.tolerance_m
    reach_m = _EVERYWHERE_M if buffer_m is None else buffer_m
    near = np.abs(distances_m) <= reach_m
    # Cells connect the points near the plane into parts. Compute the size of cells from quantiles,
    # because a few distant stray points would make the cells as large as the scene.
    up = prepared.up
    placed = members[near] @ wall_axes(plane.normal, up).T
    low, high = np.quantile(placed, (0.01, 0.99), axis=0) if len(placed) else np.zeros((2, 2))
    cell_m = cell_for(
        len(placed) * prepared.sample.n_represented, float(np.prod(high - low)), prepared
    )
    raster = SurfaceRaster.over(plane, prepared.box_corners(), up, cell_m)
    near_it = replace(prepared, tolerance_m=reach_m, fit_tolerance_m=reach_m)
    (sums,) = measure_cells(near_it, [raster])
    share = params.part_min_share
    support = support_of(raster, sums.n_near > 0, sums, part_share=share)
    if support is None:
        low_m, high_m = float(distances_m.min()), float(distances_m.max())
        raise MethodError(_TOO_FAR.format(buffer=reach_m, low=low_m, high=high_m))
    prepared.assign(raster.slab()[None], np.append(reach_m, support.bounds_m)[None])
    deviations = measure_planes(near_it, raster.slab()[None], support.bounds_m[None])
    extent_m = deviations.extents_m[0]
    side, viewpoint = 1, "given"
    if not is_settled:
        corners_m = rectangle_m(plane, raster.axes, extent_m)
        index = prepared.sample.index[near]
        side, viewpoint = side_of_stations(plane, corners_m.mean(axis=0), cloud, index), "guess"
        if side:
            viewpoint = known_viewpoint(cloud)
        else:
            nowhere = np.zeros(len(members), dtype=bool)
            clear_m = (buffer_m or 0.0) / _BUFFER_TOLERANCES
            side = side_of_remaining(plane, corners_m, members, nowhere, clear_m=clear_m)
    n_near = int(sums.n_near.sum())
    n_beside = n_near - int(deviations.n_points[0]) if buffer_m is None else 0
    faced = face(raster, extent_m, support.parts_m, side, cloud.up, is_guessed=viewpoint == "guess")
    return faced, viewpoint, max(0, n_beside)


def _plane_of(
    stated: StatedPlane, cloud: PointCloud, prepared: PreparedCloud
) -> tuple[Plane, bool]:
    """Return the plane, for offsets from the cloud's origin, and whether its side is known."""
    if stated.normal is not None and stated.offset_m is not None:
        normal = np.array(stated.normal) / math.hypot(*stated.normal)
        normal = normal / np.linalg.norm(normal)
        offset_m = stated.offset_m - float(normal @ cloud.origin)
        return Plane(normal=normal, offset_m=offset_m), True
    if stated.points is not None:
        try:
            return plane_through(np.array(stated.points) - cloud.origin), False
        except GeometryError as error:
            raise MethodError(
                f"plane.given needs three points that define a plane, but {stated.points} are "
                "collinear"
            ) from error
    up = prepared.up
    if stated.height_m is not None:
        return Plane(normal=up, offset_m=stated.height_m - float(up @ cloud.origin)), True
    ground_m = float(np.quantile(prepared.sample.offsets_m @ up, _GROUND_SHARE))
    return Plane(normal=up, offset_m=ground_m), True
