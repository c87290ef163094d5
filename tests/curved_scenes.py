"""Textured vaults and towers with a projecting band, known exactly, and photos of them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import Cylinder
from orthoflow.geometry.cameras import ViewingCamera, looking_at
from orthoflow.geometry.surfaces import angles_around, zero_direction
from orthoflow.products import PointCloud, Surface, Surfaces, surface_kind
from tests import samples
from tests.raster_scenes import UP, cell_centres, cloud_of

NO_PLANES = samples.planes(
    normal=np.zeros((0, 3)), offset=np.zeros(0), corners=np.zeros((0, 4, 3)), names=()
)


@dataclass(frozen=True, kw_only=True)
class Drum:
    """A cylinder with a band around it, `band_m` along its axis, that projects by `height_m`."""

    cylinder: Cylinder
    arc_rad: tuple[float, float]
    along_m: tuple[float, float]
    band_m: tuple[float, float] = (0.0, 0.0)
    height_m: float = 0.0

    @property
    def zero_world(self) -> NDArray[np.float64]:
        return zero_direction(self.cylinder.axis_world, UP)

    def surfaces(self) -> Surfaces:
        shape = self.cylinder
        surface = Surface(
            name=f"{surface_kind(shape, UP)} 0",
            shape=shape,
            covariance=np.zeros((7, 7)),
            n_points=1000,
            rms_m=0.001,
            zero_world=self.zero_world,
            along_m=self.along_m,
            arc_rad=self.arc_rad,
        )
        return Surfaces(surfaces=(surface,), up=UP)

    def points(
        self, arc_m: NDArray[np.float64], along_m: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """World points (n, 3) of the surface at lengths of the arc from the zero direction."""
        shape, side = self.cylinder, -1.0 if self.cylinder.is_concave else 1.0
        on_band = (along_m >= self.band_m[0]) & (along_m < self.band_m[1])
        radii_m = shape.radius_m + side * self.height_m * on_band
        angles = arc_m / shape.radius_m
        beside = np.cross(shape.axis_world, self.zero_world)
        outwards = np.outer(np.cos(angles), self.zero_world) + np.outer(np.sin(angles), beside)
        return shape.point_world + np.outer(along_m, shape.axis_world) + radii_m[:, None] * outwards

    def places(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Length of the arc and position along the axis (n, 2) of world points, in metres."""
        shape = self.cylinder
        angles = angles_around(points, shape.point_world, shape.axis_world, self.zero_world)
        middle = sum(self.arc_rad) / 2.0
        angles = middle + (angles - middle + math.pi) % math.tau - math.pi
        along = (points - shape.point_world) @ shape.axis_world
        return np.column_stack([shape.radius_m * angles, along])

    def cloud(self, step_m: float) -> PointCloud:
        """Points with the texture as intensity and colour."""
        arc = np.array(self.arc_rad) * self.cylinder.radius_m
        arcs, alongs = np.meshgrid(np.arange(*arc, step_m), np.arange(*self.along_m, step_m))
        places = np.column_stack([arcs.ravel(), alongs.ravel()])
        places += np.random.default_rng(3).uniform(-0.3, 0.3, places.shape) * step_m
        inside = (places[:, 0] >= arc[0]) & (places[:, 1] >= self.along_m[0])
        places = places[inside]
        grey = texture(places)
        rgb = np.repeat(np.rint(255.0 * grey)[:, None], 3, axis=1).astype(np.uint8)
        return cloud_of(self.points(*places.T), rgb=rgb, intensity=grey.astype(np.float32))

    def met(self, start: NDArray[np.float64], rays: NDArray[np.float64]) -> NDArray[np.float64]:
        """Distances (n,), in lengths of the rays (n, 3), at which they first meet the surface."""
        shape = self.cylinder
        relative = start - shape.point_world
        first, slope = relative @ shape.axis_world, rays @ shape.axis_world
        across = relative - np.outer(first, shape.axis_world)
        beside = rays - np.outer(slope, shape.axis_world)
        a = (beside**2).sum(axis=1)
        b = (across * beside).sum(axis=1)
        side = -1.0 if shape.is_concave else 1.0
        arc = np.array(self.arc_rad) * shape.radius_m
        best = np.full(len(rays), np.inf)

        def keep(t: NDArray[np.float64], *, is_band: bool | None) -> None:
            ahead = np.flatnonzero((t > 1e-6) & (t < best))
            places = self.places(start[ahead] + t[ahead, None] * rays[ahead])
            good = (places >= [arc[0], self.along_m[0]]) & (places <= [arc[1], self.along_m[1]])
            on_band = (places[:, 1] >= self.band_m[0]) & (places[:, 1] < self.band_m[1])
            if is_band is not None and self.height_m:
                good &= (on_band == is_band)[:, None]
            best[ahead[good.all(axis=1)]] = t[ahead[good.all(axis=1)]]

        with np.errstate(invalid="ignore", divide="ignore"):
            for is_band in (False, True):
                radius_m = shape.radius_m + side * self.height_m * is_band
                root = np.sqrt(b * b - a * ((across**2).sum(axis=1) - radius_m**2))
                keep((-b - root) / a, is_band=is_band)
                keep((-b + root) / a, is_band=is_band)
            for edge_m in self.band_m if self.height_m else ():
                t = (edge_m - first) / slope
                radii = np.linalg.norm(across + t[:, None] * beside, axis=1)
                depth = side * (radii - shape.radius_m)
                keep(np.where((depth > 0.0) & (depth < self.height_m), t, np.nan), is_band=None)
        return best

    def rendered(self, camera: ViewingCamera) -> NDArray[np.uint8]:
        """What a camera sees (height, width, 3), 0 beside the surface."""
        rays = camera.rays_world(np.column_stack(cell_centres((camera.height, camera.width))))
        start = np.broadcast_to(camera.centre_world, rays.shape)
        t = self.met(start, rays)
        grey, seen = np.zeros(len(t)), np.isfinite(t)
        grey[seen] = texture(self.places(start[seen] + t[seen, None] * rays[seen]))
        image = np.rint(255.0 * grey).astype(np.uint8).reshape(camera.height, camera.width)
        return np.repeat(image[..., None], 3, axis=2)


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
        cylinder=cylinder,
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
        cylinder=cylinder,
        arc_rad=(-math.radians(half_deg), math.radians(half_deg)),
        along_m=(-1.0, 1.0),
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
    arc_m = np.array([math.radians(arc_deg) * drum.cylinder.radius_m])
    target = drum.points(arc_m, np.array([along_m + aim_m]))[0]
    foot = drum.points(arc_m, np.array([along_m]))
    centre = foot[0] + away_m * drum.cylinder.normals(foot)[0]
    axis = drum.cylinder.axis_world
    up = axis if abs(axis @ UP) > 0.7 else np.cross(drum.cylinder.normals(foot)[0], axis)
    turn = np.cos(0.1) * up + np.sin(0.1) * np.cross(up, drum.cylinder.normals(foot)[0])
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
