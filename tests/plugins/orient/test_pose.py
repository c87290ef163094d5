"""Lens, ties and pose of a single photo: priors, withheld ties, rejection and refusal."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.orient import photos
from orthoflow_plugins.orient import pose as lenses
from orthoflow_plugins.orient.pnp import estimate_by_opencv

from orthoflow.errors import GeometryError, MethodError
from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.geometry.resection import adjust, misfit
from orthoflow.products import Intrinsics, Photo, Photos, TieRole, Ties
from orthoflow.testing import photographed as ms
from tests import samples
from tests.scenes import SURVEY_SHIFT_M
from tests.tied_photos import SIZE_PX, photo, seen_by, tied

PARAMS = lenses.OrientParams()
CAMERA = ms.camera_before()


@pytest.mark.parametrize("scale", [0.2, 2.9])
def test_the_unit_deviation_is_that_of_normal_vectors(scale: float) -> None:
    rng = np.random.default_rng(3)
    lengths = np.hypot(*rng.normal(0.0, scale, (2, 40_000)))
    assert lenses.unit_deviation(lengths) == pytest.approx(scale, rel=0.02)
    lengths[:15_000] = 1e6
    # With over a third of outliers, it remains plausible.
    assert lenses.unit_deviation(lengths) <= 3.0


def ring(inner: float, outer: float, count: int) -> NDArray[np.float64]:
    """Return lengths of vectors that are uniformly distributed over a ring."""
    shares = (np.arange(count) + 0.5) / count
    return np.sqrt(inner**2 + shares * (outer**2 - inner**2))


def test_a_limit_holds_where_hardly_any_tie_within_it_is_there_by_chance() -> None:
    right = np.full(100, 0.5)
    # Eighty outliers between one and three times the limit imply ten within it, a tenth.
    assert lenses.without_chance(np.append(right, ring(3.6, 10.4, 80)), 3.5) == 3.5
    assert lenses.without_chance(np.append(right, ring(3.6, 10.4, 81)), 3.5) < 3.5
    # Farther or unknown residuals have no effect.
    beyond = np.append(right, [10.6] * 500 + [np.nan] * 500 + [np.inf] * 500)
    assert lenses.without_chance(beyond, 3.5) == 3.5


def test_what_is_expected_of_ties_follows_from_their_scale() -> None:
    # A 2 m square has 1000 px, so a metre has 500 px.
    rng = np.random.default_rng(5)
    places = rng.uniform(-1.0, 1.0, (4000, 2))
    points = np.column_stack([places[:, 0], np.zeros(4000), places[:, 1]])
    seen = samples.seen(500.0 * places, points, 0.6, 0.002)
    known = replace(seen, sigma_m=np.zeros(4000))
    assert lenses.expected_px(known) == pytest.approx(0.6)
    in_space = np.sqrt(lenses.expected_px(seen) ** 2 - 0.6**2)
    # The median is half a metre for a coordinate and 0.7 of a metre for the larger one of both, so
    # 500 px become 707.
    assert in_space == pytest.approx(0.002 * 500.0 * np.sqrt(2.0), rel=0.03)
    for change, factor in (
        ({"pixels_photo": 3.0 * seen.pixels_photo + 40.0}, 3.0),
        ({"points_world": 2.0 * points + SURVEY_SHIFT_M}, 0.5),
        ({"sigma_m": 5.0 * seen.sigma_m}, 5.0),
    ):
        moved = np.sqrt(lenses.expected_px(replace(seen, **change)) ** 2 - 0.6**2)
        assert moved == pytest.approx(factor * in_space, rel=1e-6)


@pytest.mark.parametrize(
    ("off", "n_ties", "is_contradicted"),
    [
        *((0.025, 200, False), (0.036, 200, True), (-0.036, 200, True)),
        *((0.10, 25, True), (0.10, 24, False)),
    ],
    ids=str,
)
def test_a_calibration_more_than_three_percent_off_is_of_another_lens(
    off: float, n_ties: int, is_contradicted: bool
) -> None:
    claimed = replace(CAMERA, fx=(1.0 + off) * CAMERA.fx, fy=(1.0 + off) * CAMERA.fy)
    # The sigma is so large that no tie is rejected because of the wrong focal length.
    seen = seen_by(CAMERA, n_ties, sigma_px=6.0)
    found = lenses.estimate_pose(tied(photo(claimed), seen), PARAMS)
    assert isinstance(found, str) == is_contradicted
    if isinstance(found, str):
        # The reason contains the focal length from the ties.
        by_ties = float(found.split("focal length of ")[1].split(" px")[0])
        assert by_ties == pytest.approx(CAMERA.fx, rel=0.01)


@pytest.mark.parametrize(
    ("off", "n_ties", "n_wrong", "error_px", "is_contradicted"),
    [
        *((0.14, 200, 0, 0.3, False), (0.18, 200, 0, 0.3, True)),
        # With large errors, nearly as many ties agree with EXIF.
        (0.2, 200, 0, 6.0, False),
        # At least 25 ties must agree.
        *((0.3, 60, 34, 0.3, False), (0.3, 60, 10, 0.3, True)),
    ],
)
def test_exif_is_contradicted_by_many_more_ties_with_another_focal_length(
    off: float, n_ties: int, n_wrong: int, error_px: float, is_contradicted: bool
) -> None:
    deep: dict[str, Any] = {"noise_px": error_px, "sigma_px": error_px, "depths_m": (-1.2, 1.2)}
    seen, rng = seen_by(CAMERA, n_ties, **deep), np.random.default_rng(1)
    seen.pixels_photo[:n_wrong] = rng.uniform([0.0, 0.0], SIZE_PX, (n_wrong, 2))
    of = tied(photo(exif_focal_px=(1.0 + off) * CAMERA.fx), seen)
    found = lenses.focal_without_exif(of, PARAMS)
    assert found == (pytest.approx(CAMERA.fx, rel=0.01) if is_contradicted else None)


def test_exif_is_not_contradicted_by_waves_of_a_wall() -> None:
    """Of 60 draws, these look most like another lens, with an uncertain focal length."""
    rng, seen = (
        np.random.default_rng(40),
        seen_by(CAMERA, 30, seed=40, noise_px=0.5, depths_m=(-0.02, 0.02)),
    )
    turn = seen.points_world @ rng.normal(0.0, 1.5, (3, 3)) + rng.uniform(0.0, 6.0, 3)
    waving = replace(seen, points_world=seen.points_world + 0.01 * np.cos(turn))
    assert lenses.focal_without_exif(tied(photo(exif_focal_px=CAMERA.fx), waving), PARAMS) is None


def test_opencv_refuses_a_lens_with_skew() -> None:
    """solvePnP cannot model skew."""
    of = tied(photo(replace(CAMERA, skew=2.5)), seen_by(CAMERA, 40))
    assert isinstance(estimate_by_opencv(of, PARAMS), str)


def test_withheld_ties_have_no_say_in_the_start_and_four_places_make_none() -> None:
    seen = seen_by(CAMERA, 60)
    is_check = np.arange(60) % 2 == 0
    wrong = replace(seen, pixels_photo=np.where(is_check[:, None], 10.0, seen.pixels_photo))
    start = lenses.robust_start(tied(photo(CAMERA), wrong, is_check=is_check), PARAMS)
    assert start is not None
    np.testing.assert_array_equal(start.agreeing, ~is_check)
    assert start.lens.source == "calibration"
    np.testing.assert_allclose(start.camera.centre_world, CAMERA.centre_world, atol=1e-3)
    withheld = tied(photo(CAMERA), seen, is_check=np.ones(60, dtype=np.bool_))
    assert lenses.robust_start(withheld, PARAMS) is None
    for n_places in (4, 5):
        places = seen.take(np.arange(40) % n_places)
        start = lenses.robust_start(tied(photo(CAMERA), places), PARAMS)
        assert (start is not None) == (n_places == 5)


@pytest.mark.parametrize("times", [0.5, 2.0])
def test_ties_are_rejected_by_what_they_deviate_and_not_by_what_they_say(times: float) -> None:
    # The sigma of each tie is half a pixel, but errors are `times` as large; a tenth of the ties is
    # wrong.
    seen = seen_by(CAMERA, 300, noise_px=0.5 * times, seed=3)
    wrong = np.arange(300) % 10 == 0
    pixels = seen.pixels_photo + wrong[:, None] * np.array([0.5 * times * 6.5, 0.0])
    is_check = np.arange(300) % 4 == 0
    spoilt = replace(seen, pixels_photo=pixels)
    found = lenses.estimate_pose(tied(photo(CAMERA), spoilt, is_check=is_check), PARAMS)
    assert isinstance(found, lenses.Estimate)
    assert found.limit == pytest.approx(3.5 * times, rel=0.2)
    assert found.agreeing[~wrong].mean() > 0.98
    assert found.agreeing[wrong].mean() < 0.2
    np.testing.assert_array_equal(found.agreeing, found.fit.normalised <= found.limit)


CALIBRATED = Intrinsics(
    width=600, height=400, fx=510.0, fy=512.0, cx=303.0, cy=197.0,
    distortion=(-0.1, 0.02, 1e-4, 2e-4, 0.0),
)  # fmt: skip
OF_EXIF = [0.05, 1e-3, 6.0, 6.0, 0.1, 0.1, 1e-3, 1e-3]
FREE = ("focal", "aspect", "cx", "cy", "k1", "k2", "p1", "p2")


def lens_photo(name: str = "a.jpg", size: tuple[int, int] = (600, 400), **known: Any) -> Photo:
    return Photo(name=name, encoded=b"", width=size[0], height=size[1], **known)


def oriented(*focal_px: float) -> list[ViewingCamera]:
    return [replace(CAMERA, fx=focal, fy=focal) for focal in focal_px]


@pytest.mark.parametrize(
    ("exif_px", "size", "focals_px"),
    [
        (500.0, (600, 400), [500.0, 470.0, 530.0]),
        (None, (600, 400), [360.0, 450.0, 570.0, 720.0, 960.0, 1320.0]),
        (None, (400, 600), [360.0, 450.0, 570.0, 720.0, 960.0, 1320.0]),
    ],
)
def test_exif_is_believed_to_a_twentieth_and_without_it_lenses_from_wide_to_long_are_tried(
    exif_px: float | None, size: tuple[int, int], focals_px: list[float]
) -> None:
    prior = lenses.lens_prior(lens_photo(size=size, exif_focal_px=exif_px))
    guesses = (prior.prior, *prior.guesses)
    assert [guess.fx for guess in guesses] == pytest.approx(focals_px)
    assert {(g.fy / g.fx, g.cx, g.cy, g.distortion.any()) for g in guesses} == {
        (1.0, size[0] / 2, size[1] / 2, False)
    }
    assert prior.source == ("none" if exif_px is None else "exif")
    assert prior.freedom.names == FREE
    # The sigma of the principal point is a hundredth of the longer side.
    assert prior.freedom.sigmas.tolist() == [0.35 if exif_px is None else 0.05, *OF_EXIF[1:]]


@pytest.mark.parametrize(
    ("sharing", "lens_of", "apart"),
    [
        ("per-photo", (0, 1, 2, 3, 4, 5), (0, 1, 2, 3, 4, 5)),
        ("shared", (0, 0, 0, 0, 0, 1), (0, 0, 0, 0, 1, 2)),
        # There are two photos with one focal length, one with another, two without any, and one of
        # another size.
        ("focal-group", (0, 0, 1, 2, 2, 3), (0, 0, 1, 2, 3, 4)),
    ],
)
def test_photos_share_a_lens_by_size_and_known_focal_length(
    sharing: lenses.Sharing, lens_of: tuple[int, ...], apart: tuple[int, ...]
) -> None:
    focals_px = (500.0, 500.0, 4.0, None, None, 500.0)
    photos = [
        lens_photo(name, exif_focal_px=focal_px)
        for name, focal_px in zip("abcdef", focals_px, strict=True)
    ]
    photos[5] = replace(photos[5], width=400, height=600)
    for some, expected in ((set(), lens_of), ({4}, apart)):
        found = lenses.lens_groups(photos, oriented(*[500.0] * 6), sharing, some)
        assert (found[0], len(found[1])) == (expected, max(expected) + 1)


def test_of_photos_that_share_a_lens_the_best_known_one_tells_it() -> None:
    known = ({}, {"exif_focal_px": 520.0}, {"intrinsics": CALIBRATED})
    photos = [lens_photo(name, **of) for name, of in zip("abc", known, strict=True)]
    cameras = oriented(480.0, 500.0, 510.0)
    for n_photos, source, focal_px, sigmas in (
        (3, "calibration", 510.0, []),
        (2, "exif", 520.0, OF_EXIF),
    ):
        _, (lens,) = lenses.lens_groups(photos[:n_photos], cameras[:n_photos], "shared")
        assert (lens.source, lens.prior.fx) == (source, focal_px)
        # Calibrated lenses are fixed.
        assert lens.freedom.sigmas.tolist() == sigmas


def test_a_pixel_beyond_what_a_lens_bends_has_no_ray() -> None:
    camera = replace(CAMERA, distortion=np.array([-0.5, 0.0, 0.0, 0.0, 0.0]))
    # With k1 = -0.5, no distorted ray is farther than 0.54 focal lengths from the axis.
    rays = lenses.camera_rays(
        camera,
        np.array([[camera.cx + 0.5 * camera.fx, camera.cy], [camera.cx + camera.fx, camera.cy]]),
    )
    assert np.isfinite(rays[0]).all()
    assert np.isnan(rays[1]).all()


def ties(n: int = 12) -> Ties:
    """Return ties of two photos, alternately, with numbered pixels."""
    at = np.arange(n)
    return samples.ties(
        np.column_stack([at, 10.0 * at]).astype(np.float64),
        photo_names=("a", "b"),
        photo=(at % 2).astype(np.int32),
        points_world=np.zeros((n, 3)),
        sigma_px=0.1 + at,
        sigma_m=0.001 + at,
        role=np.full(n, TieRole.CONTROL, dtype=np.uint8),
    )


def test_what_no_orientation_can_start_from_is_refused() -> None:
    for n_ties, names, reason in (
        (12, "", "there are no photos to orient"),
        (0, "ab", "there are no ties between photos and walls"),
        (12, "a", "the ties refer to photo b, which is not among"),
    ):
        with pytest.raises(MethodError, match=reason):
            photos.require(ties(n_ties), Photos(photos=tuple(map(lens_photo, names))))


def test_ties_are_split_so_that_nothing_by_hand_is_withheld() -> None:
    by_hand = np.zeros(400, dtype=np.uint8)
    by_hand[:40] = 1
    of = replace(ties(400), by_hand=by_hand)
    of.role[[0, 4]], of.role[2] = TieRole.REJECTED, TieRole.CHECK
    params = lenses.OrientParams()
    tied = photos.tied_photo(lens_photo("a"), of, params, np.random.default_rng(1))
    # Ties that matching rejected are not used; its check points are.
    np.testing.assert_array_equal(tied.chosen, [2, *range(6, 400, 2)])
    np.testing.assert_array_equal(tied.by_hand, by_hand[tied.chosen] > 0)
    assert not (tied.is_check & tied.by_hand).any()
    share = tied.is_check.sum() / (~tied.by_hand).sum()
    assert share == pytest.approx(params.check_share, abs=0.1)
    for name in ("pixels_photo", "sigma_px", "sigma_m"):
        np.testing.assert_array_equal(getattr(tied.seen, name), getattr(of, name)[tied.chosen])
    plain = photos.tied_photo(lens_photo("a"), ties(400), params, np.random.default_rng(1))
    assert not plain.by_hand.any()


@pytest.mark.parametrize(("share", "n_check"), [(0.2, 144), (0.25, 180), (0.001, 1), (0.0, 0)])
def test_check_points_are_withheld_evenly(share: float, n_check: int) -> None:
    rng = np.random.default_rng(0)
    # There are twenty ties in each of six by six cells.
    corner = np.stack(np.meshgrid(np.arange(6), np.arange(6)), axis=-1).reshape(-1, 1, 2)
    pixels = (100.0 * (corner + rng.random((36, 20, 2)))).reshape(-1, 2)
    chosen = photos.withheld(pixels, (600, 600), share, rng)
    assert chosen.sum() == n_check
    counts = np.bincount(lenses.image_cells(pixels[chosen], (600, 600), 6), minlength=36)
    assert np.abs(counts - share * 20).max() <= 1.0
    # They are chosen at random.
    other = photos.withheld(pixels, (600, 600), share, rng)
    assert n_check == 0 or (other != chosen).any()
    assert photos.withheld(pixels[:0], (600, 600), 0.5, rng).shape == (0,)


def test_a_point_beside_the_projection_centre_agrees_with_nothing() -> None:
    ahead = CAMERA.rotation[2]
    # The points are 2 mm and 2 m in front of the camera, with a sigma of 3 mm, so the first may be
    # anywhere in the image.
    points = CAMERA.centre_world + np.array([[0.002], [2.0]]) * ahead
    seen = samples.seen(CAMERA.project(points)[:, :2] + [1.0, 0.0], points, 0.5, 0.003)
    near, far = misfit(seen, CAMERA).normalised
    assert np.isinf(near)
    assert 0.5 < far < 1.5


def test_a_soft_limit_bears_outliers() -> None:
    seen = seen_by(CAMERA, 120, noise_px=0.3, sigma_px=0.3)
    seen.pixels_photo[:12] += 40.0
    soft, hard = (
        np.linalg.norm(adjust(seen, CAMERA, **limit).camera.centre_world - CAMERA.centre_world)
        for limit in ({"soft_limit": 2.0}, {})
    )
    assert soft < 0.25 * hard


def test_too_few_points_and_a_start_that_looks_away_are_refused() -> None:
    with pytest.raises(GeometryError, match=r"needs at least 4 points, got 3"):
        adjust(seen_by(CAMERA, 3), CAMERA)
    adjust(seen_by(CAMERA, 4), CAMERA)
    turned = ms.nudged(CAMERA, (0.0, np.pi, 0.0, 0.0, 0.0, 0.0))
    with pytest.raises(GeometryError, match=r"does not see the points"):
        adjust(seen_by(CAMERA, 120), turned)
