from __future__ import annotations

import json
import re
import struct
from base64 import b64decode
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image

from orthoflow.files.geotiff import GridPlace, write_raster
from orthoflow.files.gltf import write_page, write_room
from tests.browser import Page
from tests.ortho_file_scenes import CORNER, FLOOR_SHAPE, GSD_M, UP, WALL_SHAPE, colours, room


def parts(path: Path) -> tuple[dict[str, Any], bytes]:
    """JSON and binary chunk, as the specification places them."""
    data = path.read_bytes()
    magic, version, length = struct.unpack_from("<III", data)
    assert (magic, version, length) == (0x46546C67, 2, len(data))
    size, kind = struct.unpack_from("<II", data, 12)
    assert (kind, size % 4) == (0x4E4F534A, 0)
    binary, second = struct.unpack_from("<II", data, 20 + size)
    assert (second, binary % 4, 28 + size + binary) == (0x004E4942, 0, len(data))
    return json.loads(data[20 : 20 + size]), data[28 + size :]


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("room")
    write_room(folder / "room.glb", room(folder / "files"), UP)
    return folder / "room.glb"


@pytest.fixture(scope="module")
def carved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same in relief: the right half of each wall stands out by a metre."""
    folder = tmp_path_factory.mktemp("carved")
    orthos, depths = room(folder / "files"), {}
    for ortho in orthos:
        depth_m = np.zeros(ortho.frame.shape, dtype=np.float32)
        depth_m[:, ortho.frame.width // 2 :] = 1.0
        depths[ortho.wall] = folder / f"depth_{ortho.wall}.tif"
        write_raster(depths[ortho.wall], depth_m, place=GridPlace(gsd_m=GSD_M), tags={})
    write_room(folder / "room.glb", orthos, UP, depths)
    return folder / "room.glb"


def test_relief_stands_out_towards_the_viewer(written: Path, carved: Path) -> None:
    flat, high = (trimesh.load(path).geometry for path in (written, carved))
    for name, mesh in high.items():
        low, top = mesh.bounds
        rectangle = flat[name].bounds
        np.testing.assert_allclose([low[:2], top[:2]], rectangle[:, :2], atol=1e-6)
        assert (low[2], top[2]) == (0.0, 1.0)
        right = mesh.vertices[:, 0] > 0.51 * rectangle[1, 0]
        assert (mesh.vertices[right, 2] == 1.0).all()
        # trimesh counts v upwards from below.
        middle = mesh.visual.uv - mesh.vertices[:, :2] / np.ptp(rectangle[:, :2], axis=0)
        np.testing.assert_allclose(middle, np.tile([0.0, 1.0], (len(middle), 1)), atol=1e-5)
        picture = mesh.visual.material.baseColorTexture
        assert picture.size == flat[name].visual.material.baseColorTexture.size


def test_another_program_finds_the_walls_where_they_are(written: Path) -> None:
    told, _ = parts(written)
    root = told["nodes"][0]
    offset = np.array(root["extras"]["offset_world"])
    scene = trimesh.load(written)
    assert set(scene.geometry) == {"wall </script> 0", "floor 1"}
    # x stays, y is up, z is towards the viewer in the south.
    world_from_y_up = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    sides = {"wall_0": WALL_SHAPE, "wall_1": FLOOR_SHAPE}
    normals = {"wall_0": [0, -1, 0], "wall_1": UP}
    starts = {"wall_0": CORNER, "wall_1": CORNER - WALL_SHAPE[0] * GSD_M * UP}
    for node in scene.graph.nodes_geometry:
        placed, name = scene.graph[node]
        mesh = scene.geometry[name].copy()
        mesh.apply_transform(placed)
        corners = mesh.vertices @ world_from_y_up.T + offset
        # 32 bits of some metres: below a micrometre.
        np.testing.assert_allclose(corners[0], starts[node], atol=1e-6)
        rows, columns = sides[node]
        assert mesh.area == pytest.approx(rows * columns * GSD_M**2, rel=1e-6)
        turned = mesh.face_normals @ world_from_y_up.T
        np.testing.assert_allclose(turned, np.tile(normals[node], (2, 1)), atol=1e-6)


def test_textures_show_the_orthoimage_at_its_place(written: Path) -> None:
    scene = trimesh.load(written)
    wall, floor = scene.geometry["wall </script> 0"], scene.geometry["floor 1"]
    # trimesh counts v upwards from below.
    np.testing.assert_allclose(wall.visual.uv[0], [0.0, 1.0])
    picture = np.asarray(wall.visual.material.baseColorTexture)
    assert picture.shape == (*WALL_SHAPE, 4)
    assert (picture[100:300, 200:500, 3] == 0).all()
    assert np.count_nonzero(picture[:, :, 3] == 0) == 200 * 300
    shown = picture[:, :, 3] == 255
    np.testing.assert_array_equal(picture[:, :, :3][shown], colours(WALL_SHAPE)[shown])
    assert wall.visual.material.alphaMode == "MASK"
    assert floor.visual.material.alphaMode in {None, "OPAQUE"}
    jpeg = np.asarray(floor.visual.material.baseColorTexture.convert("RGB")).astype(int)
    assert np.abs(jpeg - colours(FLOOR_SHAPE)).mean() < 3.0


def test_walls_are_painted_with_colours_that_have_their_light_already(written: Path) -> None:
    told, _ = parts(written)
    painted = {
        "metallicFactor": 0.0,
        "roughnessFactor": 1.0,
    }
    wall, floor = told["materials"]
    for index, material in enumerate((wall, floor)):
        texture = {"baseColorTexture": {"index": index}}
        assert material["pbrMetallicRoughness"] == texture | painted
        assert material["extensions"] == {"KHR_materials_unlit": {}}
    # A cell is shown or not: half way between is the border.
    assert (wall["alphaMode"], wall["alphaCutoff"]) == ("MASK", 0.5)
    assert floor.keys().isdisjoint({"alphaMode", "alphaCutoff"})
    assert told["extensionsUsed"] == ["KHR_materials_unlit"]
    assert told["textures"] == [{"sampler": 0, "source": 0}, {"sampler": 0, "source": 1}]
    assert [image["mimeType"] for image in told["images"]] == ["image/png", "image/jpeg"]
    # Linear, between levels too, and no side's colour on the other side.
    assert told["samplers"] == [
        {"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}
    ]
    assert (told["scene"], told["scenes"]) == (0, [{"nodes": [0]}])
    assert told["nodes"][0]["children"] == [1, 2]
    assert [node["mesh"] for node in told["nodes"][1:]] == [0, 1]
    assert {node["extras"]["surface"] for node in told["nodes"][1:]} == {"plane"}


@pytest.mark.long
def test_a_page_shows_the_model_without_a_server(
    new_page: Callable[[], Page], written: Path, carved: Path, tmp_path: Path
) -> None:
    page_file = tmp_path / "room.html"
    write_page(page_file, written)
    text = page_file.read_text()
    (inside,) = re.findall(r'const model = "([A-Za-z0-9+/=]*)"', text)
    assert b64decode(inside) == written.read_bytes()
    page = new_page()
    page.show_as(320, 240)
    page.open(page_file)
    page.evaluate("new Promise(done => setTimeout(done, 1500))")
    if not page.evaluate("gl !== null"):
        assert "no WebGL" in page.evaluate("document.getElementById('said').textContent")
        return
    names = "[...document.querySelectorAll('option')].map(o => o.textContent)"
    assert page.evaluate(names) == ["whole room", "wall </script> 0", "floor 1"]
    # Looked at from its front, the middle of the wall is painted as the orthoimage has it.
    page.evaluate("show(0)")
    (tmp_path / "page.png").write_bytes(page.screenshot())
    picture = np.asarray(Image.open(tmp_path / "page.png").convert("RGB")).astype(int)
    box = page.evaluate("(b => [b.left, b.top, b.width, b.height])(canvas.getBoundingClientRect())")
    pixel = picture[round(box[1] + box[3] / 2), round(box[0] + box[2] / 2)]
    rows, columns = WALL_SHAPE
    middle = colours(WALL_SHAPE)[rows // 2 - 4 : rows // 2 + 4, columns // 2 - 4 : columns // 2 + 4]
    assert np.abs(pixel - middle.mean(axis=(0, 1))).max() <= 12
    write_page(tmp_path / "carved.html", carved)
    page.open(tmp_path / "carved.html")
    page.evaluate("new Promise(done => setTimeout(done, 1000))")
    page.evaluate("show(0)")
    drawn = "walls.map(w => [w.kind === gl.UNSIGNED_INT, w.count > 6, gl.getError()])"
    assert page.evaluate(drawn) == [[True, True, 0]] * 2
    # What the browser says of a machine without a graphics card.
    of_machine = ("software WebGL", "ReadPixels")
    assert not [text for text in page.complaints if not any(part in text for part in of_machine)]
    assert all(address.startswith(("file:", "data:", "blob:")) for address in page.requests)
