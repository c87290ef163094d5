"""A cloud as E57: a Data3D per scan with its pose; normals, plane and deviation as extensions."""

from __future__ import annotations

import uuid
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.clouds.dressing import BLOCK, DressedCloud, Points
from orthoflow.files.points.scan_file import load_library
from orthoflow.version import __version__

# Prefix -> URI of the extensions of the format.
EXTENSIONS: Final = {
    "nor": "http://www.libe57.org/E57_NOR_surface_normals.txt",
    "orthoflow": "urn:orthoflow:points:1",
}
_AXES: Final = ("cartesianX", "cartesianY", "cartesianZ")
_COLOURS: Final = ("colorRed", "colorGreen", "colorBlue")
_STATE: Final = "cartesianInvalidState"
_NORMALS: Final = ("nor:normalX", "nor:normalY", "nor:normalZ")


@dataclass(frozen=True, kw_only=True)
class _Writer:
    """An E57 file under construction."""

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


def write_e57(path: Path, dressed: DressedCloud) -> int:
    """Write the selected points, scan by scan and piece by piece; return their number.

    A scan with a known station has it as its pose, and points relative to it, along the axes of the
    world, because the cloud does not keep the rotation of the instrument. Others have the cloud's
    origin as pose, so that survey coordinates keep their digits.

    Raises:
        PluginError: pye57 does not load.
    """
    libe57 = load_library("pye57", path).libe57
    writer = _Writer(libe57=libe57, image=libe57.ImageFile(str(path), "w"))
    try:
        scans = _write_head(writer, dressed)
        return sum(_write_scan(writer, scans, dressed, scan) for scan in dressed.scans)
    finally:
        writer.image.close()


def _write_head(writer: _Writer, dressed: DressedCloud) -> Any:
    """Write what precedes the scans, independent of the date; return the list of scans."""
    libe57, image = writer.libe57, writer.image
    for prefix, uri in {"": libe57.E57_V1_0_URI, **EXTENSIONS}.items():
        image.extensionsAdd(prefix, uri)
    root = image.root()
    unique = uuid.uuid5(uuid.NAMESPACE_URL, f"urn:orthoflow:{dressed.name}")
    for name, text in (
        ("formatName", "ASTM E57 3D Imaging Data File"),
        ("guid", f"{{{unique}}}"),
        ("e57LibraryVersion", libe57.E57_LIBRARY_ID),
        ("coordinateMetadata", dressed.crs_wkt),
    ):
        root.set(name, writer.text(text))
    root.set("versionMajor", libe57.IntegerNode(image, libe57.E57_FORMAT_MAJOR))
    root.set("versionMinor", libe57.IntegerNode(image, libe57.E57_FORMAT_MINOR))
    root.set("creationDateTime", writer.group(dateTimeValue=0.0, isAtomicClockReferenced=0))
    scans = libe57.VectorNode(image, allowHeteroChildren=True)
    root.set("data3D", scans)
    root.set("images2D", libe57.VectorNode(image, allowHeteroChildren=True))
    return scans


def _write_scan(writer: _Writer, scans: Any, dressed: DressedCloud, scan: int) -> int:
    station = dressed.station(scan)
    centre = dressed.cloud.origin if station is None else station
    limits = dressed.bounds_world(scan)
    if limits is None:
        return 0
    low, high = limits - centre
    node = writer.libe57.StructureNode(writer.image)
    name = f"scan {scan}" if station is not None else f"scan {scan}, station not known"
    # The same cloud gets the same name.
    unique = uuid.uuid5(uuid.NAMESPACE_URL, f"urn:orthoflow:{dressed.name}:{scan}")
    node.set("guid", writer.text(f"{{{unique}}}"))
    node.set("name", writer.text(name))
    node.set("description", writer.text(f"orthoflow {__version__}"))
    # Of the points as stored in the file.
    corners = zip("xyz", low, high, strict=True)
    bounds = {f"{axis}{end}": float(v) for axis, a, b in corners for end, v in _ends(a, b)}
    node.set("cartesianBounds", writer.group(**bounds))
    colours = {f"{name}{end}": v for name in _COLOURS for end, v in _ends(0, 255)}
    node.set("colorLimits", writer.group(**colours))
    if dressed.cloud.intensity is not None:
        node.set("intensityLimits", writer.group(intensityMinimum=0.0, intensityMaximum=1.0))
    pose = writer.libe57.StructureNode(writer.image)
    pose.set("rotation", writer.group(w=1.0, x=0.0, y=0.0, z=0.0))
    place = dict(zip("xyz", map(float, centre), strict=True))
    pose.set("translation", writer.group(**place))
    node.set("pose", pose)
    return _write_points(writer, scans, node, dressed, (scan, centre))


def _write_points(
    writer: _Writer,
    scans: Any,
    node: Any,
    dressed: DressedCloud,
    placed: tuple[int, NDArray[np.float64]],
) -> int:
    scan, centre = placed
    libe57, image = writer.libe57, writer.image
    arrays = _columns(next(dressed.blocks(scan)), centre)
    prototype = libe57.StructureNode(image)
    buffers = libe57.VectorSourceDestBuffer()
    kept = {name: np.zeros(BLOCK, dtype=values.dtype.type) for name, values in arrays.items()}
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
    n_written = 0
    for block in dressed.blocks(scan):
        for name, values in _columns(block, centre).items():
            kept[name][: len(block)] = values
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
    if name in _AXES:
        return libe57.FloatNode(image, 0.0, libe57.E57_DOUBLE)
    return libe57.FloatNode(image, 0.0, libe57.E57_SINGLE)


def _columns(points: Points, centre: NDArray[np.float64]) -> dict[str, NDArray[Any]]:
    """Return fields of points in types that pye57 accepts."""
    # The Data3D states the scan.
    fields = {name: values for name, values in points.fields().items() if name != "scan"}
    own = {"plane", "deviation", "photo"}
    return {
        # Readers require it, though all are valid.
        _STATE: np.zeros(len(points), dtype=np.int8),
        **dict(zip(_AXES, (points.world - centre).T, strict=True)),
        **dict(zip(_COLOURS, points.rgb.T, strict=True)),
        **dict(zip(_NORMALS, points.normal.T, strict=True)),
        **{f"orthoflow:{name}" if name in own else name: fields[name] for name in fields},
    }


def _ends(low: float, high: float) -> tuple[tuple[str, float], tuple[str, float]]:
    return ("Minimum", low), ("Maximum", high)
