"""Photos confirm each other's places on walls where no key points recognise them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from orthoflow_plugins.match.key_points import PairingParams, PhotoPairs, pair_photo, wall_features
from orthoflow_plugins.match.placing import Placed, confirmed
from orthoflow_plugins.match.structures import WallStructure, wall_structure
from orthoflow_plugins.match.ties import TiePiece

from orthoflow.files.images import photo_grey
from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.products import Photos, Wall
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


@cache
def on_walls() -> tuple[Sequence[Wall], list[WallStructure | None]]:
    return WALLS.walls, [wall_structure(wall) for wall in WALLS.walls]


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
    params = PairingParams()
    features = [wall_features(WALLS.walls[0], params.max_features)]
    pairs = {k: pair_photo(photo_grey(photos().photos[k]), features, params) for k in recognised}
    found = confirmed(photos(), places, pairs, on_walls())
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
    features = [wall_features(WALLS.walls[0], PairingParams().max_features)]
    right = pair_photo(photo_grey(photos().photos[2]), features, PairingParams())
    (pair,) = right.pairs
    assert pair.homography is not None
    shift = np.array([[1.0, 0.0, 120.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    wrong = replace(right, pairs=(replace(pair, homography=shift @ pair.homography),))
    places = {k: [place(k)] for k in range(3)}

    def taken(pairs: PhotoPairs) -> dict[int, float]:
        found = confirmed(photos(), places, {2: pairs}, on_walls())
        return {
            k: float((one.camera.centre_world - CAMERAS[k].centre_world)[0])
            for k, one in found.items()
        }

    assert taken(wrong) == dict.fromkeys(range(3), near)
    # Where the others confirm its key points, these stay.
    assert taken(right) == {0: near, 1: near}


# --- what photos that lie on one wall say of each other ---


def test_where_no_photo_has_a_place_nothing_is_prepared() -> None:
    untouched: Any = None
    assert confirmed(untouched, {0: (), 2: ()}, {1: untouched}, untouched) == {}
