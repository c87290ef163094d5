from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from orthoflow.files import gltf
from orthoflow.files.gltf import write_room
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


def test_textures_are_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gltf, "LONGEST_TEXTURE_PX", 200)
    write_room(tmp_path / "room.glb", room(tmp_path / "files"), UP)
    scene = trimesh.load(tmp_path / "room.glb")
    picture = scene.geometry["wall </script> 0"].visual.material.baseColorTexture
    assert max(picture.size) == 200
    middle = np.asarray(picture)[100, 150, :3].astype(int)
    whole = colours(WALL_SHAPE)[int(100.5 * 701 / 127), int(150.5 * 1103 / 200)].astype(int)
    assert np.abs(middle - whole).max() <= 2


def test_accessors_stay_inside_their_views(written: Path) -> None:
    told, binary = parts(written)
    assert told["buffers"] == [{"byteLength": len(binary)}]
    width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3}
    for entry in told["accessors"]:
        view = told["bufferViews"][entry["bufferView"]]
        size = {5126: 4, 5123: 2}[entry["componentType"]] * width[entry["type"]] * entry["count"]
        assert view["byteLength"] == size
        assert view["byteOffset"] % 4 == 0
    for view in told["bufferViews"]:
        assert view["byteOffset"] + view["byteLength"] <= len(binary)
