"""All photos at once: never worse than one by one, lenses found, errors stated as they are."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from orthoflow_plugins.orient import bundle as bundle_method
from orthoflow_plugins.orient.block import Block, Observations, Points, block_covariance, solve
from orthoflow_plugins.orient.bundle import OrientColmapBundle, adjust_block
from orthoflow_plugins.orient.photo_ties import (
    PhotoTies,
    photo_features,
)
from orthoflow_plugins.orient.photos import Trusted, by_itself, tied_photo
from orthoflow_plugins.orient.pnp import OrientPnp
from orthoflow_plugins.orient.pose import Lens, estimate_pose, lens_groups

from orthoflow.geometry.cameras import LensFreedom
from orthoflow.geometry.key_points import Features
from orthoflow.geometry.resection import SeenPoints, adjust
from orthoflow.products import Cameras, Photo, Photos, Ties
from orthoflow.sdk import StepContext
from orthoflow.testing import photographed as ms
from tests import block_scenes as bs
from tests.long_loops import seeds
from tests.scenes import SURVEY_SHIFT_M

FEW = {"max_features": 1500}
ALONE = {"photo_ties": False}


def context(tmp_path: Path, *, seed: int = 1) -> StepContext:
    folder = tmp_path / f"{len(list(tmp_path.iterdir()))}"
    folder.mkdir()
    return StepContext(rng=np.random.default_rng(seed), cores=2, scratch=folder)


def bundle(ties: Ties, photos: Photos, ctx: StepContext, **params: object) -> Cameras:
    inputs = OrientColmapBundle.In(ties=ties, photos=photos)
    return OrientColmapBundle().run(inputs, OrientColmapBundle.Params(**params), ctx).cameras


_found: dict[tuple[bytes, int], Features] = {}


def found_once(photo: Photo, n_most: int) -> Features:
    """Key points of a picture, which are the same whatever is known of its lens."""
    key = (photo.encoded, n_most)
    if key not in _found:
        _found[key] = photo_features(photo, n_most)
    return _found[key]


@pytest.fixture(autouse=True, scope="module")
def _key_points_found_once() -> Iterator[None]:
    """Look at each picture once."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bundle_method, "photo_features", found_once)
        yield


@pytest.fixture(scope="module")
def exif(tmp_path_factory: pytest.TempPathFactory) -> Cameras:
    """Four photos whose focal length EXIF says 2 % too long, by their own ties and the scan's."""
    ctx = context(tmp_path_factory.mktemp("exif"))
    return bundle(bs.scan_ties(0), bs.photos(calibrated=False), ctx, **FEW)


def one_by_one(ties: Ties, photos: Photos, ctx: StepContext) -> Cameras:
    return OrientPnp().run(OrientPnp.In(ties=ties, photos=photos), OrientPnp.Params(), ctx).cameras


def errors_m(cameras: Cameras, shift_m: np.ndarray | None = None) -> np.ndarray:
    shift = np.zeros(3) if shift_m is None else shift_m
    assert [camera.status for camera in cameras.cameras] == ["ok"] * 4
    return np.array(
        [
            ms.wall_error_m(bs.SCENE, found.viewing().shifted(shift), true)
            for found, true in zip(cameras.cameras, bs.viewers(), strict=True)
        ]
    )


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def sigmas_m(cameras: Cameras) -> np.ndarray:
    return np.array([camera.sigma_wall_m for camera in cameras.cameras], dtype=np.float64)


@pytest.mark.parametrize("calibrated", [True, False], ids=["calibrated", "exif"])
def test_ties_between_photos_make_them_more_exact(
    tmp_path: Path, exif: Cameras, calibrated: bool
) -> None:
    ties, photos = bs.scan_ties(0), bs.photos(calibrated=calibrated)
    single = errors_m(one_by_one(ties, photos, context(tmp_path)))
    together = bundle(ties, photos, context(tmp_path), **FEW) if calibrated else exif
    # Measured: 0.2 mm instead of 0.3 (calibrated) and of 0.6 (EXIF).
    assert rms(errors_m(together)) < 0.75 * rms(single)
    assert rms(errors_m(together) / sigmas_m(together)) < 2.0
    photo_ties = together.details["photo_ties"]
    assert isinstance(photo_ties, dict)
    assert photo_ties["n_points"] > 200


@pytest.mark.long
def test_stated_errors_are_those_of_repeated_orientations(tmp_path: Path) -> None:
    ratios = []
    for seed in range(8):
        ctx = context(tmp_path, seed=seed)
        together = bundle(bs.scan_ties(seed), bs.photos(calibrated=False), ctx, **ALONE)
        ratios.append(errors_m(together) / sigmas_m(together))
    assert 0.7 < rms(np.array(ratios)) < 1.5


def without_exif() -> Photos:
    known = bs.photos(calibrated=False).photos
    return ms.photos(*(replace(photo, exif_focal_px=None) for photo in known))


def with_errors_that_reach_far(ties: Ties, seed: int, sigma_m: float) -> Ties:
    """Ties whose points are off as those of a stereo cloud, neighbours by nearly the same."""
    rng = np.random.default_rng(200 + seed)
    nodes = rng.uniform(ties.points_world.min(axis=0), ties.points_world.max(axis=0), (80, 3))
    near = np.exp(-np.linalg.norm(ties.points_world[:, None] - nodes[None], axis=2) / 0.4)
    off = near / np.linalg.norm(near, axis=1, keepdims=True) @ rng.normal(size=(80, 3))
    return replace(ties, points_world=ties.points_world + sigma_m * off)


@pytest.mark.parametrize("seed", seeds(3))
def test_errors_of_the_scan_do_not_split_one_camera_into_several_lenses(
    tmp_path: Path, seed: int
) -> None:
    ties = with_errors_that_reach_far(bs.scan_ties(seed), seed, 0.003)
    together = bundle(ties, without_exif(), context(tmp_path), **ALONE)
    assert {camera.status for camera in together.cameras} == {"ok"}
    assert len({camera.intrinsics for camera in together.cameras}) == 1


@pytest.mark.long
def test_errors_of_the_scan_that_reach_far_are_stated(tmp_path: Path) -> None:
    """Relative to the scan: how far it is off on the average, nothing in it can show."""
    ratios = []
    for seed in range(8):
        exact = bs.scan_ties(seed)
        ties = with_errors_that_reach_far(exact, seed, 0.003)
        shift = (ties.points_world - exact.points_world).mean(axis=0)
        together = bundle(ties, bs.photos(calibrated=True), context(tmp_path, seed=seed), **ALONE)
        ratios.append(errors_m(together, shift) / sigmas_m(together))
    assert 0.7 < rms(np.array(ratios)) < 1.4


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_exif_that_the_photos_contradict_is_not_used_and_that_is_reported(
    tmp_path: Path, factor: float
) -> None:
    wrong = [
        replace(photo, exif_focal_px=factor * 840.0, camera="Phone")
        for photo in bs.photos(calibrated=False).photos
    ]
    ctx = context(tmp_path)
    together = bundle(bs.scan_ties(2), ms.photos(*wrong), ctx, **ALONE)
    assert {camera.status for camera in together.cameras} == {"ok"}
    assert together.cameras[0].viewing().fx == pytest.approx(840.0, rel=0.02)
    assert "exif-focal-contradicted" in [each.code for each in ctx.diagnostics]


@pytest.mark.parametrize("method", ["bundle", "pnp"])
def test_a_photo_whose_exif_the_others_contradict_is_tried_again_with_their_focal_length(
    tmp_path: Path, method: str
) -> None:
    """Of 24 ties nobody asks whether EXIF is right; with half the focal length none is oriented."""
    ties = bs.scan_ties(2, wrong_share=0.0)
    of_last = np.flatnonzero(ties.photo == 3)
    kept = np.union1d(np.flatnonzero(ties.photo < 3), of_last[:: len(of_last) // 24][:24])
    few = replace(
        ties,
        **{
            name: getattr(ties, name)[kept]
            for name in ("photo", "wall", "pixels_photo", "points_world", "sigma_px", "sigma_m")
        },
        role=ties.role[kept],
        residual_px=ties.residual_px[kept],
    )
    shots = [
        replace(photo, camera="Phone", exif_focal_px=840.0)
        for photo in bs.photos(calibrated=False).photos
    ]
    shots[3] = replace(shots[3], exif_focal_px=1680.0)
    ctx = context(tmp_path)
    if method == "bundle":
        cameras = bundle(few, ms.photos(*shots), ctx, min_hull_ratio=0.1, **ALONE).cameras
    else:
        params = OrientPnp.Params(min_hull_ratio=0.1, max_sigma_wall_cells=3.0)
        inputs = OrientPnp.In(ties=few, photos=ms.photos(*shots))
        cameras = OrientPnp().run(inputs, params, ctx).cameras.cameras
    assert [camera.status for camera in cameras] == ["ok"] * 4
    assert cameras[3].viewing().fx == pytest.approx(840.0, rel=0.03)
    assert [each.subject for each in ctx.diagnostics if each.code == "exif-focal-left-out"] == [
        "d.png"
    ]


@pytest.mark.parametrize(("zoom", "n_lenses"), [(0.92, 1), (0.8, 4)])
def test_photos_that_zoomed_share_no_lens_where_it_matters(
    tmp_path: Path, zoom: float, n_lenses: int
) -> None:
    """One of four photos: what its ties cannot tell does not make the stated errors too small."""
    ties, true = bs.scan_ties(2), [*bs.viewers()]
    middle, pixels = np.array([true[3].cx, true[3].cy]), ties.pixels_photo.copy()
    pixels[ties.photo == 3] = middle + zoom * (pixels[ties.photo == 3] - middle)
    true[3] = replace(true[3], fx=zoom * true[3].fx, fy=zoom * true[3].fy)
    found = bundle(
        replace(ties, pixels_photo=pixels), without_exif(), context(tmp_path), **ALONE
    ).cameras
    assert len({camera.intrinsics for camera in found}) == n_lenses
    for camera, other in zip(found, true, strict=True):
        assert camera.status == "ok"
        assert ms.wall_error_m(bs.SCENE, camera.viewing(), other) < 1.5 * (camera.sigma_wall_m or 0)


def test_a_photo_with_random_ties_is_refused_and_harms_none(tmp_path: Path) -> None:
    ties, photos = bs.scan_ties(6), bs.photos(calibrated=True)
    pixels = ties.pixels_photo.copy()
    bad = ties.photo == 3
    pixels[bad] = np.random.default_rng(0).uniform([0, 0], [900, 640], (bad.sum(), 2))
    spoilt = bundle(replace(ties, pixels_photo=pixels), photos, context(tmp_path), **FEW)
    assert [camera.status == "ok" for camera in spoilt.cameras] == [True, True, True, False]
    for found, true in zip(spoilt.cameras[:3], bs.viewers(), strict=False):
        assert ms.wall_error_m(bs.SCENE, found.viewing(), true) < 0.0005


@pytest.mark.parametrize("n_seeing", [2, 3])
def test_the_noise_of_ties_between_photos_is_found(n_seeing: int) -> None:
    """Points take up a part of it: of two photos three quarters, of three a half."""
    rng, params = np.random.default_rng(3), OrientColmapBundle.Params()
    scan, shots = bs.scan_ties(0), bs.photos(calibrated=True).photos
    trusted = [
        by_itself(tied_photo(s, scan, params, rng), scan, params, estimate_pose) for s in shots
    ]
    points = rng.uniform([0.6, -0.1, 0.4], [2.4, 0.1, 1.6], (900, 3))
    pixels = np.array([camera.project(points)[:, :2] for camera in bs.viewers()])
    seen = np.array([c.sees(p) for c, p in zip(bs.viewers(), pixels, strict=True)])
    # The photos that see a point, the first few of them in an order of its own.
    order = np.argsort(np.where(seen, rng.uniform(size=seen.shape), 2.0), axis=0)[:n_seeing]
    kept = np.flatnonzero(seen.sum(axis=0) >= n_seeing)
    photo, point = order[:, kept].ravel(), np.tile(np.arange(len(kept)), n_seeing)
    noise = rng.normal(0.0, 0.8, (len(photo), 2))
    between = PhotoTies(
        photo=photo,
        point=point,
        pixels=pixels[photo, kept[point]] + noise,
        scale=np.ones(len(photo)),
        points_world=points[kept],
    )
    cameras = [item.estimate.resection.camera for item in trusted if isinstance(item, Trusted)]
    groups = lens_groups(shots, cameras, "focal-group", "uncalibrated")
    known = [item for item in trusted if isinstance(item, Trusted)]
    found = adjust_block(known, between, groups, params)
    assert found.tie_sigma_px == pytest.approx(0.8, rel=0.1)


def lens_of(camera: object, freedom: LensFreedom) -> Lens:
    return Lens(prior=camera, freedom=freedom, source="calibration")


def test_one_photo_is_as_exact_as_its_resection_says() -> None:
    """The covariance of a block of one photo against the adjustment of one camera."""
    ties, camera = bs.scan_ties(9, wrong_share=0.0), bs.viewers()[0]
    mine = ties.photo == 0
    middle = ties.points_world[mine].mean(axis=0)
    camera = camera.shifted(middle)
    seen = SeenPoints(
        pixels_photo=ties.pixels_photo[mine],
        points_world=ties.points_world[mine] - middle,
        sigma_px=ties.sigma_px[mine],
        sigma_m=ties.sigma_m[mine],
    )
    freedom = LensFreedom(focal_sigma=0.05, k1_sigma=0.1)
    single = adjust(seen, camera, lens=freedom, soft_limit=2.0)
    points = Points(now=seen.points_world, known=seen.points_world, sigma_m=seen.sigma_m)
    block = Block(
        cameras=(camera,),
        lens_of=(0,),
        lenses=(lens_of(camera, freedom),),
        points=points,
        seen=Observations(
            photo=np.zeros(len(seen), np.intp),
            point=np.arange(len(seen)),
            pixels=seen.pixels_photo,
            sigma_px=seen.sigma_px,
        ),
    )
    solved = solve(block, soft_limit=2.0)
    found = solved.cameras[0]
    assert found.fx == pytest.approx(single.camera.fx, rel=1e-4)
    # Its distance is known to 10 mm, and the solver stops at a hundredth of that.
    np.testing.assert_allclose(found.centre_world, single.camera.centre_world, atol=3e-4)
    exact = replace(block, cameras=(single.camera,))
    covariance = block_covariance(exact, soft_limit=2.0)
    assert covariance.sigma0 == pytest.approx(single.sigma0, rel=1e-6)
    scale = np.sqrt(np.diag(single.covariance))
    np.testing.assert_allclose(
        covariance.sigma0**2 * covariance.cofactors / np.outer(scale, scale),
        single.covariance / np.outer(scale, scale),
        atol=1e-6,
    )


def test_lenses_of_their_own_have_a_mean_and_a_spread(tmp_path: Path) -> None:
    ties, photos = bs.scan_ties(3), bs.photos(calibrated=False)
    together = bundle(ties, photos, context(tmp_path), intrinsics="per-photo", **ALONE)
    focals = [camera.viewing().fx for camera in together.cameras]
    (entry,) = together.details["lens_statistics"]
    assert entry["n_lenses"] == 4
    assert entry["mean"]["focal"] == pytest.approx(np.mean(focals))
    assert entry["sd"]["focal"] == pytest.approx(np.std(focals, ddof=1))


def with_errors_of_places(ties: Ties, seed: int) -> Ties:
    """Ties whose points are off by what the scan is at their place, 2 mm, in whichever photo."""
    cubes = np.floor(ties.points_world / 0.4).astype(int)
    cubes -= cubes.min(axis=0)
    off = 0.002 * np.random.default_rng(100 + seed).normal(size=(*(cubes.max(axis=0) + 1), 3))
    return replace(ties, points_world=ties.points_world + off[tuple(cubes.T)])


def test_errors_of_the_scan_that_photos_share_are_stated(tmp_path: Path) -> None:
    ratios = []
    for seed in range(3):
        ties, ctx = with_errors_of_places(bs.scan_ties(seed), seed), context(tmp_path, seed=seed)
        together = bundle(ties, bs.photos(calibrated=False), ctx, **ALONE)
        ratios.append(errors_m(together) / sigmas_m(together))
    # Measured: 0.80; with cells of single photos as groups alone 1.08.
    assert 0.7 < rms(np.array(ratios)) < 1.0


def test_survey_coordinates_change_nothing(tmp_path: Path) -> None:
    ties = bs.scan_ties(8, shift_m=SURVEY_SHIFT_M)
    together = bundle(ties, bs.photos(calibrated=False), context(tmp_path), **ALONE)
    assert rms(errors_m(together, SURVEY_SHIFT_M) / sigmas_m(together)) < 2.0
