"""Fisheye lenses as OpenCV has them, and the faces of a cube that their photos become."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from orthoflow.errors import InputError
from orthoflow.files.cube_faces import (
    FACES,
    MOST_PX,
    FisheyeLens,
    PanoramaLens,
    face_lenses,
    faces_of,
    problem_of,
)
from orthoflow.files.images import decode_image, encode_png

# Wholly on its picture: a circle of 180 degrees is 464 pixels wide.
LENS = FisheyeLens(
    width=500,
    height=480,
    fx=150.0,
    fy=151.0,
    cx=252.5,
    cy=238.0,
    radial=(-0.02, 0.004, -0.002, 0.0003),
)


def coloured(directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """A colour for every direction, smooth on the sphere."""
    return np.asarray(128.0 + 100.0 * directions)


def picture(lens: FisheyeLens) -> NDArray[np.uint8]:
    return np.rint(coloured(directions_of(lens))).astype(np.uint8)


def directions_of(lens: FisheyeLens) -> NDArray[np.float64]:
    """Unit directions (height, width, 3) of a lens without tangential terms, by a table."""
    u, v = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    b = (v - lens.cy) / lens.fy
    a = (u - lens.cx - lens.skew * b) / lens.fx
    angles = np.linspace(0.0, 0.5 * np.pi * 1.2, 40_001)
    powers = np.stack([angles ** (2 * power + 1) for power in range(5)])
    bent = np.array([1.0, *lens.radial]) @ powers
    theta = np.interp(np.hypot(a, b), bent, angles)
    around = np.arctan2(b, a)
    return np.stack(
        [np.sin(theta) * np.cos(around), np.sin(theta) * np.sin(around), np.cos(theta)], axis=-1
    )


def random_directions(count: int, widest_deg: float) -> NDArray[np.float64]:
    rng = np.random.default_rng(12)
    theta = np.radians(rng.uniform(0.0, widest_deg, count))
    around = rng.uniform(0.0, 2.0 * np.pi, count)
    level = np.sin(theta)
    return np.column_stack([level * np.cos(around), level * np.sin(around), np.cos(theta)])


def test_a_fisheye_projects_as_opencv_does() -> None:
    lens = replace(LENS, skew=3.0)
    rays = 2.5 * random_directions(200, 80.0)
    matrix = np.array([[lens.fx, 0.0, lens.cx - 0.5], [0.0, lens.fy, lens.cy - 0.5], [0, 0, 1.0]])
    still, skew = np.zeros(3), lens.skew / lens.fx
    found, _ = cv2.fisheye.projectPoints(
        rays[:, None], still, still, matrix, np.array(lens.radial), alpha=skew
    )
    np.testing.assert_allclose(lens.project(rays), found[:, 0] + 0.5, atol=1e-9)


def test_tangential_terms_and_skew_are_those_of_metashape() -> None:
    lens = replace(LENS, tangential=(2e-3, -1e-3), skew=3.0)
    rays = random_directions(200, 80.0)
    # Its manual: x = x0 atan(r0) / r0 with x0 = X / Z, then as in a frame camera; P1 is p2.
    xy = rays[:, :2] / rays[:, 2:]
    r0 = np.linalg.norm(xy, axis=1)
    x, y = (xy * (np.arctan(r0) / r0)[:, None]).T
    r2 = x * x + y * y
    radial = 1.0 + sum(k * r2 ** (n + 1) for n, k in enumerate(lens.radial))
    p2, p1 = lens.tangential
    bent_x = x * radial + p1 * (r2 + 2 * x * x) + 2 * p2 * x * y
    bent_y = y * radial + p2 * (r2 + 2 * y * y) + 2 * p1 * x * y
    expected = [lens.cx + bent_x * lens.fx + bent_y * lens.skew, lens.cy + bent_y * lens.fy]
    np.testing.assert_allclose(lens.project(rays), np.column_stack(expected), atol=1e-9)
    # A panorama: u = w / 2 + f atan2(x, z), v = h / 2 + f atan2(y, hypot(x, z)), f = w / 2 pi.
    x, y, z = rays.T
    angles = np.column_stack([np.arctan2(x, z), np.arctan2(y, np.hypot(x, z))])
    found = PanoramaLens(width=720, height=360).project(rays)
    np.testing.assert_allclose(found, [360, 180] + 720 / (2 * np.pi) * angles, atol=1e-9)


def test_each_direction_is_shown_once_and_where_it_is() -> None:
    rays = random_directions(600, 88.0)
    n_seen = np.zeros(len(rays), dtype=int)
    faces = faces_of(encode_png(picture(LENS)), "a", LENS)
    assert [face.name for face in faces] == [
        f"a_{face}.png" for face in ("front", "left", "right", "up", "down")
    ]
    for face in faces:
        camera = face.lens.posed(FACES[face.face])
        pixels = camera.project(rays)[:, :2]
        seen = camera.sees(pixels)
        mask = face.mask()
        assert (mask is None) == (face.face == "front")
        at = np.floor(pixels[seen]).astype(int)
        assert mask is None or mask[at[:, 1], at[:, 0]].all()
        n_seen += seen
        shown = decode_image(face.encoded())[at[:, 1], at[:, 0]]
        # Half a pixel beside the place, of 150 to a radian, and the rounding of the colours.
        assert np.abs(shown - coloured(rays[seen])).max() < 100 * 0.75 / 150 + 1.5
    assert (n_seen == 1).all()


def test_beyond_the_field_of_view_nothing_is_used() -> None:
    narrow = replace(LENS, field_of_view_deg=120.0)
    assert np.isnan(narrow.project(random_directions(50, 10.0) @ np.diag([1, 1, -1]))).all()
    for face in faces_of(encode_png(picture(LENS)), "a", narrow):
        mask, lens = face.mask(), face.lens
        assert (mask is None) == (face.face == "front")
        if mask is None:
            continue
        rows, columns = np.nonzero(mask)
        rays = lens.posed().rays_camera(np.column_stack([columns + 0.5, rows + 0.5]))
        theta = np.degrees(
            np.arccos((rays @ FACES[face.face])[:, 2] / np.linalg.norm(rays, axis=1))
        )
        assert 59.0 < theta.max() <= 60.0
        # What the field leaves of a face is cut out, but for the steps by which it is found.
        assert (~mask).mean() < 0.5
        assert not decode_image(face.encoded())[~mask].any()


def test_masks_hold_for_the_faces() -> None:
    used = np.ones((LENS.height, LENS.width), dtype=bool)
    used[:, :260] = False
    names = {}
    for face in faces_of(encode_png(picture(LENS)), "a", LENS, used):
        mask = face.mask()
        assert mask is not None
        names[face.face] = mask
        if face.face == "left":
            continue
        rows, columns = np.nonzero(mask)
        rays = face.lens.posed().rays_camera(np.column_stack([columns + 0.5, rows + 0.5]))
        assert LENS.project(rays @ FACES[face.face])[:, 0].min() > 260.0
    assert not names["left"].any()
    assert names["right"].mean() > 0.3
    columns = np.flatnonzero(names["front"].any(axis=0))
    # The middle of the picture is 252.5, and the front is as fine as the photo is there.
    assert columns[0] == pytest.approx(face_lenses(LENS)["front"].cx + 7.5, abs=1.5)


def test_a_panorama_is_closed_and_masked_and_has_as_many_columns_as_can_be_looked_up() -> None:
    lens = PanoramaLens(width=128, height=64)
    used = np.ones((64, 128), dtype=bool)
    used[:, :64] = False  # all that is to the left
    picture = np.full((64, 128), 100, dtype=np.uint8)
    picture[:, [0, -1]] = 200
    faces = {face.face: face for face in faces_of(encode_png(picture), "p", lens, used)}
    assert list(faces) == list(FACES)
    left, right, front = (faces[name].mask() for name in ("left", "right", "front"))
    assert left is not None
    assert front is not None
    assert right is None
    assert not left.any()
    assert not front[:, :20].any()
    assert front[:, 21:].all()
    # Left of the first column is the last.
    back = faces_of(b"", "p", lens)[list(FACES).index("back")].picture(picture)
    assert back[len(back) // 2, len(back) // 2] == 200
    for width in (0, MOST_PX + 1):
        with pytest.raises(InputError, match=f"photo p is invalid: it has {width} columns"):
            faces_of(b"", "p", replace(lens, width=width))
    assert len(faces_of(b"", "p", replace(lens, width=MOST_PX))) == 6


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"fx": float("nan")}, "focal lengths positive, got nan and 151"),
        ({"width": 40_000}, "it has 40000 x 480 pixels; the limit is 32766"),
        ({"field_of_view_deg": 0.0}, "its field of view is 0 degrees"),
        ({"field_of_view_deg": 360.0}, "its field of view is 360 degrees"),
        ({"radial": (-0.3, 0.0, 0.0, 0.0)}, "not monotonic beyond 60"),
        ({"radial": (1e300, 0.0, 0.0, 0.0)}, "pixels per radian; the limit is 32766"),
        ({"fx": 1e9, "fy": 1e9}, "pixels per radian; the limit is 32766"),
        ({"cx": 1e5}, "it shows no direction inside the image"),
    ],
)
def test_a_lens_that_is_none_says_why(change: dict[str, float], problem: str) -> None:
    lens = replace(LENS, **change)  # type: ignore[arg-type]
    assert problem in problem_of(lens)
    with pytest.raises(InputError, match="the lens of photo a is invalid: "):
        faces_of(b"", "a", lens)
