"""Small point files of every format, written by the simplest means, for tests of the readers."""

from __future__ import annotations

import struct
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.points import PointBlock, open_scan
from orthoflow.files.points.fields import Columns


def read_all(path: Path, columns: Columns | None = None) -> list[PointBlock]:
    """All blocks of a point file."""
    return list(open_scan(path, columns).read())


def read_points(path: Path, columns: Columns | None = None) -> NDArray[np.float64]:
    """All points of a point file."""
    return np.concatenate([block.points for block in read_all(path, columns)])


# Any: arrays of every kind.
def write_las(
    path: Path,
    points: NDArray[np.float64],
    *,
    rgb: NDArray[Any] | None = None,
    scale: float = 0.0001,
    offset: NDArray[np.float64] | None = None,
    version: str = "1.4",
    vlrs: Sequence[tuple[str, int, bytes]] = (),
    evlrs: Sequence[tuple[str, int, bytes]] = (),
    extra: Mapping[str, NDArray[Any]] | None = None,
    **fields: Any,
) -> Path:
    """Write points with fields of the format, extra ones, and records (user, number, content).

    The records `evlrs` come after the points, which only version 1.4 allows.
    """
    import laspy

    point_format = (7 if rgb is not None else 6) if version == "1.4" else 2
    header = laspy.LasHeader(point_format=point_format, version=version)
    header.offsets = np.floor(points.min(axis=0)) if offset is None else offset
    header.scales = np.full(3, scale)
    for name, values in (extra or {}).items():
        header.add_extra_dim(laspy.ExtraBytesParams(name=name, type=values.dtype))
    header.vlrs.extend(laspy.VLR(user, number, "", content) for user, number, content in vlrs)
    las = laspy.LasData(header)
    las.x, las.y, las.z = points.T
    if rgb is not None:
        las.red, las.green, las.blue = rgb.astype(np.uint16).T
    for name, values in {**fields, **(extra or {})}.items():
        if values is not None:
            las[name] = np.rint(values).astype(np.uint16) if name == "intensity" else values
    if evlrs:
        las.evlrs = laspy.vlrs.vlrlist.VLRList([laspy.VLR(u, n, "", c) for u, n, c in evlrs])
    las.write(path)
    return path


def write_copc(path: Path, levels: Sequence[Mapping[tuple[int, int, int], Any]]) -> Path:
    """Write points (n, 3) in a cube of side 8 from the origin on, by level and place of their node.

    Points of the root are half a metre apart, it says. The nodes of each level below the first
    stand in a page of the hierarchy of their own.
    """
    import laspy
    import lazrs

    header = laspy.LasHeader(point_format=6, version="1.4")
    header.offsets, header.scales = np.zeros(3), np.full(3, 1e-4)
    packed = lazrs.LazVlr.new_for_compression(6, 0, True)
    info = laspy.VLR("copc", 1, "", bytes(160))
    header.vlrs.extend([info, laspy.vlrs.known.LasZipVlr(packed.record_data())])
    header.are_points_compressed = True
    keys = [(level, *place) for level, nodes in enumerate(levels) for place in nodes]
    with path.open("w+b") as file:
        header.write_to(file)
        compressor = lazrs.LasZipCompressor(file, packed)
        for level, *place in keys:
            points = np.asarray(levels[level][tuple(place)])
            record = laspy.ScaleAwarePointRecord.zeros(len(points), header=header)
            record.x, record.y, record.z = points.T
            if header.point_count:
                # Also after the last one, it would begin another.
                compressor.finish_current_chunk()
            header.grow(record)
            compressor.compress_many(np.frombuffer(record.array, np.uint8))
        compressor.done()
        file.seek(header.offset_to_point_data)
        chunks = lazrs.read_chunk_table(file, packed)
        at, pages = header.offset_to_point_data + 8, [b""] * len(levels)
        for key, (count, size) in zip(keys, chunks, strict=False):
            pages[key[0]] += struct.pack("<4iQii", *key, at, size, count)
            at += size
        header.start_of_first_evlr, header.number_of_evlrs = file.seek(0, 2), 1
        start = file.tell() + 60
        n_root = len(pages[0]) + 32 * (len(levels) - 1)
        at = start + n_root
        for level, page in enumerate(pages[1:], start=1):
            pages[0] += struct.pack("<4iQii", level, 0, 0, 0, at, len(page), -1)
            at += len(page)
        tree = laspy.VLR("copc", 1000, "", b"".join(pages))
        laspy.vlrs.vlrlist.VLRList([tree]).write_to(file, as_extended=True)
        info.record_data = struct.pack("<5d2Q", 4.0, 4.0, 4.0, 4.0, 0.5, start, n_root)
        info.record_data += bytes(160 - len(info.record_data))
        file.seek(0)
        header.write_to(file, ensure_same_size=True)
    return path


# Any: arrays of every kind.
def cartesian(points: NDArray[np.float64], **more: Any) -> dict[str, Any]:
    """Fields of points of an E57 scan."""
    names = ("cartesianX", "cartesianY", "cartesianZ")
    return {**dict(zip(names, points.T, strict=True)), **more}


def write_e57(
    path: Path,
    scans: Sequence[Mapping[str, Any]],
    images: Sequence[Mapping[str, Any]] = (),
    *,
    coordinate_metadata: str = "",
) -> Path:
    """Write scans, each with `fields` (name -> values) and optional `rotation` and `translation`.

    Optional `intensity_limits` and `rgb_limit` go into the header. Images have a `kind`, a
    `content`, optional `numbers` of their representation, a `name` and a pose as scans have it.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import pye57
        from pye57 import libe57

    class File(pye57.E57):
        def write_default_header(self) -> None:
            """As pye57 does, which leaves the metadata empty and can set them but once."""
            image, root = self.image_file, self.root
            image.extensionsAdd("", libe57.E57_V1_0_URI)
            texts = {"formatName": "ASTM E57 3D Imaging Data File", "guid": "{file}"}
            texts["coordinateMetadata"] = coordinate_metadata
            for name, text in texts.items():
                root.set(name, libe57.StringNode(image, text))
            for name, number in {"versionMajor": 1, "versionMinor": 0}.items():
                root.set(name, libe57.IntegerNode(image, number))
            for name in ("data3D", "images2D"):
                root.set(name, libe57.VectorNode(image, True))

    with File(str(path), mode="w") as file:
        image = file.image_file
        for index, scan in enumerate(scans):
            node = libe57.StructureNode(image)
            node.set("guid", libe57.StringNode(image, f"{{scan-{index}}}"))
            _set_pose(libe57, image, node, scan)
            _set_limits(libe57, image, node, scan)
            _set_points(libe57, file, node, scan["fields"])
        for picture in images:
            _add_image(libe57, image, picture)
    return path


def _add_image(libe57: Any, image: Any, picture: Mapping[str, Any]) -> None:
    root = image.root()
    if not root.isDefined("images2D"):
        root.set("images2D", libe57.VectorNode(image, True))
    node, shown = libe57.StructureNode(image), libe57.StructureNode(image)
    root["images2D"].append(node)
    if "name" in picture:
        node.set("name", libe57.StringNode(image, picture["name"]))
    _set_pose(libe57, image, node, picture)
    node.set(f"{picture['kind']}Representation", shown)
    for name, value in picture.get("numbers", {}).items():
        is_count = name in ("imageWidth", "imageHeight")
        node_of, number = (libe57.IntegerNode, int) if is_count else (libe57.FloatNode, float)
        shown.set(name, node_of(image, number(value)))
    content = picture["content"]
    blob = libe57.BlobNode(image, len(content))
    shown.set("jpegImage" if content.startswith(b"\xff\xd8") else "pngImage", blob)
    blob.write(bytearray(content), 0, len(content))


def _set_pose(libe57: Any, image: Any, node: Any, scan: Mapping[str, Any]) -> None:
    if "translation" not in scan:
        return
    pose = libe57.StructureNode(image)
    node.set("pose", pose)
    for name, letters in (("rotation", "wxyz"), ("translation", "xyz")):
        part = libe57.StructureNode(image)
        # Reversed: the order in the file must not matter.
        for letter, value in reversed(list(zip(letters, scan[name], strict=True))):
            part.set(letter, libe57.FloatNode(image, float(value)))
        pose.set(name, part)


def _set_limits(libe57: Any, image: Any, node: Any, scan: Mapping[str, Any]) -> None:
    if "intensity_limits" in scan:
        limits = libe57.StructureNode(image)
        low, high = scan["intensity_limits"]
        limits.set("intensityMinimum", libe57.FloatNode(image, low))
        limits.set("intensityMaximum", libe57.FloatNode(image, high))
        node.set("intensityLimits", limits)
    if "rgb_limit" in scan:
        limits = libe57.StructureNode(image)
        for name in ("colorRed", "colorGreen", "colorBlue"):
            limits.set(f"{name}Minimum", libe57.IntegerNode(image, 0))
            limits.set(f"{name}Maximum", libe57.IntegerNode(image, scan["rgb_limit"]))
        node.set("colorLimits", limits)


def _set_points(libe57: Any, file: Any, node: Any, fields: Mapping[str, Any]) -> None:
    image = file.image_file
    count = len(next(iter(fields.values())))
    prototype = libe57.StructureNode(image)
    buffers = libe57.VectorSourceDestBuffer()
    kept = []
    for name, values in fields.items():
        array = np.ascontiguousarray(values, dtype=np.float64)
        kept.append(array)
        is_number = name.startswith(("cartesian", "spherical", "intensity"))
        if name.startswith("cartesian") and name[-1] in "XYZ" and np.isfinite(array).all():
            # Scaled integers, as most scanners write them.
            raw = libe57.ScaledIntegerNode(image, 0, -(2**44), 2**44, 1e-6, 0.0)
        elif is_number and not name.endswith("State"):
            limits = (-1e9, 1e9) if np.isfinite(array).all() else ()
            raw = libe57.FloatNode(image, 0.0, libe57.E57_DOUBLE, *limits)
        else:
            raw = libe57.IntegerNode(image, 0, 0, 2**20)
        prototype.set(name, raw)
        buffers.append(libe57.SourceDestBuffer(image, name, array, max(count, 1), True, True))
    points = libe57.CompressedVectorNode(image, prototype, libe57.VectorNode(image, True))
    node.set("points", points)
    file.data3d.append(node)
    writer = points.writer(buffers)
    if count:
        writer.write(count)
    writer.close()


def write_ply(
    path: Path,
    fields: Mapping[str, NDArray[np.generic]],
    *,
    encoding: str = "binary_little_endian",
    before: str = "",
    before_data: bytes = b"",
) -> Path:
    """Write vertices and a face; `before` are header lines of elements that come before them."""
    from plyfile import PlyElement

    kinds = [(name, array.dtype.str[1:]) for name, array in fields.items()]
    table = np.array(list(zip(*fields.values(), strict=True)), dtype=kinds)
    faces = np.array([([0, 1, 2],)], dtype=[("vertex_indices", "i4", (3,))])
    elements = [PlyElement.describe(table, "vertex"), PlyElement.describe(faces, "face")]
    write_elements(path, elements, encoding, ["made by hand"])
    if before:
        head, end, data = path.read_bytes().partition(b"end_header\n")
        head = head.replace(b"element vertex", before.encode() + b"\nelement vertex")
        path.write_bytes(head + end + before_data + data)
    return path


def write_elements(
    path: Path, elements: Sequence[Any], encoding: str, comments: Sequence[str]
) -> None:
    """Write elements of plyfile."""
    from plyfile import PlyData

    order = "<" if "little" in encoding else ">"
    PlyData(elements, encoding == "ascii", order, comments=comments).write(str(path))


def write_pcd(
    path: Path,
    fields: Mapping[str, NDArray[np.generic]],
    *,
    data: str = "binary",
    width: int | None = None,
    viewpoint: str = "0 0 0 1 0 0 0",
) -> Path:
    count = len(next(iter(fields.values())))
    arrays = list(fields.values())
    kinds = {"f": "F", "u": "U", "i": "I"}
    columns = width or count
    lines = {
        "VERSION": "0.7",
        "FIELDS": " ".join(fields),
        "SIZE": " ".join(str(array.dtype.itemsize) for array in arrays),
        "TYPE": " ".join(kinds[array.dtype.kind] for array in arrays),
        "COUNT": " ".join("1" for _ in arrays),
        "WIDTH": columns,
        "HEIGHT": count // columns,
        "VIEWPOINT": viewpoint,
        "POINTS": count,
        "DATA": data,
    }
    header = "# .PCD v0.7 - Point Cloud Data file format\n"
    header += "".join(f"{key} {value}\n" for key, value in lines.items())
    if data == "ascii":
        rows = [" ".join(repr(item.item()) for item in row) for row in zip(*arrays, strict=True)]
        path.write_text(header + "\n".join([*rows, ""]))
    elif data == "binary":
        path.write_bytes(header.encode() + np.rec.fromarrays(arrays, names=[*fields]).tobytes())
    else:
        plain = b"".join(array.tobytes() for array in arrays)
        # LZF of literals only: their number less one before up to 32 of them.
        parts = [plain[at : at + 32] for at in range(0, len(plain), 32)]
        packed = b"".join(bytes([len(part) - 1]) + part for part in parts)
        path.write_bytes(header.encode() + struct.pack("<II", len(packed), len(plain)) + packed)
    return path


def write_ptx(
    path: Path, scans: Sequence[tuple[NDArray[np.float64], int, NDArray[np.float64]]]
) -> Path:
    """Write scans: table of point lines (column by column), rows per column, world_from_scan."""
    lines: list[str] = []
    for table, n_rows, matrix in scans:
        lines += [str(len(table) // n_rows), str(n_rows)]
        lines += [" ".join(map(repr, matrix[:3, 3].tolist()))]
        lines += [" ".join(map(repr, matrix[:3, axis].tolist())) for axis in range(3)]
        lines += [" ".join(map(repr, row)) for row in matrix.T.tolist()]
        lines += [" ".join(f"{value:.10g}" for value in row) for row in table]
    path.write_text("\n".join([*lines, ""]))
    return path
