"""Cameras of Agisoft Metashape: "Export Cameras" as Agisoft XML.

Metashape has our axes (x right, y down, z forward) and our pixels (the centre of the first one at
(0.5, 0.5)), its principal point counts from the middle of the photo, and what it calls P1 and P2
is p2 and p1 in OpenCV (Metashape Pro manual, appendix on camera models). A camera's matrix leads
from it to the chunk, whose own transform leads to the world.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path, PurePath
from typing import Final
from xml.etree import ElementTree as ET

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import InputError
from orthoflow.files.fisheyes import FisheyeLens
from orthoflow.files.given_cameras import (
    MOST_CAMERAS,
    GivenCamera,
    bare_name,
    checked_lens,
    damaged,
    numbers_of,
    rotation_of,
    text_of,
)
from orthoflow.files.images import MOST_PIXELS
from orthoflow.files.panoramas import FACES, PANORAMA_FROM_CAMERA, face_lens, face_name
from orthoflow.products import Intrinsics

MOST_TAGS: Final = 2_000_000
_UNKNOWN_TERMS: Final = ("k4", "p3", "p4")
_UNKNOWN_TO_FISHEYES: Final = ("p3", "p4")
_SINCE: Final = "Metashape 1.2 or newer writes f, cx, cy, k1 ... for each sensor"


def read_metashape_xml(path: Path) -> tuple[GivenCamera, ...]:
    """Read the cameras of all chunks.

    Raises:
        InputError: it is damaged, or no such file.
    """
    root = _root(path)
    chunks = root.findall("chunk") or root.findall(".//chunk")
    cameras = (camera for chunk in chunks for camera in _of_chunk(chunk, path))
    found = list(islice(cameras, MOST_CAMERAS + 1))
    if not found:
        raise damaged(path, "it holds no cameras of Metashape (document/chunk/cameras/camera)")
    return tuple(found)


def _root(path: Path) -> ET.Element:
    """Parse XML without anything that XML could do."""
    text = text_of(path)
    # Entities are the bombs of XML, and only a document type can define them.
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise InputError(
            f"{path.name} defines a document type, which no export of Metashape does, so it is not "
            "read"
        )
    if text.count("<") > MOST_TAGS:
        raise InputError(f"{path.name} has more than {MOST_TAGS} tags, too many for cameras")
    try:
        return ET.fromstring(text)
    except ET.ParseError as error:
        raise damaged(path, f"it is no XML: {error.msg}", error.position[0]) from error


def _of_chunk(chunk: ET.Element, path: Path) -> Iterator[GivenCamera]:
    lenses = {
        sensor.get("id", ""): _lens(sensor, path) for sensor in chunk.findall("sensors/sensor")
    }
    worlds = {
        component.get("id", ""): _Similarity(component.find("transform"), path)
        for component in chunk.findall("components/component")
    }
    whole = _Similarity(chunk.find("transform"), path)
    panoramas = {
        sensor.get("id", "")
        for sensor in chunk.findall("sensors/sensor")
        if sensor.get("type") == "spherical"
    }
    for camera in [*chunk.findall("cameras/camera"), *chunk.findall("cameras/group/camera")]:
        world = worlds.get(camera.get("component_id", ""), whole)
        given = _camera(camera, lenses, world, path)
        yield from _faces(given) if camera.get("sensor_id", "") in panoramas else [given]


class _Similarity:
    """World from chunk: scale, rotation and shift; none where the chunk was not referenced."""

    def __init__(self, transform: ET.Element | None, path: Path) -> None:
        self.rotation, self.shift, self.scale = np.eye(3), np.zeros(3), 1.0
        if transform is None:
            return
        rotation, shift, scale = (
            transform.findtext(name, "").split() for name in ("rotation", "translation", "scale")
        )
        if rotation:
            self.rotation = rotation_of(_some(rotation, 9, path, "rotation"), path, "the chunk")
        if shift:
            self.shift = np.array(_some(shift, 3, path, "translation"))
        if scale:
            (self.scale,) = _some(scale, 1, path, "scale")
        if not self.scale > 0.0:
            raise damaged(path, f"the scale of the chunk must be positive, got {self.scale:g}")


def _some(words: list[str], count: int, path: Path, what: str) -> list[float]:
    if len(words) != count:
        raise damaged(path, f"the {what} of the chunk must be {count} numbers, got {len(words)}")
    return numbers_of(words, path, f"the {what} of the chunk")


def _lens(sensor: ET.Element, path: Path) -> Intrinsics | FisheyeLens | str:
    """A sensor's lens, or why there is none."""
    label = sensor.get("label", sensor.get("id", ""))
    kind = sensor.get("type", "frame")
    if kind == "spherical":
        return face_lens(_size(sensor, label, path)[0])
    if kind not in ("frame", "fisheye"):
        return f"its sensor {label} is of type {kind}; orthoflow takes frame, fisheye and spherical"
    calibrations = sensor.findall("calibration")
    adjusted = [each for each in calibrations if each.get("class") == "adjusted"]
    if not calibrations:
        return f"its sensor {label} has no calibration"
    calibration = (adjusted or calibrations)[-1]
    values = {child.tag: child.text or "" for child in calibration}
    if "f" not in values:
        return f"its sensor {label} has no focal length f ({_SINCE})"
    has_own_size = calibration.find("resolution") is not None
    size = _size(calibration if has_own_size else sensor, label, path)
    return (_fisheye if kind == "fisheye" else _intrinsics)(values, size, path, label)


def _size(owner: ET.Element, label: str, path: Path) -> tuple[int, int]:
    """Width and height in pixels."""
    size = owner.find("resolution")
    words = [] if size is None else [size.get("width", ""), size.get("height", "")]
    values = numbers_of(words, path, f"the size of sensor {label}")
    if len(values) != 2 or min(values) < 1.0 or values[0] * values[1] > MOST_PIXELS:
        raise damaged(path, f"sensor {label} does not say how many pixels it has")
    return round(values[0]), round(values[1])


class _Terms:
    """The numbers of a calibration by their names; those that it leaves out are zero."""

    def __init__(self, values: Mapping[str, str], path: Path, label: str) -> None:
        self._values, self._path, self._label = values, path, label

    def __call__(self, name: str) -> float:
        what = f"{name} of sensor {self._label}"
        return numbers_of([self._values.get(name, "0")], self._path, what)[0]

    def unknown(self, names: Sequence[str]) -> str:
        """What is said of terms that our lenses have not; empty where there are none."""
        there = ", ".join(name for name in names if self(name) != 0.0)
        return there and (
            f"its sensor {self._label} has {there}, which OpenCV's model has not: "
            "optimise the cameras without them and export again"
        )


def _fisheye(
    values: Mapping[str, str], size: tuple[int, int], path: Path, label: str
) -> FisheyeLens | str:
    value = _Terms(values, path, label)
    focal = value("f")
    return value.unknown(_UNKNOWN_TO_FISHEYES) or FisheyeLens(
        width=size[0],
        height=size[1],
        fx=focal + value("b1"),
        fy=focal,
        cx=0.5 * size[0] + value("cx"),
        cy=0.5 * size[1] + value("cy"),
        radial=(value("k1"), value("k2"), value("k3"), value("k4")),
        tangential=(value("p2"), value("p1")),
        skew=value("b2"),
    )


def _intrinsics(
    values: Mapping[str, str], size: tuple[int, int], path: Path, label: str
) -> Intrinsics | str:
    value = _Terms(values, path, label)
    unknown = value.unknown(_UNKNOWN_TERMS)
    if unknown:
        return unknown
    focal = value("f")
    lens = Intrinsics(
        width=size[0],
        height=size[1],
        fx=focal + value("b1"),
        fy=focal,
        cx=0.5 * size[0] + value("cx"),
        cy=0.5 * size[1] + value("cy"),
        distortion=(value("k1"), value("k2"), value("p2"), value("p1"), value("k3")),
        source="given",
        skew=value("b2") or None,
    )
    return checked_lens(lens, path, f"sensor {label}")


def _faces(given: GivenCamera) -> list[GivenCamera]:
    """The cameras of a panorama's faces; where it has none, itself with the reason."""
    if given.rotation is None or given.translation is None:
        return [given]
    return [
        replace(
            given,
            name=face_name(PurePath(given.name).stem, face),
            rotation=axes @ PANORAMA_FROM_CAMERA @ given.rotation,
            translation=axes @ PANORAMA_FROM_CAMERA @ given.translation,
        )
        for face, axes in FACES.items()
    ]


def _camera(
    camera: ET.Element,
    lenses: Mapping[str, Intrinsics | FisheyeLens | str],
    world: _Similarity,
    path: Path,
) -> GivenCamera:
    name = bare_name(camera.get("label", ""))
    lens = lenses.get(camera.get("sensor_id", ""), "it names no sensor")
    words = camera.findtext("transform", "").split()
    if isinstance(lens, str) or not words:
        return GivenCamera(
            name=name, reason=lens if isinstance(lens, str) else "Metashape did not align it"
        )
    values = numbers_of(words, path, f"the transform of {name}")
    if len(values) != 16:
        raise damaged(path, f"the transform of {name} must be 16 numbers, got {len(values)}")
    chunk_from_camera = np.array(values).reshape(4, 4)
    turn = rotation_of(chunk_from_camera[:3, :3].ravel().tolist(), path, name)
    centre: NDArray[np.float64] = (
        world.scale * world.rotation @ chunk_from_camera[:3, 3] + world.shift
    )
    rotation = (world.rotation @ turn).T
    return GivenCamera(
        name=name,
        lens=lens,
        rotation=rotation,
        translation=-rotation @ centre,
    )
