"""Photos are placed by where edges run, whichever side of them the laser sees brighter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from orthoflow_plugins.match.placing import Placed, places_of
from orthoflow_plugins.match.structures import wall_structure

from orthoflow.files.images import decode_image, encode_png
from orthoflow.products import Photo, Wall
from orthoflow.testing import photographed as ms
from tests import matched_walls as mw

SCENE = ms.textured_wall(1)
PHOTO = ms.photo_of(SCENE, ms.camera_before(SCENE), calibrated=False)


def patchy_wall() -> Wall:
    """The wall as a laser sees it that inverts contrast in every second of many fields."""
    (wall,) = mw.walls(1).walls
    assert wall.intensity is not None
    rows, columns = np.indices(wall.frame.shape) * 5 // min(wall.frame.shape)
    sign = np.where((rows + columns) % 2 == 0, -1.0, 1.0)
    return replace(wall, intensity=(0.5 + sign * (wall.intensity - 0.5)).astype(np.float32))


STRUCTURES = [wall_structure(patchy_wall())]


def placed(photo: Photo) -> Placed | None:
    places = places_of(0, photo, STRUCTURES)
    assert not any(place.is_clear for place in places[1:])
    return next((place for place in places if place.is_clear), None)


def test_a_photo_is_placed_whatever_its_lens_and_however_it_was_held() -> None:
    """The wall inverts contrast here and there, and neither is known."""
    camera = ms.camera_before(SCENE, centre=(3.4, -1.9, 1.2), towards=(1.6, 0.0, 1.0))
    upright = decode_image(ms.photo_of(SCENE, camera).encoded, "a.png")
    turned = np.ascontiguousarray(np.rot90(upright))
    found = placed(Photo(name="a.png", encoded=encode_png(turned), width=640, height=900))
    assert found is not None
    u, v = camera.project(found.piece.points_world)[:, :2].T
    # 44 degrees from square, a quarter turned, a focal length of 0.93 instead of 0.8 of its width.
    off_px = np.linalg.norm(np.column_stack([v, 900.0 - u]) - found.piece.pixels_photo, axis=1)
    # In the coarse cells that ties were found in.
    off = off_px / (2.0 * found.piece.sigma_px)
    assert np.median(off) < 1.0
    assert (off < 3.0).mean() > 0.85
    assert abs(found.camera.fx / camera.fx - 1.0) < 0.05


def test_a_mirrored_photo_and_one_of_another_wall_are_placed_nowhere() -> None:
    mirrored = np.ascontiguousarray(decode_image(PHOTO.encoded, "a.png")[:, ::-1])
    assert placed(replace(PHOTO, encoded=encode_png(mirrored))) is None
    other = ms.textured_wall(2)
    assert placed(ms.photo_of(other, ms.camera_before(other), calibrated=False)) is None


def test_a_wall_that_shows_nothing_places_no_photo() -> None:
    blind = replace(patchy_wall(), intensity=None)
    assert places_of(0, PHOTO, [wall_structure(blind)]) == []
