"""Orientations as a COLMAP model: `cameras.txt`, `images.txt`, `points3D.txt`, read also as `.bin`.

COLMAP counts pixels as orthoflow does, the centre of the first one at (0.5, 0.5), and has the same
camera axes, so nothing is converted. The points written are the ties that the orientation kept.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice, pairwise
from pathlib import Path
from typing import Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import ArgumentError, InputError
from orthoflow.files.fisheyes import FisheyeLens
from orthoflow.files.given_cameras import (
    MOST_CAMERAS,
    GivenCamera,
    bare_name,
    bytes_of,
    checked_lens,
    damaged,
    lines_of,
    numbers_of,
)
from orthoflow.files.sidecars import write_text
from orthoflow.geometry.rotations import quaternion_from_rotation, rotation_from_quaternion
from orthoflow.products import Camera, Cameras, Intrinsics, TieRole, Ties

# COLMAP's numbers of its models, with how many parameters each has.
_MODELS: Final = (
    ("SIMPLE_PINHOLE", 3),
    ("PINHOLE", 4),
    ("SIMPLE_RADIAL", 4),
    ("RADIAL", 5),
    ("OPENCV", 8),
    ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12),
    ("FOV", 5),
    ("SIMPLE_RADIAL_FISHEYE", 4),
    ("RADIAL_FISHEYE", 5),
    ("THIN_PRISM_FISHEYE", 12),
    ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
)
# Parameters of those that OpenCV's model holds, in COLMAP's order.
_COLUMNS: Final = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "FULL_OPENCV": (
        *("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
        *("k3", "k4", "k5", "k6"),
    ),
}
# Of those that bend as OpenCV's fisheyes do.
_FISHEYES: Final = {
    "OPENCV_FISHEYE": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
    "SIMPLE_RADIAL_FISHEYE": ("f", "cx", "cy", "k1"),
    "RADIAL_FISHEYE": ("f", "cx", "cy", "k1", "k2"),
}
# More than a camera of any model has.
_MOST_WORDS: Final = 30
# u, v and the number of the point.
_OBSERVATION_BYTES: Final = 24

_Lens: TypeAlias = Intrinsics | FisheyeLens | str


@dataclass(frozen=True, kw_only=True)
class ColmapModel:
    """What was written.

    Attributes:
        n_cameras: lenses.
        n_images: oriented photos.
        n_points: ties.
    """

    n_cameras: int
    n_images: int
    n_points: int


def write_colmap_model(folder: Path, cameras: Cameras) -> ColmapModel:
    """Write a text model that COLMAP opens into an existing folder.

    Raises:
        ArgumentError: no photo is oriented, or a photo's name has spaces.
        StoreError: a file cannot be written.
    """
    oriented = [camera for camera in cameras.cameras if camera.status == "ok"]
    if not oriented:
        raise ArgumentError("no photo is oriented, so there is no COLMAP model to write")
    for camera in oriented:
        if len(camera.photo.split()) != 1:
            raise ArgumentError(
                f'a COLMAP text model ends the name of a photo at its first space, but one is "'
                f'{camera.photo}": rename the photo and run again'
            )
    lenses = list(dict.fromkeys(_lens(camera) for camera in oriented))
    seen = _KeptTies(oriented, cameras.ties)
    write_text(folder / "cameras.txt", _cameras_text(lenses))
    write_text(folder / "images.txt", _images_text(oriented, lenses, seen))
    write_text(folder / "points3D.txt", _points_text(seen))
    return ColmapModel(
        n_cameras=len(lenses), n_images=len(oriented), n_points=len(seen.points_world)
    )


class _KeptTies:
    """The ties that count: places on the walls, and where the photos have them."""

    def __init__(self, oriented: list[Camera], ties: Ties | None) -> None:
        self.observations: list[NDArray[np.intp]] = [np.empty(0, np.intp) for _ in oriented]
        self.pixels, self.points_world = np.empty((0, 2)), np.empty((0, 3))
        self.point, self.errors_px = np.empty(0, np.intp), np.empty(0)
        self.image, self.nth = np.empty(0, np.intp), np.empty(0, np.intp)
        if ties is None:
            return
        names = {camera.photo: index for index, camera in enumerate(oriented)}
        image = np.array([names.get(name, -1) for name in ties.photo_names], dtype=np.intp)
        kept = np.flatnonzero((ties.role != TieRole.REJECTED) & (image[ties.photo] >= 0))
        self.image, self.pixels = image[ties.photo[kept]], ties.pixels_photo[kept]
        self.errors_px = np.linalg.norm(ties.residual_px[kept], axis=1)
        # A place that several photos see is one point.
        self.points_world, place = np.unique(ties.points_world[kept], axis=0, return_inverse=True)
        self.point = place.ravel()
        self.observations = [np.flatnonzero(self.image == index) for index in range(len(oriented))]
        self.nth = np.zeros(len(kept), dtype=np.intp)
        for mine in self.observations:
            self.nth[mine] = np.arange(len(mine))


def _lens(camera: Camera) -> Intrinsics:
    if camera.intrinsics is None:
        raise ArgumentError(f"photo {camera.photo} is oriented, but its lens is not known")
    if camera.intrinsics.skew:
        raise ArgumentError(
            f"the lens of photo {camera.photo} has a skew of {camera.intrinsics.skew:.1f} px, "
            "which no model of COLMAP has: orient it without, by orient.pnp or skew: false"
        )
    return camera.intrinsics


def _cameras_text(lenses: list[Intrinsics]) -> str:
    lines = ["# Camera list: CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    for number, lens in enumerate(lenses, start=1):
        k1, k2, p1, p2, k3 = lens.distortion
        values = [lens.fx, lens.fy, lens.cx, lens.cy, k1, k2, p1, p2]
        model = "OPENCV"
        if k3 != 0.0:
            model, values = "FULL_OPENCV", [*values, k3, 0.0, 0.0, 0.0]
        lines.append(f"{number} {model} {lens.width} {lens.height} {_words(values)}")
    return "\n".join(lines) + "\n"


def _images_text(oriented: list[Camera], lenses: list[Intrinsics], seen: _KeptTies) -> str:
    lines = [
        "# Image list: IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME",
        "# and on a second line POINTS2D[] as X, Y, POINT3D_ID",
    ]
    for index, camera in enumerate(oriented):
        viewer = camera.viewing()
        pose = [*quaternion_from_rotation(viewer.rotation), *viewer.translation]
        lens = lenses.index(_lens(camera)) + 1
        lines.append(f"{index + 1} {_words(pose)} {lens} {camera.photo}")
        lines.append(
            " ".join(
                f"{_words(seen.pixels[at])} {int(seen.point[at]) + 1}"
                for at in seen.observations[index]
            )
        )
    return "\n".join(lines) + "\n"


def _points_text(seen: _KeptTies) -> str:
    lines = ["# Point list: POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as IMAGE_ID, POINT2D_IDX"]
    order = np.argsort(seen.point, kind="stable")
    ends = np.searchsorted(seen.point[order], np.arange(len(seen.points_world)), side="right")
    for index, (first, last) in enumerate(pairwise([0, *ends.tolist()])):
        own = order[first:last]
        track = " ".join(f"{seen.image[at] + 1} {seen.nth[at]}" for at in own)
        error = float(np.mean(seen.errors_px[own]))
        place = _words(seen.points_world[index])
        lines.append(f"{index + 1} {place} 128 128 128 {error!r} {track}")
    return "\n".join(lines) + "\n"


def read_colmap_model(cameras: Path, images: Path) -> tuple[GivenCamera, ...]:
    """Read the orientations of a model, as text or binary.

    Args:
        cameras: `cameras.txt` or `cameras.bin`.
        images: `images.txt` or `images.bin`.

    Raises:
        InputError: the model is damaged.
    """
    is_binary = images.suffix.lower() == ".bin"
    lenses = (_binary_lenses if is_binary else _text_lenses)(cameras)
    found = []
    poses = (_binary_images if is_binary else _text_images)(images)
    for name, camera_id, pose in islice(poses, MOST_CAMERAS + 1):
        if camera_id not in lenses:
            raise damaged(images, f"{name} has camera {camera_id}, which {cameras.name} has not")
        lens, length = lenses[camera_id], float(np.linalg.norm(pose[:4]))
        if not (math.isfinite(length) and length > 0.0 and all(map(math.isfinite, pose))):
            raise damaged(images, f"the pose of {name} must be finite numbers")
        if isinstance(lens, str):
            found.append(GivenCamera(name=bare_name(name), reason=lens))
            continue
        found.append(
            GivenCamera(
                name=bare_name(name),
                lens=lens,
                rotation=rotation_from_quaternion(np.array(pose[:4]) / length),
                translation=np.array(pose[4:]),
            )
        )
    if not found:
        raise damaged(images, "the model has no images")
    return tuple(found)


def _text_lenses(path: Path) -> dict[int, _Lens]:
    lenses: dict[int, _Lens] = {}
    for number, line in enumerate(lines_of(path), start=1):
        words = line.split(maxsplit=_MOST_WORDS)
        if not words or words[0].startswith("#"):
            continue
        if len(words) < 5:
            raise damaged(path, "expected CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]", number)
        camera_id, width, height, *params = numbers_of(
            [words[0], *words[2:]], path, "a camera's parameters", number
        )
        lenses[int(camera_id)] = _lens_of(words[1], (int(width), int(height)), params, path)
        _check_count(lenses, path)
    return lenses


def _text_images(path: Path) -> Iterator[tuple[str, int, list[float]]]:
    lines = enumerate(lines_of(path), start=1)
    for number, line in lines:
        words = line.split(maxsplit=9)
        if not words or words[0].startswith("#"):
            continue
        if len(words) < 10:
            raise damaged(
                path, "expected IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", number
            )
        pose = numbers_of(words[1:8], path, "a pose", number)
        yield words[9].strip(), int(numbers_of([words[8]], path, "CAMERA_ID", number)[0]), pose
        # The points of the image stand in a line of their own, which may be empty.
        next(lines, None)


def _binary_lenses(path: Path) -> dict[int, _Lens]:
    data = _Bytes(path)
    lenses: dict[int, _Lens] = {}
    for _ in range(data.count()):
        camera_id, model, width, height = data.values("<IiQQ")
        if not 0 <= model < len(_MODELS):
            raise damaged(path, f"camera {camera_id} is of the unknown model {model}")
        name, n_params = _MODELS[model]
        params = list(data.values(f"<{n_params}d"))
        lenses[camera_id] = _lens_of(name, (width, height), params, path)
        _check_count(lenses, path)
    return lenses


def _check_count(lenses: dict[int, _Lens], path: Path) -> None:
    if len(lenses) > MOST_CAMERAS:
        raise InputError(f"{path.name} holds more than {MOST_CAMERAS} cameras: split it")


def _binary_images(path: Path) -> Iterator[tuple[str, int, list[float]]]:
    data = _Bytes(path)
    for _ in range(data.count()):
        _image_id, *pose, camera_id = data.values("<I7dI")
        name = data.text()
        data.skip(_OBSERVATION_BYTES * data.count())
        yield name, camera_id, pose


class _Bytes:
    """A binary file of COLMAP's, read from the front."""

    def __init__(self, path: Path) -> None:
        self._path, self._at, self._content = path, 0, bytes_of(path)

    def values(self, form: str) -> tuple[Any, ...]:
        """The next values."""
        start = self._at
        self.skip(struct.calcsize(form))
        return struct.unpack_from(form, self._content, start)

    def count(self) -> int:
        """How many items follow; each has at least one byte."""
        (count,) = self.values("<Q")
        if count > len(self._content):
            raise damaged(self._path, f"it states {count} items, more than it has bytes")
        return int(count)

    def text(self) -> str:
        """The text up to the next zero."""
        end = self._content.find(b"\0", self._at)
        text = self._content[self._at : end].decode("utf-8", errors="replace")
        self.skip(max(end, len(self._content)) + 1 - self._at if end < 0 else end + 1 - self._at)
        return text

    def skip(self, count: int) -> None:
        """Go on by so many bytes."""
        self._at += count
        if self._at > len(self._content):
            raise damaged(self._path, "it ends too early, it is cut off")


def _lens_of(model: str, size: tuple[int, int], params: list[float], path: Path) -> _Lens:
    """A camera's lens, or why there is none."""
    columns = _COLUMNS.get(model) or _FISHEYES.get(model)
    if columns is None:
        return (
            f"its camera is of the model {model}, which OpenCV's has not: undistort the model "
            "with COLMAP (image_undistorter), or refine it as OPENCV"
        )
    if len(params) != len(columns):
        raise damaged(path, f"a camera {model} has {len(columns)} parameters, got {len(params)}")
    values = dict(zip(columns, params, strict=True))
    fx, fy = (values[name if name in values else "f"] for name in ("fx", "fy"))
    if model in _FISHEYES:
        return FisheyeLens(
            width=size[0],
            height=size[1],
            fx=fx,
            fy=fy,
            cx=values["cx"],
            cy=values["cy"],
            radial=tuple(values.get(name, 0.0) for name in ("k1", "k2", "k3", "k4")),
        )
    if any(values.get(name, 0.0) for name in ("k4", "k5", "k6")):
        return "its camera has k4, k5 or k6, which orthoflow does not take: refine it as OPENCV"
    lens = Intrinsics(
        width=size[0],
        height=size[1],
        fx=fx,
        fy=fy,
        cx=values["cx"],
        cy=values["cy"],
        distortion=tuple(values.get(name, 0.0) for name in ("k1", "k2", "p1", "p2", "k3")),
        source="given",
    )
    return checked_lens(lens, path, f"a camera {model}")


def _words(values: list[float] | NDArray[np.float64]) -> str:
    """Shortest texts that give the numbers back."""
    return " ".join(repr(float(value)) for value in values)
