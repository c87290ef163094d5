"""Simulated scenes that consist of textured rectangles.

Rectangles can be bent to parts of cylinders, cones and spheres, so that vaults, towers, spires and
domes consist of few rectangles.

Random numbers are functions of a lattice cell, a seed and an index (`draw`), so they do not depend
on the order of computation or the number of threads. The formulas are those of `scene_rays`,
applied to arrays.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import GeometryError

N_TEXTURE_PARAMS = 8


class SurfaceRole(IntEnum):
    """Role of a rectangle in a room."""

    WALL = 0
    RELIEF = 1
    RECESS = 2
    OBJECT = 3


class TextureKind(IntEnum):
    """Pattern of a rectangle; its parameters are in `texture_params`.

    A pattern is a function of the position (a, b) in the rectangle, so it can be evaluated exactly
    at any position. Its 8 parameters are red, green, blue (0..255), laser reflectance (0..1),
    contrast (0..1), period in metres, seed and spectral gap. The gap is 0 if the laser measures the
    visible pattern, and 1 if it measures a different one.

    Attributes:
        PLAIN: a single colour with smooth stains.
        FRESCO: stains, rosettes that all differ, and painted lines.
        TEXTILE: a motif that is repeated exactly.
        TILES: chequered, stained tiles with joints.
        WOOD: wood grain along b.
    """

    PLAIN = 0
    FRESCO = 1
    TEXTILE = 2
    TILES = 3
    WOOD = 4


# Fields of a scene that have one row per rectangle.
_PER_RECTANGLE: Final = "centre axis_a axis_b extent plane_index role texture texture_params"


@dataclass(frozen=True, kw_only=True)
class Scene:
    """Rectangles with holes and procedural textures.

    Attributes:
        origin: (3,) float64 metres, world coordinates; all positions in the scene are relative to
            it, so a different origin of the world changes only this field.
        centre: (r, 3) float64 position of a = b = 0, in metres from `origin`, world axes.
        axis_a: (r, 3) float64 unit vector in the rectangle, world axes.
        axis_b: (r, 3) float64 unit vector in the rectangle perpendicular to `axis_a`, world axes.
        extent: (r, 4) float64 a_min, a_max, b_min and b_max, in metres from the centre.
        plane_index: (r,) int16 index of the rectangle's true plane; -1 if it belongs to none.
        role: (r,) uint8 `SurfaceRole`.
        texture: (r,) int32 `TextureKind`.
        texture_params: (r, 8) float64 (see `TextureKind`).
        hole_rectangle: (h,) int32 index of the rectangle that contains the hole, ascending.
        hole_extent: (h, 4) float64 metres, as in `extent`; the edge of a hole belongs to the
            rectangle.
        curvature_per_m: (r,) float64 reciprocal radii, in 1 / metre, of rectangles that are bent
            about an axis parallel to `axis_b` without being stretched, so that a is an arc length.
            The curvature is positive if a rectangle is bent towards its normal, and 0 if it is
            flat. None if all rectangles are flat.
        taper_per_m: (r,) float64, in 1 / metre, of rectangles that are bent to parts of cones.
            Lines along `axis_b` meet at b = -1 / taper. Along them, b is a length, and a is an arc
            length at b = 0, which is 1 + b taper times as long at b. The taper is 0 for cylinders
            and flat rectangles, and infinite for parts of spheres, whose meridians meet at b = 0:
            there, b is the length along a meridian, and a the angle about the normal, from
            `axis_a` to `axis_b`, divided by the curvature's absolute value. None if no rectangle
            is part of a cone or sphere.
    """

    origin: NDArray[np.float64]
    centre: NDArray[np.float64]
    axis_a: NDArray[np.float64]
    axis_b: NDArray[np.float64]
    extent: NDArray[np.float64]
    plane_index: NDArray[np.int16]
    role: NDArray[np.uint8]
    texture: NDArray[np.int32]
    texture_params: NDArray[np.float64]
    hole_rectangle: NDArray[np.int32]
    hole_extent: NDArray[np.float64]
    curvature_per_m: NDArray[np.float64] | None = None
    taper_per_m: NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        count = len(self.centre)
        shapes = {
            "origin": (self.origin.shape, (3,)),
            "centre": (self.centre.shape, (count, 3)),
            "axis_a": (self.axis_a.shape, (count, 3)),
            "axis_b": (self.axis_b.shape, (count, 3)),
            "extent": (self.extent.shape, (count, 4)),
            "plane_index": (self.plane_index.shape, (count,)),
            "role": (self.role.shape, (count,)),
            "texture": (self.texture.shape, (count,)),
            "texture_params": (self.texture_params.shape, (count, N_TEXTURE_PARAMS)),
            "hole_extent": (self.hole_extent.shape, (len(self.hole_rectangle), 4)),
            "curvature_per_m": (self.curvatures_per_m.shape, (count,)),
            "taper_per_m": (self.tapers_per_m.shape, (count,)),
        }
        for name, (shape, expected) in shapes.items():
            if shape != expected:
                raise GeometryError(f"scene.{name} must have shape {expected}, got {shape}")
        if np.any(np.diff(self.hole_rectangle) < 0):
            raise GeometryError("scene.hole_rectangle must be in ascending order")

    def __len__(self) -> int:
        return len(self.centre)

    @property
    def normal(self) -> NDArray[np.float64]:
        """Unit normals (r, 3), axis_a x axis_b, in world axes."""
        return np.cross(self.axis_a, self.axis_b)

    @property
    def curvatures_per_m(self) -> NDArray[np.float64]:
        """Curvatures (r,) in 1 / metre; 0 for flat rectangles."""
        bent = self.curvature_per_m
        return np.zeros(len(self.centre)) if bent is None else bent

    @property
    def tapers_per_m(self) -> NDArray[np.float64]:
        """Tapers (r,) in 1 / metre; 0 for rectangles that are not part of a cone."""
        return np.zeros(len(self.centre)) if self.taper_per_m is None else self.taper_per_m

    def points_m(
        self, rectangle: NDArray[np.int64], a: NDArray[np.float64], b: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the points (n, 3) at (a, b) of rectangles (n,), in metres from `origin`."""
        bent, taper = self.curvatures_per_m[rectangle], self.tapers_per_m[rectangle]
        is_round = np.isinf(taper)
        taper = np.where(is_round, 0.0, taper)
        turn = np.where(bent == 0.0, 1.0, np.hypot(bent, taper))
        radius = (1.0 + taper * b) / turn
        along = np.where(bent == 0.0, a, radius * np.sin(a * turn))
        lifted = np.where(bent == 0.0, 0.0, radius * (1.0 - np.cos(a * turn)))
        upwards = b - lifted * taper / turn
        across = radius * np.sin(b * turn)
        along = np.where(is_round, across * np.cos(a * turn), along)
        upwards = np.where(is_round, across * np.sin(a * turn), upwards)
        lifted = np.where(is_round, radius * (1.0 - np.cos(b * turn)), lifted)
        points = self.centre[rectangle]
        points += upwards[:, None] * self.axis_b[rectangle]
        points += along[:, None] * self.axis_a[rectangle]
        return points + (lifted * bent / turn)[:, None] * self.normal[rectangle]

    def normals_at(
        self, rectangle: NDArray[np.int32], points: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the unit normals (n, 3) of rectangles (n,) at points (3, n) on these.

        Points are in metres from `origin`.
        """
        normals = self.normal[rectangle]
        bent = self.curvatures_per_m[rectangle]
        chosen = np.flatnonzero(bent)
        if len(chosen):
            own = rectangle[chosen]
            offset = points[:, chosen].T - self.centre[own]
            x, y, z = (
                np.einsum("ni,ni->n", offset, axes[own])
                for axes in (self.axis_a, self.axis_b, self.normal)
            )
            bends, tapers = bent[chosen], self.tapers_per_m[own]
            is_round = np.isinf(tapers)
            tapers = np.where(is_round, 0.0, tapers)
            # The width is that of the cone at the foot of a point, relative to b = 0.
            squares = bends**2 + tapers**2
            axial = 1.0 + tapers * y - bends * z
            reach = tapers * (np.sqrt(squares * x * x + axial**2) - 1.0 + bends * z)
            b = np.where(tapers == 0.0, y, (reach + bends**2 * y) / squares)
            b = np.where(is_round, 0.0, b)
            offset -= b[:, None] * self.axis_b[own]
            normals[chosen] -= (bends / (1.0 + tapers * b))[:, None] * offset
        return normals

    def corners_m(self) -> NDArray[np.float64]:
        """Return the corners (r, 4, 3) of the rectangles, in metres, as if all were flat.

        They are relative to `origin`.
        """
        a = self.extent[:, [0, 1, 1, 0], None] * self.axis_a[:, None, :]
        b = self.extent[:, [2, 2, 3, 3], None] * self.axis_b[:, None, :]
        return self.centre[:, None, :] + a + b

    def turned(self, rotation: NDArray[np.float64]) -> Scene:
        """Return the scene rotated about its origin by a matrix (3, 3)."""
        return replace(
            self,
            centre=self.centre @ rotation.T,
            axis_a=self.axis_a @ rotation.T,
            axis_b=self.axis_b @ rotation.T,
        )


@dataclass(frozen=True, kw_only=True)
class Viewers:
    """Positions from which a scene is viewed, in all directions within a range of elevations.

    Attributes:
        positions_world: (s, 3) float64 metres.
        up: (3,) float64 unit vector.
        lowest_elevation_deg: lowest visible elevation; positive above the horizon.
        highest_elevation_deg: highest visible elevation.
    """

    positions_world: NDArray[np.float64]
    up: NDArray[np.float64]
    lowest_elevation_deg: float = -90.0
    highest_elevation_deg: float = 90.0


_WORD: Final = 1 << 64
_GOLDEN: Final = 0x9E3779B97F4A7C15
_COLUMN: Final = np.uint64(0xD1B54A32D192ED03)
_ROW: Final = np.uint64(0x8CB92BA72F3D8DD7)
_FIRST: Final = np.uint64(0xBF58476D1CE4E5B9)
_SECOND: Final = np.uint64(0x94D049BB133111EB)
_TURN: Final = 2.0 * np.pi


def cell_states(
    columns: NDArray[np.int64], rows: NDArray[np.int64], seed: int
) -> NDArray[np.uint64]:
    """Return random 64-bit states of lattice cells; `columns` and `rows` are broadcast."""
    state = mixed_bits(columns.astype(np.uint64) * _COLUMN + np.uint64(seed % _WORD))
    return mixed_bits(state ^ (rows.astype(np.uint64) * _ROW))


def uniforms(states: NDArray[np.uint64], draw: int) -> NDArray[np.float64]:
    """Return a random number in [0, 1) for each state; it also depends on the index `draw`."""
    bits = mixed_bits(states + np.uint64((draw + 1) * _GOLDEN % _WORD))
    bits >>= np.uint64(11)
    return np.multiply(bits, 1.0 / 9007199254740992.0, dtype=np.float64)


def normals(states: NDArray[np.uint64], draw: int) -> NDArray[np.float64]:
    """Return a standard normal number for each state (Box and Muller); `draw` must be even."""
    lengths = np.sqrt(-2.0 * np.log1p(-uniforms(states, draw)))
    return np.asarray(lengths * np.cos(_TURN * uniforms(states, draw + 1)), dtype=np.float64)


def mixed_bits(values: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Scramble 64 bits (splitmix64's finaliser); neighbouring inputs give unrelated outputs."""
    bits = values ^ (values >> np.uint64(30))
    bits *= _FIRST
    bits ^= bits >> np.uint64(27)
    bits *= _SECOND
    bits ^= bits >> np.uint64(31)
    return bits
