"""JSON beside rasters: how large, how long, and which vectors make a frame."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from orthoflow.errors import InputError, StoreError
from orthoflow.files import sidecars
from orthoflow.files.geotiff import GridPlace
from orthoflow.geometry import WallFrame
from orthoflow.products import LayerMask, OrthoMask, SurfaceMask


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
        ({"u_world": [0.0, 1.0]}, "u_world must be three numbers"),
        ({"u_world": [0.0, True, 0.0]}, "u_world must be three numbers"),
        ({"u_world": [0.0, "1.0", "x"]}, "u_world must be three numbers"),
        ({"u_world": [[0.0], [1.0, 2.0], [0.0]]}, "u_world must be three numbers"),
        ({"u_world": [0.0, 10**400, 0.0]}, "u_world must be three numbers"),
        ({"origin_world": [1e9, 0.0, 0.0]}, "origin_world must be three numbers"),
        ({"origin_world": [-1e9, 0.0, 0.0]}, "origin_world must be three numbers"),
        ({"origin_world": [math.nan, 0.0, 0.0]}, "origin_world must be three numbers"),
        ({"v_world": [0.0, 0.0, 1.0]}, "a.json: a wall frame needs u x v = -n"),
    ],
)
def test_what_makes_no_frame_is_told(changes: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        placed(vectors(**changes))


def test_the_farthest_frame_is_a_frame() -> None:
    assert placed(vectors(origin_world=[9.9e8, 0.0, 0.0])).origin_world[0] == 9.9e8


def test_long_values_are_cut_in_messages() -> None:
    assert sidecars.shown_value("a" * 98) == repr("a" * 98)
    assert sidecars.shown_value("a" * 99) == "'" + "a" * 99 + " ..."


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"\xff", r"a\.json is not UTF-8 text"),
        (b"{", r"a\.json: no JSON, "),
        (b"[]", r"a\.json: expected a JSON object with origin_world"),
    ],
)
def test_what_is_no_sidecar_is_told(tmp_path: Path, content: bytes, message: str) -> None:
    (tmp_path / "a.json").write_bytes(content)
    with pytest.raises(InputError, match=message):
        sidecars.read_sidecar(tmp_path / "a.json")


def test_numbers_that_json_has_not_become_null() -> None:
    assert sidecars.numbers(np.array([[1.5, np.nan], [np.inf, 2.0]])) == [[1.5, None], [None, 2.0]]
    assert sidecars.numbers(np.array([1, 2])) == [1, 2]
    assert sidecars.numbers(np.array([True, False])) == [True, False]
    assert [sidecars.number(value) for value in (None, math.nan, -math.inf, 2.0)] == [
        None,
        None,
        None,
        2.0,
    ]


def test_each_value_of_a_mask_has_its_meaning() -> None:
    for meanings, mask in (
        (sidecars.SURFACE_MASK_MEANINGS, SurfaceMask),
        (sidecars.LAYER_MASK_MEANINGS, LayerMask),
        (sidecars.ORTHO_MASK_MEANINGS, OrthoMask),
    ):
        said: Any = sidecars.mask_meanings(meanings)
        assert list(said) == [str(value) for value in range(len(mask))]
        assert [text.partition(":")[0].replace(" ", "_") for text in said.values()] == [
            value.name.lower() for value in mask
        ]


@pytest.mark.parametrize("map_crs", [None, "site"])
def test_tags_place_a_raster_without_the_file_beside_it(map_crs: str | None) -> None:
    frame = placed(vectors() | ({} if map_crs is None else {"map_crs": map_crs}), (1.0, 3.0))
    tags = sidecars.raster_tags(
        frame, digest="sha256:0", name="wall 0", content="depth", extra={"unit": "m"}
    )
    assert (tags["gsd_m"], tags["name"], tags["content"], tags["unit"]) == (
        "0.5",
        "wall 0",
        "depth",
        "m",
    )
    assert (tags["product_digest"], tags["software"]) == ("sha256:0", "orthoflow")
    assert json.loads(tags["plane"]) == {"normal": [1.0, 0.0, 0.0], "offset_m": 1.0}
    content = json.loads(tags["frame"])
    assert content.get("map_crs") == map_crs
    assert sidecars.frame_of_raster(
        content,
        raster=GridPlace(gsd_m=0.5, corner_m=frame.raster_corner_m),
        shape=(2, 4),
        name="a.tif",
    ).has_cells_of(frame)


def test_json_is_written_for_people_and_with_every_letter(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    sidecars.write_json(path, {"name": "w\N{LATIN SMALL LETTER A WITH DIAERESIS}nde", "n": [1]})
    text = path.read_text(encoding="utf-8")
    assert (
        text
        == '{\n  "name": "w\N{LATIN SMALL LETTER A WITH DIAERESIS}nde",\n  "n": [\n    1\n  ]\n}\n'
    )
    with pytest.raises(ValueError, match="not JSON compliant"):
        sidecars.write_json(path, {"n": math.nan})
    with pytest.raises(StoreError, match=r"b\.json cannot be written: .*; free some space"):
        sidecars.write_text(tmp_path / "none" / "b.json", "")
