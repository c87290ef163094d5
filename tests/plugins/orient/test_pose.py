"""How exact ties should be before any pose, which may be chance, and whose calibration is wrong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.orient.pnp import estimate_by_opencv
from orthoflow_plugins.orient.pose import (
    Estimate,
    OrientParams,
    estimate_pose,
    expected_px,
    robust_start,
    unit_deviation,
    without_chance,
)

from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.geometry.resection import SeenPoints
from orthoflow.testing import photographed as ms
from tests.scenes import SURVEY_SHIFT_M
from tests.tied_photos import SCENE, photo, seen_by, tied

PARAMS = OrientParams()


def camera() -> ViewingCamera:
    return ms.camera_before(SCENE)


def test_a_pose_depends_on_the_ratios_of_the_sigmas_of_its_ties_alone() -> None:
    """What counts less as too far off follows how far ties are off, not what they state."""
    viewer = camera()
    rng = np.random.default_rng(7)
    seen = seen_by(viewer, 200, sigma_px=0.5)
    # Longer tails than normal ones: many are beyond the limit.
    off_px = 0.35 * rng.standard_t(3, size=(200, 2))
    seen = replace(seen, pixels_photo=seen.pixels_photo + off_px)
    scaled = replace(seen, sigma_px=2.5 * seen.sigma_px, sigma_m=2.5 * seen.sigma_m)
    check = np.arange(200) % 5 == 0
    # The same ties are sampled first.
    params = OrientParams(threshold_px=4.0)
    found, other = (
        estimate_pose(tied(photo(viewer), each, is_check=check), params) for each in (seen, scaled)
    )
    assert isinstance(found, Estimate)
    assert isinstance(other, Estimate)
    np.testing.assert_array_equal(found.agreeing, other.agreeing)
    np.testing.assert_allclose(
        found.resection.camera.centre_world, other.resection.camera.centre_world, atol=1e-6
    )
    np.testing.assert_allclose(found.resection.covariance, other.resection.covariance, rtol=1e-2)


@pytest.mark.parametrize("scale", [0.2, 2.9])
def test_the_unit_deviation_is_that_of_normal_vectors(scale: float) -> None:
    rng = np.random.default_rng(3)
    lengths = np.hypot(*rng.normal(0.0, scale, (2, 40_000)))
    assert unit_deviation(lengths) == pytest.approx(scale, rel=0.02)
    lengths[:15_000] = 1e6
    # A good third of wrong ones leaves it within reason.
    assert unit_deviation(lengths) <= 3.0


def ring(inner: float, outer: float, count: int) -> NDArray[np.float64]:
    """Lengths of vectors that lie evenly over a ring."""
    shares = (np.arange(count) + 0.5) / count
    return np.sqrt(inner**2 + shares * (outer**2 - inner**2))


def test_a_limit_holds_where_hardly_any_tie_within_it_is_there_by_chance() -> None:
    right = np.full(100, 0.5)
    # Eighty wrong ones from one to three times the limit stand for ten within it: a tenth.
    assert without_chance(np.append(right, ring(3.6, 10.4, 80)), 3.5) == 3.5
    assert without_chance(np.append(right, ring(3.6, 10.4, 81)), 3.5) < 3.5
    # Farther off, or not known at all, they tell nothing.
    beyond = np.append(right, [10.6] * 500 + [np.nan] * 500 + [np.inf] * 500)
    assert without_chance(beyond, 3.5) == 3.5


@pytest.mark.parametrize("n_wrong", [1000, 4000])
def test_a_limit_is_tightened_until_chance_is_a_tenth(n_wrong: int) -> None:
    right = np.hypot(*np.random.default_rng(4).normal(0.0, 0.3, (2, 300)))
    lengths = np.append(right, ring(0.0, 30.0, n_wrong))
    found = without_chance(lengths, 3.5)

    def share(limit: float) -> float:
        inside = np.count_nonzero(lengths <= limit)
        around = np.count_nonzero(lengths <= 3.0 * limit) - inside
        return around / 8.0 / inside

    assert share(found) <= 0.1
    # One step before it was not: a fifth less each time.
    if found < 3.5:
        assert share(found / 0.8) > 0.1
        steps = np.log(found / 3.5) / np.log(0.8)
        assert steps == pytest.approx(round(steps), abs=1e-9)


def test_what_is_expected_of_ties_follows_from_their_scale() -> None:
    # A square of 2 m seen as 1000 px: 500 px for a metre.
    rng = np.random.default_rng(5)
    places = rng.uniform(-1.0, 1.0, (4000, 2))
    points = np.column_stack([places[:, 0], np.zeros(4000), places[:, 1]])
    seen = SeenPoints(
        pixels_photo=500.0 * places,
        points_world=points,
        sigma_px=np.full(4000, 0.6),
        sigma_m=np.full(4000, 0.002),
    )
    known = replace(seen, sigma_m=np.zeros(4000))
    assert expected_px(known) == pytest.approx(0.6)
    in_space = np.sqrt(expected_px(seen) ** 2 - 0.6**2)
    # Half a metre lies in the middle of the places, seven tenths of it in that of the farther
    # coordinate: 500 px become 707.
    assert in_space == pytest.approx(0.002 * 500.0 * np.sqrt(2.0), rel=0.03)
    for change, factor in (
        ({"pixels_photo": 3.0 * seen.pixels_photo + 40.0}, 3.0),
        ({"points_world": 2.0 * points + SURVEY_SHIFT_M}, 0.5),
        ({"sigma_m": 5.0 * seen.sigma_m}, 5.0),
    ):
        moved = np.sqrt(expected_px(replace(seen, **change)) ** 2 - 0.6**2)
        assert moved == pytest.approx(factor * in_space, rel=1e-6)


@pytest.mark.parametrize(
    ("off", "n_ties", "is_contradicted"),
    [
        (0.025, 200, False),
        (0.036, 200, True),
        (-0.036, 200, True),
        (0.10, 25, True),
        (0.10, 24, False),
    ],
    ids=str,
)
def test_a_calibration_more_than_three_percent_off_is_of_another_lens(
    off: float, n_ties: int, is_contradicted: bool
) -> None:
    true = camera()
    claimed = replace(true, fx=(1.0 + off) * true.fx, fy=(1.0 + off) * true.fy)
    # Wide enough that no tie is rejected for the wrong focal length.
    seen = seen_by(true, n_ties, sigma_px=6.0)
    found = estimate_pose(tied(photo(claimed), seen), PARAMS)
    if not is_contradicted:
        assert isinstance(found, Estimate)
        return
    assert isinstance(found, str)
    # The reason states the focal length by the ties.
    by_ties = float(found.split("focal length of ")[1].split(" px")[0])
    assert by_ties == pytest.approx(true.fx, rel=0.01)


def test_opencv_refuses_a_lens_with_skew() -> None:
    """Which solvePnP cannot model."""
    of = tied(photo(replace(camera(), skew=2.5)), seen_by(camera(), 40))
    assert isinstance(estimate_by_opencv(of, PARAMS), str)


def test_ties_at_four_places_make_no_pose() -> None:
    true = camera()
    seen = seen_by(true, 5)
    for n_places in (4, 5):
        places = seen.take(np.arange(40) % n_places)
        start = robust_start(tied(photo(true), places), PARAMS)
        assert (start is not None) == (n_places == 5)


def test_withheld_ties_have_no_say_in_the_start() -> None:
    true = camera()
    seen = seen_by(true, 60)
    is_check = np.arange(60) % 2 == 0
    wrong = replace(seen, pixels_photo=np.where(is_check[:, None], 10.0, seen.pixels_photo))
    start = robust_start(tied(photo(true), wrong, is_check=is_check), PARAMS)
    assert start is not None
    np.testing.assert_array_equal(start.agreeing, ~is_check)
    assert start.lens.source == "calibration"
    np.testing.assert_allclose(start.camera.centre_world, true.centre_world, atol=1e-3)


@pytest.mark.parametrize("times", [0.5, 2.0])
def test_ties_are_rejected_by_what_they_deviate_and_not_by_what_they_say(times: float) -> None:
    true = camera()
    # They say half a pixel each, and deviate by so many times as much; a tenth of them is wrong.
    seen = seen_by(true, 300, noise_px=0.5 * times, seed=3)
    wrong = np.arange(300) % 10 == 0
    pixels = seen.pixels_photo + wrong[:, None] * np.array([0.5 * times * 6.5, 0.0])
    is_check = np.arange(300) % 4 == 0
    spoilt = replace(seen, pixels_photo=pixels)
    found = estimate_pose(tied(photo(true), spoilt, is_check=is_check), PARAMS)
    assert isinstance(found, Estimate)
    assert found.limit == pytest.approx(3.5 * times, rel=0.2)
    assert found.agreeing[~wrong].mean() > 0.98
    assert found.agreeing[wrong].mean() < 0.2
    np.testing.assert_array_equal(found.agreeing, found.fit.normalised <= found.limit)
