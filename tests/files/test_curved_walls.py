"""Files of curved walls: models and drawings place them in space, pages convert positions."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import ezdxf
import numpy as np
import pytest
import trimesh

from orthoflow.files.drawings.dxf import write_room_dxf, write_wall_dxf
from orthoflow.files.drawings.geojson import write_wall_geojson
from orthoflow.files.drawings.key_plans import DrawnWall, RoomLines, key_plan
from orthoflow.files.drawings.sheet_contents import axes_of, north_of
from orthoflow.files.geotiff import GridPlace, write_raster
from orthoflow.files.gltf import write_room
from orthoflow.files.publishing import publish_orthoimages
from orthoflow.files.sidecars import OrthoFile, ortho_files, read_sidecar
from orthoflow.files.tiles.pyramid import PAGE, write_viewer
from orthoflow.files.wall_descriptions import described
from orthoflow.geometry import ConeBend, CylinderBend, SphereBend, WallFrame
from orthoflow.products import Orthoimages
from orthoflow.report.pictures import Picture, cursor_places
from tests import drawing_runs, samples
from tests.raster_scenes import UP

RADIUS_M = 2.0
FLAT = replace(
    samples.facing_south(0.05, 100, 40, (5.0, 6.0, 7.0)), up=(0.0, 0.0, 1.0), name="tower 3"
)
# A whole turn has 251 cells.
WALLS = {
    "tower": replace(FLAT, bend=CylinderBend(along="u", radius_m=-RADIUS_M)),
    "column": replace(FLAT, width=251, bend=CylinderBend(along="u", radius_m=-RADIUS_M)),
    "vault": replace(FLAT, height=80, bend=CylinderBend(along="v", radius_m=RADIUS_M)),
    "spire": replace(
        FLAT,
        height=84,
        bend=ConeBend(
            apex_m=(2.525, 0.025),
            toward_rad=0.5 * math.pi,
            half_angle_rad=0.2,
            is_inside=False,
            slants_m=(2.0, 4.0),
            half_sector_rad=math.pi * math.sin(0.2),
        ),
    ),
    "dome": replace(
        FLAT,
        height=100,
        bend=SphereBend(pole_m=(2.5, 2.5), radius_m=1.6, is_inside=True, most_m=2.5),
    ),
}


def published(frame: WallFrame, folder: Path) -> OrthoFile:
    image = samples.orthoimage(
        frame, wall=0, name="tower 3", rgb=np.full((*frame.shape, 3), 90, np.uint8)
    )
    folder.mkdir()
    publish_orthoimages(Orthoimages(images=(image,)), folder, "sha256:" + "1" * 64)
    (ortho,) = ortho_files(sorted(folder.iterdir()))
    return ortho


@pytest.mark.parametrize("name", WALLS)
@pytest.mark.parametrize("depth_m", [None, 0.3])
def test_models_bend_walls(name: str, depth_m: float | None, tmp_path: Path) -> None:
    frame = WALLS[name]
    ortho = published(frame, tmp_path / "files")
    assert ortho.frame.has_cells_of(frame)
    assert ortho.frame.raster_axes == frame.raster_axes
    # The mean of the corners of a dome is far below it.
    raster = tmp_path / "files" / ortho.path
    near = described(raster, read_sidecar(raster.with_suffix(".json"))).near
    assert near == pytest.approx(frame.middle_world.tolist(), abs=0.006)
    depths = None
    if depth_m is not None:
        depths = {ortho.wall: tmp_path / "depth.tif"}
        rows, columns = np.mgrid[: frame.height, : frame.width] + 0.5
        is_shown = frame.shows(np.column_stack([columns.ravel(), rows.ravel()]))
        raster = np.where(is_shown.reshape(frame.shape), depth_m, np.nan).astype(np.float32)
        write_raster(depths[ortho.wall], raster, place=GridPlace(gsd_m=frame.gsd_m), tags={})
    write_room(tmp_path / "room.glb", (ortho,), UP, depths)
    scene = trimesh.load(tmp_path / "room.glb")
    document = json.loads(json.dumps(scene.graph.to_flattened()))
    (node,) = (one for one in document.values() if one["geometry"])
    (mesh,) = scene.geometry.values()
    # The root turns y up, and the model has an offset.
    placed = np.array(node["transform"])
    points = mesh.vertices @ placed[:3, :3].T + placed[:3, 3]
    world = points @ np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]).T
    shares = mesh.visual.uv * [1.0, -1.0] + [0.0, 1.0]
    cells = shares * [frame.width, frame.height]
    expected = frame.world_from_wall(cells, depth_m or 0.0)
    off = world - expected
    np.testing.assert_allclose(off - np.round(off[0]), 0.0, atol=1e-4)
    middles = cells[mesh.faces].mean(axis=1)
    normals = mesh.face_normals @ placed[:3, :3].T @ np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]).T
    assert (np.einsum("ij,ij->i", normals, frame.axes_at(middles)[:, 2]) > 0.99).all()


@pytest.mark.parametrize("name", WALLS)
def test_drawings_unroll_and_place_walls(name: str, tmp_path: Path) -> None:
    frame = WALLS[name]
    wall = DrawnWall(number=3, name="tower 3", plane_index=None, frame=frame, image="wall_3.png")
    width_m, height_m = 0.05 * frame.width, 0.05 * frame.height
    np.testing.assert_allclose(np.ptp(wall.corners_m, axis=0), [width_m, height_m])
    lines = RoomLines(planes=drawing_runs.box_planes(), checkpoints=None)
    write_wall_dxf(tmp_path / "wall.dxf", wall, lines)
    (image,) = ezdxf.readfile(tmp_path / "wall.dxf").modelspace().query("IMAGE")
    np.testing.assert_allclose(image.dxf.u_pixel[0] * frame.width, width_m)
    write_room_dxf(tmp_path / "room.dxf", [wall], lines)
    space = ezdxf.readfile(tmp_path / "room.dxf").modelspace()
    assert not space.query("IMAGE")
    rings = [
        np.array([tuple(vertex.dxf.location) for vertex in line.vertices])
        for line in space.query("POLYLINE")
    ]
    assert any(
        len(ring) > 100 and np.abs(frame.wall_from_world(ring)[:, 2]).max() < 1e-6 for ring in rings
    )
    unrolled = {
        "spire": "unrolled cone with a half angle of 11.46°",
        "dome": "development of a sphere of radius 1.600 m, which cannot be unrolled",
    }
    text = axes_of(frame).phrase.text()
    assert text.startswith(unrolled.get(name, "unrolled cylinder of radius 2.000 m"))
    assert name != "dome" or "up to 1.56 times" in text
    assert north_of(frame) is None
    assert key_plan(lines.planes, frame).arrow is None
    write_wall_geojson(tmp_path / "wall.geojson", wall, lines)
    features = json.loads((tmp_path / "wall.geojson").read_text())["features"]
    ring = np.array(features[0]["geometry"]["coordinates"][0])
    np.testing.assert_allclose(np.ptp(ring, axis=0), [width_m, height_m])


def test_pages_know_the_arc_of_a_wall(tmp_path: Path) -> None:
    frame = WALLS["vault"]
    assert frame.bend is not None
    bend = frame.bend.revolution.numbers
    ortho = published(frame, tmp_path / "files")
    write_viewer(tmp_path, {"vault": ortho})
    assert f'"bend": {json.dumps(bend)}' in (tmp_path / PAGE).read_text()
    pictures = [
        Picture(uri="", title="", caption="", frame=one, id=str(k))
        for k, one in enumerate((frame, frame.flat))
    ]
    curved, flat = cursor_places(pictures, [])
    assert curved["bend"] == bend
    assert "bend" not in flat
