"""Directions, planes and wall frames in the world.

A wall frame converts between the cells of a wall's raster and the world.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import GeometryError
from orthoflow.geometry.bends import ConeBend, CylinderBend, SphereBend

UpDirection = Literal["z", "x", "-x", "y", "-y", "-z"]

UP_VECTORS: Final[dict[UpDirection, tuple[float, float, float]]] = {
    "x": (1.0, 0.0, 0.0),
    "-x": (-1.0, 0.0, 0.0),
    "y": (0.0, 1.0, 0.0),
    "-y": (0.0, -1.0, 0.0),
    "z": (0.0, 0.0, 1.0),
    "-z": (0.0, 0.0, -1.0),
}

# Axis e1 for each up axis. e2 = up x e1 completes the right-handed frame; for up = z, the frame is
# (x, y, z).
_FIRST_AXES: Final[dict[int, tuple[float, float, float]]] = {
    0: (0.0, 1.0, 0.0),
    1: (0.0, 0.0, 1.0),
    2: (1.0, 0.0, 0.0),
}


def up_vector(direction: UpDirection) -> NDArray[np.float64]:
    """Return the unit vector (3,) of an up direction in world axes."""
    return np.array(UP_VECTORS[direction])


def basis_from_up(up: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the right-handed frame that defines horizontal directions, omega and phi.

    Args:
        up: (3,) unit vector in world axes.

    Returns:
        (3, 3) with the rows e1, e2, up; `basis @ point_world` gives two horizontal coordinates and
        the height. e1 is the component perpendicular to up of the world axis that follows the axis
        nearest to up (x follows z, y follows x, and z follows y). For up = z, this is the identity.
    """
    axis = int(np.argmax(np.abs(up)))
    first = np.array(_FIRST_AXES[axis])
    first = first - (first @ up) * up
    first /= np.linalg.norm(first)
    return np.array([first, across(up, first), up])


def across(first: NDArray[np.float64], second: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the cross product of two vectors (3,); `np.cross` takes twenty times as long."""
    a, b, c = first.tolist()
    d, e, f = second.tolist()
    return np.array([b * f - c * e, c * d - a * f, a * e - b * d])


@dataclass(frozen=True, kw_only=True)
class Plane:
    """A plane: the points x with `normal . x = offset_m`.

    Attributes:
        normal: (3,) float64 unit vector in world axes, towards the viewer.
        offset_m: signed distance of the plane from the world origin along the normal, metres.
    """

    normal: NDArray[np.float64]
    offset_m: float

    def __post_init__(self) -> None:
        if self.normal.shape != (3,) or abs(float(np.linalg.norm(self.normal)) - 1.0) > 1e-9:
            raise GeometryError(f"a plane needs a unit normal of shape (3,), got {self.normal!r}")

    def distances_m(self, points_world: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return signed distances (n,) of points (n, 3), metres, positive towards the viewer."""
        return points_world @ self.normal - self.offset_m

    def flipped(self) -> Plane:
        """Return the same plane with the opposite normal."""
        return Plane(normal=-self.normal, offset_m=-self.offset_m)

    def towards(self, viewpoint_world: NDArray[np.float64]) -> Plane:
        """Return the same plane with its normal towards a viewpoint (3,)."""
        signed_m = float(viewpoint_world @ self.normal) - self.offset_m
        return self if signed_m >= 0.0 else self.flipped()


def plane_through(points_world: NDArray[np.float64]) -> Plane:
    """Return the plane through three points (3, 3); its normal follows the right-hand rule.

    Raises:
        GeometryError: the points coincide or are collinear.
    """
    first, second, third = points_world
    normal = np.cross(second - first, third - first)
    length = float(np.linalg.norm(normal))
    extent = float(np.linalg.norm(points_world - first, axis=1).max())
    if not math.isfinite(length) or length <= 1e-9 * extent * extent or length == 0.0:
        raise GeometryError(
            f"three points must define a plane, but {points_world.tolist()} are collinear"
        )
    normal = normal / length
    return Plane(normal=normal, offset_m=float(normal @ points_world.mean(axis=0)))


def angle_between_deg(first: NDArray[np.float64], second: NDArray[np.float64]) -> float:
    """Return the angle between two unit vectors in degrees, 0 to 180; small angles are accurate."""
    cross = float(np.linalg.norm(np.cross(first, second)))
    return math.degrees(math.atan2(cross, float(first @ second)))


def omega_phi_deg(normal: NDArray[np.float64], up: NDArray[np.float64]) -> tuple[float, float]:
    """Return the azimuth omega (0 to 360) and elevation phi (-90 to 90) of a normal, in degrees.

    markiewicz2015 equation 3: n = (cos phi cos omega, cos phi sin omega, sin phi), in the (e1, e2,
    up) frame of `basis_from_up`.
    """
    first, second, height = basis_from_up(up) @ normal
    omega = math.degrees(math.atan2(second, first)) % 360.0
    return omega, math.degrees(math.asin(max(-1.0, min(1.0, height))))


def rotation_from_vector(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotation matrix (3, 3) of a rotation vector (3,) in radians (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    cross = cross_matrix(vector)
    if angle < 1e-8:
        return np.eye(3) + cross + 0.5 * cross @ cross
    first, second = math.sin(angle) / angle, (1.0 - math.cos(angle)) / angle**2
    return np.eye(3) + first * cross + second * cross @ cross


def cross_matrix(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return M (3, 3) such that M @ x is the cross product of a vector (3,) and x."""
    matrix: NDArray[np.float64] = cross_matrices(vector[None])[0]
    return matrix


def cross_matrices(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the matrices of `cross_matrix`, (n, 3, 3), for vectors (n, 3)."""
    matrices = np.zeros((len(vectors), 3, 3))
    x, y, z = vectors.T
    matrices[:, 0, 1], matrices[:, 0, 2] = -z, y
    matrices[:, 1, 0], matrices[:, 1, 2] = z, -x
    matrices[:, 2, 0], matrices[:, 2, 1] = -y, x
    return matrices


def signed_area(ring: NDArray[np.float64]) -> float:
    """Return the signed area of an open ring (n, 2), by the shoelace formula.

    The area is positive if the ring is counter-clockwise in axes with x to the right and y up. Far
    from the origin, precision is lost, so pass coordinates relative to one of the points.

    >>> signed_area(np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 1.0], [0.0, 1.0]]))
    2.0
    """
    x, y = ring.T
    return 0.5 * float(x @ np.roll(y, -1) - y @ np.roll(x, -1))


# A plane is a floor or ceiling if the angle between its normal and the vertical is smaller than
# this. With a nearly vertical normal, the direction to the right of the viewer would depend on
# noise.
LEVEL_LIMIT_DEG: Final = 10.0
# Coordinates in survey frames on Earth are smaller than this; larger ones are corrupt.
#: maximum distance from the origin in metres; points farther away are ignored with a warning
FARTHEST_M: Final = 1e9
_LEAST_COSINE: Final = math.cos(math.radians(LEVEL_LIMIT_DEG))

RasterAxes = Literal["map", "wall", "level", "plane"]


@dataclass(frozen=True, kw_only=True)
class WallFrame:
    """A raster on a plane, cylinder or cone; u points to the right of the viewer, n to the viewer.

    The axis v points down; `u x v = -n`. The centre of cell (row, column) is at (column + 0.5,
    row + 0.5). On a plane, the world coordinates of a position (column, row) at a given depth are
    `origin_world + gsd_m * (column * u_world + row * v_world) + depth_m * normal_world`.

    On a curved surface, the axes depend on the position (see `axes_at`), and `u_world`, `v_world`
    and `normal_world` are those at the top-left corner. The surface is unrolled (see `bends`), and
    the depth is the distance from it along the local normal.

    Attributes:
        origin_world: (3,) float64 metres, outer corner of the top-left cell, on the surface.
        u_world: (3,) unit vector, at the origin.
        v_world: (3,) unit vector, at the origin.
        normal_world: (3,) unit vector, at the origin.
        gsd_m: side of a cell in metres.
        width: number of columns.
        height: number of rows.
        map_crs: coordinate system if the raster is a map, with u to the east and v to the south: an
            EPSG code, or `site` for a local system. None if the raster is not a map.
        up: unit vector in the direction of increasing height; None if unknown.
        name: name of the wall, used in the name of the raster's coordinate system.
        left_m: distance along the wall from its left edge to the left edge of this raster, if the
            raster shows only part of the wall.
        bend: curvature of a raster on a cylinder, cone or sphere; None for a raster on a plane.
    """

    origin_world: NDArray[np.float64]
    u_world: NDArray[np.float64]
    v_world: NDArray[np.float64]
    normal_world: NDArray[np.float64]
    gsd_m: float
    width: int
    height: int
    map_crs: str | None = None
    up: tuple[float, float, float] | None = None
    name: str = ""
    left_m: float = 0.0
    bend: CylinderBend | ConeBend | SphereBend | None = None

    def __post_init__(self) -> None:
        if not (self.gsd_m > 0.0 and self.width > 0 and self.height > 0):
            raise GeometryError(
                f"a wall frame needs a positive cell size and at least one cell, got "
                f"{self.gsd_m} m and {self.width} x {self.height}"
            )
        vectors = (self.origin_world, self.u_world, self.v_world, self.normal_world)
        if any(np.shape(vector) != (3,) for vector in vectors):
            raise GeometryError(
                "a wall frame needs an origin and three axes, each with 3 coordinates"
            )
        if not np.allclose(np.cross(self.u_world, self.v_world), -self.normal_world, atol=1e-9):
            raise GeometryError("a wall frame needs u x v = -n, but these axes mirror the image")
        if isinstance(self.bend, CylinderBend):
            # A raster of whole blocks of cells may exceed a full turn by a part of a block.
            n_cells = self.width if self.bend.along == "u" else self.height
            if (n_cells - 1) * self.gsd_m > math.tau * abs(self.bend.radius_m):
                raise GeometryError(
                    f"a curved wall frame must not exceed one turn, got {n_cells} cells of "
                    f"{self.gsd_m} m at a radius of {abs(self.bend.radius_m)} m"
                )
        if self.bend is not None and self.map_crs is not None:
            raise GeometryError("a curved wall frame cannot be a map")

    @property
    def axes_world(self) -> NDArray[np.float64]:
        """The vectors u, v and n, as rows (3, 3); on a curved surface, at the top-left corner."""
        return np.array([self.u_world, self.v_world, self.normal_world])

    @property
    def size_m(self) -> NDArray[np.float64]:
        """Width and height (2,) of the raster in metres."""
        return np.array([self.gsd_m * self.width, self.gsd_m * self.height])

    @property
    def shape(self) -> tuple[int, int]:
        """Numbers of rows and columns."""
        return self.height, self.width

    @property
    def raster_axes(self) -> RasterAxes:
        """Meaning of X and Y in the files of this raster.

        For upright walls, X is the distance along the wall, and Y is the height, which is exact at
        the top edge. For floors and ceilings, X and Y are the horizontal world axes. Y of a ceiling
        increases with the row number, so that the ceiling can be superimposed on the floor. For
        sloping planes, and if up is unknown, X and Y are distances from the top-left corner.
        Cylinders with a vertical axis are treated as walls, with the heights of the axis; other
        cylinders are treated as sloping planes. On cones and spheres, X and Y are distances from
        the apex or pole.
        """
        if self.map_crs is not None:
            return "map"
        bend = self.bend
        if self.up is None or (
            bend is not None and not (isinstance(bend, CylinderBend) and bend.along == "u")
        ):
            return "plane"
        if -float(self.v_world @ self.up) >= _LEAST_COSINE:
            return "wall"
        if bend is not None:
            return "plane"
        first = basis_from_up(np.array(self.up))[0]
        is_level = abs(float(self.normal_world @ self.up)) >= _LEAST_COSINE
        return "level" if is_level and float(self.u_world @ first) >= _LEAST_COSINE else "plane"

    @property
    def raster_corner_m(self) -> tuple[float, float]:
        """X and Y of the outer corner of the top-left cell, as in files, in metres."""
        axes = self.raster_axes
        if axes == "map":
            return float(self.origin_world[0]), float(self.origin_world[1])
        if self.bend is not None and self.bend.revolution.fan > 0.0:
            right_m, down_m = self.bend.revolution.place_m.tolist()
            return -right_m, down_m
        if axes == "plane" or self.up is None:
            return 0.0, 0.0
        # If a tower leans, the height varies along a row of cells; the height of the axis does not.
        beside = self.origin_world
        if isinstance(self.bend, CylinderBend):
            beside = beside + self.bend.radius_m * self.normal_world
        first, second, height = (basis_from_up(np.array(self.up)) @ beside).tolist()
        return (self.left_m, height) if axes == "wall" else (first, second)

    @property
    def raster_down(self) -> float:
        """Change of Y per metre in the direction of v: -1, or 1 for ceilings."""
        if self.up is None or self.raster_axes != "level":
            return -1.0
        return 1.0 if float(self.normal_world @ self.up) < 0.0 else -1.0

    @property
    def crs(self) -> str:
        """Name of the coordinate system, as in files.

        For a wall, it consists of the name of the wall and a hash of the world position of X = Y =
        0. The name is therefore the same for all rasters of a wall and of its parts, and differs
        between walls.
        """
        if self.map_crs is not None:
            return self.map_crs
        start_m = np.zeros((1, 2))
        if isinstance(self.bend, ConeBend):
            # At the apex itself, there are no axes.
            start_m[0] = math.cos(self.bend.toward_rad), -math.sin(self.bend.toward_rad)
        at = self.wall_from_raster(start_m)
        zero, axes = self.world_from_wall(at)[0], self.axes_at(at)[0, :2]
        # The position is rounded to millimetres, the axes to 1e-6.
        place = [*np.round(1e3 * zero), *np.round(1e6 * axes.ravel())]
        if isinstance(self.bend, ConeBend):
            place.append(np.round(1e6 * self.bend.half_angle_rad))
        elif self.bend is not None:
            place.append(np.round(1e3 * self.bend.radius_m))
        digest = hashlib.sha256(",".join(f"{value:.0f}" for value in place).encode()).hexdigest()
        return f"{self.name or 'plane'} {digest[:8]}"

    @property
    def plane(self) -> Plane:
        """Plane that contains the raster; for a curved surface, the tangent plane at its middle."""
        if self.bend is not None:
            normal = self.facing_world
            return Plane(normal=normal, offset_m=float(normal @ self.middle_world))
        return Plane(
            normal=self.normal_world, offset_m=float(self.normal_world @ self.origin_world)
        )

    @property
    def middle_world(self) -> NDArray[np.float64]:
        """Point (3,) on the surface at the middle of the raster, in metres."""
        middle: NDArray[np.float64] = self.world_from_wall(0.5 * self._size)[0]
        return middle

    @property
    def facing_world(self) -> NDArray[np.float64]:
        """Unit normal (3,) at the middle of the raster."""
        normal: NDArray[np.float64] = self.axes_at(0.5 * self._size)[0, 2]
        return normal

    @property
    def flat(self) -> WallFrame:
        """The same raster on a plane; a curved one is unrolled onto the plane at its corner."""
        return self if self.bend is None else replace(self, bend=None)

    def of_rows(self, rows: slice) -> WallFrame:
        """Return the frame of the part of the raster with the given rows."""
        height = rows.stop - rows.start
        if self.bend is not None:
            return self.part((0.0, float(rows.start)), width=self.width, height=height)
        corner = self.origin_world + rows.start * self.gsd_m * self.v_world
        return replace(self, origin_world=corner, height=height)

    def part(
        self, corner: tuple[float, float] | NDArray[np.float64], *, width: int, height: int
    ) -> WallFrame:
        """Return the frame of another part of the same surface.

        Args:
            corner: column and row of the top-left corner of the part, which may be outside this
                raster.
            width: number of columns.
            height: number of rows.
        """
        at = np.array([corner], dtype=np.float64)
        placed = replace(self, origin_world=self.world_from_wall(at)[0], width=width, height=height)
        if self.bend is None:
            return placed
        u, v, normal = self.axes_at(at)[0]
        bend = self.bend.moved(self.gsd_m * at[0])
        return replace(placed, u_world=u, v_world=v, normal_world=normal, bend=bend)

    def has_cells_of(self, other: WallFrame) -> bool:
        """Return whether both frames have the same cells, to within 0.001 cells at the corners."""
        if self.shape != other.shape or (self.bend is None) != (other.bend is None):
            return False
        # Rasters on surfaces with different radii or sides may have the same corners, but not the
        # same middle.
        apart = max(
            np.abs(self.corners_world() - other.corners_world()).max(),
            0.0 if self.bend is None else np.abs(self.middle_world - other.middle_world).max(),
        )
        return bool(apart <= 1e-3 * self.gsd_m)

    def world_from_wall(
        self, pixels_wall: NDArray[np.float64], depths_m: NDArray[np.float64] | float = 0.0
    ) -> NDArray[np.float64]:
        """Return the world points (n, 3) at positions (n, 2) = (column, row) and depths (n,)."""
        # In notebooks, users may pass a single position as a list of two numbers.
        pixels = np.atleast_2d(np.asarray(pixels_wall, dtype=np.float64))
        if self.bend is not None:
            local = self.bend.points(self.gsd_m * pixels, depths_m)
            return np.asarray(self.origin_world + local @ self.axes_world)
        in_plane = self.gsd_m * (pixels[:, :1] * self.u_world + pixels[:, 1:2] * self.v_world)
        lifted = np.multiply.outer(np.broadcast_to(depths_m, len(pixels)), self.normal_world)
        points: NDArray[np.float64] = self.origin_world + in_plane + lifted
        return points

    def wall_from_world(self, points_world: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return wall positions (n, 3) = (column, row, depth in metres) of world points (n, 3)."""
        relative = points_world - self.origin_world
        if self.bend is not None:
            size_m = self.size_m
            on_wall = self.bend.places(relative @ self.axes_world.T, size_m)
            on_wall[:, :2] /= self.gsd_m
            return on_wall
        return np.column_stack(
            [
                relative @ self.u_world / self.gsd_m,
                relative @ self.v_world / self.gsd_m,
                relative @ self.normal_world,
            ]
        )

    def axes_at(self, pixels_wall: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the axes u, v and n, as rows (n, 3, 3), at positions (n, 2) = (column, row)."""
        pixels = np.atleast_2d(np.asarray(pixels_wall, dtype=np.float64))
        if self.bend is None:
            return np.broadcast_to(self.axes_world, (len(pixels), 3, 3))
        return np.asarray(self.bend.axes_at(self.gsd_m * pixels) @ self.axes_world)

    def outline_world(self, n_sides: int = 64) -> NDArray[np.float64]:
        """Return the closed outline (n, 3) of the surface, with points along its arcs."""
        if self.bend is None:
            return self.corners_world()[[0, 1, 2, 3, 0]]
        if isinstance(self.bend, SphereBend):
            # The whole turn about the pole has no edges along meridians.
            rim = self.bend.ribs_m(self.size_m, 2 * n_sides)[:, 1] / self.gsd_m
            return self.world_from_wall(rim)
        ribs = self.bend.ribs_m(self.size_m, n_sides) / self.gsd_m
        shares = np.linspace(0.0, 1.0, n_sides)[:, None]
        first, last = (rib[0] + shares * (rib[1] - rib[0]) for rib in (ribs[0], ribs[-1]))
        return self.world_from_wall(np.vstack([first, ribs[:, 1], last[::-1], ribs[::-1, 0]]))

    def shows(self, pixels_wall: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return whether positions (n, 2) = (column, row) are in the raster and on its surface."""
        inside = ((pixels_wall >= 0.0) & (pixels_wall <= self._size)).all(axis=1)
        if self.bend is not None:
            inside &= self.bend.contains(self.gsd_m * pixels_wall)
        return np.asarray(inside)

    def cell_centres(self, rows: slice) -> NDArray[np.float64]:
        """Return the centres (k * width, 2) = (column, row) of the cells of k rows."""
        columns, rows_of = np.arange(self.width) + 0.5, np.arange(self.height)[rows] + 0.5
        return np.stack(np.meshgrid(columns, rows_of), axis=-1).reshape(-1, 2)

    def shown_cells(self, rows: slice) -> NDArray[np.bool_]:
        """Return which cells (k, width) of k rows have their centres on the surface."""
        return self.shows(self.cell_centres(rows)).reshape(-1, self.width)

    def met_by(
        self, start_world: NDArray[np.float64], rays: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the points (n, 3) where rays first meet the front of the raster; NaN if they miss.

        Args:
            start_world: (3,) start of all rays.
            rays: (n, 3) directions.
        """
        points = np.full((len(rays), 3), np.nan)
        with np.errstate(divide="ignore", invalid="ignore"):
            lengths = self._lengths_to_surface(start_world, rays)
        ahead = np.flatnonzero(lengths > 0.0)
        met = start_world + lengths[ahead, None] * rays[ahead]
        on_wall = self.wall_from_world(met)[:, :2]
        facing = np.einsum("ij,ij->i", rays[ahead], self.axes_at(on_wall)[:, 2]) < 0.0
        inside = self.shows(on_wall) & facing
        points[ahead[inside]] = met[inside]
        return points

    def _lengths_to_surface(
        self, start_world: NDArray[np.float64], rays: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return distances (n,) along rays to the surface facing them, in units of ray lengths."""
        to_origin = self.origin_world - start_world
        if self.bend is None:
            return np.asarray((to_origin @ self.normal_world) / (rays @ self.normal_world))
        return self.bend.met_lengths(-self.axes_world @ to_origin, rays @ self.axes_world.T)

    def metres_per_cell(
        self, pixels_wall: NDArray[np.float64], depths_m: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the sizes (n, 2) of cells along u and v, in metres.

        In front of a surface seen from inside, arcs are shorter; in front of one seen from outside,
        they are longer.

        Args:
            pixels_wall: (n, 2) = (column, row).
            depths_m: (n,) depths.
        """
        if self.bend is None:
            return np.full((len(depths_m), 2), self.gsd_m)
        return self.gsd_m * self.bend.scales(self.gsd_m * pixels_wall, depths_m)

    def require_plane(self, what: str) -> None:
        """Refuse a curved raster where only planes can be processed.

        Args:
            what: name, for the message, of the method or operation.

        Raises:
            GeometryError: the raster is on a curved surface.
        """
        if self.bend is not None:
            raise GeometryError(f"{what} does not take curved walls, but {self.name} is one")

    @property
    def _size(self) -> NDArray[np.float64]:
        return np.array([[self.width, self.height]], dtype=np.float64)

    def raster_from_wall(self, pixels_wall: NDArray[np.float64]) -> NDArray[np.float64]:
        """Convert (n, 2) = (column, row) to (n, 2) = (X, Y), in metres as in files."""
        return np.array(self.raster_corner_m) + self.gsd_m * pixels_wall * [1.0, self.raster_down]

    def wall_from_raster(self, places_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Convert (n, 2) = (X, Y), in metres as in files, to (n, 2) = (column, row)."""
        pixels: NDArray[np.float64] = (
            (places_m - np.array(self.raster_corner_m)) * [1.0, self.raster_down] / self.gsd_m
        )
        return pixels

    def distances_m(self, points_world: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the distances (n,) of world points (n, 3) from the rectangle of the raster."""
        on_wall = self.wall_from_world(points_world)
        beside_px = on_wall[:, :2] - np.clip(on_wall[:, :2], 0.0, [self.width, self.height])
        beside_m = self.gsd_m * np.linalg.norm(beside_px, axis=1)
        return np.asarray(np.hypot(beside_m, on_wall[:, 2]))

    def corners_world(self) -> NDArray[np.float64]:
        """Return the outer corners (4, 3): top-left first, counter-clockwise for the viewer."""
        columns = np.array([0, 0, self.width, self.width], dtype=np.float64)
        rows = np.array([0, self.height, self.height, 0], dtype=np.float64)
        return self.world_from_wall(np.column_stack([columns, rows]))


def wall_axes(normal: NDArray[np.float64], up: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the axes u and v of a wall frame on a plane.

    u is horizontal and points to the right of the viewer. For floors and ceilings (normal within 10
    degrees of the vertical), u is the axis e1 of `basis_from_up` projected onto the plane, so that
    a floor looks like a map, with e1 to the right and e2 upwards.

    Args:
        normal: (3,) unit vector towards the viewer.
        up: (3,) unit vector.

    Returns:
        (2, 3) with the rows u and v.
    """
    if abs(float(normal @ up)) > math.cos(math.radians(LEVEL_LIMIT_DEG)):
        first = basis_from_up(up)[0]
        u = first - (first @ normal) * normal
    else:
        u = across(up, normal)
    u = u / np.linalg.norm(u)
    return np.array([u, across(u, normal)])


def frame_over(
    corners_world: NDArray[np.float64], normal: NDArray[np.float64], *, gsd_m: float
) -> WallFrame:
    """Return the wall frame of a rectangle on a plane.

    Args:
        corners_world: (4, 3) metres, top-left first, counter-clockwise for the viewer.
        normal: (3,) unit vector of the rectangle, towards the viewer.
        gsd_m: side of a cell in metres.

    Returns:
        The frame that begins at the top-left corner of the rectangle and covers it; the right and
        bottom edges may exceed it by less than a cell.
    """
    top_left, bottom_left, _, top_right = corners_world
    u = top_right - top_left
    width_m = float(np.linalg.norm(u))
    height_m = float(np.linalg.norm(bottom_left - top_left))
    if not (width_m > 0.0 and height_m > 0.0):
        raise GeometryError(
            f"the area of a rectangle must not be 0, got corners {corners_world.tolist()}"
        )
    # Stored corners are rounded, so make the axes perpendicular to the normal again.
    u = u - (u @ normal) * normal
    u = u / np.linalg.norm(u)
    return WallFrame(
        origin_world=top_left.copy(),
        u_world=u,
        v_world=np.cross(u, normal),
        normal_world=normal.copy(),
        gsd_m=gsd_m,
        # With the tolerance of 1e-6 cells, a width of 3.000000001 m and cells of 3 mm gives no
        # extra column.
        width=max(1, math.ceil(width_m / gsd_m - 1e-6)),
        height=max(1, math.ceil(height_m / gsd_m - 1e-6)),
    )
