"""Orientations of photos that other programs found, turned from the convention of each into ours.

What comes out has our axes (x right, y down, z forward) and our pixels (first centre at 0.5, 0.5),
in the world of the file. Read here are `cameras.json` of a run, Bundler's file and RealityCapture's
list; `camera_formats` knows who reads the rest.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import InputError
from orthoflow.files.containers import MOST_PIXELS
from orthoflow.files.fisheyes import FACE_FROM_CAMERA, FisheyeLens, face_lenses, problem_of
from orthoflow.files.json_texts import parse_json
from orthoflow.files.panoramas import FACES, PANORAMA_FROM_CAMERA, face_name
from orthoflow.files.regular_files import open_text, reading, text_of_file
from orthoflow.geometry.opencv_border import HALF_PIXEL
from orthoflow.products import Intrinsics

# Of a model with the observations of each photo, which is read line by line, and of other files.
MOST_MODEL_BYTES: Final = 500_000_000
MOST_BYTES: Final = 50_000_000
MOST_LINE: Final = 20_000_000
_WHAT: Final = "a file of cameras"
MOST_CAMERAS: Final = 100_000
_LONGEST_NUMBER: Final = 12
_FULL_FRAME_MM: Final = 36.0
_ORTHONORMAL: Final = 1e-4
# A lens that is so near to another one is the same to any matcher; beyond the other limit its
# error shows in an orthoimage.
NEGLIGIBLE_PX: Final = 0.05
MAX_LEFT_OUT_PX: Final = 0.5
_FEWEST_DIRECTIONS: Final = 30
_FAR_PX: Final = 1e4
_WIDEST_FITTED_DEG: Final = 355.0
# Axes of OpenGL, which Bundler and RealityCapture have: x right, y up, z backwards.
_FROM_OPENGL: Final = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True, kw_only=True)
class CentredLens:
    """A lens whose file says nothing of the photo's size, and counts from the photo's middle.

    Attributes:
        focal_px: focal length in pixels, or None where it is said by the photo's longer side.
        focal_share: focal length as a share of the photo's longer side, or None.
        off_middle: principal point from the middle, right and down, in shares of that side.
        radial: k1, k2, k3, k4.
        tangential: two terms whose order and signs the file does not define; they are left out.
    """

    focal_px: float | None = None
    focal_share: float | None = None
    off_middle: tuple[float, float] = (0.0, 0.0)
    radial: tuple[float, ...]
    tangential: tuple[float, ...] = (0.0, 0.0)

    def of_size(self, width: int, height: int) -> tuple[Intrinsics | FisheyeLens, float]:
        """Return the lens of a photo of so many pixels, and how many at most are left out."""
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
    """The orientation of one photo as a file has it.

    Attributes:
        name: of the photo, with the folders that the file states, separated by slashes; some
            programs leave out its suffix.
        lens: interior orientation, where the file says it.
        rotation: (3, 3) camera_from_world; None where the file only says why there is none.
        translation: (3,) camera_from_world, in the unit of the file.
        sigma_wall_m: predicted error on the wall, where the file says it.
        reason: why the photo has no orientation; empty where it has one.
        note: what of it could not be taken over exactly, or was converted; empty without such.
    """

    name: str
    lens: Intrinsics | CentredLens | FisheyeLens | None = None
    rotation: NDArray[np.float64] | None = None
    translation: NDArray[np.float64] | None = None
    sigma_wall_m: float | None = None
    reason: str = ""
    note: str = ""

    def of_face(self, face: str) -> GivenCamera:
        """Give the camera of a face of the cube that a fisheye's photo becomes."""
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
        """Return the cameras of a panorama's faces; itself where it has no pose."""
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
    """Text of a file of cameras.

    Raises:
        InputError: it cannot be read, is no text, or larger than any such file.
    """
    return text_of_file(path, MOST_BYTES, _WHAT)


def lines_of(path: Path) -> Iterator[str]:
    """Lines of a model, one after the other, without their ends.

    Raises:
        InputError: it cannot be read, is no text, is larger than any such file, or has a longer
            line.
    """
    with reading(path, MOST_MODEL_BYTES, _WHAT), open_text(path) as stream:
        while line := stream.readline(MOST_LINE):
            if len(line) == MOST_LINE:
                raise InputError(f"{path.name} has a line of more than {MOST_LINE} letters")
            yield line.rstrip("\n")


def photo_path(text: str) -> str:
    """Path of a photo with slashes, whichever way those of its program lean."""
    return PureWindowsPath(text.strip()).as_posix()


def normalised_grid(lens: Intrinsics) -> NDArray[np.float64]:
    """Places (n, 2) in front of a lens, as x / z and y / z, that cover its image."""
    u, v = np.meshgrid(np.linspace(0, lens.width, 25), np.linspace(0, lens.height, 19))
    return np.column_stack([(u.ravel() - lens.cx) / lens.fx, (v.ravel() - lens.cy) / lens.fy])


def nearest_lens(
    start: Intrinsics, rays: NDArray[np.float64], pixels: NDArray[np.float64]
) -> tuple[Intrinsics | FisheyeLens, float]:
    """Return the lens of ours that is nearest to another program's, and by how many pixels not.

    Args:
        start: focal length, principal point and size of the other lens.
        rays: (n, 3) directions that cover its image.
        pixels: (n, 2) where it sees them.

    Returns:
        OpenCV's model, or its fisheye where that is too far off; the worst deviation.
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
    """Return a lens with a note of what it leaves out, or the reason why it cannot be taken."""
    if worst_px <= NEGLIGIBLE_PX:
        return lens, ""
    size = f"{worst_px:.2g} pixels" if worst_px < _FAR_PX else "more than any pixels"
    if worst_px > MAX_LEFT_OUT_PX:
        return f"{whose} differs from the nearest lens of OpenCV by up to {size}: {way_out}", ""
    return lens, f"{whose} is taken as OpenCV's nearest lens, up to {size} off"


def damaged(path: Path, what: str, line: int | None = None) -> InputError:
    """Build the error for a file of cameras that makes no sense."""
    where = path.name if line is None else f"{path.name}:{line}"
    return InputError(f"{where}: {what}; export the cameras again")


def numbers_of(texts: Sequence[str], path: Path, what: str, line: int | None = None) -> list[float]:
    """Turn words into finite numbers.

    Raises:
        InputError: one of them is none.
    """
    try:
        values = [float(text) for text in texts]
    except ValueError:
        values = [math.nan]
    if not all(math.isfinite(value) for value in values):
        raise damaged(path, f"{what} must be numbers, got {' '.join(texts)[:60]!r}", line)
    return values


def rotation_of(values: Sequence[float], path: Path, whose: str) -> NDArray[np.float64]:
    """Nine numbers as the nearest rotation matrix.

    Raises:
        InputError: they are far from one.
    """
    matrix = np.array(values, dtype=np.float64).reshape(3, 3)
    # LAPACK may look for the singular values of infinity for ever.
    if (np.abs(matrix) <= 1.0 + _ORTHONORMAL).all():
        left, _, right = np.linalg.svd(matrix)
        rotation: NDArray[np.float64] = left @ right
        if np.abs(rotation - matrix).max() <= _ORTHONORMAL and np.linalg.det(rotation) > 0.0:
            return rotation
    raise damaged(path, f"the rotation of {whose} is no rotation matrix")


def checked_lens(lens: Intrinsics, path: Path, whose: str) -> Intrinsics:
    """Give a lens that can be one.

    Raises:
        InputError: it cannot.
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


def read_cameras_json(path: Path) -> tuple[GivenCamera, ...]:
    """Read the `cameras.json` of a run: OpenCV's pixels, X_camera = R X_world + t.

    Raises:
        InputError: it is damaged.
    """
    try:
        content: Any = parse_json(text_of(path))
        entries: Mapping[str, Any] = dict(content["cameras"])
        return tuple(
            _of_json(name, dict(entry), path)
            for name, entry in islice(entries.items(), MOST_CAMERAS + 1)
        )
    except (ValueError, KeyError, TypeError, OverflowError) as error:
        if isinstance(error, InputError):
            raise
        raise damaged(path, "it is no cameras.json of a run") from error


def _of_json(name: str, entry: Mapping[str, Any], path: Path) -> GivenCamera:
    if entry["status"] != "ok":
        return GivenCamera(name=name, reason=str(entry["status"]))
    matrix = np.array(entry["K"], dtype=np.float64)
    distortion = tuple(float(value) for value in entry["distortion"])
    if matrix.shape != (3, 3) or len(distortion) != 5:
        raise damaged(path, f"the lens of {name} must be K (3 x 3) and k1, k2, p1, p2, k3")
    lens = Intrinsics(
        width=int(entry["width"]),
        height=int(entry["height"]),
        fx=float(matrix[0, 0]),
        fy=float(matrix[1, 1]),
        cx=float(matrix[0, 2]) + HALF_PIXEL,
        cy=float(matrix[1, 2]) + HALF_PIXEL,
        distortion=distortion,
        source="given",
        skew=float(matrix[0, 1]) or None,
    )
    lens = checked_lens(lens, path, name)
    rotation = np.array(entry["R_camera_from_world"], dtype=np.float64).ravel().tolist()
    sigma_mm = entry.get("sigma_wall_mm")
    return GivenCamera(
        name=name,
        lens=lens,
        rotation=rotation_of(rotation, path, name),
        translation=np.array(
            numbers_of([str(v) for v in entry["t_camera_from_world"]], path, f"t of {name}")
        ).reshape(3),
        sigma_wall_m=None
        if sigma_mm is None
        else numbers_of([str(sigma_mm)], path, f"sigma_wall_mm of {name}")[0] / 1000.0,
    )


def bundler_count(path: Path) -> int:
    """Return how many cameras a file of Bundler states.

    Raises:
        InputError: it does not.
    """
    words = list(islice(_words_of(path), 2))
    counts = numbers_of(words, path, "the counts of cameras and points")
    if len(counts) < 2 or not 0.0 <= counts[0] <= MOST_CAMERAS:
        raise damaged(path, "it states no count of cameras")
    return int(counts[0])


def read_bundler(path: Path, names: Sequence[str]) -> tuple[GivenCamera, ...]:
    """Read Bundler's file: f, k1, k2, R and t of each camera, with the axes of OpenGL.

    Its pixels count from the middle of the photo, y upwards.

    Args:
        path: the file.
        names: of the photos, in its order.

    Raises:
        InputError: it is damaged.
    """
    # What follows the cameras are points, which may be many.
    words = list(islice(_words_of(path), 2 + 15 * len(names)))
    found = []
    for index, name in enumerate(names):
        values = numbers_of(words[2 + 15 * index : 17 + 15 * index], path, f"camera {index}")
        if len(values) < 15:
            raise damaged(path, f"it ends within camera {index}")
        focal, k1, k2 = values[:3]
        if not focal > 0.0:
            found.append(GivenCamera(name=name, reason="Bundler did not orient it"))
            continue
        found.append(
            GivenCamera(
                name=name,
                lens=CentredLens(focal_px=focal, radial=(k1, k2, 0.0)),
                rotation=_FROM_OPENGL @ rotation_of(values[3:12], path, name),
                translation=_FROM_OPENGL @ np.array(values[12:15]),
            )
        )
    return tuple(found)


def _words_of(path: Path) -> Iterator[str]:
    for line in lines_of(path):
        if not line.lstrip().startswith("#"):
            yield from line.split()


_ANGLES: Final = ("x", "y", "alt", "heading", "pitch", "roll")


def read_realitycapture_list(path: Path) -> tuple[GivenCamera, ...]:
    """Read RealityCapture's "internal/external camera parameters" (CSV).

    The focal length is the equivalent of a film 36 mm wide on the photo's longer side, the
    principal point in shares of that side from the middle; heading is clockwise from north (y),
    pitch 0 looks straight down. Terms that are not in the list are zero; lines of comment may
    stand anywhere.

    Raises:
        InputError: it is damaged.
    """
    lines = text_of(path).splitlines()
    heads = (
        (number, line.lstrip("# "))
        for number, line in enumerate(lines)
        if {"name", "heading"} <= {word.strip() for word in re.split("[,;\t]", line.lstrip("# "))}
    )
    number, head = next(heads, (0, ""))
    columns = [word.strip() for word in re.split("[,;\t]", head)]
    missing = [name for name in ("name", *_ANGLES) if name not in columns]
    if missing:
        raise damaged(
            path,
            f"the column {missing[0]} is missing: expected RealityCapture's internal/external "
            "camera parameters, #name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2",
        )
    separator = next(mark for mark in ",;\t" if mark in head)
    rows = csv.reader(lines[number + 1 :], delimiter=separator)
    try:
        return tuple(
            _of_row(dict(zip(columns, row, strict=False)), path, number + 1 + rows.line_num)
            for row in islice(rows, MOST_CAMERAS + 1)
            if any(row) and not row[0].lstrip().startswith("#")
        )
    except csv.Error as error:
        raise damaged(path, f"it is no table: {error}") from error


def _of_row(row: Mapping[str, str], path: Path, line: int) -> GivenCamera:
    name = photo_path(row["name"])
    pose = numbers_of([row.get(key, "") for key in _ANGLES], path, "the parameters", line)
    terms = ("px", "py", "k1", "k2", "k3", "k4", "t1", "t2")
    px, py, *radial, t1, t2 = numbers_of(
        [row.get(key) or "0" for key in terms], path, "the parameters", line
    )
    if not row.get("f"):
        return GivenCamera(
            name=name,
            reason="the list has no focal length f: export internal/external camera parameters",
        )
    (focal,) = numbers_of([row["f"]], path, "the focal length", line)
    if not focal > 0.0:
        raise damaged(path, f"the focal length of {name} must be positive, got {focal:g}", line)
    rotation = _FROM_OPENGL @ _world_from_angles(*pose[3:]).T
    return GivenCamera(
        name=name,
        lens=CentredLens(
            focal_share=focal / _FULL_FRAME_MM,
            off_middle=(px, py),
            radial=tuple(radial),
            tangential=(t1, t2),
        ),
        rotation=rotation,
        translation=-rotation @ np.array(pose[:3]),
    )


def _world_from_angles(
    heading_deg: float, pitch_deg: float, roll_deg: float
) -> NDArray[np.float64]:
    """World from the camera's OpenGL axes: about z by -heading, x by pitch, y by roll."""
    h, p, r = (math.radians(value) for value in (-heading_deg, pitch_deg, roll_deg))
    about_z = [[math.cos(h), -math.sin(h), 0.0], [math.sin(h), math.cos(h), 0.0], [0.0, 0.0, 1.0]]
    about_x = [[1.0, 0.0, 0.0], [0.0, math.cos(p), -math.sin(p)], [0.0, math.sin(p), math.cos(p)]]
    about_y = [[math.cos(r), 0.0, math.sin(r)], [0.0, 1.0, 0.0], [-math.sin(r), 0.0, math.cos(r)]]
    return np.asarray(np.array(about_z) @ np.array(about_x) @ np.array(about_y))
