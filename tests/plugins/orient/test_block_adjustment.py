"""How photos and lenses are adjusted together: what a round starts from, rejects and weighs."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.orient import block_adjustment
from orthoflow_plugins.orient.block import (
    Block,
    BlockCovariance,
    Lens,
    Observations,
    Points,
    _places,
)
from orthoflow_plugins.orient.block_adjustment import _State
from orthoflow_plugins.orient.lenses import LensGroups
from orthoflow_plugins.orient.photo_ties import PhotoTies

from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.geometry.lenses import LensFreedom
from orthoflow.geometry.resection import SeenPoints
from tests import block_scenes as bs

FREE = LensFreedom(focal_sigma=0.02)
MIDDLE = np.array([1.5, 0.0, 1.0])


def on_wall(n: int, seed: int = 0) -> NDArray[np.float64]:
    return np.random.default_rng(seed).uniform([0.9, -0.1, 0.6], [1.9, 0.1, 1.4], (n, 3))


def seen(camera: ViewingCamera, points: NDArray[np.float64], **sigmas: float) -> SeenPoints:
    return SeenPoints(
        pixels_photo=camera.project(points)[:, :2],
        points_world=points,
        sigma_px=np.full(len(points), sigmas.get("px", 0.5)),
        sigma_m=np.full(len(points), sigmas.get("m", 0.001)),
    )


def trusted(camera: ViewingCamera, of: SeenPoints, sigma0: float = 1.0, **more: Any) -> Any:
    n = len(of)
    nothing = np.zeros(n, dtype=np.bool_)
    return SimpleNamespace(
        tied=SimpleNamespace(
            seen=of,
            is_check=more.get("is_check", nothing),
            rule=SimpleNamespace(rejection_sigma=3.5),
        ),
        estimate=SimpleNamespace(
            agreeing=more.get("agreeing", ~nothing),
            resection=SimpleNamespace(camera=camera, sigma0=sigma0),
        ),
    )


def between(
    cameras: tuple[ViewingCamera, ...], points: NDArray[np.float64], scale: float = 1.0
) -> PhotoTies:
    """Each point seen by all cameras."""
    n, k = len(points), len(cameras)
    return PhotoTies(
        photo=np.repeat(np.arange(k), n),
        point=np.tile(np.arange(n), k),
        pixels=np.vstack([camera.project(points)[:, :2] for camera in cameras]),
        scale=np.full(n * k, scale),
        points_world=points,
    )


def lens(camera: ViewingCamera, freedom: LensFreedom = FREE) -> Lens:
    return Lens(prior=camera, freedom=freedom, source="exif")


def state(
    cameras: tuple[ViewingCamera, ...], ties: PhotoTies, counts: list[int], **more: Any
) -> Any:
    usual: dict[str, Any] = {
        "cameras": cameras,
        "tie_points": ties.points_world,
        "agreeing": tuple(np.ones(n, dtype=np.bool_) for n in counts),
        "units": tuple(1.0 for _ in counts),
        "tie_active": np.ones(len(ties.photo), dtype=np.bool_),
        "tie_sigma": 0.5,
    }
    return _State(**{**usual, **more})


def test_each_round_starts_from_photos_with_the_lens_that_they_share() -> None:
    first, second, third = bs.viewers()[:3]
    second = replace(second, fx=777.0, fy=777.0)
    own = replace(third, fx=888.0, fy=888.0)
    of = [seen(camera, on_wall(12)) for camera in (first, second, own)]
    is_check = np.arange(12) < 3
    agreeing = np.arange(12) != 5
    photos = [
        trusted(first, of[0], 0.05),
        trusted(second, of[1], 2.0, is_check=is_check, agreeing=agreeing),
        trusted(own, of[2], 0.7),
    ]
    groups = LensGroups(lenses=(lens(first), lens(third, LensFreedom())), lens_of=(0, 0, 1))
    ties = between((first, second), on_wall(7, 1))
    begun = block_adjustment._start(photos, ties, groups, MIDDLE)
    # A lens that is free is that of the first photo that has it, a fixed one what it is known as.
    assert [camera.fx for camera in begun.cameras] == [first.fx, first.fx, third.fx]
    for camera, of_photo in zip(begun.cameras, (first, second, third), strict=True):
        np.testing.assert_allclose(camera.centre_world, of_photo.centre_world - MIDDLE, atol=1e-9)
        np.testing.assert_array_equal(camera.rotation, of_photo.rotation)
    np.testing.assert_array_equal(begun.tie_points, ties.points_world - MIDDLE)
    np.testing.assert_array_equal(begun.agreeing[1], agreeing & ~is_check)
    # No photo's ties are better than a tenth of what they say.
    assert begun.units == (0.1, 2.0, 0.7)
    assert begun.tie_active.all()
    assert begun.tie_sigma == 0.5


def test_ties_at_one_place_of_the_wall_are_one_point_as_uncertain_as_the_worst() -> None:
    first, second = (camera.shifted(MIDDLE) for camera in bs.viewers()[:2])
    points = on_wall(5).round(6)
    # The second sees the last two of the first's points, rounded otherwise, and two of its own.
    others = np.vstack([points[3:] + 2e-7, on_wall(2, 7)])
    of = [
        seen(bs.viewers()[0], points, m=0.001, px=0.5),
        seen(bs.viewers()[1], others, m=0.002, px=0.4),
    ]
    photos = [trusted(camera, each) for camera, each in zip((first, second), of, strict=True)]
    ties = between(bs.viewers()[:2], on_wall(3, 9), scale=2.0)
    active = np.array([True, True, False, True, True, True])
    now = state((first, second), ties, [5, 4], units=(3.0, 0.5), tie_active=active, tie_sigma=0.8)
    now.agreeing[0][0] = False
    groups = LensGroups(lenses=(lens(first),), lens_of=(0, 0))
    block = block_adjustment._block(photos, ties, groups, now, MIDDLE)
    # Four points of the first, of which two are shared, two more, and three between photos.
    assert len(block.points) == 6 + 3
    of_scan = block.seen.point < 6
    np.testing.assert_array_equal(block.seen.photo[of_scan], [0] * 4 + [1] * 4)
    world = np.vstack([points[1:], others])
    at = block.points.known[block.seen.point[of_scan]] + MIDDLE
    np.testing.assert_allclose(at, world, atol=3e-7)
    counts = np.bincount(block.seen.point)
    assert sorted(counts[:6].tolist()) == [1, 1, 1, 1, 2, 2]
    sigma_of = block.points.sigma_m[block.seen.point[of_scan]]
    np.testing.assert_allclose(sigma_of, [0.003] * 2 + [0.003] * 2 + [0.003] * 2 + [0.001] * 2)
    np.testing.assert_allclose(block.seen.sigma_px[of_scan], [1.5] * 4 + [0.2] * 4)
    np.testing.assert_array_equal(block.seen.pixels[of_scan][:4], of[0].pixels_photo[1:])
    # Ties between photos: none that is not active, their points known from nowhere.
    np.testing.assert_array_equal(block.seen.point[~of_scan] - 6, ties.point[active])
    np.testing.assert_array_equal(block.seen.photo[~of_scan], ties.photo[active])
    np.testing.assert_array_equal(block.seen.pixels[~of_scan], ties.pixels[active])
    np.testing.assert_allclose(block.seen.sigma_px[~of_scan], 1.6)
    assert np.isinf(block.points.sigma_m[6:]).all()
    np.testing.assert_array_equal(block.points.now, block.points.known)


def block_of(cameras: tuple[ViewingCamera, ...], points: NDArray[np.float64]) -> Block:
    """A block whose last points are those between photos; two of the scan are before them."""
    every = np.vstack([on_wall(2, 5), points])
    nothing = np.zeros(0, dtype=np.intp)
    return Block(
        cameras=cameras,
        lens_of=(0,) * len(cameras),
        lenses=(lens(cameras[0]),),
        points=Points(now=every, known=every, sigma_m=np.full(len(every), np.inf)),
        seen=Observations(
            photo=nothing, point=nothing, pixels=np.zeros((0, 2)), sigma_px=np.zeros(0)
        ),
    )


def test_residuals_between_photos_are_lengths_and_endless_behind_a_camera() -> None:
    cameras = bs.viewers()[:2]
    points = on_wall(4, 3)
    ties = between(cameras, points)
    ties.pixels[2] += [3.0, 4.0]
    points[3] = cameras[1].centre_world - 2.0 * cameras[1].rotation[2]
    found = block_adjustment._tie_residuals(ties, block_of(cameras, points))
    np.testing.assert_allclose(found[[0, 1, 2, 4, 5, 6]], [0, 0, 5, 0, 0, 0], atol=1e-9)
    assert np.isinf(found[7])


def test_a_point_that_one_photo_alone_still_sees_ties_nothing() -> None:
    point = np.array([0, 1, 2, 0, 1, 2, 2])
    active = np.array([True, True, True, True, False, True, False])
    kept = block_adjustment._in_several(point, active)
    assert kept.tolist() == [True, False, True, True, False, True, False]


@pytest.mark.parametrize("noise_px", [0.05, 0.4, 1.5, 9.0])
@pytest.mark.parametrize("n_photos", [2, 3])
def test_ties_between_photos_are_as_exact_as_their_residuals_say(
    noise_px: float, n_photos: int
) -> None:
    cameras = bs.viewers()[:n_photos]
    scale = 2.0
    points = on_wall(600, 3)
    ties = between(cameras, points, scale)
    # What is left when each point was fitted: of 2 m coordinates three less.
    left = (2 * n_photos - 3) / (2 * n_photos)
    rng = np.random.default_rng(4)
    ties.pixels[:] += scale * noise_px * math.sqrt(left) * rng.normal(size=ties.pixels.shape)
    ties.pixels[:2] += 5_000.0
    of = [seen(camera, on_wall(30)) for camera in cameras]
    is_check = np.arange(30) % 3 == 0
    photos = [
        trusted(camera, each, is_check=is_check) for camera, each in zip(cameras, of, strict=True)
    ]
    lengths = np.abs(np.random.default_rng(6).normal(0.0, 1.0, 30))
    lengths[4] = 30.0
    fits: list[Any] = [SimpleNamespace(normalised=lengths) for _ in cameras]
    before = state(cameras, ties, [30] * n_photos)
    block = block_of(cameras, points)
    after, limits = block_adjustment._weighed(photos, ties, block, fits, before)
    assert after.tie_sigma == pytest.approx(min(max(noise_px, 0.1), 2.0), rel=0.08)
    np.testing.assert_array_equal(after.tie_points, points)
    assert after.cameras == block.cameras
    # Two points lost one photo: with two photos nothing of them is left.
    off = block_adjustment._tie_residuals(ties, block) / scale
    is_near = off <= 3.5 * after.tie_sigma
    np.testing.assert_array_equal(
        after.tie_active, block_adjustment._in_several(ties.point, is_near)
    )
    assert not after.tie_active[:2].any()
    unit = float(np.median(lengths)) / 1.1774
    assert after.units == pytest.approx([unit] * n_photos, rel=1e-3)
    assert limits == pytest.approx([3.5 * unit] * n_photos, rel=1e-3)
    for agreeing in after.agreeing:
        np.testing.assert_array_equal(agreeing, (lengths <= 3.5 * unit) & ~is_check)
    # Without any there is nothing to weigh.
    none = replace(before, tie_active=np.zeros(len(ties.photo), dtype=np.bool_), tie_sigma=0.7)
    still, _ = block_adjustment._weighed(photos, ties, block, fits, none)
    assert (still.tie_sigma, still.tie_active.any()) == (0.7, False)


def test_rounds_are_the_same_where_the_same_ties_count() -> None:
    cameras = bs.viewers()[:2]
    ties = between(cameras, on_wall(3))
    one, other = (state(cameras, ties, [4, 4], tie_sigma=sigma) for sigma in (0.5, 0.9))
    assert block_adjustment._same(one, other)
    other.agreeing[1][2] = False
    assert not block_adjustment._same(one, other)
    one.agreeing[1][2] = False
    other.tie_active[0] = False
    assert not block_adjustment._same(one, other)


@pytest.mark.parametrize("unit", [1.0, 0.4])
def test_a_photo_takes_its_part_of_the_covariance_into_the_world(unit: float) -> None:
    cameras = bs.viewers()[:2]
    block = block_of(cameras, on_wall(2))
    rng = np.random.default_rng(2)
    half = rng.normal(size=(13, 13))
    cofactors = half @ half.T + np.eye(13)
    covariance = BlockCovariance(
        matrix=1.44 * cofactors, cofactors=cofactors, sigma0=1.2, redundancy=9.0
    )
    of = seen(cameras[1].shifted(-MIDDLE), on_wall(6) + MIDDLE)
    item = trusted(cameras[1], of)
    item.estimate = block_adjustment.Estimate(
        resection=item.estimate.resection,
        intrinsics=None,  # type: ignore[arg-type]
        source="before",
        fit=None,  # type: ignore[arg-type]
        agreeing=np.zeros(6, dtype=np.bool_),
        limit=0.0,
    )
    fit: Any = SimpleNamespace(normalised=np.array([0.0, 1.0, 2.0, 3.0, 4.0, np.nan]))
    now = state(cameras, between(cameras, on_wall(1)), [6, 6], units=(9.0, unit))
    found = block_adjustment._estimate(1, item, block, (covariance, MIDDLE), (fit, now, 3.0))
    resection = found.resection
    np.testing.assert_allclose(
        resection.camera.centre_world, cameras[1].centre_world + MIDDLE, atol=1e-9
    )
    assert resection.sigma0 == pytest.approx(1.2 * unit)
    assert resection.variance_factor == pytest.approx(1.44 * unit**2)
    # How well the pixel of a point is known does not change with where the origin is.
    columns = block.columns(1)
    local = replace(
        resection, camera=cameras[1], covariance=covariance.matrix[np.ix_(columns, columns)]
    )
    points = on_wall(5)
    np.testing.assert_allclose(
        block_adjustment_covariances(resection, points + MIDDLE),
        block_adjustment_covariances(local, points),
        rtol=1e-6,
    )
    assert found.agreeing.tolist() == [True, True, True, True, False, False]
    assert (found.limit, found.source) == (3.0, "exif")


def block_adjustment_covariances(
    resection: Any, points: NDArray[np.float64]
) -> NDArray[np.float64]:
    from orthoflow.geometry.resection import predicted_covariances

    return predicted_covariances(resection, points)


def test_places_that_may_err_together_are_as_wide_as_a_fifth_of_a_photo() -> None:
    cameras = bs.viewers()[:2]
    rng = np.random.default_rng(8)
    points = rng.uniform([0.9, 0.0, 0.6], [1.9, 0.0, 1.4], (400, 3))
    block = block_of(cameras, points)
    n = len(block.points)
    photo = np.repeat([0, 1], n)
    block = replace(
        block,
        seen=Observations(
            photo=photo,
            point=np.tile(np.arange(n), 2),
            pixels=np.zeros((2 * n, 2)),
            sigma_px=np.ones(2 * n),
        ),
    )
    groups = _places(block)
    # Both photos' ties of one place are in one group.
    np.testing.assert_array_equal(groups[:n], groups[n:])
    width_m = np.median(
        [
            900.0 / 5.0 / camera.fx * np.median(camera.project(block.points.now)[:, 2])
            for camera in cameras
        ]
    )
    cubes = np.floor(block.points.now / width_m)
    same = (cubes[:, None] == cubes[None]).all(axis=2)
    np.testing.assert_array_equal(groups[:n, None] == groups[None, :n], same)
    assert 4 < len(np.unique(groups)) < 60


@pytest.mark.parametrize(
    ("n_agreeing", "n_rounds"),
    [
        # The first round finds what the second has to confirm.
        ([4, 4, 4, 4, 4], 2),
        ([3, 3, 3, 3, 3], 2),
        ([3, 2, 2, 2, 2], 3),
        ([3, 2, 1, 2, 1], 5),
    ],
)
def test_rounds_go_on_until_the_same_ties_count_and_no_more_than_five(
    monkeypatch: pytest.MonkeyPatch, n_agreeing: list[int], n_rounds: int
) -> None:
    cameras = bs.viewers()[:2]
    of = [seen(camera, on_wall(4, k) + k) for k, camera in enumerate(cameras)]
    photos = [trusted(camera, each) for camera, each in zip(cameras, of, strict=True)]
    ties = between(cameras, on_wall(9, 3))
    ties.pixels[:9] += [3.0, 4.0]
    ties.pixels[9:] -= [3.0, 4.0]
    middle = 0.5 * (of[0].points_world.mean(axis=0) + of[1].points_world.mean(axis=0))
    states = iter(
        state(
            cameras,
            ties,
            [4, 4],
            agreeing=(np.arange(4) < n, np.ones(4, dtype=np.bool_)),
            tie_active=np.arange(18) % 9 > 0,
            tie_sigma=0.1 * (nth + 1),
        )
        for nth, n in enumerate(n_agreeing)
    )
    solved: list[Block] = []

    def solve(block: Block, *, soft_limit: float) -> Block:
        assert soft_limit == 3.0
        solved.append(block)
        still = between(cameras, on_wall(9, 3))
        now = np.vstack([block.points.now[:-9], still.points_world])
        return block.moved(cameras, now)

    monkeypatch.setattr(block_adjustment, "solve", solve)
    monkeypatch.setattr(block_adjustment, "_weighed", lambda *_: (next(states), [3.0, 4.0]))
    monkeypatch.setattr(block_adjustment, "block_covariance", lambda block, soft_limit: soft_limit)
    monkeypatch.setattr(block_adjustment, "_estimate", lambda at, *more: (at, more[-1][-1]))
    groups = LensGroups(lenses=(lens(cameras[0]),), lens_of=(0, 0))
    found = block_adjustment.adjust_block(photos, ties, groups)
    assert len(solved) == n_rounds
    np.testing.assert_allclose(found.middle, middle)
    assert found.estimates == ((0, 3.0), (1, 4.0))
    assert found.covariance == 3.0
    # The last round was solved with what the one before had left.
    assert found.tie_sigma_px == pytest.approx(0.1 * (n_rounds - 1))
    assert (found.n_tie_points, found.n_tie_observations) == (8, 16)
    assert found.tie_rmse_px == pytest.approx(5.0 / math.sqrt(2.0))


def test_without_ties_between_photos_there_is_no_residual(monkeypatch: pytest.MonkeyPatch) -> None:
    cameras = bs.viewers()[:2]
    photos = [trusted(camera, seen(camera, on_wall(8, k))) for k, camera in enumerate(cameras)]
    monkeypatch.setattr(block_adjustment, "solve", lambda block, soft_limit: block)
    monkeypatch.setattr(block_adjustment, "block_covariance", lambda *_, **__: None)
    monkeypatch.setattr(block_adjustment, "_estimate", lambda *_: None)
    groups = LensGroups(lenses=(lens(cameras[0]),), lens_of=(0, 0))
    found = block_adjustment.adjust_block(photos, between(cameras, np.empty((0, 3))), groups)
    assert math.isnan(found.tie_sigma_px)
    assert math.isnan(found.tie_rmse_px)
    assert (found.n_tie_points, found.n_tie_observations) == (0, 0)
