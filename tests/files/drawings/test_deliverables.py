"""Relief, elevations, QGIS projects and IIIF of walls whose depths and places are known."""

from __future__ import annotations

import json
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pdfplumber
import pytest
import rasterio
from PIL import Image

from orthoflow.files.drawings.geojson import ProjectLayer, write_project
from orthoflow.files.drawings.printed_pictures import (
    NOTHING,
    ElevationWall,
    Light,
    elevation,
    shaded,
    unfolded,
    write_depth_figure,
    write_relief,
)
from orthoflow.files.drawings.sheet_contents import SheetText, TitleBlock
from orthoflow.files.geotiff import GridPlace, write_raster
from orthoflow.files.sidecars import placed_raster
from orthoflow.geometry.frames import frame_over
from orthoflow.records.open import open_run
from orthoflow.records.walls import delivered_walls, room_results, write_walls_json
from tests.drawing_runs import GSD_M, SIZE_M, WALL, box_image, box_planes, export, write_drawing_run
from tests.optional import skip

UP = np.array([0.0, 0.0, 1.0])


@pytest.mark.parametrize("slope", [-0.6, 0.0, 0.3])
def test_shading_is_the_cosine_between_surface_and_light(slope: float) -> None:
    gsd_m = 0.01
    depths = np.tile(slope * gsd_m * np.arange(20.0), (10, 1))  # rises to the right
    light = Light(azimuth_deg=90.0, altitude_deg=30.0)  # from the right
    normal = np.array([-slope, 0.0, 1.0]) / np.hypot(slope, 1.0)
    towards = np.array([np.cos(np.radians(30.0)), 0.0, np.sin(np.radians(30.0))])
    wanted = 1.0 + 254.0 * max(0.0, float(normal @ towards))
    assert np.abs(shaded(depths, gsd_m, light).astype(float) - wanted).max() <= 1.0


def test_light_from_above_meets_what_looks_up() -> None:
    depths = np.tile(-0.005 * np.arange(20.0)[:, None], (1, 10))  # recedes downwards: looks down
    depths[5, 5] = np.nan
    above, below = (shaded(depths, 0.01, Light(azimuth_deg=a)) for a in (0.0, 180.0))
    assert above[5, 5] == below[5, 5] == NOTHING
    assert below[8:].min() > above[8:].max()


def test_noise_of_a_flat_wall_is_not_shaded_and_an_edge_is(tmp_path: Path) -> None:
    depths = np.random.default_rng(5).normal(0.0, 0.002, (400, 600)).astype(np.float32)
    depths[:, 300:] += 0.03
    write_raster(tmp_path / "depth.tif", depths, place=GridPlace(gsd_m=0.005), tags={})
    write_relief(tmp_path / "depth.tif", tmp_path / "relief.tif", Light(azimuth_deg=90.0))
    with rasterio.open(tmp_path / "relief.tif") as made:
        grey = made.read(1).astype(float)
    flat = np.delete(grey, np.s_[295:305], axis=1)
    # Noise tilts cells by 15 degrees; averaged, by two.
    assert flat.std() < 10.0
    assert grey[:, 299:301].mean() < flat.mean() - 90.0


def test_equal_depths_before_and_behind_the_plane_have_equally_strong_colours(
    run: Path, tmp_path: Path
) -> None:
    depth = next((run / "products").rglob(f"wall_{WALL}_depth.tif"))
    frame = placed_raster(depth)[0]
    # Three bands: 40 mm behind the plane, on it, and 10 mm before it.
    rows = np.repeat([-0.04, 0.0, 0.01], -(-frame.height // 3))[: frame.height, None]
    depths_m = np.broadcast_to(rows, frame.shape).astype(np.float32)
    write_raster(tmp_path / "depth.tif", depths_m, place=GridPlace.of(frame), tags={})
    write_depth_figure(tmp_path / "depth.tif", frame, tmp_path / "figure.png", Light())
    with Image.open(tmp_path / "figure.png") as figure:
        rgb = np.asarray(figure.convert("RGB")).astype(int)
    colours, counts = np.unique(rgb.reshape(-1, 3), axis=0, return_counts=True)
    paleness = colours.min(axis=1) / np.maximum(colours.max(axis=1), 1)
    common = {
        sign: paleness[of][np.argmax(counts[of])]
        for sign in (-1, 1)
        for of in [np.flatnonzero(sign * (colours[:, 0] - colours[:, 2]) > 8)]
    }
    # A quarter of the depth is a pale red beside a full blue.
    assert common[-1] < 0.2
    assert common[1] > 0.6
    # What lies on the plane is grey, shaded as it is.
    grey = (np.ptp(colours, axis=1) < 4) & (colours.max(axis=1) < 250)
    assert counts[grey].sum() > 0.2 * counts[colours.max(axis=1) < 250].sum()


def test_relief_lies_where_the_depths_do(run: Path, tmp_path: Path) -> None:
    export(run, "relief", tmp_path / "out", "--light", "90,20", code=0)
    depth = next((run / "products").rglob(f"wall_{WALL}_depth.tif"))
    with (
        rasterio.open(depth) as given,
        rasterio.open(tmp_path / "out" / f"wall_{WALL}_relief.tif") as made,
    ):
        assert (made.transform, made.crs, made.shape) == (given.transform, given.crs, given.shape)
        assert np.array_equal(made.read(1) == NOTHING, ~np.isfinite(given.read(1)))
    lines = json.loads((tmp_path / "out" / f"wall_{WALL}_contours.geojson").read_text())
    assert lines["type"] == "FeatureCollection"
    with Image.open(tmp_path / "out" / f"wall_{WALL}_relief.png") as figure:
        assert figure.width > 600
    export(run, "relief", tmp_path / "no", "--light", "90", code=2)


def test_walls_unfold_in_the_order_of_a_viewer_who_turns_right() -> None:
    planes = box_planes()
    walls = [
        ElevationWall(
            name=planes.names[k],
            frame=frame_over(planes.corners[k], planes.normal[k], gsd_m=0.05),
            raster=Path("none.tif"),
        )
        for k in (2, 3, 4, 5)
    ]
    order, is_inside = unfolded([walls[2], walls[0], walls[3], walls[1]], UP)
    assert is_inside
    names = [wall.name for wall in order]
    # Walls 2 (y = 3 m), 3 (x = 4 m), 4 (y = 0), 5 (x = 0) follow each other clockwise.
    start = names.index("wall 2")
    assert names[start:] + names[:start] == ["wall 2", "wall 3", "wall 4", "wall 5"]
    text = SheetText(name="walls", block=TitleBlock(), notes=(), digest="0" * 64, run="run")
    drawing = elevation(order, UP, text, 50)
    assert drawing.size_m[0] >= sum(wall.size_m[0] for wall in order)
    # Each floor and each ceiling has its height.
    start, slope = drawing.axes.down
    edges = {height for wall in order for height in (wall.frame.corners_world() @ UP).tolist()}
    marked = {start + slope * down for down in drawing.heights}
    assert all(min(abs(height - edge) for edge in edges) < 1e-3 for height in marked)


def test_an_elevation_has_the_picture_in_scale(run: Path, tmp_path: Path) -> None:
    export(run, "elevation", tmp_path / "out", "--scale", 25, "--language", "fr", code=0)
    with pdfplumber.open(tmp_path / "out" / "elevation_1.pdf") as pdf:
        (page,) = pdf.pages
        (image,) = page.images
        words = page.extract_text()
        assert "1:25" in words
        # With the title block of all sheets, in the language.
        assert "feuille 1 sur 1" in words
    in_mm = 25.4 / 72.0
    assert (image["x1"] - image["x0"]) * in_mm == pytest.approx(
        1000 * (SIZE_M[0] - 0.2) / 25, abs=0.1
    )


def test_walls_of_an_elevation_stand_at_their_heights(tmp_path: Path) -> None:
    image = box_image()
    corner = image.frame.origin_world + 5.0 * image.frame.u_world - [0.0, 0.0, 0.5]
    frame = replace(image.frame, origin_world=corner)
    lower = replace(image, name="wall 3", plane_index=3, frame=frame)
    run = write_drawing_run(tmp_path / "run", others=(lower,))
    export(run, "elevation", tmp_path / "out", "--scale", 50, code=0)
    with pdfplumber.open(tmp_path / "out" / "elevation_1.pdf") as pdf:
        first, second = sorted(one["top"] for one in pdf.pages[0].images)
    assert (second - first) * 25.4 / 72.0 == pytest.approx(10.0, abs=0.1)


def test_a_qgis_project_shifts_x_alone(run: Path, tmp_path: Path) -> None:
    export(run, "qgis", tmp_path / "out", code=0)
    project = (tmp_path / "out" / "walls.qgs").read_text()
    virtual = sorted((tmp_path / "out").glob("*_ortho.vrt"))
    assert virtual
    for path in virtual:
        assert f"./{path.name}" in project
        given = next((run / "products").rglob(f"{path.stem.partition('_')[2]}.tif"))
        with rasterio.open(path) as shifted, rasterio.open(given) as raster:
            assert shifted.transform.f == raster.transform.f
            assert shifted.transform.a == pytest.approx(GSD_M)
            assert np.array_equal(shifted.read(), raster.read())
            assert np.array_equal(shifted.dataset_mask(), raster.dataset_mask())


def test_walls_of_a_qgis_project_stand_side_by_side(run: Path, tmp_path: Path) -> None:
    raster = next((run / "products").rglob("*_ortho.tif"))
    about = {"kind": "ortho", "raster": raster, "about": "", "is_shown": True}
    write_project(tmp_path, "walls", [ProjectLayer(wall=name, **about) for name in "ab"])
    bounds = []
    for path in sorted(tmp_path.glob("*.vrt")):
        with rasterio.open(path) as placed:
            bounds.append(placed.bounds)
    assert bounds[1].left == pytest.approx(bounds[0].right + 1.0)
    assert bounds[1].top == bounds[0].top


def test_every_export_states_the_same_of_a_wall(tmp_path: Path) -> None:
    """GIS, tiles, manifest, catalogue and `walls.json`: size, share painted, expected error."""
    image = box_image()
    errors_m = np.full(image.frame.shape, 0.002, np.float32)
    image = replace(image, error_m=errors_m, n_check_points=12)
    run = write_drawing_run(tmp_path / "run", image=image)
    (wall,) = room_results(open_run(run)).walls
    assert wall.about is not None
    assert wall.about.sentence == (
        "3.80 x 2.30 m; 97% covered; expected error of a point measured in this image: median "
        "2.0 mm, 95 % below 2.0 mm (one standard deviation, relative to the scan and excluding "
        "its errors, due to orientation, depth and parallax; withheld tie points on this wall: 12)"
    )
    for target, file in (
        ("qgis", "walls.qgs"),
        ("tiles", "index.html"),
        ("iiif", "manifest.json"),
        ("stac", f"products/mosaic/wall_{WALL}_ortho.item.json"),
    ):
        export(run, target, tmp_path / target, code=0)
        assert wall.about.sentence in (tmp_path / target / file).read_text(), target
    item = json.loads((tmp_path / "stac" / file).read_text())
    assert item["properties"]["orthoflow:expected_mm_median"] == pytest.approx(2.0)
    assert item["assets"]["error"]["href"] == f"./wall_{WALL}_error.tif"
    cells = open_run(run).record.cells
    write_walls_json(run / "products", cells)
    assert delivered_walls(run / "products") == (
        wall.about.model_copy(update={"orthoimage": f"mosaic/wall_{WALL}_ortho.tif"}),
    )
    assert delivered_walls(tmp_path) == ()
    (tmp_path / "walls.json").write_text('{"walls": [{"number": "x"}]}')
    assert delivered_walls(tmp_path) == ()


@pytest.mark.filterwarnings("default")  # the models of iiif_prezi3
def test_an_iiif_manifest_has_a_scale_and_its_tiles_are_the_picture(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "out"
    monkeypatch.setattr("orthoflow.files.tiles.iiif.TILE_PX", 256)
    export(run, "iiif", folder, "--base-url", "https://example.org/room/", code=0)
    text = (folder / "manifest.json").read_text()
    manifest = json.loads(text)
    (canvas,) = manifest["items"]
    assert canvas["service"][0]["physicalScale"] == pytest.approx(1000 * GSD_M)
    stem = f"wall_{WALL}_ortho"
    layers = {one["id"].split("/")[4] for one in canvas["items"][0]["items"][0]["body"]["items"]}
    assert layers == {stem, *(f"wall_{WALL}_{kind}" for kind in ("intensity", "depth", "relief"))}
    info = json.loads((folder / stem / "info.json").read_text())
    assert info["id"] == f"https://example.org/room/{stem}"
    with rasterio.open(next((run / "products").rglob(f"{stem}.tif"))) as raster:
        assert (info["height"], info["width"]) == raster.shape
        wanted = np.moveaxis(raster.read(), 0, 2)[:, :, :3].astype(int)
        shown = raster.dataset_mask() > 0
    made = np.zeros_like(wanted)
    for top in range(0, info["height"], 256):
        for left in range(0, info["width"], 256):
            wide, high = min(256, info["width"] - left), min(256, info["height"] - top)
            tile = folder / stem / f"{left},{top},{wide},{high}" / f"{wide},{high}" / "0"
            made[top : top + high, left : left + wide] = np.asarray(
                Image.open(tile / "default.jpg")
            )
    # JPEG keeps grey levels to a few.
    assert np.abs(made - wanted)[shown].mean() < 6
    if find_spec("iiif_prezi3") is None:
        skip("program", "iiif-prezi3, which asks for an older Pillow")
    from iiif_prezi3 import Manifest

    assert len(Manifest(**manifest).items) == 1
