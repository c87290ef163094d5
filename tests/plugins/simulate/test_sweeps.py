"""Where a simulated scanner stands, and which angles it scans."""

from __future__ import annotations

import math

import numpy as np
import pytest
from orthoflow_plugins.simulate.room_model import main_wall_axes
from orthoflow_plugins.simulate.scanning import planned_sweeps, station_positions

from orthoflow.geometry import Plane

UP = np.array([0.0, 0.0, 1.0])


@pytest.mark.parametrize("n_stations", [1, 4])
def test_panoramas_close_and_detail_scans_just_hold_the_main_wall(n_stations: int) -> None:
    along, towards = main_wall_axes()
    # Four metres before the origin, 6 x 3 m, off the middle.
    middle = 4.0 * towards + 0.3 * along
    outline = np.array(
        [middle + a * along + h * UP for a, h in ((-3, 1.6), (-3, -1.4), (3, -1.4), (3, 1.6))]
    )
    wall = Plane(normal=-towards, offset_m=-4.0)
    seeds = np.arange(100, 110)
    sweeps = planned_sweeps(station_positions(n_stations), (0.05, 0.02), wall, outline, seeds)
    assert [sweep.seed for sweep in sweeps] == list(range(100, 100 + 2 * n_stations))
    forward = math.atan2(towards[1], towards[0])
    shares = np.linspace(0.0, 1.0, 201)[:, None]
    rim = np.concatenate(
        [a + shares * (b - a) for a, b in zip(outline, np.roll(outline, -1, axis=0), strict=True)]
    )
    for k, station in enumerate(station_positions(n_stations)):
        panorama, detail = sweeps[2 * k : 2 * k + 2]
        distance_m = 4.0 - station @ towards
        for sweep, step_m in ((panorama, 0.05), (detail, 0.02)):
            np.testing.assert_array_equal(sweep.station, station)
            assert sweep.step == pytest.approx(step_m / distance_m)
        assert panorama.azimuth == 0.0
        assert panorama.elevation == pytest.approx(math.radians(-62.0))
        assert 0.0 <= 2.0 * math.pi - panorama.n_columns * panorama.step < panorama.step
        assert 0.0 <= math.radians(124.0) - panorama.n_rows * panorama.step < panorama.step
        rays = rim - station
        azimuths = np.arctan2(rays[:, 1], rays[:, 0]) - forward
        azimuths = forward + (azimuths + math.pi) % (2.0 * math.pi) - math.pi
        elevations = np.arctan2(rays[:, 2], np.hypot(rays[:, 0], rays[:, 1]))
        for seen, first, n_steps in (
            (azimuths, detail.azimuth, detail.n_columns),
            (elevations, detail.elevation, detail.n_rows),
        ):
            assert first == pytest.approx(seen.min(), abs=1e-3)
            assert -1e-3 < first + n_steps * detail.step - seen.max() < 1.001 * detail.step + 1e-3
