"""Textured walls as a scan shows them, and what matching finds of photos on them."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.products import Ties, Walls
from orthoflow.testing import photographed as ms
from tests.method_runs import run
from tests.tied_photos import context


@cache
def walls(seed: int) -> Walls:
    return ms.walls_of(ms.textured_wall(seed))


# Any: inputs and parameters differ by method.
def ties_of(method: Any, folder: Path, inputs: dict[str, Any], **params: Any) -> Ties:
    found: Ties = run(method, context(folder), inputs, **params).ties
    return found


def off_px(ties: Ties, camera: ViewingCamera) -> NDArray[np.float64]:
    """How far (n, 2) ties are from where the true camera sees their points."""
    off: NDArray[np.float64] = ties.pixels_photo - camera.project(ties.points_world)[:, :2]
    return off
