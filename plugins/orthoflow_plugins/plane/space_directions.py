"""The directions that a 3D accumulator asks about: even over the hemisphere, the pole once.

At phi = 90 degrees every omega is the same plane: a table of omega by phi counts a floor 180 times.
Here each circle of one phi has as many directions as its length asks for.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthoflow_plugins.plane.candidates import Family


@dataclass(frozen=True, kw_only=True)
class Directions:
    """Directions of normals in the (e1, e2, up) frame, those of one omega together.

    Attributes:
        angles_rad: (d, 2) omega 0..pi and phi -pi/2..pi/2.
        starts: (o + 1,) where those of each omega start.
        normals: (d, 3) unit vectors.
        step_rad: angle between neighbours.
    """

    angles_rad: NDArray[np.float64]
    starts: NDArray[np.int64]
    normals: NDArray[np.float64]
    step_rad: float


def directions_over(step_deg: float, family: Family, tilt_most_deg: float) -> Directions:
    """Cover the hemisphere, or the part of it that a family of planes needs."""
    n_turns = max(4, round(180.0 / step_deg))
    step_rad = math.pi / n_turns
    phis = -0.5 * math.pi + step_rad * np.arange(1, n_turns + 1)
    limit_rad = math.radians(tilt_most_deg) + step_rad
    if family == "wall":
        phis = phis[np.abs(phis) <= limit_rad]
    elif family == "level":
        phis = phis[0.5 * math.pi - np.abs(phis) <= limit_rad]
    # The pole is the last phi; its cosine is zero but for rounding, so it has one omega.
    n_around = np.maximum(1, np.ceil(n_turns * np.cos(phis) - 1e-9)).astype(np.int64)
    rows = []
    starts = [0]
    for turn in range(n_turns):
        begins = turn * n_around // n_turns != (turn - 1) * n_around // n_turns
        rows += [(turn * step_rad, phi) for phi in phis[begins]]
        starts.append(len(rows))
    angles = np.array(rows)
    omega, phi = angles[:, 0], angles[:, 1]
    normals = np.column_stack(
        [np.cos(phi) * np.cos(omega), np.cos(phi) * np.sin(omega), np.sin(phi)]
    )
    return Directions(
        angles_rad=angles,
        starts=np.array(starts, dtype=np.int64),
        normals=normals,
        step_rad=step_rad,
    )
