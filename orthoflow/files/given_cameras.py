"""Orientations of photos from other programs, converted from their conventions into ours.

The results have our axes (x right, y down, z forward) and our pixels (first centre at 0.5, 0.5), in
the world of the file. `camera_formats` chooses the reader.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import InputError
from orthoflow.files.cube_faces import (
    FACE_FROM_CAMERA,
    FACES,
    PANORAMA_FROM_CAMERA,
    FisheyeLens,
    face_lenses,
    face_name,
    problem_of,
)
from orthoflow.files.photo_files import MOST_PIXELS
from orthoflow.products import Intrinsics
from orthoflow.untrusted_text import open_text, reading, text_of_file

# Limits for models with the observations of each photo, which are read line by line, and for other
# files.
#: bytes of a file of a COLMAP model, or Bundler's
MOST_MODEL_BYTES: Final = 500_000_000
#: bytes of a file of cameras (`cameras.json`, Metashape's XML, RealityCapture's list)
MOST_BYTES: Final = 50_000_000
#: characters of a line of a file of cameras
MOST_LINE: Final = 20_000_000
_WHAT: Final = "a file of cameras"
#: cameras of one file
MOST_CAMERAS: Final = 100_000
_LONGEST_NUMBER: Final = 12
_ORTHONORMAL: Final = 1e-4
# A lens this close to another one is equivalent for any matcher; beyond the other limit its error
# is visible in an orthoimage.
NEGLIGIBLE_PX: Final = 0.05
#: error in pixels of what a file of cameras states and cannot be represented
MAX_LEFT_OUT_PX: Final = 0.5
_FEWEST_DIRECTIONS: Final = 30
_FAR_PX: Final = 1e4
_WIDEST_FITTED_DEG: Final = 355.0


@dataclass(frozen=True, kw_only=True)
class CentredLens:
    """A lens whose file does not state the photo's size, and counts from the photo's centre.

    Attributes:
        focal_px: focal length in pixels, or None if it is relative to the photo's longer side.
        focal_share: focal length as a share of the photo's longer side, or None.
        off_middle: principal point from the middle, right and down, in shares of that side.
        radial: k1, k2, k3, k4.
        tangential: two terms whose order and signs the file does not define; they are omitted.
    """

    focal_px: float | None = None
    focal_share: float | None = None
    off_middle: tuple[float, float] = (0.0, 0.0)
    radial: tuple[float, ...]
    tangential: tuple[float, ...] = (0.0, 0.0)

    def of_size(self, width: int, height: int) -> tuple[Intrinsics | FisheyeLens, float]:
        """Lens for a photo of this size, and the largest omitted distortion in pixels."""
        longest = max(width, height)
        focal = self.focal_px or (self.focal_share or 0.0) * longest
        k1, k2, k3, k4 = (*self.radial, 0.0, 0.0)[:4]
        plain = Intrinsics(
            width=width,
            height=height,
            fx=focal,
            fy=focal,
            cx=0.5 * width + self.off_middle[0] * longest,
            cy=0.5 * height + self.off_middle[1] * longest,
            distortion=(k1, k2, 0.0, 0.0, k3),
            source="given",
        )
        corner2 = (width * width + height * height) / (4.0 * focal * focal)
        left_out_px = 3.0 * focal * corner2 * math.hypot(*self.tangential)
        if not k4:
            return plain, left_out_px
        xy = normalised_grid(plain)
        r2 = (xy * xy).sum(axis=1, keepdims=True)
        bent = xy * (1.0 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4))))
        rays = np.column_stack([xy, np.ones(len(xy))])
        lens, worst_px = nearest_lens(plain, rays, focal * bent + [plain.cx, plain.cy])
        return lens, worst_px + left_out_px


@dataclass(frozen=True, kw_only=True)
class GivenCamera:
    """The orientation of one photo as in a file.

    Attributes:
        name: name of the photo, with the folders that the file states, separated by slashes; some
            programs omit its suffix.
        lens: interior orientation, if the file states it.
        rotation: (3, 3) camera_from_world; None if the file only states why there is none.
        translation: (3,) camera_from_world, in the unit of the file.
        sigma_wall_m: predicted error on the wall, if the file states it.
        reason: why the photo has no orientation; empty if it has one.
        note: what was approximated or converted; empty if nothing.
    """

    name: str
    lens: Intrinsics | CentredLens | FisheyeLens | None = None
    rotation: NDArray[np.float64] | None = None
    translation: NDArray[np.float64] | None = None
    sigma_wall_m: float | None = None
    reason: str = ""
    note: str = ""

    def of_face(self, face: str) -> GivenCamera:
        """Return the camera of a face of the cube of a fisheye photo."""
        if not isinstance(self.lens, FisheyeLens) or self.rotation is None:
            return self
        problem = problem_of(self.lens)
        if problem or face not in face_lenses(self.lens):
            return GivenCamera(
                name=self.name,
                reason=f"its fisheye lens is none: {problem}"
                if problem
                else "its fisheye lens does not show that face",
            )
        axes = FACE_FROM_CAMERA[face]
        return replace(
            self,
            lens=face_lenses(self.lens)[face],
            rotation=axes @ self.rotation,
            translation=axes @ np.asarray(self.translation, dtype=np.float64),
        )

    def panorama_faces(self) -> list[GivenCamera]:
        """Return the cameras of a panorama's faces; itself without a pose."""
        if self.rotation is None or self.translation is None:
            return [self]
        stem = str(PurePosixPath(self.name).with_suffix(""))
        return [
            replace(
                self,
                name=face_name(stem, face),
                rotation=axes @ PANORAMA_FROM_CAMERA @ self.rotation,
                translation=axes @ PANORAMA_FROM_CAMERA @ self.translation,
            )
            for face, axes in FACES.items()
        ]


def text_of(path: Path) -> str:
    """Return the text of a file of cameras.

    Raises:
        InputError: it cannot be read, is not text, or is larger than any such file.
    """
    return text_of_file(path, MOST_BYTES, _WHAT)


def lines_of(path: Path) -> Iterator[str]:
    """Yield the lines of a model, without their line ends.

    Raises:
        InputError: it cannot be read, is not text, is larger than any such file, or has a longer
            line.
    """
    with reading(path, MOST_MODEL_BYTES, _WHAT), open_text(path) as stream:
        while line := stream.readline(MOST_LINE):
            if len(line) == MOST_LINE:
                raise InputError(f"{path.name} has a line of more than {MOST_LINE} letters")
            yield line.rstrip("\n")


def photo_path(text: str) -> str:
    """Return the path of a photo with forward slashes."""
    return PureWindowsPath(text.strip()).as_posix()


def normalised_grid(lens: Intrinsics) -> NDArray[np.float64]:
    """Return positions (n, 2) in front of a lens, as x / z and y / z, that cover its image."""
    u, v = np.meshgrid(np.linspace(0, lens.width, 25), np.linspace(0, lens.height, 19))
    return np.column_stack([(u.ravel() - lens.cx) / lens.fx, (v.ravel() - lens.cy) / lens.fy])


def nearest_lens(
    start: Intrinsics, rays: NDArray[np.float64], pixels: NDArray[np.float64]
) -> tuple[Intrinsics | FisheyeLens, float]:
    """Return our lens nearest to another program's, and the deviation in pixels.

    Args:
        start: focal length, principal point and size of the other lens.
        rays: (n, 3) directions that cover its image.
        pixels: (n, 2) their pixels.

    Returns:
        OpenCV's model, or its fisheye if that deviates too much; the largest deviation.
    """
    from scipy.optimize import least_squares

    seen = np.isfinite(rays).all(axis=1) & np.isfinite(pixels).all(axis=1)
    rays, pixels = rays[seen], pixels[seen]
    if len(pixels) < _FEWEST_DIRECTIONS:
        return start, math.inf

    def brown(v: NDArray[np.float64]) -> Intrinsics:
        fx, fy, cx, cy, *terms = v.tolist()
        return replace(start, fx=fx, fy=fy, cx=cx, cy=cy, distortion=tuple(terms))

    def fisheye(v: NDArray[np.float64]) -> FisheyeLens:
        fx, fy, cx, cy, *terms = v.tolist()
        return FisheyeLens(
            width=start.width,
            height=start.height,
            fx=fx,
            fy=fy,
            cx=cx,
            cy=cy,
            radial=tuple(terms[:4]),
            tangential=tuple(terms[4:]),
            field_of_view_deg=_WIDEST_FITTED_DEG,
        )

    def off_brown(v: NDArray[np.float64]) -> NDArray[np.float64]:
        off = brown(v).posed().project(rays)[:, :2] - pixels
        return np.nan_to_num(off, nan=_FAR_PX, posinf=_FAR_PX, neginf=-_FAR_PX).ravel()

    def off_fisheye(v: NDArray[np.float64]) -> NDArray[np.float64]:
        off = fisheye(v).project(rays) - pixels
        return np.nan_to_num(off, nan=_FAR_PX, posinf=_FAR_PX, neginf=-_FAR_PX).ravel()

    focal = [start.fx, start.fy, start.cx, start.cy]
    fits: list[tuple[float, Intrinsics | FisheyeLens]] = []
    with np.errstate(all="ignore"):
        if (rays[:, 2] > 0.2 * np.linalg.norm(rays, axis=1)).all():
            found = least_squares(off_brown, [*focal, *[0.0] * 5], x_scale="jac")
            fits.append((_worst_px(found.fun), brown(found.x)))
        if not fits or fits[0][0] > MAX_LEFT_OUT_PX:
            found = least_squares(off_fisheye, [*focal, *[0.0] * 6], x_scale="jac")
            fits.append((_worst_px(found.fun), fisheye(found.x)))
    worst_px, lens = min(fits, key=lambda fit: fit[0])
    return lens, worst_px


def _worst_px(residuals: NDArray[np.float64]) -> float:
    return float(np.hypot(residuals[::2], residuals[1::2]).max())


def lens_or_reason(
    whose: str, lens: Intrinsics | FisheyeLens, worst_px: float, way_out: str
) -> tuple[Intrinsics | FisheyeLens | str, str]:
    """Return a lens with a note of omitted terms, or the reason why it cannot be used."""
    if worst_px <= NEGLIGIBLE_PX:
        return lens, ""
    size = f"{worst_px:.2g} pixels" if worst_px < _FAR_PX else "more than any pixels"
    if worst_px > MAX_LEFT_OUT_PX:
        return f"{whose} differs from the nearest lens of OpenCV by up to {size}: {way_out}", ""
    return lens, f"{whose} is replaced by OpenCV's nearest lens, with a deviation of up to {size}"


def damaged(path: Path, what: str, line: int | None = None) -> InputError:
    """Return the error for an invalid file of cameras."""
    where = path.name if line is None else f"{path.name}:{line}"
    return InputError(f"{where}: {what}; export the cameras again")


def numbers_of(texts: Sequence[str], path: Path, what: str, line: int | None = None) -> list[float]:
    """Parse words as finite numbers.

    Raises:
        InputError: one of them is not a number.
    """
    try:
        values = [float(text) for text in texts]
    except ValueError:
        values = [math.nan]
    if not all(math.isfinite(value) for value in values):
        raise damaged(path, f"{what} must be numbers, got {' '.join(texts)[:60]!r}", line)
    return values


def rotation_of(values: Sequence[float], path: Path, whose: str) -> NDArray[np.float64]:
    """Return nine numbers as the nearest rotation matrix.

    Raises:
        InputError: they are far from one.
    """
    matrix = np.array(values, dtype=np.float64).reshape(3, 3)
    # LAPACK may not terminate for singular values of infinity.
    if (np.abs(matrix) <= 1.0 + _ORTHONORMAL).all():
        left, _, right = np.linalg.svd(matrix)
        rotation: NDArray[np.float64] = left @ right
        if np.abs(rotation - matrix).max() <= _ORTHONORMAL and np.linalg.det(rotation) > 0.0:
            return rotation
    raise damaged(path, f"the rotation of {whose} is not a rotation matrix")


def checked_lens(lens: Intrinsics, path: Path, whose: str) -> Intrinsics:
    """Return a lens if it is valid.

    Raises:
        InputError: it is not.
    """
    values = (lens.fx, lens.fy, lens.cx, lens.cy, lens.skew or 0.0, *lens.distortion)
    if not (all(map(math.isfinite, values)) and lens.fx > 0.0 and lens.fy > 0.0):
        raise damaged(path, f"the lens of {whose} is none: focal length {lens.fx:g}, {lens.fy:g}")
    if min(lens.width, lens.height) < 1 or lens.width * lens.height > MOST_PIXELS:
        size = f"{_cut(lens.width)} x {_cut(lens.height)}"
        raise damaged(path, f"the photo {whose} is {size} pixels, expected 1 to {MOST_PIXELS}")
    return lens


def _cut(number: int) -> str:
    text = str(number)
    return text if len(text) <= _LONGEST_NUMBER else f"{text[:_LONGEST_NUMBER]}..."
