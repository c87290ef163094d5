"""Orientations as a COLMAP text model: `cameras.txt`, `images.txt`, `points3D.txt`.

COLMAP counts pixels as orthoflow does, the centre of the first one at (0.5, 0.5), and has the same
camera axes, so nothing is converted. The points are the ties that the orientation kept.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import ArgumentError
from orthoflow.files.sidecars import write_text
from orthoflow.geometry.rotations import quaternion_from_rotation
from orthoflow.products import Camera, Cameras, Intrinsics, TieRole, Ties


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


def _words(values: list[float] | NDArray[np.float64]) -> str:
    """Shortest texts that give the numbers back."""
    return " ".join(repr(float(value)) for value in values)
