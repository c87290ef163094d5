"""Laying a scene out for ray casting: a tree of boxes that spares rays most rectangles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.scene_kernels import CastTable
from orthoflow.geometry.scenes import Scene


def cast_table(scene: Scene) -> CastTable:
    """Lay a scene out for ray casting, with its tree of bounding boxes."""
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
    """Bounding boxes over rectangles, split where rays have the least to do.

    The boxes lie along the axes of that rectangle which makes them smallest: in a room most others
    are parallel or square to it, and their boxes are as thin as they are.
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
        # A micrometre of slack: a rectangle along the axes must not have an empty box.
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
        """Choose the members of the first child; None when a leaf is cheaper.

        The cost of a child is its number of rectangles times the surface of its box, which is how
        often rays come by (Goldsmith and Salmon 1987); visiting a node costs about one rectangle.
        """
        low, high = self._low[members], self._high[members]
        whole = _surface_m2(high.max(axis=0) - low.min(axis=0))
        best_cost, best = len(members) * whole, None
        for axis in range(3):
            order = np.argsort(low[:, axis] + high[:, axis], kind="stable")
            heads = _running_surfaces(low[order], high[order])[:-1]
            tails = _running_surfaces(low[order[::-1]], high[order[::-1]])[:-1][::-1]
            counts = np.arange(1, len(members))
            costs = whole + counts * heads + (len(members) - counts) * tails
            if len(costs) and costs.min() < best_cost:
                best_cost = float(costs.min())
                best = np.zeros(len(members), dtype=np.bool_)
                best[order[: int(np.argmin(costs)) + 1]] = True
        return best


def _surface_m2(sides: NDArray[np.float64]) -> float:
    return float(sides[0] * sides[1] + sides[1] * sides[2] + sides[2] * sides[0])


def _running_surfaces(low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.float64]:
    """Surface of the box round the first 1, 2, ... members."""
    x, y, z = (np.maximum.accumulate(high) - np.minimum.accumulate(low)).T
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
