"""A corner of a room as a cloud: the wall x = 0, seen from x > 0, and the floor z = 0."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from orthoflow.products import Planes, PointCloud
from tests import samples

ORIGIN: Final = np.array([500_000.0, 4_000_000.0, 100.0])
NORMALS: Final = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def corner(n_side: int, first_m: float, *, deviation_m: float = 0.0, **more: Any) -> PointCloud:
    """Grids from `first_m` to 2 m, before their planes, of two scans that take turns."""
    a, b = (axis.ravel() for axis in np.meshgrid(*[np.linspace(first_m, 2.0, n_side)] * 2))
    flat = np.full(len(a), deviation_m)
    offsets = np.vstack([np.column_stack([flat, a, b]), np.column_stack([a, b, flat])])
    x, y, z = (np.ascontiguousarray(axis) for axis in offsets.T.astype(np.float32))
    scan = (np.arange(len(offsets)) % 2).astype(np.uint16)
    plain: dict[str, Any] = {"scan": scan, "up": np.array([0.0, 0.0, 1.0])}
    return PointCloud(origin=ORIGIN, x=x, y=y, z=z, **(plain | more))


def planes(sign: float = 1.0) -> Planes:
    wall = np.array([[0.0, 0.0, 2.0], [0.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 2.0, 2.0]])
    return samples.planes(
        normal=sign * NORMALS,
        offset=sign * (NORMALS @ ORIGIN),
        corners=ORIGIN + np.array([wall, wall[:, [2, 1, 0]]]),
        n_points=np.array([1, 1]),
        names=("wall 0", "floor"),
    )
