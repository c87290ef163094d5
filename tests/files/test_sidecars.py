"""JSON beside rasters: how large, how long, and which vectors make a frame."""

from __future__ import annotations

import math

import pytest

from orthoflow.errors import InputError
from orthoflow.files import sidecars
from orthoflow.files.geotiff import GridPlace
from orthoflow.geometry import WallFrame


def vectors(**changes: object) -> dict[str, object]:
    """A wall in the plane x = 1, seen from the east."""
    usual: dict[str, object] = {
        "origin_world": [1.0, 2.0, 3.0],
        "u_world": [0.0, 1.0, 0.0],
        "v_world": [0, 0, -1],
        "normal_world": [1.0, 0.0, 0.0],
    }
    return {**usual, **changes}


def placed(content: dict[str, object], corner_m: tuple[float, float] = (0.0, 0.0)) -> WallFrame:
    return sidecars.frame_of_raster(
        content, raster=GridPlace(gsd_m=0.5, corner_m=corner_m), shape=(2, 4), name="a.json"
    )


def test_a_raster_lies_where_its_corner_is_in_the_plane() -> None:
    frame = placed(vectors(), (1.5, -0.5))
    # X counts along u, Y against v, which points down.
    assert frame.origin_world.tolist() == [1.0, 3.5, 2.5]
    assert (frame.width, frame.height, frame.gsd_m, frame.map_crs) == (4, 2, 0.5, None)


def test_a_map_lies_where_its_coordinates_are() -> None:
    content = vectors(
        u_world=[1.0, 0.0, 0.0], v_world=[0.0, -1.0, 0.0], normal_world=[0, 0, 1], map_crs=2180
    )
    frame = placed(content, (10.0, 20.0))
    assert frame.origin_world.tolist() == [10.0, 20.0, 3.0]
    assert frame.map_crs == "2180"
    assert frame.raster_corner_m == (10.0, 20.0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"u_world": None}, "u_world must be three numbers below 1e\\+09, got None"),
        *(
            ({"u_world": value}, "u_world must be three numbers")
            for value in (
                *([0.0, 1.0], [0.0, True, 0.0], [0.0, "1.0", "x"], [0.0, 10**400, 0.0]),
                [[0.0], [1.0, 2.0], [0.0]],
            )
        ),
        *(
            ({"origin_world": [value, 0.0, 0.0]}, "origin_world must be three numbers")
            for value in (1e9, -1e9, math.nan)
        ),
        ({"v_world": [0.0, 0.0, 1.0]}, "a.json: a wall frame needs u x v = -n"),
    ],
)
def test_what_makes_no_frame_is_told(changes: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        placed(vectors(**changes))
