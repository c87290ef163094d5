"""Writers of clouds, block by block: LAZ 1.4, binary PLY with double coordinates, and E57.

LAZ stores the scan number as the point source ID, and plane, deviation, normals and photo number as
extra bytes. E57 has a Data3D with a pose for each scan, and extensions for normals, plane and
deviation. PLY is written without a library, because libraries need all points at once or do not
support custom fields.
"""

from __future__ import annotations

import datetime as dt
import math
import uuid
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.clouds.attributes import BLOCK, AttributedCloud
from orthoflow.files.points.scan_file import load_library
from orthoflow.products import PointCloud
from orthoflow.version import __version__

# Point format of LAS 1.4 with colours.
_POINT_FORMAT: Final = 7
_VERSION: Final = "1.4"
_SCALE_M: Final = 1e-4
_NO_DATE: Final = dt.date(1970, 1, 1)
_LARGEST: Final = 2.0**30
# Field names as in CloudCompare and PDAL.
_LAS_NAMES: Final = {
    **{f"n{axis}": f"Normal{axis.upper()}" for axis in "xyz"},
    "scan": "point_source_id",
}
_EXTRA_BYTES: Final = {
    **dict.fromkeys(("nx", "ny", "nz"), "surface normal, 0 0 0 unknown"),
    "plane": "index of the plane, -1 none",
    "deviation": "m from plane, + towards viewer",
    "photo": "source photo of colour, -1 none",
}


def write_laz(path: Path, attributed: AttributedCloud) -> int:
    """Write the selected points block by block and return their number.

    World coordinates are stored in steps of 0.1 mm relative to the offset in the header.

    Raises:
        PluginError: laspy cannot be imported.
    """
    laspy = load_library("laspy", path)
    header = las_header(laspy, attributed)
    n_written = 0
    with laspy.open(path, mode="w", header=header) as writer:
        for points in attributed.blocks():
            writer.write_points(las_record(laspy, header, points))
            n_written += len(points)
    return n_written


# Any: laspy has no types.
def las_record(laspy: Any, header: Any, points: NDArray[np.void]) -> Any:
    """Return points as a laspy record for a header."""
    record = laspy.ScaleAwarePointRecord.zeros(len(points), header=header)
    for name in points.dtype.names or ():
        values = points[name]
        if name in ("red", "green", "blue"):
            # LAS colours have 16 bits.
            values = 257 * values.astype(np.uint16)
        elif name == "intensity":
            values = np.rint(65535.0 * values).astype(np.uint16)
        record[_LAS_NAMES.get(name, name)] = values
    record.return_number[:] = 1
    record.number_of_returns[:] = 1
    return record


def las_header(laspy: Any, attributed: AttributedCloud) -> Any:
    """Return the header of a cloud, without points."""
    cloud = attributed.cloud
    header = laspy.LasHeader(point_format=_POINT_FORMAT, version=_VERSION)
    columns = attributed.columns
    header.add_extra_dims(
        [
            laspy.ExtraBytesParams(
                name=_LAS_NAMES.get(name, name), type=columns[name].type, description=text
            )
            for name, text in _EXTRA_BYTES.items()
            if name in (columns.names or ())
        ]
    )
    header.scales = np.full(3, _scale_m(cloud))
    header.offsets = np.floor(cloud.origin)
    # LAS 1.4 requires this bit for the point format, even if the coordinate system is unknown.
    header.global_encoding.wkt = True
    if attributed.crs_wkt:
        header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(attributed.crs_wkt))
    # The date is fixed, so that identical clouds give identical bytes.
    header.creation_date = _NO_DATE
    header.generating_software = "orthoflow"
    return header


def _scale_m(cloud: PointCloud) -> float:
    spans = [float(max(abs(v.min()), abs(v.max()))) for v in (cloud.x, cloud.y, cloud.z) if len(v)]
    coarsest = max(spans, default=0.0) / _LARGEST
    # With this scale, 32 bits cover two hundred kilometres.
    return _SCALE_M if coarsest <= _SCALE_M else 10.0 ** math.ceil(math.log10(coarsest))


_TYPES: Final = {"f8": "double", "f4": "float", "u1": "uchar", "u2": "ushort", "i2": "short"}
# Width reserved for the point count, which is overwritten once it is known.
_DIGITS: Final = 12


def write_ply(path: Path, attributed: AttributedCloud) -> int:
    """Write the selected points block by block and return their number.

    Raises:
        OSError: the file cannot be written.
    """
    head = [
        *("ply", "format binary_little_endian 1.0", "comment orthoflow, metres"),
        f"comment coordinate system {' '.join(attributed.crs_wkt.split()) or 'unknown'}",
        f"element vertex {0:0{_DIGITS}d}",
    ]
    columns = attributed.columns
    properties = [f"property {_TYPES[columns[k].str[1:]]} {k}" for k in columns.names or ()]
    n_written = 0
    with path.open("wb") as stream:
        count_at = stream.write("\n".join(head).encode()) - _DIGITS
        stream.write("\n".join(["", *properties, "end_header", ""]).encode())
        for points in attributed.blocks():
            stream.write(points.tobytes())
            n_written += len(points)
        stream.seek(count_at)
        stream.write(f"{n_written:0{_DIGITS}d}".encode())
    return n_written


# Prefix and URI of the extensions.
EXTENSIONS: Final = {
    "nor": "http://www.libe57.org/E57_NOR_surface_normals.txt",
    "orthoflow": "urn:orthoflow:points:1",
}
_COLOURS: Final = ("colorRed", "colorGreen", "colorBlue")
_STATE: Final = "cartesianInvalidState"
# The scan number is not a field, since each scan has its own Data3D.
_E57_NAMES: Final = {
    **{axis: f"cartesian{axis.upper()}" for axis in "xyz"},
    **dict(zip(("red", "green", "blue"), _COLOURS, strict=True)),
    **{f"n{axis}": f"nor:normal{axis.upper()}" for axis in "xyz"},
    "intensity": "intensity",
    **{name: f"orthoflow:{name}" for name in ("plane", "deviation", "photo")},
}


@dataclass(frozen=True, kw_only=True)
class _Writer:
    # Any: libE57 has no types.
    libe57: Any
    image: Any

    def group(self, **numbers: float) -> Any:
        node = self.libe57.StructureNode(self.image)
        for name, value in numbers.items():
            kind = self.libe57.IntegerNode if isinstance(value, int) else self.libe57.FloatNode
            node.set(name, kind(self.image, value))
        return node

    def text(self, value: str) -> Any:
        return self.libe57.StringNode(self.image, value)


def write_e57(path: Path, attributed: AttributedCloud) -> int:
    """Write the selected points scan by scan, block by block, and return their number.

    The pose of a scan has the axes of the world, because the cloud does not contain the rotation of
    the instrument. Its position is the station or, if that is unknown, the cloud's origin. Points
    are relative to the pose, so survey coordinates keep all digits.

    Raises:
        PluginError: pye57 cannot be imported.
    """
    libe57 = load_library("pye57", path).libe57
    writer = _Writer(libe57=libe57, image=libe57.ImageFile(str(path), "w"))
    try:
        scans = _write_head(writer, attributed)
        return sum(_write_scan(writer, scans, attributed, scan) for scan in attributed.scans)
    finally:
        writer.image.close()


def _write_head(writer: _Writer, attributed: AttributedCloud) -> Any:
    libe57, image = writer.libe57, writer.image
    for prefix, uri in {"": libe57.E57_V1_0_URI, **EXTENSIONS}.items():
        image.extensionsAdd(prefix, uri)
    root = image.root()
    unique = uuid.uuid5(uuid.NAMESPACE_URL, f"urn:orthoflow:{attributed.name}")
    for name, text in (
        ("formatName", "ASTM E57 3D Imaging Data File"),
        ("guid", f"{{{unique}}}"),
        ("e57LibraryVersion", libe57.E57_LIBRARY_ID),
        ("coordinateMetadata", attributed.crs_wkt),
    ):
        root.set(name, writer.text(text))
    root.set("versionMajor", libe57.IntegerNode(image, libe57.E57_FORMAT_MAJOR))
    root.set("versionMinor", libe57.IntegerNode(image, libe57.E57_FORMAT_MINOR))
    root.set("creationDateTime", writer.group(dateTimeValue=0.0, isAtomicClockReferenced=0))
    scans = libe57.VectorNode(image, allowHeteroChildren=True)
    root.set("data3D", scans)
    root.set("images2D", libe57.VectorNode(image, allowHeteroChildren=True))
    return scans


def _write_scan(writer: _Writer, scans: Any, attributed: AttributedCloud, scan: int) -> int:
    station = attributed.station(scan)
    centre = attributed.cloud.origin if station is None else station
    limits = attributed.bounds_world(scan)
    if limits is None:
        return 0
    low, high = limits - centre
    node = writer.libe57.StructureNode(writer.image)
    name = f"scan {scan}" if station is not None else f"scan {scan}, station unknown"
    # The same cloud always gets the same id.
    unique = uuid.uuid5(uuid.NAMESPACE_URL, f"urn:orthoflow:{attributed.name}:{scan}")
    node.set("guid", writer.text(f"{{{unique}}}"))
    node.set("name", writer.text(name))
    node.set("description", writer.text(f"orthoflow {__version__}"))
    # Bounds of the points as stored in the file.
    corners = zip("xyz", low, high, strict=True)
    bounds = {f"{axis}{end}": float(v) for axis, a, b in corners for end, v in _ends(a, b)}
    node.set("cartesianBounds", writer.group(**bounds))
    colours = {f"{name}{end}": v for name in _COLOURS for end, v in _ends(0, 255)}
    node.set("colorLimits", writer.group(**colours))
    if attributed.cloud.intensity is not None:
        node.set("intensityLimits", writer.group(intensityMinimum=0.0, intensityMaximum=1.0))
    pose = writer.libe57.StructureNode(writer.image)
    pose.set("rotation", writer.group(w=1.0, x=0.0, y=0.0, z=0.0))
    place = dict(zip("xyz", map(float, centre), strict=True))
    pose.set("translation", writer.group(**place))
    node.set("pose", pose)
    return _write_points(writer, scans, node, attributed, (scan, centre))


def _write_points(
    writer: _Writer,
    scans: Any,
    node: Any,
    attributed: AttributedCloud,
    placed: tuple[int, NDArray[np.float64]],
) -> int:
    scan, centre = placed
    libe57, image, columns = writer.libe57, writer.image, attributed.columns
    names = {name: _E57_NAMES[name] for name in columns.names or () if name in _E57_NAMES}
    # Readers require a validity field, although all points are valid.
    kept = {_STATE: np.zeros(BLOCK, dtype=np.int8)} | {
        own: np.zeros(BLOCK, dtype=columns[name].type) for name, own in names.items()
    }
    prototype = libe57.StructureNode(image)
    buffers = libe57.VectorSourceDestBuffer()
    for name, values in kept.items():
        prototype.set(name, _field(libe57, image, name, values.dtype))
        buffers.append(
            libe57.SourceDestBuffer(image, name, values, BLOCK, doConversion=True, doScaling=True)
        )
    points = libe57.CompressedVectorNode(
        image, prototype, libe57.VectorNode(image, allowHeteroChildren=True)
    )
    node.set("points", points)
    scans.append(node)
    stream = points.writer(buffers)
    offsets = dict(zip("xyz", centre.tolist(), strict=True))
    n_written = 0
    for block in attributed.blocks(scan):
        for name, own in names.items():
            kept[own][: len(block)] = block[name] - offsets.get(name, 0)
        stream.write(len(block))
        n_written += len(block)
    stream.close()
    return n_written


def _field(libe57: Any, image: Any, name: str, kind: np.dtype[Any]) -> Any:
    if name in _COLOURS:
        return libe57.IntegerNode(image, 0, 0, 255)
    if name == _STATE:
        return libe57.IntegerNode(image, 0, 0, 2)
    if kind.kind == "i":
        return libe57.IntegerNode(image, 0, -(1 << 15), (1 << 15) - 1)
    if name == "intensity":
        return libe57.FloatNode(image, 0.0, libe57.E57_SINGLE, 0.0, 1.0)
    precision = libe57.E57_DOUBLE if kind == np.float64 else libe57.E57_SINGLE
    return libe57.FloatNode(image, 0.0, precision)


def _ends(low: float, high: float) -> tuple[tuple[str, float], tuple[str, float]]:
    return ("Minimum", low), ("Maximum", high)
