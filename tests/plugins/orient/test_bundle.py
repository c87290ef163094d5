"""Bundle adjustment: never worse than single photos; lenses and predicted errors are correct."""

from __future__ import annotations

import itertools
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace as Fields
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.orient import photo_ties
from orthoflow_plugins.orient.bundle import OrientColmapBundle, adjust_block, of_another_lens
from orthoflow_plugins.orient.photos import (
    Trusted,
    by_itself,
    looked_at,
    refused,
    tied_photo,
    with_believable_priors,
)
from orthoflow_plugins.orient.pnp import OrientPnp
from orthoflow_plugins.orient.pose import (
    UNKNOWN,
    TiedPhoto,
    estimate_pose,
    focal_without_exif,
    lens_groups,
)
from orthoflow_plugins.orient.report import Oriented

from orthoflow.files.images import encode_png
from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.geometry.key_points import Features
from orthoflow.products import Cameras, Intrinsics, Photo, Photos, TieRole, Ties
from orthoflow.testing import photographed as ms
from tests import block_scenes as bs
from tests import samples
from tests import tied_photos as tp
from tests.long_loops import long_only, seeds
from tests.samples import features
from tests.scenes import SURVEY_SHIFT_M
from tests.tied_photos import context

ALONE = {"photo_ties": False}
bundle = partial(tp.oriented, OrientColmapBundle)


def errors_m(cameras: Cameras, shift_m: np.ndarray | float = 0.0) -> np.ndarray:
    pairs = zip(cameras.cameras, bs.viewers(), strict=True)
    return np.array(
        [
            ms.wall_error_m(bs.SCENE, found.viewing().shifted(np.zeros(3) + shift_m), true)
            for found, true in pairs
            if found.status == "ok"
        ]
    )


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def sigmas_m(cameras: Cameras) -> np.ndarray:
    stated = [camera.sigma_wall_m for camera in cameras.cameras if camera.status == "ok"]
    return np.array(stated, dtype=np.float64)


def test_ties_between_photos_make_them_more_exact_and_a_photo_with_random_ones_harms_none(
    tmp_path: Path,
) -> None:
    """The EXIF focal length is 2 % too long."""
    ties, photos = bs.scan_ties(0), bs.photos(calibrated=False)
    pixels, bad = ties.pixels_photo.copy(), ties.photo == 3
    pixels[bad] = np.random.default_rng(0).uniform([0, 0], [900, 640], (bad.sum(), 2))
    spoilt = replace(ties, pixels_photo=pixels)
    single = tp.oriented(OrientPnp, spoilt, photos, context(tmp_path))
    together = bundle(spoilt, photos, context(tmp_path), max_features=700)
    for cameras in (single, together):
        assert [camera.status == "ok" for camera in cameras.cameras] == [True] * 3 + [False]
    # Measured: 0.2 mm instead of 0.6 mm.
    errors = errors_m(together)
    assert rms(errors) < 0.75 * rms(errors_m(single))
    assert rms(errors / sigmas_m(together)) < 2.0
    photo_ties = together.details["photo_ties"]
    assert isinstance(photo_ties, dict)
    assert photo_ties["n_points"] > 100


def without_exif() -> Photos:
    known = bs.photos(calibrated=False).photos
    return ms.photos(*(replace(photo, exif_focal_px=None) for photo in known))


def with_errors_that_reach_far(ties: Ties, seed: int, sigma_m: float) -> Ties:
    """Return ties with correlated errors of neighbouring points, as in a stereo cloud."""
    rng = np.random.default_rng(200 + seed)
    nodes = rng.uniform(ties.points_world.min(axis=0), ties.points_world.max(axis=0), (80, 3))
    near = np.exp(-np.linalg.norm(ties.points_world[:, None] - nodes[None], axis=2) / 0.4)
    off = near / np.linalg.norm(near, axis=1, keepdims=True) @ rng.normal(size=(80, 3))
    return replace(ties, points_world=ties.points_world + sigma_m * off)


@pytest.mark.parametrize("seed", seeds(3))
def test_errors_of_the_scan_do_not_split_one_camera_into_several_lenses(
    tmp_path: Path, seed: int
) -> None:
    ties = with_errors_that_reach_far(bs.scan_ties(seed, n=100), seed, 0.003)
    together = bundle(ties, without_exif(), context(tmp_path), **ALONE)
    assert {camera.status for camera in together.cameras} == {"ok"}
    assert len({camera.intrinsics for camera in together.cameras}) == 1


def with_errors_of_places(ties: Ties, seed: int) -> Ties:
    """Return ties with 2 mm errors that depend on the position and are the same in all photos."""
    cubes = np.floor(ties.points_world / 0.4).astype(int)
    cubes -= cubes.min(axis=0)
    off = 0.002 * np.random.default_rng(100 + seed).normal(size=(*(cubes.max(axis=0) + 1), 3))
    return replace(ties, points_world=ties.points_world + off[tuple(cubes.T)])


def test_stated_errors_are_those_of_repeated_orientations(tmp_path: Path) -> None:
    """In survey coordinates, with errors that photos share."""
    ratios = []
    for seed in range(3):
        ties = with_errors_of_places(bs.scan_ties(seed, shift_m=SURVEY_SHIFT_M), seed)
        ctx = context(tmp_path, seed=seed)
        together = bundle(ties, bs.photos(calibrated=False), ctx, **ALONE)
        assert {camera.status for camera in together.cameras} == {"ok"}
        ratios.append(errors_m(together, SURVEY_SHIFT_M) / sigmas_m(together))
    # Measured: 1.10, of which the mean error of the points is a part.
    assert 0.8 < rms(np.array(ratios)) < 1.25


def test_sigmas_of_one_photo_that_are_too_small_move_no_photo(tmp_path: Path) -> None:
    """The weights of its ties follow their residuals."""
    ties, params = bs.scan_ties(2, n=90, wrong_share=0.0), {"rejection_sigma": 20.0, **ALONE}
    factor = np.where(ties.photo == 0, 0.25, 1.0)
    bold = replace(ties, sigma_px=factor * ties.sigma_px, sigma_m=factor * ties.sigma_m)
    right, same = (
        bundle(each, without_exif(), context(tmp_path), **params).cameras for each in (ties, bold)
    )
    for camera, other in zip(right, same, strict=True):
        away_m = ms.wall_error_m(bs.SCENE, other.viewing(), camera.viewing())
        # Measured: 0.22; it is 0.37 if the sigmas of positions are used as stated, 0.69 for pixels.
        assert away_m < 0.3 * (camera.sigma_wall_m or 0.0)
        assert other.sigma0_px == pytest.approx(camera.sigma0_px, rel=0.25)


def with_exif(*focals_px: float) -> Photos:
    known = zip(bs.photos(calibrated=False).photos, focals_px, strict=True)
    return ms.photos(*(replace(of, exif_focal_px=px, camera="Phone") for of, px in known))


def test_exif_that_the_photos_contradict_is_not_used_and_that_is_reported(tmp_path: Path) -> None:
    """With half the focal length, as digital zoom leaves it, no photo is oriented."""
    ctx, params = context(tmp_path), {"min_hull_ratio": 0.1, "max_sigma_wall_cells": 3.0}
    together = bundle(bs.scan_ties(2, n=40), with_exif(*[420.0] * 4), ctx, **ALONE, **params)
    assert {camera.status for camera in together.cameras} == {"ok"}
    assert together.cameras[0].viewing().fx == pytest.approx(840.0, rel=0.02)
    assert "exif-focal-contradicted" in [each.code for each in ctx.diagnostics]


def zoomed(ties: Ties, zoom: float, *photos: int) -> Ties:
    """Return ties of which some photos have another focal length."""
    true, pixels = bs.viewers()[3], ties.pixels_photo.copy()
    middle, is_other = np.array([true.cx, true.cy]), np.isin(ties.photo, photos)
    pixels[is_other] = middle + zoom * (pixels[is_other] - middle)
    return replace(ties, pixels_photo=pixels)


def test_exif_is_believed_that_one_photo_of_several_contradicts(tmp_path: Path) -> None:
    ties, params = zoomed(bs.scan_ties(2, n=40), 0.5, 0, 1, 2), OrientColmapBundle.Params()
    photos, ctx = with_exif(*[420.0] * 4).photos, context(tmp_path)
    assert focal_without_exif(tied_photo(photos[3], ties, params, ctx.rng), params)
    assert with_believable_priors(photos, ties, params, ctx) == list(photos)
    # A photo with another focal length in EXIF is not of this lens.
    photos = with_exif(*[420.0] * 3, 845.0).photos
    first, *_, last = with_believable_priors(photos, bs.scan_ties(2, n=40), params, ctx)
    assert first.exif_focal_px == pytest.approx(840.0, rel=0.1)
    assert last == photos[3]


@pytest.mark.parametrize(
    ("others", "camera", "again"),
    [
        *(((840.0, 850.0), "Phone", 845.0), ((840.0, 900.0), "Phone", None)),
        # One photo, another camera, or less than 15 % show nothing.
        *(((840.0,), "Phone", None), ((840.0, 850.0), "Other", None)),
        ((1500.0, 1500.0), "Phone", None),
    ],
)
def test_a_refused_photo_gets_the_focal_length_in_which_the_others_agree(
    tmp_path: Path, others: tuple[float, ...], camera: str, again: float | None
) -> None:
    ties, ctx = bs.scan_ties(2, n=40), context(tmp_path)
    photos = with_exif(*others, *[1680.0] * (4 - len(others))).photos[: len(others) + 1]
    photos = (*photos[:-1], replace(photos[-1], camera=camera))
    tied = [tied_photo(photo, ties, OrientColmapBundle.Params(), ctx.rng) for photo in photos]

    def look(one: TiedPhoto) -> Oriented:
        """Orient all but photos with the wrong focal length."""
        found, focal_px = refused(one, "no pose"), one.photo.exif_focal_px
        lens = replace(photos[0].lens_prior()[0], fx=focal_px, fy=focal_px)
        camera = replace(found.camera, status="ok", intrinsics=Intrinsics.of(lens, source="exif"))
        return found if focal_px == 1680.0 else replace(found, camera=camera)

    last = looked_at(tied, look, ctx)[-1].camera.intrinsics
    assert (None if last is None else last.fx) == again


@pytest.mark.parametrize(("method", "own"), [(OrientColmapBundle, ALONE), (OrientPnp, {})])
def test_a_photo_whose_exif_the_others_contradict_is_tried_again_with_their_focal_length(
    tmp_path: Path, method: type[OrientPnp | OrientColmapBundle], own: dict[str, bool]
) -> None:
    """EXIF is not tested with 24 ties; with half the focal length, no photo is oriented."""
    ties = bs.scan_ties(2, n=96, wrong_share=0.0)
    few = samples.taken(ties, (ties.photo < 3) | (np.arange(len(ties.photo)) % 4 == 0))
    ctx, photos = context(tmp_path), with_exif(840.0, 840.0, 840.0, 1680.0)
    params = {"min_hull_ratio": 0.1, "max_sigma_wall_cells": 3.0, **own}
    cameras = tp.oriented(method, few, photos, ctx, **params).cameras
    assert [camera.status for camera in cameras] == ["ok"] * 4
    assert cameras[3].viewing().fx == pytest.approx(840.0, rel=0.03)
    again = [each.subject for each in ctx.diagnostics if each.code == "exif-focal-left-out"]
    assert again == ["d.png"]


@pytest.mark.parametrize(("method", "own"), [(OrientColmapBundle, ALONE), (OrientPnp, {})])
def test_few_of_the_ties_that_are_used_agree_by_chance(
    tmp_path: Path, method: type[OrientPnp | OrientColmapBundle], own: dict[str, bool]
) -> None:
    """Four of five are anywhere within 8 px: of those within 3.5 sigma, a fifth would be wrong."""
    ties, rng = bs.scan_ties(2, n=600, wrong_share=0.0), np.random.default_rng(3)
    off_px = (np.arange(len(ties.photo)) % 5 > 0)[:, None] * rng.uniform(-8.0, 8.0, (2400, 2))
    spread = replace(ties, pixels_photo=ties.pixels_photo + off_px)
    found = tp.oriented(method, spread, bs.photos(calibrated=True), context(tmp_path), **own)
    assert found.ties is not None
    is_used = found.ties.role == TieRole.CONTROL
    assert 0.02 < off_px[is_used].any(axis=1).mean() < 0.12


@pytest.mark.parametrize(("zoom", "n_lenses"), [*long_only((0.92, 1)), (0.8, 4)])
def test_photos_that_zoomed_share_no_lens_where_it_matters(
    tmp_path: Path, zoom: float, n_lenses: int
) -> None:
    """One of four photos is zoomed; even if unnoticed, its predicted error is not too small.

    With `shared`, they share a lens in any case.
    """
    true = [*bs.viewers()]
    true[3] = replace(true[3], fx=zoom * true[3].fx, fy=zoom * true[3].fy)
    ties = zoomed(bs.scan_ties(2, n=90), zoom, 3)
    found = bundle(ties, without_exif(), context(tmp_path), **ALONE).cameras
    assert len({camera.intrinsics for camera in found}) == n_lenses
    for camera, other in zip(found, true, strict=True):
        assert camera.status == "ok"
        assert ms.wall_error_m(bs.SCENE, camera.viewing(), other) < 1.5 * (camera.sigma_wall_m or 0)
    shared = bundle(ties, without_exif(), context(tmp_path), intrinsics="shared", **ALONE)
    assert [len(lens["photos"]) for lens in shared.details["lenses"]] == [4]


def of_focal(log_focal: float, sigma: float) -> Any:
    """What `of_another_lens` reads of a photo or of its orientation."""
    covariance = np.diag([*np.zeros(6), sigma**2])
    camera, lens = Fields(fx=1000.0 * np.exp(log_focal)), Fields(names=("focal",))
    resection = Fields(camera=camera, covariance=covariance, lens=lens)
    return Fields(resection=resection, estimate=Fields(resection=resection))


@pytest.mark.parametrize(
    ("offs", "sigma", "source", "others"),
    [
        # Two percent and five standard deviations.
        ([0.019, 0.0], 0.0001, UNKNOWN, set()),
        ([0.021, 0.0], 0.0001, UNKNOWN, {0}),
        ([0.049, 0.0], 0.01, UNKNOWN, set()),
        ([0.051, 0.0], 0.01, UNKNOWN, {0}),
        # Those with less than half of the largest difference may only follow the shared lens.
        ([0.1, -0.06, 0.04], 0.0001, UNKNOWN, {0, 1}),
        # EXIF says that they share a lens.
        ([0.1, 0.0], 0.0001, "exif", set()),
    ],
)
def test_a_photo_has_another_lens_by_a_difference_that_matters_and_is_sure(
    offs: list[float], sigma: float, source: str, others: set[int]
) -> None:
    block: Any = Fields(lens_of=(0,) * len(offs), lenses=(Fields(source=source),))
    adjusted: Any = Fields(block=block, estimates=[of_focal(0.0, sigma)] * len(offs))
    assert of_another_lens([of_focal(off, sigma) for off in offs], adjusted) == others


def test_the_noise_of_ties_between_photos_is_found() -> None:
    """Points absorb three quarters of the noise with two photos, and half of it with three."""
    rng, params, n_seeing = np.random.default_rng(3), OrientColmapBundle.Params(), 3
    scan, shots = bs.scan_ties(0, n=60), bs.photos(calibrated=True).photos
    trusted = [
        by_itself(tied_photo(s, scan, params, rng), scan, params, estimate_pose) for s in shots
    ]
    points = rng.uniform([0.6, -0.1, 0.4], [2.4, 0.1, 1.6], (500, 3))
    pixels = np.array([camera.project(points)[:, :2] for camera in bs.viewers()])
    seen = np.array([c.sees(p) for c, p in zip(bs.viewers(), pixels, strict=True)])
    # Choose some of the photos that see each point, in random order.
    order = np.argsort(np.where(seen, rng.uniform(size=seen.shape), 2.0), axis=0)[:n_seeing]
    kept = np.flatnonzero(seen.sum(axis=0) >= n_seeing)
    photo, point = order[:, kept].ravel(), np.tile(np.arange(len(kept)), n_seeing)
    noise = rng.normal(0.0, 0.8, (len(photo), 2))
    between = photo_ties.PhotoTies(
        photo=photo,
        point=point,
        pixels=pixels[photo, kept[point]] + noise,
        scale=np.ones(len(photo)),
        points_world=points[kept],
    )
    known = [item for item in trusted if isinstance(item, Trusted)]
    cameras = [item.estimate.resection.camera for item in known]
    groups = lens_groups(shots, cameras, "focal-group")
    found = adjust_block(known, between, groups, params)
    assert found.tie_sigma_px == pytest.approx(0.8, rel=0.1)


def camera(*centre: float) -> ViewingCamera:
    return samples.aimed(centre, (0.2, 5.0, 0.3), 900.0, (1000, 800))


CENTRES = ((-1.0, 0.0, 0.0), (1.0, 0.3, 0.2), (0.2, -0.4, 0.9), (0.1, 0.2, -0.8))
CAMERAS = [camera(*centre) for centre in CENTRES]
PAIRS = list(itertools.combinations(range(4), 2))


def described(count: int, seed: int = 0) -> NDArray[np.float32]:
    """Return descriptors (n, 128) that are far from each other."""
    return np.random.default_rng(seed).integers(0, 60, (count, 128)).astype(np.float32)


def scene_points(count: int = 30) -> NDArray[np.float64]:
    return np.random.default_rng(2).uniform((-1.0, 4.0, -0.8), (1.2, 6.0, 1.2), (count, 3))


def seen_in(
    points: NDArray[np.float64], moved: dict[tuple[int, int], tuple[float, float]] | None = None
) -> list[Features]:
    """Return key points of all points in all photos, in random order; some are moved."""
    found = []
    for photo, view in enumerate(CAMERAS):
        pixels = view.project(points)[:, :2]
        for (of, point), by in (moved or {}).items():
            if of == photo:
                pixels[point] += by
        order = np.random.default_rng(photo).permutation(len(points))
        found.append(features(pixels[order], descriptors=described(len(points))[order]))
    return found


def observed(ties: photo_ties.PhotoTies, points: NDArray[np.float64]) -> list[list[int]]:
    """Return the photos that see each tied point, by the point's index in the scene."""
    found: list[list[int]] = [[] for _ in points]
    for photo, point in zip(ties.photo, ties.point, strict=True):
        apart = np.linalg.norm(points - ties.points_world[point], axis=1)
        found[int(apart.argmin())].append(int(photo))
    return [sorted(photos) for photos in found]


def residuals_px(ties: photo_ties.PhotoTies) -> NDArray[np.float64]:
    """Return the distances of observations from the projections of their points."""
    pairs = zip(ties.photo, ties.points_world[ties.point], strict=True)
    seen = [CAMERAS[photo].project(point[None])[0, :2] for photo, point in pairs]
    return np.linalg.norm(np.array(seen) - ties.pixels, axis=1)


def test_points_are_tied_in_all_photos_that_see_them_where_they_are() -> None:
    points = scene_points()
    ties = photo_ties.tie_photos(CAMERAS, seen_in(points), PAIRS, 1000)
    assert observed(ties, points) == [[0, 1, 2, 3]] * 30
    apart = np.linalg.norm(points[:, None] - ties.points_world[None], axis=2).min(axis=0)
    np.testing.assert_allclose(apart, 0.0, atol=1e-7)
    np.testing.assert_allclose(residuals_px(ties), 0.0, atol=1e-5)
    # Key points of photos of 1000 px are found at full size, those of larger ones at 1600 px.
    assert set(ties.scale) == {1.0}
    large = [replace(view, width=3200, height=2560) for view in CAMERAS]
    assert set(photo_ties.tie_photos(large, seen_in(points), PAIRS, 1000).scale) == {2.0}


def test_of_many_points_those_that_most_photos_see_are_kept() -> None:
    points = scene_points()
    known_to = seen_in(points)
    # The last two photos show only the first ten points.
    for photo in (2, 3):
        order = np.random.default_rng(photo).permutation(30)
        known_to[photo] = known_to[photo].take(order < 10)
    ties = photo_ties.tie_photos(CAMERAS, known_to, PAIRS, 12)
    seen = observed(ties, points)
    assert seen[:10] == [[0, 1, 2, 3]] * 10
    assert sum(photos == [0, 1] for photos in seen[10:]) == 2


def across_line(point: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the direction in the second photo perpendicular to a point's epipolar line."""
    first, second = CAMERAS[0], CAMERAS[1]
    beyond = first.centre_world + 1.1 * (point - first.centre_world)
    along = np.diff(second.project(np.array([point, beyond]))[:, :2], axis=0)[0]
    return np.array([-along[1], along[0]]) / np.linalg.norm(along)


@pytest.mark.parametrize(
    ("is_along", "off_px", "is_tied"),
    [(False, 5.6, True), (False, 6.4, False), (True, 20.0, True), (True, 22.0, False)],
)
def test_matches_within_six_pixels_of_the_line_and_eight_of_the_point_are_tied(
    *, is_along: bool, off_px: float, is_tied: bool
) -> None:
    # The first photo does not reveal an error along its epipolar line, but the third photo does.
    points, n_photos = scene_points(), 2 + is_along
    across = across_line(points[4])
    way = (across[1], -across[0]) if is_along else tuple(across)
    moved = {(1, 4): (off_px * way[0], off_px * way[1])}
    pairs = [(0, 1), (0, 2)][: 1 + is_along]
    ties = photo_ties.tie_photos(CAMERAS[:n_photos], seen_in(points, moved)[:n_photos], pairs, 1000)
    assert residuals_px(ties).max() <= 8.0
    assert len(ties.points_world) == (30 if is_tied else 29)


@pytest.mark.parametrize(
    ("angle_deg", "aside", "n_points"), [(1.9, 0.0, 0), (2.1, 0.0, 2), (2.1, 3.0, 0)]
)
def test_rays_must_meet_before_the_photos_at_two_degrees(
    angle_deg: float, aside: float, n_points: int
) -> None:
    half, found = 5.0 * np.tan(np.radians(0.5 * angle_deg)), []
    views = [camera(0.2 + side * half, 0.0, 0.3) for side in (-1.0, 1.0)]
    for view, side in zip(views, (-1.0, 1.0), strict=True):
        # Looking aside, the rays diverge and intersect behind both photos.
        points = np.tile([0.2 + side * aside * half, 5.0, 0.3], (2, 1))
        found.append(features(view.project(points)[:, :2], descriptors=described(2)))
    ties = photo_ties.tie_photos(views, found, [(0, 1)], 10)
    assert len(ties.points_world) == n_points


@pytest.mark.parametrize(("share", "is_pair"), [(0.35, True), (0.45, False)])
def test_pairs_show_enough_of_each_others_walls(share: float, is_pair: bool) -> None:
    # The second photo shows four of the ten points of the first; the first shows all points of the
    # second.
    points = np.tile([0.2, 5.0, 0.3], (10, 1))
    behind = points.copy()
    behind[:6, 1] = -500.0
    views = [camera(-1.0, 0.0, 0.0), camera(1.0, 0.0, 0.0)]
    for shown in ([behind, points], [points, behind]):
        assert photo_ties.overlapping_pairs(views, shown, share) == [(0, 1)] * is_pair
    assert photo_ties.overlapping_pairs(views, [points[:0], points], share) == []


def test_key_points_are_in_pixels_of_the_photo_when_it_was_reduced() -> None:
    """Bright discs on grey; the centre of the first pixel is at (0.5, 0.5)."""
    width, height = 2400, 150
    centres = np.array([[0.2, 0.5], [0.45, 0.4], [0.7, 0.6]]) * (width, height)
    rows, columns = np.mgrid[:height, :width] + 0.5
    away = [np.hypot(columns - column, rows - row) for column, row in centres]
    grey = np.where(np.min(away, axis=0) < 18.0, 210.0, 90.0)
    soft = cv2.GaussianBlur(grey, (0, 0), 2.0).astype(np.uint8)
    photo = Photo(name="a.png", encoded=encode_png(soft), width=width, height=height)
    for n_most, limit_px in ((100, 0.5), (3, 20.0)):
        found = photo_ties.photo_features(photo, n_most).pixels
        # The strongest key points include one in each part of the photo before a second in any
        # part.
        assert np.linalg.norm(found[:, None] - centres, axis=2).min(axis=0).max() < limit_px
    assert len(found) == 3


def test_a_track_with_two_points_of_one_photo_is_none() -> None:
    starts = np.array([0, 10, 20, 30])
    links = np.array([[0, 10], [10, 20], [1, 11], [11, 21], [21, 2], [3, 22]])
    found = [track.tolist() for track in photo_ties.tracks_of(links, starts)]
    assert found == [[0, 10, 20], [3, 22]]
    assert photo_ties.tracks_of(np.empty((0, 2), dtype=np.intp), starts) == []
