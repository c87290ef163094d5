"""Photos in E57 files (`images2D`), with their lenses and poses if these are in the file.

The camera axes of a pinhole image are x right, y up and z backwards (ASTM E2807); the pose
transforms them to the file's world. Principal points are relative to the outer corner of the first
pixel, as in orthoflow. The axes of a spherical image are x forwards, y left and z up.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import InputError
from orthoflow.files.cube_faces import PanoramaLens
from orthoflow.files.given_cameras import GivenCamera
from orthoflow.files.points.e57 import FORMAT, number_of, pose_of
from orthoflow.files.points.scan_file import load_library, reading
from orthoflow.products import Intrinsics

SUFFIX: Final = ".e57"
_FROM_Y_UP: Final = np.diag([1.0, -1.0, -1.0])
# Rotation to camera axes from the axes of a spherical image.
_FROM_PANORAMA: Final = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
_REPRESENTATIONS: Final = ("pinhole", "spherical", "cylindrical", "visualReference")
_CONTENTS: Final = {"jpegImage": ".jpg", "pngImage": ".png"}
_PINHOLE: Final = (
    *("imageWidth", "imageHeight", "focalLength", "pixelWidth", "pixelHeight"),
    *("principalPointX", "principalPointY"),
)
_UNUSUAL: Final = re.compile(r"[^\w.-]+")


@dataclass(frozen=True, kw_only=True)
class E57Image:
    """A photo in an E57 file.

    Attributes:
        name: photo name, composed of file name, image name, and the suffix for the image format.
        content: JPEG or PNG data, as in the file.
        camera: lens and pose, or the reason why they are missing.
    """

    name: str
    content: bytes
    camera: GivenCamera


def read_e57_images(path: Path) -> tuple[E57Image, ...]:
    """Read the photos of an E57 file.

    Raises:
        InputError: the file is damaged, or contains no photos.
        PluginError: the library for E57 is missing.
    """
    pye57 = load_library("pye57", path)
    with reading(path, FORMAT), pye57.E57(str(path)) as file:
        root = file.image_file.root()
        has_images = root.isDefined("images2D")
        nodes = list(_children(root["images2D"])) if has_images else []
        images = tuple(
            image
            for index, node in enumerate(nodes)
            for image in _image(path, index, pye57.libe57.StructureNode(node))
        )
    if not images:
        raise InputError(f"{path.name} contains no photos (images2D as JPEG or PNG)")
    return images


@dataclass(frozen=True, kw_only=True)
class E57ImageCount:
    """Number of images in an E57 file, and number of images with lens and pose."""

    n_images: int = 0
    n_posed: int = 0


def count_e57_images(path: Path) -> E57ImageCount:
    """Count the photos and panoramas in an E57 file without reading them.

    Raises:
        InputError: the file is damaged.
        PluginError: the library for E57 is missing.
    """
    pye57 = load_library("pye57", path)
    with reading(path, FORMAT), pye57.E57(str(path)) as file:
        root = file.image_file.root()
        if not root.isDefined("images2D"):
            return E57ImageCount()
        nodes = [pye57.libe57.StructureNode(node) for node in _children(root["images2D"])]
        n_posed = sum(
            node.isDefined("pose")
            and any(node.isDefined(f"{kind}Representation") for kind in ("pinhole", "spherical"))
            for node in nodes
        )
        return E57ImageCount(n_images=len(nodes), n_posed=n_posed)


def _children(vector: Any) -> Iterator[Any]:
    return (vector.get(index) for index in range(vector.childCount()))


def _image(path: Path, index: int, node: Any) -> Iterator[E57Image]:
    """Yield the photo of an image node; nothing if the node has no JPEG or PNG data."""
    for kind in _REPRESENTATIONS:
        field = f"{kind}Representation"
        shown = node[field] if node.isDefined(field) else None
        for content, suffix in _CONTENTS.items():
            if shown is not None and shown.isDefined(content):
                name = _name(path, index, node, suffix)
                camera = _camera(path, name, node, kind, shown)
                yield E57Image(name=name, content=_content(path, shown[content]), camera=camera)
                return


def _is_whole(shown: Any) -> bool:
    """Return whether a spherical image covers the whole sphere, to within half a pixel."""
    width, height, across, up = (
        number_of(shown[name])
        for name in ("imageWidth", "imageHeight", "pixelWidth", "pixelHeight")
    )
    return (
        abs(width * across - 2.0 * math.pi) < 0.5 * across and abs(height * up - math.pi) < 0.5 * up
    )


def _name(path: Path, index: int, node: Any, suffix: str) -> str:
    stated = str(node["name"].value()) if node.isDefined("name") else ""
    bare = _UNUSUAL.sub("_", stated.removesuffix(suffix)).strip("_.")[:60]
    return f"{path.stem}_{index:03d}{'_' if bare else ''}{bare}{suffix}"


def _content(path: Path, blob: Any) -> bytes:
    count = int(blob.byteCount())
    if not 0 < count <= path.stat().st_size:
        raise InputError(f"{path.name} is damaged: it declares a photo of {count} bytes")
    content = bytearray(count)
    blob.read(content, 0, count)
    return bytes(content)


def _camera(path: Path, name: str, node: Any, kind: str, shown: Any) -> GivenCamera:
    if kind == "visualReference":
        return GivenCamera(
            name=name, reason="the E57 file contains it only for reference, without a pose"
        )
    if kind == "cylindrical":
        return GivenCamera(
            name=name, reason=f"it is a {kind} image, which cannot be used for orthoimages"
        )
    if not node.isDefined("pose"):
        return GivenCamera(name=name, reason="the E57 file contains no pose for it")
    world_from_camera, centre = pose_of(node)
    if kind == "spherical":
        if not _is_whole(shown):
            reason = "it is a part of a panorama; only full panoramas can be used"
            return GivenCamera(name=name, reason=reason)
        width, height = (round(number_of(shown[field])) for field in ("imageWidth", "imageHeight"))
        rotation: NDArray[np.float64] = _FROM_PANORAMA @ world_from_camera.T
        return GivenCamera(
            name=name,
            lens=PanoramaLens(width=width, height=height),
            rotation=rotation,
            translation=-rotation @ centre,
        )
    values = {field: number_of(shown[field]) for field in _PINHOLE}
    if not all(math.isfinite(value) for value in values.values()) or not all(
        values[field] > 0.0 for field in ("focalLength", "pixelWidth", "pixelHeight")
    ):
        raise InputError(f"{path.name}: the lens of photo {name} is invalid: {values}")
    rotation = _FROM_Y_UP @ world_from_camera.T
    return GivenCamera(
        name=name,
        lens=Intrinsics(
            width=round(values["imageWidth"]),
            height=round(values["imageHeight"]),
            fx=values["focalLength"] / values["pixelWidth"],
            fy=values["focalLength"] / values["pixelHeight"],
            cx=values["principalPointX"],
            cy=values["principalPointY"],
            source="given",
        ),
        rotation=rotation,
        translation=-rotation @ centre,
    )
