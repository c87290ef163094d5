"""Textured vaults, towers, spires and domes with a projecting band, and photos of them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import Cone, Cylinder, Sphere
from orthoflow.geometry.cameras import ViewingCamera, looking_at
from orthoflow.geometry.surfaces import along_and_across, angles_around, zero_direction
from orthoflow.products import PointCloud, Surface, Surfaces, surface_kind
from tests import samples
from tests.raster_scenes import UP, cell_centres, cloud_of

NO_PLANES = samples.planes(
    normal=np.zeros((0, 3)), offset=np.zeros(0), corners=np.zeros((0, 4, 3)), names=()
)


@dataclass(frozen=True, kw_only=True)
class Drum:
    """A cylinder or cone with a band around it, `band_m` along it, that projects by `height_m`.

    On a cone, positions along it are distances from the apex, and lengths of the arc those at the
    middle of `along_m`.
    """

    shape: Cylinder | Cone
    arc_rad: tuple[float, float]
    along_m: tuple[float, float]
    band_m: tuple[float, float] = (0.0, 0.0)
    height_m: float = 0.0

    @property
    def zero_world(self) -> NDArray[np.float64]:
        return zero_direction(self.shape.axis_world, UP)

    @property
    def axis_world(self) -> NDArray[np.float64]:
        return self.shape.axis_world

    @property
    def half_rad(self) -> float:
        """Angle between the axis and the generatrices."""
        return self.shape.half_angle_rad if isinstance(self.shape, Cone) else 0.0

    @property
    def start_world(self) -> NDArray[np.float64]:
        shape = self.shape
        return shape.point_world if isinstance(shape, Cylinder) else shape.apex_world

    @property
    def radius_m(self) -> float:
        if isinstance(self.shape, Cylinder):
            return self.shape.radius_m
        return float(np.mean(self.along_m)) * math.sin(self.half_rad)

    @property
    def sides_m(self) -> tuple[float, float]:
        """Sides of the unrolled surface, or of the box around its sector."""
        low_m, high_m = self.along_m
        half_m = 0.5 * float(np.ptp(self.arc_rad)) * self.radius_m
        if isinstance(self.shape, Cylinder):
            return high_m - low_m, 2.0 * half_m
        turn = 2.0 * half_m / (low_m + high_m)
        return high_m - low_m * math.cos(turn), 2.0 * high_m * math.sin(turn)

    def surfaces(self) -> Surfaces:
        shape, (low_m, high_m) = self.shape, self.along_m
        surface = Surface(
            name=f"{surface_kind(shape, UP, self.zero_world)} 0",
            shape=shape,
            covariance=np.zeros((7, 7)),
            n_points=1000,
            rms_m=0.001,
            zero_world=self.zero_world,
            along_m=(low_m * math.cos(self.half_rad), high_m * math.cos(self.half_rad)),
            arc_rad=self.arc_rad,
        )
        return Surfaces(surfaces=(surface,), up=UP)

    def points(
        self, arc_m: NDArray[np.float64], along_m: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """World points (n, 3) of the surface at lengths of the arc from the zero direction."""
        on_band = (along_m >= self.band_m[0]) & (along_m < self.band_m[1])
        depths_m = (-1.0 if self.shape.is_concave else 1.0) * self.height_m * on_band
        sine, cosine = math.sin(self.half_rad), math.cos(self.half_rad)
        radii_m = cosine * depths_m + sine * along_m
        if isinstance(self.shape, Cylinder):
            radii_m = radii_m + self.radius_m
        axis, angles = self.shape.axis_world, arc_m / self.radius_m
        beside = np.cross(axis, self.zero_world)
        outwards = np.outer(np.cos(angles), self.zero_world) + np.outer(np.sin(angles), beside)
        axial = np.outer(cosine * along_m - sine * depths_m, axis)
        return self.start_world + axial + radii_m[:, None] * outwards

    def places(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Length of the arc and position along the axis (n, 2) of world points, in metres."""
        start, axis = self.start_world, self.shape.axis_world
        angles = angles_around(points, start, axis, self.zero_world)
        middle = sum(self.arc_rad) / 2.0
        angles = middle + (angles - middle + math.pi) % math.tau - math.pi
        axial, across = along_and_across(points, start, axis)
        along = math.cos(self.half_rad) * axial
        along += math.sin(self.half_rad) * np.linalg.norm(across, axis=1)
        return np.column_stack([self.radius_m * angles, along])

    def texture(self, places_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Grey values (n,) of places; those of a cone are a function of the unrolled position."""
        if isinstance(self.shape, Cone):
            turns = math.sin(self.half_rad) * places_m[:, 0] / self.radius_m
            slants = places_m[:, 1]
            places_m = np.column_stack([slants * np.sin(turns), slants * np.cos(turns)])
        return texture(places_m)

    def cloud(self, step_m: float) -> PointCloud:
        """Points with the texture as intensity and colour."""
        arc = np.array(self.arc_rad) * self.radius_m
        arcs, alongs = np.meshgrid(np.arange(*arc, step_m), np.arange(*self.along_m, step_m))
        places = np.column_stack([arcs.ravel(), alongs.ravel()])
        places += np.random.default_rng(3).uniform(-0.3, 0.3, places.shape) * step_m
        inside = (places[:, 0] >= arc[0]) & (places[:, 1] >= self.along_m[0])
        places = places[inside]
        grey = self.texture(places)
        rgb = np.repeat(np.rint(255.0 * grey)[:, None], 3, axis=1).astype(np.uint8)
        return cloud_of(self.points(*places.T), rgb=rgb, intensity=grey.astype(np.float32))

    def met(self, start: NDArray[np.float64], rays: NDArray[np.float64]) -> NDArray[np.float64]:
        """Distances (n,), in lengths of the rays (n, 3), at which they first meet the surface."""
        sine, cosine = math.sin(self.half_rad), math.cos(self.half_rad)
        side = -1.0 if self.shape.is_concave else 1.0
        base_m = self.radius_m if isinstance(self.shape, Cylinder) else 0.0
        axial, across = along_and_across(start, self.start_world, self.shape.axis_world)
        slope, beside = along_and_across(rays, np.zeros(3), self.shape.axis_world)
        arc = np.array(self.arc_rad) * self.radius_m
        best = np.full(len(rays), np.inf)

        def keep(t: NDArray[np.float64], *, is_band: bool | None) -> None:
            ahead = np.flatnonzero((t > 1e-6) & (t < best))
            places = self.places(start[ahead] + t[ahead, None] * rays[ahead])
            good = (places >= [arc[0], self.along_m[0]]) & (places <= [arc[1], self.along_m[1]])
            on_band = (places[:, 1] >= self.band_m[0]) & (places[:, 1] < self.band_m[1])
            if is_band is not None and self.height_m:
                good &= (on_band == is_band)[:, None]
            best[ahead[good.all(axis=1)]] = t[ahead[good.all(axis=1)]]

        # Lines of the profile: cosines of the distance from the axis and of the one along it, and
        # their sum; those of the surface, of the band and of its two edges.
        lines: list[tuple[float, float, float, bool | None]] = [
            (cosine, -sine, cosine * base_m, False),
            (cosine, -sine, cosine * base_m + side * self.height_m, True),
            *((sine, cosine, edge_m, None) for edge_m in (self.band_m if self.height_m else ())),
        ]
        # Squared distance from the axis: a polynomial of t.
        squares = [
            (one * other).sum(axis=1)
            for one, other in ((across, across), (across, beside), (beside, beside))
        ]
        for of_radius, of_axial, total, is_band in lines:
            rest, slopes = total - of_axial * axial, of_axial * slope
            a = of_radius**2 * squares[2] - slopes**2
            b = of_radius**2 * squares[1] + rest * slopes
            c = of_radius**2 * squares[0] - rest**2
            for sign in (-1.0, 1.0):
                with np.errstate(invalid="ignore", divide="ignore"):
                    root = b * b - a * c
                    t = (-b + sign * np.sqrt(np.maximum(root, 0.0))) / a
                    t[root < -1e-9 * b * b] = np.nan
                    radii = np.sqrt(squares[0] + t * (2.0 * squares[1] + t * squares[2]))
                    t[np.abs(of_radius * radii - (rest - t * slopes)) > 1e-6] = np.nan
                    depths = side * (cosine * (radii - base_m) - sine * (axial + t * slope))
                if is_band is None:
                    t[~((depths > 0.0) & (depths < self.height_m))] = np.nan
                keep(t, is_band=is_band)
        return best

    def rendered(self, camera: ViewingCamera) -> NDArray[np.uint8]:
        """What a camera sees (height, width, 3), 0 beside the surface."""
        rays = camera.rays_world(np.column_stack(cell_centres((camera.height, camera.width))))
        start = np.broadcast_to(camera.centre_world, rays.shape)
        t = self.met(start, rays)
        grey, seen = np.zeros(len(t)), np.isfinite(t)
        grey[seen] = self.texture(self.places(start[seen] + t[seen, None] * rays[seen]))
        image = np.rint(255.0 * grey).astype(np.uint8).reshape(camera.height, camera.width)
        return np.repeat(image[..., None], 3, axis=2)


@dataclass(frozen=True, kw_only=True)
class Ball(Drum):
    """A sphere around its pole, which is above; `along_m` and `band_m` are distances from it."""

    shape: Sphere  # type: ignore[assignment]

    @property
    def zero_world(self) -> NDArray[np.float64]:
        return UP

    @property
    def axis_world(self) -> NDArray[np.float64]:
        return np.eye(3)[0]

    @property
    def radius_m(self) -> float:
        return self.shape.radius_m

    @property
    def sides_m(self) -> tuple[float, float]:
        return 2.0 * self.along_m[1], 2.0 * self.along_m[1]

    def points(
        self, arc_m: NDArray[np.float64], along_m: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        on_band = (along_m >= self.band_m[0]) & (along_m < self.band_m[1])
        side = -1.0 if self.shape.is_concave else 1.0
        radii_m = self.radius_m + side * self.height_m * on_band
        angles, turns = arc_m / self.radius_m, along_m / self.radius_m
        level = np.sin(turns)[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
        outwards = np.column_stack([level, np.cos(turns)])
        return self.shape.centre_world + radii_m[:, None] * outwards

    def places(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        x, y, z = (points - self.shape.centre_world).T
        return self.radius_m * np.column_stack([np.arctan2(y, x), np.arctan2(np.hypot(x, y), z)])

    def texture(self, places_m: NDArray[np.float64]) -> NDArray[np.float64]:
        angles, along_m = places_m[:, 0] / self.radius_m, places_m[:, 1]
        return texture(along_m[:, None] * np.column_stack([np.cos(angles), np.sin(angles)]))

    def met(self, start: NDArray[np.float64], rays: NDArray[np.float64]) -> NDArray[np.float64]:
        relative, side = start - self.shape.centre_world, -1.0 if self.shape.is_concave else 1.0
        top_m = self.radius_m + side * self.height_m
        # Coefficients of squares of the height and of the distance from the centre, and their sum.
        lines: list[tuple[float, float, float, bool | None]] = [
            (0.0, 1.0, self.radius_m**2, False),
            (0.0, 1.0, top_m**2, True),
        ]
        cosines = [math.cos(edge_m / self.radius_m) for edge_m in self.band_m if self.height_m]
        lines += [(1.0, -(cosine**2), 0.0, None) for cosine in cosines]
        best = np.full(len(rays), np.inf)
        for of_height, of_square, total, is_band in lines:
            one, other = (
                of_height * part[:, 2:] * UP + of_square * part for part in (rays, relative)
            )
            a, b = (one * rays).sum(axis=1), (one * relative).sum(axis=1)
            c = (other * relative).sum(axis=1) - total
            for sign in (-1.0, 1.0):
                with np.errstate(invalid="ignore"):
                    t = (-b + sign * np.sqrt(b * b - a * c)) / a
                points = start + t[:, None] * rays
                along_m = self.places(points)[:, 1]
                good = (t > 1e-6) & (along_m <= self.along_m[1])
                on_band = (along_m >= self.band_m[0]) & (along_m < self.band_m[1])
                if is_band is None:
                    depths = self.shape.distances_m(points)
                    good &= np.abs(along_m[:, None] - self.band_m).min(axis=1) < 1e-6
                    good &= (depths > 0.0) & (depths < self.height_m)
                elif self.height_m:
                    good &= on_band == is_band
                best = np.where(good & (t < best), t, best)
        return best


def texture(places_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Grey values 0..1 (n,), with detail of 2 to 40 cm that occurs nowhere twice."""
    rng = np.random.default_rng(23)
    total = np.zeros(len(places_m), dtype=np.float32)
    for length_m in np.geomspace(0.02, 0.4, 20):
        direction, phase = rng.uniform(0.0, 2.0 * np.pi, 2)
        along = places_m @ [np.cos(direction), np.sin(direction)]
        total += np.sin((2.0 * np.pi * along / length_m + phase).astype(np.float32))
    return np.asarray(0.5 + 0.45 * np.tanh(total / 3.5), dtype=np.float64)


def vault(*, half_deg: float = 75.0, length_m: float = 3.0, **band: object) -> Drum:
    """A barrel vault of 3 m radius, its axis turned by 20 degrees and 2 m high."""
    turn = np.radians(20.0)
    cylinder = Cylinder(
        point_world=np.array([4.0, 5.0, 2.0]),
        axis_world=np.array([np.cos(turn), np.sin(turn), 0.0]),
        radius_m=3.0,
        is_concave=True,
    )
    half, reach = math.radians(half_deg), 0.5 * length_m
    return Drum(
        shape=cylinder,
        arc_rad=(-half, half),
        along_m=(-reach, reach),
        **band,  # type: ignore[arg-type]
    )


def tower(
    *, radius_m: float = 1.0, half_deg: float = 150.0, is_concave: bool = False, **band: object
) -> Drum:
    """300 degrees of a round tower that leans by half a degree, or of an apse or column."""
    axis = np.array([0.006, -0.006, 1.0])
    cylinder = Cylinder(
        point_world=np.array([10.0, 20.0, 1.0]),
        axis_world=axis / np.linalg.norm(axis),
        radius_m=radius_m,
        is_concave=is_concave,
    )
    return Drum(
        shape=cylinder,
        arc_rad=(-math.radians(half_deg), math.radians(half_deg)),
        along_m=(-1.0, 1.0),
        **band,  # type: ignore[arg-type]
    )


def spire(*, half_deg: float = 150.0, is_concave: bool = False, **band: object) -> Drum:
    """A leaning spire with a half angle of 15 degrees, without its tip, or a funnel's inside."""
    axis = np.array([0.02, 0.01, 1.0 if is_concave else -1.0])
    cone = Cone(
        apex_world=np.array([10.0, 20.0, 8.0]),
        axis_world=axis / np.linalg.norm(axis),
        half_angle_rad=math.radians(15.0),
        is_concave=is_concave,
    )
    half = math.radians(half_deg)
    return Drum(
        shape=cone,
        arc_rad=(-half, half),
        along_m=(2.5, 4.5),
        **band,  # type: ignore[arg-type]
    )


def dome(*, most_deg: float = 80.0, is_concave: bool = True, **band: object) -> Ball:
    """A dome of 1 m radius, seen from below or from above."""
    sphere = Sphere(centre_world=np.array([10.0, 20.0, 3.0]), radius_m=1.0, is_concave=is_concave)
    return Ball(
        shape=sphere,
        arc_rad=(-math.pi, math.pi),
        along_m=(0.0, math.radians(most_deg)),
        **band,  # type: ignore[arg-type]
    )


def camera(
    drum: Drum,
    arc_deg: float,
    along_m: float,
    away_m: float,
    *,
    width: int = 1200,
    aim_m: float = 0.0,
) -> ViewingCamera:
    """A camera that looks at a place of the surface from a distance, a little tilted."""
    arc_m = np.array([math.radians(arc_deg) * drum.radius_m])
    target = drum.points(arc_m, np.array([along_m + aim_m]))[0]
    foot = drum.points(arc_m, np.array([along_m]))
    centre = foot[0] + away_m * drum.shape.normals(foot)[0]
    axis = drum.axis_world
    up = (
        np.sign(axis @ UP) * axis
        if abs(axis @ UP) > 0.7
        else np.cross(drum.shape.normals(foot)[0], axis)
    )
    turn = np.cos(0.1) * up + np.sin(0.1) * np.cross(up, drum.shape.normals(foot)[0])
    return samples.camera(
        looking_at(centre, target, turn),
        centre,
        width=width,
        height=width * 3 // 4,
        fx=0.8 * width,
        fy=0.8 * width,
        cx=0.505 * width,
        cy=0.37 * width,
        distortion=np.array([-0.08, 0.03, 5e-4, -4e-4, 0.0]),
    )
