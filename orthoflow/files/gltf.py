"""Export of a room as binary glTF 2.0: flat or relief walls with orthoimages, in metres, y up."""

from __future__ import annotations

import math
import struct
from base64 import b64encode
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib.resources import files
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import InputError
from orthoflow.files.geotiff import RasterParts
from orthoflow.files.images import encode_jpeg, encode_png
from orthoflow.files.sidecars import OrthoFile, chart_json, numbers, write_bytes
from orthoflow.geometry import Bend, SphereBend, WallFrame
from orthoflow.geometry.frames import basis_from_up
from orthoflow.products import JsonValue
from orthoflow.untrusted_text import json_bytes
from orthoflow.version import __version__

# Largest texture that the GPUs of current phones support.
LONGEST_TEXTURE_PX: Final = 4096
# Browsers can open pages of a few hundred megabytes; base64 adds a third.
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
    """Write the walls; the file and one texture at a time are kept in memory.

    Each wall is a node with a matrix. The vertices are in metres on the wall; the matrix positions
    them relative to `extras.offset_world` of the root, with y as the up direction, so that large
    survey coordinates need not fit into 32-bit vertices. Empty cells are transparent; a wall seen
    from behind is invisible.

    Args:
        path: output file, `.glb`.
        orthos: the orthoimages, at least one.
        up: (3,) unit vector of the world's up direction.
        depths: GeoTIFF of depths by wall number, for walls in relief; other walls are flat.

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
            "meaning": "world = offset_world + position after the matrix of its wall; the matrix "
            "of this node rotates the world's up direction to y",
            "unit": "m",
        },
    }
    write_bytes(path, document.finished(root))


def write_page(path: Path, model: Path) -> None:
    """Write a page that shows a model without a server; a small model is embedded.

    If the model is large or cannot be read, the page asks the user for the file.

    Args:
        path: output file, `.html`.
        model: a file written by `write_room`.

    Raises:
        StoreError: the file cannot be written.
    """
    page = files(__package__).joinpath("room_viewer.html").read_text(encoding="utf-8")
    head, _, tail = page.partition("/*MODEL*/")
    content = b"" if model.stat().st_size > _INSIDE_MOST_BYTES else b64encode(model.read_bytes())
    write_bytes(path, b"".join([head.encode(), content, tail.encode()]))


@dataclass(frozen=True, kw_only=True)
class _Document:
    data: bytearray = field(default_factory=bytearray)
    views: list[JsonValue] = field(default_factory=list)
    accessors: list[JsonValue] = field(default_factory=list)
    images: list[JsonValue] = field(default_factory=list)
    materials: list[JsonValue] = field(default_factory=list)
    meshes: list[JsonValue] = field(default_factory=list)
    nodes: list[JsonValue] = field(default_factory=list)

    def add_wall(self, ortho: OrthoFile, offset: NDArray[np.float64], depth: Path | None) -> int:
        """Add the mesh, texture and node of a wall; return the number of the node."""
        frame = ortho.frame
        mesh = flat_mesh(frame) if depth is None else relief_mesh(frame, depth)
        attributes: dict[str, JsonValue] = {"POSITION": self._array(mesh.vertices, "VEC3")}
        if depth is None:
            normals = _normals(frame, mesh.places)
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
                    "surface": "depths of the wall"
                    if depth is not None
                    else str(chart_json(frame)["chart"]),
                },
            }
        )
        # The number is the index plus one, because node 0 is the root.
        return len(self.nodes)

    def finished(self, root: dict[str, JsonValue]) -> bytes:
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
        alpha = np.where(shown, np.uint8(255), np.uint8(0))
        encoded = encode_jpeg(rgb) if is_whole else encode_png(np.dstack([rgb, alpha]))
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
        # Disable shading, because photos contain the actual lighting.
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
        # Each view must begin, and the data must end, at a multiple of four bytes.
        self.data.extend(content + bytes(-len(content) % 4))
        return len(self.views) - 1


def _columns(matrix: NDArray[np.float64]) -> JsonValue:
    """Return a matrix's sixteen elements column by column, as glTF requires."""
    return numbers(matrix.T.ravel())


# Number of nodes along a wall's longer side: at most about 500,000 triangles, which phones can
# display.
LONGEST_NODES: Final = 512
# Arc of a flat facet of a curved wall; its middle is off by 0.03 % of the radius.
_STRIP_RAD: Final = math.radians(2.9)


@dataclass(frozen=True, kw_only=True)
class WallMesh:
    """Triangles of a wall, relative to the top-left corner of its raster.

    Attributes:
        vertices: (n, 3) float32 metres: x right, y up, z towards the viewer.
        places: (n, 2) float32 texture coordinates of the vertices, from (0, 0) top-left to (1, 1).
        triangles: (m, 3) vertex indices, counterclockwise for the viewer; uint16 or uint32.
    """

    vertices: NDArray[np.float32]
    places: NDArray[np.float32]
    triangles: NDArray[np.uint16 | np.uint32]


def flat_mesh(frame: WallFrame) -> WallMesh:
    """Return the rectangle of a wall, or flat facets of a curved one."""
    if frame.bend is not None:
        return _strips(frame, frame.bend)
    places = np.array([[0, 0], [0, 1], [1, 1], [1, 0]], dtype=np.float32)
    return WallMesh(
        vertices=_lifted(frame, places, np.zeros(4)),
        places=places,
        triangles=np.array([[0, 1, 2], [0, 2, 3]], dtype=np.uint16),
    )


def _strips(frame: WallFrame, bend: Bend) -> WallMesh:
    size_m = frame.size_m
    count = max(2, math.ceil(bend.turn_rad(size_m) / _STRIP_RAD)) + 1
    ribs = bend.ribs_m(size_m, count) / size_m
    n_facets = 1
    if isinstance(bend, SphereBend):
        n_facets = math.ceil(bend.most_m / bend.radius_m / _STRIP_RAD)
    shares = np.linspace(0.0, 1.0, n_facets + 1)[:, None, None]
    nodes = (1.0 - shares) * ribs[:, 0] + shares * ribs[:, 1]
    start = np.arange(nodes.shape[0] * nodes.shape[1]).reshape(nodes.shape[:2])[:-1, :-1].ravel()
    end = start + len(ribs)
    corners = [start, end, end + 1, start + 1]
    if np.linalg.det([bend.revolution.along, bend.revolution.aside]) > 0.0:
        corners.reverse()
    triangles = np.concatenate([np.stack([corners[k] for k in (0, i, i + 1)], 1) for i in (1, 2)])
    places = np.ascontiguousarray(nodes.reshape(-1, 2), dtype=np.float32)
    # Facets at a pole or apex have one triangle; the area of the other one is 0.
    first, second, third = places[triangles.T]
    triangles = triangles[np.abs(np.linalg.det(np.stack([second - first, third - first], 1))) > 0.0]
    return WallMesh(
        vertices=_lifted(frame, places, np.zeros(len(places))),
        places=places,
        triangles=triangles.astype(np.uint16),
    )


def _normals(frame: WallFrame, places: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the normals (n, 3) at positions of a mesh, in its axes."""
    normals = frame.axes_at(places.astype(np.float64) * [frame.width, frame.height])[:, 2]
    axes = np.array([frame.u_world, -frame.v_world, frame.normal_world])
    return np.ascontiguousarray(normals @ axes.T, dtype=np.float32)


def relief_mesh(frame: WallFrame, depth: Path) -> WallMesh:
    """Return the surface of a wall, or its rectangle if no depth is known.

    Nodes are averages of cells, at most `LONGEST_NODES` along a side. Triangles with a node of
    unknown depth are omitted; depth steps become slopes one node wide.

    Args:
        frame: frame of the wall.
        depth: GeoTIFF of the wall's depths in metres, positive towards the viewer.

    Raises:
        InputError: the file cannot be read, or its size differs from the wall's.
    """
    rows, columns = frame.shape
    factor = max(1.0, max(rows, columns) / LONGEST_NODES)
    shape = (max(1, round(rows / factor)), max(1, round(columns / factor)))
    with RasterParts(depth) as raster:
        if raster.shape != frame.shape:
            raise InputError(
                f"{depth} has {raster.shape[1]} x {raster.shape[0]} cells; expected the "
                f"{columns} x {rows} of the orthoimage"
            )
        depths, shown = raster.read((0.0, 0.0, float(columns), float(rows)), shape)
    is_known = (shown & np.isfinite(depths)).ravel()
    node = np.arange(is_known.size, dtype=np.uint32).reshape(shape)
    corners = [
        part.ravel() for part in (node[:-1, :-1], node[1:, :-1], node[1:, 1:], node[:-1, 1:])
    ]
    triangles = np.concatenate([np.stack([corners[k] for k in (0, i, i + 1)], 1) for i in (1, 2)])
    used, triangles = np.unique(triangles[is_known[triangles].all(axis=1)], return_inverse=True)
    if not len(used):
        return flat_mesh(frame)
    down, right = np.meshgrid(*(_places(size) for size in shape), indexing="ij")
    places = np.stack([right.ravel(), down.ravel()], axis=1)[used]
    return WallMesh(
        vertices=_lifted(frame, places, depths.ravel()[used]),
        places=places,
        triangles=triangles.reshape(-1, 3).astype(np.uint32),
    )


def _places(count: int) -> NDArray[np.float32]:
    """Return positions (0 to 1) of nodes along a side: cell centres, and the two ends."""
    places = (np.arange(count) + 0.5) / count
    places[0], places[-1] = 0.0, 1.0
    return places.astype(np.float32)


def _lifted(
    frame: WallFrame, places: NDArray[np.float32], depths_m: NDArray[np.generic]
) -> NDArray[np.float32]:
    if frame.bend is not None:
        near = replace(frame, origin_world=np.zeros(3))
        axes = np.array([frame.u_world, -frame.v_world, frame.normal_world])
        cells = places.astype(np.float64) * [frame.width, frame.height]
        points = near.world_from_wall(cells, depths_m.astype(np.float64))
        return np.ascontiguousarray(points @ axes.T, dtype=np.float32)
    sides_m = np.array([frame.width, -frame.height]) * frame.gsd_m
    return np.column_stack([places * sides_m, depths_m]).astype(np.float32)
