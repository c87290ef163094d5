"""The faces of a panorama: where each looks, what it shows up to the poles, and its name."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from orthoflow.errors import InputError
from orthoflow.files.cube_faces import FACES, MOST_PX, CubeFace, PanoramaLens, face_rays, faces_of
from tests.wide_lenses import directions_of_panorama

WIDTH, HEIGHT = 512, 256


def faces(width: int = WIDTH) -> dict[str, CubeFace]:
    lens = PanoramaLens(width=width, height=HEIGHT)
    return {face.face: face for face in faces_of(b"", "hall", lens)}


def coloured(directions: NDArray[np.float64]) -> NDArray[np.uint8]:
    return np.rint(128.0 + 120.0 * directions).astype(np.uint8)


@pytest.mark.parametrize("face", FACES)
def test_a_face_shows_each_direction_where_it_is(face: str) -> None:
    cube = faces()[face]
    found = cube.picture(coloured(directions_of_panorama(WIDTH, HEIGHT))).astype(float)
    # To x forwards, y to the left, z up.
    right, down, forwards = np.moveaxis(face_rays(cube.lens) @ FACES[face], -1, 0)
    expected = np.stack([forwards, -right, -down], axis=-1)
    expected /= np.linalg.norm(expected, axis=-1, keepdims=True)
    assert found.shape == (cube.lens.height, cube.lens.width, 3)
    # A colour changes by 120 in 81 pixels: what rounding and half a pixel at the poles leave.
    np.testing.assert_allclose(found, coloured(expected), atol=2.0)
    # Up to the pole itself, which no row of the panorama shows.
    middle = cube.lens.height // 2
    np.testing.assert_allclose(found[middle, middle], coloured(expected[middle, middle]), atol=2.0)


def test_left_of_the_first_column_is_the_last() -> None:
    panorama = np.full((HEIGHT, WIDTH), 100, dtype=np.uint8)
    panorama[:, 0] = panorama[:, -1] = 200
    back = faces()["back"].picture(panorama)
    assert back[len(back) // 2, len(back) // 2] == 200


@pytest.mark.parametrize(
    ("width", "is_read"), [(0, False), (1, True), (MOST_PX, True), (MOST_PX + 1, False)]
)
def test_a_panorama_has_as_many_columns_as_can_be_looked_up(width: int, is_read: bool) -> None:
    if is_read:
        assert [face.name for face in faces(width).values()] == [
            f"hall_{face}.png" for face in FACES
        ]
        return
    with pytest.raises(InputError, match=f"photo hall is none: it has {width} columns"):
        faces(width)
