"""Random planes through a few points of a sample, points near each other more often than not.

Three points drawn from all of a room are on one small wall once in a million draws. The sample is
put along a space-filling curve, and the points of a hypothesis come from one stretch of it, of a
length that is drawn too: short stretches find small planes, long ones fix large planes well.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

Model = Literal["3d", "2d"]

# Stretches hold at least so many points, and each length is half of the one before.
_STRETCH_LEAST: Final = 32
# Triangles flatter than this (height over longest side) fix no plane.
_FLATTEST: Final = 0.02
_CURVE_BITS: Final = 10
# Bits of a number spread to every third place, step by step.
_SPREADS: Final = ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249))


@dataclass(frozen=True, kw_only=True)
class Hypotheses:
    """Planes in the frame of the points they were drawn from.

    Attributes:
        normals: (h, 3) unit vectors.
        offsets_m: (h,) normal times point.
    """

    normals: NDArray[np.float64]
    offsets_m: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.offsets_m)

    def chosen(self, index: NDArray[np.intp] | NDArray[np.bool_]) -> Hypotheses:
        """Give some of them."""
        return Hypotheses(normals=self.normals[index], offsets_m=self.offsets_m[index])

    def joined(self, others: Hypotheses) -> Hypotheses:
        """Give them and some others."""
        return Hypotheses(
            normals=np.concatenate([self.normals, others.normals]),
            offsets_m=np.concatenate([self.offsets_m, others.offsets_m]),
        )

    def rows(self) -> NDArray[np.float32]:
        """(h, 4) normal and offset, as the compiled scoring takes them."""
        return np.column_stack([self.normals, self.offsets_m]).astype(np.float32)


def curve_order(points_m: NDArray[np.float64]) -> NDArray[np.intp]:
    """Order points (m, 3) along a Morton curve, so that neighbours on it are near each other."""
    low, high = np.quantile(points_m, (0.01, 0.99), axis=0)
    scale = (2**_CURVE_BITS - 1) / max(float((high - low).max()), 1e-9)
    cells = np.clip((points_m - low) * scale, 0, 2**_CURVE_BITS - 1).astype(np.uint32)
    key = np.zeros(len(points_m), dtype=np.uint32)
    for axis in range(3):
        bits = cells[:, axis]
        for shift, mask in _SPREADS:
            bits = (bits | (bits << np.uint32(shift))) & np.uint32(mask)
        key |= bits << np.uint32(axis)
    return np.argsort(key, kind="stable")


def draw_hypotheses(
    points_m: NDArray[np.float64],
    count: int,
    model: Model,
    up: NDArray[np.float64],
    rng: np.random.Generator,
) -> Hypotheses:
    """Draw planes through points.

    Args:
        points_m: (m, 3) in curve order.
        count: how many are drawn; those that fix no plane are left out.
        model: `3d` through three points, `2d` upright through two.
        up: (3,) unit vector.
        rng: source of chance.
    """
    n_points = len(points_m)
    n_lengths = max(1, int(np.log2(max(1.0, n_points / _STRETCH_LEAST))) + 1)
    stretch = np.ceil(n_points / 2.0 ** rng.integers(0, n_lengths, count)).astype(np.int64)
    first = (rng.random(count) * (n_points - stretch + 1)).astype(np.int64)
    n_corners = 3 if model == "3d" else 2
    chosen = first[:, None] + (rng.random((count, n_corners)) * stretch[:, None]).astype(np.int64)
    corners = points_m[chosen]
    a = corners[:, 1] - corners[:, 0]
    b = corners[:, 2] - corners[:, 0] if model == "3d" else np.broadcast_to(up, a.shape)
    normals = np.cross(a, b)
    lengths = np.linalg.norm(normals, axis=1)
    longest = np.maximum(np.linalg.norm(a, axis=1), np.linalg.norm(b, axis=1))
    fixed = lengths > (_FLATTEST * longest**2 if model == "3d" else 1e-6)
    normals = normals[fixed] / lengths[fixed, None]
    return Hypotheses(
        normals=normals, offsets_m=np.einsum("ij,ij->i", normals, corners[fixed].mean(axis=1))
    )
