"""Ray casting in a simulated scene: which surface a ray meets, and its colour there.

Import this module where it is used: it loads compiled kernels.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.scene_kernels import CastTable, cast_rays
from orthoflow.geometry.scenes import Scene, SurfaceRole
from orthoflow.geometry.texture_kernels import PaintTable, paint_points

# Rays per batch, so that arrays of one number per ray stay in the processor's cache.
RAYS_AT_ONCE: Final = 1 << 14


@dataclass(frozen=True, kw_only=True)
class Hits:
    """Where rays first meet a scene.

    Attributes:
        t: (n,) float64 distance in units of the ray's direction, inf without a hit.
        rectangle: (n,) int32 row of the scene, -1 without a hit.
    """

    t: NDArray[np.float64]
    rectangle: NDArray[np.int32]


class SceneRays:
    """A scene prepared once for many rays.

    Starts and points are metres from the scene's origin. Arrays hold one row per coordinate,
    (3, n): numpy works on such rows several times as fast as on one row per point.

    Args:
        scene: the scene.
    """

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._table = _cast_table(scene)
        self._paint = PaintTable(
            frames=np.ascontiguousarray(np.hstack([scene.centre, scene.axis_a, scene.axis_b])),
            kinds=np.array(scene.texture),
            params=np.array(scene.texture_params),
        )

    @cached_property
    def objects(self) -> SceneRays:
        """Return the free-standing objects alone; rectangles are numbered among them."""
        return SceneRays(self._scene.only(self._scene.role == SurfaceRole.OBJECT))

    def cast(
        self,
        starts: NDArray[np.float64],
        ways: NDArray[np.float64],
        *,
        within: NDArray[np.float64] | float = np.inf,
    ) -> Hits:
        """Find the first hit of rays.

        Args:
            starts: (3, n), or (3, 1) for all.
            ways: (3, n) directions of any length, the unit of distances.
            within: (n,) or one maximum distance.
        """
        n_rays = ways.shape[1]
        t = np.empty(n_rays)
        t[:] = within
        rectangle = np.empty(n_rays, dtype=np.int32)
        cast_rays(
            self._table,
            np.ascontiguousarray(starts, dtype=np.float64),
            np.ascontiguousarray(ways, dtype=np.float64),
            t,
            rectangle,
        )
        t[rectangle < 0] = np.inf
        return Hits(t=t, rectangle=rectangle)

    def colours(
        self, rectangle: NDArray[np.int32], points: NDArray[np.float64]
    ) -> NDArray[np.float32]:
        """Red, green, blue 0..255 and reflectance 0..1 (4, n) of points; 0 on rectangle -1."""
        painted = np.zeros((4, len(rectangle)), dtype=np.float32)
        paint_points(
            self._paint,
            np.ascontiguousarray(rectangle, dtype=np.int32),
            np.ascontiguousarray(points, dtype=np.float64),
            painted,
        )
        return painted


def points_on(
    starts: NDArray[np.float64], ways: NDArray[np.float64], hits: Hits
) -> NDArray[np.float64]:
    """Return the points (3, n) that rays meet; the start of rays without a hit."""
    return starts + np.where(hits.rectangle < 0, 0.0, hits.t) * ways


def _cast_table(scene: Scene) -> CastTable:
    """Prepare a scene for ray casting, with its tree of bounding boxes."""
    tree = _BoxTree(scene)
    holes = np.searchsorted(scene.hole_rectangle, np.arange(len(scene) + 1))
    turned = scene.turned(tree.axes)
    return CastTable(
        axes=np.ascontiguousarray(tree.axes),
        rectangles=np.column_stack(
            [
                turned.centre,
                turned.axis_a,
                turned.axis_b,
                turned.normal,
                turned.extent,
                holes[:-1],
                holes[1:],
            ]
        ),
        holes=np.array(scene.hole_extent),
        nodes=np.column_stack(
            [np.array(tree.boxes).reshape(-1, 6), np.array(tree.links).reshape(-1, 3)]
        ).astype(np.float64),
        order=np.array(tree.order, dtype=np.int64),
    )


class _BoxTree:
    """Bounding boxes over rectangles, split where the cost of rays is lowest.

    The boxes are aligned with the rectangle that makes them smallest: in a room most others are
    parallel or perpendicular to it, and their boxes are thin.
    """

    def __init__(self, scene: Scene) -> None:
        self.boxes: list[list[float]] = []
        self.links: list[tuple[int, int, int]] = []
        self.order: list[int] = []
        self.axes = np.eye(3)
        if len(scene) == 0:
            return
        self.axes = _tightest_axes(scene)
        corners = scene.corners_m() @ self.axes.T
        # A tolerance of a micrometre: a rectangle along the axes must not have an empty box.
        self._low = corners.min(axis=1) - 1e-6
        self._high = corners.max(axis=1) + 1e-6
        self._add(np.arange(len(scene)))

    def _add(self, members: NDArray[np.int64]) -> None:
        node, first = len(self.boxes), len(self.order)
        low, high = self._low[members], self._high[members]
        self.boxes.append([*low.min(axis=0), *high.max(axis=0)])
        self.links.append((0, first, first))
        first_half = self._cheapest_half(members)
        if first_half is None:
            self.order.extend(int(member) for member in members)
            self.links[node] = (len(self.boxes), first, len(self.order))
            return
        self._add(members[first_half])
        self._add(members[~first_half])
        self.links[node] = (len(self.boxes), first, first)

    def _cheapest_half(self, members: NDArray[np.int64]) -> NDArray[np.bool_] | None:
        """Choose the members of the first child; None if a leaf is cheaper.

        The cost of a child is its number of rectangles times the surface of its box, which is
        proportional to the probability of a hit (Goldsmith and Salmon 1987); visiting a node costs
        about one rectangle.
        """
        if len(members) == 1:
            return None
        low, high = self._low[members], self._high[members]
        whole = _surface_m2(high.max(axis=0) - low.min(axis=0))
        # Along all three axes at once, (n, axis): most nodes have few members.
        order = np.argsort(low + high, axis=0, kind="stable")
        heads = _running_surfaces(low[order], high[order])[:-1]
        tails = _running_surfaces(low[order[::-1]], high[order[::-1]])[:-1][::-1]
        counts = np.arange(1, len(members))[:, np.newaxis]
        costs = whole + counts * heads + (len(members) - counts) * tails
        last, axis = np.argmin(costs, axis=0), int(np.argmin(costs.min(axis=0)))
        if costs[last[axis], axis] >= len(members) * whole:
            return None
        best = np.zeros(len(members), dtype=np.bool_)
        best[order[: last[axis] + 1, axis]] = True
        return best


def _surface_m2(sides: NDArray[np.float64]) -> float:
    return float(sides[0] * sides[1] + sides[1] * sides[2] + sides[2] * sides[0])


def _running_surfaces(low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return surfaces (n, k) of boxes around the first 1, 2, ... members of k orders (n, k, 3)."""
    sides = np.maximum.accumulate(high) - np.minimum.accumulate(low)
    x, y, z = sides[..., 0], sides[..., 1], sides[..., 2]
    surfaces: NDArray[np.float64] = x * y + y * z + z * x
    return surfaces


def _tightest_axes(scene: Scene) -> NDArray[np.float64]:
    corners = scene.corners_m()
    axes = np.stack([scene.axis_a, scene.axis_b, scene.normal], axis=1)
    # Many rectangles share their axes; each set is tried once.
    _, first = np.unique(axes.reshape(-1, 9).round(9), axis=0, return_index=True)
    axes = axes[np.sort(first)]
    surfaces = []
    for candidate in axes:
        x, y, z = np.ptp(corners @ candidate.T, axis=1).T
        surfaces.append(float(np.sum(x * y + y * z + z * x)))
    chosen: NDArray[np.float64] = axes[int(np.argmin(surfaces))]
    return chosen
