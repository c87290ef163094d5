"""COLMAP models: `cameras.txt`, `images.txt` and `points3D.txt`; `.bin` files can also be read.

COLMAP has the same pixel coordinates as orthoflow (the centre of the first pixel is (0.5, 0.5)) and
the same camera axes, so nothing is converted. The written points are the ties that the orientation
kept. pycolmap reads and writes the models.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from io import TextIOWrapper
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import ArgumentError, InputError, PluginError, StoreError
from orthoflow.files.cube_faces import FisheyeLens, PanoramaLens, WideLens
from orthoflow.files.given_cameras import (
    MOST_CAMERAS,
    MOST_MODEL_BYTES,
    GivenCamera,
    checked_lens,
    damaged,
    lens_of_terms,
    lens_or_reason,
    nearest_lens,
    normalised_grid,
    photo_path,
    rotation_of,
)
from orthoflow.files.photo_files import MOST_PIXELS
from orthoflow.products import Camera, Cameras, Intrinsics, TieRole, Ties
from orthoflow.untrusted_text import open_file, reading

# Our names for COLMAP's parameters, where they differ, for models that are part of OpenCV's.
_NAMES: Final = {"k": "k1"}
_BROWN: Final = frozenset(
    {"SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"}
)
_FISHEYES: Final = frozenset(
    {"SIMPLE_FISHEYE", "FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE"}
)
# The files of a model; rigs and frames were added in version 3.12. The points are not read.
COLMAP_PARTS: Final = ("cameras", "images", "rigs", "frames")
_OBSERVATION_BYTES: Final = 24
_POSE_BYTES: Final = 64
_DATUM_BYTES: Final = 16
_SENSOR_BYTES: Final = 8
_RIGID_BYTES: Final = 56
_WORDS_OF_IMAGE: Final = 10
_MAX_SAID: Final = 90
_UNDISTORT: Final = "undistort the model with COLMAP (image_undistorter), or refine it as OPENCV"


@dataclass(frozen=True, kw_only=True)
class ColmapModel:
    """The size of a written model.

    Attributes:
        n_cameras: number of lenses.
        n_images: number of oriented photos.
        n_points: number of points from ties.
    """

    n_cameras: int
    n_images: int
    n_points: int


def write_colmap_model(folder: Path, cameras: Cameras) -> ColmapModel:
    """Write a text model for COLMAP into an existing folder.

    Raises:
        ArgumentError: no photo is oriented, or a photo name contains spaces.
        PluginError: pycolmap is missing.
        StoreError: a file cannot be written.
    """
    oriented = [camera for camera in cameras.cameras if camera.status == "ok"]
    if not oriented:
        raise ArgumentError("no photo is oriented, so there is no COLMAP model to write")
    for camera in oriented:
        if len(camera.photo.split()) != 1:
            raise ArgumentError(
                "a COLMAP text model cannot contain photo names with spaces, such as "
                f'"{camera.photo}": rename the photo and run again'
            )
    lenses = list(dict.fromkeys(_lens(camera) for camera in oriented))
    pycolmap = _pycolmap("writing a COLMAP model")
    model = pycolmap.Reconstruction()
    for number, lens in enumerate(lenses, start=1):
        k1, k2, p1, p2, k3 = lens.distortion
        params = [lens.fx, lens.fy, lens.cx, lens.cy, k1, k2, p1, p2]
        model.add_camera_with_trivial_rig(
            pycolmap.Camera(
                camera_id=number,
                model="FULL_OPENCV" if k3 else "OPENCV",
                width=lens.width,
                height=lens.height,
                params=[*params, k3, 0.0, 0.0, 0.0] if k3 else params,
            )
        )
    seen = [_kept_ties(cameras.ties, camera.photo) for camera in oriented]
    for number, (camera, ties) in enumerate(zip(oriented, seen, strict=True), start=1):
        viewer = camera.viewing()
        image = pycolmap.Image(
            name=camera.photo, camera_id=lenses.index(_lens(camera)) + 1, image_id=number
        )
        image.points2D = [pycolmap.Point2D(xy) for xy in ties[:, :2]]
        pose = pycolmap.Rigid3d(np.column_stack([viewer.rotation, viewer.translation]))
        model.add_image_with_trivial_frame(image, pose)
    # Ties of several photos at the same position become one point.
    image_of = np.concatenate([np.full(len(ties), k) for k, ties in enumerate(seen, start=1)])
    nth = np.concatenate([np.arange(len(ties)) for ties in seen])
    tied = np.concatenate(seen)
    places, of_place, counts = np.unique(
        tied[:, 2:5], axis=0, return_inverse=True, return_counts=True
    )
    groups = np.split(np.argsort(of_place.ravel(), kind="stable"), np.cumsum(counts)[:-1])
    for place, own in zip(places, groups, strict=False):
        track = pycolmap.Track()
        for at in own:
            track.add_element(int(image_of[at]), int(nth[at]))
        point = model.add_point3D(place, track, np.full(3, 128, dtype=np.uint8))
        model.points3D[point].error = float(tied[own, 5].mean())
    try:
        model.write_text(str(folder))
    except Exception as error:  # pycolmap raises various errors
        raise StoreError(f"cannot write the COLMAP model: {error}; free some disk space") from error
    return ColmapModel(n_cameras=len(lenses), n_images=len(oriented), n_points=len(places))


def _pycolmap(purpose: str) -> Any:
    try:
        import pycolmap
    except ImportError as error:
        raise PluginError(f"{purpose} needs pycolmap: pip install pycolmap") from error
    return pycolmap


def _kept_ties(ties: Ties | None, photo: str) -> NDArray[np.float64]:
    """Return the kept ties of a photo (n, 6): u, v, x, y, z and length of the residual."""
    if ties is None or photo not in ties.photo_names:
        return np.empty((0, 6))
    mine = (ties.photo == ties.photo_names.index(photo)) & (ties.role != TieRole.REJECTED)
    errors_px = np.linalg.norm(ties.residual_px[mine], axis=1)
    return np.column_stack([ties.pixels_photo[mine], ties.points_world[mine], errors_px])


def _lens(camera: Camera) -> Intrinsics:
    if camera.intrinsics is None:
        raise ArgumentError(f"photo {camera.photo} is oriented, but its lens is not known")
    if camera.intrinsics.skew:
        raise ArgumentError(
            f"the lens of photo {camera.photo} has a skew of {camera.intrinsics.skew:.1f} px, "
            "which no COLMAP camera model supports: orient the photo without skew, with "
            "orient.pnp or skew: false"
        )
    return camera.intrinsics


def read_colmap_model(parts: Sequence[Path]) -> tuple[GivenCamera, ...]:
    """Read the orientations of a text or binary model with pycolmap, including rigs.

    Args:
        parts: `cameras`, `images` and, if present, `rigs` and `frames`; all `.txt` or all `.bin`.

    Raises:
        InputError: the model is damaged.
        PluginError: pycolmap is missing.
    """
    pycolmap = _pycolmap(f"reading the COLMAP model of {parts[0].name}")
    images = next(path for path in parts if path.stem.lower() == "images")
    suffix = images.suffix.lower()
    for path in parts:
        with reading(path, MOST_MODEL_BYTES, "a camera file"):
            pass
    if suffix == ".bin":
        for path in parts:
            _require_whole(path)
    with tempfile.TemporaryDirectory() as folder:
        for path in parts:
            (Path(folder) / f"{path.stem.lower()}{suffix}").symlink_to(path.absolute())
        # Replace the file of points with an empty one, because it is large and not needed.
        (Path(folder) / f"points3D{suffix}").write_bytes(bytes(8) if suffix == ".bin" else b"")
        try:
            model = pycolmap.Reconstruction(folder)
        except Exception as error:  # pycolmap raises various errors
            # pycolmap's messages begin with a position in its C++ source.
            reason = " ".join(str(error).rpartition("] ")[2].split())[:_MAX_SAID]
            raise damaged(images, f"pycolmap cannot read the COLMAP model ({reason})") from error
    if not model.images:
        raise damaged(images, "the model has no images")
    if len(model.images) > MOST_CAMERAS or len(model.cameras) > MOST_CAMERAS:
        raise InputError(f"{images.name} contains more than {MOST_CAMERAS} cameras: split the file")
    lenses = {number: _lens_of(camera, images) for number, camera in model.cameras.items()}
    by_number = sorted(model.images.items())
    names = _whole_names(images) if suffix == ".txt" else {}
    try:
        names = {number: image.name for number, image in by_number} | names
    except UnicodeDecodeError as error:
        raise damaged(images, "the name of an image is not UTF-8 text") from error
    return tuple(
        _given(image, names[number], *lenses[image.camera_id], path=images)
        for number, image in by_number
    )


def _require_whole(path: Path) -> None:
    """Refuse a binary file that is truncated or declares more items than its size allows.

    pycolmap would allocate memory for the declared number of items, and read past the end of the
    file.
    """
    end_of = {"images": _end_of_image, "rigs": _end_of_rig, "frames": _end_of_frame}
    content, at = path.read_bytes(), 8
    count = int.from_bytes(content[:at], "little")
    if path.stem.lower() in end_of:
        for _ in range(min(count, len(content))):
            at = end_of[path.stem.lower()](content, at)
            if at > len(content):
                break
    if at > len(content) or count > len(content):
        raise damaged(path, "it is truncated")


def _end_of_image(content: bytes, at: int) -> int:
    at = content.find(b"\0", at + _POSE_BYTES) + 1 or len(content)
    return at + 8 + _OBSERVATION_BYTES * int.from_bytes(content[at : at + 8], "little")


def _end_of_frame(content: bytes, at: int) -> int:
    at += _POSE_BYTES
    return at + 4 + _DATUM_BYTES * int.from_bytes(content[at : at + 4], "little")


def _end_of_rig(content: bytes, at: int) -> int:
    n_sensors = int.from_bytes(content[at + 4 : at + 8], "little")
    at += 8 + _SENSOR_BYTES * min(n_sensors, 1)
    for _ in range(n_sensors - 1):
        at += _SENSOR_BYTES + 1 + _RIGID_BYTES * any(content[at + _SENSOR_BYTES :][:1])
        if at > len(content):
            break
    return at


def _whole_names(images: Path) -> dict[int, str]:
    """Return photo names by image number from a text file; pycolmap truncates them at spaces."""
    names: dict[int, str] = {}
    with open_file(images) as content:
        stream = TextIOWrapper(content, encoding="utf-8", errors="replace")
        for line in stream:
            words = line.split(maxsplit=9)
            if words and not words[0].startswith("#"):
                if len(words) == _WORDS_OF_IMAGE and words[0].isdecimal():
                    names[int(words[0])] = words[9].strip()
                # Skip the next line, which contains the points of the image and may be empty.
                next(stream, None)
    return names


def _given(
    image: Any, whole_name: str, lens: Intrinsics | WideLens | str, note: str, *, path: Path
) -> GivenCamera:
    name = photo_path(whole_name)
    if isinstance(lens, str):
        return GivenCamera(name=name, reason=lens)
    if not image.has_pose:
        return GivenCamera(name=name, reason="COLMAP did not register it")
    seen = image.cam_from_world()
    matrix = np.asarray(seen.matrix(), dtype=np.float64)
    if not np.isfinite(matrix).all() or not np.any(seen.rotation.quat):
        raise damaged(path, f"the pose of {name} must be finite numbers")
    return GivenCamera(
        name=name,
        lens=lens,
        rotation=rotation_of(matrix[:, :3].ravel().tolist(), path, name),
        translation=matrix[:, 3],
        note=note,
    )


def _lens_of(camera: Any, path: Path) -> tuple[Intrinsics | WideLens | str, str]:
    """Return a camera's lens and a note on omitted terms, or the reason why it is unusable."""
    if min(camera.width, camera.height) < 1 or camera.width * camera.height > MOST_PIXELS:
        raise damaged(
            path,
            f"a camera has {camera.width} x {camera.height} pixels; expected 1 to {MOST_PIXELS}",
        )
    if camera.is_spherical():
        return PanoramaLens(width=int(camera.width), height=int(camera.height)), ""
    words = [word.strip() for word in camera.params_info.split(",")]
    values = {
        _NAMES.get(word, word): float(value)
        for word, value in zip(words, camera.params, strict=True)
    }
    values |= {name: values.get(name, values.get("f", 0.0)) for name in ("fx", "fy")}
    model, size = str(camera.model_name), (int(camera.width), int(camera.height))
    is_rational = any(values.get(name, 0.0) for name in ("k4", "k5", "k6"))
    is_exact = model in _FISHEYES or (model in _BROWN and not is_rational)
    pinhole = {name: values[name] for name in ("fx", "fy", "cx", "cy")}
    terms = values if is_exact else pinhole
    lens, _ = lens_of_terms(terms, *size, is_fisheye=model in _FISHEYES)
    if isinstance(lens, FisheyeLens):
        return lens, ""
    checked_lens(lens, path, f"a camera {model}")
    if is_exact:
        return lens, ""
    pixels = normalised_grid(lens) * [lens.fx, lens.fy] + [lens.cx, lens.cy]
    rays = np.asarray(camera.cam_ray_from_img(pixels), dtype=np.float64)
    nearest, worst_px = nearest_lens(lens, rays, pixels)
    return lens_or_reason(f"its camera of the model {model}", nearest, worst_px, _UNDISTORT)
