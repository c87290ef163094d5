"""Photo orientations from other programs, converted to orthoflow's conventions.

The results have orthoflow's axes (x right, y down, z forward) and pixel coordinates (centre of the
first pixel at (0.5, 0.5)), in the world of the file. `camera_formats` chooses the reader.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PureWindowsPath
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import InputError
from orthoflow.files.cube_faces import (
    FACES,
    WIDEST_DEG,
    FisheyeLens,
    WideLens,
    face_lenses,
    problem_of,
)
from orthoflow.files.photo_files import MOST_PIXELS
from orthoflow.products import Intrinsics
from orthoflow.untrusted_text import open_text, reading, text_of_file

# The limit is larger for models that contain the observations of each photo, since they are read
# line by line.
#: bytes of a file of a COLMAP or Bundler model
MOST_MODEL_BYTES: Final = 500_000_000
#: bytes of another camera file (`cameras.json`, Metashape's XML, RealityCapture's list)
MOST_BYTES: Final = 50_000_000
#: characters of a line of a camera file
MOST_LINE: Final = 20_000_000
_WHAT: Final = "a camera file"
#: cameras in one file
MOST_CAMERAS: Final = 100_000
_LONGEST_NUMBER: Final = 12
_ORTHONORMAL: Final = 1e-4
# Up to the first limit, omitted lens terms do not affect matching; beyond the second, they are
# visible in an orthoimage.
NEGLIGIBLE_PX: Final = 0.05
#: error in pixels due to lens terms in a camera file that cannot be represented
MAX_LEFT_OUT_PX: Final = 0.5
_FEWEST_DIRECTIONS: Final = 30
_FAR_PX: Final = 1e4
_WIDEST_FITTED_DEG: Final = 355.0
# Number of terms in OpenCV's models: k1, k2, p1, p2, k3; and k1 to k4, p1, p2.
_BROWN_TERMS, _FISHEYE_TERMS = 5, 6


@dataclass(frozen=True, kw_only=True)
class CentredLens:
    """A lens from a file without the photo's size, with positions relative to the photo's centre.

    Attributes:
        focal_px: focal length in pixels, or None if it is relative to the photo's longer side.
        focal_share: focal length as a fraction of the photo's longer side, or None.
        off_middle: principal point relative to the centre, right and down, as a fraction of the
            longer side.
        radial: coefficients k1, k2, k3, k4.
        tangential: two terms whose order and signs the file does not define; they are ignored.
    """

    focal_px: float | None = None
    focal_share: float | None = None
    off_middle: tuple[float, float] = (0.0, 0.0)
    radial: tuple[float, ...]
    tangential: tuple[float, ...] = (0.0, 0.0)

    def of_size(self, width: int, height: int) -> tuple[Intrinsics | FisheyeLens, float]:
        """Return the lens for a photo of this size, and the largest ignored distortion in px."""
        longest = max(width, height)
        focal = self.focal_px or (self.focal_share or 0.0) * longest
        terms = {f"k{n}": term for n, term in enumerate(self.radial, start=1)}
        terms |= {"fx": focal, "fy": focal}
        terms["cx"], terms["cy"] = (
            0.5 * side + off * longest
            for side, off in zip((width, height), self.off_middle, strict=True)
        )
        lens, worst_px = lens_of_terms(terms, width, height)
        corner2 = (width * width + height * height) / (4.0 * focal * focal)
        return lens, worst_px + 3.0 * focal * corner2 * math.hypot(*self.tangential)


@dataclass(frozen=True, kw_only=True)
class GivenCamera:
    """The orientation of one photo, as given in a file.

    Attributes:
        name: photo name as in the file, with folders separated by slashes; some programs omit the
            suffix.
        lens: interior orientation, or None if the file does not contain it.
        rotation: (3, 3) camera_from_world; None if the photo has no orientation.
        translation: (3,) camera_from_world, in the unit of the file.
        covariance: (6, 6) as in `Camera`, with the translation in the unit of the file, or None.
        sigma_wall_m: predicted error on the wall, or None if the file does not contain it.
        reason: reason why the photo has no orientation; empty if it is oriented.
        note: remarks on approximations and conversions; may be empty.
    """

    name: str
    lens: Intrinsics | CentredLens | WideLens | None = None
    rotation: NDArray[np.float64] | None = None
    translation: NDArray[np.float64] | None = None
    covariance: NDArray[np.float64] | None = None
    sigma_wall_m: float | None = None
    reason: str = ""
    note: str = ""

    def of_face(self, face: str) -> GivenCamera:
        """Return the camera of a cube face of a wide photo."""
        if not isinstance(self.lens, WideLens) or self.rotation is None:
            return self
        problem = problem_of(self.lens)
        if problem or face not in face_lenses(self.lens):
            reason = (
                f"its lens is invalid: {problem}"
                if problem
                else ("its lens does not cover that face")
            )
            return GivenCamera(name=self.name, reason=reason)
        axes = FACES[face]
        return replace(
            self,
            lens=face_lenses(self.lens)[face],
            rotation=axes @ self.rotation,
            translation=axes @ np.asarray(self.translation, dtype=np.float64),
        )


def text_of(path: Path) -> str:
    """Return the text of a camera file.

    Raises:
        InputError: the file cannot be read, is not text, or is too large.
    """
    return text_of_file(path, MOST_BYTES, _WHAT)


def lines_of(path: Path) -> Iterator[str]:
    """Yield the lines of a camera file, without line ends.

    Raises:
        InputError: the file cannot be read, is not text, is too large, or has too long a line.
    """
    with reading(path, MOST_MODEL_BYTES, _WHAT), open_text(path) as stream:
        while line := stream.readline(MOST_LINE):
            if len(line) == MOST_LINE:
                raise InputError(f"{path.name} has a line of more than {MOST_LINE} characters")
            yield line.rstrip("\n")


def photo_path(text: str) -> str:
    """Return the path of a photo with forward slashes."""
    return PureWindowsPath(text.strip()).as_posix()


def normalised_grid(lens: Intrinsics) -> NDArray[np.float64]:
    """Return directions (n, 2), as x / z and y / z, that cover the image of a lens."""
    u, v = np.meshgrid(np.linspace(0, lens.width, 25), np.linspace(0, lens.height, 19))
    return np.column_stack([(u.ravel() - lens.cx) / lens.fx, (v.ravel() - lens.cy) / lens.fy])


def lens_of_terms(
    terms: Mapping[str, float], width: int, height: int, *, is_fisheye: bool = False
) -> tuple[Intrinsics | FisheyeLens, float]:
    """Return the lens for another program's parameters, approximated if our models lack some.

    Args:
        terms: `fx`, `fy`, `cx`, `cy` and `skew` in pixels; `k1` to `k4`, `p1` and `p2` as in
            OpenCV; with `p3` and `p4`, the tangential terms are multiplied by
            1 + p3 r^2 + p4 r^4. Missing parameters are 0.
        width: image width in pixels.
        height: image height in pixels.
        is_fisheye: whether the distortion is a function of the angle from the axis.

    Returns:
        The lens, which may be invalid, and its largest deviation in pixels.
    """
    t = defaultdict(float, terms)
    fx, fy, cx, cy = (t[name] for name in ("fx", "fy", "cx", "cy"))
    start = Intrinsics(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy, source="given")
    radial = tuple(t[f"k{n}"] for n in range(1, 5))
    lens: Intrinsics | FisheyeLens = replace(
        start, distortion=(*radial[:2], t["p1"], t["p2"], radial[2]), skew=t["skew"] or None
    )
    if is_fisheye:
        lens = _fisheye(start, (*radial, t["p1"], t["p2"]), WIDEST_DEG, skew=t["skew"])
    is_exact = not (t["p3"] or t["p4"] or (radial[3] and not is_fisheye))
    if is_exact or not (min(fx, fy) > 0.0 and all(map(math.isfinite, t.values()))):
        return lens, 0.0
    xy = normalised_grid(start)
    rays = np.column_stack([xy, np.ones(len(xy))])
    if is_fisheye:
        # For a fisheye, the positions of the grid are angles from the axis.
        theta = np.hypot(*xy.T)[:, None]
        rays = np.column_stack([xy * np.sinc(theta / np.pi), np.cos(theta)])
    x, y = xy.T
    r2 = x * x + y * y
    growth = np.polynomial.polynomial.polyval(r2, [1.0, *radial])
    further = 1.0 + t["p3"] * r2 + t["p4"] * r2 * r2
    bent_x = x * growth + (t["p2"] * (r2 + 2.0 * x * x) + 2.0 * t["p1"] * x * y) * further
    bent_y = y * growth + (t["p1"] * (r2 + 2.0 * y * y) + 2.0 * t["p2"] * x * y) * further
    pixels = np.column_stack([cx + bent_x * fx + bent_y * t["skew"], cy + bent_y * fy])
    return nearest_lens(start, rays, pixels)


def _fisheye(
    start: Intrinsics, terms: Sequence[float], field_of_view_deg: float, skew: float = 0.0
) -> FisheyeLens:
    """Return a fisheye lens with the size, focal length and principal point of another lens."""
    return FisheyeLens(
        width=start.width,
        height=start.height,
        fx=start.fx,
        fy=start.fy,
        cx=start.cx,
        cy=start.cy,
        radial=tuple(terms[:4]),
        tangential=tuple(terms[4:]),
        skew=skew,
        field_of_view_deg=field_of_view_deg,
    )


def nearest_lens(
    start: Intrinsics, rays: NDArray[np.float64], pixels: NDArray[np.float64]
) -> tuple[Intrinsics | FisheyeLens, float]:
    """Return the lens of our models that is closest to another program's lens, and its deviation.

    Args:
        start: focal length, principal point and size of the other lens.
        rays: (n, 3) directions that cover the other lens's image.
        pixels: (n, 2) positions of these directions in that image.

    Returns:
        The lens in OpenCV's model, or in its fisheye model if the former deviates too much, and the
        largest deviation of the lens returned.
    """
    from scipy.optimize import least_squares

    seen = np.isfinite(rays).all(axis=1) & np.isfinite(pixels).all(axis=1)
    rays, pixels = rays[seen], pixels[seen]
    if len(pixels) < _FEWEST_DIRECTIONS:
        return start, math.inf

    def lens_of(v: NDArray[np.float64]) -> Intrinsics | FisheyeLens:
        fx, fy, cx, cy, *terms = v.tolist()
        lens = replace(start, fx=fx, fy=fy, cx=cx, cy=cy)
        if len(terms) == _BROWN_TERMS:
            return replace(lens, distortion=tuple(terms))
        return _fisheye(lens, terms, _WIDEST_FITTED_DEG)

    def residuals(v: NDArray[np.float64]) -> NDArray[np.float64]:
        lens = lens_of(v)
        viewing = lens if isinstance(lens, FisheyeLens) else lens.posed()
        off_px = viewing.project(rays)[:, :2] - pixels
        return np.nan_to_num(off_px, nan=_FAR_PX, posinf=_FAR_PX, neginf=-_FAR_PX).ravel()

    is_before = bool((rays[:, 2] > 0.2 * np.linalg.norm(rays, axis=1)).all())
    best: tuple[float, Intrinsics | FisheyeLens] = (math.inf, start)
    with np.errstate(all="ignore"):
        for n_terms in (_BROWN_TERMS, _FISHEYE_TERMS) if is_before else (_FISHEYE_TERMS,):
            begin = [start.fx, start.fy, start.cx, start.cy, *[0.0] * n_terms]
            found = least_squares(residuals, begin, x_scale="jac")
            worst_px = float(np.hypot(found.fun[::2], found.fun[1::2]).max())
            best = min(best, (worst_px, lens_of(found.x)), key=lambda fit: fit[0])
            if worst_px <= MAX_LEFT_OUT_PX:
                break
    return best[1], best[0]


def lens_or_reason(
    whose: str, lens: Intrinsics | FisheyeLens, worst_px: float, way_out: str
) -> tuple[Intrinsics | FisheyeLens | str, str]:
    """Return a lens and a note on ignored terms, or the reason why the lens cannot be used."""
    if worst_px <= NEGLIGIBLE_PX:
        return lens, ""
    size = f"{worst_px:.2g} pixels" if worst_px < _FAR_PX else f"over {_FAR_PX:.0f} pixels"
    if worst_px > MAX_LEFT_OUT_PX:
        return f"{whose} differs from the closest OpenCV lens by up to {size}: {way_out}", ""
    return lens, f"{whose} is replaced by the closest OpenCV lens, with a deviation of up to {size}"


def damaged(path: Path, what: str, line: int | None = None) -> InputError:
    """Return the error for an invalid camera file."""
    where = path.name if line is None else f"{path.name}:{line}"
    return InputError(f"{where}: {what}; export the cameras again")


def numbers_of(texts: Sequence[str], path: Path, what: str, line: int | None = None) -> list[float]:
    """Convert words to finite numbers.

    Raises:
        InputError: a word is not a finite number.
    """
    try:
        values = [float(text) for text in texts]
    except ValueError:
        values = [math.nan]
    if not all(math.isfinite(value) for value in values):
        raise damaged(path, f"{what} must be numbers, got {' '.join(texts)[:60]!r}", line)
    return values


def rotation_of(values: Sequence[float], path: Path, whose: str) -> NDArray[np.float64]:
    """Return the rotation matrix closest to nine numbers.

    Raises:
        InputError: the numbers are far from a rotation.
    """
    matrix = np.array(values, dtype=np.float64).reshape(3, 3)
    # LAPACK may not terminate if values are infinite.
    if (np.abs(matrix) <= 1.0 + _ORTHONORMAL).all():
        left, _, right = np.linalg.svd(matrix)
        rotation: NDArray[np.float64] = left @ right
        if np.abs(rotation - matrix).max() <= _ORTHONORMAL and np.linalg.det(rotation) > 0.0:
            return rotation
    raise damaged(path, f"the rotation of {whose} is not a rotation matrix")


def checked_lens(lens: Intrinsics, path: Path, whose: str) -> Intrinsics:
    """Return a lens after checking that it is valid.

    Raises:
        InputError: the lens is invalid.
    """
    values = (lens.fx, lens.fy, lens.cx, lens.cy, lens.skew or 0.0, *lens.distortion)
    if not (all(map(math.isfinite, values)) and lens.fx > 0.0 and lens.fy > 0.0):
        raise damaged(
            path,
            f"the lens of {whose} must have finite parameters and positive focal lengths, got fx = "
            f"{lens.fx:g} and fy = {lens.fy:g}",
        )
    if min(lens.width, lens.height) < 1 or lens.width * lens.height > MOST_PIXELS:
        size = f"{_cut(lens.width)} x {_cut(lens.height)}"
        raise damaged(path, f"the photo {whose} has {size} pixels; expected 1 to {MOST_PIXELS}")
    return lens


def _cut(number: int) -> str:
    text = str(number)
    return text if len(text) <= _LONGEST_NUMBER else f"{text[:_LONGEST_NUMBER]}..."
