"""Check points of the room: painted crossings and corners of mouldings that a surveyor can name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.scenes import Scene, SurfaceRole, TextureKind
from orthoflow.products import CheckPoints

if TYPE_CHECKING:
    from orthoflow.geometry.scene_views import SceneCameras

_FLAT: Final = "flat"
_VERTICAL_EDGE: Final = "vertical edge"
# The lattice of painted lines of a fresco, in periods (see `texture_kernels`).
_LATTICE: Final = 0.9
_CLEAR_M: Final = 0.04
# Number of its plane in `scene.plane_index`: it is built first.
_MAIN_WALL: Final = 0
_INSIDE_M: Final = 0.004
_LIFT_M: Final = 0.01


@dataclass(frozen=True, kw_only=True)
class _Spots:
    """Places on rectangles: rectangle (n,), and (a, b) metres (n, 2) on it."""

    rectangle: NDArray[np.int64]
    in_rectangle: NDArray[np.float64]

    def moved(self, step: NDArray[np.float64]) -> _Spots:
        """Move all places by (2,) or each by (n, 2)."""
        return _Spots(rectangle=self.rectangle, in_rectangle=self.in_rectangle + step)

    def points(self, scene: Scene) -> NDArray[np.float64]:
        """Points (n, 3) from the scene's origin."""
        chosen = self.rectangle
        points: NDArray[np.float64] = (
            scene.centre[chosen]
            + self.in_rectangle[:, :1] * scene.axis_a[chosen]
            + self.in_rectangle[:, 1:] * scene.axis_b[chosen]
        )
        return points


def check_points(
    scene: Scene,
    views: SceneCameras,
    stations: NDArray[np.float64],
    world_from_room: NDArray[np.float64],
    shift_world_m: NDArray[np.float64],
    *,
    n_most: int,
) -> CheckPoints:
    """Choose check points of each class on the main wall.

    `flat` ones are crossings of the painted lines of a fresco, with 4 cm of bare wall around;
    `vertical edge` ones are front corners of mouldings. A station sees each of them.

    Args:
        scene: the room, in its own frame.
        views: the same, laid out for looking at it.
        stations: (s, 3) metres, room frame.
        world_from_room: (3, 3) rotation.
        shift_world_m: (3,) world position of the room's origin.
        n_most: so many of each class, or what there are.
    """
    chosen = {
        _FLAT: _spread(_crossings(scene, views, stations), n_most),
        _VERTICAL_EDGE: _spread(_corners(scene, views, stations), n_most),
    }
    points = np.concatenate(list(chosen.values())) @ world_from_room.T + shift_world_m
    names = [
        f"{kind[0].upper()}{i:02d}" for kind, found in chosen.items() for i in range(len(found))
    ]
    return CheckPoints(
        names=tuple(names),
        points_world=points,
        classes=tuple(kind for kind, found in chosen.items() for _ in found),
        wall=np.full(len(points), -1, dtype=np.int32),
        pixels_wall=np.full((len(points), 2), np.nan),
    )


def _crossings(
    scene: Scene, views: SceneCameras, stations: NDArray[np.float64]
) -> NDArray[np.float64]:
    frescos = (scene.plane_index == _MAIN_WALL) & (scene.texture == TextureKind.FRESCO)
    spots = _joined([_lattice(scene, int(index)) for index in np.flatnonzero(frescos)])
    clear = np.ones(len(spots.rectangle), dtype=np.bool_)
    for right in (-_CLEAR_M, 0.0, _CLEAR_M):
        for up in (-_CLEAR_M, 0.0, _CLEAR_M):
            clear &= _are_seen(scene, views, spots.moved(np.array([right, up])), stations)
    return spots.points(scene)[clear]


def _lattice(scene: Scene, index: int) -> _Spots:
    """Crossings of the painted lines of a fresco."""
    step = _LATTICE * scene.texture_params[index, 5]
    a0, a1, b0, b1 = scene.extent[index] / step
    a, b = np.meshgrid(np.arange(np.ceil(a0), a1), np.arange(np.ceil(b0), b1))
    places = step * np.column_stack([a.ravel(), b.ravel()])
    return _Spots(rectangle=np.full(len(places), index), in_rectangle=places)


def _corners(
    scene: Scene, views: SceneCameras, stations: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Front corners of mouldings parallel to the plane."""
    walls = np.flatnonzero((scene.plane_index == _MAIN_WALL) & (scene.role == SurfaceRole.WALL))
    normal, foot = scene.normal[walls[0]], scene.centre[walls[0]]
    heights = (scene.centre - foot) @ normal
    fronts = np.flatnonzero(
        (scene.role == SurfaceRole.RELIEF)
        & (np.abs(scene.normal @ normal) > 1.0 - 1e-9)
        & (np.abs(heights) < 0.5)
    )
    inwards = np.tile([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]], (len(fronts), 1))
    spots = _Spots(
        rectangle=np.repeat(fronts, 4),
        in_rectangle=scene.extent[fronts][:, [[0, 2], [0, 3], [1, 2], [1, 3]]].reshape(-1, 2),
    )
    seen = _are_seen(scene, views, spots.moved(_INSIDE_M * inwards), stations)
    # Where bars meet, their common corner lies in the middle of a face and shows no edge.
    beside = spots.moved(_INSIDE_M * inwards * np.array([-1.0, 1.0]))
    return spots.points(scene)[seen & ~_are_level(scene, views, beside)]


def _joined(parts: Sequence[_Spots]) -> _Spots:
    return _Spots(
        rectangle=np.concatenate([part.rectangle for part in parts]),
        in_rectangle=np.concatenate([part.in_rectangle for part in parts]),
    )


def _are_seen(
    scene: Scene, views: SceneCameras, spots: _Spots, stations: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Which places (n,) any station sees."""
    points = spots.points(scene)
    seen = np.zeros(len(points), dtype=np.bool_)
    for station in stations:
        hits = views.cast(station, points - station)
        seen |= (hits.rectangle == spots.rectangle) & (np.abs(hits.t - 1.0) < 1e-6)
    return seen


def _are_level(scene: Scene, views: SceneCameras, spots: _Spots) -> NDArray[np.bool_]:
    """Which places (n,) have a surface at their own height, whatever rectangle it belongs to."""
    points, normals = spots.points(scene), scene.normal[spots.rectangle]
    inwards = np.where(np.einsum("ij,ij->i", normals, points) > 0.0, -1.0, 1.0)[:, None] * normals
    hits = views.cast(points + _LIFT_M * inwards, -inwards)
    level: NDArray[np.bool_] = np.abs(hits.t - _LIFT_M) < 1e-4
    return level


def _spread(points: NDArray[np.float64], n_most: int) -> NDArray[np.float64]:
    """Points that lie far from each other: each next one is the farthest from all."""
    if len(points) <= n_most:
        return points
    chosen = [0]
    nearest = np.linalg.norm(points - points[0], axis=1)
    while len(chosen) < n_most:
        chosen.append(int(np.argmax(nearest)))
        nearest = np.minimum(nearest, np.linalg.norm(points - points[chosen[-1]], axis=1))
    spread: NDArray[np.float64] = points[np.sort(chosen)]
    return spread
