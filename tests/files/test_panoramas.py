"""The faces of a panorama: where each looks, what it shows up to the poles, and its name."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from orthoflow.errors import InputError
from orthoflow.files.cube_faces import (
    FACES,
    MOST_PX,
    face_lens,
    face_picture,
    face_rays,
    faces_of,
)

WIDTH, HEIGHT = 512, 256


def directions() -> NDArray[np.float64]:
    """(rows, columns, 3) of the pixels: forwards x in the middle, y to the left, z up."""
    azimuth = np.pi - 2.0 * np.pi * (np.arange(WIDTH) + 0.5) / WIDTH
    elevation = 0.5 * np.pi - np.pi * (np.arange(HEIGHT) + 0.5) / HEIGHT
    level = np.cos(elevation)[:, None]
    up = np.broadcast_to(np.sin(elevation)[:, None], (HEIGHT, WIDTH))
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), up], axis=-1)


def coloured(ways: NDArray[np.float64]) -> NDArray[np.uint8]:
    return np.rint(128.0 + 120.0 * ways).astype(np.uint8)


@pytest.mark.parametrize("face", FACES)
def test_a_face_shows_each_direction_where_it_is(face: str) -> None:
    lens = face_lens(WIDTH)
    found = face_picture(coloured(directions()), face).astype(float)
    ways = face_rays(lens) @ FACES[face]
    ways /= np.linalg.norm(ways, axis=-1, keepdims=True)
    assert found.shape == (lens.height, lens.width, 3)
    # A colour changes by 120 in 81 pixels: what rounding and half a pixel at the poles leave.
    np.testing.assert_allclose(found, coloured(ways), atol=2.0)
    # Up to the pole itself, which no row of the panorama shows.
    if face in {"up", "down"}:
        middle = found[lens.height // 2, lens.width // 2]
        np.testing.assert_allclose(middle, 128.0 + 120.0 * FACES[face][2], atol=2.0)


def test_left_of_the_first_column_is_the_last() -> None:
    panorama = np.full((HEIGHT, WIDTH), 100, dtype=np.uint8)
    panorama[:, 0] = panorama[:, -1] = 200
    back = face_picture(panorama, "back")
    assert back[len(back) // 2, len(back) // 2] == 200


@pytest.mark.parametrize(
    ("width", "is_read"), [(0, False), (1, True), (MOST_PX, True), (MOST_PX + 1, False)]
)
def test_a_panorama_has_as_many_columns_as_can_be_looked_up(width: int, is_read: bool) -> None:
    if is_read:
        assert [face.name for face in faces_of(b"", "hall", width)] == [
            f"hall_{face}.png" for face in FACES
        ]
        return
    with pytest.raises(InputError, match=f"panorama hall has {width} columns, at most 32766"):
        faces_of(b"", "hall", width)
