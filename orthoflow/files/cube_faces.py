"""Panoramas and fisheye photos converted to photos of the faces of a cube, for all methods.

A fisheye is OpenCV's (`cv2.fisheye`; Kannala and Brandt 2006): a point theta off the axis is seen
theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8) focal lengths from the principal
point. Metashape's also has tangential terms and a skew. Directions in a panorama are x forwards
(the centre of the picture), y to the left and z up; columns count azimuth clockwise seen from
above, rows elevation downwards, as in ASTM E2807.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import InputError
from orthoflow.files.images import decode_levels, encode_png
from orthoflow.files.photo_files import MOST_PIXELS
from orthoflow.geometry.cameras import HALF_PIXEL
from orthoflow.geometry.levels import Colours
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
# Limit of OpenCV's remap.
#: columns of a panorama; columns and rows of a fisheye photo and its faces
MOST_PX: Final = 32_766


def face_lens(width: int) -> Intrinsics:
    """Return the lens of the faces of a panorama, with equal resolution at the centre of a face."""
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
    """Return directions (height, width, 3) of the pixels of a face, z = 1, in camera axes."""
    right = (np.arange(lens.width) + 0.5 - lens.cx) / lens.fx
    down = (np.arange(lens.height) + 0.5 - lens.cy) / lens.fy
    across, along = np.meshgrid(right, down)
    return np.stack([across, along, np.ones_like(across)], axis=-1)


def faces_of(
    panorama: bytes, stem: str, width: int, used: NDArray[np.bool_] | None = None
) -> tuple[CubeFace, ...]:
    """Return the faces of a panorama as photos `<stem>_<face>.png`.

    Args:
        panorama: the file's bytes.
        stem: stem of its name.
        width: columns.
        used: mask of the panorama (rows, columns), True where it may be used; None: all.

    Raises:
        InputError: it has too many columns.
    """
    if not 1 <= width <= MOST_PX:
        raise InputError(f"panorama {stem} has {width} columns, at most {MOST_PX} can be read")
    lens = face_lens(width)
    return tuple(
        CubeFace(name=face_name(stem, face), photo=panorama, face=face, lens=lens, used=used)
        for face in FACES
    )


def face_name(stem: str, face: str) -> str:
    """Return the name of the photo of a panorama's face."""
    return f"{stem}_{face}.png"


def face_in(name: str) -> tuple[str, str] | None:
    """Return stem and face of the name of a photo that may be a face; None if it is not."""
    stem, _, face = name.removesuffix(".png").rpartition("_")
    return (stem, face) if stem and face in FACES and name == face_name(stem, face) else None


def face_picture(panorama: Colours, name: str) -> Colours:
    """Resample a face from a panorama (rows, columns[, 3]) by bilinear interpolation, as deep."""
    import cv2

    height, width = panorama.shape[:2]
    lens = face_lens(width)
    rays = face_rays(lens) @ FACES[name]
    azimuth = np.arctan2(rays[..., 1], rays[..., 0])
    elevation = np.arctan2(rays[..., 2], np.hypot(rays[..., 0], rays[..., 1]))
    # OpenCV counts from the centre of the first pixel.
    columns = width * (0.5 - azimuth / (2.0 * math.pi)) - HALF_PIXEL
    rows = height * (0.5 - elevation / math.pi) - HALF_PIXEL
    # The last column is left of the first; above the first row, that row is repeated.
    framed = np.concatenate([panorama[:, -1:], panorama, panorama[:, :1]], axis=1)
    looked_up = cv2.remap(
        framed,
        (columns + 1.0).astype(np.float32),
        rows.astype(np.float32),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return np.asarray(looked_up, dtype=panorama.dtype)


WIDEST_DEG: Final = 180.0
_FULL_TURN_DEG: Final = 360.0
# Rows: right, down and forwards of each face, in the axes of the camera.
FACE_FROM_CAMERA: Final[Mapping[str, NDArray[np.float64]]] = {
    face: axes @ PANORAMA_FROM_CAMERA for face, axes in FACES.items()
}
# Directions per side used to find the part of a face that the lens sees.
_TRIED: Final = 65
# A face that shows less than this share of the largest one is omitted.
_LEAST_SHARE: Final = 0.02
_ANGLES_TRIED: Final = 2000


@dataclass(frozen=True, kw_only=True)
class FisheyeLens:
    """A fisheye lens; pixels as ours, the first one's centre at (0.5, 0.5).

    Attributes:
        width: pixels.
        height: pixels.
        fx: focal length in pixels along u; fy along v.
        cx: principal point in pixels; cy along v.
        radial: k1, k2, k3, k4.
        tangential: p1, p2, applied to the undistorted direction.
        skew: pixels along u per unit along v.
        field_of_view_deg: the full angle that the lens shows; photos are not used beyond it.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    radial: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)
    tangential: tuple[float, ...] = (0.0, 0.0)
    skew: float = 0.0
    field_of_view_deg: float = WIDEST_DEG

    def project(self, rays_camera: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return pixels (..., 2) of directions (..., 3); NaN beyond the field of view."""
        x, y, z = np.moveaxis(rays_camera, -1, 0)
        across = np.hypot(x, y)
        theta = np.arctan2(across, z)
        with np.errstate(all="ignore"):
            # Undistorted; straight ahead it is zero.
            scale = np.where(across > 0.0, theta / np.where(across > 0.0, across, 1.0), 0.0)
            a, b = x * scale, y * scale
            radial, (p1, p2) = _radial(self.radial, theta), self.tangential
            r2 = theta * theta
            bent_a = a * radial + 2.0 * p1 * a * b + p2 * (r2 + 2.0 * a * a)
            bent_b = b * radial + p1 * (r2 + 2.0 * b * b) + 2.0 * p2 * a * b
        pixels = np.stack(
            [self.fx * bent_a + self.skew * bent_b + self.cx, self.fy * bent_b + self.cy], axis=-1
        )
        pixels[theta > self.limit_rad] = np.nan
        return pixels

    def sees(self, pixels: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Report which pixels (..., 2) lie inside the image; NaN does not."""
        u, v = pixels[..., 0], pixels[..., 1]
        return (u >= 0.0) & (u < self.width) & (v >= 0.0) & (v < self.height)

    @property
    def limit_rad(self) -> float:
        """Return the angle off the axis up to which the lens is used."""
        return min(math.radians(0.5 * self.field_of_view_deg), _fold_rad(self.radial))

    def finest_px(self, theta_rad: float) -> float:
        """Return the maximum number of pixels per radian within a right angle off the axis."""
        theta = min(theta_rad, self.limit_rad)
        around = _bent(self, theta) / math.sin(theta) if theta > 0.0 else 1.0
        with np.errstate(all="ignore"):
            along = float(_growth(self.radial, np.array(theta)))
        return max(self.fx, self.fy) * max(along, around)


def problem_of(lens: FisheyeLens) -> str:
    """Return why a lens is invalid, or "" if it is valid."""
    return _problem_of_numbers(lens) or _problem_of_faces(lens)


def _problem_of_numbers(lens: FisheyeLens) -> str:
    values = (lens.fx, lens.fy, lens.cx, lens.cy, lens.skew, *lens.radial, *lens.tangential)
    if not all(map(math.isfinite, values)) or min(lens.fx, lens.fy) <= 0.0:
        return f"focal length {lens.fx:g}, {lens.fy:g}"
    if not (1 <= lens.width <= MOST_PX and 1 <= lens.height <= MOST_PX):
        return f"a photo of 1 to {MOST_PX} columns and rows is expected"
    if not 0.0 < lens.field_of_view_deg < _FULL_TURN_DEG:
        return f"a field of view of {lens.field_of_view_deg:g} degrees, expected one below 360"
    return ""


def _problem_of_faces(lens: FisheyeLens) -> str:
    fold = _fold_rad(lens.radial)
    if fold < math.radians(0.5 * lens.field_of_view_deg) and _bent(lens, fold) < _farthest(lens):
        return (
            f"it folds back {math.degrees(fold):.1f} degrees off the axis, inside the image, so "
            "that two directions share a pixel"
        )
    finest = max(lens.finest_px(0.0), lens.finest_px(0.5 * math.pi))
    if not finest < MOST_PX:
        return f"{finest:.0f} pixels per radian, at most {MOST_PX} are taken"
    faces = face_lenses(lens)
    large = [face for face in faces.values() if not _is_small(face)]
    if large:
        return f"its faces would have {large[0].width} x {large[0].height} pixels"
    return "" if faces else "it shows nothing inside the image"


def _is_small(face: Intrinsics) -> bool:
    return max(face.width, face.height) <= MOST_PX and face.width * face.height <= MOST_PIXELS


def _radial(radial: tuple[float, ...], theta: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the ratio of distorted to undistorted angle."""
    k1, k2, k3, k4 = radial
    t2 = theta * theta
    return 1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))


def _growth(radial: tuple[float, ...], theta: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the derivative of the distorted by the undistorted angle."""
    k1, k2, k3, k4 = radial
    t2 = theta * theta
    return 1.0 + t2 * (3.0 * k1 + t2 * (5.0 * k2 + t2 * (7.0 * k3 + t2 * 9.0 * k4)))


@cache
def _fold_rad(radial: tuple[float, ...]) -> float:
    """Angle off the axis where a lens model stops increasing; a straight angle if never."""
    angles = np.linspace(0.0, math.pi, _ANGLES_TRIED)
    with np.errstate(all="ignore"):
        # Written as a negated comparison, so that NaN fails it.
        stops = ~(_growth(radial, angles) > 0.0)
    return float(angles[max(int(np.argmax(stops)) - 1, 0)]) if stops.any() else math.pi


def _bent(lens: FisheyeLens, theta_rad: float) -> float:
    with np.errstate(all="ignore"):
        return theta_rad * float(_radial(lens.radial, np.array(theta_rad)))


def _farthest(lens: FisheyeLens) -> float:
    """Return the distance of the farthest corner from the principal point, in focal lengths."""
    across = max(lens.cx, lens.width - lens.cx) / lens.fx
    down = max(lens.cy, lens.height - lens.cy) / lens.fy
    return math.hypot(across, down)


@cache
def face_lenses(lens: FisheyeLens) -> Mapping[str, Intrinsics]:
    """Return lenses of the faces that a fisheye shows, each cropped to the visible part."""
    steps = np.linspace(-1.0, 1.0, _TRIED)
    right, down = np.meshgrid(steps, steps)
    rays = np.stack([right, down, np.ones_like(right)], axis=-1)
    shown = {face: lens.sees(lens.project(rays @ axes)) for face, axes in FACE_FROM_CAMERA.items()}
    most = max(float(seen.mean()) for seen in shown.values())
    return {
        face: _cut(lens, face, seen)
        for face, seen in shown.items()
        if seen.any() and seen.mean() >= _LEAST_SHARE * most
    }


def _cut(lens: FisheyeLens, face: str, seen: NDArray[np.bool_]) -> Intrinsics:
    """Lens of the part of a face between the outermost visible directions, with a margin.

    A face has the resolution of the photo at its centre, so that nothing is lost there.
    """
    off_axis = 0.0 if face == "front" else 0.5 * math.pi
    side = max(1, round(2.0 * lens.finest_px(off_axis)))
    ends = []
    for axis in (0, 1):
        there = np.flatnonzero(seen.any(axis=axis))
        first, last = int(there[0]) - 1, int(there[-1]) + 1
        ends += [
            max(0, math.floor(side * first / (_TRIED - 1))),
            min(side, math.ceil(side * last / (_TRIED - 1))),
        ]
    left, right, top, bottom = ends
    return Intrinsics(
        width=right - left,
        height=bottom - top,
        fx=0.5 * side,
        fy=0.5 * side,
        cx=0.5 * side - left,
        cy=0.5 * side - top,
        source="given",
    )


@dataclass(frozen=True, kw_only=True)
class CubeFace:
    """A face of a cube around a panorama or a fisheye's photo, as a photo.

    Attributes:
        name: name of the photo.
        photo: the file of the whole, unmodified.
        face: which of `FACES`.
        lens: its lens, which is exact.
        fisheye: lens of the whole; None for a panorama.
        used: mask of the whole (rows, columns), True where it may be used; None: all.
    """

    name: str
    photo: bytes
    face: str
    lens: Intrinsics
    fisheye: FisheyeLens | None = None
    used: NDArray[np.bool_] | None = None

    def encoded(self) -> bytes:
        """Return the photo as a PNG file, black where the whole shows nothing."""
        return encode_png(self._looked_up(decode_levels(self.photo, self.name)))

    def mask(self) -> NDArray[np.bool_] | None:
        """Return which pixels (height, width) may be used; None if all may."""
        seen = np.ones((self.lens.height, self.lens.width), dtype=np.bool_)
        if self.fisheye is not None:
            seen = self.fisheye.sees(self._pixels(self.fisheye))
        if self.used is not None:
            whole = self._looked_up(np.where(self.used, np.uint8(255), np.uint8(0)))
            seen &= whole == np.uint8(255)
        return None if seen.all() else seen

    def _pixels(self, fisheye: FisheyeLens) -> NDArray[np.float64]:
        """Return pixels of the fisheye (height, width, 2) of those of the face."""
        return fisheye.project(face_rays(self.lens) @ FACE_FROM_CAMERA[self.face])

    def _looked_up(self, photo: Colours) -> Colours:
        """Resample the face from the whole by bilinear interpolation."""
        import cv2

        if self.fisheye is None:
            return face_picture(photo, self.face)
        pixels = self._pixels(self.fisheye)
        pixels[~self.fisheye.sees(pixels)] = np.nan
        # OpenCV counts from the centre of the first pixel; NaN would be sampled anywhere.
        u, v = np.moveaxis(np.nan_to_num(pixels - HALF_PIXEL).astype(np.float32), -1, 0)
        looked_up = cv2.remap(photo, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        looked_up[np.isnan(pixels[..., 0])] = 0
        return np.asarray(looked_up, dtype=photo.dtype)


def fisheye_faces(
    photo: bytes, stem: str, lens: FisheyeLens, used: NDArray[np.bool_] | None = None
) -> tuple[CubeFace, ...]:
    """Return the visible parts of a fisheye photo as photos `<stem>_<face>.png`.

    Args:
        photo: the file's bytes.
        stem: stem of its name.
        lens: its lens.
        used: mask of the photo (height, width), True where it may be used; None: all.

    Raises:
        InputError: the lens is invalid.
    """
    problem = problem_of(lens)
    if problem:
        raise InputError(f"the fisheye lens of photo {stem} is none: {problem}")
    return tuple(
        CubeFace(
            name=face_name(stem, face), photo=photo, face=face, lens=own, fisheye=lens, used=used
        )
        for face, own in face_lenses(lens).items()
    )
