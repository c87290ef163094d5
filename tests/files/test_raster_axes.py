"""X along the wall and Y as height in every file of a wall; floors and ceilings in plan."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
from numpy.typing import NDArray

from orthoflow.files.geotiff import name_run, read_raster
from orthoflow.files.polygons import write_features
from orthoflow.files.publishing import publish_orthoimages
from orthoflow.files.sidecars import placed_raster
from orthoflow.geometry import WallFrame, basis_from_up, wall_axes
from orthoflow.products import Orthoimages
from tests import samples, scenes

# Survey coordinates; 3 x 2 m in cells of 10 cm.
CORNER = np.array([4_512_345.25, 5_300_210.5, 187.125])
SHAPE = (20, 30)
GSD_M = 0.1
LEAN_DEG = 2.0


def frame(kind: str, up: NDArray[np.float64], *, name: str = "wall 0") -> WallFrame:
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
    of = frame(kind, up)
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
    path = published(frame("wall", UPS[0]), tmp_path)
    before = read_raster(path)
    write_features(tmp_path / "a.geojson", [], frame("wall", UPS[0]).crs)
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
    floor = frame("floor", UPS[0])
    # The ceiling's first row is the floor's last.
    below = floor.world_from_wall(np.array([[0.0, 20.0]]))[0]
    ceiling = replace(frame("ceiling", UPS[0]), origin_world=below + 3.0 * UPS[0])
    bounds = []
    for name, of in (("floor", floor), ("ceiling", ceiling)):
        (tmp_path / name).mkdir()
        with rasterio.open(published(of, tmp_path / name)) as dataset:
            bounds.append(sorted((dataset.bounds.bottom, dataset.bounds.top)))
    np.testing.assert_allclose(bounds[0], bounds[1])


def test_what_neither_stands_nor_lies_counts_from_its_corner() -> None:
    turn = scenes.random_rotation(np.random.default_rng(4))
    wall = frame("wall", UPS[0])
    axes = ("u_world", "v_world", "normal_world")
    sloping = replace(wall, **{name: turn @ getattr(wall, name) for name in axes})
    for of in (sloping, replace(wall, up=None)):
        assert (of.raster_axes, of.raster_corner_m) == ("plane", (0.0, 0.0))
