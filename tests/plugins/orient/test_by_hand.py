"""Ties measured by hand, and poses from other programs, are used, checked or corrected."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.orient.bundle import OrientColmapBundle
from orthoflow_plugins.orient.given import OrientGiven
from orthoflow_plugins.orient.photos import pose_by_hand
from orthoflow_plugins.orient.pnp import OrientPnp
from orthoflow_plugins.orient.pose import Estimate, Start
from orthoflow_plugins.read.cameras import ReadCameras
from scipy import stats

from orthoflow.errors import MethodError
from orthoflow.files.publishing import publish_cameras
from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.products import Camera, Cameras, InputFiles, Intrinsics, Photos, TieRole, Ties
from orthoflow.testing import photographed as ms
from tests import samples
from tests import tied_photos as tp
from tests.method_runs import run
from tests.tied_photos import context, known_ties, photo

SCENE = tp.SCENE
CAMERA = ms.camera_before(centre=(1.3, -2.6, 1.1))
SIGMA_PX = 1.0
# Two rows of typical clicks, as shares of the photo; the points are on relief.
SPREAD = ((0.12, 0.15), (0.5, 0.12), (0.88, 0.16), (0.13, 0.86), (0.52, 0.88), (0.87, 0.84))
MORE = ((0.3, 0.5), (0.7, 0.45))


def clicked(
    seed: int,
    *,
    n: int = 6,
    blunder: NDArray[np.float64] | None = None,
    places: tuple[tuple[float, float], ...] = (),
) -> Ties:
    """Return ties by hand with the noise of their sigmas; the last one has a blunder."""
    rng = np.random.default_rng(seed)
    shares = np.array(places or (*SPREAD, *MORE)[:n])
    n = len(shares)
    pixels = (shares + rng.uniform(-0.03, 0.03, (n, 2))) * [CAMERA.width, CAMERA.height]
    # Find the wall point of a pixel, first along the ray to the plane, then onto the relief.
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
        walls=(samples.tie_wall(SCENE.frame.corners_world(), ms.GSD_M),),
    )


def joined(first: Ties, second: Ties) -> Ties:
    """Return the ties of both, with the second ones marked as measured by hand."""
    return tp.joined(replace(first, by_hand=np.zeros(len(first.photo), np.uint8)), second)


Orient = Callable[[Ties, Photos], tuple[Cameras, list[str]]]


@pytest.fixture(params=["pnp", "bundle"])
def orient(request: pytest.FixtureRequest, tmp_path: Path) -> Orient:
    method = {"pnp": OrientPnp, "bundle": OrientColmapBundle}[request.param]

    def run(ties: Ties, photos: Photos) -> tuple[Cameras, list[str]]:
        ctx = tp.context(tmp_path)
        return tp.oriented(method, ties, photos, ctx), list(ctx.warnings)

    return run


CALIBRATED = ms.photos(tp.photo(CAMERA))


def error_share(found: Camera) -> float:
    """Return the error on the wall divided by the predicted standard deviation."""
    assert found.sigma_wall_m is not None
    return ms.wall_error_m(SCENE, found.viewing(), CAMERA) / found.sigma_wall_m


def test_six_ties_orient_a_photo_within_what_their_sigma_says(orient: Orient) -> None:
    shares = []
    for seed in range(8):
        cameras, _ = orient(clicked(seed), CALIBRATED)
        assert cameras.cameras[0].status == "ok", seed
        shares.append(error_share(cameras.cameras[0]))
        assert cameras.ties is not None
        assert (cameras.ties.role == TieRole.CONTROL).all()
    # For a chi distribution with about as many degrees of freedom, the mean square is close to 1.
    assert 0.4 < np.sqrt(np.mean(np.square(shares))) < 1.6
    assert max(shares) < 3.0


@pytest.mark.parametrize("size_px", [15.0, 60.0, 400.0])
def test_a_gross_blunder_among_eight_is_left_out_or_refused(orient: Orient, size_px: float) -> None:
    for seed in range(3):
        angle = seed * 2.1
        blunder = size_px * np.array([np.cos(angle), np.sin(angle)])
        cameras, warnings = orient(clicked(seed, n=8, blunder=blunder), CALIBRATED)
        found = cameras.cameras[0]
        assert cameras.ties is not None
        if found.status == "ok":
            assert error_share(found) < 3.0
            assert cameras.ties.role.tolist() == [0] * 7 + [int(TieRole.REJECTED)]
            assert any("that contradict the others were ignored" in text for text in warnings)
        else:
            assert "measured by hand contradict" in found.status
    # Large blunders are always recognised.
    assert size_px < 50.0 or found.status == "ok"


def test_ties_that_hang_on_one_of_them_are_refused(orient: Orient) -> None:
    # Five ties are in a corner and one is far away. The predicted error is small, but if that tie
    # is wrong, the pose without it is poor.
    corner = ((0.06, 0.1), (0.2, 0.1), (0.06, 0.3), (0.2, 0.3), (0.13, 0.2))
    hanging = orient(clicked(3, places=(*corner, (0.95, 0.9))), CALIBRATED)[0].cameras[0]
    # The reason names the pixel of that tie.
    assert re.search(r"\(u 8\d\d, v 5\d\d\)", hanging.status)
    far = ((0.95, 0.9), (0.9, 0.2))
    held = orient(clicked(3, places=(*corner, *far)), CALIBRATED)[0].cameras[0]
    assert held.status == "ok"


def test_ties_by_hand_join_those_that_matching_found(orient: Orient) -> None:
    matched = known_ties(CAMERA, 5, n=120, wrong_share=0.2)
    alone = orient(clicked(1), CALIBRATED)[0].cameras[0]
    both, _ = orient(joined(matched, clicked(1)), CALIBRATED)
    found = both.cameras[0]
    assert found.status == "ok"
    assert found.sigma_wall_m is not None
    assert alone.sigma_wall_m is not None
    assert found.sigma_wall_m < 0.5 * alone.sigma_wall_m
    assert error_share(found) < 3.0
    assert both.ties is not None
    # Ties by hand are never withheld.
    assert (both.ties.role[-6:] == TieRole.CONTROL).all()
    assert (both.ties.role == TieRole.CHECK).sum() >= 15


def test_ties_by_hand_stand_against_a_repeated_motif(orient: Orient) -> None:
    # Matching confused a window with the next one: 120 ties agree with a pose that is off by 0.4 m.
    beside = known_ties(CAMERA, 5, n=120, shift_m=np.array([0.4, 0.0, 0.0]))
    wrong = orient(beside, CALIBRATED)[0].cameras[0]
    assert wrong.status == "ok"
    assert ms.wall_error_m(SCENE, wrong.viewing(), CAMERA) > 0.2
    cameras, _ = orient(joined(replace(beside, walls=clicked(1).walls), clicked(1)), CALIBRATED)
    assert cameras.cameras[0].status == "ok"
    assert error_share(cameras.cameras[0]) < 3.0


def by_hand(
    points: NDArray[np.float64], noise_px: float = 0.0, **sigmas: NDArray[np.float64]
) -> tuple[Estimate, Start] | str:
    """Return the pose by ties to points that are exact except for the given noise."""
    n = len(points)
    noise = noise_px * np.random.default_rng(3).normal(size=(n, 2))
    seen = samples.seen(CAMERA.project(points)[:, :2] + noise, points, SIGMA_PX, 1e-4)
    seen = replace(seen, **sigmas)
    return pose_by_hand(tp.tied(tp.photo(CAMERA), seen, by_hand=np.ones(n, dtype=np.bool_)))


@pytest.mark.parametrize(("chance", "fits"), [(0.0012, True), (0.0008, False)])
def test_right_ties_are_called_contradictory_once_in_a_thousand_photos(
    chance: float, fits: bool
) -> None:
    # With six ties, none may be omitted.
    points = np.random.default_rng(2).uniform([0.9, -0.2, 0.7], [1.8, 0.2, 1.5], (6, 3))
    exact = {"sigma_m": np.zeros(6)}
    found = by_hand(points, 1.0, sigma_px=np.full(6, 3.0), **exact)
    assert not isinstance(found, str)
    # Errors are in pixels, since no residual is so small by chance that a larger one is assumed.
    squares = float((found[0].fit.residuals_px ** 2).sum())
    sigma_px = np.full(6, np.sqrt(squares / stats.chi2.isf(chance, 6)))
    assert isinstance(by_hand(points, 1.0, sigma_px=sigma_px, **exact), str) != fits


@pytest.mark.parametrize("relief_m", [0.0, 0.0004])
def test_a_small_plate_seen_from_afar_may_be_turned_either_way(relief_m: float) -> None:
    # Perspective distinguishes the two rotations of a plate of 12 cm, rotated by 35 degrees and
    # seen from 2.9 m, by only a quarter of a pixel.
    across, up = (grid.ravel() for grid in np.meshgrid(*[np.linspace(-0.06, 0.06, 3)] * 2))
    relief = relief_m * (np.arange(9) % 2 - 0.5)
    turn = np.deg2rad(35.0)
    along = across * np.cos(turn) - relief * np.sin(turn)
    away = across * np.sin(turn) + relief * np.cos(turn)
    points = np.array([1.3, 0.0, 1.1]) + np.stack([along, away, up], axis=1)
    reason = by_hand(points)
    assert isinstance(reason, str)
    assert reason.startswith("two different poses")


WALLS = ms.walls_of(SCENE)
PHOTO = photo()
PHOTOS = ms.photos(PHOTO)


def oriented(camera: ViewingCamera = CAMERA) -> Cameras:
    return ms.cameras(ms.oriented(camera))


def given(
    folder: Path, cameras: Cameras, ties: Ties | None = None, photos: Photos = PHOTOS
) -> tuple[Cameras, list[str]]:
    ctx = context(folder)
    inputs = OrientGiven.In(cameras=cameras, photos=photos, walls=WALLS, ties=ties)
    found = OrientGiven().run(inputs, OrientGiven.Params(), ctx).cameras
    return found, list(ctx.warnings)


def test_poses_elsewhere_or_behind_that_show_no_wall_are_refused(tmp_path: Path) -> None:
    elsewhere = replace(CAMERA, translation=CAMERA.translation + np.array([500.0, 0, 0]))
    for away in (elsewhere, ms.camera_before(centre=(1.3, 2.6, 1.1))):
        with pytest.raises(MethodError, match=r"no given pose shows a wall: the cameras are"):
            given(tmp_path, oriented(away))


OFF = ms.nudged(CAMERA, (0.02, -0.02, 0.01, 0.1, -0.05, 0.1))


def test_six_ties_by_hand_correct_a_given_pose_and_fewer_check_it(tmp_path: Path) -> None:
    assert ms.wall_error_m(SCENE, OFF, CAMERA) > 0.05
    cameras, _ = given(tmp_path, oriented(OFF), clicked(4))
    (found,) = cameras.cameras
    assert found.status == "ok"
    assert error_share(found) < 3.0
    assert found.intrinsics == Intrinsics.of(CAMERA)
    assert cameras.details["given"] == []
    three = samples.taken(clicked(4), slice(3))
    for camera, n_off in ((CAMERA, 0), (OFF, 3)):
        cameras, warnings = given(tmp_path, oriented(camera), three)
        assert cameras.cameras[0].status == "ok"
        assert len(warnings) == (n_off > 0)
    assert "3 of its 3 ties measured by hand disagree with the given pose, by up to" in warnings[0]


def test_ties_by_hand_orient_a_photo_without_a_pose(tmp_path: Path) -> None:
    lost = Cameras(cameras=(Camera(photo="a.png", status="Metashape did not align it"),))
    assert given(tmp_path, lost)[0].cameras == lost.cameras
    (found,) = given(tmp_path, lost, clicked(4), ms.photos(photo(CAMERA)))[0].cameras
    assert found.status == "ok"
    assert error_share(found) < 3.0
    # Fewer than six ties are treated as ordinary ties, of which eight are needed.
    few = samples.taken(clicked(4), slice(5))
    (found,) = tp.oriented(OrientPnp, few, CALIBRATED, context(tmp_path)).cameras
    assert found.status.startswith("too few ties to the walls were found (5;")


@pytest.mark.parametrize("n_by_hand", [0, 3], ids=["as they are", "checked by hand"])
def test_handed_on_cameras_keep_their_errors_and_ties(tmp_path: Path, n_by_hand: int) -> None:
    sigmas_m = {"a.png": 1.25e-3, "b.png": 3.5e-3, "c.png": None, "d.png": 1.5e-3}
    spread = np.diag(np.arange(1.0, 7.0)) * 1e-8
    known = replace(clicked(5, n=6), by_hand=None, photo_names=tuple(sigmas_m))
    known = replace(known, role=np.repeat([TieRole.CHECK, TieRole.CONTROL], 3).astype(np.uint8))
    # One tie is far from every wall.
    known.points_world[5] += 100.0
    handed_on = ms.cameras(
        *(
            replace(ms.oriented(CAMERA, name=name), sigma_wall_m=sigma_m, covariance=spread)
            for name, sigma_m in sigmas_m.items()
        )
    )
    handed_on = replace(handed_on, ties=known)
    (tmp_path / "given").mkdir()
    publish_cameras(handed_on, tmp_path / "given", "sha256:0")
    photos = ms.photos(*(replace(PHOTO, name=name) for name in sigmas_m))
    files = InputFiles(name="cameras", paths=tuple(sorted((tmp_path / "given").iterdir())))
    contexts = context(tmp_path), context(tmp_path)
    inputs = {"files": files, "photos": photos}
    cameras = run(ReadCameras, contexts[0], inputs).cameras
    ties = samples.taken(clicked(4), slice(n_by_hand)) if n_by_hand else None
    inputs = {"cameras": cameras, "photos": photos, "walls": WALLS, "ties": ties}
    placed = run(OrientGiven, contexts[1], inputs).cameras
    assert placed.details["given"] == list(sigmas_m)
    for camera in placed.cameras:
        np.testing.assert_allclose(camera.rotation_camera_from_world, CAMERA.rotation, atol=1e-12)
        np.testing.assert_allclose(camera.covariance, spread)
    assert placed.ties is not None
    later = samples.taken(placed.ties, slice(n_by_hand, None))
    np.testing.assert_array_equal(later.role, known.role)
    np.testing.assert_array_equal(later.wall, [0, 0, 0, 0, 0, -1])
    np.testing.assert_allclose(later.pixels_photo, known.pixels_photo)
    for ctx in contexts:
        assert not ctx.warnings
        found = {one.name: one.value for one in ctx.metrics if one.name.startswith("sigma_wall")}
        assert found == pytest.approx({"sigma_wall_mm_median": 1.5, "sigma_wall_mm_worst": 3.5})
