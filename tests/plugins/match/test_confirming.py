"""Photos confirm each other's places on walls where no key points recognise them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.match import confirming
from orthoflow_plugins.match.confirming import confirmed
from orthoflow_plugins.match.pairing import USUAL_RULE, PhotoPairs, pair_photo, wall_features
from orthoflow_plugins.match.pictures import photo_grey
from orthoflow_plugins.match.placing import Placed, PlacedWalls
from orthoflow_plugins.match.sift import MatchSift
from orthoflow_plugins.match.tie_pieces import TiePiece

from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.products import Photos, Ties
from orthoflow.sdk import StepContext
from orthoflow.testing import photographed as ms

SCENE = ms.textured_wall(1)
WALLS = ms.walls_of(SCENE)
CAMERAS = [
    ms.camera_before(SCENE),
    ms.camera_before(SCENE, centre=(1.9, -2.2, 1.0), towards=(1.7, 0.0, 0.9)),
    ms.camera_before(SCENE, centre=(1.5, -2.4, 0.9), towards=(1.4, 0.0, 1.1)),
]


@cache
def photos() -> Photos:
    return Photos(
        photos=tuple(
            replace(ms.photo_of(SCENE, camera), name=f"{nth}.png")
            for nth, camera in enumerate(CAMERAS)
        )
    )


def place(
    photo: int, *, aside_m: float = 0.0, share: float = 0.3, is_clear: bool = False
) -> Placed:
    """A place of a photo, the right one or so far to the right of it."""
    camera = moved(CAMERAS[photo], aside_m)
    frame = SCENE.frame
    cells = np.stack(np.meshgrid(np.arange(100.0, 400.0, 30.0), np.arange(60.0, 280.0, 30.0)), -1)
    points = frame.world_from_wall(cells.reshape(-1, 2), np.zeros(cells[..., 0].size))
    piece = TiePiece(
        photo=photo,
        wall=0,
        pixels_photo=camera.project(points)[:, :2],
        points_world=points,
        sigma_px=np.ones(len(points)),
        sigma_m=np.full(len(points), 0.01),
    )
    return Placed(
        piece=piece, camera=camera, lead=6.0, share=share, radius_px=30.0, is_clear=is_clear
    )


def moved(camera: ViewingCamera, aside_m: float) -> ViewingCamera:
    return camera.shifted(-aside_m * SCENE.frame.u_world)


def chosen(places: dict[int, Sequence[Placed]], recognised: Sequence[int] = ()) -> dict[int, float]:
    """Metres that the chosen places are aside, by photo."""
    rule = USUAL_RULE
    features = [wall_features(WALLS.walls[0], rule)]
    pairs = {k: pair_photo(photo_grey(photos().photos[k]), features, rule) for k in recognised}
    found = confirmed(photos(), places, pairs, PlacedWalls(walls=WALLS.walls))
    return {
        k: float((place.camera.centre_world - CAMERAS[k].centre_world)[0])
        for k, place in found.items()
    }


def test_places_that_agree_are_taken_if_one_of_them_is_clear() -> None:
    near = pytest.approx(0.0, abs=1e-9)
    assert chosen({0: [place(0, is_clear=True)], 1: [place(1)]}) == {0: near, 1: near}
    assert chosen({0: [place(0)], 1: [place(1)]}) == {}
    assert chosen({k: [place(k)] for k in range(3)}) == {0: near, 1: near, 2: near}


def test_a_place_that_no_photo_confirms_is_not_taken_however_clear_it_is() -> None:
    assert chosen({0: [place(0, is_clear=True)]}) == {}
    wrong = place(0, aside_m=0.3, share=0.6, is_clear=True)
    assert chosen({0: [wrong], 1: [place(1, is_clear=True)]}) == {}


def test_of_several_places_of_a_photo_the_one_that_others_confirm_is_taken() -> None:
    near = pytest.approx(0.0, abs=1e-9)
    wrong = place(0, aside_m=0.3, share=0.6)
    right = {1: [place(1, is_clear=True)], 2: [place(2)]}
    assert chosen({0: [wrong, place(0)], **right}) == {0: near, 1: near, 2: near}


def test_photos_that_are_wrong_together_lose_to_one_that_key_points_recognise() -> None:
    wrong = [place(k, aside_m=0.3, share=0.6, is_clear=True) for k in range(2)]
    assert chosen({0: wrong[:1], 1: wrong[1:]}) == {
        k: pytest.approx(0.3, abs=1e-9) for k in range(2)
    }
    near = pytest.approx(0.0, abs=1e-9)
    both = {0: [wrong[0], place(0)], 1: [wrong[1]]}
    assert chosen(both, recognised=[2]) == {0: near}


def test_key_points_that_agree_by_chance_do_not_keep_a_photo_from_its_place() -> None:
    near = pytest.approx(0.0, abs=1e-9)
    features = [wall_features(WALLS.walls[0], USUAL_RULE)]
    right = pair_photo(photo_grey(photos().photos[2]), features, USUAL_RULE)
    (pair,) = right.pairs
    assert pair.homography is not None
    shift = np.array([[1.0, 0.0, 120.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    wrong = replace(right, pairs=(replace(pair, homography=shift @ pair.homography),))
    places = {k: [place(k)] for k in range(3)}

    def taken(pairs: PhotoPairs) -> dict[int, float]:
        found = confirmed(photos(), places, {2: pairs}, PlacedWalls(walls=WALLS.walls))
        return {
            k: float((one.camera.centre_world - CAMERAS[k].centre_world)[0])
            for k, one in found.items()
        }

    assert taken(wrong) == dict.fromkeys(range(3), near)
    # Where the others confirm its key points, these stay.
    assert taken(right) == {0: near, 1: near}


def sifted(
    folder: Path, places: dict[int, list[Placed]], structure: Literal["never", "confirmed", "alone"]
) -> tuple[Ties, list[str]]:
    ctx = StepContext(rng=np.random.default_rng(1), cores=2, scratch=folder)
    inputs = MatchSift.In(photos=Photos(photos=photos().photos[:2]), walls=WALLS)
    # Key points count for nothing here, so that a few will do.
    params = MatchSift.Params(structure=structure, n_features_max=500)
    ties = MatchSift().run(inputs, params, ctx).ties
    return ties, ctx.warnings


def test_a_photo_that_nobody_confirms_is_placed_only_for_who_asks_and_looks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # As if no key points had shown a wall clearly.
    for least in ("LEAST", "CLEARLY"):
        monkeypatch.setattr(f"orthoflow_plugins.match.sift.{least}", 10**6)
    asked: list[int] = []
    places = {0: [place(0, is_clear=True)], 1: [place(1, aside_m=0.3)]}

    def found(index: int, *_: object) -> list[Placed]:
        asked.append(index)
        return places[index]

    monkeypatch.setattr("orthoflow_plugins.match.placing.places_of", found)

    def n_placed(structure: Literal["never", "confirmed", "alone"]) -> tuple[int, list[str]]:
        ties, said = sifted(tmp_path, places, structure)
        notes = ties.details["photos"]
        assert isinstance(notes, dict)
        return sum(
            isinstance(note, dict) and note["picture"] == "structure" for note in notes.values()
        ), said

    assert n_placed("never") == (0, [])
    assert asked == []
    assert n_placed("confirmed") == (0, [])
    assert sorted(asked) == [0, 1]
    count, said = n_placed("alone")
    assert count == 1
    assert ["look at its overlay" in text for text in said] == [True]
    places[1] = [place(1)]
    assert n_placed("confirmed") == (2, [])


# --- what photos that lie on one wall say of each other ---

CELLS = (30, 40)
CELL_PX = 4.0


def laid(
    *,
    photo: int = 0,
    wall: int = 0,
    aside_px: tuple[float, float] = (0.0, 0.0),
    rows: slice = slice(None),
    apart_cells: float = 3.0,
    placed: Any = None,
) -> Any:
    """A photo that shows some rows of a wall, each cell four pixels wide."""
    pixels = np.full((*CELLS, 2), np.nan)
    at = np.stack(np.meshgrid(np.arange(40) + 0.5, np.arange(30) + 0.5), axis=-1) * CELL_PX
    pixels[rows] = (at + aside_px)[rows]
    return confirming._Laid(
        photo=photo,
        wall=wall,
        pixels=pixels,
        cell_px=CELL_PX,
        apart_cells=apart_cells,
        placed=placed,
    )


def shared(
    n: int, off_cells: float = 0.0, *, aside_px: tuple[float, float] = (100.0, 50.0)
) -> NDArray[np.float64]:
    """Key points of two photos, in the second so far from where its place has them."""
    rng = np.random.default_rng(1)
    first = rng.uniform(10.0, [150.0, 110.0], (n, 2))
    second = first + aside_px + off_cells * CELL_PX * np.array([0.6, 0.8])
    return np.stack([first, second], axis=1)


@pytest.mark.parametrize(("n", "agrees"), [(23, False), (24, True)])
def test_two_dozen_shared_key_points_tell_whether_places_agree(n: int, agrees: bool) -> None:
    one, other = laid(), laid(photo=1, aside_px=(100.0, 50.0))
    assert confirming._agree(one, other, shared(n)) == agrees
    # Those that lie beside what the first place shows say nothing.
    beside = shared(40)
    beside[n:, 0] += [0.0, 300.0]
    assert confirming._agree(one, other, beside) == agrees


@pytest.mark.parametrize(
    ("limits", "off_cells", "agrees"),
    [
        # A key point is up to seven tenths of a cell from the middle of the one it is in.
        ((3.0, 3.0), 2.2, True),
        ((3.0, 3.0), 3.8, False),
        ((3.0, 6.0), 5.2, True),
        ((6.0, 3.0), 5.2, True),
        ((3.0, 6.0), 6.8, False),
    ],
)
def test_key_points_lie_within_some_cells_of_where_the_other_place_has_them(
    limits: tuple[float, float], off_cells: float, agrees: bool
) -> None:
    one = laid(apart_cells=limits[0])
    other = laid(photo=1, aside_px=(100.0, 50.0), apart_cells=limits[1])
    assert confirming._agree(one, other, shared(60, off_cells)) == agrees


@pytest.mark.parametrize(("n_right", "agrees"), [(59, False), (60, True)])
def test_six_of_ten_shared_key_points_must_agree(n_right: int, agrees: bool) -> None:
    one, other = laid(), laid(photo=1, aside_px=(100.0, 50.0))
    points = shared(100)
    points[n_right:, 1] += 60.0
    assert confirming._agree(one, other, points) == agrees


@pytest.mark.parametrize(("n_rows", "overlaps"), [(4, False), (5, True)])
def test_places_overlap_where_they_share_two_hundred_cells(n_rows: int, overlaps: bool) -> None:
    upper, lower = laid(rows=slice(0, 15)), laid(photo=1, rows=slice(15 - n_rows, 30))
    assert confirming._overlap(upper, lower) == overlaps
    assert not confirming._overlap(upper, laid(photo=1, wall=1))


def test_a_recognised_photo_lies_where_its_homography_puts_the_cells() -> None:
    fine = SimpleNamespace(frame=SimpleNamespace(gsd_m=0.01, shape=(120, 160)))
    coarse = SimpleNamespace(frame=SimpleNamespace(gsd_m=0.04, shape=CELLS))
    # A pixel per fine cell, 20 of them beside the photo at the left and 30 above it.
    moved = np.array([[1.0, 0.0, -20.0], [0.0, 1.0, -30.0], [0.0, 0.0, 1.0]])
    far = np.array([[1.0, 0.0, 5000.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    pairs: Any = SimpleNamespace(
        pairs=[
            SimpleNamespace(wall=0, homography=moved),
            SimpleNamespace(wall=0, homography=None),
            SimpleNamespace(wall=5, homography=moved),
            SimpleNamespace(wall=0, homography=far),
        ]
    )
    shot: Any = (7, SimpleNamespace(photos=[SimpleNamespace(width=100, height=70)] * 8))
    (found,) = confirming._laid_by_homography(shot, pairs, {0: coarse}, [fine])  # type: ignore[dict-item, list-item]
    rows, columns = np.mgrid[:30, :40] + 0.5
    expected = np.stack([4.0 * columns - 20.0, 4.0 * rows - 30.0], axis=-1)
    inside = ((expected >= 0.0) & (expected < [100.0, 70.0])).all(axis=2)
    np.testing.assert_array_equal(np.isfinite(found.pixels[..., 0]), inside)
    np.testing.assert_allclose(found.pixels[inside], expected[inside])
    assert (found.photo, found.wall, found.placed, found.apart_cells) == (7, 0, None, 6.0)
    assert found.cell_px == pytest.approx(4.0, rel=0.05)


def placed_at(share: float, *, is_clear: bool = False) -> Any:
    return SimpleNamespace(share=share, is_clear=is_clear)


@pytest.mark.parametrize(
    ("photos", "clear", "recognised", "is_enough"),
    [
        ((0, 1), (), (), False),
        ((0, 1), (1,), (), True),
        ((0, 1), (), (1,), True),
        ((0, 1, 2), (), (), True),
        # Two places of one photo are one photo.
        ((0, 1, 1), (), (), False),
    ],
)
def test_three_photos_or_one_that_is_sure_are_enough(
    photos: tuple[int, ...], clear: tuple[int, ...], recognised: tuple[int, ...], is_enough: bool
) -> None:
    some = [
        laid(
            photo=photo,
            placed=None if k in recognised else placed_at(0.1, is_clear=k in clear),
        )
        for k, photo in enumerate(photos)
    ]
    assert confirming._is_enough(some, range(len(some))) == is_enough


def test_the_heaviest_group_wins_and_whoever_contradicts_it_loses_all() -> None:
    shares = {"a": 0.3, "b": 0.2, "c": 0.45, "d": 0.6, "e": 0.5, "f": 0.4, "g": 0.9}
    places = {name: placed_at(share, is_clear=True) for name, share in shares.items()}

    def on(photo: int, name: str | None) -> Any:
        return laid(photo=photo, placed=None if name is None else places[name])

    some = [on(0, "a"), on(1, "b"), on(0, "c"), on(2, "d"), on(3, "e"), on(4, "f"), on(9, None)]
    # The first two stand with a photo that was recognised, which outweighs all shares.
    agreeing = [(0, 1), (1, 6), (2, 3), (4, 5)]
    found = confirming._chosen(some, agreeing)
    assert found == {0: places["a"], 1: places["b"], 3: places["e"], 4: places["f"]}
    assert confirming._weight(some, [0, 1, 6]) == pytest.approx(1000.5)
    assert confirming._weight(some, [2, 3]) == pytest.approx(1.05)
    # Without it the others are heavier.
    found = confirming._chosen(some, [(0, 1), (2, 3), (4, 5)])
    assert found == {0: places["c"], 2: places["d"], 3: places["e"], 4: places["f"]}
    # Of two places of one photo in a group, the one with the larger share.
    twice = [on(0, "a"), on(0, "g"), on(1, "b"), on(0, "c")]
    assert confirming._chosen(twice, [(0, 2), (1, 2), (3, 2)]) == {0: places["g"], 1: places["b"]}
    assert confirming._chosen(some, []) == {}


def test_shared_key_points_are_given_in_pixels_of_both_photos(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scales = {2: 0.5, 5: 0.25, 7: 1.0}
    places = np.array([[4.0, 8.0], [10.0, 20.0], [30.0, 30.0]])
    asked: list[int] = []

    def small(photos: Any, index: int) -> Any:
        asked.append(index)
        return SimpleNamespace(
            grey=index, features=SimpleNamespace(pixels=places + index), scale=scales[index]
        )

    def pair_photo(grey: Any, walls: list[Any], rule: Any) -> Any:
        def pair(first: list[int], second: list[int], agreeing: list[bool], is_shown: bool) -> Any:
            matches = SimpleNamespace(first=np.array(first), second=np.array(second))
            return SimpleNamespace(matches=matches, agreeing=np.array(agreeing), is_shown=is_shown)

        assert rule is confirming._RULE
        return SimpleNamespace(
            features=SimpleNamespace(pixels=places - 1.0),
            pairs=[
                pair([0, 1, 2], [2, 0, 1], [True, False, True], is_shown=grey == 2),
                pair([1], [1], [True], is_shown=False),
            ],
        )

    monkeypatch.setattr(confirming, "_small", small)
    monkeypatch.setattr(confirming, "pair_photo", pair_photo)
    found = confirming._shared(photos(), [(2, 5), (5, 7)], 1)
    # Each photo is looked at once.
    assert sorted(asked) == [2, 5, 7]
    np.testing.assert_allclose(
        found[2, 5],
        [
            [(places[0] - 1.0) / 0.5, (places[2] + 5.0) / 0.25],
            [(places[2] - 1.0) / 0.5, (places[1] + 5.0) / 0.25],
        ],
    )
    assert found[5, 7].shape == (0, 2, 2)


@pytest.mark.parametrize(("width", "scale"), [(1600, 1.0), (3200, 0.5), (800, 1.0)])
def test_photos_are_compared_at_sixteen_hundred_pixels(
    monkeypatch: pytest.MonkeyPatch, width: int, scale: float
) -> None:
    grey = np.random.default_rng(1).integers(0, 255, (width // 8, width), dtype=np.uint8)
    monkeypatch.setattr(confirming, "photo_grey", lambda _: grey)
    found = confirming._small(photos(), 0)
    assert found.scale == scale
    assert found.grey.shape == (round(width // 8 * scale), round(width * scale))
    # Key points lie in the shrunk picture.
    assert found.features.pixels[:, 0].max() <= width * scale
    assert len(found.features) > 20


def test_where_no_photo_has_a_place_nothing_is_prepared() -> None:
    untouched: Any = None
    assert confirmed(untouched, {0: (), 2: ()}, {1: untouched}, untouched) == {}
