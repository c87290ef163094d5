"""Photos found by what others show: whose lens they have, which of them paints, and which pose."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.match import recovering
from orthoflow_plugins.match.descriptors import Matches
from orthoflow_plugins.match.features import Features
from orthoflow_plugins.match.recovering import (
    PaintedWall,
    _pose,
    lens_of,
    painted_walls,
    recovered_pose,
)

from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.products import Camera, Intrinsics, Photo
from orthoflow.testing import photographed as ms
from tests import samples
from tests.scenes import SURVEY_SHIFT_M

VIEW = ms.camera_before(ms.textured_wall(0))


def photo(**known: Any) -> Photo:
    return Photo(**{"name": "new.png", "encoded": b"", "width": 900, "height": 640, **known})


def oriented(focal_px: float, *, width: int = 900, height: int = 640) -> Camera:
    view = replace(VIEW, fx=focal_px, fy=focal_px, width=width, height=height)
    return ms.oriented(view, name="old.png")


def test_a_calibrated_photo_keeps_its_lens() -> None:
    own = replace(VIEW, fx=777.0)
    found = lens_of(photo(intrinsics=Intrinsics.of(own)), {"old.png": oriented(500.0)}, ms.photos())
    assert found is not None
    assert found == Intrinsics.of(own)


@pytest.mark.parametrize(
    ("exif_px", "is_known"),
    [(None, True), (1000.0, True), (920.0, True), (1100.0, True), (905.0, False), (1120.0, False)],
)
def test_a_lens_is_taken_from_a_photo_of_the_same_size_and_nearly_the_same_focal_length(
    exif_px: float | None, is_known: bool
) -> None:
    found = lens_of(photo(exif_focal_px=exif_px), {"old.png": oriented(1000.0)}, ms.photos())
    assert (found is not None) == is_known
    if found is not None:
        assert found.fx == 1000.0


def test_a_lens_that_contradicts_exif_is_that_of_photos_with_the_same_exif() -> None:
    old, new = photo(name="old.png", exif_focal_px=500.0), photo(exif_focal_px=500.0)
    found = lens_of(new, {"old.png": oriented(1000.0)}, ms.photos(old, new))
    assert found is not None
    assert found.fx == 1000.0


@pytest.mark.parametrize("size", [(640, 900), (900, 641), (901, 640)])
def test_photos_of_another_size_have_another_lens(size: tuple[int, int]) -> None:
    cameras = {"old.png": oriented(1000.0, width=size[0], height=size[1])}
    assert lens_of(photo(), cameras, ms.photos()) is None
    assert lens_of(photo(), {}, ms.photos()) is None


def test_a_missing_photo_starts_with_the_lens_that_ties_tell_best() -> None:
    photos = ms.photos(photo(name="few.png"), photo(name="many.png"), photo())
    rough = replace(VIEW, fx=1.1 * VIEW.fx, fy=1.1 * VIEW.fy)
    known = {
        name: replace(ms.oriented(rough, name=name), intrinsics=Intrinsics.of(rough, source=source))
        for name, source in (("few.png", "estimated"), ("many.png", "estimated"))
    }
    traces: Any = [trace_of(at, n, rough) for at, n in ((0, 16), (1, 80))]
    found = lens_of(photo(), recovering._settled(photos, known, traces), photos)
    assert found is not None
    assert found.source == "estimated"
    assert found.fx == pytest.approx(VIEW.fx, rel=0.01)
    # What was given from elsewhere stays, and is known best.
    given = Intrinsics.of(replace(rough, fx=1000.0))
    known["few.png"] = replace(known["few.png"], intrinsics=given)
    assert lens_of(photo(), recovering._settled(photos, known, traces), photos) == given
    assert recovering._settled(photos, known, traces)["many.png"].viewing().fx == found.fx


def trace_of(index: int, n: int, camera: ViewingCamera) -> Any:
    """Exact ties of the view, traced from a camera."""
    pixels, points = ties(n, seed=index)
    piece = SimpleNamespace(
        pixels_photo=pixels,
        points_world=points,
        sigma_px=np.full(len(pixels), 0.3),
        sigma_m=np.full(len(pixels), 1e-4),
    )
    return SimpleNamespace(pieces=[piece], view=SimpleNamespace(index=index, camera=camera))


def view_of(
    grey: float, part: tuple[slice, slice], size: float, *, unknown: tuple[int, int] | None = None
) -> Any:
    """A photo that shows one grey in a part of the first of two walls, so large."""
    projection = SimpleNamespace(part=part, pixels_per_cell=size)
    shown = np.full((part[0].stop - part[0].start, part[1].stop - part[1].start), grey, np.float32)
    if unknown is not None:
        shown[unknown] = np.nan
    return SimpleNamespace(
        view=SimpleNamespace(
            projections=[projection, None], on_wall=lambda _index, _projection: shown
        )
    )


def test_of_photos_the_one_that_shows_a_place_largest_paints_it() -> None:
    walls = [samples.wall(samples.facing_south(0.01, 30, 20)) for _ in range(2)]
    small = view_of(100.0, (slice(0, 20), slice(0, 30)), 0.5)
    large = view_of(200.0, (slice(0, 10), slice(5, 15)), 2.0, unknown=(3, 2))
    middle = view_of(50.0, (slice(5, 15), slice(0, 30)), 1.0)
    expected = np.full((20, 30), 100.0)
    expected[5:15] = 50.0
    expected[:10, 5:15] = 200.0
    # What the largest does not know is the next one's.
    expected[3, 7] = 100.0
    for order in ((small, middle, large), (large, small, middle)):
        first, second = painted_walls(order, walls)  # type: ignore[arg-type]
        assert first.wall.intensity is not None
        np.testing.assert_allclose(first.wall.intensity, expected / 255.0, atol=1e-6)
        assert first.features is not None
        assert second.features is None
        assert second.wall.intensity is not None
        assert np.isnan(second.wall.intensity).all()


def ties(n: int, seed: int = 1) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    rng = np.random.default_rng(seed)
    points = rng.uniform([0.2, -0.3, 0.2], [2.8, 0.1, 1.8], (6 * n, 3))
    pixels = VIEW.project(points)[:, :2]
    inside = np.flatnonzero(VIEW.sees(pixels))[:n]
    return pixels[inside], points[inside]


def lens() -> ViewingCamera:
    """The lens of the view, its pose forgotten."""
    return replace(VIEW, rotation=np.eye(3), translation=np.zeros(3))


@pytest.mark.parametrize("shift_m", [np.zeros(3), SURVEY_SHIFT_M], ids=["near", "survey"])
@pytest.mark.parametrize("wrong_share", [0.0, 0.4])
def test_the_pose_is_the_one_that_most_points_agree_with(
    wrong_share: float, shift_m: NDArray[np.float64]
) -> None:
    pixels, points = ties(80)
    n_wrong = round(wrong_share * len(pixels))
    wrong = pixels.copy()
    wrong[:n_wrong] = np.random.default_rng(5).uniform([0, 0], [900, 640], (n_wrong, 2))
    found = _pose(wrong, points + shift_m, lens(), 2.0)
    assert found is not None
    np.testing.assert_allclose(found.centre_world, VIEW.centre_world + shift_m, atol=2e-3)
    np.testing.assert_allclose(found.project(points + shift_m)[:, :2], pixels, atol=0.5)
    assert (found.fx, found.cx) == (VIEW.fx, VIEW.cx)


@pytest.mark.parametrize(("n_right", "is_found"), [(23, False), (24, True)])
def test_two_dozen_points_must_agree_with_a_pose(n_right: int, is_found: bool) -> None:
    pixels, points = ties(40)
    pixels[n_right:] = np.random.default_rng(6).uniform([0, 0], [900, 640], (40 - n_right, 2))
    assert (_pose(pixels, points, lens(), 0.5) is not None) == is_found


def key_points(pixels: NDArray[np.float64]) -> Features:
    n = len(pixels)
    return Features(
        pixels=pixels,
        sizes_px=np.full(n, 4.0),
        angles_deg=np.zeros(n),
        descriptors=np.zeros((n, 128), dtype=np.float32),
    )


def test_matches_that_agree_are_pixels_and_points_of_the_walls_shown() -> None:
    frame = samples.facing_south(0.01, 40, 30)
    cells = np.random.default_rng(2).uniform(5.0, 25.0, (6, 2))
    wall = PaintedWall(wall=samples.wall(frame), features=key_points(cells))
    blind = PaintedWall(wall=samples.wall(frame), features=None)
    in_photo = key_points(np.arange(12.0).reshape(6, 2))
    at = np.arange(5)
    matches = Matches(first=at, second=at[::-1] + 1, ratio=np.ones(5))

    def pair(index: int, *, is_shown: bool) -> Any:
        return SimpleNamespace(wall=index, matches=matches, agreeing=at % 2 == 0, is_shown=is_shown)

    pairs: Any = SimpleNamespace(
        features=in_photo,
        scale=1.0,
        pairs=[pair(0, is_shown=False), pair(0, is_shown=True), pair(1, is_shown=True)],
    )
    pixels, points = recovering._agreeing(pairs, [wall, blind])
    np.testing.assert_array_equal(pixels, in_photo.pixels[[0, 2, 4]])
    np.testing.assert_allclose(points, frame.world_from_wall(cells[[5, 3, 1]], np.zeros(3)))
    pairs.pairs.clear()
    pixels, points = recovering._agreeing(pairs, [wall, blind])
    assert (pixels.shape, points.shape) == ((0, 2), (0, 3))


@pytest.mark.parametrize(("n", "is_found"), [(23, False), (24, True)])
def test_a_pose_is_asked_of_two_dozen_matches_that_agree(
    monkeypatch: pytest.MonkeyPatch, n: int, is_found: bool
) -> None:
    pixels, points = ties(n)
    monkeypatch.setattr(recovering, "pair_photo", lambda *_: None)
    monkeypatch.setattr(recovering, "_agreeing", lambda *_: (pixels, points))
    limits: list[float] = []
    monkeypatch.setattr(recovering, "_pose", lambda *args: limits.append(args[-1]) or VIEW)
    grey = np.zeros((640, 900), dtype=np.uint8)
    assert (recovered_pose(grey, [], lens()) is not None) == is_found
    # Two thousandths of the photo's longer side.
    assert limits == [pytest.approx(1.8)] * is_found
