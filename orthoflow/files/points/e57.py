"""E57 through libE57's block buffers: several scans with their poses, cartesian or spherical.

Its XML is checked first, with limits and for elements only: libE57 compares each child of a
structure with all previous ones, so that 60,000 take over 50 s. It currently refuses entities as
bad XML; that the files which they name are not read must not depend on its version. The standard
(ASTM E2807) does not need any of that.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final
from xml.parsers.expat import ExpatError, ParserCreate

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import InputError
from orthoflow.files.points.blocks import (
    BLOCK_POINTS,
    PointBlock,
    PointField,
    Scan,
    ScanFile,
    short_file_error,
)
from orthoflow.files.points.fields import columns_of_names, point_block
from orthoflow.files.points.libraries import load_library, reading
from orthoflow.files.points.units import (
    StatedUnit,
    unit_of_comments,
    unit_of_crs,
    unit_of_name,
)

FORMAT: Final = "E57"

_CARTESIAN: Final = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL: Final = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
_COLOURS: Final = ("colorRed", "colorGreen", "colorBlue")
_GRID: Final = ("rowIndex", "columnIndex")
# Non-zero if the value is invalid.
_STATES: Final = (
    "cartesianInvalidState",
    "sphericalInvalidState",
    "isIntensityInvalid",
    "isColorInvalid",
)
# Scans of large buildings, a thousand scans with pictures, have a few million bytes.
#: bytes of the XML of an E57 file
MOST_XML_BYTES: Final = 1 << 25
#: elements of the XML of an E57 file
MOST_XML_ELEMENTS: Final = 200_000
#: levels of elements in the XML of an E57 file
DEEPEST_XML: Final = 64
# For a structure; vectors, as of scans and pictures, may have any number.
#: elements of a structure in the XML of an E57 file; vectors may have more
MOST_XML_CHILDREN: Final = 500
# E57 3.3: pages of 1024 bytes, the last four of each a checksum.
_PAGE: Final = 1024
_PAYLOAD: Final = 1020
_HEADER: Final = struct.Struct("<8sIIQQQQ")
_ENCODING: Final = re.compile(rb"<\?xml[^>]*encoding\s*=\s*[\"']([^\"']*)", re.IGNORECASE)


@dataclass(frozen=True, kw_only=True)
class ScanHeader:
    """The required parts of one Data3D entry.

    Attributes:
        index: position in the file's data3D.
        n_points: stated number of points, including invalid ones.
        names: fields of each point.
        intensity: name of the field that is the intensity, or None.
        rotation: (3, 3) world from scan.
        translation: (3,) position of the scanner in the file's world.
        scan: its own statements.
    """

    index: int
    n_points: int
    names: frozenset[str]
    intensity: str | None
    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]
    scan: Scan

    @property
    def axes(self) -> tuple[str, ...]:
        """Names of the three coordinates."""
        return _CARTESIAN if self.names.issuperset(_CARTESIAN) else _SPHERICAL

    @property
    def invalid_state(self) -> str:
        """Name of the field that is non-zero for points without a position."""
        return "cartesianInvalidState" if self.axes is _CARTESIAN else "sphericalInvalidState"


def open_e57(path: Path, *, intensity_field: str | None = None) -> ScanFile:
    """Open an E57 file; every scan with points is read, in the order of the file."""
    check_xml(path)
    pye57 = load_library("pye57", path)
    with reading(path, FORMAT), pye57.E57(str(path)) as file:
        unit = _unit(file.image_file.root())
        headers = [
            _read_header(path, file, index, intensity_field, unit)
            for index in range(file.scan_count)
            if file.data3d[index].isDefined("points")
        ]
    headers = [header for header in headers if header.n_points > 0]
    return ScanFile(
        name=path.name,
        format_name=FORMAT,
        n_most=sum(header.n_points for header in headers),
        scans=[header.scan for header in headers],
        read=lambda: _blocks(path, pye57, headers),
    )


def _unit(root: Any) -> StatedUnit:
    """Metres, as in the standard, unless the coordinate metadata state another unit."""
    metres = unit_of_name("m", "the E57 standard")
    if not root.isDefined("coordinateMetadata"):
        return metres
    text = str(root["coordinateMetadata"].value())
    found = unit_of_crs(text, "coordinate metadata")
    return found or unit_of_comments([text], "coordinate metadata") or metres


def _read_header(
    path: Path, file: Any, index: int, intensity_field: str | None, unit: StatedUnit
) -> ScanHeader:
    node = file.data3d[index]
    points = node["points"]
    names = tuple(str(name) for name in file.get_header(index).point_fields)
    axes = next((axes for axes in (_CARTESIAN, _SPHERICAL) if set(names) >= set(axes)), None)
    if axes is None:
        raise InputError(
            f"{path.name}: scan {index} has the fields {', '.join(sorted(names))}, expected "
            "cartesianX, Y, Z or sphericalRange, Azimuth, Elevation"
        )
    renamed = [dict(zip(axes, _CARTESIAN, strict=True)).get(name, name) for name in names]
    columns = columns_of_names(renamed, intensity_field=intensity_field)
    intensity = None
    if columns is not None and "intensity" in columns.names:
        intensity = names[columns.names.index("intensity")]
    fields: list[PointField] = [] if intensity is None else ["intensity"]
    fields += ["rgb"] if set(names) >= set(_COLOURS) else []
    fields += ["grid"] if set(names) >= set(_GRID) else []
    used = {*axes, intensity, *_STATES} | {
        name for name in (*_COLOURS, *_GRID) if ("rgb" if name in _COLOURS else "grid") in fields
    }
    rotation, translation = pose_of(node)
    is_posed = not (np.allclose(rotation, np.eye(3), atol=1e-12) and not translation.any())
    scan = Scan(
        name=str(node["name"].value()) if node.isDefined("name") else "",
        fields=frozenset(fields),
        fields_used=tuple(name for name in names if name in used),
        fields_not_used=tuple(name for name in names if name not in used),
        intensity_limits=_limits(node, "intensityLimits", "intensityMinimum", "intensityMaximum")
        if intensity == "intensity"
        else None,
        rgb_limit=_rgb_limit(node),
        unit=unit,
        station=translation,
        station_is_posed=is_posed,
    )
    return ScanHeader(
        index=index,
        n_points=int(points.childCount()),
        names=frozenset(names),
        intensity=intensity,
        rotation=rotation,
        translation=translation,
        scan=scan,
    )


def pose_of(node: Any) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return rotation and translation to the file's world; the identity without a pose."""
    rotation = np.eye(3)
    translation = np.zeros(3)
    if not node.isDefined("pose"):
        return rotation, translation
    pose = node["pose"]
    if pose.isDefined("rotation"):
        # By name: files may store the four numbers in any order.
        rotation = _rotation([number_of(pose["rotation"][name]) for name in "wxyz"])
    if pose.isDefined("translation"):
        translation = np.array([number_of(pose["translation"][name]) for name in "xyz"])
    return rotation, translation


def _rotation(quaternion: list[float]) -> NDArray[np.float64]:
    """Return world-from-scan of a quaternion w, x, y, z of any length; the identity without one."""
    from scipy.spatial.transform import Rotation

    length = math.hypot(*quaternion)
    if not (math.isfinite(length) and length > 0.0):
        return np.eye(3)
    # Normalised before scipy squares it: the squares of stored numbers may overflow or underflow.
    unit = [item / length for item in quaternion]
    return np.asarray(Rotation.from_quat(unit, scalar_first=True).as_matrix(), dtype=np.float64)


def number_of(node: Any) -> float:
    """Return the value of a number's node, whatever its type."""
    scaled = getattr(node, "scaledValue", None)
    return float(node.value() if scaled is None else scaled())


def _limits(node: Any, group: str, low: str, high: str) -> tuple[float, float] | None:
    if not node.isDefined(group):
        return None
    limits = node[group]
    if not (limits.isDefined(low) and limits.isDefined(high)):
        return None
    smallest, largest = number_of(limits[low]), number_of(limits[high])
    is_usable = math.isfinite(smallest) and math.isfinite(largest) and largest > smallest
    return (smallest, largest) if is_usable else None


def _rgb_limit(node: Any) -> float | None:
    """Return the largest colour value that the header states for any of the three channels."""
    stated = [_limits(node, "colorLimits", f"{name}Minimum", f"{name}Maximum") for name in _COLOURS]
    largest = [item[1] for item in stated if item is not None]
    return max(largest) if len(largest) == 3 else None


def _blocks(path: Path, pye57: Any, headers: list[ScanHeader]) -> Iterator[PointBlock]:
    with reading(path, FORMAT):
        file = pye57.E57(str(path))
    try:
        for scan, header in enumerate(headers):
            yield from _scan_blocks(path, pye57.libe57, file, header, scan)
    finally:
        file.close()


def _scan_blocks(
    path: Path, libe57: Any, file: Any, header: ScanHeader, scan: int
) -> Iterator[PointBlock]:
    wanted = {*header.axes, header.invalid_state, *_COLOURS, *_GRID, *_STATES} & header.names
    if header.intensity is not None:
        wanted.add(header.intensity)
    capacity = min(BLOCK_POINTS, header.n_points)
    with reading(path, FORMAT):
        arrays, buffers = _buffers(libe57, file, sorted(wanted), capacity)
        reader = file.data3d[header.index]["points"].reader(buffers)
    n_read = 0
    while True:
        with reading(path, FORMAT):
            count = int(reader.read())
        if count == 0:
            break
        n_read += count
        yield _block({name: array[:count] for name, array in arrays.items()}, header, scan)
    reader.close()
    if n_read != header.n_points:
        raise short_file_error(
            path, f"scan {header.index}", f"{n_read} points", str(header.n_points)
        )


def _buffers(
    libe57: Any, file: Any, names: list[str], capacity: int
) -> tuple[dict[str, NDArray[Any]], Any]:
    arrays: dict[str, NDArray[Any]] = {}
    buffers = libe57.VectorSourceDestBuffer()
    for name in names:
        # No integers: pye57 treats numpy's 64-bit ones as 32-bit ones and returns garbage, and its
        # own readers' 16 bits are too few for rows and columns.
        is_exact = name.startswith(("cartesian", "spherical", "row", "column"))
        arrays[name] = np.zeros(capacity, dtype=np.float64 if is_exact else np.float32)
        buffers.append(
            libe57.SourceDestBuffer(
                file.image_file, name, arrays[name], capacity, doConversion=True, doScaling=True
            )
        )
    return arrays, buffers


def _block(arrays: dict[str, NDArray[Any]], header: ScanHeader, scan: int) -> PointBlock:
    axes = np.stack([arrays[name] for name in header.axes])
    if header.axes is _SPHERICAL:
        axes = _cartesian(axes)
    values: dict[str, NDArray[np.generic]] = {}
    if header.intensity is not None:
        values["intensity"] = arrays[header.intensity]
        if (invalid := arrays.get("isIntensityInvalid")) is not None:
            values["intensity"] = np.where(invalid != 0, np.nan, values["intensity"])
    if "rgb" in header.scan.fields:
        values |= dict(zip("rgb", (arrays[name] for name in _COLOURS), strict=True))
        if (invalid := arrays.get("isColorInvalid")) is not None:
            values["has_rgb"] = invalid == 0
    if "grid" in header.scan.fields:
        values |= dict(zip(("row", "column"), (arrays[name] for name in _GRID), strict=True))
    state = arrays.get(header.invalid_state)
    block = point_block(
        axes, values, causes=None if state is None else {"invalid": state != 0}, scan=scan
    )
    if not header.scan.station_is_posed:
        return block
    return replace(block, points=block.points @ header.rotation.T + header.translation)


def _cartesian(spherical: NDArray[np.float64]) -> NDArray[np.float64]:
    """E57 8.4.4: azimuth from x towards y, elevation from the xy plane towards z, radians."""
    distance, azimuth, elevation = spherical
    level = distance * np.cos(elevation)
    return np.stack(
        [level * np.cos(azimuth), level * np.sin(azimuth), distance * np.sin(elevation)]
    )


def check_xml(path: Path) -> None:
    """Check the XML of an E57 file.

    Raises:
        InputError: it is too large or too deep, has a document type, or is not XML in UTF-8.
    """
    xml = _xml_of(path)
    encoding = _ENCODING.match(xml)
    if encoding is not None and encoding[1].upper() != b"UTF-8":
        raise _refusal(path, f"it is in {encoding[1][:40]!r}, expected UTF-8")
    # For each enclosing element: its number of children, and the maximum.
    around: list[list[int]] = [[0, 1]]
    n_elements = 0

    def begin(name: str, attributes: dict[str, str]) -> None:
        nonlocal n_elements
        n_elements += 1
        around[-1][0] += 1
        if around[-1][0] > around[-1][1]:
            raise _refusal(path, f"a structure in it has more than {MOST_XML_CHILDREN} elements")
        is_vector = attributes.get("type") == "Vector"
        around.append([0, MOST_XML_ELEMENTS if is_vector else MOST_XML_CHILDREN])
        if len(around) > DEEPEST_XML + 1:
            raise _refusal(path, f"it is nested deeper than {DEEPEST_XML} elements")
        if n_elements > MOST_XML_ELEMENTS:
            raise _refusal(path, f"it has more than {MOST_XML_ELEMENTS} elements")

    def refuse_doctype(*declaration: object) -> None:
        raise _refusal(path, "it declares a document type or entities, which no E57 has")

    parser = ParserCreate("UTF-8")
    parser.StartElementHandler = begin
    parser.EndElementHandler = lambda name: around.pop()
    parser.StartDoctypeDeclHandler = refuse_doctype
    try:
        parser.Parse(xml, True)  # noqa: FBT003 - it is all there is
    except ExpatError as error:
        raise _refusal(path, f"it is not XML ({error})") from error


def _xml_of(path: Path) -> bytes:
    with path.open("rb") as file:
        head = file.read(_HEADER.size)
        if len(head) < _HEADER.size:
            raise _refusal(path, "the file ends within its header")
        _, _, _, _, start, length, _ = _HEADER.unpack(head)
        if length > MOST_XML_BYTES:
            raise _refusal(path, f"it has {length} bytes, at most {MOST_XML_BYTES} are read")
        offset = start % _PAGE
        file.seek(min(start - offset, path.stat().st_size))
        raw = file.read((offset + length) // _PAYLOAD * _PAGE + 2 * _PAGE)
    pages = b"".join(raw[at : at + _PAYLOAD] for at in range(0, len(raw), _PAGE))
    return pages[offset : offset + length]


def _refusal(path: Path, reason: str) -> InputError:
    return InputError(
        f"{path.name} cannot be read as E57: its XML is refused, {reason}; the file is damaged or "
        "was not written by a scanner's program, copy or export it again"
    )
