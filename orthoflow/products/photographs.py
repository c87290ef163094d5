"""Photographs, their interior and exterior orientations, and their ties to walls."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any, ClassVar, Final, Self

import numpy as np
from numpy.typing import NDArray

from orthoflow.diagnostics import DiagnosticSpec
from orthoflow.errors import ProductError
from orthoflow.geometry import WallFrame
from orthoflow.geometry.cameras import LensFreedom, ViewingCamera, unmeasured
from orthoflow.products.product import (
    JsonValue,
    Product,
    Tolerance,
    require_shapes,
)
from orthoflow.products.walls import Wall

# A photo counts as upside down if the cosine of the angle between its up direction and the vertical
# is below minus this value.
_UPRIGHT: Final = 0.5
# Ties on a floor or a ceiling do not determine the direction of the vertical in a photo. Directions
# along which ties extend less than _MIN_RELIEF of their longest extent are ignored, and the
# vertical is unknown if its scale is less than _MIN_VERTICAL of the scale over all axes.
_MIN_RELIEF: Final = 0.1
_MIN_VERTICAL: Final = 0.3
PHOTOS_UPSIDE_DOWN: Final = DiagnosticSpec(
    code="photos-upside-down",
    severity="error",
    text="{n_down} of {n_photos} photos are upside down: if the vertical axis of the scan points "
    "down, walls and orthoimages are upside down and floor and ceiling are swapped",
    remedy="set {step[read.scan]}.up={opposite}, or rotate the photos if they are upside down",
)
# Focal length relative to the longer side, assumed if neither a calibration nor EXIF provides it.
_USUAL_FOCAL: Final = 0.8


@dataclass(frozen=True, kw_only=True)
class Intrinsics:
    """Interior orientation; the centre of the first pixel is at (0.5, 0.5).

    Attributes:
        width: width in pixels.
        height: height in pixels.
        fx: focal length along u in pixels; `fy` along v.
        cx: u of the principal point in pixels; `cy` is its v.
        distortion: k1, k2, p1, p2, k3 (Brown's model, as in OpenCV).
        source: `calibration`, `exif`, `truth` or `estimated`.
        skew: pixels along u per unit of y / z; None if rows and columns are perpendicular.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)
    source: str = "calibration"
    skew: float | None = None

    @classmethod
    def of(cls, camera: ViewingCamera, *, source: str = "calibration") -> Self:
        """Return the interior orientation of a camera."""
        return cls(
            width=camera.width,
            height=camera.height,
            fx=camera.fx,
            fy=camera.fy,
            cx=camera.cx,
            cy=camera.cy,
            distortion=tuple(camera.distortion.tolist()),
            source=source,
            skew=camera.skew or None,
        )

    def posed(
        self,
        rotation: NDArray[np.float64] | None = None,
        translation: NDArray[np.float64] | None = None,
    ) -> ViewingCamera:
        """Return a camera with this lens at a pose, by default at the origin of the world.

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
            skew=self.skew or 0.0,
        )


@dataclass(frozen=True, kw_only=True)
class Photo:
    """One photograph.

    Attributes:
        name: file name, preceded by its folders in the input if several photos have the same file
            name. Poses and ties refer to a photo by this name.
        encoded: unchanged bytes of the file. Pixel coordinates refer to the image as stored; the
            EXIF orientation is not applied.
        width: width of the stored image in pixels.
        height: height of the stored image in pixels.
        exif_orientation: EXIF tag 1..8; 1 if there is no tag.
        exif_focal_px: focal length from EXIF in pixels, or None.
        intrinsics: calibrated interior orientation, or None.
        mask: PNG of the same size, white where pixels may be used (see `files.images`); None if
            all pixels may be used.
        camera: camera model and focal length, identical for photos with the same lens; empty if
            unknown.
        folder: folder of the file in the input; empty if all photos are in one folder.
    """

    name: str
    encoded: bytes
    width: int
    height: int
    exif_orientation: int = 1
    exif_focal_px: float | None = None
    intrinsics: Intrinsics | None = None
    mask: bytes | None = None
    camera: str = ""
    folder: str = ""

    def lens_prior(self) -> tuple[ViewingCamera, LensFreedom]:
        """Return the lens assumed before the orientation, from a calibration, EXIF or a default.

        Returns:
            A camera with the most probable lens, at the origin of the world, and the standard
            deviations of the uncertain lens parameters (none if calibrated).
        """
        if self.intrinsics is not None:
            return self.intrinsics.posed(), LensFreedom()
        longest_px, exif_px = max(self.width, self.height), self.exif_focal_px
        focal_px = exif_px or _USUAL_FOCAL * longest_px
        lens = Intrinsics(
            width=self.width,
            height=self.height,
            fx=focal_px,
            fy=focal_px,
            cx=0.5 * self.width,
            cy=0.5 * self.height,
        )
        return lens.posed(), unmeasured(longest_px, has_exif=exif_px is not None)


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
    """Lens calibrations by photo name or pattern; the first that matches a name applies.

    Attributes:
        patterns: photo names or shell patterns.
        intrinsics: interior orientation for each pattern.
    """

    type_name: ClassVar[str] = "calibration"

    patterns: tuple[str, ...]
    intrinsics: tuple[Intrinsics, ...]


class TieRole(IntEnum):
    """The role of a tie.

    Attributes:
        CONTROL: used to orient the photo.
        CHECK: withheld from the orientation, to check it.
        REJECTED: the tie contradicts the other ties, or its photo is not oriented.
    """

    CONTROL = 0
    CHECK = 1
    REJECTED = 2


@dataclass(frozen=True, kw_only=True)
class TieWall:
    """Properties of a wall that are needed for orientation.

    Attributes:
        name: label of the wall.
        corners_world: four corners (x, y, z) of its raster in metres: top-left, then
            counter-clockwise for the viewer, as in `WallFrame.corners_world`.
        normal_world: unit vector (x, y, z) towards the viewer; photos are never taken from behind.
        gsd_m: cell size of its raster in metres. None if the wall has no raster, in which case
            limits in cells do not apply.
        plane_index: index of its plane in `Planes`; None if unknown.
        frame: raster of a curved wall, whose normal is that at its middle; None on a plane.
    """

    name: str = ""
    corners_world: tuple[tuple[float, ...], ...]
    normal_world: tuple[float, ...]
    gsd_m: float | None = None
    plane_index: int | None = None
    frame: WallFrame | None = None

    def __post_init__(self) -> None:
        shapes = np.shape(self.corners_world), np.shape(self.normal_world)
        if shapes != ((4, 3), (3,)):
            raise ProductError(
                "the wall of a tie must have 4 corners and a normal, each with 3 coordinates; "
                f"got the shapes {shapes[0]} and {shapes[1]}"
            )

    @classmethod
    def of(cls, wall: Wall) -> Self:
        """Return the description of a wall for its ties."""
        frame = wall.frame
        return cls(
            name=wall.name,
            corners_world=tuple(tuple(corner) for corner in frame.corners_world().tolist()),
            normal_world=tuple(frame.facing_world.tolist()),
            gsd_m=frame.gsd_m,
            plane_index=wall.plane_index,
            frame=None if frame.bend is None else frame,
        )


@dataclass(frozen=True, kw_only=True)
class Ties(Product):
    """Points on walls, with known positions, that were measured in photos.

    A method may leave `walls` and `search_radius_px` empty, although both help to assess
    orientations. If `walls` is empty, walls are described by the points of the ties, and neither
    the visible side of a wall nor its cell size is known.

    Attributes:
        photo_names: names of the photos to which `photo` refers.
        photo: (n,) int32 index into `photo_names`.
        wall: (n,) int32 index of the wall, -1 if unknown.
        pixels_photo: (n, 2) float64 (u, v); the centre of the first pixel is at (0.5, 0.5).
        points_world: (n, 3) float64 metres.
        sigma_px: (n,) float64 pixels, a priori standard deviation of u and of v.
        sigma_m: (n,) float64 metres, a priori standard deviation of x, of y and of z. Adjustments
            propagate it to the photo and add the resulting variance to that of `sigma_px`.
        role: (n,) uint8 `TieRole`.
        residual_px: (n, 2) float64 observed minus computed; NaN before an orientation.
        walls: walls to which `wall` refers; empty if not given.
        by_hand: (n,) uint8, 1 for ties measured by hand; None if there are none. Such ties are
            never withheld, and their standard deviations are not estimated.
        search_radius_px: for each photo, the radius around the expected position of a tie within
            which the photo was searched (even wrong ties are within it); None if the whole photo
            was searched. Empty if all photos were searched completely.
        details: further results as JSON, intended only for users.
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
    by_hand: NDArray[np.uint8] | None = None
    walls: tuple[TieWall, ...] = ()
    search_radius_px: tuple[float | None, ...] = ()
    details: dict[str, JsonValue] = field(default_factory=dict)

    def __post_init__(self) -> None:
        count = len(self.photo)
        require_shapes(
            "ties",
            {
                "photo": (self.photo, (count,)),
                "wall": (self.wall, (count,)),
                "pixels_photo": (self.pixels_photo, (count, 2)),
                "points_world": (self.points_world, (count, 3)),
                "sigma_px": (self.sigma_px, (count,)),
                "sigma_m": (self.sigma_m, (count,)),
                "role": (self.role, (count,)),
                "residual_px": (self.residual_px, (count, 2)),
                "by_hand": (self.by_hand, (count,)),
            },
        )
        if count and not 0 <= int(self.photo.min()) <= int(self.photo.max()) < len(
            self.photo_names
        ):
            raise ProductError(
                f"ties.photo must be an index of one of {len(self.photo_names)} photos"
            )
        if self.search_radius_px and len(self.search_radius_px) != len(self.photo_names):
            raise ProductError(
                f"ties.search_radius_px must be empty or have one value per photo, got "
                f"{len(self.search_radius_px)} values for {len(self.photo_names)} photos"
            )

    def check_against(self, others: Mapping[str, Product]) -> None:
        """See `Product.check_against`.

        Raises:
            ProductError: a coordinate or a standard deviation of a tie is invalid, or a photo is
                unknown.
        """
        for name in ("pixels_photo", "points_world", "sigma_px", "sigma_m"):
            if not np.isfinite(getattr(self, name)).all():
                raise ProductError(f"ties.{name} must be finite")
        for name in ("sigma_px", "sigma_m"):
            if (getattr(self, name) < 0.0).any():
                raise ProductError(f"ties.{name} must be 0 or more")
        _require_photos("ties", self.photo_names, others)

    def upside_down(self, up: NDArray[np.float64]) -> dict[str, Any]:
        """Return the values of `PHOTOS_UPSIDE_DOWN` if most photos with ties are upside down.

        Each photo is approximated by an affine map of its ties that are not rejected.

        Args:
            up: (3,) unit vector, vertical axis of the scan.
        """
        tops = []
        kept = self.role != TieRole.REJECTED
        for photo in np.unique(self.photo[kept]):
            points, pixels = (
                given[kept & (self.photo == photo)]
                for given in (self.points_world, self.pixels_photo)
            )
            pixels_per_m = np.linalg.lstsq(
                points - points.mean(axis=0), pixels - pixels.mean(axis=0), rcond=_MIN_RELIEF
            )[0]
            above = up @ pixels_per_m
            scale = float(np.linalg.norm(above))
            is_known = scale > _MIN_VERTICAL * float(np.linalg.norm(pixels_per_m))
            tops.append(-float(above[1]) / scale if is_known else 0.0)
        return _upside_down(tops, up)

    def number(self, wall: int) -> int:
        """Return the wall number shown to users: the index of the plane in `planes.json`."""
        known = self.walls[wall].plane_index if 0 <= wall < len(self.walls) else None
        return wall if known is None else known


@dataclass(frozen=True, kw_only=True)
class Camera:
    """Orientation of one photo, or the reason why it is not oriented.

    Attributes:
        photo: name of the photo.
        status: `ok`, or one sentence with the reason why the photo is not oriented; all following
            fields but the last are then None.
        intrinsics: interior orientation.
        rotation_camera_from_world: (3, 3) float64, det +1; x right, y down, z forward.
        translation_camera_from_world: (3,) float64 metres.
        covariance: (6, 6) float64 covariance of the estimated pose, or None. The first three
            parameters are a small rotation vector dr in camera axes, radians, applied to the
            rotation R0 as exp(dr) R0; the others are `translation_camera_from_world`, metres.
        sigma0_px: a priori error of a pixel coordinate (median `Ties.sigma_px` of control ties)
            times the standard deviation of unit weight, which is 1 if the a priori errors in `Ties`
            are correct.
        sigma_wall_m: standard deviation on the wall due to `covariance` (including that of an
            estimated lens), metres.
        is_ambiguous: whether the photo is not oriented because its ties agree equally well with
            several poses, so that another match of the same content would not be evidence.
    """

    photo: str
    status: str
    intrinsics: Intrinsics | None = None
    rotation_camera_from_world: NDArray[np.float64] | None = None
    translation_camera_from_world: NDArray[np.float64] | None = None
    covariance: NDArray[np.float64] | None = None
    sigma0_px: float | None = None
    sigma_wall_m: float | None = None
    is_ambiguous: bool = False

    def viewing(self) -> ViewingCamera:
        """Return the camera model for projections.

        Raises:
            ProductError: the photo is not oriented.
        """
        rotation, translation = self.rotation_camera_from_world, self.translation_camera_from_world
        if self.intrinsics is None or rotation is None or translation is None:
            raise ProductError(f"photo {self.photo} is not oriented: {self.status}")
        return self.intrinsics.posed(rotation, translation)


@dataclass(frozen=True, kw_only=True)
class ResidualRow:
    """Statistics of the residuals (observed minus computed) of one photo, role, axis and unit.

    Attributes:
        photo: name of the photo.
        role: `control` or `check`.
        axis: `u` or `v` of the photo.
        unit: `px` in the photo, `cell` of the raster of the wall, or `mm` on the wall (pixels times
            the median size of a pixel on the wall).
        n: number of residuals.
        mean: arithmetic mean.
        shift_p: probability of a mean at least this far from zero if the expected value is zero
            (two-sided t-test); None for one tie.
        sd: standard deviation.
        median: median of the residuals.
        nmad: 1.4826 times the median absolute deviation from the median.
        skewness: third standardised moment; None if all residuals are the same.
        rmse: root mean square.
        p95: 95th percentile of absolute values.
        max: largest absolute value.
        beyond_own: share of residuals that exceed twice the RMSE of this axis.
        beyond_cells: share of residuals that exceed two cells of the raster of the wall; None if
            the cell size is unknown.
        beyond_any: share of ties whose residual in u or v exceeds twice the RMSE of that axis.
    """

    photo: str
    role: str
    axis: str
    unit: str
    n: int
    mean: float
    shift_p: float | None = None
    sd: float
    median: float
    nmad: float
    skewness: float | None = None
    rmse: float
    p95: float
    max: float
    beyond_own: float
    beyond_cells: float | None = None
    beyond_any: float


@dataclass(frozen=True, kw_only=True)
class Cameras(Product):
    """Orientations of a set of photos.

    Attributes:
        cameras: orientation of each photo, in the order of the photos.
        ties: ties with their roles and residuals after the orientation, or None.
        residual_table: statistics of the residuals of oriented photos; may be empty.
        details: further results as JSON, intended only for users.
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
    residual_table: tuple[ResidualRow, ...] = ()
    details: dict[str, JsonValue] = field(default_factory=dict)

    def upside_down(self, up: NDArray[np.float64]) -> dict[str, Any]:
        """Return the values of `PHOTOS_UPSIDE_DOWN` if most oriented photos are upside down.

        Args:
            up: (3,) unit vector, vertical axis of the scan.

        Returns:
            The values; empty if at most half of the photos are upside down.
        """
        # The up direction of a photo is the negative second axis of its camera, which points down.
        tops = [-one.viewing().rotation[1] @ up for one in self.cameras if one.status == "ok"]
        return _upside_down(tops, up)

    def check_against(self, others: Mapping[str, Product]) -> None:
        """See `Product.check_against`.

        Raises:
            ProductError: an orientation is not finite or not a rotation, or its photo is unknown.
        """
        for camera in self.cameras:
            rotation = camera.rotation_camera_from_world
            if camera.status != "ok":
                continue
            if rotation is None or camera.translation_camera_from_world is None:
                raise ProductError(f"camera {camera.photo} has the status ok, but no orientation")
            is_turn = rotation.shape == (3, 3) and np.allclose(
                rotation @ rotation.T, np.eye(3), atol=1e-6
            )
            if not is_turn or np.linalg.det(rotation) < 0.0:
                raise ProductError(
                    f"camera {camera.photo}: rotation_camera_from_world must be a rotation "
                    "(orthonormal, determinant +1)"
                )
            if not np.isfinite(camera.translation_camera_from_world).all():
                raise ProductError(
                    f"camera {camera.photo}: translation_camera_from_world must be finite"
                )
            spread = camera.covariance
            if spread is not None and not (
                np.isfinite(spread).all() and (np.diagonal(spread) >= 0.0).all()
            ):
                raise ProductError(
                    f"camera {camera.photo}: covariance must be finite, with variances of at least "
                    "0"
                )
        _require_photos("cameras", [camera.photo for camera in self.cameras], others)


def _upside_down(tops: Sequence[float], up: NDArray[np.float64]) -> dict[str, Any]:
    n_down = sum(float(top) < -_UPRIGHT for top in tops)
    if 2 * n_down <= len(tops):
        return {}
    axis = int(np.abs(up).argmax())
    opposite = f"{'-' if up[axis] > 0.0 else ''}{'xyz'[axis]}"
    return {"n_down": n_down, "n_photos": len(tops), "opposite": opposite}


def _require_photos(what: str, names: Iterable[str], others: Mapping[str, Product]) -> None:
    for product in others.values():
        known = {photo.name for photo in product.photos} if isinstance(product, Photos) else None
        unknown = [name for name in names if known is not None and name not in known]
        if unknown:
            raise ProductError(
                f"{what} refer to the photo {unknown[0]}, which is not an input of the step"
            )
