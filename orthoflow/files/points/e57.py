"""E57 files, read with libE57: several scans with poses, in Cartesian or spherical coordinates.

The XML section is checked before libE57 parses it. libE57 compares each child of a structure with
all previous ones, so 60,000 children take over 50 s; and some versions read files that XML entities
refer to. The standard (ASTM E2807) requires neither.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import InputError
from orthoflow.files.points.fields import columns_of_names
from orthoflow.files.points.scan_file import (
    BLOCK_POINTS,
    PointBlock,
    Scan,
    ScanFile,
    Values,
    cut_off,
    load_library,
    point_block,
    reading,
)
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
# Fields that are non-zero if the values of a point are invalid.
_STATES: Final = (
    "cartesianInvalidState",
    "sphericalInvalidState",
    "isIntensityInvalid",
    "isColorInvalid",
)
# The XML of a large building (a thousand scans with pictures) has a few million bytes.
#: bytes of the XML of an E57 file
MOST_XML_BYTES: Final = 1 << 25
#: elements of the XML of an E57 file
MOST_XML_ELEMENTS: Final = 200_000
#: nesting levels of the XML of an E57 file
DEEPEST_XML: Final = 64
# The fields of a structure have different names, so this also limits their number.
#: different element names in the XML of an E57 file
MOST_XML_NAMES: Final = 500
# E57 3.3: the file has pages of 1024 bytes, of which the last four are a checksum.
_PAGE: Final = 1024
_PAYLOAD: Final = 1020
_HEADER: Final = struct.Struct("<8sIIQQQQ")
_TAG: Final = re.compile(rb"<(/?)([A-Za-z_][\w:.-]*)[^<>]*?(/?)>")

# Index in the file, number of points, field names by meaning, and pose.
_Part = tuple[int, int, dict[str, str], tuple[NDArray[np.float64], NDArray[np.float64]] | None]


def open_e57(path: Path, *, intensity_field: str | None = None) -> ScanFile:
    """Open an E57 file; all scans with points are read, in file order."""
    check_xml(path)
    pye57 = load_library("pye57", path)
    parts: list[_Part] = []
    scans: list[Scan] = []
    with reading(path, FORMAT), pye57.E57(str(path)) as file:
        unit = _unit(file.image_file.root())
        for index in range(file.scan_count):
            if file.data3d[index].isDefined("points"):
                part, scan = _read_header(path, file, index, intensity_field)
                scan.unit = unit
                if part[1] > 0:
                    parts.append(part)
                    scans.append(scan)
    return ScanFile(
        name=path.name,
        format_name=FORMAT,
        n_most=sum(n_points for _, n_points, *_ in parts),
        scans=scans,
        read=partial(_blocks, path, pye57, parts),
    )


def _unit(root: Any) -> StatedUnit:
    """Return the unit: metres by the standard, unless the coordinate metadata declare another."""
    text = str(root["coordinateMetadata"].value()) if root.isDefined("coordinateMetadata") else ""
    found = unit_of_crs(text, "coordinate metadata")
    found = found or unit_of_comments([text], "coordinate metadata")
    return found or unit_of_name("m", "the E57 standard")


def _read_header(
    path: Path, file: Any, index: int, intensity_field: str | None
) -> tuple[_Part, Scan]:
    node = file.data3d[index]
    names = tuple(str(name) for name in file.get_header(index).point_fields)
    axes = next((axes for axes in (_CARTESIAN, _SPHERICAL) if set(names) >= set(axes)), None)
    if axes is None:
        raise InputError(
            f"{path.name}: scan {index} has the fields {', '.join(sorted(names))}; expected "
            f"{', '.join(_CARTESIAN)} or {', '.join(_SPHERICAL)}"
        )
    renamed = [dict(zip(axes, _CARTESIAN, strict=True)).get(name, name) for name in names]
    columns = columns_of_names(renamed, intensity_field=intensity_field)
    used = dict(zip("xyz", axes, strict=True))
    if columns is not None and "intensity" in columns.names:
        used["intensity"] = names[columns.names.index("intensity")]
    for meanings, wanted in (("rgb", _COLOURS), (("row", "column"), _GRID)):
        if set(names) >= set(wanted):
            used |= dict(zip(meanings, wanted, strict=True))
    groups = {"intensity": "intensity", "r": "rgb", "row": "grid"}
    read = {*used.values(), *_STATES}
    rotation, translation = pose_of(node)
    is_posed = not (np.allclose(rotation, np.eye(3), atol=1e-12) and not translation.any())
    brightest = [
        _limits(node, "colorLimits", f"{name}Minimum", f"{name}Maximum") for name in _COLOURS
    ]
    scan = Scan(
        name=str(node["name"].value()) if node.isDefined("name") else "",
        fields=frozenset(group for name, group in groups.items() if name in used),  # type: ignore[misc]
        fields_used=tuple(name for name in names if name in read),
        fields_not_used=tuple(name for name in names if name not in read),
        intensity_limits=_limits(node, "intensityLimits", "intensityMinimum", "intensityMaximum")
        if used.get("intensity") == "intensity"
        else None,
        rgb_limit=max(one[1] for one in brightest if one) if all(brightest) else None,
        station=translation,
        station_is_posed=is_posed,
    )
    used |= {name: name for name in _STATES if name in names}
    n_points = int(node["points"].childCount())
    return (index, n_points, used, (rotation, translation) if is_posed else None), scan


def pose_of(node: Any) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return rotation and translation to the world frame; the identity if there is no pose."""
    from scipy.spatial.transform import Rotation

    rotation, translation = np.eye(3), np.zeros(3)
    pose = node["pose"] if node.isDefined("pose") else None
    if pose is not None and pose.isDefined("rotation"):
        # Read the four numbers by name, since the file may store them in any order.
        quaternion = [number_of(pose["rotation"][name]) for name in "wxyz"]
        length = math.hypot(*quaternion)
        if math.isfinite(length) and length > 0.0:
            # Normalise with `hypot` before scipy does, because squares of very large or small
            # numbers overflow or underflow.
            unit = [item / length for item in quaternion]
            rotation = np.asarray(Rotation.from_quat(unit, scalar_first=True).as_matrix())
    if pose is not None and pose.isDefined("translation"):
        translation = np.array([number_of(pose["translation"][name]) for name in "xyz"])
    return rotation, translation


def number_of(node: Any) -> float:
    """Return the value of a numeric node of any type."""
    scaled = getattr(node, "scaledValue", None)
    return float(node.value() if scaled is None else scaled())


def _limits(node: Any, group: str, low: str, high: str) -> tuple[float, float] | None:
    limits = node[group] if node.isDefined(group) else None
    if limits is None or not (limits.isDefined(low) and limits.isDefined(high)):
        return None
    smallest, largest = number_of(limits[low]), number_of(limits[high])
    is_usable = math.isfinite(smallest) and math.isfinite(largest) and largest > smallest
    return (smallest, largest) if is_usable else None


def _blocks(path: Path, pye57: Any, parts: list[_Part]) -> Iterator[PointBlock]:
    libe57 = pye57.libe57
    with reading(path, FORMAT):
        file = pye57.E57(str(path))
    try:
        for scan, (index, n_points, used, pose) in enumerate(parts):
            capacity, n_read = min(BLOCK_POINTS, n_points), 0
            with reading(path, FORMAT):
                arrays: Values = {}
                buffers = libe57.VectorSourceDestBuffer()
                for meaning, name in used.items():
                    # Integer buffers are not used, because pye57 treats numpy's 64-bit integers as
                    # 32-bit ones and returns garbage, and the 16 bits in its own readers are too
                    # few for rows and columns.
                    kind = np.float64 if meaning in ("x", "y", "z", "row", "column") else np.float32
                    arrays[meaning] = np.zeros(capacity, dtype=kind)
                    buffers.append(
                        libe57.SourceDestBuffer(
                            file.image_file,
                            name,
                            arrays[meaning],
                            capacity,
                            doConversion=True,
                            doScaling=True,
                        )
                    )
                reader = file.data3d[index]["points"].reader(buffers)
            while True:
                with reading(path, FORMAT):
                    count = int(reader.read())
                if count == 0:
                    break
                n_read += count
                values = {name: array[:count] for name, array in arrays.items()}
                is_spherical = used["x"] == _SPHERICAL[0]
                yield _block(values, scan, pose, is_spherical=is_spherical)
            reader.close()
            if n_read != n_points:
                raise cut_off(path, f"scan {index}", f"{n_read} points", str(n_points))
    finally:
        file.close()


def _block(
    values: Values,
    scan: int,
    pose: tuple[NDArray[np.float64], NDArray[np.float64]] | None,
    *,
    is_spherical: bool,
) -> PointBlock:
    axes = np.stack([values[axis] for axis in "xyz"])
    if is_spherical:
        # E57 8.4.4: azimuth from x towards y and elevation from the xy plane towards z, in radians.
        distance, azimuth, elevation = axes
        level = distance * np.cos(elevation)
        axes = np.stack(
            [level * np.cos(azimuth), level * np.sin(azimuth), distance * np.sin(elevation)]
        )
    state = values.get(_STATES[is_spherical])
    if "intensity" in values and "isIntensityInvalid" in values:
        is_invalid = values["isIntensityInvalid"] != 0
        values["intensity"] = np.where(is_invalid, np.nan, values["intensity"])
    if "r" in values and "isColorInvalid" in values:
        values["has_rgb"] = values["isColorInvalid"] == 0
    causes = {} if state is None else {"invalid": state != 0}
    return point_block(axes, values, causes=causes, scan=scan, pose=pose)


def check_xml(path: Path) -> None:
    """Check the XML of an E57 file before libE57 parses it.

    Raises:
        InputError: the XML is too large or nested too deeply, declares a document type or entities,
            or has more element names than any scanner software writes.
    """
    xml = _xml_of(path)
    if b"<!DOCTYPE" in xml or b"<!ENTITY" in xml:
        raise _refusal(
            path, "it declares a document type or entities, which E57 files do not contain"
        )
    names: set[bytes] = set()
    n_elements = depth = 0
    for tag in _TAG.finditer(xml):
        depth += -1 if tag[1] else 0 if tag[3] else 1
        n_elements += not tag[1]
        names.add(tag[2])
        for count, most, reason in (
            (depth, DEEPEST_XML, f"it is nested deeper than {DEEPEST_XML} elements"),
            (n_elements, MOST_XML_ELEMENTS, f"it has more than {MOST_XML_ELEMENTS} elements"),
            (
                len(names),
                MOST_XML_NAMES,
                f"its elements have more than {MOST_XML_NAMES} different names",
            ),
        ):
            if count > most:
                raise _refusal(path, reason)


def _xml_of(path: Path) -> bytes:
    with path.open("rb") as file:
        head = file.read(_HEADER.size)
        if len(head) < _HEADER.size:
            raise _refusal(path, "the file ends within its header")
        _, _, _, _, start, length, _ = _HEADER.unpack(head)
        if length > MOST_XML_BYTES:
            raise _refusal(path, f"it has {length} bytes; the limit is {MOST_XML_BYTES}")
        offset = start % _PAGE
        file.seek(min(start - offset, path.stat().st_size))
        raw = file.read((offset + length) // _PAYLOAD * _PAGE + 2 * _PAGE)
    pages = b"".join(raw[at : at + _PAYLOAD] for at in range(0, len(raw), _PAGE))
    return pages[offset : offset + length]


def _refusal(path: Path, reason: str) -> InputError:
    return InputError(
        f"{path.name} cannot be read as E57 because of its XML: {reason}; the file is damaged or "
        "was not written by scanner software; copy or export it again"
    )
