"""Conversion of panoramas and fisheye photos to photos of cube faces, which all methods can use.

The fisheye model is OpenCV's (`cv2.fisheye`; Kannala and Brandt 2006): the image of a point at the
angle theta from the axis is theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8) focal
lengths from the principal point. Metashape's model also has tangential terms and skew. In a
panorama, columns are azimuths, clockwise as seen from above, and rows are elevations, from top to
bottom, as in ASTM E2807; the camera looks at the centre of the image.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import InputError
from orthoflow.files.images import decode_levels, encode_png
from orthoflow.files.photo_files import MOST_PIXELS
from orthoflow.geometry.cameras import HALF_PIXEL
from orthoflow.geometry.levels import Colours
from orthoflow.products import Intrinsics

# Rows: right, down and forward vectors of each face in camera axes (x right, y down, z forward).
FACES: Final[Mapping[str, NDArray[np.float64]]] = {
    "front": np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
    "left": np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]),
    "back": np.array([[-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]]),
    "right": np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]),
    "up": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
    "down": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
}
# Limit of OpenCV's remap.
#: columns of a panorama; columns and rows of a fisheye photo and its faces
MOST_PX: Final = 32_766
WIDEST_DEG: Final = 180.0
_FULL_TURN_DEG: Final = 360.0
# Directions sampled per side of a face to find the part that the lens sees.
_TRIED: Final = 65
# A face with less than this share of the largest face's visible area is omitted.
_LEAST_SHARE: Final = 0.02
_ANGLES_TRIED: Final = 2000


def face_rays(lens: Intrinsics) -> NDArray[np.float64]:
    """Return directions (height, width, 3) of a face's pixels in the axes of the face; z is 1."""
    right = (np.arange(lens.width) + 0.5 - lens.cx) / lens.fx
    down = (np.arange(lens.height) + 0.5 - lens.cy) / lens.fy
    across, along = np.meshgrid(right, down)
    return np.stack([across, along, np.ones_like(across)], axis=-1)


def face_in(name: str) -> tuple[str, str] | None:
    """Split the photo name of a cube face into its stem and the face; return None for other names.

    >>> face_in("hall_left.png"), face_in("left.png")
    (('hall', 'left'), None)
    """
    stem, _, face = name.removesuffix(".png").rpartition("_")
    return (stem, face) if stem and face in FACES and name.endswith(".png") else None


@dataclass(frozen=True, kw_only=True)
class PanoramaLens:
    """The lens of a panorama that covers the whole sphere, in orthoflow's pixel coordinates."""

    width: int
    height: int

    def project(self, rays_camera: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return pixels (..., 2) of directions (..., 3)."""
        x, y, z = np.moveaxis(rays_camera, -1, 0)
        u = self.width * (0.5 + np.arctan2(x, z) / (2.0 * math.pi))
        v = self.height * (0.5 + np.arctan2(y, np.hypot(x, z)) / math.pi)
        return np.stack([u, v], axis=-1)

    def sees(self, pixels: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return which pixels (..., 2) are inside the image, i.e. are finite."""
        return np.asarray(np.isfinite(pixels).all(axis=-1))


@dataclass(frozen=True, kw_only=True)
class FisheyeLens:
    """A fisheye lens, in orthoflow's pixel coordinates (first pixel centre at (0.5, 0.5)).

    Attributes:
        width: image width in pixels.
        height: image height in pixels.
        fx: focal length along u in pixels.
        fy: focal length along v in pixels.
        cx: principal point along u in pixels.
        cy: principal point along v in pixels.
        radial: coefficients k1, k2, k3, k4.
        tangential: coefficients p1, p2, applied to the undistorted direction.
        skew: shift along u, in pixels, per unit along v.
        field_of_view_deg: full angle covered by the lens; photos are not used outside it.
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
            # Undistorted direction; it is zero on the axis.
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
        """Return which pixels (..., 2) are inside the image; NaN is outside."""
        u, v = pixels[..., 0], pixels[..., 1]
        return (u >= 0.0) & (u < self.width) & (v >= 0.0) & (v < self.height)

    @property
    def limit_rad(self) -> float:
        """Return the largest angle from the axis at which the lens is used."""
        return min(math.radians(0.5 * self.field_of_view_deg), _fold_rad(self.radial))

    def finest_px(self, theta_rad: float) -> float:
        """Return the higher of radial and tangential resolution at an angle, in px/rad."""
        theta = min(theta_rad, self.limit_rad)
        around = _bent(self, theta) / math.sin(theta) if theta > 0.0 else 1.0
        with np.errstate(all="ignore"):
            along = float(_growth(self.radial, np.array(theta)))
        return max(self.fx, self.fy) * max(along, around)


WideLens: TypeAlias = FisheyeLens | PanoramaLens


def problem_of(lens: WideLens) -> str:
    """Return why a lens is invalid, or "" if it is valid."""
    if isinstance(lens, PanoramaLens):
        is_valid = 1 <= lens.width <= MOST_PX
        return "" if is_valid else f"it has {lens.width} columns; the limit is {MOST_PX}"
    return _problem_of_numbers(lens) or _problem_of_faces(lens)


def _problem_of_numbers(lens: FisheyeLens) -> str:
    values = (lens.fx, lens.fy, lens.cx, lens.cy, lens.skew, *lens.radial, *lens.tangential)
    if not all(map(math.isfinite, values)) or min(lens.fx, lens.fy) <= 0.0:
        return (
            f"its parameters must be finite and its focal lengths positive, got {lens.fx:g} and "
            f"{lens.fy:g}"
        )
    if not (1 <= lens.width <= MOST_PX and 1 <= lens.height <= MOST_PX):
        return (
            f"it has {lens.width} x {lens.height} pixels; the limit is {MOST_PX} columns and rows"
        )
    if not 0.0 < lens.field_of_view_deg < _FULL_TURN_DEG:
        return f"its field of view is {lens.field_of_view_deg:g} degrees, not between 0 and 360"
    return ""


def _problem_of_faces(lens: FisheyeLens) -> str:
    fold = _fold_rad(lens.radial)
    # Distance of the farthest corner from the principal point, in focal lengths.
    across = max(lens.cx, lens.width - lens.cx) / lens.fx
    down = max(lens.cy, lens.height - lens.cy) / lens.fy
    is_inside = _bent(lens, fold) < math.hypot(across, down)
    if fold < math.radians(0.5 * lens.field_of_view_deg) and is_inside:
        return (
            f"its distortion is not monotonic beyond {math.degrees(fold):.1f} degrees from the "
            "axis, inside the image, so two directions share a pixel"
        )
    finest = max(lens.finest_px(0.0), lens.finest_px(0.5 * math.pi))
    if not finest < MOST_PX:
        return f"it has {finest:.0f} pixels per radian; the limit is {MOST_PX}"
    faces = face_lenses(lens)
    large = [
        face
        for face in faces.values()
        if max(face.width, face.height) > MOST_PX or face.width * face.height > MOST_PIXELS
    ]
    if large:
        return f"its faces would be too large: {large[0].width} x {large[0].height} pixels"
    return "" if faces else "it shows no direction inside the image"


def _radial(radial: tuple[float, ...], theta: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the ratio of distorted to undistorted angle."""
    k1, k2, k3, k4 = radial
    t2 = theta * theta
    return 1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))


def _growth(radial: tuple[float, ...], theta: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the derivative of the distorted angle with respect to the undistorted one."""
    k1, k2, k3, k4 = radial
    t2 = theta * theta
    return 1.0 + t2 * (3.0 * k1 + t2 * (5.0 * k2 + t2 * (7.0 * k3 + t2 * 9.0 * k4)))


@cache
def _fold_rad(radial: tuple[float, ...]) -> float:
    """Return the angle at which the distorted angle stops increasing; pi if it never does."""
    angles = np.linspace(0.0, math.pi, _ANGLES_TRIED)
    with np.errstate(all="ignore"):
        # The comparison is negated so that NaN counts as not increasing.
        stops = ~(_growth(radial, angles) > 0.0)
    return float(angles[max(int(np.argmax(stops)) - 1, 0)]) if stops.any() else math.pi


def _bent(lens: FisheyeLens, theta_rad: float) -> float:
    with np.errstate(all="ignore"):
        return theta_rad * float(_radial(lens.radial, np.array(theta_rad)))


@cache
def face_lenses(lens: WideLens) -> Mapping[str, Intrinsics]:
    """Return the lenses of the faces that a lens sees, each cropped to the visible part.

    At its centre, a face of a panorama has the resolution of the panorama.
    """
    if isinstance(lens, PanoramaLens):
        side = max(1, round(lens.width / math.pi))
        return dict.fromkeys(FACES, _lens_of_face(side, (0, side, 0, side)))
    steps = np.linspace(-1.0, 1.0, _TRIED)
    right, down = np.meshgrid(steps, steps)
    rays = np.stack([right, down, np.ones_like(right)], axis=-1)
    shown = {face: lens.sees(lens.project(rays @ axes)) for face, axes in FACES.items()}
    most = max(float(seen.mean()) for seen in shown.values())
    return {
        face: _cut(lens, face, seen)
        for face, seen in shown.items()
        if seen.any() and seen.mean() >= _LEAST_SHARE * most
    }


def _lens_of_face(side: int, ends: tuple[int, int, int, int]) -> Intrinsics:
    """Return the lens of a part of a face; `ends` is left, right, top and bottom in pixels."""
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


def _cut(lens: FisheyeLens, face: str, seen: NDArray[np.bool_]) -> Intrinsics:
    """Return the lens of the part of a face that contains all visible directions, plus a margin.

    At its centre, the face has the resolution of the photo.
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
    return _lens_of_face(side, (ends[0], ends[1], ends[2], ends[3]))


@dataclass(frozen=True, kw_only=True)
class CubeFace:
    """A face of the cube around a panorama or fisheye camera, as a photo.

    Attributes:
        name: photo name of the face.
        photo: unmodified content of the wide photo's file.
        face: key of `FACES`.
        lens: lens of the face, without distortion.
        whole: lens of the wide photo.
        used: mask of the wide photo (rows, columns), True for usable pixels; None for all.
    """

    name: str
    photo: bytes
    face: str
    lens: Intrinsics
    whole: WideLens
    used: NDArray[np.bool_] | None = None

    def encoded(self) -> bytes:
        """Return the face as a PNG file, black outside the wide photo's field of view."""
        return encode_png(self.picture(decode_levels(self.photo, self.name)))

    def mask(self) -> NDArray[np.bool_] | None:
        """Return the usable pixels (height, width) of the face; None for all."""
        seen = self.whole.sees(self._pixels())
        if self.used is not None:
            used = self.picture(np.where(self.used, np.uint8(255), np.uint8(0)))
            seen &= used == np.uint8(255)
        return None if seen.all() else seen

    def picture(self, whole: Colours) -> Colours:
        """Resample the face from the wide photo (rows, columns[, 3]), bilinearly."""
        import cv2

        pixels = self._pixels()
        seen = self.whole.sees(pixels)
        if isinstance(self.whole, PanoramaLens):
            # Add a column on each side, copied from the opposite side.
            whole = np.concatenate([whole[:, -1:], whole, whole[:, :1]], axis=1)
            pixels[..., 0] += 1.0
        pixels[~seen] = 0.0
        # In OpenCV, the centre of the first pixel is (0, 0).
        u, v = np.moveaxis((pixels - HALF_PIXEL).astype(np.float32), -1, 0)
        found = cv2.remap(whole, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        found[~seen] = 0
        return np.asarray(found, dtype=whole.dtype)

    def _pixels(self) -> NDArray[np.float64]:
        """Return the positions (height, width, 2) of the face's pixels in the wide photo."""
        return self.whole.project(face_rays(self.lens) @ FACES[self.face])


def faces_of(
    photo: bytes, stem: str, lens: WideLens, used: NDArray[np.bool_] | None = None
) -> tuple[CubeFace, ...]:
    """Return the visible cube faces of a wide photo, named `<stem>_<face>.png`.

    Args:
        photo: content of the file.
        stem: file name without suffix.
        lens: lens of the photo.
        used: mask of the photo (height, width), True for usable pixels; None for all.

    Raises:
        InputError: the lens is invalid.
    """
    problem = problem_of(lens)
    if problem:
        raise InputError(f"the lens of photo {stem} is invalid: {problem}")
    return tuple(
        CubeFace(name=f"{stem}_{face}.png", photo=photo, face=face, lens=own, whole=lens, used=used)
        for face, own in face_lenses(lens).items()
    )
