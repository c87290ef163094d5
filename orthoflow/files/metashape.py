"""Cameras from Agisoft Metashape: "Export Cameras" as Agisoft XML.

Metashape has orthoflow's axes (x right, y down, z forward) and pixel coordinates (centre of the
first pixel at (0.5, 0.5)), but measures the principal point from the centre of the photo, and its
P1 and P2 are p2 and p1 in OpenCV (Metashape Pro manual, appendix on camera models). A camera's
matrix transforms camera to chunk coordinates; the chunk's own transform converts these to the
world. For chunks with a geographic or projected coordinate system, the world is geocentric, in
metres and in the system's datum, and the poses are converted from there. In a rig, only the master
camera has a matrix; the pose of each other camera relative to the master is stored in its sensor.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any, Final
from xml.etree import ElementTree as ET

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import InputError
from orthoflow.files.cube_faces import PanoramaLens, WideLens
from orthoflow.files.given_cameras import (
    MOST_CAMERAS,
    GivenCamera,
    checked_lens,
    damaged,
    lens_of_terms,
    lens_or_reason,
    numbers_of,
    photo_path,
    rotation_of,
    text_of,
)
from orthoflow.files.photo_files import MOST_PIXELS
from orthoflow.products import Intrinsics

#: tags of Metashape's XML
MOST_TAGS: Final = 2_000_000
_TERMS: Final = ("f", "cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4")
_SINCE_EXPORT: Final = "optimise the cameras without k4, p3 and p4 and export again"
# Half the baseline over which the local axes of a coordinate system are computed.
_STEP_M: Final = 50.0
_SINCE: Final = "Metashape 1.2 or newer writes f, cx, cy, k1 ... for each sensor"


def read_metashape_xml(path: Path) -> tuple[GivenCamera, ...]:
    """Read the cameras of all chunks.

    Raises:
        InputError: the file is damaged, or not a Metashape export.
    """
    root = _root(path)
    chunks = root.findall("chunk") or root.findall(".//chunk")
    cameras = (camera for chunk in chunks for camera in _of_chunk(chunk, path))
    found = list(islice(cameras, MOST_CAMERAS + 1))
    if not found:
        raise damaged(path, "it contains no Metashape cameras (document/chunk/cameras/camera)")
    return tuple(found)


def _root(path: Path) -> ET.Element:
    """Parse XML; document types and entities are refused."""
    text = text_of(path)
    # Entities can expand without limit, and only a document type can define them.
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise InputError(
            f"{path.name} defines a document type, which Metashape exports do not "
            "contain, so it is not read"
        )
    if text.count("<") > MOST_TAGS:
        raise InputError(
            f"{path.name} has more than {MOST_TAGS} tags, too many for a list of cameras"
        )
    try:
        return ET.fromstring(text)
    except ET.ParseError as error:
        raise damaged(path, f"it is not XML: {error.msg}", error.position[0]) from error


def _of_chunk(chunk: ET.Element, path: Path) -> Iterator[GivenCamera]:
    sensors = {
        element.get("id", ""): _Sensor(element, path) for element in chunk.findall("sensors/sensor")
    }
    worlds = {
        component.get("id", ""): _Similarity(component.find("transform"), path)
        for component in chunk.findall("components/component")
    }
    whole = _Similarity(chunk.find("transform"), path)
    # A chunk without any georeference still has the default system of new chunks.
    is_placed = any(world.is_placed for world in (whole, *worlds.values()))
    site = _site(chunk.findtext("reference", ""), path) if is_placed else None
    elements = [*chunk.findall("cameras/camera"), *chunk.findall("cameras/group/camera")]
    masters = {element.get("id", ""): element for element in elements}
    is_off = chunk.get("enabled", "true").lower() in _OFF
    for element in elements:
        world = worlds.get(element.get("component_id", ""), whole)
        if is_off or element.get("enabled", "true").lower() in _OFF:
            what = "chunk" if is_off else "camera"
            name = photo_path(element.get("label", ""))
            yield GivenCamera(name=name, reason=f"its {what} is disabled in Metashape")
            continue
        sensor = sensors.get(element.get("sensor_id", ""))
        given = _camera(element, masters, sensor, world, path)
        if site is not None and world.is_placed and given.rotation is not None:
            given = site(given)
        yield given


_OFF: Final = ("false", "0")


def _site(wkt: str, path: Path) -> Callable[[GivenCamera], GivenCamera] | None:
    """Return the transform from geocentric metres to the chunk's system, or None.

    Raises:
        InputError: the system is in degrees, or unknown.
    """
    if not wkt.strip() or wkt.lstrip().startswith(("LOCAL_CS", "ENGCRS", "ENGINEERINGCRS")):
        return None
    import pyproj

    try:
        stated = pyproj.CRS.from_wkt(wkt)
        # Metashape omits projection parameters that follow from a code.
        code = stated.to_json_dict().get("id", {})
        crs = pyproj.CRS.from_authority(code["authority"], code["code"]) if code else stated
        if crs.is_geocentric:
            return None
        if crs.is_geographic:
            raise InputError(
                f"{path.name} is in degrees ({crs.name}): in Metashape, set the chunk to "
                "the projected coordinate system of the scan and export again"
            )
        metres = crs.axis_info[0].unit_conversion_factor
        convert = _from_geocentric(crs, path).transform
    except pyproj.exceptions.ProjError as error:
        raise damaged(path, f"its coordinate system is not known ({error})") from error

    heights = "" if crs.is_compound else ", heights above its ellipsoid"

    def to_site(points: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.stack(convert(*points.T), axis=-1) * [metres, metres, 1.0]

    def converted(given: GivenCamera) -> GivenCamera:
        rotation, shift = np.asarray(given.rotation), np.asarray(given.translation)
        centre = -rotation.T @ shift
        places = centre + _STEP_M * np.vstack([np.eye(3), -np.eye(3)])
        there = to_site(np.vstack([centre, places]))
        if not np.isfinite(there).all():
            raise damaged(path, f"{given.name} has no position in {crs.name}")
        # Rotation to the axes of the system at the camera; scale and shear are removed.
        left, _, right = np.linalg.svd((there[1:4] - there[4:]).T / (2.0 * _STEP_M))
        turned = rotation @ (left @ right).T
        return replace(
            given,
            rotation=turned,
            translation=-turned @ there[0],
            note=given.note or f"poses are converted from geocentric metres to {crs.name}{heights}",
        )

    return converted


# Any: pyproj has no types that mypy accepts in strict mode.
def _from_geocentric(crs: Any, path: Path) -> Any:
    """Return the transformer from geocentric metres to a projected system, as used by Metashape.

    Raises:
        InputError: the heights need a grid that is not installed.
    """
    import pyproj

    level = crs.sub_crs_list[0] if crs.is_compound else crs
    if level.geodetic_crs is None:
        raise damaged(path, f"its coordinate system {crs.name} is not georeferenced")
    geodetic = level.geodetic_crs.to_json_dict()
    datum = "datum_ensemble" if "datum_ensemble" in geodetic else "datum"
    axes = [
        {"name": axis, "abbreviation": axis, "direction": f"geocentric{axis}", "unit": "metre"}
        for axis in "XYZ"
    ]
    geocentric = pyproj.CRS.from_json_dict(
        {
            "type": "GeodeticCRS",
            "name": f"geocentric of {level.name}",
            datum: geodetic[datum],
            "coordinate_system": {"subtype": "Cartesian", "axis": axes},
        }
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # reported below instead
        group = pyproj.transformer.TransformerGroup(geocentric, crs, always_xy=True)
    # If the accuracy is negative, heights would not be converted.
    if crs.is_compound and not (group.best_available and group.transformers[0].accuracy >= 0.0):
        grids = [grid.short_name for way in group.unavailable_operations for grid in way.grids]
        missing = f" without its grid {grids[0]} (`projsync --file {grids[0]}`)" if grids else ""
        raise InputError(
            f"{path.name} is in {crs.name}, whose heights PROJ cannot compute{missing}: set a "
            "coordinate system without a vertical part for the chunk and export again"
        )
    return pyproj.Transformer.from_crs(geocentric, crs, always_xy=True)


class _Similarity:
    """Transform from chunk to world: scale, rotation and translation; identity by default."""

    def __init__(self, transform: ET.Element | None, path: Path) -> None:
        self.rotation, self.shift, self.scale = np.eye(3), np.zeros(3), 1.0
        self.is_placed = False
        if transform is None:
            return
        self.is_placed = bool(transform.findtext("translation", "").strip())
        self.rotation, self.shift = _pose(transform, ("translation",), path, "the chunk")
        if words := transform.findtext("scale", "").split():
            (self.scale,) = _some(words, 1, path, "scale", "the chunk")
        if not self.scale > 0.0:
            raise damaged(path, f"the scale of the chunk must be positive, got {self.scale:g}")


def _pose(
    element: ET.Element, places: Sequence[str], path: Path, whose: str
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the rotation and translation of an element; `places` are names for the translation."""
    rotation, shift = np.eye(3), np.zeros(3)
    if words := element.findtext("rotation", "").split():
        rotation = rotation_of(_some(words, 9, path, "rotation", whose), path, whose)
    for name in places:
        if words := element.findtext(name, "").split():
            return rotation, np.array(_some(words, 3, path, name, whose))
    return rotation, shift


def _some(words: list[str], count: int, path: Path, what: str, whose: str) -> list[float]:
    if len(words) != count:
        raise damaged(path, f"the {what} of {whose} must be {count} numbers, got {len(words)}")
    return numbers_of(words, path, f"the {what} of {whose}")


class _Sensor:
    """A sensor: its lens, or the reason why the lens is missing, and its pose in the rig."""

    def __init__(self, element: ET.Element, path: Path) -> None:
        self.label = element.get("label", element.get("id", ""))
        self.lens, self.note = self._lens(element, path)
        places = ("location", "translation")
        self.rotation, self.location = _pose(element, places, path, f"sensor {self.label}")
        shutter = element.findtext("rolling_shutter", "").strip().lower()
        self.has_rolling_shutter = shutter not in ("", "none", "disabled", *_OFF)

    def _lens(self, element: ET.Element, path: Path) -> tuple[Intrinsics | WideLens | str, str]:
        kind = element.get("type", "frame")
        if kind == "spherical":
            width, height = _size(element, self.label, path)
            return PanoramaLens(width=width, height=height), ""
        if kind not in ("frame", "fisheye"):
            return (
                f"its sensor {self.label} is of type {kind}; orthoflow supports frame, fisheye and "
                "spherical"
            ), ""
        calibrations = element.findall("calibration")
        if not calibrations:
            return f"its sensor {self.label} has no calibration", ""
        adjusted = [each for each in calibrations if each.get("class") == "adjusted"]
        calibration = (adjusted or calibrations)[-1]
        t = dict.fromkeys(_TERMS, 0.0) | {
            child.tag: numbers_of([child.text or ""], path, f"{child.tag} of sensor {self.label}")[
                0
            ]
            for child in calibration
            if child.tag in _TERMS
        }
        if calibration.find("f") is None:
            return f"its sensor {self.label} has no focal length f ({_SINCE})", ""
        has_own_size = calibration.find("resolution") is not None
        width, height = _size(calibration if has_own_size else element, self.label, path)
        t |= {"fx": t["f"] + t["b1"], "fy": t["f"], "skew": t["b2"], "p1": t["p2"], "p2": t["p1"]}
        t |= {"cx": 0.5 * width + t["cx"], "cy": 0.5 * height + t["cy"]}
        lens, worst_px = lens_of_terms(t, width, height, is_fisheye=kind == "fisheye")
        if isinstance(lens, Intrinsics):
            checked_lens(lens, path, f"sensor {self.label}")
        return lens_or_reason(f"the lens of sensor {self.label}", lens, worst_px, _SINCE_EXPORT)


def _size(owner: ET.Element, label: str, path: Path) -> tuple[int, int]:
    size = owner.find("resolution")
    words = [] if size is None else [size.get("width", ""), size.get("height", "")]
    values = numbers_of(words, path, f"the size of sensor {label}")
    if len(values) != 2 or min(values) < 1.0 or values[0] * values[1] > MOST_PIXELS:
        raise damaged(path, f"the size of sensor {label} in pixels is missing")
    return round(values[0]), round(values[1])


def _camera(
    element: ET.Element,
    masters: Mapping[str, ET.Element],
    sensor: _Sensor | None,
    world: _Similarity,
    path: Path,
) -> GivenCamera:
    name = photo_path(element.get("label", ""))
    if sensor is None:
        return GivenCamera(name=name, reason="it has no sensor")
    if isinstance(sensor.lens, str):
        return GivenCamera(name=name, reason=sensor.lens)
    master = masters.get(element.get("master_id", ""), element)
    chunk_from_camera = _matrix(element, name, path)
    if chunk_from_camera is None and master is not element:
        chunk_from_camera = _matrix(master, name, path)
        if chunk_from_camera is not None:
            offset = np.eye(4)
            offset[:3, :3], offset[:3, 3] = sensor.rotation, sensor.location
            chunk_from_camera = chunk_from_camera @ offset
    if chunk_from_camera is None:
        return GivenCamera(name=name, reason="Metashape did not align it")
    turn = rotation_of(chunk_from_camera[:3, :3].ravel().tolist(), path, name)
    centre: NDArray[np.float64] = (
        world.scale * world.rotation @ chunk_from_camera[:3, 3] + world.shift
    )
    rotation = (world.rotation @ turn).T
    note = sensor.note
    if sensor.has_rolling_shutter or element.find("rolling_shutter") is not None:
        note = _rolling_shutter(element, sensor)
    return GivenCamera(
        name=name,
        lens=sensor.lens,
        rotation=rotation,
        translation=-rotation @ centre,
        note=note,
    )


def _rolling_shutter(element: ET.Element, sensor: _Sensor) -> str:
    """Return a note on a compensated rolling shutter, with the displacement if it is known."""
    words = element.findtext("rolling_shutter", "").split()
    moved = ""
    try:
        matrix = np.array([float(word) for word in words])
    except ValueError:
        matrix = np.empty(0)
    if matrix.size in (12, 16) and np.isfinite(matrix).all() and sensor.lens is not None:
        turn = matrix.reshape(-1, 4)[:3, :3]
        cosine = float(np.clip(0.5 * (np.trace(turn) - 1.0), -1.0, 1.0))
        focal = getattr(sensor.lens, "fx", 0.0)
        moved = f" by up to {0.5 * focal * math.acos(cosine):.2g} pixels"
    return (
        f"sensor {sensor.label} has a rolling shutter, for which Metashape compensates and "
        f"orthoflow does not: the first and last rows are displaced{moved}"
    )


def _matrix(element: ET.Element, name: str, path: Path) -> NDArray[np.float64] | None:
    words = element.findtext("transform", "").split()
    return np.reshape(_some(words, 16, path, "transform", name), (4, 4)) if words else None
