"""E57 through libE57's block buffers: several scans with their poses, cartesian or spherical.

Its XML is looked at before, bounded and nothing but elements: libE57 compares each child of a
structure with all before it, so that 60,000 take over 50 s. Entities it refuses today as bad XML;
that nothing is read which they name shall not hang on its version. The standard (ASTM E2807) needs
none of that.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final
from xml.parsers.expat import ExpatError, ParserCreate

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import InputError
from orthoflow.files.points.blocks import (
    BLOCK_POINTS,
    PointBlock,
    ScanFile,
    point_fields,
    short_file_error,
)
from orthoflow.files.points.libraries import load_library, reading

FORMAT: Final = "E57"

_CARTESIAN: Final = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL: Final = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
_COLOURS: Final = ("colorRed", "colorGreen", "colorBlue")
_GRID: Final = ("rowIndex", "columnIndex")
# Scans of large buildings, a thousand scans with pictures, have a few million bytes.
MOST_XML_BYTES: Final = 1 << 25
MOST_XML_ELEMENTS: Final = 200_000
DEEPEST_XML: Final = 64
# Of a structure; vectors, as of scans and pictures, may have as many as they like.
MOST_XML_CHILDREN: Final = 500
# E57 3.3: pages of 1024 bytes, the last four of each a checksum.
_PAGE: Final = 1024
_PAYLOAD: Final = 1020
_HEADER: Final = struct.Struct("<8sIIQQQQ")
_ENCODING: Final = re.compile(rb"<\?xml[^>]*encoding\s*=\s*[\"']([^\"']*)", re.IGNORECASE)


@dataclass(frozen=True, kw_only=True)
class ScanHeader:
    """What is needed of one Data3D entry.

    Attributes:
        index: position in the file's data3D.
        n_points: stated number of points, invalid ones included.
        names: fields of each point.
        rotation: (3, 3) world from scan.
        translation: (3,) position of the scanner in the file's world.
        is_posed: the pose is not the identity.
        intensity_limits: stated smallest and largest value, or None.
        rgb_limit: stated value of full brightness, or None.
    """

    index: int
    n_points: int
    names: frozenset[str]
    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]
    is_posed: bool
    intensity_limits: tuple[float, float] | None
    rgb_limit: float | None

    @property
    def axes(self) -> tuple[str, ...]:
        """Names of the three coordinates."""
        return _CARTESIAN if self.names.issuperset(_CARTESIAN) else _SPHERICAL

    @property
    def invalid_state(self) -> str:
        """Name of the field that is not zero for points without a position."""
        return "cartesianInvalidState" if self.axes is _CARTESIAN else "sphericalInvalidState"


def open_e57(path: Path) -> ScanFile:
    """Open an E57 file; every scan with points is read, in the order of the file."""
    check_xml(path)
    pye57 = load_library("pye57", path)
    with reading(path, FORMAT), pye57.E57(str(path)) as file:
        headers = [
            _read_header(path, file, index)
            for index in range(file.scan_count)
            if file.data3d[index].isDefined("points")
        ]
    headers = [header for header in headers if header.n_points > 0]
    limits = [header.intensity_limits for header in headers]
    stated = [item for item in limits if item is not None]
    rgb_limits = {header.rgb_limit for header in headers if header.names.issuperset(_COLOURS)}
    return ScanFile(
        name=path.name,
        format_name=FORMAT,
        n_most=sum(header.n_points for header in headers),
        fields=point_fields(
            has_intensity=all("intensity" in header.names for header in headers),
            has_rgb=all(header.names.issuperset(_COLOURS) for header in headers),
            has_grid=all(header.names.issuperset(_GRID) for header in headers),
        ),
        read=lambda: _blocks(path, pye57, headers),
        # One scale for all scans of a file, else equal surfaces would differ between them.
        intensity_limits=(min(low for low, _ in stated), max(high for _, high in stated))
        if stated and len(stated) == len(limits)
        else None,
        rgb_limit=rgb_limits.pop() if len(rgb_limits) == 1 else None,
        details={"scans": len(headers)},
    )


def _read_header(path: Path, file: Any, index: int) -> ScanHeader:
    node = file.data3d[index]
    points = node["points"]
    prototype = file.get_header(index).point_fields
    names = frozenset(str(name) for name in prototype)
    if not (names.issuperset(_CARTESIAN) or names.issuperset(_SPHERICAL)):
        raise InputError(
            f"{path.name}: scan {index} has the fields {', '.join(sorted(names))}, expected "
            "cartesianX, Y, Z or sphericalRange, Azimuth, Elevation"
        )
    rotation, translation = pose_of(node)
    is_posed = not (np.allclose(rotation, np.eye(3), atol=1e-12) and not translation.any())
    return ScanHeader(
        index=index,
        n_points=int(points.childCount()),
        names=names,
        rotation=rotation,
        translation=translation,
        is_posed=is_posed,
        intensity_limits=_limits(node, "intensityLimits", "intensityMinimum", "intensityMaximum"),
        rgb_limit=_rgb_limit(node),
    )


def pose_of(node: Any) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rotation and translation to the file's world; the identity where the file states none."""
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
    """World-from-scan of a quaternion w, x, y, z of any length; the identity for one without."""
    from scipy.spatial.transform import Rotation

    length = math.hypot(*quaternion)
    if not (math.isfinite(length) and length > 0.0):
        return np.eye(3)
    # Of length 1 before scipy squares it: squares of what files hold may be too large or too small.
    unit = [item / length for item in quaternion]
    return np.asarray(Rotation.from_quat(unit, scalar_first=True).as_matrix(), dtype=np.float64)


def number_of(node: Any) -> float:
    """Give the value of a number's node, whatever its type."""
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
    """Largest colour value that the header states for any of the three channels."""
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
    wanted = {*header.axes, header.invalid_state, "intensity", *_COLOURS, *_GRID} & header.names
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
) -> tuple[dict[str, NDArray[np.generic]], Any]:
    arrays: dict[str, NDArray[np.generic]] = {}
    buffers = libe57.VectorSourceDestBuffer()
    for name in names:
        # float64 for all: pye57 takes numpy's 64-bit integers for 32-bit ones and leaves rubbish,
        # and its own readers' 16 bits are too few for rows and columns.
        arrays[name] = np.zeros(capacity, dtype=np.float64)
        buffers.append(
            libe57.SourceDestBuffer(
                file.image_file, name, arrays[name], capacity, doConversion=True, doScaling=True
            )
        )
    return arrays, buffers


def _block(arrays: dict[str, NDArray[np.generic]], header: ScanHeader, scan: int) -> PointBlock:
    n_read = len(next(iter(arrays.values())))
    state = arrays.get(header.invalid_state)
    if state is not None and state.any():
        arrays = {name: array[state == 0] for name, array in arrays.items()}
    local = np.column_stack([arrays[name] for name in header.axes]).astype(np.float64)
    if header.axes is _SPHERICAL:
        local = _cartesian(local)
    points = local @ header.rotation.T + header.translation if header.is_posed else local
    has_rgb = all(name in arrays for name in _COLOURS)
    has_grid = all(name in arrays for name in _GRID)
    return PointBlock(
        points=points,
        scan=scan,
        n_read=n_read,
        n_invalid=n_read - len(points),
        intensity=arrays["intensity"].astype(np.float32) if "intensity" in arrays else None,
        rgb=np.column_stack([arrays[name] for name in _COLOURS]) if has_rgb else None,
        row=arrays["rowIndex"].astype(np.int64) if has_grid else None,
        column=arrays["columnIndex"].astype(np.int64) if has_grid else None,
        station=header.translation,
        station_is_posed=header.is_posed,
    )


def _cartesian(spherical: NDArray[np.float64]) -> NDArray[np.float64]:
    """E57 8.4.4: azimuth from x towards y, elevation from the xy plane towards z, radians."""
    distance, azimuth, elevation = spherical.T
    level = distance * np.cos(elevation)
    return np.column_stack(
        [level * np.cos(azimuth), level * np.sin(azimuth), distance * np.sin(elevation)]
    )


def check_xml(path: Path) -> None:
    """Look at the XML of an E57 file.

    Raises:
        InputError: it is too large or too deep, has a document type, or is no XML in UTF-8.
    """
    xml = _xml_of(path)
    encoding = _ENCODING.match(xml)
    if encoding is not None and encoding[1].upper() != b"UTF-8":
        raise _refusal(path, f"it is in {encoding[1][:40]!r}, expected UTF-8")
    _Elements(path).parse(xml)


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


class _Elements:
    """Counts elements and how deep they lie, and refuses what is none."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._n_elements = 0
        # Of each element around the present place: how many children, and how many it may have.
        self._open: list[list[int]] = []

    def parse(self, xml: bytes) -> None:
        """Parse it all.

        Raises:
            InputError: something in it is refused.
        """
        parser = ParserCreate("UTF-8")
        parser.StartElementHandler = self._begin
        parser.EndElementHandler = self._end
        parser.StartDoctypeDeclHandler = self._refuse_doctype
        try:
            parser.Parse(xml, True)  # noqa: FBT003 - it is all there is
        except ExpatError as error:
            raise _refusal(self._path, f"it is no XML ({error})") from error

    def _begin(self, name: str, attributes: dict[str, str]) -> None:
        if self._open:
            self._open[-1][0] += 1
            if self._open[-1][0] > self._open[-1][1]:
                raise _refusal(
                    self._path, f"a structure in it has more than {MOST_XML_CHILDREN} elements"
                )
        is_vector = attributes.get("type") == "Vector"
        self._open.append([0, MOST_XML_ELEMENTS if is_vector else MOST_XML_CHILDREN])
        self._n_elements += 1
        if len(self._open) > DEEPEST_XML:
            raise _refusal(self._path, f"it is nested deeper than {DEEPEST_XML} elements")
        if self._n_elements > MOST_XML_ELEMENTS:
            raise _refusal(self._path, f"it has more than {MOST_XML_ELEMENTS} elements")

    def _end(self, name: str) -> None:
        self._open.pop()

    def _refuse_doctype(self, *declaration: object) -> None:
        raise _refusal(self._path, "it declares a document type or entities, which no E57 has")


def _refusal(path: Path, reason: str) -> InputError:
    return InputError(
        f"{path.name} cannot be read as E57: its XML is refused, {reason}; the file is damaged or "
        "was not written by a scanner's program, copy or export it again"
    )
