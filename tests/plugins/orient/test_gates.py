"""Every gate of an orientation, on both sides of its limit, and the predicted error on walls."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.orient import gates
from orthoflow_plugins.orient.pose import OrientParams
from scipy import optimize, stats

from orthoflow.geometry.cameras import LensFreedom, ViewingCamera
from orthoflow.geometry.resection import Resection
from orthoflow.products import Photo
from tests import samples
from tests.tied_photos import known_wall

N_TIES = 100
DISTANCE_M = 3.0
SIZE_PX = (800, 600)


def camera(*, turn_deg: float = 0.0) -> ViewingCamera:
    """Return a camera at y = -3 in front of the middle of the wall y = 0, turned to the right."""
    centre = np.array([0.0, -DISTANCE_M, 0.0])
    turn = math.radians(turn_deg)
    ahead = centre + np.array([math.sin(turn), math.cos(turn), 0.0])
    return samples.aimed(centre, ahead, 600.0, SIZE_PX)


def wall(half_m: tuple[float, float] = (1.0, 0.5)) -> gates.KnownWall:
    across, up = half_m
    return known_wall((-across, across), (-up, up), gsd_m=0.002)


def posed(
    shift_sigma_m: tuple[float, float, float], viewer: ViewingCamera | None = None
) -> Resection:
    """Return a pose of which only the camera position is uncertain, along the camera's axes."""
    covariance = np.zeros((6, 6))
    covariance[3:, 3:] = np.diag(np.square(shift_sigma_m))
    return Resection(
        camera=camera() if viewer is None else viewer,
        covariance=covariance,
        sigma0=1.0,
        variance_factor=1.0,
        lens=LensFreedom(),
    )


WALL = wall((1.0, 1.0))
PARAMS = OrientParams(min_hull_ratio=0.2, max_sigma_wall_cells=0.5, max_sigma_corner_cells=1.5)


def grid(n: int = 10) -> np.ndarray:
    """Return pixels (n * n, 2) distributed over a photo of 1000 x 800, in random order."""
    places = np.stack(np.meshgrid(np.arange(n), np.arange(n)), axis=-1).reshape(-1, 2) + 0.5
    pixels = places / n * (1000.0, 800.0)
    return pixels[np.random.default_rng(3).permutation(n * n)]


def candidate(**changes: Any) -> gates.Candidate:
    """Return a good orientation: 80 of 100 ties agree, including 16 of 20 withheld ones."""
    agreeing = changes.pop("agreeing", np.arange(N_TIES) % 25 >= 5)
    lengths = np.where(agreeing, 0.5, 8.0)
    footprint = grid(20)
    error = gates.WallError(
        rms_m=0.0008,
        worst_m=0.002,
        corners_m=np.full(4, 0.002),
        footprint_px=footprint,
        sigmas_m=np.full(len(footprint), 0.0008),
    )
    centre = changes.pop("centre", np.array([0.0, -2.0, 0.0]))
    estimate = SimpleNamespace(
        agreeing=agreeing,
        limit=3.0,
        source=changes.pop("source", "calibration"),
        fit=SimpleNamespace(
            normalised=changes.pop("normalised", lengths),
            residuals_px=lengths[:, None] * (0.6, 0.8),
        ),
        resection=SimpleNamespace(camera=SimpleNamespace(centre_world=centre)),
        without_one=(),
    )
    pixels = changes.pop("pixels", grid())
    if changes.get("error"):
        changes["error"] = replace(error, **changes["error"])
    usual: dict[str, Any] = {
        "photo": Photo(name="a.png", encoded=b"", width=1000, height=800),
        "seen": samples.seen(pixels, np.zeros((N_TIES, 3))),
        "is_check": np.arange(N_TIES) % 5 == 0,
        "walls": np.zeros(N_TIES, dtype=np.int32),
        "estimate": estimate,
        "known": (WALL,),
        "error": error,
        "params": PARAMS,
    }
    return gates.Candidate(**{**usual, **changes})


def gated(some: Sequence[gates.Gate] | None = None, /, **changes: Any) -> str | None:
    """Return the name of the gate that refuses a candidate."""
    found = gates.refusal(candidate(**changes), some)
    return found and found[0]


def test_a_good_orientation_is_ok_without_a_note() -> None:
    good = candidate()
    assert gated() is gated(gates.GATES_BEFORE_BLOCK) is None
    assert gates.warnings_for(good) == []
    assert (good.control.sum(), good.checked.sum(), good.gsd_m) == (64, 16, 0.002)
    assert sum(good.quadrant_counts) == 80
    # The points extend over 0.9 of each side, the footprint over 0.95.
    assert good.hull_ratio == pytest.approx((0.9 / 0.95) ** 2, rel=0.05)
    # A withheld tie that duplicates a control tie checks nothing.
    pixels = grid()
    pixels[10] = pixels[11]  # withheld, and control
    twice = candidate(pixels=pixels)
    assert np.flatnonzero(twice.withheld & ~twice.checked).tolist() == [10]


def test_check_points_in_one_place_are_one() -> None:
    good = candidate()
    pixels = good.seen.pixels_photo.copy()
    pixels[good.is_check] = (100.0, 100.0)
    assert gated(pixels=pixels, search_radius_px=20.0) == "chance"
    assert gated(search_radius_px=20.0) != "chance"


def params(**changes: Any) -> OrientParams:
    return PARAMS.model_copy(update=changes)


def agreeing(n_control: int, n_check: int) -> np.ndarray:
    """Return a mask of inliers with given numbers of control and withheld ties."""
    is_check = candidate().is_check
    found = np.zeros(N_TIES, dtype=np.bool_)
    found[np.flatnonzero(~is_check)[:n_control]] = True
    found[np.flatnonzero(is_check)[:n_check]] = True
    return found


def check_deviates(factor: float) -> np.ndarray:
    """Return normalised residuals that are larger by a factor at withheld ties."""
    good = candidate()
    return np.where(good.estimate.agreeing, np.where(good.is_check, 0.5 * factor, 0.5), 8.0)


@pytest.mark.parametrize(
    ("good", "bad", "name"),
    [
        # 80 % of the control points agree, so 8 of 20 check points must agree.
        ({"agreeing": agreeing(64, 8)}, {"agreeing": agreeing(64, 7)}, "check-share"),
        # Check ties may deviate twice as much as the control.
        ({"normalised": check_deviates(1.95)}, {"normalised": check_deviates(2.05)}, "check-rms"),
        ({"agreeing": agreeing(12, 16)}, {"agreeing": agreeing(11, 16)}, "control"),
        ({"params": params(min_hull_ratio=0.8)}, {"params": params(min_hull_ratio=0.95)}, "hull"),
        # The limits are 0.5 and 1.5 cells of 2 mm.
        ({"error": {"rms_m": 0.00099}}, {"error": {"rms_m": 0.00101}}, "accuracy"),
        ({"error": {"worst_m": 0.0029}}, {"error": {"worst_m": 0.0031}}, "accuracy-at-worst"),
        ({"centre": np.array([0.0, -0.1, 0.0])}, {"centre": np.array([0.0, 0.1, 0.0])}, "side"),
        ({}, {"error": None}, "shown"),
    ],
)
def test_each_gate_refuses_what_is_beyond_its_bound(
    good: dict[str, Any], bad: dict[str, Any], name: str
) -> None:
    assert gated(**good) is None
    assert gated(**bad) == name
    # There is a reason.
    assert gates.refusal(candidate(**bad))[1]


def test_four_check_ties_are_too_few_to_compare_their_deviations() -> None:
    few = np.isin(np.arange(N_TIES), [6, 7, 8, 9])
    loose = np.where(candidate().estimate.agreeing, np.where(few, 2.0, 0.5), 8.0)
    assert gated(is_check=few, normalised=loose) != "check-rms"


def six_agree(length: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a mask of inliers with six of twenty withheld ties, and normalised residuals."""
    good = candidate()
    agrees = good.estimate.agreeing.copy()
    agrees[good.is_check] = np.arange(20) < 6
    return agrees, np.where(agrees, length, 8.0)


# Four shares of the limit are tested, each with the probability of at least six of twenty.
BY_CHANCE = optimize.brentq(lambda p: 4.0 * stats.binom.sf(5, 20, p) - 1e-5, 1e-4, 0.5)


@pytest.mark.parametrize("share", [0.2, 0.35, 0.6, 1.0])
def test_one_wrong_pose_in_a_hundred_thousand_may_look_right(share: float) -> None:
    # Six of twenty residuals are within this share of the limit of 3.
    length = 0.999 * 3.0 * share
    agrees, lengths = six_agree(length)
    # Radius for residuals of half a pixel.
    radius_px = 3.0 * share * 0.5 / length
    searched_px = math.sqrt(math.pi * radius_px**2 / BY_CHANCE) / 2.0
    for factor, is_fine in ((1.02, True), (0.98, False)):
        found = gated(agreeing=agrees, normalised=lengths, search_radius_px=factor * searched_px)
        assert (found != "chance") == is_fine


def in_quarter(quarter: int, n: int) -> np.ndarray:
    """Return a mask of inliers with only n in a given quarter."""
    good = candidate()
    columns, rows = (good.seen.pixels_photo >= (500.0, 400.0)).T
    mine = np.flatnonzero((2 * rows + columns == quarter) & good.estimate.agreeing)
    agreeing = good.estimate.agreeing.copy()
    agreeing[mine[n:]] = False
    return agreeing


def quarter_error(quarter: int, sigma_m: float) -> dict[str, Any]:
    columns, rows = (grid(20) >= (500.0, 400.0)).T
    return {"sigmas_m": np.where(2 * rows + columns == quarter, sigma_m, 0.0)}


@pytest.mark.parametrize("quarter", range(4))
def test_quarters_without_ties_must_be_known_from_the_others(quarter: int) -> None:
    def found(n: int, sigma_m: float = 0.01, **changes: Any) -> str | None:
        error = quarter_error(quarter, sigma_m)
        return gated(agreeing=in_quarter(quarter, n), error=error, **changes)

    assert found(2) is None
    assert found(1) == "quarters"
    # The limit is half a cell of 2 mm; a quarter without a wall needs no ties.
    assert found(1, 0.00099) is found(0, 0.0) is None
    assert found(1, 0.00101) == "quarters"
    strict = params(quadrants="strict")
    assert found(1, 0.0, params=strict) == "quarters"
    assert found(2, 0.01, params=strict) is None
    unknown = (replace(WALL, gsd_m=None),)
    assert found(1, 0.0001, known=unknown) == "quarters"
    assert found(0, 0.0, known=unknown) is None
    assert gated(gates.GATES_BEFORE_BLOCK, agreeing=in_quarter(quarter, 0)) is None


def test_the_side_of_a_wall_is_asked_where_it_is_known_and_tied() -> None:
    behind = np.array([0.0, 1.0, 0.0])
    blind = replace(WALL, has_side=False)
    assert gated(centre=behind, known=(blind,)) is None
    other = replace(WALL, index=1)
    assert gated(centre=behind, known=(other,)) is None
    walls = np.zeros(N_TIES, dtype=np.int32)
    control = np.flatnonzero(candidate().control)
    walls[control[:3]] = 1
    assert gated(centre=behind, known=(other,), walls=walls) is None
    walls[control[:4]] = 1
    assert gated(centre=behind, known=(other,), walls=walls) == "side"
    assert gated(gates.GATES_BEFORE_BLOCK, centre=behind) == "side"


def test_limits_of_good_orientations_are_reported() -> None:
    def reported(**changes: Any) -> list[tuple[str, Any]]:
        return [(spec.code, values) for spec, values in gates.warnings_for(candidate(**changes))]

    assert reported(source="none") == [("focal-length-estimated", {})]
    counts = candidate(agreeing=in_quarter(0, 2)).quadrant_counts
    assert counts[0] == 2
    assert max(counts) > 20
    [(code, values)] = reported(agreeing=in_quarter(0, 2))
    assert (code, values["n_most"], values["n_least"]) == ("ties-crowded", max(counts), 2)
    assert max(candidate(agreeing=in_quarter(0, 3)).quadrant_counts) <= 30
    assert reported(agreeing=in_quarter(0, 3)) == []
    ratio = candidate().hull_ratio
    assert reported(params=params(min_hull_ratio=ratio / 1.51)) == []
    covers = reported(params=params(min_hull_ratio=ratio / 1.49))
    assert covers == [("control-covers-little", {"share": ratio})]
    assert (gates.too_few(8) == "", gates.too_few(7) == "") == (True, False)
    nowhere = candidate(error=None)
    assert nowhere.hull_ratio == 0.0
    assert math.isinf(nowhere.search_radius_px)


@pytest.mark.parametrize(("n_agree", "is_enough"), [(40, True), (39, False)])
def test_one_tie_in_twenty_five_must_agree(n_agree: int, is_enough: bool) -> None:
    every = np.arange(1000)
    seen = candidate().seen.take(every % N_TIES)
    changes = {"seen": seen, "is_check": every % 5 == 0, "walls": np.zeros(1000, dtype=np.int32)}
    found = gated(gates.CONTROL_GATES[:2], agreeing=every < n_agree, **changes)
    assert (found != "share") == is_enough


def test_wrong_ties_gather_on_a_quarter_of_what_has_texture() -> None:
    # All six residuals are within a fifth of the limit, 30 px; the whole photo was searched.
    agrees, lengths = six_agree(0.01)
    radius_px = 0.2 * 3.0 * 0.5 / 0.01
    # The ties are on a grid of 10 x 10, whose hull is 0.9 x 0.9 of the photo.
    scale = math.sqrt(4.0 * math.pi * radius_px**2 / BY_CHANCE / (900.0 * 720.0))
    for factor, is_fine in ((1.02, True), (0.98, False)):
        pixels = (500.0, 400.0) + factor * scale * (grid() - (500.0, 400.0))
        found = gated(gates.CONTROL_GATES[2:3], agreeing=agrees, normalised=lengths, pixels=pixels)
        assert (found is None) == is_fine


def test_the_area_of_a_hull_is_that_of_its_polygon() -> None:
    # Points in a triangle, including its corners.
    corners = np.array([[0.0, 0.0], [20.0, 5.0], [4.0, 30.0]])
    inside = np.random.default_rng(0).dirichlet(np.ones(3), 60) @ corners
    assert gates.hull_area(np.vstack([inside, corners])) == pytest.approx(0.5 * (20 * 30 - 5 * 4))
    for flat in (np.outer(np.arange(5.0), [2.0, 3.0]), corners[:2], np.empty((0, 2))):
        assert gates.hull_area(flat) == 0.0


def centres(shape: tuple[int, int], half_m: tuple[float, float]) -> NDArray[np.float64]:
    """Return cell centres (rows, cols, 2) of a grid, metres right of and below its middle."""
    down, right = (
        half * (2.0 * (np.arange(n) + 0.5) / n - 1.0)
        for n, half in zip(shape, half_m[::-1], strict=True)
    )
    return np.stack(np.meshgrid(right, down), axis=-1)


def error_of(sigmas_m: tuple[float, float, float], half_m: tuple[float, float]) -> gates.WallError:
    found = gates.wall_error(posed(sigmas_m), [wall(half_m)])
    assert found is not None
    return found


def test_a_camera_that_may_stand_aside_shows_the_wall_as_much_aside() -> None:
    found = error_of((0.003, 0.004, 0.0), (1.0, 0.5))
    # RMS of both coordinates.
    expected = math.sqrt(0.5 * (0.003**2 + 0.004**2))
    np.testing.assert_allclose(found.sigmas_m, expected, rtol=1e-6)
    assert (found.rms_m, found.worst_m) == pytest.approx((expected, expected))
    # The photo covers 4 m x 3 m of the plane, so its corners do not show the wall of 2 m x 1 m.
    assert np.isnan(found.corners_m).all()
    assert len(found.footprint_px) == len(found.sigmas_m) == 15 * 15
    pixels = SIZE_PX / np.array([2.0, 2.0]) + 200.0 * centres((15, 15), (1.0, 0.5)).reshape(-1, 2)
    np.testing.assert_allclose(found.footprint_px, pixels, atol=1e-6)


def test_a_camera_that_may_stand_nearer_is_worst_far_from_the_middle() -> None:
    nearer = (0.0, 0.0, 0.006)
    grid = gates.sigmas_on_wall(posed(nearer), wall(), (4, 6))
    aside = np.linalg.norm(centres((4, 6), (1.0, 0.5)), axis=2)
    np.testing.assert_allclose(grid, 0.006 * aside / DISTANCE_M / math.sqrt(2.0), rtol=1e-6)
    # Corners of the photo are included where they show a wall: 2 m and 1.5 m from the middle, minus
    # half a pixel.
    for half_m in ((1.0, 0.5), (2.5, 1.3), (1.7, 2.0)):
        found = error_of(nearer, half_m)
        assert np.isnan(found.corners_m).all()
        assert found.rms_m == pytest.approx(float(np.sqrt(np.mean(found.sigmas_m**2))))
        assert found.worst_m == pytest.approx(float(found.sigmas_m.max()))
    found = error_of(nearer, (2.5, 2.0))
    aside = math.hypot(399.5, 299.5) / 600.0 * DISTANCE_M
    expected = 0.006 * aside / DISTANCE_M / math.sqrt(2.0)
    np.testing.assert_allclose(found.corners_m, expected, rtol=1e-6)
    assert found.worst_m == pytest.approx(expected)
    assert found.worst_m > found.sigmas_m.max()


def test_a_photo_that_shows_no_wall_has_no_error() -> None:
    resection = posed((0.001, 0.001, 0.001), camera(turn_deg=180.0))
    assert gates.wall_error(resection, [wall()]) is None
    assert gates.wall_error(resection, []) is None
    assert np.isnan(gates.sigmas_on_wall(resection, wall(), (3, 3))).all()


@pytest.mark.parametrize(("aside_m", "is_shown"), [(29.0, True), (31.0, False)])
def test_places_seen_flatter_than_one_in_ten_are_not_shown(aside_m: float, is_shown: bool) -> None:
    # A cosine of 0.1 corresponds to a ratio of 9.95 to 1.
    corners = np.array([[0, 0, 0.1], [0, 0, -0.1], [0.2, 0, -0.1], [0.2, 0, 0.1]])
    strip = replace(wall(), corners_world=corners + np.array([aside_m - 0.1, 0, 0]))
    sideways = camera(turn_deg=84.0)
    found = gates.wall_error(posed((0.001, 0.001, 0.001), sideways), [strip])
    assert (found is not None) == is_shown


def test_walls_are_as_ties_describe_them_or_through_their_points() -> None:
    rng = np.random.default_rng(2)
    places = rng.uniform(-1.0, 1.0, (40, 2)) * [2.0, 0.5]
    turn = math.radians(30.0)
    along = np.array([math.cos(turn), math.sin(turn), 0.0])
    points = np.array([5.0, 7.0, 1.0]) + places[:, :1] * along + places[:, 1:] * samples.UP
    described = replace(samples.tie_wall(wall().corners_world, 0.004), plane_index=6)
    number = np.repeat([0, 1, 2, -1], [15, 20, 2, 3]).astype(np.int32)
    ties = samples.ties(
        np.zeros((40, 2)),
        points_world=points,
        wall=number,
        sigma_px=np.ones(40),
        sigma_m=np.ones(40),
        walls=(described,),
    )
    first, second = gates.known_walls(ties, np.ones(40, dtype=np.bool_))
    assert (first.index, first.number, first.gsd_m, first.has_side) == (0, 6, 0.004, True)
    np.testing.assert_array_equal(first.corners_world, wall().corners_world)
    np.testing.assert_array_equal(first.normal, [0.0, -1.0, 0.0])
    # Two points do not define a wall; twenty points define their bounding rectangle.
    assert (second.index, second.number, second.gsd_m, second.has_side) == (1, 1, None, False)
    own = points[15:35]
    across = np.cross(along, samples.UP)
    assert abs(second.normal @ across) == pytest.approx(1.0)
    np.testing.assert_allclose((second.corners_world - own[0]) @ across, 0.0, atol=1e-9)
    sides = second.corners_world[[1, 3]] - second.corners_world[0]
    shares = (own - second.corners_world[0]) @ sides.T / (sides**2).sum(axis=1)
    np.testing.assert_allclose(
        [shares.min(axis=0), shares.max(axis=0)], [[0, 0], [1, 1]], atol=1e-9
    )
    # Only the chosen ties are used.
    assert [item.index for item in gates.known_walls(ties, number == 1)] == [1]
