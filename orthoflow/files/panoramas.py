"""Panoramas over the whole sphere as photos of a cube's faces, which every method can take.

Directions in a panorama are x forwards (the middle of the picture), y to the left and z up; columns
count azimuth clockwise seen from above, rows elevation downwards, as ASTM E2807 has them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import InputError
from orthoflow.files.images import decode_levels, encode_png
from orthoflow.geometry.levels import Colours
from orthoflow.geometry.opencv_border import HALF_PIXEL
from orthoflow.products import Intrinsics

# Rows: right, down and forwards of each face, in the directions of the panorama.
FACES: Final[Mapping[str, NDArray[np.float64]]] = {
    "front": np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]),
    "left": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    "back": np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]]),
    "right": np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0]]),
    "up": np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
    "down": np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]),
}
# From the axes of a camera that looks forwards: x right, y down, z forward.
PANORAMA_FROM_CAMERA: Final = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
# What OpenCV can look up.
MOST_PX: Final = 32_766


def face_lens(width: int) -> Intrinsics:
    """Lens of the faces of a panorama with so many columns: as fine in the middle of a face."""
    focal_px = width / (2.0 * math.pi)
    side = max(1, round(2.0 * focal_px))
    return Intrinsics(
        width=side,
        height=side,
        fx=0.5 * side,
        fy=0.5 * side,
        cx=0.5 * side,
        cy=0.5 * side,
        source="given",
    )


def face_rays(lens: Intrinsics) -> NDArray[np.float64]:
    """Directions (height, width, 3) of the pixels of a face, z = 1, in the axes of its camera."""
    right = (np.arange(lens.width) + 0.5 - lens.cx) / lens.fx
    down = (np.arange(lens.height) + 0.5 - lens.cy) / lens.fy
    across, along = np.meshgrid(right, down)
    return np.stack([across, along, np.ones_like(across)], axis=-1)


@dataclass(frozen=True, kw_only=True)
class PanoramaFace:
    """A face of a panorama as a photo.

    Attributes:
        name: of the photo.
        panorama: the panorama's file, as it is.
        face: which of `FACES`.
        width: columns of the panorama.
        used: mask of the panorama (rows, columns), True where it may be used; None: all.
    """

    name: str
    panorama: bytes
    face: str
    width: int
    used: NDArray[np.bool_] | None = None

    @property
    def lens(self) -> Intrinsics:
        """Its lens, which is exact."""
        return face_lens(self.width)

    def encoded(self) -> bytes:
        """The photo as a PNG file."""
        return encode_png(face_picture(decode_levels(self.panorama, self.name), self.face))

    def mask(self) -> NDArray[np.bool_] | None:
        """Which pixels (height, width) may be used; None where all may."""
        if self.used is None:
            return None
        whole = face_picture(np.where(self.used, np.uint8(255), np.uint8(0)), self.face)
        used: NDArray[np.bool_] = whole == np.uint8(255)
        return None if used.all() else used


def faces_of(
    panorama: bytes, stem: str, width: int, used: NDArray[np.bool_] | None = None
) -> tuple[PanoramaFace, ...]:
    """Give the faces of a panorama as photos `<stem>_<face>.png`.

    Args:
        panorama: the file's bytes.
        stem: of its name.
        width: columns.
        used: mask of the panorama (rows, columns), True where it may be used; None: all.

    Raises:
        InputError: it has more columns than can be looked up.
    """
    if not 1 <= width <= MOST_PX:
        raise InputError(f"panorama {stem} has {width} columns, at most {MOST_PX} can be read")
    return tuple(
        PanoramaFace(
            name=face_name(stem, face), panorama=panorama, face=face, width=width, used=used
        )
        for face in FACES
    )


def face_name(stem: str, face: str) -> str:
    """Name of the photo that a panorama's face becomes."""
    return f"{stem}_{face}.png"


def face_in(name: str) -> tuple[str, str] | None:
    """Stem and face in the name of a photo that may be a face; None where it is none."""
    stem, _, face = name.removesuffix(".png").rpartition("_")
    return (stem, face) if stem and face in FACES and name == face_name(stem, face) else None


def face_picture(panorama: Colours, name: str) -> Colours:
    """Look a face up in a panorama (rows, columns[, 3]), between its pixels linearly, as deep."""
    import cv2

    height, width = panorama.shape[:2]
    lens = face_lens(width)
    rays = face_rays(lens) @ FACES[name]
    azimuth = np.arctan2(rays[..., 1], rays[..., 0])
    elevation = np.arctan2(rays[..., 2], np.hypot(rays[..., 0], rays[..., 1]))
    # OpenCV counts from the centre of the first pixel.
    columns = width * (0.5 - azimuth / (2.0 * math.pi)) - HALF_PIXEL
    rows = height * (0.5 - elevation / math.pi) - HALF_PIXEL
    # Left of the first column is the last; above the first row nothing is nearer than that row.
    framed = np.concatenate([panorama[:, -1:], panorama, panorama[:, :1]], axis=1)
    looked_up = cv2.remap(
        framed,
        (columns + 1.0).astype(np.float32),
        rows.astype(np.float32),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return np.asarray(looked_up, dtype=panorama.dtype)
