"""What a laser sees of a material that the eye does not: contrast the other way round, wet, marks.

Red lead, gold, wet plaster and retouchings change order between the laser's one wavelength and the
three broad bands of a camera. Per material, reflectance falls with red and rises with green, each
by a gain and a power of its own; wet patches are darker, retro-reflecting spots blind the detector.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.hashed_numbers import cell_states, uniforms
from orthoflow.geometry.scenes import Scene

# Ranges of what is drawn per material: reflectance of black, falls with red, rises with green.
_BLACK: Final = (0.75, 0.9)
_RED: Final = (0.6, 0.85)
_GREEN: Final = (0.4, 0.65)
_RED_POWER: Final = (0.8, 1.3)
_GREEN_POWER: Final = (1.2, 1.8)
_OWN_PATTERN: Final = 0.35
_WET_M: Final = 0.7
_WET_FROM: Final = 0.6
_WET_DARKER: Final = 0.45
_SPOT_EVERY_M: Final = 0.4
_SPOT_SHARE: Final = 0.05
_SPOT_RADIUS_M: Final = 0.012


@dataclass(frozen=True, kw_only=True)
class LaserBand:
    """The laser's band in one scene.

    Attributes:
        scene: whose rectangles are seen; its origin at (0, 0, 0).
        inversion: 0 when the laser sees what the scene's textures say, 1 when all contrast goes
            by the materials' own response.
        seed: of materials, patches and spots.
    """

    scene: Scene
    inversion: float
    seed: int

    def reflectance(
        self,
        rectangle: NDArray[np.int32],
        points: NDArray[np.float64],
        colours: NDArray[np.float32],
    ) -> NDArray[np.float64]:
        """What the laser sees of points.

        Args:
            rectangle: (n,) that each lies on.
            points: (3, n) metres.
            colours: (4, n) red, green, blue 0..255, and the texture's own reflectance.

        Returns:
            (n,) 0..1.
        """
        plain: NDArray[np.float64] = colours[3].astype(np.float64)
        if self.inversion == 0.0:
            return plain
        material = self.scene.texture_params[rectangle, 6].astype(np.int64)
        states = cell_states(material, np.zeros_like(material), self.seed)

        def drawn(limits: tuple[float, float], draw: int) -> NDArray[np.float64]:
            share = uniforms(states, draw)
            return np.asarray(limits[0] + (limits[1] - limits[0]) * share, dtype=np.float64)

        red, green = colours[0] / 255.0, colours[1] / 255.0
        own = (
            drawn(_BLACK, 0)
            - drawn(_RED, 1) * red ** drawn(_RED_POWER, 2)
            + drawn(_GREEN, 3) * green ** drawn(_GREEN_POWER, 4)
            + _OWN_PATTERN * (plain - self.scene.texture_params[rectangle, 3])
        )
        a, b = self._places(rectangle, points)
        wet = _smooth_noise(a / _WET_M, b / _WET_M, material + self.seed)
        own *= 1.0 - _WET_DARKER * np.clip((wet - _WET_FROM) / 0.1, 0.0, 1.0)
        own[_is_spot(a, b, material + self.seed)] = 1.0
        mixed = (1.0 - self.inversion) * plain + self.inversion * own
        return np.asarray(np.clip(mixed, 0.01, 1.0), dtype=np.float64)

    def _places(
        self, rectangle: NDArray[np.int32], points: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        offsets = points.T - self.scene.centre[rectangle]
        a, b = (
            np.einsum("ni,ni->n", offsets, axis[rectangle])
            for axis in (self.scene.axis_a, self.scene.axis_b)
        )
        return a, b


def _smooth_noise(
    x: NDArray[np.float64], y: NDArray[np.float64], seed: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Noise 0..1 that is smooth between the points of a lattice, and its own per seed."""
    column, row = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    s, t = x - column, y - row
    s, t = s * s * (3.0 - 2.0 * s), t * t * (3.0 - 2.0 * t)
    total = np.zeros_like(x)
    for right in (0, 1):
        for down in (0, 1):
            weight = (s if right else 1.0 - s) * (t if down else 1.0 - t)
            total += weight * uniforms(_lattice(column + right, row + down, seed), 5)
    return total


def _is_spot(
    a: NDArray[np.float64], b: NDArray[np.float64], seed: NDArray[np.int64]
) -> NDArray[np.bool_]:
    column = np.floor(a / _SPOT_EVERY_M).astype(np.int64)
    row = np.floor(b / _SPOT_EVERY_M).astype(np.int64)
    states = _lattice(column, row, seed)
    distance = np.hypot(
        a / _SPOT_EVERY_M - column - 0.2 - 0.6 * uniforms(states, 6),
        b / _SPOT_EVERY_M - row - 0.2 - 0.6 * uniforms(states, 7),
    )
    is_near = distance < _SPOT_RADIUS_M / _SPOT_EVERY_M
    return np.asarray(is_near & (uniforms(states, 8) < _SPOT_SHARE), dtype=np.bool_)


def _lattice(
    column: NDArray[np.int64], row: NDArray[np.int64], seed: NDArray[np.int64]
) -> NDArray[np.uint64]:
    return cell_states(column, row + 1_000_003 * seed, 0)
