"""Walls on cylinders, cones and spheres: their grids and extents, and their points, unrolled."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import (
    Cone,
    ConeBend,
    Cylinder,
    CylinderBend,
    Sphere,
    SphereBend,
    WallFrame,
    wall_axes,
)
from orthoflow.geometry.bands import row_bands
from orthoflow.geometry.bends import NARROWEST
from orthoflow.geometry.slabs import Slab
from orthoflow.geometry.surfaces import angles_around
from orthoflow.geometry.unrolling import unrolled
from orthoflow.products import Planes, PointCloud, Surface, Surfaces, Wall
from orthoflow_plugins.raster.extents import Extent, Reach, SampledPoints, extent_of
from orthoflow_plugins.raster.frames import blank
from orthoflow_plugins.raster.parameters import RasterParams

# Axes within 45 degrees of the vertical are upright.
_UPRIGHT_COSINE: Final = math.sqrt(0.5)
# A plane belongs to the relief of a cylinder if at least this share of the plane is in the
# cylinder's buffer.
_COVERED_SHARE: Final = 0.8
_PLACES: Final = 9
# Largest angle from the pole of a developed sphere, where lengths are stretched by a factor of 5.
_FARTHEST_RAD: Final = math.radians(149.0)


class CurvedWalls:
    """The curved surfaces that become walls; they are numbered after all planes."""

    def __init__(self, surfaces: Surfaces | None, planes: Planes, params: RasterParams) -> None:
        self.surfaces: dict[int, Surface] = {}
        self.frames: dict[int, WallFrame] = {}
        self._planes, self._params = planes, params
        found = () if surfaces is None else surfaces.surfaces
        self._vaults = [
            surface
            for surface in found
            if isinstance(surface.shape, Cylinder) and surface.shape.is_concave
        ]
        for k, surface in enumerate(found):
            index = len(planes) + k
            if not _is_chosen(surface, index, planes.up, params):
                continue
            if params.ranks or params.near or len(self.frames) < params.n_walls_max:
                self.surfaces[index] = surface
                self.frames[index] = _frame_of(surface, planes.up, index, params)

    def extent(self, index: int, points: SampledPoints, reach: Reach, *, threads: int) -> Extent:
        """Determine the buffer of a wall from its relief, unrolled onto a plane."""
        frame, surface = self.frames[index], self.surfaces[index]
        behind_m, front_m = limits_m(frame)
        if not reach.is_set:
            slab = Slab(frame=frame, front_m=min(front_m, 1.0), behind_m=min(behind_m, 1.5))
            near = unrolled(points, slab)
            sample = SampledPoints(
                origin=near.origin,
                x=near.x,
                y=near.y,
                z=near.z,
                n_represented=points.n_represented,
            )
            flat = frame.flat
            plane = replace(
                self._planes,
                normal=flat.normal_world[None],
                offset=np.array([flat.plane.offset_m]),
                corners=flat.corners_world()[None],
                covariance=np.zeros((1, 4, 4)),
                n_points=np.array([surface.n_points]),
                rms_m=np.array([surface.rms_m]),
                names=(frame.name,),
                part_corners=None,
                part_plane=None,
                side_from=(),
                thickness=(),
            )
            found = extent_of(sample, plane, 0, reach, threads=threads)
        else:
            found = reach.as_set
        return Extent(front_m=min(found.front_m, front_m), behind_m=min(found.behind_m, behind_m))

    def blank_beyond_groins(self, wall: Wall, index: int) -> None:
        """Set the cells of a vault to void where another vault that crosses it is open.

        Where two vaults cross, the surface of each ends at the groins, beyond which it would be
        inside the other. There, the points in the buffer belong to the other vault.
        """
        own = self.surfaces[index]
        bands = list(row_bands(wall.frame.shape))
        for other in self._vaults if own.shape.is_concave else ():
            if other is own:
                continue
            inside = [_is_inside(other, wall.frame, rows) for rows in bands]
            depths_m = [wall.depth_m[rows][one] for rows, one in zip(bands, inside, strict=True)]
            depth_m = np.concatenate(depths_m)
            depth_m = depth_m[np.isfinite(depth_m)]
            # A vault that was built inside the other one has a surface there.
            if len(depth_m) and np.median(depth_m) < -self._planes.tolerance_m:
                for rows, one in zip(bands, inside, strict=True):
                    blank(wall, rows, one)

    def covers(self, plane: int, buffer_m: tuple[float, float], index: int) -> bool:
        """Return whether a plane is inside the raster and the buffer of a curved wall."""
        frame, corners = self.frames[index], self._planes.corners[plane]
        shares = np.stack(np.meshgrid(*2 * [np.linspace(0.0, 1.0, _PLACES)]), axis=-1)
        places = corners[0] + shares.reshape(-1, 2) @ (corners[[3, 1]] - corners[0])
        on_wall = frame.wall_from_world(places)
        inside = frame.shows(on_wall[:, :2])
        inside &= (on_wall[:, 2] <= buffer_m[0]) & (on_wall[:, 2] >= -buffer_m[1])
        facing = frame.axes_at(on_wall[:, :2])[:, 2] @ self._planes.normal[plane] > 0.0
        return float((inside & facing).mean()) >= _COVERED_SHARE


def limits_m(frame: WallFrame) -> tuple[float, float]:
    """Return the maximum depths behind and in front of a wall, limited towards its axis."""
    if frame.bend is None:
        return math.inf, math.inf
    most_m = (1.0 - NARROWEST) * frame.bend.deepest_m
    return (math.inf, most_m) if frame.bend.is_concave else (most_m, math.inf)


def blank_beside(wall: Wall) -> None:
    """Set the cells beside the development of a cone or sphere to void.

    A cylinder fills its raster.
    """
    if isinstance(wall.frame.bend, ConeBend | SphereBend):
        for rows in row_bands(wall.mask.shape):
            blank(wall, rows, ~wall.frame.shown_cells(rows))


def flattened(cloud: PointCloud, slab: Slab) -> tuple[PointCloud, Slab]:
    """Return a cloud and a slab; if the wall is curved, both are unrolled onto a plane."""
    if slab.frame.bend is None:
        return cloud, slab
    near = unrolled(cloud, slab)
    flat = replace(
        cloud.selected(near.index), origin=near.origin, x=near.x, y=near.y, z=near.z, stations=None
    )
    return flat, replace(slab, frame=slab.frame.flat)


def _is_inside(vault: Surface, frame: WallFrame, rows: slice) -> NDArray[np.bool_]:
    """Return the mask of the cells in some rows whose places on the surface are in a vault.

    A vault is the space between its axis and its arc.
    """
    axis = vault.axis_world
    points = frame.world_from_wall(frame.cell_centres(rows))
    along = (points - vault.middle_world) @ axis
    inside = np.abs(along) < 0.5 * (vault.along_m[1] - vault.along_m[0])
    inside &= vault.shape.distances_m(points) > 0.0
    start = angles_around(points, vault.middle_world, axis, vault.zero_world)
    start = (start - vault.arc_rad[0]) % math.tau
    inside &= start < vault.arc_rad[1] - vault.arc_rad[0]
    return inside.reshape(-1, frame.width)


def _is_chosen(surface: Surface, index: int, up: NDArray[np.float64], params: RasterParams) -> bool:
    if params.ranks:
        return index in params.ranks
    is_upright = abs(float(surface.axis_world @ up)) >= _UPRIGHT_COSINE
    if isinstance(surface.shape, Sphere):
        # Its middle is in the direction of its axis.
        is_upright = not is_upright
    if params.constraint == "horizontal" or (params.constraint == "vertical" and not is_upright):
        return False
    start_rad, end_rad = surface.arc_rad
    length_m = surface.along_m[1] - surface.along_m[0]
    if isinstance(surface.shape, Cone):
        length_m /= math.cos(surface.shape.half_angle_rad)
    area_m2 = (end_rad - start_rad) * surface.radius_m * length_m
    if isinstance(surface.shape, Sphere):
        least, most = np.array(surface.along_m) / surface.radius_m
        area_m2 = math.tau * surface.radius_m**2 * float(np.cos(least) - np.cos(most))
    return bool(params.near) or area_m2 >= params.min_area_m2


def _frame_of(
    surface: Surface, up: NDArray[np.float64], index: int, params: RasterParams
) -> WallFrame:
    east, north, top = up.tolist()
    shape, name = surface.shape, f"{surface.name.rsplit(' ', 1)[0]} {index}"
    if isinstance(shape, Cone):
        frame = _over_cone(surface, shape, up, params)
    elif isinstance(shape, Sphere):
        frame = _over_sphere(surface, shape, up, params)
    else:
        frame = _over_cylinder(surface, shape, up, params)
    return replace(frame, up=(east, north, top), name=name)


def _over_cylinder(
    surface: Surface, shape: Cylinder, up: NDArray[np.float64], params: RasterParams
) -> WallFrame:
    """Return the grid over a cylinder's points, widened on all sides.

    An upright axis is vertical in the image, as a person in front of the wall sees it. The axis of
    a vault points to the right, so that its springing lines are the upper and lower edges of the
    image.
    """
    axis, radius_m, gsd_m = shape.axis_world, shape.radius_m, params.gsd_m
    is_upright = abs(float(axis @ up)) >= _UPRIGHT_COSINE
    is_upwards = float(axis @ up) > 0.0
    start_rad, end_rad = surface.arc_rad
    margin_rad = min(params.margin_m / radius_m, max(0.0, 0.5 * (math.tau - (end_rad - start_rad))))
    start_rad, end_rad = start_rad - margin_rad, end_rad + margin_rad
    low_m, high_m = surface.along_m[0] - params.margin_m, surface.along_m[1] + params.margin_m
    # Direction of the axis in the image: downwards for towers, to the right for vaults.
    straight = (-axis if is_upwards else axis) if is_upright else axis
    first_m = high_m if float(straight @ axis) < 0.0 else low_m
    # Along the arc in the image, angles about the axis decrease if a surface is seen from inside
    # and an upright axis points upwards. They increase if it is seen from outside or its axis
    # points downwards.
    is_from_end = shape.is_concave == (float(straight @ axis) < 0.0 or not is_upright)
    angle = end_rad if is_from_end else start_rad
    beside = np.cross(axis, surface.zero_world)
    outwards = math.cos(angle) * surface.zero_world + math.sin(angle) * beside
    normal = -outwards if shape.is_concave else outwards
    u = np.cross(normal, straight) if is_upright else straight
    arc_m, length_m = (end_rad - start_rad) * radius_m, high_m - low_m
    # The last cell of a full turn may overlap the first one.
    n_arc, n_along = (math.ceil(each_m / gsd_m - 1e-6) for each_m in (arc_m, length_m))
    return WallFrame(
        origin_world=shape.point_world + first_m * axis + radius_m * outwards,
        u_world=u,
        v_world=np.cross(u, normal),
        normal_world=normal,
        gsd_m=gsd_m,
        width=max(1, n_arc if is_upright else n_along),
        height=max(1, n_along if is_upright else n_arc),
        bend=CylinderBend(
            along="u" if is_upright else "v",
            radius_m=radius_m if shape.is_concave else -radius_m,
        ),
    )


def _over_cone(
    surface: Surface, shape: Cone, up: NDArray[np.float64], params: RasterParams
) -> WallFrame:
    """Return the grid over the sector of a cone's points, widened on all sides.

    The middle generatrix of an upright cone is vertical in the image, so that the apex of a spire
    is at the top. The axis of another cone points to the right, as that of a vault.
    """
    axis, gsd_m = shape.axis_world, params.gsd_m
    sine, cosine = math.sin(shape.half_angle_rad), math.cos(shape.half_angle_rad)
    start_rad, end_rad = surface.arc_rad
    least_m = max(0.0, surface.along_m[0] / cosine - params.margin_m)
    most_m = surface.along_m[1] / cosine + params.margin_m
    half_rad = min(0.5 * (end_rad - start_rad) * sine + params.margin_m / most_m, math.pi * sine)
    # The middle generatrix and the normal there.
    middle_rad = 0.5 * (start_rad + end_rad)
    beside = np.cross(axis, surface.zero_world)
    outwards = math.cos(middle_rad) * surface.zero_world + math.sin(middle_rad) * beside
    generatrix = sine * outwards + cosine * axis
    normal = (-1.0 if shape.is_concave else 1.0) * (cosine * outwards - sine * axis)
    is_upright = abs(float(axis @ up)) >= _UPRIGHT_COSINE
    toward = np.array([1.0, 0.0])
    if is_upright:
        toward = np.array([0.0, 1.0 if float(axis @ up) < 0.0 else -1.0])
    u = np.cross(normal, toward[1] * generatrix) if is_upright else generatrix
    # The apex is at the centre of a cell, because a corner of a raster must not be at the apex.
    lowest_m = min(least_m * math.cos(half_rad), most_m * math.cos(half_rad))
    first = math.floor(lowest_m / gsd_m + 0.5 + 1e-6)
    last = math.ceil(most_m / gsd_m - 0.5 - 1e-6)
    n_aside = math.ceil(most_m * math.sin(min(half_rad, 0.5 * math.pi)) / gsd_m - 0.5 - 1e-6)
    before = np.where(toward > 0.0, first, np.where(toward < 0.0, -last, -n_aside)) - 0.5
    bend = ConeBend(
        apex_m=(-most_m * toward[0], -most_m * toward[1]),
        toward_rad=math.atan2(toward[1], toward[0]),
        half_angle_rad=shape.half_angle_rad,
        is_inside=shape.is_concave,
        slants_m=(least_m, most_m),
        half_sector_rad=half_rad,
    )
    at_edge = WallFrame(
        origin_world=shape.apex_world + most_m * generatrix,
        u_world=u,
        v_world=np.cross(u, normal),
        normal_world=normal,
        gsd_m=gsd_m,
        width=1,
        height=1,
        bend=bend,
    )
    n_along, n_across = last - first + 1, 2 * n_aside + 1
    return at_edge.part(
        before - most_m / gsd_m * toward,
        width=n_across if is_upright else n_along,
        height=n_along if is_upright else n_across,
    )


def _over_sphere(
    surface: Surface, shape: Sphere, up: NDArray[np.float64], params: RasterParams
) -> WallFrame:
    """Return the grid around the middle of a sphere's points, widened on all sides.

    At the middle, which is the pole, the axes are those of a plane: a dome is seen from below, like
    a ceiling.
    """
    pole, radius_m, gsd_m = surface.axis_world, shape.radius_m, params.gsd_m
    normal = -pole if shape.is_concave else pole
    u, v = wall_axes(normal, up)
    most_m = min(surface.along_m[1] + params.margin_m, _FARTHEST_RAD * radius_m)
    half = math.ceil(most_m / gsd_m - 1e-6)
    at_pole = WallFrame(
        origin_world=shape.centre_world + radius_m * pole,
        u_world=u,
        v_world=v,
        normal_world=normal,
        gsd_m=gsd_m,
        width=1,
        height=1,
        bend=SphereBend(
            pole_m=(0.0, 0.0), radius_m=radius_m, is_inside=shape.is_concave, most_m=most_m
        ),
    )
    return at_pole.part((-float(half), -float(half)), width=2 * half, height=2 * half)
