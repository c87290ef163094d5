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
from numpy.typing import NDArray
from PIL import Image
from syrupy.assertion import SnapshotAssertion

from orthoflow.files import gltf
from orthoflow.files.geotiff import GridPlace, write_raster
from orthoflow.files.gltf import WallMesh, relief_mesh, write_page, write_room
from tests import samples
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
    document, _ = parts(written)
    root = document["nodes"][0]
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


def test_walls_are_painted_with_colours_that_have_their_light_already(
    written: Path, snapshot: SnapshotAssertion
) -> None:
    document, _ = parts(written)
    named = ("extensionsUsed", "materials", "textures", "samplers", "scene", "scenes")
    assert {name: document[name] for name in named} == snapshot
    assert [image["mimeType"] for image in document["images"]] == ["image/png", "image/jpeg"]
    assert document["nodes"][0]["children"] == [1, 2]
    assert [node["mesh"] for node in document["nodes"][1:]] == [0, 1]
    assert {node["extras"]["surface"] for node in document["nodes"][1:]} == {"plane"}


# Walls as triangles

RELIEF_GSD_M = 0.01
RELIEF_SHAPE = (40, 60)


def slope() -> NDArray[np.float32]:
    """Depths that grow by 0.1 m to the right and 0.04 m downwards, by the middles of cells."""
    rows, columns = np.indices(RELIEF_SHAPE)
    return (0.1 * (columns + 0.5) / RELIEF_SHAPE[1] + 0.04 * (rows + 0.5) / RELIEF_SHAPE[0]).astype(
        np.float32
    )


def relief(folder: Path, depths_m: NDArray[np.float32]) -> WallMesh:
    write_raster(folder / "depth.tif", depths_m, place=GridPlace(gsd_m=RELIEF_GSD_M), tags={})
    rows, columns = RELIEF_SHAPE
    frame = samples.facing_east(RELIEF_GSD_M, columns, rows, (1.0, 2.0, 30.0))
    return relief_mesh(frame, folder / "depth.tif")


def area_m2(mesh: WallMesh) -> float:
    """Area as the viewer sees it; triangles that turn their back count less than nothing."""
    first, second, third = (mesh.vertices[mesh.triangles[:, k], :2].astype(float) for k in range(3))
    one, other = second - first, third - first
    return float(0.5 * (one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]).sum())


def test_a_slope_is_where_the_depths_are(tmp_path: Path) -> None:
    mesh = relief(tmp_path, slope())
    assert len(mesh.vertices) == RELIEF_SHAPE[0] * RELIEF_SHAPE[1]
    assert area_m2(mesh) == pytest.approx(0.4 * 0.6)
    np.testing.assert_allclose(mesh.vertices[:, :2], mesh.places * [0.6, -0.4], atol=1e-6)
    # Outer nodes stand for cells half a cell further in.
    expected = 0.1 * mesh.places[:, 0] + 0.04 * mesh.places[:, 1]
    inner = ((mesh.places > 0.0) & (mesh.places < 1.0)).all(axis=1)
    np.testing.assert_allclose(mesh.vertices[inner, 2], expected[inner], atol=1e-6)
    np.testing.assert_allclose(mesh.vertices[:, 2], expected, atol=2e-3)


def test_where_no_depth_is_known_there_is_a_hole(tmp_path: Path) -> None:
    depths_m = slope()
    depths_m[10:20, 30:45] = np.nan
    mesh = relief(tmp_path, depths_m)
    # From the middles of the last known cells on either side, two corners of it halved.
    assert area_m2(mesh) == pytest.approx(0.4 * 0.6 - 0.11 * 0.16 + 0.01**2)
    assert np.isfinite(mesh.vertices).all()
    assert np.unique(mesh.triangles).tolist() == list(range(len(mesh.vertices)))
    assert len(mesh.vertices) == RELIEF_SHAPE[0] * RELIEF_SHAPE[1] - 150


def test_nodes_of_a_large_wall_are_means_of_cells(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gltf, "LONGEST_NODES", 15)
    mesh = relief(tmp_path, slope())
    assert len(mesh.vertices) == 10 * 15
    first = mesh.vertices[:, 2].reshape(10, 15)[0, 0]
    assert first == pytest.approx(slope()[:4, :4].mean(), abs=1e-6)
    assert area_m2(mesh) == pytest.approx(0.4 * 0.6)


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
    drawn = "walls.map(w => [w.kind === gl.UNSIGNED_INT, w.count > 6, gl.getError()])"
    assert page.evaluate(drawn) == [[True, True, 0]] * 2
    # What the browser says of a machine without a graphics card.
    of_machine = ("software WebGL", "ReadPixels")
    assert not [text for text in page.complaints if not any(part in text for part in of_machine)]
    assert all(address.startswith(("file:", "data:", "blob:")) for address in page.requests)
