"""Photographs, what is known of their cameras, ties to the walls, and their orientation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import ProductError
from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.products.product import JsonValue, Product, Tolerance


@dataclass(frozen=True, kw_only=True)
class Intrinsics:
    """Interior orientation in orthoflow's pixel convention (first pixel centre at 0.5, 0.5).

    Attributes:
        width: pixels.
        height: pixels.
        fx: focal length in pixels along u; fy along v.
        cx: principal point in pixels; cy along v.
        distortion: k1, k2, p1, p2, k3 (Brown, as OpenCV).
        source: `calibration`, `exif`, `truth` or `estimated`.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)
    source: str = "calibration"

    @classmethod
    def of(cls, camera: ViewingCamera, *, source: str = "calibration") -> Self:
        """Give the interior orientation of a camera."""
        return cls(
            width=camera.width,
            height=camera.height,
            fx=camera.fx,
            fy=camera.fy,
            cx=camera.cx,
            cy=camera.cy,
            distortion=tuple(camera.distortion.tolist()),
            source=source,
        )

    def posed(
        self,
        rotation: NDArray[np.float64] | None = None,
        translation: NDArray[np.float64] | None = None,
    ) -> ViewingCamera:
        """Give the camera with this lens at a pose; without one, at the origin of its own axes.

        Args:
            rotation: (3, 3), camera_from_world.
            translation: (3,) metres, camera_from_world.
        """
        return ViewingCamera(
            width=self.width,
            height=self.height,
            fx=self.fx,
            fy=self.fy,
            cx=self.cx,
            cy=self.cy,
            distortion=np.array(self.distortion, dtype=np.float64),
            rotation=np.eye(3) if rotation is None else rotation,
            translation=np.zeros(3) if translation is None else translation,
        )


@dataclass(frozen=True, kw_only=True)
class Photo:
    """One photograph.

    Attributes:
        name: file name without folder; poses and ties refer to it.
        encoded: the file's bytes as they were; pixel frame = the stored array, EXIF orientation
            not applied.
        width: pixels of the stored array.
        height: pixels.
        exif_orientation: EXIF tag 1..8, 1 without one.
        exif_focal_px: focal length from EXIF in pixels, or None.
        intrinsics: calibration if known, or None.
    """

    name: str
    encoded: bytes
    width: int
    height: int
    exif_orientation: int = 1
    exif_focal_px: float | None = None
    intrinsics: Intrinsics | None = None


@dataclass(frozen=True, kw_only=True)
class Photos(Product):
    """A set of photographs, ordered by name.

    Attributes:
        photos: the photographs.
    """

    type_name: ClassVar[str] = "photos"
    embedded: ClassVar[bool] = False

    photos: tuple[Photo, ...]


@dataclass(frozen=True, kw_only=True)
class Calibration(Product):
    """Calibrated cameras, by photo name or pattern; the first that matches a photo holds.

    Attributes:
        patterns: photo names or shell patterns.
        intrinsics: one per pattern.
    """

    type_name: ClassVar[str] = "calibration"

    patterns: tuple[str, ...]
    intrinsics: tuple[Intrinsics, ...]


class TieRole(IntEnum):
    """What a tie is used for."""

    CONTROL = 0
    CHECK = 1
    REJECTED = 2


@dataclass(frozen=True, kw_only=True)
class Ties(Product):
    """Points seen in a photo and known on a wall.

    Attributes:
        photo_names: names the column `photo` refers to.
        photo: (n,) int32 index into `photo_names`.
        wall: (n,) int32 index of the wall.
        pixels_photo: (n, 2) float64 (u, v), first pixel centre at (0.5, 0.5).
        points_world: (n, 3) float64 metres.
        sigma_px: (n,) float64.
        sigma_m: (n,) float64.
        role: (n,) uint8 `TieRole`.
        residual_px: (n, 2) float64 observed - computed, NaN before an orientation.
        details: what else the method says, JSON.
    """

    type_name: ClassVar[str] = "ties"
    tolerances: ClassVar[Mapping[str, Tolerance]] = {
        "pixels_photo": Tolerance(limit=0.05, unit="px"),
        "points_world": Tolerance(limit=1e-4, unit="m"),
        "residual_px": Tolerance(limit=0.05, unit="px"),
        "sigma_px": Tolerance(limit=0.05, unit="px"),
        "sigma_m": Tolerance(limit=1e-4, unit="m"),
    }

    photo_names: tuple[str, ...]
    photo: NDArray[np.int32]
    wall: NDArray[np.int32]
    pixels_photo: NDArray[np.float64]
    points_world: NDArray[np.float64]
    sigma_px: NDArray[np.float64]
    sigma_m: NDArray[np.float64]
    role: NDArray[np.uint8]
    residual_px: NDArray[np.float64]
    details: dict[str, JsonValue] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Camera:
    """The orientation of one photo, or why there is none.

    Attributes:
        photo: name of the photo.
        status: `ok`, or the reason in one sentence; without `ok` the rest is None.
        intrinsics: interior orientation.
        rotation_camera_from_world: (3, 3) float64, det +1; x right, y down, z forward.
        translation_camera_from_world: (3,) float64 metres.
        covariance: (6, 6) float64 of (rotation vector, translation), or None.
        sigma0_px: standard deviation of unit weight, pixels.
        sigma_wall_m: predicted error on the wall, metres.
    """

    photo: str
    status: str
    intrinsics: Intrinsics | None = None
    rotation_camera_from_world: NDArray[np.float64] | None = None
    translation_camera_from_world: NDArray[np.float64] | None = None
    covariance: NDArray[np.float64] | None = None
    sigma0_px: float | None = None
    sigma_wall_m: float | None = None

    def viewing(self) -> ViewingCamera:
        """Give the camera that projects.

        Raises:
            ProductError: the photo is not oriented.
        """
        rotation, translation = self.rotation_camera_from_world, self.translation_camera_from_world
        if self.intrinsics is None or rotation is None or translation is None:
            raise ProductError(f"photo {self.photo} is not oriented: {self.status}")
        return self.intrinsics.posed(rotation, translation)


@dataclass(frozen=True, kw_only=True)
class Cameras(Product):
    """Orientations of a set of photos.

    Attributes:
        cameras: one per photo, in the photos' order.
        ties: the ties with their roles and residuals after the orientation, or None.
        details: what else the method says, JSON.
    """

    type_name: ClassVar[str] = "cameras"
    tolerances: ClassVar[Mapping[str, Tolerance]] = {
        "rotation_camera_from_world": Tolerance(limit=1e-5, unit="1"),
        "translation_camera_from_world": Tolerance(limit=1e-3, unit="m"),
        "covariance": Tolerance(limit=1e-4, unit="1"),
        "residual_px": Tolerance(limit=0.05, unit="px"),
    }

    cameras: tuple[Camera, ...]
    ties: Ties | None = None
    details: dict[str, JsonValue] = field(default_factory=dict)
