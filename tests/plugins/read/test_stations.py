"""Where the scanner stood: what files say credibly, what the user says, or nothing."""

from __future__ import annotations

import numpy as np
import pytest
from orthoflow_plugins.read.stations import ScanSummary, choose_stations


def scan(
    station: tuple[float, float, float] | None = (0.0, 0.0, 0.0),
    *,
    is_posed: bool = False,
    low: tuple[float, float, float] = (-2.0, -2.0, -2.0),
    high: tuple[float, float, float] = (2.0, 2.0, 2.0),
) -> ScanSummary:
    return ScanSummary(
        station=None if station is None else np.array(station),
        is_posed=is_posed,
        low=np.array(low),
        high=np.array(high),
    )


@pytest.mark.parametrize(
    ("low", "is_believed"),
    [
        ((-2.0, -2.0, -2.0), True),
        # A box of 2 x 2 x 1 m has a diagonal of 3 m.
        ((2.9, 0.0, 0.0), True),
        ((3.1, 0.0, 0.0), False),
        ((500_000.0, 0.0, 0.0), False),
        ((np.nan, 0.0, 0.0), False),
    ],
)
def test_one_scan_without_a_pose_may_have_been_seen_from_its_origin(
    low: tuple[float, float, float], is_believed: bool
) -> None:
    high = (low[0] + 2.0, low[1] + 2.0, low[2] + 1.0)
    found = choose_stations([scan(low=low, high=high)], None)
    assert (found.source == "file") is is_believed
    assert (found.positions is not None) is is_believed


def test_two_scans_without_poses_did_not_both_stand_at_the_origin() -> None:
    found = choose_stations([scan(), scan()], None)
    assert (found.positions, found.source, found.per_scan) == (None, None, False)
    mixed = choose_stations([scan(), scan((1.0, 0.0, 0.0), is_posed=True)], None)
    assert mixed.positions is not None
    assert mixed.positions.tolist() == [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]
