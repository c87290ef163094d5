"""Photos confirm each other's places on walls where no key points recognise them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pytest
from orthoflow_plugins.match.key_points import PairingParams, PhotoPairs, pair_photo, wall_features
from orthoflow_plugins.match.placing import Placed, confirmed
from orthoflow_plugins.match.structures import wall_structure
from orthoflow_plugins.match.ties import TiePiece

from orthoflow.files.images import photo_grey
from orthoflow.testing import photographed as ms
from tests import matched_walls as mw

SCENE = ms.textured_wall(1)
WALLS = mw.walls(1)
CAMERAS = [
    ms.camera_before(SCENE),
    ms.camera_before(SCENE, centre=(1.9, -2.2, 1.0), towards=(1.7, 0.0, 0.9)),
    ms.camera_before(SCENE, centre=(1.5, -2.4, 0.9), towards=(1.4, 0.0, 1.1)),
]


PHOTOS = ms.photos(
    *(ms.photo_of(SCENE, camera, name=f"{nth}.png") for nth, camera in enumerate(CAMERAS))
)
ON_WALLS = (WALLS.walls, [wall_structure(wall) for wall in WALLS.walls])
NEAR = pytest.approx(0.0, abs=1e-9)


def place(
    photo: int, *, aside_m: float = 0.0, share: float = 0.3, is_clear: bool = False
) -> Placed:
    """A place of a photo, the right one or so far to the right of it."""
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
    """What key points of a photo show of the wall."""
    features = [wall_features(WALLS.walls[0], PairingParams().max_features)]
    return pair_photo(photo_grey(PHOTOS.photos[photo]), features, PairingParams())


def chosen(
    places: dict[int, Sequence[Placed]], recognised: Mapping[int, PhotoPairs] | None = None
) -> dict[int, float]:
    """Metres that the chosen places are aside, by photo."""
    found = confirmed(PHOTOS, places, recognised or {}, ON_WALLS)
    return {
        k: float((place.camera.centre_world - CAMERAS[k].centre_world)[0])
        for k, place in found.items()
    }


def test_places_that_agree_are_taken_if_one_of_them_is_clear() -> None:
    assert chosen({0: [place(0, is_clear=True)], 1: [place(1)]}) == {0: NEAR, 1: NEAR}
    assert chosen({0: [place(0)], 1: [place(1)]}) == {}
    assert chosen({k: [place(k)] for k in range(3)}) == {0: NEAR, 1: NEAR, 2: NEAR}


def test_a_place_that_no_photo_confirms_is_not_taken_however_clear_it_is() -> None:
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
    # Where the others confirm its key points, these stay.
    assert chosen(places, {2: right}) == {0: NEAR, 1: NEAR}
    # Where no photo has a place there is nothing to choose.
    assert chosen({0: (), 2: ()}, {1: right}) == {}
