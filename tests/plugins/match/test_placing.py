"""Photos are located by the positions of edges, and confirm each other's positions."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.match import structures
from orthoflow_plugins.match.key_points import PairingParams, PhotoPairs, pair_photo, wall_features
from orthoflow_plugins.match.placing import Placed, confirmed, places_of
from orthoflow_plugins.match.ties import TiePiece

from orthoflow.files.images import decode_image, encode_png, photo_grey
from orthoflow.products import Photo, Photos, Wall
from orthoflow.testing import photographed as ms
from tests import matched_walls as mw

SCENE = ms.textured_wall(1)


def patchy_wall() -> Wall:
    """Return the wall with an intensity whose contrast is inverted in every second field."""
    (wall,) = mw.walls(1).walls
    assert wall.intensity is not None
    rows, columns = np.indices(wall.frame.shape) * 5 // min(wall.frame.shape)
    sign = np.where((rows + columns) % 2 == 0, -1.0, 1.0)
    return replace(wall, intensity=(0.5 + sign * (wall.intensity - 0.5)).astype(np.float32))


@cache
def patchy_structure() -> structures.WallStructure | None:
    return structures.wall_structure(patchy_wall())


def placed(photo: Photo) -> Placed | None:
    places = places_of(0, photo, [patchy_structure()])
    assert not any(place.is_clear for place in places[1:])
    return next((place for place in places if place.is_clear), None)


def test_a_photo_is_placed_whatever_its_lens_and_however_it_was_held() -> None:
    """The contrast of the wall is inverted in places; the photo's lens and rotation are unknown."""
    camera = ms.camera_before(centre=(2.6, -1.2, 1.1), towards=(1.5, 0.0, 1.0))
    upright = decode_image(ms.photo_of(SCENE, camera).encoded, "a.png")
    turned = np.ascontiguousarray(np.rot90(upright))
    found = placed(Photo(name="a.png", encoded=encode_png(turned), width=640, height=900))
    assert found is not None
    u, v = camera.project(found.piece.points_world)[:, :2].T
    # The photo is oblique by 42 degrees and rotated by a quarter turn; its focal length is 0.93
    # instead of 0.8 of its width.
    off_px = np.linalg.norm(np.column_stack([v, 900.0 - u]) - found.piece.pixels_photo, axis=1)
    # The offset is in coarse cells, in which the ties were found.
    off = off_px / (2.0 * found.piece.sigma_px)
    assert np.median(off) < 1.0
    assert (off < 3.0).mean() > 0.85
    assert abs(found.camera.fx / camera.fx - 1.0) < 0.05


def test_a_mirrored_photo_and_one_of_another_wall_are_placed_nowhere() -> None:
    photo = ms.photo_of(SCENE, ms.camera_before(), calibrated=False)
    mirrored = np.ascontiguousarray(decode_image(photo.encoded, "a.png")[:, ::-1])
    assert placed(replace(photo, encoded=encode_png(mirrored))) is None
    other = ms.textured_wall(2)
    assert placed(ms.photo_of(other, ms.camera_before(), calibrated=False)) is None
    # On a wall without intensity, there are no positions.
    blind = replace(patchy_wall(), intensity=None)
    assert places_of(0, photo, [structures.wall_structure(blind)]) == []


CAMERAS = [
    replace(each, width=600, height=420, fx=560.0, fy=562.0, cx=303.0, cy=208.0)
    for each in (
        ms.camera_before(),
        ms.camera_before(centre=(1.9, -2.2, 1.0), towards=(1.7, 0.0, 0.9)),
        ms.camera_before(centre=(1.5, -2.4, 0.9), towards=(1.4, 0.0, 1.1)),
    )
]
NEAR = pytest.approx(0.0, abs=1e-9)


@cache
def on_walls() -> tuple[Sequence[Wall], list[structures.WallStructure | None]]:
    walls = mw.walls(1).walls
    return walls, [structures.wall_structure(wall) for wall in walls]


@cache
def photos() -> Photos:
    shots = enumerate(CAMERAS)
    return ms.photos(*(ms.photo_of(SCENE, camera, name=f"{nth}.png") for nth, camera in shots))


def place(
    photo: int, *, aside_m: float = 0.0, share: float = 0.3, is_clear: bool = False
) -> Placed:
    """Return a position of a photo: the right one, or displaced to the right."""
    camera = CAMERAS[photo].shifted(-aside_m * SCENE.frame.u_world)
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


def paired(photo: int) -> PhotoPairs:
    """Return key point matches of a photo with the wall."""
    features = [wall_features(mw.walls(1).walls[0], PairingParams().max_features)]
    return pair_photo(photo_grey(photos().photos[photo]), features, PairingParams())


def chosen(
    places: dict[int, Sequence[Placed]], recognised: Mapping[int, PhotoPairs] | None = None
) -> dict[int, float]:
    """Return the displacements of the chosen positions in metres, by photo."""
    found = confirmed(photos(), places, recognised or {}, on_walls())
    return {
        k: float((place.camera.centre_world - CAMERAS[k].centre_world)[0])
        for k, place in found.items()
    }


def test_places_that_agree_are_taken_if_one_of_them_is_clear() -> None:
    assert chosen({0: [place(0, is_clear=True)], 1: [place(1)]}) == {0: NEAR, 1: NEAR}
    assert chosen({0: [place(0)], 1: [place(1)]}) == {}
    assert chosen({k: [place(k)] for k in range(3)}) == {0: NEAR, 1: NEAR, 2: NEAR}
    # A position that no photo confirms is not accepted, however clear it is.
    assert chosen({0: [place(0, is_clear=True)]}) == {}
    wrong = place(0, aside_m=0.3, share=0.6, is_clear=True)
    assert chosen({0: [wrong], 1: [place(1, is_clear=True)]}) == {}


def test_photos_that_are_wrong_together_lose_to_one_that_key_points_recognise() -> None:
    wrong = [place(k, aside_m=0.3, share=0.6, is_clear=True) for k in range(2)]
    assert chosen({0: wrong[:1], 1: wrong[1:]}) == {
        k: pytest.approx(0.3, abs=1e-9) for k in range(2)
    }
    both = {0: [wrong[0], place(0)], 1: [wrong[1]]}
    assert chosen(both, {2: paired(2)}) == {0: NEAR}


def test_key_points_that_agree_by_chance_do_not_keep_a_photo_from_its_place() -> None:
    right = paired(2)
    (pair,) = right.pairs
    assert pair.homography is not None
    shift = np.array([[1.0, 0.0, 120.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    wrong = replace(right, pairs=(replace(pair, homography=shift @ pair.homography),))
    places = {k: [place(k)] for k in range(3)}
    assert chosen(places, {2: wrong}) == dict.fromkeys(range(3), NEAR)
    # If the others confirm its key points, these are used.
    assert chosen(places, {2: right}) == {0: NEAR, 1: NEAR}
    # If no photo has a position, none is chosen.
    assert chosen({0: (), 2: ()}, {1: right}) == {}


def picture(height: int, width: int) -> NDArray[np.float32]:
    """Return blocks of 7 pixels with random grey values."""
    blocks = np.random.default_rng(3).uniform(0.0, 1.0, (height // 7 + 1, width // 7 + 1))
    wide = np.kron(blocks, np.ones((7, 7)))[:height, :width, None]
    return np.ascontiguousarray(wide, dtype=np.float32)


def test_edges_are_the_same_whichever_side_is_brighter_and_turn_with_the_picture() -> None:
    grey, known = picture(120, 120), np.ones((120, 120), dtype=np.bool_)
    upright = structures.structure_of(grey, known).values
    np.testing.assert_allclose(
        structures.structure_of(1.0 - grey, known).values, upright, atol=1e-4
    )
    turned = structures.structure_of(np.ascontiguousarray(np.rot90(grey)), known).values
    # A quarter turn is half a turn of doubled angles and a full turn of fourfold angles.
    signs = np.array([-1.0, -1.0, 1.0, 1.0, 1.0])
    np.testing.assert_allclose(turned, np.rot90(upright) * signs, atol=1e-4)
    # Each cell contains the direction of edges, not their strength, so vectors are at most one unit
    # long.
    lengths = np.linalg.norm(upright, axis=2)
    assert lengths.max() < 1.0
    assert np.median(lengths) == pytest.approx(1.0 / 1.3, abs=0.01)


def test_what_is_not_known_and_its_border_has_no_structure() -> None:
    known = np.ones((80, 90), dtype=np.bool_)
    known[20:40, 30:60] = False
    found = structures.structure_of(picture(80, 90), known)
    void = np.zeros_like(known)
    void[19:41, 29:61] = True
    np.testing.assert_array_equal(found.known == 0.0, void)
    assert not found.values[void].any()
    assert (np.linalg.norm(found.values[~void], axis=1) > 0.0).mean() > 0.99


def test_a_piece_of_the_wall_lies_where_it_was_taken_from() -> None:
    (wall,) = mw.walls(1).walls
    structure = structures.wall_structure(wall)
    assert structure is not None
    assert wall.intensity is not None
    # A part with half of both sides.
    corner = np.array([wall.frame.width // 3, wall.frame.height // 4])
    size = np.array([wall.frame.width // 2, wall.frame.height // 2])
    (left, top), (right, bottom) = corner, corner + size
    grey = np.rint(255 * np.clip(np.nan_to_num(wall.intensity, nan=0.5), 0.0, 1.0)).astype(np.uint8)
    # Inverted, so that edges keep their positions.
    cut = 255 - grey[top:bottom, left:right]
    places = structures.likely_places(np.repeat(cut[..., None], 3, axis=2), structure, n_most=3)
    assert 1 < len(places) <= 3
    for one, other in itertools.combinations(places, 2):
        assert one.lead >= other.lead
        apart_m = np.hypot(*(one.centre_m - other.centre_m))
        # The same position at a neighbouring scale is not another position.
        assert apart_m > 0.25 * one.width_m or abs(math.log(one.width_m / other.width_m)) > 0.25
    best, fine_m = places[0], wall.frame.gsd_m
    # Sizes are tried in steps of a tenth, and parts may slip by 3 % of the width.
    slip_m = 0.03 * best.width_m + structure.wall.frame.gsd_m
    assert best.width_m == pytest.approx(fine_m * size[0], rel=0.06)
    assert np.abs(best.centre_m - fine_m * (corner + 0.5 * size)).max() < slip_m
    np.testing.assert_allclose(best.parts_photo.mean(axis=0), 0.5, atol=0.01)
    np.testing.assert_allclose(np.ptp(best.parts_photo, axis=0), 0.5, atol=0.02)
    assert np.abs(best.parts_m - fine_m * (corner + best.parts_photo * size)).max() < slip_m
