"""What the page's script needs to tell world coordinates under the cursor of an orthoimage."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from orthoflow.foreign_text import shown
from orthoflow.geometry import WallFrame

# Depths are told to a millimetre at so many places of a wall, some 40 kB of a page.
_PLACES_MOST: Final = 8_000


@dataclass(frozen=True, kw_only=True)
class CoarseDepths:
    """Depths of a wall on a coarse grid over its whole raster.

    Attributes:
        columns: of the grid; rows alike.
        depth_mm: row by row, None where nothing is known.
    """

    columns: int
    rows: int
    depth_mm: tuple[int | None, ...]


class Placed(Protocol):
    """A picture of a wall."""

    @property
    def id(self) -> str: ...  # noqa: D102 - as `pictures.Picture` has them
    @property
    def number(self) -> int: ...  # noqa: D102
    @property
    def name(self) -> str: ...  # noqa: D102
    @property
    def frame(self) -> WallFrame | None: ...  # noqa: D102
    @property
    def depths(self) -> CoarseDepths | None: ...  # noqa: D102


def coarse_depths(depth_m: NDArray[np.float32]) -> CoarseDepths:
    """Take the depths in the middle of each cell of a coarse grid."""
    height, width = depth_m.shape
    step = max(1.0, math.sqrt(width * height / _PLACES_MOST))
    columns, rows = max(1, round(width / step)), max(1, round(height / step))
    at_columns = ((np.arange(columns) + 0.5) * width / columns).astype(np.intp)
    at_rows = ((np.arange(rows) + 0.5) * height / rows).astype(np.intp)
    picked = np.rint(1000.0 * depth_m[np.ix_(at_rows, at_columns)].astype(np.float64)).ravel()
    return CoarseDepths(
        columns=columns,
        rows=rows,
        depth_mm=tuple(int(value) if math.isfinite(value) else None for value in picked.tolist()),
    )


def cursor_places(
    orthoimages: Sequence[Placed], walls: Sequence[Placed]
) -> list[dict[str, object]]:
    """State where the cells of each orthoimage lie in the world.

    Args:
        orthoimages: pictures of orthoimages.
        walls: pictures of walls, of which those of the depth know it.
    """
    places: list[dict[str, object]] = []
    for picture in orthoimages:
        frame = picture.frame
        if frame is None:
            continue
        known = (other for other in walls if other.depths is not None and other.frame is not None)
        fitting = (other for other in known if other.frame and frame.has_cells_of(other.frame))
        depths = next((other.depths for other in fitting), None)
        places.append(
            {
                "id": picture.id,
                "wall": picture.number,
                "name": shown(picture.name),
                "origin": frame.origin_world.tolist(),
                "u": frame.u_world.tolist(),
                "v": frame.v_world.tolist(),
                "n": frame.normal_world.tolist(),
                "gsd": frame.gsd_m,
                "width": frame.width,
                "height": frame.height,
                "columns": depths.columns if depths else 0,
                "rows": depths.rows if depths else 0,
                "mm": list(depths.depth_mm) if depths else [],
            }
        )
    return places
