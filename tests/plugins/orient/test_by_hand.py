"""Ties that a person measured: six orient a photo as well as they say, a wrong one never does."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.orient import by_hand
from orthoflow_plugins.orient.bundle import OrientColmapBundle
from orthoflow_plugins.orient.dlt import OrientDlt
from orthoflow_plugins.orient.pnp import OrientPnp

from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.geometry.lenses import LensFreedom
from orthoflow.geometry.resection import Resection, SeenPoints
from orthoflow.geometry.rotations import rotation_from_vector
from orthoflow.products import Camera, Cameras, Intrinsics, Photos, TieRole, Ties, TieWall
from orthoflow.sdk import StepContext
from orthoflow.testing import photographed as ms
from tests import samples
from tests.plugins.orient.test_pnp import PIXEL, known_ties

SCENE = ms.textured_wall(0)
CAMERA = ms.camera_before(SCENE, centre=(1.3, -2.6, 1.1))
SIGMA_PX = 1.0
# Two rows of clicks as a person spreads them, in shares of the photo; the points lie on a relief.
SPREAD = ((0.12, 0.15), (0.5, 0.12), (0.88, 0.16), (0.13, 0.86), (0.52, 0.88), (0.87, 0.84))
MORE = ((0.3, 0.5), (0.7, 0.45))


def clicked(
    seed: int,
    *,
    n: int = 6,
    blunder: NDArray[np.float64] | None = None,
    places: tuple[tuple[float, float], ...] = (),
) -> Ties:
    """Ties that a person measured with the noise that is stated, the last one off by a blunder."""
    rng = np.random.default_rng(seed)
    shares = np.array(places or (*SPREAD, *MORE)[:n])
    n = len(shares)
    pixels = (shares + rng.uniform(-0.03, 0.03, (n, 2))) * [CAMERA.width, CAMERA.height]
    # The wall point behind a pixel: along the ray to the plane, then onto the relief.
    rays = CAMERA.rays_world(pixels)
    points = CAMERA.centre_world + rays * (-CAMERA.centre_world[1] / rays[:, 1:2])
    cells = SCENE.frame.wall_from_world(points)[:, :2]
    depth = SCENE.depth_m(cells[:, 0] * ms.GSD_M, cells[:, 1] * ms.GSD_M)
    points = SCENE.frame.world_from_wall(cells, depth)
    pixels = CAMERA.project(points)[:, :2] + rng.normal(0.0, SIGMA_PX, (n, 2))
    if blunder is not None:
        pixels[-1] += blunder
    return samples.ties(
        pixels,
        points_world=points,
        sigma_px=np.full(n, SIGMA_PX),
        sigma_m=np.full(n, 1e-4),
        by_hand=np.ones(n, np.uint8),
        walls=(
            TieWall(
                gsd_m=ms.GSD_M,
                normal_world=(0.0, -1.0, 0.0),
                corners_world=tuple(map(tuple, SCENE.frame.corners_world().tolist())),
            ),
        ),
    )


def joined(first: Ties, second: Ties) -> Ties:
    arrays = ("photo", "wall", "pixels_photo", "points_world", "sigma_px", "sigma_m", "role")
    by_hand = [
        np.zeros(len(ties.photo), np.uint8) if ties.by_hand is None else ties.by_hand
        for ties in (first, second)
    ]
    return replace(
        first,
        by_hand=np.concatenate(by_hand),
        residual_px=np.concatenate([first.residual_px, second.residual_px]),
        **{name: np.concatenate([getattr(first, name), getattr(second, name)]) for name in arrays},
    )


Orient = Callable[[Ties, Photos], tuple[Cameras, list[str]]]


@pytest.fixture(params=["pnp", "bundle"])
def orient(request: pytest.FixtureRequest, tmp_path: Path) -> Orient:
    method = {"pnp": OrientPnp, "dlt": OrientDlt, "bundle": OrientColmapBundle}[request.param]

    def run(ties: Ties, photos: Photos) -> tuple[Cameras, list[str]]:
        ctx = StepContext(rng=np.random.default_rng(1), cores=1, scratch=tmp_path)
        inputs = method.In(ties=ties, photos=photos)
        return method().run(inputs, method.Params(), ctx).cameras, list(ctx.warnings)

    return run


def calibrated(camera: ViewingCamera = CAMERA) -> Photos:
    return ms.photos(replace(PIXEL, intrinsics=Intrinsics.of(camera)))


def error_share(found: Camera) -> float:
    """Error on the wall over the standard deviation that is stated."""
    assert found.sigma_wall_m is not None
    return ms.wall_error_m(SCENE, found.viewing(), CAMERA) / found.sigma_wall_m


def test_six_ties_orient_a_photo_within_what_their_sigma_says(orient: Orient) -> None:
    shares = []
    for seed in range(8):
        cameras, _ = orient(clicked(seed), calibrated())
        assert cameras.cameras[0].status == "ok", seed
        shares.append(error_share(cameras.cameras[0]))
        assert cameras.ties is not None
        assert (cameras.ties.role == TieRole.CONTROL).all()
    # Of a chi distribution with about as many degrees of freedom, the mean square is near 1.
    assert 0.4 < np.sqrt(np.mean(np.square(shares))) < 1.6
    assert max(shares) < 3.0


@pytest.mark.parametrize("size_px", [15.0, 60.0, 400.0])
def test_a_gross_blunder_among_eight_is_left_out_or_refused(orient: Orient, size_px: float) -> None:
    for seed in range(3):
        angle = seed * 2.1
        blunder = size_px * np.array([np.cos(angle), np.sin(angle)])
        cameras, warnings = orient(clicked(seed, n=8, blunder=blunder), calibrated())
        found = cameras.cameras[0]
        assert cameras.ties is not None
        if found.status == "ok":
            assert error_share(found) < 3.0
            assert cameras.ties.role.tolist() == [0] * 7 + [int(TieRole.REJECTED)]
            assert any("left out of them, as they contradict" in text for text in warnings)
        else:
            assert "measured by hand contradict" in found.status
    # Far off, the blunder is plain.
    assert size_px < 50.0 or found.status == "ok"


def test_a_blunder_among_six_is_refused(orient: Orient) -> None:
    for seed in range(4):
        (found,) = orient(clicked(seed, blunder=np.array([40.0, -30.0])), calibrated())[0].cameras
        assert "its 6 ties measured by hand contradict each other" in found.status


def test_three_blunders_among_fifteen_are_refused(orient: Orient) -> None:
    # Nothing is withheld of them, so that the gates for matched ties could not judge the pose.
    rng = np.random.default_rng(5)
    ties = clicked(2, places=tuple(map(tuple, rng.uniform(0.08, 0.92, (15, 2)))))
    pixels = ties.pixels_photo.copy()
    pixels[:3] += [[60.0, 0.0], [0.0, -80.0], [-50.0, 50.0]]
    (found,) = orient(replace(ties, pixels_photo=pixels), calibrated())[0].cameras
    assert "its 15 ties measured by hand contradict each other by more than" in found.status


def test_ties_that_hang_on_one_of_them_are_refused(orient: Orient) -> None:
    # Five in a corner and one far away: the error that they predict is small, but were that one
    # wrong, the pose without it would be worth little.
    corner = ((0.06, 0.1), (0.2, 0.1), (0.06, 0.3), (0.2, 0.3), (0.13, 0.2))
    hanging = orient(clicked(3, places=(*corner, (0.95, 0.9))), calibrated())[0].cameras[0]
    assert re.match(r"without the tie at \(u 8\d\d, v 5\d\d\) its predicted", hanging.status)
    far = ((0.95, 0.9), (0.9, 0.2))
    held = orient(clicked(3, places=(*corner, *far)), calibrated())[0].cameras[0]
    assert held.status == "ok"


def test_ties_by_hand_join_those_that_matching_found(orient: Orient) -> None:
    matched = known_ties(CAMERA, 5, n=120, wrong_share=0.2)
    alone = orient(clicked(1), calibrated())[0].cameras[0]
    both, _ = orient(joined(matched, clicked(1)), calibrated())
    found = both.cameras[0]
    assert found.status == "ok"
    assert found.sigma_wall_m is not None
    assert alone.sigma_wall_m is not None
    assert found.sigma_wall_m < 0.5 * alone.sigma_wall_m
    assert error_share(found) < 3.0
    assert both.ties is not None
    # Never withheld.
    assert (both.ties.role[-6:] == TieRole.CONTROL).all()
    assert (both.ties.role == TieRole.CHECK).sum() >= 15


def test_ties_by_hand_stand_against_a_repeated_motif(orient: Orient) -> None:
    # Matching took the next window for this one: 120 ties agree with a pose 0.4 m beside.
    beside = known_ties(CAMERA, 5, n=120, shift_m=np.array([0.4, 0.0, 0.0]))
    wrong = orient(beside, calibrated())[0].cameras[0]
    assert wrong.status == "ok"
    assert ms.wall_error_m(SCENE, wrong.viewing(), CAMERA) > 0.2
    cameras, _ = orient(joined(replace(beside, walls=clicked(1).walls), clicked(1)), calibrated())
    assert cameras.cameras[0].status == "ok"
    assert error_share(cameras.cameras[0]) < 3.0


def test_wrong_matches_do_not_harm_a_photo_that_is_tied_by_hand(orient: Orient) -> None:
    garbage = known_ties(CAMERA, 5, n=60, wrong_share=1.0)
    assert orient(garbage, calibrated())[0].cameras[0].status != "ok"
    cameras, _ = orient(joined(garbage, clicked(2)), calibrated())
    assert cameras.cameras[0].status == "ok"
    assert error_share(cameras.cameras[0]) < 3.0


def test_a_focal_length_from_exif_is_refined_by_ties_by_hand(orient: Orient) -> None:
    photos = ms.photos(replace(PIXEL, exif_focal_px=1.02 * CAMERA.fx))
    for seed in range(4):
        (found,) = orient(clicked(seed), photos)[0].cameras
        assert found.status == "ok"
        assert error_share(found) < 3.0
        assert found.intrinsics is not None
        assert found.intrinsics.source == "estimated"


def test_fewer_than_six_are_ordinary_ties(orient: Orient) -> None:
    ties = clicked(1)
    five = replace(
        ties,
        **{
            name: getattr(ties, name)[:5]
            for name in ("photo", "wall", "pixels_photo", "points_world", "sigma_px", "sigma_m")
        },
        role=ties.role[:5],
        residual_px=ties.residual_px[:5],
        by_hand=np.ones(5, np.uint8),
    )
    (found,) = orient(five, calibrated())[0].cameras
    assert "5 ties with the walls, at least 8 are needed" in found.status


# --- which of them fit together ---


def numbered(n: int) -> SeenPoints:
    """Ties that are told apart by their pixels: the k-th in a file is at u = k, v = 10 k."""
    at = np.arange(n, dtype=np.float64)
    return SeenPoints(
        pixels_photo=np.column_stack([at, 10.0 * at]) + 0.5,
        points_world=np.zeros((n, 3)),
        sigma_px=np.ones(n),
        sigma_m=np.zeros(n),
    )


def pose(turn_deg: float, chance: float = 0.5) -> Any:
    rotation = rotation_from_vector(np.radians([turn_deg, 0.0, 0.0]))
    camera = SimpleNamespace(rotation=rotation)
    return SimpleNamespace(resection=SimpleNamespace(camera=camera), chance=chance)


def told(
    monkeypatch: pytest.MonkeyPatch, n: int, fits: dict[tuple[int, ...], list[Any]]
) -> tuple[list[int] | str, list[tuple[int, ...]]]:
    """What is said of some ties, by which poses fit without some of them; and what was asked."""
    asked: list[tuple[int, ...]] = []

    def found(seen: SeenPoints, prior: object) -> Iterator[Any]:
        kept = seen.pixels_photo[:, 0].astype(int).tolist()
        without = tuple(k for k in range(n) if k not in kept)
        asked.append(without)
        yield from fits.get(without, [])

    monkeypatch.setattr(by_hand, "_fits", found)
    prior: Any = None
    verdict = by_hand._consistent(numbered(n), prior)
    return (verdict if isinstance(verdict, str) else verdict[0].tolist()), asked


def test_all_ties_are_kept_where_they_fit_together(monkeypatch: pytest.MonkeyPatch) -> None:
    assert told(monkeypatch, 9, {(): [pose(0.0)]}) == (list(range(9)), [()])
    # One pose that comes out twice is one.
    twice = {(): [pose(0.0), pose(1.9, 0.9), pose(3.5)]}
    assert told(monkeypatch, 9, twice)[0] == list(range(9))


@pytest.mark.parametrize("without", [(), (3,)])
def test_two_poses_are_not_told_apart(
    monkeypatch: pytest.MonkeyPatch, without: tuple[int, ...]
) -> None:
    said, _ = told(monkeypatch, 9, {without: [pose(0.0), pose(2.1)]})
    assert isinstance(said, str)
    assert said.startswith("two poses agree with its ties measured by hand")


@pytest.mark.parametrize("wrong", [(4,), (0,), (2, 6)])
def test_what_is_plainly_wrong_is_left_out(
    monkeypatch: pytest.MonkeyPatch, wrong: tuple[int, ...]
) -> None:
    kept, asked = told(monkeypatch, 8, {wrong: [pose(0.0)]})
    assert kept == [k for k in range(8) if k not in wrong]
    # As few as possible: all that leave out less were asked before.
    assert asked == [some for n in range(len(wrong) + 1) for some in combinations(range(8), n)]


@pytest.mark.parametrize(
    ("fitting", "places"),
    [
        ([(2,), (5,)], "(u 2, v 20), (u 5, v 50)"),
        ([(1, 2), (2, 6)], "(u 1, v 10), (u 2, v 20), (u 6, v 60)"),
    ],
)
def test_what_may_be_wrong_is_named_where_it_is_not_plain(
    monkeypatch: pytest.MonkeyPatch, fitting: list[tuple[int, ...]], places: str
) -> None:
    said, _ = told(monkeypatch, 8, {some: [pose(0.0)] for some in fitting})
    assert said == (
        "its 8 ties measured by hand contradict each other, and it is not plain which is wrong, "
        f"one of {places}: measure them again, or add more"
    )


@pytest.mark.parametrize(
    ("n", "n_most"), [(6, 0), (7, 1), (8, 2), (20, 2), (25, 2), (26, 1), (40, 1)]
)
def test_at_most_two_are_left_out_of_few_and_one_of_many(
    monkeypatch: pytest.MonkeyPatch, n: int, n_most: int
) -> None:
    said, asked = told(monkeypatch, n, {})
    assert isinstance(said, str)
    assert f"leaving out up to {n_most} of them does not help (6 must stay)" in said
    assert asked == [some for k in range(n_most + 1) for some in combinations(range(n), k)]


@pytest.mark.parametrize("turn_deg", [1.9, 2.1, 90.0, 180.0])
def test_poses_are_apart_by_more_than_two_degrees(turn_deg: float) -> None:
    base = rotation_from_vector(np.array([0.3, -1.0, 0.4]))
    for axis in np.eye(3):
        turned = rotation_from_vector(np.radians(turn_deg) * axis) @ base
        cameras: Any = [SimpleNamespace(rotation=each) for each in (base, turned)]
        assert by_hand._are_apart(*cameras) == (turn_deg > 2.0)
    # Rounding does not take the angle from what has a cosine.
    assert not by_hand._are_apart(cameras[0], cameras[0])


def test_of_each_pose_the_likeliest_is_kept() -> None:
    poses = [pose(0.0, 0.2), pose(10.0, 0.4), pose(1.0, 0.9), pose(11.5, 0.3)]
    kept = by_hand._distinct(iter(poses))
    assert [each.chance for each in kept] == [0.9, 0.4]


def resection(sigma0: float, n_lens: int = 0) -> Resection:
    free = LensFreedom(focal_sigma=0.5, k1_sigma=0.25) if n_lens else LensFreedom()
    return Resection(
        camera=CAMERA,
        covariance=sigma0**2 * np.diag(np.arange(1.0, 7.0 + n_lens)),
        sigma0=sigma0,
        variance_factor=sigma0**2,
        lens=free,
    )


@pytest.mark.parametrize(("sigma0", "unit"), [(0.25, 1.0), (1.0, 1.0), (3.0, 3.0)])
def test_small_residuals_do_not_make_a_pose_more_exact_than_its_ties(
    sigma0: float, unit: float
) -> None:
    found = by_hand._as_stated(resection(sigma0))
    np.testing.assert_allclose(found.covariance, unit**2 * np.diag(np.arange(1.0, 7.0)))
    assert (found.sigma0, found.variance_factor) == (unit, unit**2)


def test_a_known_lens_is_observed_as_well() -> None:
    assert by_hand._redundancy(numbered(9), resection(0.5)) == 18 - 6
    # Cofactors 7 and 8 of the lens, by what was known of it.
    expected = 18 - 8 + 7.0 / 0.5**2 + 8.0 / 0.25**2
    assert by_hand._redundancy(numbered(9), resection(0.5, 2)) == pytest.approx(expected)


def by(points: NDArray[np.float64]) -> SeenPoints:
    return SeenPoints(
        pixels_photo=CAMERA.project(points)[:, :2],
        points_world=points,
        sigma_px=np.full(len(points), SIGMA_PX),
        sigma_m=np.full(len(points), 1e-4),
    )


@pytest.mark.parametrize("n", [3, 4, 9])
@pytest.mark.parametrize("relief_m", [0.0, 0.001, 0.02, 0.2])
def test_adjustments_start_from_poses_that_fit(n: int, relief_m: float) -> None:
    rng = np.random.default_rng(2)
    points = rng.uniform([0.9, 0.0, 0.7], [1.8, 1e-9, 1.5], (n, 3))
    points[:, 1] = relief_m * np.where(np.arange(n) % 2 == 0, -1.0, 1.0)
    starts = by_hand._starts(by(points), CAMERA)
    if n < 4:
        assert starts == []
        return
    off = [np.linalg.norm(start.centre_world - CAMERA.centre_world) for start in starts]
    assert min(off) < 0.01
    assert starts[int(np.argmin(off))].fx == CAMERA.fx
    # Of points in a plane, the pose mirrored in it nearly fits as well.
    is_flat = relief_m < 0.01
    assert (len(starts) == 3) == is_flat
    assert is_flat or len(starts) == 1
    # What no ray of the lens shows says nothing.
    if n > 4:
        beyond = by(points)
        beyond.pixels_photo[0] = [1e5, 1e5]
        narrow = replace(CAMERA, distortion=np.array([-0.3, 0.0, 0.0, 0.0, 0.0]))
        assert len(by_hand._starts(beyond, narrow)) >= 1


@pytest.mark.parametrize(("noise_px", "fits"), [(0.0, True), (1.0, True), (6.0, False)])
def test_poses_fit_whose_residuals_are_no_larger_than_chance_makes_them(
    noise_px: float, fits: bool
) -> None:
    from scipy import stats

    rng = np.random.default_rng(2)
    points = rng.uniform([0.9, -0.2, 0.7], [1.8, 0.2, 1.5], (9, 3))
    seen = by(points)
    seen.pixels_photo[:] += noise_px * rng.normal(size=(9, 2))
    prior: Any = SimpleNamespace(
        guesses=[SimpleNamespace(posed=lambda: CAMERA)], freedom=LensFreedom()
    )
    found = list(by_hand._fits(seen, prior))
    assert bool(found) == fits
    for fit in found:
        squares = 12.0 * fit.resection.sigma0**2
        assert fit.chance == pytest.approx(stats.chi2.sf(squares, 12), abs=1e-9)
        assert fit.prior is CAMERA


@pytest.mark.parametrize(("chance", "fits"), [(0.0012, True), (0.0008, False)])
def test_right_ties_are_called_contradictory_once_in_a_thousand_photos(
    chance: float, fits: bool
) -> None:
    from scipy import stats

    rng = np.random.default_rng(2)
    points = rng.uniform([0.9, -0.2, 0.7], [1.8, 0.2, 1.5], (9, 3))
    seen = replace(by(points), sigma_m=np.zeros(9))
    seen.pixels_photo[:] += rng.normal(size=(9, 2))
    prior: Any = SimpleNamespace(
        guesses=[SimpleNamespace(posed=lambda: CAMERA)], freedom=LensFreedom()
    )
    fit = next(iter(by_hand._fits(seen, prior)))
    # With such deviations the same residuals are as large as by chance one time in so many.
    times = fit.resection.sigma0 * np.sqrt(12.0 / stats.chi2.isf(chance, 12))
    found = list(by_hand._fits(replace(seen, sigma_px=times * seen.sigma_px), prior))
    assert bool(found) == fits
    if fits:
        assert found[0].chance == pytest.approx(chance, rel=0.01)


@pytest.mark.parametrize("relief_m", [0.0, 0.0004])
def test_a_small_plate_seen_from_afar_may_be_turned_either_way(relief_m: float) -> None:
    # 12 cm of a plate that stands 35 degrees oblique, from 2.9 m: perspective tells which way
    # it is turned by a quarter of a pixel.
    across, up = (grid.ravel() for grid in np.meshgrid(*[np.linspace(-0.06, 0.06, 3)] * 2))
    relief = relief_m * (np.arange(9) % 2 - 0.5)
    turn = np.deg2rad(35.0)
    along = across * np.cos(turn) - relief * np.sin(turn)
    away = across * np.sin(turn) + relief * np.cos(turn)
    points = np.array([1.3, 0.0, 1.1]) + np.stack([along, away, up], axis=1)
    seen = by(points)
    said = by_hand.pose_by_hand(calibrated().photos[0], seen, np.ones(9, dtype=np.bool_))
    assert isinstance(said, str)
    assert said.startswith("two poses agree with its ties measured by hand")


def test_a_pose_by_hand_knows_what_it_was_found_from() -> None:
    rng = np.random.default_rng(2)
    points = rng.uniform([0.9, -0.2, 0.7], [1.8, 0.2, 1.5], (14, 3))
    seen = by(points)
    seen.pixels_photo[:] += 0.3 * rng.normal(size=(14, 2))
    # Every second one was measured by hand, and the third of these is wrong.
    measured = np.arange(14) % 2 == 0
    hand = np.flatnonzero(measured)
    more = np.concatenate([hand, [1, 3]])
    measured[[1, 3]] = True
    seen.pixels_photo[hand[2]] += [70.0, -50.0]
    photo = calibrated().photos[0]
    found = by_hand.pose_by_hand(photo, seen, measured)
    assert not isinstance(found, str)
    estimate = found.estimate
    agreeing = np.zeros(14, dtype=np.bool_)
    agreeing[np.setdiff1d(more, hand[2])] = True
    np.testing.assert_array_equal(estimate.agreeing, agreeing)
    np.testing.assert_array_equal(found.start.agreeing, agreeing)
    assert (estimate.limit, estimate.source) == (3.5, "calibration")
    assert estimate.notes[0] == "oriented by ties measured by hand alone"
    u, v = seen.pixels_photo[hand[2]] - 0.5
    assert estimate.notes[1].endswith(f"contradict the others: (u {u:.0f}, v {v:.0f})")
    # Without each of them in turn less is known than with all.
    assert len(estimate.without_one) == agreeing.sum()
    sure = np.trace(estimate.resection.covariance)
    worth = [np.trace(each.covariance) for each in estimate.without_one]
    assert min(worth) > sure
    assert len({round(value / sure, 6) for value in worth}) == len(worth)
    assert estimate.fit.normalised.shape == (14,)
    assert found.start.camera is estimate.resection.camera
    nothing_lost = by_hand.pose_by_hand(photo, seen, measured & (np.arange(14) != hand[2]))
    assert not isinstance(nothing_lost, str)
    assert len(nothing_lost.estimate.notes) == 1
