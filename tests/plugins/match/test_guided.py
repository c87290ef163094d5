"""Guided matching: displacements accurate to a few hundredths of a cell, from a rough pose."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from orthoflow_plugins.match import channels, displacements
from orthoflow_plugins.match.guided import MatchGuided
from orthoflow_plugins.match.sift import MatchSift
from scipy.ndimage import gaussian_filter, shift

from orthoflow.errors import MethodError
from orthoflow.files.images import decode_image, encode_png
from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.products import Camera, Cameras, Photos, Ties, Walls
from orthoflow.testing import photographed as ms
from tests import matched_walls as mw
from tests import samples

ROUGH = (0.004, -0.005, 0.003, 0.01, -0.02, 0.01)


SCENE = ms.textured_wall(1)


def guided(photos: Photos, walls: Walls, cameras: Cameras, folder: Path, **params: object) -> Ties:
    inputs = {"photos": photos, "walls": walls, "cameras": cameras}
    return mw.ties_of(MatchGuided, folder, inputs, **params)


def rough(camera: ViewingCamera) -> Cameras:
    """Return the pose of a photo with an error of a few centimetres."""
    return ms.cameras(ms.oriented(ms.nudged(camera, ROUGH)))


@pytest.mark.parametrize("moved", [(2.37, -1.41), (-3.5, 0.25)], ids=str)
@pytest.mark.parametrize("content", [channels.gradient_channels, channels.grey_channels])
def test_a_known_shift_is_measured_without_bias(content, moved: tuple[float, float]) -> None:  # type: ignore[no-untyped-def]
    rng = np.random.default_rng(3)
    grey = 40.0 * gaussian_filter(rng.normal(size=(240, 300)), 2.0, mode="wrap")
    later = shift(grey, (moved[1], moved[0]), order=5, mode="grid-wrap")
    # Neighbouring cells of a real picture share their noise.
    noise = [2.0 * gaussian_filter(rng.normal(size=grey.shape), 1.5) for _ in range(2)]
    noisy = [
        (image + off).astype(np.float32) for image, off in zip((grey, later), noise, strict=True)
    ]
    first, second = (content(image) for image in noisy)
    places = channels.textured_places(channels.texture(first), first.known > 0.0, 200)
    found = displacements.measure(first, second, places, radius_cells=6, min_score=0.3)
    assert len(found.places) > 100
    error = found.shift_cells - moved
    np.testing.assert_allclose(error.mean(axis=0), 0.0, atol=0.02)
    assert np.sqrt(np.mean(error**2)) < 0.12
    if content is channels.grey_channels:
        # Half of a normal distribution is within 0.67 standard deviations.
        ratios = np.abs(error) / found.sigma_cells[:, None]
        assert np.median(ratios) == pytest.approx(0.67, abs=0.2)


@pytest.mark.parametrize("content", ["grey", "colours"])
def test_a_rough_pose_suffices(tmp_path: Path, content: str) -> None:
    camera, walls = ms.camera_before(), mw.walls(1)
    photo = ms.photo_of(SCENE, camera)
    if content == "colours":
        # For the laser, red is bright and green is dark.
        (wall,), (other,) = walls.walls, mw.walls(3).walls
        green = decode_image(ms.photo_of(ms.textured_wall(3), camera).encoded, "a.png")[..., 0]
        red = decode_image(photo.encoded, "a.png")[..., 0]
        photo = replace(photo, encoded=encode_png(np.dstack([red, green, red])))
        intensity = np.asarray(0.5 + 0.6 * (wall.intensity - other.intensity), np.float32)
        walls = replace(walls, walls=(replace(wall, intensity=intensity),))
    ties = guided(ms.photos(photo), walls, rough(camera), tmp_path)
    assert ties.details["photos"]["a.png"]["channels"] == content  # type: ignore[call-overload,index]
    error = mw.off_px(ties, camera)
    assert len(error) > 200
    assert np.linalg.norm(error, axis=1).max() < 1.5
    # A cell has 1.9 photo pixels, so this is a tenth of a cell.
    assert np.sqrt(np.mean(error**2)) < 0.2
    np.testing.assert_allclose(error.mean(axis=0), 0.0, atol=0.05)


def test_cells_finer_than_points_lie_apart_do_as_well(tmp_path: Path) -> None:
    fine = ms.walls_of(replace(SCENE, frame=ms.textured_wall(1, gsd_m=0.003).frame)).walls[0]
    # Every fifth cell has a point and no gap is filled, so points are 6.7 mm apart.
    is_void = np.random.default_rng(8).random(fine.frame.shape) > 0.2
    sparse = samples.wall(
        fine.frame,
        depth_m=np.where(is_void, np.float32(np.nan), fine.depth_m),
        sigma_m=np.full(fine.frame.shape, np.nan, dtype=np.float32),
        count=np.where(is_void, 0, fine.count // 3).astype(np.uint32),
        intensity=np.where(is_void, np.float32(np.nan), fine.intensity),
    )
    camera = ms.camera_before()
    walls = replace(mw.walls(1), walls=(sparse,))
    ties = guided(ms.photos(ms.photo_of(SCENE, camera)), walls, rough(camera), tmp_path)
    error = mw.off_px(ties, camera)
    assert len(error) > 200
    assert np.sqrt(np.mean(error**2)) < 0.3
    np.testing.assert_allclose(error.mean(axis=0), 0.0, atol=0.05)
    assert 0.3 < np.sqrt(np.mean((error / ties.sigma_px[:, None]) ** 2)) < 1.4
    # Orientations are assessed with the cells of the orthoimage.
    assert ties.walls[0].gsd_m == pytest.approx(0.003)


@pytest.mark.parametrize("is_ambiguous", [False, True])
def test_a_photo_without_a_pose_is_found_by_what_another_shows_of_the_wall(
    tmp_path: Path, is_ambiguous: bool
) -> None:
    # The intensity depends on the absolute difference of grey from its median, so edges have no
    # sign.
    (wall,) = mw.walls(1).walls
    assert wall.intensity is not None
    stripes = np.where(wall.intensity > np.nanmedian(wall.intensity), 1.0, -1.0)
    strange = replace(wall, intensity=(0.5 + stripes * (wall.intensity - 0.5)).astype(np.float32))
    cameras = {
        "a.png": ms.camera_before(),
        "b.png": ms.camera_before(centre=(1.9, -2.3, 0.9), roll=1.57),
    }
    photos = ms.photos(*(ms.photo_of(SCENE, each, name=name) for name, each in cameras.items()))
    start = ms.cameras(
        ms.oriented(ms.nudged(cameras["a.png"], ROUGH)),
        Camera(photo="b.png", status="no ties", is_ambiguous=is_ambiguous),
    )
    ties = guided(photos, replace(mw.walls(1), walls=(strange,)), start, tmp_path)
    mine = ties.photo == 1
    error = ties.pixels_photo[mine] - cameras["b.png"].project(ties.points_world[mine])[:, :2]
    assert (mine.sum() > 100) != is_ambiguous
    assert is_ambiguous or np.sqrt(np.mean(error**2)) < 0.6


def test_ties_on_a_part_of_the_wall_that_was_moved_are_rejected(tmp_path: Path) -> None:
    # The moved ties agree with their neighbours, but differ from the others by four cells.
    camera = ms.camera_before()
    photo = ms.photo_of(SCENE, camera)
    rgb = decode_image(photo.encoded, "a.png").copy()
    rgb[220:380, 380:540] = rgb[220:380, 372:532]
    moved = replace(photo, encoded=encode_png(rgb))
    start = ms.cameras(ms.oriented(camera))
    ties = guided(ms.photos(moved), mw.walls(1), start, tmp_path)
    error_px = np.linalg.norm(mw.off_px(ties, camera), axis=1)
    assert len(error_px) > 200
    assert error_px.max() < 4.0


def test_no_oriented_photo_is_refused_and_a_pose_far_off_gives_hardly_any_ties(
    tmp_path: Path,
) -> None:
    camera = ms.camera_before()
    photos = ms.photos(ms.photo_of(SCENE, camera))
    off = ms.nudged(camera, (0.0, 0.15, 0.0, -0.4, 0.0, 0.0))
    assert len(guided(photos, mw.walls(1), ms.cameras(ms.oriented(off)), tmp_path).photo) < 30
    refused = ms.cameras(Camera(photo="a.png", status="3 ties with the walls"))
    with pytest.raises(MethodError, match=r"no photo is oriented.*a\.png: 3 ties with the walls"):
        guided(photos, mw.walls(1), refused, tmp_path)


def test_the_papers_mask_keeps_best_matches_from_going_astray(tmp_path: Path) -> None:
    # The photo shows a quarter of the wall; without the ratio test, every key point of the wall has
    # a match.
    camera = ms.camera_before(centre=(1.0, -1.3, 1.0), towards=(1.0, 0.0, 1.0))
    inputs = {"photos": ms.photos(ms.photo_of(SCENE, camera)), "walls": mw.walls(1)}
    wrong, n_right = {}, {}
    for ratio in (1.0, 0.8):
        settings = {"preset": "paper", "ratio": ratio}
        plain = mw.ties_of(MatchSift, tmp_path, inputs, **settings)
        masked = guided(*inputs.values(), rough(camera), tmp_path, **settings)
        for name, ties in (("plain", plain), ("masked", masked)):
            off = mw.off_px(ties, camera)
            is_wrong = ~(np.linalg.norm(off, axis=1) < 6.0)
            wrong[name, ratio], n_right[name, ratio] = is_wrong.mean(), int((~is_wrong).sum())
    # Measured in both ways: 587 right matches without the ratio test, and 542 with it.
    assert n_right["masked", 1.0] > 0.9 * n_right["plain", 1.0] > 100
    assert n_right["masked", 0.8] > 0.9 * n_right["plain", 0.8] > 0.8 * n_right["plain", 1.0]
    # Measured: 83 % and 33 % wrong matches without the ratio test, 7 % and 1 % with that of
    # openMVG.
    assert wrong["plain", 1.0] > 0.5
    assert wrong["masked", 1.0] < 0.6 * wrong["plain", 1.0]
    assert wrong["plain", 0.8] < 0.2 * wrong["plain", 1.0]
    assert wrong["masked", 0.8] < 0.6 * wrong["plain", 0.8]
    right = np.linalg.norm(off, axis=1) < 2.0
    np.testing.assert_allclose(off[right].mean(axis=0), 0.0, atol=0.1)
