"""The faces of a panorama: where each looks, what it shows up to the poles, and its name."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from orthoflow.errors import InputError
from orthoflow.files.cube_faces import (
    FACES,
    MOST_PX,
    face_in,
    face_lens,
    face_name,
    face_picture,
    face_rays,
    faces_of,
)
from orthoflow.files.images import decode_image, encode_png

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


def test_faces_look_to_all_sides_and_stand_upright() -> None:
    for axes in FACES.values():
        np.testing.assert_array_equal(np.cross(axes[0], axes[1]), axes[2])
    level = ("front", "left", "back", "right")
    assert all(FACES[face][1].tolist() == [0, 0, -1] for face in level)
    forwards = {face: axes[2].tolist() for face, axes in FACES.items()}
    assert forwards == {
        "front": [1, 0, 0], "left": [0, 1, 0], "back": [-1, 0, 0], "right": [0, -1, 0],
        "up": [0, 0, 1], "down": [0, 0, -1],
    }  # fmt: skip


def test_the_first_row_is_the_nearest_of_all_above_it() -> None:
    """The last as well: nothing of the other end of the panorama is mixed in."""
    panorama = np.zeros((HEIGHT, WIDTH), dtype=np.uint8)
    panorama[0], panorama[-1] = 250, 90
    for face, grey in (("up", 250), ("down", 90)):
        found = face_picture(panorama, face)
        # The pole itself, half a row beyond.
        assert found[len(found) // 2, len(found) // 2] == grey


def test_left_of_the_first_column_is_the_last() -> None:
    panorama = np.full((HEIGHT, WIDTH), 100, dtype=np.uint8)
    panorama[:, 0] = panorama[:, -1] = 200
    back = face_picture(panorama, "back")
    assert back[len(back) // 2, len(back) // 2] == 200


@pytest.mark.parametrize(("width", "side"), [(1, 1), (3, 1), (512, 163), (10_000, 3_183)])
def test_a_face_is_as_fine_in_its_middle_as_the_panorama(width: int, side: int) -> None:
    lens = face_lens(width)
    assert (lens.width, lens.height) == (side, side)
    # Half a side at 45 degrees.
    assert lens.fx == lens.fy == lens.cx == lens.cy == 0.5 * side


def test_rays_go_through_the_middles_of_pixels() -> None:
    lens = face_lens(13)
    assert lens.width == 4
    rays = face_rays(lens)
    np.testing.assert_allclose(rays[0, :, 0], [-0.75, -0.25, 0.25, 0.75])
    np.testing.assert_allclose(rays[:, 2, 1], [-0.75, -0.25, 0.25, 0.75])
    assert (rays[..., 2] == 1.0).all()


@pytest.mark.parametrize(
    ("name", "found"),
    [
        ("hall_front.png", ("hall", "front")),
        ("a_b_down.png", ("a_b", "down")),
        ("hall_front.jpg", None),
        ("hall_front", None),
        ("_front.png", None),
        ("front.png", None),
        ("hall_fore.png", None),
    ],
)
def test_a_face_is_known_by_its_name(name: str, found: tuple[str, str] | None) -> None:
    assert face_in(name) == found
    if found is not None:
        assert face_name(*found) == name


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


def test_a_face_is_a_photo_of_its_own() -> None:
    panorama = encode_png(coloured(directions()))
    (front, *_) = faces_of(panorama, "hall", WIDTH)
    np.testing.assert_array_equal(
        decode_image(front.encoded()), face_picture(coloured(directions()), "front")
    )
    assert front.mask() is None
    assert front.lens == face_lens(WIDTH)
