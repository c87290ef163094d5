"""Photos are placed by where edges run, whichever side of them the laser sees brighter."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.match.placing import Placed, PlacedWalls, placed_photo
from orthoflow_plugins.match.sift import MatchSift

from orthoflow.files.images import decode_image, encode_png
from orthoflow.products import Photo, TieRole, Ties, Wall
from orthoflow.sdk import StepContext
from orthoflow.testing import photographed as ms

CAMERA = ms.camera_before(ms.textured_wall(1))
PHOTO = ms.photo_of(ms.textured_wall(1), CAMERA)


def patchy_wall() -> Wall:
    """The wall as a laser sees it that inverts contrast in every second of many fields."""
    wall = ms.walls_of(ms.textured_wall(1)).walls[0]
    assert wall.intensity is not None
    rows, columns = np.indices(wall.frame.shape) * 5 // min(wall.frame.shape)
    sign = np.where((rows + columns) % 2 == 0, -1.0, 1.0)
    return replace(wall, intensity=(0.5 + sign * (wall.intensity - 0.5)).astype(np.float32))


def placed(photo: Photo) -> Placed | None:
    return placed_photo(0, photo, PlacedWalls(walls=[patchy_wall()]))


def off_cells(found: Placed) -> NDArray[np.float64]:
    """How far ties are from the truth, in the coarse cells that they were found in."""
    off_px = CAMERA.project(found.piece.points_world)[:, :2] - found.piece.pixels_photo
    return np.linalg.norm(off_px, axis=1) / (2.0 * found.piece.sigma_px)


def test_a_photo_is_placed_where_contrast_is_inverted_here_and_there() -> None:
    found = placed(PHOTO)
    assert found is not None
    assert np.median(off_cells(found)) < 1.0
    assert (off_cells(found) < 3.0).mean() > 0.9


def test_a_mirrored_photo_is_placed_nowhere() -> None:
    mirrored = np.ascontiguousarray(decode_image(PHOTO.encoded, "a.png")[:, ::-1])
    assert placed(replace(PHOTO, encoded=encode_png(mirrored))) is None


def test_a_photo_of_another_wall_is_placed_nowhere() -> None:
    assert placed(ms.photo_of(ms.textured_wall(2), CAMERA)) is None


def test_a_wall_that_shows_nothing_places_no_photo() -> None:
    blind = replace(patchy_wall(), intensity=None)
    assert placed_photo(0, PHOTO, PlacedWalls(walls=[blind])) is None


def sifted(folder: Path, *, tries_structure: bool) -> tuple[Ties, list[str]]:
    said: list[str] = []
    ctx = StepContext(
        rng=np.random.default_rng(1),
        cores=2,
        scratch=folder,
        listen=lambda event: said.append(event.text) if event.kind == "warning" else None,
    )
    walls = replace(ms.walls_of(ms.textured_wall(1)), walls=(patchy_wall(),))
    params = MatchSift.Params(tries_structure=tries_structure)
    inputs = MatchSift.In(photos=ms.photos(PHOTO), walls=walls)
    return MatchSift().run(inputs, params, ctx).ties, said


def test_only_who_asks_for_it_gets_photos_placed_so_and_is_told_to_look(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # As if no key points had shown a wall clearly.
    monkeypatch.setattr("orthoflow_plugins.match.sift.LEAST", 10**6)
    told = "placed by where edges run alone; where patterns repeat"
    ties, said = sifted(tmp_path, tries_structure=True)
    assert (ties.role != TieRole.REJECTED).sum() >= 40
    assert [told in text for text in said] == [True]
    _, said = sifted(tmp_path, tries_structure=False)
    assert said == []
