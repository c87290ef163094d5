"""Photos are placed by where edges run, whichever side of them the laser sees brighter."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
from numpy.typing import NDArray
from orthoflow_plugins.match.placing import Placed, places_of
from orthoflow_plugins.match.structures import WallStructure, wall_structure

from orthoflow.files.images import decode_image, encode_png
from orthoflow.products import Photo, Wall
from orthoflow.testing import photographed as ms

CAMERA = ms.camera_before(ms.textured_wall(1))


@cache
def usual_photo() -> Photo:
    return ms.photo_of(ms.textured_wall(1), CAMERA)


def patchy_wall() -> Wall:
    """The wall as a laser sees it that inverts contrast in every second of many fields."""
    wall = ms.walls_of(ms.textured_wall(1)).walls[0]
    assert wall.intensity is not None
    rows, columns = np.indices(wall.frame.shape) * 5 // min(wall.frame.shape)
    sign = np.where((rows + columns) % 2 == 0, -1.0, 1.0)
    return replace(wall, intensity=(0.5 + sign * (wall.intensity - 0.5)).astype(np.float32))


@cache
def patchy_walls() -> list[WallStructure | None]:
    return [wall_structure(patchy_wall())]


def placed(photo: Photo) -> Placed | None:
    places = places_of(0, photo, patchy_walls())
    assert not any(place.is_clear for place in places[1:])
    return next((place for place in places if place.is_clear), None)


def off_cells(found: Placed, seen_px: NDArray[np.float64]) -> NDArray[np.float64]:
    """How far ties are from the truth, in the coarse cells that they were found in."""
    off_px = seen_px - found.piece.pixels_photo
    return np.linalg.norm(off_px, axis=1) / (2.0 * found.piece.sigma_px)


def test_a_photo_is_placed_where_contrast_is_inverted_here_and_there() -> None:
    found = placed(usual_photo())
    assert found is not None
    off = off_cells(found, CAMERA.project(found.piece.points_world)[:, :2])
    assert np.median(off) < 1.0
    assert (off < 3.0).mean() > 0.9


def test_neither_a_lens_nor_how_the_camera_was_held_needs_to_be_known() -> None:
    scene = ms.textured_wall(1)
    camera = ms.camera_before(scene, centre=(3.4, -1.9, 1.2), towards=(1.6, 0.0, 1.0))
    upright = decode_image(ms.photo_of(scene, camera).encoded, "a.png")
    turned = np.ascontiguousarray(np.rot90(upright))
    photo = replace(
        usual_photo(), encoded=encode_png(turned), width=640, height=900, intrinsics=None
    )
    assert photo.exif_focal_px is None
    found = placed(photo)
    assert found is not None
    u, v = camera.project(found.piece.points_world)[:, :2].T
    # 44 degrees from square, a quarter turned, a focal length of 0.93 instead of 0.8 of its width.
    assert np.median(off_cells(found, np.column_stack([v, 900.0 - u]))) < 1.0
    assert abs(found.camera.fx / camera.fx - 1.0) < 0.05


def test_a_mirrored_photo_is_placed_nowhere() -> None:
    mirrored = np.ascontiguousarray(decode_image(usual_photo().encoded, "a.png")[:, ::-1])
    assert placed(replace(usual_photo(), encoded=encode_png(mirrored), exif_focal_px=840.0)) is None


def test_a_wall_that_shows_nothing_places_no_photo() -> None:
    blind = replace(patchy_wall(), intensity=None)
    assert places_of(0, usual_photo(), [wall_structure(blind)]) == []


def test_a_photo_of_another_wall_is_placed_nowhere() -> None:
    other = ms.photo_of(ms.textured_wall(2), CAMERA)
    assert placed(replace(other, exif_focal_px=840.0)) is None
