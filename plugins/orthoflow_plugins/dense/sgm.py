"""`dense.sgm`: a point cloud from oriented photos by semi-global matching."""

from __future__ import annotations

from typing import ClassVar, Final, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from orthoflow.errors import MethodError
from orthoflow.files.images import photo_rgb
from orthoflow.geometry import UpDirection, up_vector
from orthoflow.geometry.cameras import ViewingCamera, opencv_matrix
from orthoflow.products import Cameras, Photo, Photos, PointCloud
from orthoflow.sdk import Method, MethodParams, MetricSpec, Ports, StepContext

# Maximum angle between the base and the rows of a photo. The rows of a rectified pair are parallel
# to its base, so photos taken one above the other cannot be paired.
_ALONG_ROWS: Final = np.cos(np.radians(30.0))
# Minimum angle between the base and the optical axes.
_SIDEWAYS: Final = np.sin(np.radians(25.0))
# Maximum angle between the optical axes.
_SAME_VIEW: Final = np.cos(np.radians(30.0))
# Best parallax, as a share of the photo width, corresponding to the usual overlap of 70 %. With an
# overlap of less than 50 %, photos look too different to be matched; with a very short base, depths
# are inaccurate.
_BEST_PARALLAX: Final = 0.3
_LEAST_PARALLAX: Final = 0.05
_MOST_PARALLAX: Final = 0.5
# Settings of OpenCV's matcher for colour images, from its documentation.
_BLOCK_PX: Final = 5
_SMALL_STEP: Final = 8 * 3 * _BLOCK_PX**2
_LARGE_STEP: Final = 32 * 3 * _BLOCK_PX**2


class _View(NamedTuple):
    photo: Photo
    camera: ViewingCamera


class DenseSgm(Method):
    """Compute surface points from pairs of neighbouring oriented photos (OpenCV's SGM).

    Each photo is paired with the photo to its right that has a similar viewing direction and whose
    overlap is closest to 70 %. The angle between the base and the photo's rows must be at most 30
    degrees, that between the base and the optical axis at least 25 degrees, that between the two
    optical axes at most 30 degrees, and the overlap 50 to 95 %. Points get the colour of the left
    photo. The points of each pair are one scan, whose station is the projection centre of the left
    photo. Photos taken one above the other are not matched.
    """

    id: ClassVar[str] = "dense.sgm"
    determinism = "loose"
    metrics = (
        MetricSpec("n_pairs", label="pairs of photos"),
        MetricSpec("n_points", label="points"),
        MetricSpec("matched_share", label="share of matched pixels of the left photos"),
    )
    citations: ClassVar[tuple[str, ...]] = (
        (
            "Hirschmueller 2008, Stereo processing by semiglobal matching and mutual information, "
            "doi:10.1109/TPAMI.2007.1166"
        ),
    )

    class Params(MethodParams):
        """Range of distances to the surface, and density of its points."""

        nearest_m: float = Field(1.0, gt=0.0, description="Distance to the nearest surface.")
        farthest_m: float = Field(
            10.0, gt=0.0, description="Distance to the farthest surface; larger ranges take longer."
        )
        spacing_m: float = Field(
            0.0,
            ge=0.0,
            description="Each pair of photos keeps one point per cube of this side; with 0, "
            "it keeps one per pixel.",
        )
        up: UpDirection = Field("z", description="World direction that is up.")

        @model_validator(mode="after")
        def _farthest_is_beyond_nearest(self) -> Self:
            if self.farthest_m <= self.nearest_m:
                raise ValueError(
                    f"farthest_m {self.farthest_m:g} must be greater than nearest_m "
                    f"{self.nearest_m:g}"
                )
            return self

    class In(Ports):
        """The photos and their orientations."""

        photos: Photos
        cameras: Cameras

    class Out(Ports):
        """The points from all pairs."""

        cloud: PointCloud

    def run(self, inputs: In, params: Params, ctx: StepContext) -> Out:
        """Choose pairs of photos, match each pair, and join the points."""
        views = _oriented(inputs)
        distance_m = float(np.sqrt(params.nearest_m * params.farthest_m))
        neighbours = [(left, _right_of(left, views, distance_m)) for left in views]
        pairs = [(left, right) for left, right in neighbours if right is not None]
        if not pairs:
            raise MethodError(
                f"no pairs were found among the oriented photos ({len(views)}): neighbouring "
                "photos with similar viewing directions must overlap sideways by 50 to 95 % at a "
                f"distance of {distance_m:.2g} m (from nearest_m and farthest_m)"
            )
        parts = []
        n_pixels = n_matched = 0
        for done, (left, right) in enumerate(pairs):
            ctx.progress(done / len(pairs), f"{left.photo.name} and {right.photo.name}")
            points, rgb, shown = _matched(left, right, params)
            n_pixels, n_matched = n_pixels + shown, n_matched + len(points)
            if params.spacing_m:
                cubes = np.floor(points / params.spacing_m).astype(np.int64)
                kept = np.unique(cubes, axis=0, return_index=True)[1]
                points, rgb = points[kept], rgb[kept]
            parts.append((points, rgb))
        n_points = sum(len(points) for points, _ in parts)
        if not n_points:
            raise MethodError(
                f"no pair of photos matches between {params.nearest_m:g} and "
                f"{params.farthest_m:g} m: set nearest_m and farthest_m to the range of the surface"
            )
        ctx.metric("n_pairs", len(pairs), "1")
        ctx.metric("n_points", n_points, "1")
        ctx.metric("matched_share", n_matched / n_pixels, "1")
        origin = np.floor(np.mean([left.camera.centre_world for left, _ in pairs], axis=0))
        x, y, z = (np.concatenate([points for points, _ in parts]) - origin).T.astype(np.float32)
        cloud = PointCloud(
            origin=origin,
            x=x.copy(),
            y=y.copy(),
            z=z.copy(),
            up=up_vector(params.up),
            rgb=np.concatenate([rgb for _, rgb in parts]),
            scan=np.repeat(np.arange(len(parts)), [len(points) for points, _ in parts]).astype(
                np.uint16
            ),
            stations=np.array([left.camera.centre_world for left, _ in pairs]),
            stations_source="file",
        )
        return self.Out(cloud=cloud)


def _oriented(inputs: DenseSgm.In) -> list[_View]:
    cameras = {camera.photo: camera for camera in inputs.cameras.cameras if camera.status == "ok"}
    return [
        _View(photo, cameras[photo.name].viewing())
        for photo in inputs.photos.photos
        if photo.name in cameras
    ]


def _right_of(left: _View, views: list[_View], distance_m: float) -> _View | None:
    """Return the photo to the right with the best overlap for matching; None if there is none."""
    lens, axes = left.camera, left.camera.rotation
    found: list[tuple[float, int]] = []
    for place, other in enumerate(views):
        base = axes @ (other.camera.centre_world - lens.centre_world)
        sideways = float(np.hypot(base[0], base[1]))
        # Displacement of the surface between the two photos, as a share of the photo width.
        parallax = lens.fx * sideways / distance_m / lens.width
        if (
            _LEAST_PARALLAX <= parallax <= _MOST_PARALLAX
            and base[0] >= _ALONG_ROWS * sideways
            and sideways >= _SIDEWAYS * float(np.linalg.norm(base))
            and axes[2] @ other.camera.rotation[2] >= _SAME_VIEW
            and axes[0] @ other.camera.rotation[0] >= _SAME_VIEW
        ):
            found.append((abs(np.log(parallax / _BEST_PARALLAX)), place))
    return views[min(found)[1]] if found else None


def _matched(
    left: _View, right: _View, params: DenseSgm.Params
) -> tuple[NDArray[np.float64], NDArray[np.uint8], int]:
    """Match a pair of photos.

    Returns:
        Points (n, 3) in world coordinates, their colours (n, 3), and the number of pixels tried.
    """
    import cv2

    images = [photo_rgb(view.photo) for view in (left, right)]
    first, second = left.camera, right.camera
    turn = second.rotation @ first.rotation.T
    shift = second.translation - turn @ first.translation
    size = (first.width, first.height)
    matrices = [opencv_matrix(first), opencv_matrix(second)]
    lenses = [first.distortion, second.distortion]
    r1, r2, p1, p2, back, _, _ = cv2.stereoRectify(
        matrices[0], lenses[0], matrices[1], lenses[1], size, turn, shift[:, None], alpha=-1
    )
    rectified = [
        cv2.remap(
            image, *cv2.initUndistortRectifyMap(k, lens, r, p, size, cv2.CV_32FC1), cv2.INTER_LINEAR
        )
        for image, k, lens, r, p in zip(images, matrices, lenses, (r1, r2), (p1, p2), strict=True)
    ]
    reach = abs(p2[0, 3])
    most, least = (int(reach / distance) for distance in (params.nearest_m, params.farthest_m))
    # OpenCV requires a multiple of 16. The number must be small enough that some pixels remain to
    # be matched.
    n_disparities = 16 * min(-(-(most - least) // 16), (size[0] - least - _BLOCK_PX) // 16 - 1)
    if n_disparities < 16:
        return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.uint8), size[0] * size[1]
    matcher = cv2.StereoSGBM.create(
        minDisparity=least,
        numDisparities=n_disparities,
        blockSize=_BLOCK_PX,
        P1=_SMALL_STEP,
        P2=_LARGE_STEP,
        disp12MaxDiff=1,
        uniquenessRatio=10,
        speckleWindowSize=100,
        speckleRange=2,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )
    disparity = matcher.compute(*rectified).astype(np.float32) / 16.0
    kept = disparity >= max(least, 1)
    in_view = cv2.reprojectImageTo3D(disparity, back)[kept].astype(np.float64) @ r1
    points = (in_view - first.translation) @ first.rotation
    return points, np.asarray(rectified[0][kept], dtype=np.uint8), kept.size
