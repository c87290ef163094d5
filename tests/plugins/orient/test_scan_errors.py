"""Motions of scans, measured from surfaces that several of them contain, against drawn motions."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.orient.photos import scan_errors_of
from orthoflow_plugins.orient.pose import OrientIn
from orthoflow_plugins.orient.scan_errors import ScanErrors, measured_scan_errors

from orthoflow.products import Photos
from tests import samples
from tests.raster_scenes import cloud_of, context

ORIGIN = np.array([4e5, 5e6, 100.0])
SIDES_M = np.array([6.0, 5.0, 3.0])
ENDS = np.array([[0.5, 0.1, 1.0], [5.5, 0.1, 2.0]])


def scanned(
    motions: NDArray[np.float64], sides: tuple[int, ...], gap_m: float = -2.0
) -> ScanErrors | None:
    """Halves of a box that overlap, and its ends, each scanned twice from its station.

    The noise is 2 mm.
    """
    rng, offsets, scan = np.random.default_rng(7), [], []
    for own, at in enumerate((0, 1, 0, 1)):
        for side in sides:
            points = SIDES_M * rng.uniform(size=(6000, 3))
            points[:, side % 3] = SIDES_M[side % 3] * (side // 3)
            away_m = points[:, 0] if at == 0 else SIDES_M[0] - points[:, 0]
            points = points[(side % 3 == 0) | (away_m < 0.5 * (SIDES_M[0] - gap_m))]
            points += motions[at, 0] + np.cross(motions[at, 1], points)
            offsets.append(points + 0.002 * rng.normal(size=points.shape))
            scan += [own] * len(points)
    columns = np.vstack(offsets).astype(np.float32).T
    return measured_scan_errors(
        list(columns), np.array(scan, np.uint16), ORIGIN, np.eye(4, 3)[[0, 1, 0, 1]]
    )


@pytest.mark.parametrize("turn_rad", [0.0, 5e-4])
def test_motions_are_found_from_the_sides_that_two_stations_share(turn_rad: float) -> None:
    motions = np.random.default_rng(3).normal(size=(2, 2, 3)) * [[[0.005], [turn_rad]]]
    found = scanned(motions, (0, 1, 2, 3, 4, 5))
    assert found is not None
    errors = found.at(ORIGIN + ENDS)
    motions -= motions.mean(axis=0)
    true = motions[:, 0] + np.cross(motions[:, 1], ENDS)
    apart = errors[1, :, 0] - errors[0, :, 0]
    np.testing.assert_allclose(apart, true[1] - true[0], atol=3e-4)
    assert (np.abs(errors[:, :, 1:]) < 5e-4).all()


def test_what_one_wall_does_not_show_is_as_uncertain_as_what_it_shows_is_large() -> None:
    motions = np.array([[[0.0, 0.0, 0.0]] * 2, [[0.004, 0.006, -0.003], [0.0, 0.0, 0.0]]])
    found = scanned(motions, (1,))
    assert found is not None
    errors = found.at(ORIGIN + ENDS)
    apart = errors[1] - errors[0]
    assert apart[1, 0] == pytest.approx(0.006, abs=3e-4)
    sigmas = np.linalg.norm(apart[:, 1:], axis=1)
    np.testing.assert_allclose(sigmas, [0.006, 0.0, 0.006], atol=1e-3)


def test_a_match_is_of_the_mean_of_scans_or_of_the_fullest_or_between() -> None:
    """Of two scans with 3 and 1 of 4 points, shifted by 8 mm and 0 mm, in one place."""
    motions = np.zeros((2, 6, 1))
    motions[0, 0, 0] = 0.008
    shares, places = np.array([[0.75, 0.25]]), {"origin": ORIGIN, "centres": np.zeros((1, 3))}
    found = ScanErrors(**places, extent_m=1.0, shares=shares, motions=motions, sigma_m=np.ones(2))
    # The mean is 6 mm off, the fullest scan 8 mm; those between have an SD of 2 mm / sqrt(12).
    errors = found.at(ORIGIN[None])
    np.testing.assert_allclose(errors[0, 0], [0.007, 0.002 / 12**0.5], atol=1e-12)
    np.testing.assert_allclose(errors[0, 1:], 0.0, atol=1e-12)


def test_scans_without_a_common_surface_show_no_motions() -> None:
    assert scanned(np.zeros((2, 2, 3)), (1, 2), gap_m=1.0) is None


@pytest.mark.parametrize(
    ("n_scans", "source", "reason"),
    [
        (0, None, "no scan numbers"),
        (1, "file", None),
        (1, None, "one scan"),
        (2, "file", "no surface"),
        (101, "file", "101 scans"),
    ],
)
def test_clouds_that_do_not_show_their_registration_are_reported_with_the_reason(
    tmp_path: Path, n_scans: int, source: str | None, reason: str | None
) -> None:
    # The scans are metres apart.
    scan = np.repeat(np.arange(n_scans, dtype=np.uint16), 20) if n_scans else None
    points = np.random.default_rng(1).uniform(size=(20 * max(n_scans, 1), 3))
    points[:, 0] += 0.0 if scan is None else 3.0 * scan
    stations = None if source is None else np.arange(3.0 * n_scans).reshape(-1, 3)
    cloud = replace(cloud_of(points), scan=scan, stations=stations, stations_source=source)
    ones = {"points_world": np.ones((1, 3)), "sigma_px": np.ones(1), "sigma_m": np.ones(1)}
    ties = samples.ties(np.ones((1, 2)), **ones)
    inputs = OrientIn(ties=ties, photos=Photos(photos=()), cloud=cloud)
    ctx = context(tmp_path)
    assert scan_errors_of(inputs, ctx) is None
    assert [one.code for one in ctx.diagnostics] == ["registration-unknown"] * (reason is not None)
    assert all(str(reason) in one.text for one in ctx.diagnostics)
