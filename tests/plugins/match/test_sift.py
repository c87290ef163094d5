"""Matching photos with walls: unbiased ties, colours with other reflectances, ties by hand."""

from __future__ import annotations

from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.match.guided import MatchGuided
from orthoflow_plugins.match.key_points import mixed
from orthoflow_plugins.match.pictures import points_on_wall
from orthoflow_plugins.match.sift import MatchSift

from orthoflow.errors import MethodError
from orthoflow.files.images import decode_image, encode_png
from orthoflow.products import Photo, TieRole, Ties, Walls
from orthoflow.testing import photographed as ms
from tests import matched_walls as mw
from tests import samples
from tests.long_loops import long_only
from tests.method_runs import run
from tests.tied_photos import context

SCENE = ms.textured_wall(1)


def level_photo() -> Photo:
    return ms.photo_of(SCENE, ms.camera_before())


def sift(
    folder: Path, photo: Photo, walls: Walls | None = None, hand: Ties | None = None
) -> tuple[Ties, list[str]]:
    """Return the ties of a photo and the codes of diagnostics."""
    ctx = context(folder)
    inputs = {"photos": ms.photos(photo), "walls": walls or mw.walls(1), "hand": hand}
    return run(MatchSift, ctx, inputs).ties, [each.code for each in ctx.diagnostics]


@pytest.mark.parametrize("roll", [0.0, *long_only(1.57)])
def test_ties_lie_where_the_true_camera_sees_their_points(tmp_path: Path, roll: float) -> None:
    camera = ms.camera_before(roll=roll)
    ties, _ = sift(tmp_path, ms.photo_of(SCENE, camera))
    error = mw.off_px(ties, camera)
    length = np.linalg.norm(error, axis=1)
    right = error[length < 3.0]
    assert len(right) > 1000
    assert np.mean(length >= 3.0) < 0.05
    # With OpenCV's default, the mean would be a quarter of a pixel.
    np.testing.assert_allclose(right.mean(axis=0), 0.0, atol=0.05)
    # The predicted standard deviation is approximately that of the ties.
    depth = camera.project(ties.points_world)[:, 2]
    stated = np.hypot(ties.sigma_px, ties.sigma_m * camera.fx / depth)[length < 3.0]
    assert 0.3 < np.sqrt(np.mean((right / stated[:, None]) ** 2)) < 1.5


def test_where_photos_are_upside_down_the_run_goes_no_further(tmp_path: Path) -> None:
    with pytest.raises(MethodError, match="upside down"):
        sift(tmp_path, ms.photo_of(SCENE, ms.camera_before(roll=3.1)))
    ties, _ = sift(tmp_path, level_photo())
    down = replace(ties, pixels_photo=-ties.pixels_photo)
    # The ties of a floor or ceiling do not tell.
    level = replace(down, points_world=ties.points_world[:, [0, 2, 1]])
    found = [one.upside_down(np.array([0.0, 0.0, 1.0])) for one in (ties, down, level)]
    assert found == [{}, {"n_down": 1, "n_photos": 1, "opposite": "-z"}, {}]


def test_a_photo_of_nothing_known_is_warned_of(tmp_path: Path) -> None:
    ties, codes = sift(tmp_path, photo_with(np.full((480, 640), 128, np.uint8)))
    assert not (ties.role != TieRole.REJECTED).any()
    assert codes == ["photo-shows-no-wall"]


@pytest.mark.parametrize("share", [0.04, 0.06, 0.2])
def test_a_mirrored_photo_is_recognised_as_such(tmp_path: Path, share: float) -> None:
    # The right side of the wall is the mirror image of its left side. Narrow sides are coloured, so
    # a mixture shows hardly anything else.
    (wall,) = mw.walls(1).walls
    side, symmetric = round(share * wall.frame.width), np.array(wall.intensity)
    symmetric[:, -side:] = symmetric[:, side - 1 :: -1]
    flat = np.where(np.isfinite(symmetric), 0.0, np.nan).astype(np.float32)
    palace = replace(mw.walls(1), walls=(replace(wall, intensity=symmetric, depth_m=flat),))
    mirrored = np.repeat(np.nan_to_num(symmetric * 255.0)[:, ::-1, None], 3, axis=2)
    if share < 0.1:
        sides = np.r_[:side, -side:0]
        mirrored[:, sides] = 110.0 + (mirrored[:, sides] - 110.0) * [0.5, -0.25, 0.0]
    ties, codes = sift(tmp_path, photo_with(mirrored.clip(0, 255).astype(np.uint8)), palace)
    assert not (ties.role != TieRole.REJECTED).any()
    assert codes == ["photo-mirrored"]


@pytest.mark.parametrize("n_even", [0, 400], ids=["steps alone", "some elsewhere"])
def test_where_few_cells_have_several_points_those_on_steps_decide_no_uncertainty(
    n_even: int,
) -> None:
    # Cells are half as wide as the point spacing, so hardly any cell except at the step has several
    # points.
    (wall,) = mw.walls(1).walls
    depth, sigma = wall.depth_m.copy(), np.full_like(wall.sigma_m, np.nan)
    depth[:, 300:] += 0.2
    sigma[:, 299:301] = 0.1
    count = np.where(np.isfinite(sigma), 2, 1).astype(np.uint32)
    rows, columns = np.divmod(np.arange(n_even), 20)
    sigma[rows, columns], count[rows, columns] = 0.0015, 2
    sparse = replace(wall, depth_m=depth, sigma_m=sigma, count=count)
    flat = points_on_wall(sparse, np.array([[100.3, 80.7]]))
    # Sigma is half a cell if nothing else is known; otherwise, it is less than a tenth of the sigma
    # on the step.
    assert flat[1][0] < (0.01 if n_even else 0.7 * ms.GSD_M)
    edge = points_on_wall(sparse, np.array([[300.1, 80.7]]))
    assert edge[1][0] > 0.05


def measured(*names: str) -> Ties:
    count = len(names)
    return samples.ties(
        np.arange(2.0 * count).reshape(count, 2),
        photo_names=("stranger.png", "a.png"),
        photo=np.array([("stranger.png", "a.png").index(name) for name in names], dtype=np.int32),
        wall=np.full(count, -1, np.int32),
        points_world=np.array([[0.5 + 0.1 * k, 0.3, 1.0] for k in range(count)]),
        sigma_px=np.ones(count),
        sigma_m=np.full(count, 0.002),
        by_hand=np.ones(count, np.uint8),
    )


def test_ties_by_hand_stand_behind_those_that_are_found(tmp_path: Path) -> None:
    alone, _ = sift(tmp_path, level_photo())
    assert alone.by_hand is None
    hand = measured("a.png", "stranger.png", "a.png")
    both, _ = sift(tmp_path, level_photo(), hand=hand)
    count = len(alone.photo)
    np.testing.assert_array_equal(both.pixels_photo[:count], alone.pixels_photo)
    np.testing.assert_array_equal(both.pixels_photo[count:], hand.pixels_photo[[0, 2]])
    np.testing.assert_array_equal(both.points_world[count:], hand.points_world[[0, 2]])
    assert both.photo_names == ("a.png",)
    for name, value in (("photo", 0), ("wall", 0), ("by_hand", 1)):
        np.testing.assert_array_equal(getattr(both, name)[count:], [value, value])
    assert not both.by_hand[:count].any()


def test_a_tie_by_hand_lies_on_the_nearest_wall(tmp_path: Path) -> None:
    (wall,) = mw.walls(1).walls
    moves = np.array([[0.0, 1.0, 0.0], [5.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    frames = [replace(wall.frame, origin_world=wall.frame.origin_world + move) for move in moves]
    walls = tuple(replace(wall, frame=frame, intensity=None) for frame in frames)
    hand = replace(
        measured("a.png", "a.png", "a.png"),
        points_world=np.array([[1.0, 0.9, 1], [5.5, 0.2, 1], [1.0, 0.3, 1]]),
    )
    ties, _ = sift(tmp_path, level_photo(), replace(mw.walls(1), walls=walls), hand)
    np.testing.assert_array_equal(ties.wall, [0, 1, 2])


def test_walls_that_show_nothing_leave_the_ties_by_hand(tmp_path: Path) -> None:
    bare = replace(
        mw.walls(1), walls=tuple(replace(wall, intensity=None) for wall in mw.walls(1).walls)
    )
    with pytest.raises(MethodError, match="neither intensity nor colour"):
        sift(tmp_path, level_photo(), bare)
    hand = measured("a.png", "a.png")
    inputs = {"photos": ms.photos(level_photo()), "walls": bare, "hand": hand}
    cameras = {"cameras": ms.cameras(ms.oriented(ms.camera_before()))}
    for method, more in ((MatchSift, {}), (MatchGuided, cameras)):
        ctx = context(tmp_path)
        ties = run(method, ctx, {**inputs, **more}).ties
        np.testing.assert_array_equal(ties.by_hand, [1, 1])
        assert len(ties.walls) == 1
        assert [each.code for each in ctx.diagnostics] == ["scan-without-texture"]


# The camera shows only the middle of the picture, which contains enough key points.
CAMERA = replace(ms.camera_before(), width=630, height=448, cx=0.5 * 630, cy=0.5 * 448)


def grey_of(seed: int) -> NDArray[np.uint8]:
    """Return a photo of the wall with one texture; the relief is the same for all textures."""
    return decode_image(ms.photo_of(ms.textured_wall(seed), CAMERA).encoded, "a.png")[:, :, 0]


def photo_with(rgb: NDArray[np.uint8]) -> Photo:
    height, width = rgb.shape[:2]
    return Photo(name="a.png", encoded=encode_png(rgb), width=width, height=height)


def wall_with(red: float, green: float) -> Walls:
    """Return the wall with an intensity combined from the textures 1 (red) and 2 (green)."""
    first, second = (mw.walls(seed).walls[0] for seed in (1, 2))
    intensity = 0.5 + red * (first.intensity - 0.45) + green * (second.intensity - 0.45)
    return replace(mw.walls(1), walls=(replace(first, intensity=intensity.astype(np.float32)),))


@pytest.mark.parametrize(
    ("green", "laser", "mixture"),
    [(2, (0.6, -0.6), "red less green"), (1, (-1.0, 0.0), "red as dark")],
    ids=["two materials", "without colours"],
)
def test_a_photo_is_found_in_the_mixture_that_the_laser_sees(
    tmp_path: Path, green: int, laser: tuple[float, float], mixture: str
) -> None:
    rgb = np.stack([grey_of(1), grey_of(green), grey_of(1)], axis=-1)
    ties, _ = sift(tmp_path, photo_with(rgb), wall_with(*laser))
    assert right(ties) > 150
    assert right(ties) > 0.9 * (ties.role != TieRole.REJECTED).sum()
    assert ties.details["photos"]["a.png"]["picture"] == mixture  # type: ignore[call-overload,index]


def test_a_photo_of_something_else_gets_no_ties_in_any_mixture(tmp_path: Path) -> None:
    rgb = np.stack([grey_of(seed) for seed in (2, 3, 4)], axis=-1)
    ties, _ = sift(tmp_path, photo_with(rgb), wall_with(1.0, 0.0))
    assert (ties.role != TieRole.REJECTED).sum() == 0


def right(ties: Ties) -> int:
    """Count the ties within two cells of the true pixels of their points."""
    kept = ties.role != TieRole.REJECTED
    return int((np.linalg.norm(mw.off_px(ties, CAMERA)[kept], axis=1) < 4.0).sum())


# --- choice of mixtures ---


@pytest.mark.parametrize(("levels", "shows"), [(7, False), (9, True)])
def test_a_mixture_of_hardly_any_contrast_shows_nothing(levels: int, *, shows: bool) -> None:
    ramp = np.rint(np.linspace(100, 100 + levels, 400))
    colours = np.stack([np.full_like(ramp, 50), ramp, ramp], axis=-1)
    found = mixed(np.tile(colours, (40, 1, 1)).astype(np.uint8), "green less red")
    assert (found is not None) is shows
    if found is not None:
        assert (found.min(), found.max()) == (0, 255)
        assert (np.diff(found[0].astype(int)) >= 0).all()


@pytest.mark.long
def test_photos_of_repeating_windows_are_oriented_where_they_are(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.syspath_prepend(Path(__file__).parents[3] / "benchmarks")
    courtyard = import_module("courtyard")
    built = courtyard.courtyard(2, 4, coarser=2.0)
    n_facades, errors = courtyard.oriented(built, coarser=2.0)
    assert n_facades == 4
    assert [error.status for error in errors] == ["ok"] * 4
    assert not any(error.is_wrong for error in errors)
    # A shift by one window would be 1.9 m.
    assert max(error.centre_m for error in errors) < 0.05
