"""The product: cracks as lines, which are stored, compared and published like any other product."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from orthoflow.errors import ProductError
from orthoflow.files.geotiff import SITE_CRS
from orthoflow.files.polygons import write_features
from orthoflow.products import Product, Tolerance


@dataclass(frozen=True, kw_only=True)
class Cracks(Product):
    """Cracks of all walls; each is a line through its vertices.

    Attributes:
        vertices_world: (n, 3) float64 metres, in the order of the lines.
        line: (n,) int32 index of the line of each vertex, 0..k-1 without gaps.
        wall: (k,) int32 index of the wall of each line.
        width_m: (k,) float64 mean width of each line.
    """

    type_name: ClassVar[str] = "cracks"
    tolerances: ClassVar[Mapping[str, Tolerance]] = {
        "vertices_world": Tolerance(limit=1e-3, unit="m"),
        "width_m": Tolerance(limit=1e-4, unit="m"),
    }

    vertices_world: NDArray[np.float64]
    line: NDArray[np.int32]
    wall: NDArray[np.int32]
    width_m: NDArray[np.float64]

    def __post_init__(self) -> None:
        if self.vertices_world.shape != (len(self.line), 3):
            raise ProductError(
                f"cracks.vertices_world must have shape ({len(self.line)}, 3), got "
                f"{self.vertices_world.shape}"
            )

    def __len__(self) -> int:
        return len(self.wall)

    def vertices(self, index: int) -> NDArray[np.float64]:
        """Return the vertices (m, 3) of one line."""
        return self.vertices_world[self.line == index]

    def length_m(self) -> float:
        """Return the total length of all lines."""
        return sum(
            float(np.linalg.norm(np.diff(self.vertices(index), axis=0), axis=1).sum())
            for index in range(len(self))
        )


def publish_cracks(product: Cracks, folder: Path, digest: str) -> None:
    """Write `cracks.geojson`, with a line per crack in the scan's coordinates (metres)."""
    features = [
        {
            "type": "Feature",
            "properties": {
                "wall": int(product.wall[index]),
                "width_mm": round(1000 * float(product.width_m[index]), 3),
            },
            "geometry": {
                "type": "LineString",
                "coordinates": np.round(product.vertices(index), 5).tolist(),
            },
        }
        for index in range(len(product))
    ]
    write_features(folder / "cracks.geojson", features, SITE_CRS, digest=digest)
