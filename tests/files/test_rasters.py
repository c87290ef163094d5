"""GeoTIFF files, the JSON beside them, and the orthoimages read from both."""

from __future__ import annotations

import json
import math
import os
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import rasterio
from numpy.testing import assert_allclose
from numpy.typing import NDArray

from orthoflow.errors import InputError
from orthoflow.files import geotiff, sidecars
from orthoflow.files.geotiff import (
    GridPlace,
    check_header,
    epsg_wkt,
    name_run,
    place_of,
    read_raster,
    require_map_crs,
    write_orthoimage,
    write_raster,
)
from orthoflow.files.polygons import write_features
from orthoflow.files.publishing import publish_orthoimages
from orthoflow.files.sidecars import OrthoFile, ortho_files, placed_raster
from orthoflow.files.wall_descriptions import described
from orthoflow.geometry import WallFrame, basis_from_up, wall_axes
from orthoflow.products import Orthoimages
from tests import samples, scenes


def test_a_header_states_what_its_file_can_hold(tmp_path: Path) -> None:
    def stated(width: int, **tags: str) -> Any:
        return SimpleNamespace(
            width=width, height=1000, count=1, tags=lambda ns: tags if ns == "OVERVIEWS" else {}
        )

    path = tmp_path / "wall.tif"
    path.touch()
    os.truncate(path, 1_000_000)
    check_header(path, stated(1_100_000))
    with pytest.raises(InputError, match="1100001 x 1000 cells in 1 bands, but its 1000000 bytes"):
        check_header(path, stated(1_100_001))
    with pytest.raises(InputError, match=r"^wall\.tif stores its overviews in another file"):
        check_header(path, stated(4, OVERVIEW_FILE="http://a/b.ovr"))


# --- coordinate systems ---


def test_maps_are_in_metres() -> None:
    for crs in ("EPSG:25832", "EPSG:2100", "site"):
        require_map_crs(crs)
    # Degrees, and feet.
    for crs in ("EPSG:4326", "EPSG:2263"):
        with pytest.raises(InputError, match=f"^{crs} is not a coordinate system in metres"):
            require_map_crs(crs)
    assert "25832" in epsg_wkt(25832)
    assert epsg_wkt(999_999) == ""


def test_a_part_of_a_raster_is_read_where_it_lies(tmp_path: Path) -> None:
    values = np.arange(48, dtype=np.float32).reshape(6, 8)
    geotiff.write_raster(tmp_path / "a.tif", values, place=geotiff.GridPlace(gsd_m=0.5), tags={})
    with geotiff.RasterParts(tmp_path / "a.tif") as source:
        part, shown = source.read((2.0, 1.0, 7.0, 4.0), (3, 5))
        halved, _ = source.read((2.0, 0.0, 6.0, 4.0), (2, 2))
    np.testing.assert_array_equal(part, values[1:4, 2:7])
    assert shown.all()
    np.testing.assert_allclose(halved, values[:4, 2:6].reshape(2, 2, 2, 2).mean(axis=(1, 3)))


# Where a raster lies


def test_a_raster_in_a_map_lies_on_earth(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    # On the central meridian of zone 32, nine degrees east.
    place = GridPlace(gsd_m=2.5, corner_m=(499_990.0, 5_334_000.0), crs="EPSG:25832")
    rgb = np.zeros((4, 8, 3), np.uint8)
    write_orthoimage(path, rgb, np.ones((4, 8), np.bool_), place=place, tags={})
    found = place_of(path)
    assert found.shape == (4, 8)
    assert_allclose(found.transform, (2.5, 0.0, 499_990.0, 0.0, -2.5, 5_334_000.0))
    assert found.bounds == (499_990.0, 5_333_990.0, 500_010.0, 5_334_000.0)
    assert found.epsg == 25832
    assert found.wkt2.startswith("PROJCRS[")
    assert set(found.bands) == {"uint8"}
    assert len(found.bands) in (3, 4)
    lon, lat = np.array(found.outline_lonlat).T
    # Ten metres are 1.35e-4 degrees of longitude at 48.1 degrees north, and 9e-5 of latitude.
    assert_allclose(lon, 9.0 + 1.345e-4 * np.array([-1, 1, 1, -1, -1]), atol=1e-6)
    assert_allclose(lat - lat[0], 8.99e-5 * np.array([0, 0, 1, 1, 0]), atol=1e-7)
    assert lat[0] == pytest.approx(48.157, abs=0.01)


def test_a_raster_in_the_plane_of_its_wall_is_no_place_on_earth(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    write_raster(path, np.zeros((2, 3), np.float32), place=GridPlace(gsd_m=0.5), tags={})
    found = place_of(path)
    assert (found.epsg, found.outline_lonlat) == (None, ())
    assert found.wkt2.startswith('ENGCRS["run 00000000-000000-000000 plane, metres"')
    assert (found.shape, found.bands) == ((2, 3), ("float32",))
    assert found.bounds == (0.0, -1.0, 1.5, 0.0)


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


ROWS, COLUMNS = 6, 9
RGB = np.random.default_rng(1).integers(0, 256, (ROWS, COLUMNS, 3), dtype=np.uint8)
SHOWN = np.ones((ROWS, COLUMNS), dtype=np.bool_)
SHOWN[4:, 2] = False


def frame(rows: int = ROWS, columns: int = COLUMNS) -> WallFrame:
    return samples.facing_south(0.5, columns, rows)


def ortho(folder: Path, rgb: NDArray[np.uint8 | np.uint16] = RGB) -> OrthoFile:
    path = folder / "wall_0_ortho.tif"
    shown = SHOWN[: len(rgb)]
    write_orthoimage(path, rgb, shown, place=GridPlace(gsd_m=0.5), tags={})
    return OrthoFile(path=path, about=described(path, {}), frame=frame(*rgb.shape[:2]), digest="")


def test_orthoimages_are_known_by_their_names_and_come_in_the_order_of_their_walls(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    beside: dict[str, dict[str, object]] = {
        "wall_12_ortho.tif": {"name": "east", "product_digest": "ab12"},
        "wall_3_ortho.tif": {"name": 5, "product_digest": None},
    }
    monkeypatch.setattr(sidecars, "placed_raster", lambda path: (frame(), beside[path.name]))
    names = [*beside, "wall_3_depth.tif", "wall_123456_ortho.tif", "my_wall_1_ortho.tif"]
    found = ortho_files([Path(name) for name in names])
    assert [(one.wall, one.name, one.digest, one.path.name) for one in found] == [
        (3, "wall 3", "", "wall_3_ortho.tif"),
        (12, "east", "ab12", "wall_12_ortho.tif"),
    ]


def test_pictures_are_averaged_to_their_longest_side_and_cut(tmp_path: Path) -> None:
    image = ortho(tmp_path)
    for longest_px, shape in ((3, (2, 3)), (1, (1, 1)), (100, (6, 9))):
        rgb, shown = image.shrunk(longest_px)
        assert rgb.shape == (*shape, 3)
        assert shown.shape == shape
    np.testing.assert_array_equal(rgb[shown], RGB[SHOWN])
    # All cells of the first are shown, so it is their mean.
    mean = RGB[:3, :3].mean(axis=(0, 1))
    np.testing.assert_allclose(image.shrunk(3)[0][0, 0], mean, atol=1.0)
    rgb, shown = image.part((1, 2, COLUMNS, 5), (3, COLUMNS - 1))
    np.testing.assert_array_equal(shown, SHOWN[2:5, 1:])
    np.testing.assert_array_equal(rgb[shown], RGB[2:5, 1:][shown])


def test_depths_are_no_colours(tmp_path: Path) -> None:
    one = ortho(tmp_path)
    write_raster(
        one.path, np.zeros((ROWS, COLUMNS), np.float32), place=GridPlace(gsd_m=0.5), tags={}
    )
    with pytest.raises(
        InputError, match=r"ortho\.tif has 1 bands of float32; expected 3 bands with 8 or"
    ):
        one.shrunk(9)


# X along the wall, Y as height --------------------------------------------------------------------


# Survey coordinates; 3 x 2 m in cells of 10 cm.
CORNER = np.array([4_512_345.25, 5_300_210.5, 187.125])
SHAPE = (20, 30)
GSD_M = 0.1
LEAN_DEG = 2.0


def frame_of(kind: str, up: NDArray[np.float64], *, name: str = "wall 0") -> WallFrame:
    _, second, height = basis_from_up(up)
    lean = np.radians(LEAN_DEG)
    normal = {
        "wall": -second,
        "leaning": -np.cos(lean) * second + np.sin(lean) * height,
        "floor": height,
        "ceiling": -height,
    }[kind]
    u, v = wall_axes(normal, up)
    east, north, top = up.tolist()
    plain = samples.facing_south(GSD_M, SHAPE[1], SHAPE[0], CORNER)
    placed = {"u_world": u, "v_world": v, "normal_world": normal}
    return replace(plain, **placed, up=(east, north, top), name=name)


def published(of: WallFrame, folder: Path) -> Path:
    image = samples.orthoimage(of, name=of.name, rgb=np.full((*of.shape, 3), 90, np.uint8))
    publish_orthoimages(Orthoimages(images=(image,)), folder, "sha256:0")
    return folder / "wall_0_ortho.tif"


UPS = [np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, -1.0]), np.array([0.0, 1.0, 0.0])]


@pytest.mark.parametrize("up", UPS, ids=["z", "-z", "y"])
@pytest.mark.parametrize("kind", ["wall", "leaning", "floor", "ceiling"])
def test_files_have_heights_or_places_in_plan(
    kind: str, up: NDArray[np.float64], tmp_path: Path
) -> None:
    of = frame_of(kind, up)
    path = published(of, tmp_path)
    about = json.loads(path.with_suffix(".json").read_text())
    pixels = np.array([[0.0, 0.0], [30.0, 0.0], [7.5, 20.0]])
    first, second, height = (of.world_from_wall(pixels) @ basis_from_up(up).T).T
    with rasterio.open(path) as dataset:
        place = dataset.transform
        x, y = place.c + place.a * pixels[:, 0], place.f + place.e * pixels[:, 1]
        wkt = dataset.crs.to_wkt()
    if kind in {"wall", "leaning"}:
        np.testing.assert_allclose(x, GSD_M * pixels[:, 0])
        # A wall that leans is longer than it is high.
        np.testing.assert_allclose(y, height, atol=1e-6 if kind == "wall" else 2e-3)
        assert about["x_of_left_m"] == 0.0
        assert about["height_of_top_m"] == pytest.approx(float(CORNER @ up))
    else:
        np.testing.assert_allclose(x, first, atol=1e-6)
        np.testing.assert_allclose(y, second, atol=1e-6)
    again, _ = placed_raster(path)
    assert again.has_cells_of(of)
    assert (again.raster_corner_m, again.crs) == (of.raster_corner_m, of.crs)
    np.testing.assert_allclose(of.wall_from_raster(np.column_stack([x, y])), pixels, atol=1e-6)
    step_x, _, _, step_y, middle_x, middle_y = map(
        float, path.with_suffix(".tfw").read_text().split()
    )
    assert (step_x, step_y) == (GSD_M, of.raster_down * GSD_M)
    assert (middle_x - 0.5 * step_x, middle_y - 0.5 * step_y) == pytest.approx((x[0], y[0]))
    # What lies on it has the same coordinate system.
    write_features(tmp_path / "a.geojson", [], of.crs)
    named = json.loads((tmp_path / "a.geojson").read_text())["crs"]["properties"]["name"]
    assert rasterio.crs.CRS.from_user_input(named).to_wkt() == wkt
    assert f' {of.crs}, metres"' in wkt


@pytest.mark.parametrize("run_id", ["20260314-101500-a1b2c3", "a run: \u00e4 of another program"])
def test_published_files_name_run_and_wall(run_id: str, tmp_path: Path) -> None:
    path = published(frame_of("wall", UPS[0]), tmp_path)
    before = read_raster(path)
    write_features(tmp_path / "a.geojson", [], frame_of("wall", UPS[0]).crs)
    for file in tmp_path.iterdir():
        name_run(file, run_id)
    named = json.loads((tmp_path / "a.geojson").read_text())["crs"]["properties"]["name"]
    crs = json.loads(path.with_suffix(".json").read_text())["crs"]
    with rasterio.open(path) as dataset:
        wkt = dataset.crs.to_wkt()
        assert dataset.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
    assert f'"{crs}, metres"' in wkt
    assert rasterio.crs.CRS.from_user_input(named).to_wkt() == wkt
    assert re.match(rf"run {re.sub('[^ a-z0-9-]', '_', run_id)[:22]}_* wall 0 ", crs)
    np.testing.assert_array_equal(read_raster(path).values, before.values)


def test_a_floor_and_the_ceiling_over_it_lie_upon_each_other(tmp_path: Path) -> None:
    floor = frame_of("floor", UPS[0])
    # The ceiling's first row is the floor's last.
    below = floor.world_from_wall(np.array([[0.0, 20.0]]))[0]
    ceiling = replace(frame_of("ceiling", UPS[0]), origin_world=below + 3.0 * UPS[0])
    bounds = []
    for name, of in (("floor", floor), ("ceiling", ceiling)):
        (tmp_path / name).mkdir()
        with rasterio.open(published(of, tmp_path / name)) as dataset:
            bounds.append(sorted((dataset.bounds.bottom, dataset.bounds.top)))
    np.testing.assert_allclose(bounds[0], bounds[1])


def test_what_neither_stands_nor_lies_counts_from_its_corner() -> None:
    turn = scenes.random_rotation(np.random.default_rng(4))
    wall = frame_of("wall", UPS[0])
    axes = ("u_world", "v_world", "normal_world")
    sloping = replace(wall, **{name: turn @ getattr(wall, name) for name in axes})
    for of in (sloping, replace(wall, up=None)):
        assert (of.raster_axes, of.raster_corner_m) == ("plane", (0.0, 0.0))
