"""A room as binary glTF 2.0: each wall with its orthoimage, flat or in relief, in metres, y up."""

from __future__ import annotations

import struct
from base64 import b64encode
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.images import encode_jpeg, encode_png
from orthoflow.files.json_texts import json_bytes
from orthoflow.files.ortho_files import OrthoFile
from orthoflow.files.sidecars import numbers, write_bytes
from orthoflow.files.wall_meshes import flat_mesh, relief_mesh
from orthoflow.geometry.directions import basis_from_up
from orthoflow.products import JsonValue
from orthoflow.version import __version__

# What graphics cards of today's phones still take.
LONGEST_TEXTURE_PX: Final = 4096
# Browsers take pages of some hundred megabytes; letters take a third more.
_INSIDE_MOST_BYTES: Final = 1 << 27
_COMPONENTS: Final = {"float32": 5126, "uint16": 5123, "uint32": 5125}
_VERTICES, _INDICES = 34962, 34963
_MAGIC, _JSON_CHUNK, _BINARY_CHUNK = 0x46546C67, 0x4E4F534A, 0x004E4942
_CLAMPED, _LINEAR, _TRILINEAR = 33071, 9729, 9987


def write_room(
    path: Path,
    orthos: Sequence[OrthoFile],
    up: NDArray[np.float64],
    depths: Mapping[int, Path] | None = None,
) -> None:
    """Write the walls; memory holds one texture at a time beside the file.

    A wall is a node with a matrix: its vertices are metres on the wall, its matrix places it
    relative to `extras.offset_world` of the root, which makes y of the world's up. So large survey
    coordinates stay out of the 32 bits of vertices. Empty cells are transparent; what is behind a
    wall sees through it.

    Args:
        path: the new file, `.glb`.
        orthos: at least one.
        up: (3,) unit vector of the world.
        depths: GeoTIFF of the depths of each wall, by number, for walls in relief; without them
            walls are flat.

    Raises:
        StoreError: the file cannot be written.
        InputError: an orthoimage or a depth raster cannot be read.
    """
    corners = np.concatenate([ortho.frame.corners_world() for ortho in orthos])
    offset = np.round(corners.mean(axis=0))
    document = _Document()
    children = [
        document.add_wall(ortho, offset, None if depths is None else depths[ortho.wall])
        for ortho in orthos
    ]
    first, second, _ = basis_from_up(up)
    turned = np.eye(4)
    turned[:3, :3] = [first, up, -second]
    root: dict[str, JsonValue] = {
        "name": "room",
        "matrix": _columns(turned),
        "children": [*children],
        "extras": {
            "offset_world": numbers(offset),
            "meaning": "world = offset_world + what the matrices of walls give; the matrix of "
            "this node turns the world's up to y",
            "unit": "m",
        },
    }
    write_bytes(path, document.finished(root))


def write_page(path: Path, model: Path) -> None:
    """Write a page that shows a model without a server: the model is in it, up to some size.

    Of a larger one, or one that cannot be read, the page asks for the file.

    Args:
        path: the new file, `.html`.
        model: a file of `write_room`.

    Raises:
        StoreError: the file cannot be written.
    """
    page = files(__package__).joinpath("room_viewer.html").read_text(encoding="utf-8")
    head, _, tail = page.partition("/*MODEL*/")
    content = b"" if model.stat().st_size > _INSIDE_MOST_BYTES else b64encode(model.read_bytes())
    write_bytes(path, b"".join([head.encode(), content, tail.encode()]))


@dataclass(frozen=True, kw_only=True)
class _Document:
    """A glTF document as it grows, and the bytes that it points into."""

    data: bytearray = field(default_factory=bytearray)
    views: list[JsonValue] = field(default_factory=list)
    accessors: list[JsonValue] = field(default_factory=list)
    images: list[JsonValue] = field(default_factory=list)
    materials: list[JsonValue] = field(default_factory=list)
    meshes: list[JsonValue] = field(default_factory=list)
    nodes: list[JsonValue] = field(default_factory=list)

    def add_wall(self, ortho: OrthoFile, offset: NDArray[np.float64], depth: Path | None) -> int:
        """Add mesh, texture and node of a wall; gives the node's number."""
        frame = ortho.frame
        mesh = flat_mesh(frame) if depth is None else relief_mesh(frame, depth)
        attributes: dict[str, JsonValue] = {"POSITION": self._array(mesh.vertices, "VEC3")}
        if depth is None:
            normals = np.array([[0, 0, 1]] * len(mesh.vertices), np.float32)
            attributes["NORMAL"] = self._array(normals, "VEC3")
        attributes["TEXCOORD_0"] = self._array(mesh.places, "VEC2")
        indices = self._array(mesh.triangles.ravel(), "SCALAR")
        material = self._add_material(ortho)
        self.meshes.append(
            {
                "name": ortho.name,
                "primitives": [
                    {"attributes": attributes, "indices": indices, "material": material}
                ],
            }
        )
        placed = np.eye(4)
        placed[:3, :3] = np.column_stack([frame.u_world, -frame.v_world, frame.normal_world])
        placed[:3, 3] = frame.origin_world - offset
        self.nodes.append(
            {
                "name": f"wall_{ortho.wall}",
                "mesh": len(self.meshes) - 1,
                "matrix": _columns(placed),
                "extras": {
                    "name": ortho.name,
                    "origin_world": numbers(frame.origin_world),
                    "gsd_m": frame.gsd_m,
                    "width": frame.width,
                    "height": frame.height,
                    "product_digest": ortho.digest,
                    "surface": "plane" if depth is None else "depths of the wall",
                },
            }
        )
        # The root comes first.
        return len(self.nodes)

    def finished(self, root: dict[str, JsonValue]) -> bytes:
        """Give the file."""
        n_images = len(self.images)
        sampler = {"magFilter": _LINEAR, "minFilter": _TRILINEAR}
        document: dict[str, JsonValue] = {
            "asset": {"version": "2.0", "generator": f"orthoflow {__version__}"},
            "extensionsUsed": ["KHR_materials_unlit"],
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [root, *self.nodes],
            "meshes": self.meshes,
            "materials": self.materials,
            "textures": [{"sampler": 0, "source": k} for k in range(n_images)],
            "images": self.images,
            "samplers": [{**sampler, "wrapS": _CLAMPED, "wrapT": _CLAMPED}],
            "accessors": self.accessors,
            "bufferViews": self.views,
            "buffers": [{"byteLength": len(self.data)}],
        }
        text = json_bytes(document, indent=None)
        text += b" " * (-len(text) % 4)
        head = struct.pack("<III", _MAGIC, 2, 28 + len(text) + len(self.data))
        json_head = struct.pack("<II", len(text), _JSON_CHUNK)
        binary_head = struct.pack("<II", len(self.data), _BINARY_CHUNK)
        return b"".join([head, json_head, text, binary_head, self.data])

    def _add_material(self, ortho: OrthoFile) -> int:
        rgb, shown = ortho.shrunk(LONGEST_TEXTURE_PX)
        is_whole = bool(shown.all())
        encoded = encode_jpeg(rgb) if is_whole else _with_alpha(rgb, shown)
        self.images.append(
            {
                "name": f"wall_{ortho.wall}_ortho",
                "bufferView": self._view(encoded),
                "mimeType": "image/jpeg" if is_whole else "image/png",
            }
        )
        material: dict[str, JsonValue] = {
            "name": ortho.name,
            "pbrMetallicRoughness": {
                "baseColorTexture": {"index": len(self.images) - 1},
                "metallicFactor": 0.0,
                "roughnessFactor": 1.0,
            },
            "extensions": {"KHR_materials_unlit": {}},
        }
        # Colours are those of photographs, which have their light already.
        if not is_whole:
            material |= {"alphaMode": "MASK", "alphaCutoff": 0.5}
        self.materials.append(material)
        return len(self.materials) - 1

    def _array(self, values: NDArray[np.generic], kind: str) -> int:
        is_index = kind == "SCALAR"
        entry: dict[str, JsonValue] = {
            "bufferView": self._view(values.tobytes(), _INDICES if is_index else _VERTICES),
            "componentType": _COMPONENTS[values.dtype.name],
            "count": len(values),
            "type": kind,
        }
        if kind == "VEC3":
            entry |= {"min": numbers(values.min(axis=0)), "max": numbers(values.max(axis=0))}
        self.accessors.append(entry)
        return len(self.accessors) - 1

    def _view(self, content: bytes, target: int | None = None) -> int:
        view: dict[str, JsonValue] = {
            "buffer": 0,
            "byteOffset": len(self.data),
            "byteLength": len(content),
        }
        self.views.append(view if target is None else {**view, "target": target})
        # Each begins at a multiple of four bytes, and so does what follows the last.
        self.data.extend(content + bytes(-len(content) % 4))
        return len(self.views) - 1


def _columns(matrix: NDArray[np.float64]) -> JsonValue:
    """Sixteen numbers column by column, as glTF wants matrices."""
    return numbers(matrix.T.ravel())


def _with_alpha(rgb: NDArray[np.uint8], shown: NDArray[np.bool_]) -> bytes:
    return encode_png(np.dstack([rgb, np.where(shown, np.uint8(255), np.uint8(0))]))
