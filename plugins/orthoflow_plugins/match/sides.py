"""`face.photos`: find the visible side of walls from photos if the scanner stations are unknown."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from importlib.metadata import version
from typing import ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.images import photo_grey, photo_rgb
from orthoflow.geometry.frames import LEVEL_LIMIT_DEG, WallFrame, frame_over
from orthoflow.geometry.key_points import Features
from orthoflow.geometry.levels import REC_601
from orthoflow.geometry.slabs import Slab
from orthoflow.products import (
    Photo,
    Photos,
    Planes,
    PointCloud,
    SideSource,
    SurfaceMask,
    Wall,
)
from orthoflow.sdk import DiagnosticSpec, Method, MethodParams, MetricSpec, Ports, StepContext
from orthoflow.sdk.methods import Determinism
from orthoflow_plugins.match.key_points import (
    MIXTURES,
    PairingParams,
    mixed,
    side_matches,
    wall_features,
)
from orthoflow_plugins.match.pictures import (
    filled_smoothly,
    one_by_one,
    require_photos,
)

# Cell size relative to the point spacing.
_SPACINGS_PER_CELL: Final = 0.6
# Radius of gap filling.
_FILLED_CELLS: Final = 2
_MAX_CELLS: Final = 4_000_000
_MIN_POINTS: Final = 3
# Minimum number of inliers, summed over all photos, to decide the side of a plane.
_MIN_AGREEING: Final = 16
# Minimum ratio of these inliers to the inliers on the other side. A symmetric facade partly matches
# its mirror image.
_MIN_MARGIN_RATIO: Final = 2.0
# A plane faces the opposite way if its normal is within 45 degrees of the opposite direction.
_OPPOSITE_COSINE: Final = -math.sqrt(0.5)
SIDES_GUESSED: Final = DiagnosticSpec(
    code="plane-sides-guessed",
    severity="warning",
    text="neither stations nor photos determine from which side {n} of {n_planes} planes were "
    "seen ({planes}); the side with more of the other points was assumed to be the front",
    remedy="if an image is mirrored, set {step[read.scan]}.view_from",
    rank_by="n",
)


class FaceByPhotos(Method):
    """Turn planes whose side was guessed towards the side that the photos show.

    A wall seen from behind is a mirror image of its photos. If no scanner station determines the
    side of a plane, the cloud is projected onto a coarse raster in the plane, and the photos are
    matched with this picture and with its mirror image. The side with clearly more inliers is used.
    If the side of every plane is unclear in grey, mixtures of the colours of the photos are used. A
    plane whose side the photos do not determine is turned if it is between two planes with known
    sides that both face the opposite way. Planes with a known side, floors and ceilings are
    unchanged.
    """

    id: ClassVar[str] = "face.photos"
    determinism: ClassVar[Determinism] = "exact"
    metrics: ClassVar[tuple[MetricSpec, ...]] = (
        MetricSpec("n_planes_guessed", label="planes whose front side was checked with photos"),
        MetricSpec("n_planes_seen", label="planes whose front side was determined from photos"),
        MetricSpec("n_planes_turned", label="planes flipped to face the photos"),
    )
    citations: ClassVar[tuple[str, ...]] = (
        "Lowe 2004, Distinctive image features, doi:10.1023/B:VISI.0000029664.99615.94",
    )

    class Params(MethodParams):
        """No parameters."""

    class In(Ports):
        """The planes, the cloud in which they were found, and the photos."""

        planes: Planes
        cloud: PointCloud
        photos: Photos

    class Out(Ports):
        """The planes, some of them turned."""

        planes: Planes

    def run(self, inputs: In, params: Params, ctx: StepContext) -> Out:
        """Determine the side of each plane whose side was guessed."""
        del params
        planes, cloud = inputs.planes, inputs.cloud
        require_photos(inputs.photos)
        cloud.require_points(_MIN_POINTS)
        ctx.progress(0.0, "planes with an assumed front")
        level = math.cos(math.radians(LEVEL_LIMIT_DEG))
        is_level = np.abs(planes.normal @ planes.up) > level
        asked = [
            index
            for index in range(len(planes))
            if planes.side_source(index) == "guess" and not is_level[index]
        ]
        ctx.metric("n_planes_guessed", len(asked), "1")
        shown = cloud.intensity is not None or cloud.rgb is not None
        if not asked or not shown:
            ctx.metric("n_planes_turned", 0, "1")
            _warn_of_guesses(planes, planes.side_from, ctx)
            return self.Out(planes=planes)
        pictures = [_features(planes, index, cloud, ctx.cores) for index in asked]
        counts = self._counts(inputs.photos, pictures, ctx)
        sources: list[SideSource] = [planes.side_source(index) for index in range(len(planes))]
        n_turned = 0
        for index, (front, behind) in zip(asked, counts.tolist(), strict=True):
            if not _is_decided(front, behind):
                continue
            sources[index] = "photos"
            if behind > front:
                planes = planes.turned(index)
                n_turned += 1
                ctx.log(
                    f"{planes.names[index]}: flipped, because {behind} matches of photos agree "
                    f"with its other side, and only {front} with the assumed front"
                )
        for index in asked:
            if sources[index] == "guess" and _is_turned_away(planes, index, sources):
                planes = planes.turned(index)
                n_turned += 1
                ctx.log(f"{planes.names[index]}: flipped like the planes in front of and behind it")
        ctx.metric("n_planes_turned", n_turned, "1")
        ctx.metric("n_planes_seen", sources.count("photos"), "1")
        _warn_of_guesses(planes, sources, ctx)
        if "photos" not in sources:
            return self.Out(planes=planes)
        return self.Out(planes=replace(planes, side_from=tuple(sources)))

    def _counts(
        self,
        photos: Photos,
        pictures: Sequence[Features | None],
        ctx: StepContext,
    ) -> NDArray[np.intp]:
        """Count the inliers (planes, 2) on the front and on the back of each plane.

        The photos are matched in grey. If this does not determine the side of any plane, the first
        mixture of colours that determines one is used.
        """
        counts = np.zeros((len(pictures), 2), dtype=np.intp)

        def look(photo: Photo, mixture: str) -> NDArray[np.intp]:
            picture = photo_grey(photo) if mixture == "grey" else mixed(photo_rgb(photo), mixture)
            if picture is None:
                return np.zeros_like(counts)
            return side_matches(picture, pictures, PairingParams())

        for name in ("grey", *MIXTURES):
            tried = np.zeros_like(counts)
            found = one_by_one(partial(look, mixture=name), photos.photos, ctx.cores)
            for nth, matches in enumerate(found):
                ctx.progress((nth + 1) / (len(photos.photos) + 1), f"photos on both sides, {name}")
                tried += matches
            if any(_is_decided(front, behind) for front, behind in tried.tolist()):
                return tried
            if name == "grey":
                counts = tried
        return counts

    @classmethod
    def tools(cls) -> dict[str, str]:
        """OpenCV for detection and description of key points."""
        return {"opencv-python-headless": version("opencv-python-headless")}


def _is_decided(front: int, behind: int) -> bool:
    least = max(_MIN_AGREEING, _MIN_MARGIN_RATIO * min(front, behind))
    return max(front, behind) >= least


def _is_turned_away(planes: Planes, index: int, sources: Sequence[SideSource]) -> bool:
    """Return whether a plane is between planes with known sides that both face the opposite way.

    An example is a step of a fountain in front of a facade. Both are seen from the same side, but
    most points of the cloud, those of the facade, are behind the step.
    """
    known = np.array([source != "guess" for source in sources])
    opposite = known & (planes.normal @ planes.normal[index] < _OPPOSITE_COSINE)
    centre = planes.corners[index].mean(axis=0)
    in_front_m = planes.normal[opposite] @ centre - planes.offset[opposite]
    return bool((in_front_m > 0.0).any() and (in_front_m < 0.0).any())


def _warn_of_guesses(planes: Planes, sources: Sequence[SideSource], ctx: StepContext) -> None:
    named = sources or [planes.side_source(index) for index in range(len(planes))]
    guessed = [name for name, source in zip(planes.names, named, strict=True) if source == "guess"]
    if guessed:
        ctx.report(SIDES_GUESSED, n=len(guessed), n_planes=len(planes), planes=", ".join(guessed))


def _features(planes: Planes, index: int, cloud: PointCloud, cores: int) -> Features | None:
    """Find key points in a raster of the cloud on a plane, or None if there are none."""
    corners = planes.corners[index]
    area_m2 = float(
        np.linalg.norm(corners[3] - corners[0]) * np.linalg.norm(corners[1] - corners[0])
    )
    spacing_m = math.sqrt(area_m2 / max(1, int(planes.n_points[index])))
    cell_m = max(_SPACINGS_PER_CELL * spacing_m, math.sqrt(area_m2 / _MAX_CELLS))
    frame = frame_over(corners, planes.normal[index], gsd_m=cell_m)
    grey = _grey_on(frame, planes.tolerance_m, cloud, cores)
    known = np.isfinite(grey)
    wall = Wall(
        frame=frame,
        plane_index=index,
        name=planes.names[index],
        depth_m=np.where(known, np.float32(0.0), np.float32(np.nan)),
        sigma_m=np.full(frame.shape, np.nan, dtype=np.float32),
        count=known.astype(np.uint32),
        mask=np.where(known, SurfaceMask.MEASURED, SurfaceMask.VOID).astype(np.uint8),
        intensity=grey,
    )
    return wall_features(wall, PairingParams().max_features)


def _grey_on(
    frame: WallFrame, tolerance_m: float, cloud: PointCloud, cores: int
) -> NDArray[np.float32]:
    """Return grey values 0..1 (rows, cols) of the points nearest to the viewer; NaN elsewhere."""
    import cv2

    from orthoflow.geometry.rastering import topmost_points

    slab = Slab(frame=frame, front_m=tolerance_m, behind_m=tolerance_m)
    winners = topmost_points(cloud, slab, threads=cores)
    has_point = winners["point"] < len(cloud)
    points = winners["point"][has_point]
    grey = np.full(len(winners), np.nan, dtype=np.float32)
    if cloud.intensity is not None:
        grey[has_point] = cloud.intensity[points]
    elif cloud.rgb is not None:
        weights = REC_601.astype(np.float32)
        grey[has_point] = cloud.rgb[points].astype(np.float32) @ weights / np.float32(255.0)
    grey = grey.reshape(frame.shape)
    filled = filled_smoothly(grey)
    side = 2 * _FILLED_CELLS + 1
    near = cv2.dilate(np.isfinite(grey).astype(np.uint8), np.ones((side, side), np.uint8))
    filled[np.asarray(near) == 0] = np.nan
    return filled
