"""Where the scanner stood: taken from the files where they say so credibly, else from the user."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, kw_only=True)
class ScanSummary:
    """One scan as it was read, in metres; a few stray points do not count.

    Attributes:
        station: (3,) where the file says the scanner stood, or None.
        is_posed: the file states a pose other than the identity.
        low: (3,) smallest coordinates, but for a few.
        high: (3,) largest coordinates, but for a few.
    """

    station: NDArray[np.float64] | None
    is_posed: bool
    low: NDArray[np.float64]
    high: NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Stations:
    """What is known of the viewer.

    Attributes:
        positions: (s, 3) metres, or None.
        source: `file`, `view_from` or None.
        per_scan: row i is the station of scan i.
    """

    positions: NDArray[np.float64] | None
    source: str | None
    per_scan: bool


def choose_stations(
    scans: Sequence[ScanSummary], view_from: tuple[float, float, float] | None
) -> Stations:
    """Choose the files' stations if there are any, else the user's viewpoint."""
    n_unposed = sum(scan.station is not None and not scan.is_posed for scan in scans)
    known = [
        scan.station
        for scan in scans
        if scan.station is not None
        and (scan.is_posed or (n_unposed == 1 and _may_be_scanner(scan)))
    ]
    if known:
        return Stations(
            positions=np.vstack(known), source="file", per_scan=len(known) == len(scans)
        )
    if view_from is not None:
        return Stations(positions=np.array([view_from]), source="view_from", per_scan=False)
    return Stations(positions=None, source=None, per_scan=False)


def _may_be_scanner(scan: ScanSummary) -> bool:
    """Whether a scan without a pose can have been seen from its origin.

    A scan in its scanner's frame surrounds or faces the origin; a cloud in survey coordinates, or
    one of several scans that were registered before export, lies anywhere.
    """
    if scan.station is None or not np.isfinite(scan.low).all():
        return False
    nearest = np.clip(scan.station, scan.low, scan.high)
    diagonal_m = float(np.linalg.norm(scan.high - scan.low))
    return float(np.linalg.norm(nearest - scan.station)) <= diagonal_m
