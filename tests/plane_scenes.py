"""Clouds of rectangles with known planes, for the tests of plane detection."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from orthoflow_plugins.plane.cloud import PreparedCloud, prepare
from orthoflow_plugins.plane.proposing import DetectorParams
from orthoflow_plugins.plane.search import Search

from orthoflow.geometry import angle_between_deg
from orthoflow.products import Planes, PointCloud
from orthoflow.sdk import Method, StepContext
from tests.method_runs import run

NOISE_M = 0.002
TOLERANCE_M, FIT_TOLERANCE_M = 0.05, 0.015


@dataclass(frozen=True)
class Rectangle:
    """A true surface: centre, two half axes (metres), how many points."""

    name: str
    centre: tuple[float, float, float]
    half_a: tuple[float, float, float]
    half_b: tuple[float, float, float]
    n_points: int

    @property
    def normal(self) -> NDArray[np.float64]:
        normal = np.cross(self.half_a, self.half_b)
        return normal / np.linalg.norm(normal)

    def points(self, rng: np.random.Generator, noise_m: float) -> NDArray[np.float64]:
        spread = rng.uniform(-1.0, 1.0, (self.n_points, 2))
        flat = np.array(self.centre) + spread @ np.array([self.half_a, self.half_b])
        return flat + rng.normal(0.0, noise_m, (self.n_points, 1)) * self.normal


STATION = np.array([[0.3, -0.2, 0.1]])
# A room of 6 x 4 x 3 m; the front wall (y = 2) leans by 0.4 degrees and is the densest.
LEAN = np.radians(0.4)
ROOM = (
    Rectangle("front", (0, 2, 0), (3, 0, 0), (0, 1.5 * np.sin(LEAN), 1.5 * np.cos(LEAN)), 30_000),
    Rectangle("back", (0, -2, 0), (3, 0, 0), (0, 0, 1.5), 9_000),
    Rectangle("left", (-3, 0, 0), (0, 2, 0), (0, 0, 1.5), 8_000),
    Rectangle("right", (3, 0, 0), (0, 2, 0), (0, 0, 1.5), 7_000),
    Rectangle("floor", (0, 0, -1.5), (3, 0, 0), (0, 2, 0), 16_000),
    Rectangle("ceiling", (0, 0, 1.5), (3, 0, 0), (0, 2, 0), 15_000),
    Rectangle("table", (1, -0.5, -0.75), (0.8, 0, 0), (0, 0.5, 0), 2_500),
)


def turned(angle_deg: float) -> NDArray[np.float64]:
    """Rotation (3, 3) about z."""
    cosine, sine = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    return np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1.0]])


def sampled(
    rectangles: tuple[Rectangle, ...] = ROOM, *, seed: int = 1, noise_m: float = NOISE_M
) -> NDArray[np.float64]:
    """Points (n, 3) of rectangles, one after the other."""
    rng = np.random.default_rng(seed)
    return np.concatenate([rectangle.points(rng, noise_m) for rectangle in rectangles])


def cloud_of(
    points: NDArray[np.float64],
    *,
    up: tuple[float, float, float] = (0.0, 0.0, 1.0),
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0),
    stations: NDArray[np.float64] | None = None,
    source: str | None = "file",
) -> PointCloud:
    """A cloud of points given relative to its origin; read-only, as methods get them."""
    offsets = points.astype(np.float32)
    columns = [np.ascontiguousarray(offsets[:, axis]) for axis in range(3)]
    for column in columns:
        column.flags.writeable = False
    return PointCloud(
        origin=np.array(origin),
        x=columns[0],
        y=columns[1],
        z=columns[2],
        up=np.array(up),
        stations=None if stations is None else stations + np.array(origin),
        stations_source=None if stations is None else source,
    )


def detect(
    method: type[Method],
    cloud: PointCloud,
    folder: Path,
    *,
    seed: int = 0,
    cores: int = 1,
    **params: Any,
) -> tuple[Any, StepContext]:
    """What a detector finds in a cloud, and the context that it reported to."""
    folder.mkdir(parents=True, exist_ok=True)
    ctx = StepContext(rng=np.random.default_rng(seed), cores=cores, scratch=folder)
    return run(method, ctx, {"cloud": cloud}, **params), ctx


def nearest(planes: Planes, normal: NDArray[np.float64], centre: NDArray[np.float64]) -> int:
    """The plane that passes nearest to a true one's centre among those with its direction."""
    parallel = np.abs(planes.normal @ normal) > np.cos(np.radians(1.0))
    return int(np.argmin(np.abs(planes.normal @ centre - planes.offset) + 1e6 * ~parallel))


def errors(planes: Planes, truth: Rectangle) -> tuple[float, float]:
    """Angle in degrees and offset at the true centre in metres, of the plane nearest to it."""
    normal, centre = truth.normal, np.array(truth.centre)
    found = planes.plane(nearest(planes, normal, centre))
    angle = angle_between_deg(found.normal, normal)
    return min(angle, 180.0 - angle), abs(float(found.distances_m(centre[None])[0]))


def expect(
    planes: Planes, truths: Iterable[Rectangle], angle_deg: float, miss_m: float = 3e-4
) -> None:
    """Assert that the errors of the planes nearest to true ones are below limits."""
    for truth in truths:
        found = errors(planes, truth)
        assert found[0] < angle_deg, truth.name
        assert found[1] < miss_m, truth.name


def prepared(points: NDArray[np.float64], *, parts: int = 1) -> PreparedCloud:
    """A cloud of points (n, 3) as the passes take it."""
    return prepare(cloud_of(points), TOLERANCE_M, FIT_TOLERANCE_M, parts=parts)


def search_in(cloud: PreparedCloud, **params: object) -> Search:
    """A search in a cloud that has taken nothing yet."""
    return Search(
        cloud=cloud,
        params=DetectorParams.model_validate({"min_share": 0.1, "n_planes_max": 10, **params}),
    )
