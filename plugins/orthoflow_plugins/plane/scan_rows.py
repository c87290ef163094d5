"""One row of a scan on the first plane: how thick it is there, after Figure 3 of markiewicz2015.

Along a row there is no footprint and no second station to blur the picture: what is left is the
noise of single distances, on one material after the other.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import wall_axes
from orthoflow.products import JsonValue, Planes, PointCloud
from orthoflow_plugins.plane.remainders import Remainder
from orthoflow_plugins.plane.thickness import Materials, robust_sigma, spreads_by_material

# Points a scan row needs on a plane to be worth drawing.
_ROW_LEAST: Final = 20
# Relief and bow are not thickness: distances are taken from the mean of a piece of the row.
_PIECE_M: Final = 0.1
_PIECE_LEAST: Final = 4


@dataclass(frozen=True, kw_only=True)
class ScanRow:
    """One row of one scan on the first plane.

    Attributes:
        row: its number.
        scan: the scan it is from.
        along_m: (n,) place along the plane, to the viewer's right; ascending.
        distance_m: (n,) distance from the plane, positive towards the viewer.
        intensity: (n,) 0..1, or None where the cloud has none.
    """

    row: int
    scan: int
    along_m: NDArray[np.float64]
    distance_m: NDArray[np.float64]
    intensity: NDArray[np.float64] | None

    def to_json(self, materials: Materials) -> JsonValue:
        """Numbers for the planes' details: thickness of the row, and of each material on it."""
        piece = np.floor((self.along_m - self.along_m[0]) / _PIECE_M).astype(np.int64)
        count = np.bincount(piece)
        mean_m = np.bincount(piece, self.distance_m) / np.maximum(count, 1)
        crowded = count[piece] >= _PIECE_LEAST
        piece = piece[crowded]
        # A mean of n follows its own points: deviations from it are too small by this.
        deviation_m = (self.distance_m[crowded] - mean_m[piece]) / np.sqrt(1.0 - 1.0 / count[piece])
        told: dict[str, JsonValue] = {
            "row": self.row,
            "scan": self.scan,
            "n_points": len(self.along_m),
            "sigma_m": robust_sigma(deviation_m) if len(deviation_m) else None,
        }
        if self.intensity is not None and materials:
            spreads = spreads_by_material(self.intensity[crowded], materials, deviation_m)
            told["material"] = [item.to_json() for item in spreads]
        return told


def scan_row(
    planes: Planes, plane_of_sample: NDArray[np.int64], whole: Remainder, cloud: PointCloud
) -> ScanRow | None:
    """Give the scan row that most of the first plane's points are on, None without rows."""
    if cloud.row is None:
        return None
    members = whole.sample.index[plane_of_sample == 0]
    if not len(members):
        return None
    scans = np.zeros(len(members), dtype=np.int64) if cloud.scan is None else cloud.scan[members]
    keys = scans.astype(np.int64) * 2**32 + cloud.row[members]
    names, counts = np.unique(keys, return_counts=True)
    scan, row = divmod(int(names[np.argmax(counts)]), 2**32)
    chosen = np.flatnonzero(cloud.row == row)
    if cloud.scan is not None:
        chosen = chosen[cloud.scan[chosen] == scan]
    on_plane = whole.claims[chosen]
    claim = whole.sample_claims[plane_of_sample == 0]
    chosen = chosen[on_plane == claim[0]]
    if len(chosen) < _ROW_LEAST:
        return None
    points = np.column_stack([cloud.x[chosen], cloud.y[chosen], cloud.z[chosen]]).astype(np.float64)
    normal = planes.normal[0]
    along_m = points @ wall_axes(normal, planes.up)[0]
    order = np.argsort(along_m, kind="stable")
    distance_m = points @ normal - (planes.offset[0] - float(normal @ cloud.origin))
    intensity = None if cloud.intensity is None else cloud.intensity[chosen].astype(np.float64)
    return ScanRow(
        row=row,
        scan=scan,
        along_m=along_m[order],
        distance_m=distance_m[order],
        intensity=None if intensity is None else intensity[order],
    )
