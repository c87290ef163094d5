"""The six world directions that can be up in a scan, and the frame that belongs to each."""

from __future__ import annotations

from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

UpDirection = Literal["z", "x", "-x", "y", "-y", "-z"]

UP_VECTORS: Final[dict[UpDirection, tuple[float, float, float]]] = {
    "x": (1.0, 0.0, 0.0),
    "-x": (-1.0, 0.0, 0.0),
    "y": (0.0, 1.0, 0.0),
    "-y": (0.0, -1.0, 0.0),
    "z": (0.0, 0.0, 1.0),
    "-z": (0.0, 0.0, -1.0),
}

# e1 for each up axis; e2 = up x e1 completes the right-handed frame. With up = z this is (x, y, z).
_FIRST_AXES: Final[dict[int, tuple[float, float, float]]] = {
    0: (0.0, 1.0, 0.0),
    1: (0.0, 0.0, 1.0),
    2: (1.0, 0.0, 0.0),
}


def up_vector(direction: UpDirection) -> NDArray[np.float64]:
    """Return the unit vector (3,) of an up direction in world axes."""
    return np.array(UP_VECTORS[direction])


def basis_from_up(up: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the right-handed frame to which "horizontal", "2D" and the angles omega and phi refer.

    Args:
        up: (3,) unit vector in world axes, any direction.

    Returns:
        (3, 3) rows e1, e2, up: `basis @ point_world` gives (first, second, height). For up = z it
        is the identity. e1 is the world axis that follows the one nearest to up (x after z, y
        after x, z after y), made perpendicular to up.
    """
    axis = int(np.argmax(np.abs(up)))
    first = np.array(_FIRST_AXES[axis])
    first = first - (first @ up) * up
    first /= np.linalg.norm(first)
    return np.array([first, across(up, first), up])


def across(first: NDArray[np.float64], second: NDArray[np.float64]) -> NDArray[np.float64]:
    """Cross product (3,); `np.cross` takes twenty times as long for two single vectors."""
    a, b, c = first.tolist()
    d, e, f = second.tolist()
    return np.array([b * f - c * e, c * d - a * f, a * e - b * d])
