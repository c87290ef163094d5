"""A room of four walls and a ceiling with smooth colours, exactly known, seen by any lens."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import WallFrame, wall_axes
from orthoflow.products import Walls
from tests import samples
from tests.raster_scenes import UP

NORMALS = np.array([[0, -1, 0], [1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, 0, -1]], dtype=np.float64)
# Metres per period of the colours across and down; red and green differ in them.
_PERIODS_M = np.array([[0.31, 0.23], [0.19, 0.37], [0.27, 0.29]])


@dataclass(frozen=True, kw_only=True)
class BoxRoom:
    """A room `size_m` (x, y, z) large, whose floor has its middle at `middle`.

    Attributes:
        size_m: its sides.
        middle: (3,) metres.
        gsd_m: cells of its walls' rasters.
    """

    size_m: tuple[float, float, float]
    middle: NDArray[np.float64]
    gsd_m: float

    @cached_property
    def frames(self) -> tuple[WallFrame, ...]:
        """Frames of the walls, north (which looks to -y) first, and of the ceiling."""
        return tuple(self._frame(normal) for normal in NORMALS)

    def _frame(self, normal: NDArray[np.float64]) -> WallFrame:
        half = 0.5 * np.array(self.size_m)
        u, v = wall_axes(normal, UP)
        across, down = (2.0 * abs(axis @ half) for axis in (u, v))
        centre = self.middle + half * UP - normal * abs(normal @ half)
        return WallFrame(
            origin_world=centre - 0.5 * across * u - 0.5 * down * v,
            u_world=u,
            v_world=v,
            normal_world=normal,
            gsd_m=self.gsd_m,
            width=round(across / self.gsd_m),
            height=round(down / self.gsd_m),
        )

    def walls(self) -> Walls:
        """The walls as rasters, all on their planes."""
        rasters = [
            samples.wall(frame, plane_index=index, name=f"wall {index}")
            for index, frame in enumerate(self.frames)
        ]
        return samples.walls(*rasters, buffer_m=0.05)

    def colours(self, wall: int, cells: NDArray[np.float64]) -> NDArray[np.float64]:
        """Colours (..., 3) of 8 bits, not rounded, at cells (..., 2) of a wall."""
        across, down = np.moveaxis(cells * self.gsd_m, -1, 0)
        waves = [
            np.sin(2.0 * np.pi * across / first + wall + 1.0)
            + np.cos(2.0 * np.pi * down / second - 0.7 * wall)
            for first, second in _PERIODS_M
        ]
        return np.stack([128.0 + 50.0 * wave for wave in waves], axis=-1)

    def cell_centres(self, wall: int) -> NDArray[np.float64]:
        """Centres (rows, columns, 2) of the cells of a wall."""
        frame = self.frames[wall]
        across, down = np.meshgrid(np.arange(frame.width) + 0.5, np.arange(frame.height) + 0.5)
        return np.stack([across, down], axis=-1)

    def seen(
        self, centre_world: NDArray[np.float64], rays_world: NDArray[np.float64]
    ) -> NDArray[np.uint8]:
        """Colours (..., 3) of what is seen from within along rays (..., 3); the floor is black."""
        rays = rays_world.reshape(-1, 3)
        found = np.zeros((len(rays), 3))
        nearest = np.full(len(rays), np.inf)
        for wall, frame in enumerate(self.frames):
            with np.errstate(divide="ignore"):
                reach = ((frame.origin_world - centre_world) @ frame.normal_world) / (
                    rays @ frame.normal_world
                )
            hit = (reach > 0.0) & (reach < nearest)
            places = frame.wall_from_world(centre_world + reach[hit, None] * rays[hit])[:, :2]
            inside = ((places > -1e-6) & (places < [frame.width + 1e-6, frame.height + 1e-6])).all(
                axis=1
            )
            at = np.flatnonzero(hit)[inside]
            nearest[at] = reach[at]
            found[at] = self.colours(wall, places[inside])
        return np.rint(found).astype(np.uint8).reshape(rays_world.shape)
