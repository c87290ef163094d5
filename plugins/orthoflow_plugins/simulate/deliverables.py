"""Results of the simulation: cloud, ground truth and check points, with their metrics."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion

from orthoflow.files.images import decode_image, encode_webp
from orthoflow.geometry import frame_over, wall_axes
from orthoflow.geometry.rows import Rows
from orthoflow.geometry.scene_views import SceneCameras, render
from orthoflow.geometry.scenes import Scene, SurfaceRole, TextureKind
from orthoflow.products import CheckPoints, JsonValue, Photos, Planes, PointCloud, Truth
from orthoflow.sdk import StepContext
from orthoflow_plugins.simulate.photographs import Shot, true_cameras
from orthoflow_plugins.simulate.room_model import Room
from orthoflow_plugins.simulate.scanning import (
    HIGHEST_ELEVATION_DEG,
    LOWEST_ELEVATION_DEG,
    SPOILT,
    Scan,
)

_CHUNK = 1 << 20
_PICTURE_GSD_M = 0.01
_TILE_M = 0.1
_THUMB_PX = 300
_FLAT: Final = "flat"
_VERTICAL_EDGE: Final = "vertical edge"
# Spacing of the painted lines of a fresco, in periods (see `geometry.scene_rays`).
_LATTICE: Final = 0.9
_CLEAR_M: Final = 0.04
# Value of `scene.plane_index` for the main wall, which is built first.
_MAIN_WALL: Final = 0
_INSIDE_M: Final = 0.004
_LIFT_M: Final = 0.01


@dataclass(frozen=True, kw_only=True)
class Delivery:
    """A scanned room and its position in the world.

    Attributes:
        room: the room in its own frame.
        scan: the scans, in the room frame.
        world_from_room: (3, 3) rotation; exact if its elements are 0, 1 or -1.
        shift_world_m: (3,) world position of the room's origin.
    """

    room: Room
    scan: Scan
    world_from_room: NDArray[np.float64]
    shift_world_m: NDArray[np.float64]

    @property
    def stations_world(self) -> NDArray[np.float64]:
        """World coordinates (s, 3) of the stations, metres."""
        return self.scan.stations @ self.world_from_room.T + self.shift_world_m

    @property
    def up_world(self) -> NDArray[np.float64]:
        """Unit vector (3,) upwards in world axes."""
        return self.world_from_room[:, 2].copy()


def cloud_of(delivery: Delivery) -> PointCloud:
    """Return the cloud; a shift of the room in the world only changes its origin and stations."""
    points = delivery.scan.points
    x, y, z = (
        # If axes are only permuted, these products are exact.
        np.asarray(
            sum(
                share * axis
                for share, axis in zip(
                    row.astype(np.float32), (points.x, points.y, points.z), strict=True
                )
                if share != 0.0
            )
        )
        for row in delivery.world_from_room
    )
    return PointCloud(
        origin=delivery.shift_world_m.copy(),
        x=x,
        y=y,
        z=z,
        up=delivery.up_world,
        intensity=points.intensity,
        rgb=points.rgb,
        scan=delivery.scan.scan,
        row=delivery.scan.row,
        column=delivery.scan.column,
        stations=delivery.stations_world,
        stations_source="file",
        source={"simulated": True},
    )


def truth_of(
    delivery: Delivery,
    cloud: PointCloud,
    shots: tuple[Shot, ...],
    parameters: Mapping[str, JsonValue],
) -> Truth:
    """Return the ground truth, with planes in descending order of the number of points.

    Args:
        delivery: the scanned room.
        cloud: the scanned points in world coordinates.
        shots: the photos, in the room frame.
        parameters: parameters of the simulation, which are only recorded.
    """
    rectangle = delivery.scan.points.rectangle
    scene = delivery.room.scene
    # The last entry is for gross outliers and mixed distances.
    plane_of = np.append(scene.plane_index, np.int16(-1)).astype(np.int16)
    raw = plane_of[np.where(rectangle == SPOILT, len(scene), rectangle)]
    n_points = np.bincount(raw + 1, minlength=len(delivery.room.planes) + 1)[1:]
    order = np.argsort(-n_points, kind="stable")
    rank = np.full(len(order) + 1, -1, dtype=np.int16)
    rank[order] = np.arange(len(order), dtype=np.int16)
    labels = rank[raw]
    planes = _true_planes(delivery, order, n_points[order])
    turned = scene.turned(delivery.world_from_room)
    return Truth(
        scene=replace(
            turned, origin=delivery.shift_world_m.copy(), plane_index=rank[scene.plane_index]
        ),
        planes=replace(planes, rms_m=_rms_m(cloud, planes, labels)),
        labels=labels,
        stations=delivery.stations_world,
        lowest_elevation_deg=LOWEST_ELEVATION_DEG,
        highest_elevation_deg=HIGHEST_ELEVATION_DEG,
        n_spoilt=int(np.count_nonzero(rectangle == SPOILT)),
        cameras=true_cameras(shots, delivery.world_from_room, delivery.shift_world_m)
        if shots
        else None,
        photos=tuple(shot.taken for shot in shots),
        details={"parameters": dict(parameters), "n_points": len(cloud)},
    )


def report_room(truth: Truth, cloud: PointCloud, ctx: StepContext) -> None:
    """Report metrics, and the true orthoimage of the main wall."""
    main = truth.planes.names.index("main wall")
    ctx.metric("n_points", len(cloud), "1")
    ctx.metric("n_true_planes", len(truth.planes), "1")
    ctx.metric("main_wall_points", int(truth.planes.n_points[main]), "1")
    ctx.metric("outlier_share", truth.n_spoilt / len(cloud), "1")
    step = measured_step(truth, cloud, main)
    if step is not None:
        ctx.metric("scan_step_median_mm", 1000.0 * step[0], "mm")
        ctx.metric("scan_step_p90_mm", 1000.0 * step[1], "mm")
    ctx.figure(
        "main_wall",
        partial(_picture, truth, main, ctx.cores),
        f"True orthoimage of the main wall with {_PICTURE_GSD_M * 1000:.0f} mm pixels, for "
        "comparison with the result, in which blurred or doubled edges are errors.",
    )


def report_photos(photos: Photos, shots: tuple[Shot, ...], ctx: StepContext) -> None:
    """If there are photos, report metrics and a contact sheet."""
    if not photos.photos:
        return
    ctx.metric("n_photos", len(photos.photos), "1")
    ctx.metric("photo_megapixels", sum(p.width * p.height for p in photos.photos) / 1e6, "1")
    ctx.metric("photo_gsd_mm", float(np.mean([1000.0 * shot.taken.gsd_m for shot in shots])), "mm")
    ctx.metric("photo_obliquity_max_deg", max(shot.taken.obliquity_deg for shot in shots), "deg")
    ctx.figure(
        "photos",
        partial(_contact_sheet, photos),
        "The photos, in the order of their names. Orthoimages are good where several photos show "
        "a wall frontally; blur, and parts that no photo shows, cannot be corrected later.",
    )


def _contact_sheet(photos: Photos) -> bytes:
    small = []
    for photo in photos.photos:
        step = max(1, photo.width // _THUMB_PX)
        small.append(decode_image(photo.encoded, photo.name)[::step, ::step])
    per_row = math.ceil(math.sqrt(len(small)))
    blank = np.zeros_like(small[0])
    small += [blank] * (-len(small) % per_row)
    rows = [np.hstack(small[i : i + per_row]) for i in range(0, len(small), per_row)]
    return encode_webp(np.vstack(rows))


def measured_step(truth: Truth, cloud: PointCloud, plane: int) -> tuple[float, float] | None:
    """Measure the point spacing on a plane in 10 cm tiles; None if no tile is entirely inside.

    Returns:
        The median and the 90th percentile over the tiles, in metres, of the spacing of a square
        grid with the same density.
    """
    frame = frame_over(truth.planes.corners[plane], truth.planes.normal[plane], gsd_m=_TILE_M)
    counts = np.zeros(frame.shape, dtype=np.int64)
    for start in range(0, len(cloud), _CHUNK):
        chosen = np.flatnonzero(truth.labels[start : start + _CHUNK] == plane) + start
        pixels = np.floor(frame.wall_from_world(cloud.points_world(chosen))[:, :2]).astype(int)
        inside = np.all((pixels >= 0) & (pixels < [frame.width, frame.height]), axis=1)
        np.add.at(counts, (pixels[inside, 1], pixels[inside, 0]), 1)
    # A tile is entirely inside the wall if all neighbouring tiles contain points.
    whole = counts[binary_erosion(counts > 0, np.ones((3, 3), dtype=np.bool_))]
    if whole.size == 0:
        return None
    steps = _TILE_M / np.sqrt(whole)
    return float(np.median(steps)), float(np.percentile(steps, 90))


def _picture(truth: Truth, plane: int, cores: int) -> bytes:
    corners, normal = truth.planes.corners[plane], truth.planes.normal[plane]
    frame = frame_over(corners, normal, gsd_m=_PICTURE_GSD_M)
    image = render(truth.scene, frame, front_m=0.3, behind_m=0.3, supersample=2, cores=cores)
    return encode_webp(np.nan_to_num(image.rgb).round().astype(np.uint8))


def _true_planes(
    delivery: Delivery, order: NDArray[np.int64], n_points: NDArray[np.int64]
) -> Planes:
    chosen = [delivery.room.planes[index] for index in order]
    turn, shift_m = delivery.world_from_room, delivery.shift_world_m
    normals = [item.plane.normal @ turn.T for item in chosen]
    corners = []
    for item, normal in zip(chosen, normals, strict=True):
        # Compute the bounding rectangle of the outline along the wall axes.
        axes = wall_axes(normal, delivery.up_world)
        along = item.outline @ turn.T @ axes.T
        (left, low), (right, high) = along.min(axis=0), along.max(axis=0)
        ends = np.array([[left, low], [left, high], [right, high], [right, low]])
        corners.append(item.plane.offset_m * normal + ends @ axes + shift_m)
    count = len(chosen)
    return Planes(
        normal=np.array(normals),
        offset=np.array(
            [
                item.plane.offset_m + float(normal @ shift_m)
                for item, normal in zip(chosen, normals, strict=True)
            ]
        ),
        corners=np.array(corners),
        covariance=np.zeros((count, 4, 4)),
        n_points=n_points.astype(np.int64),
        rms_m=np.zeros(count),
        up=delivery.up_world,
        names=tuple(item.name for item in chosen),
        viewpoint="stations",
        details={"true": True},
    )


def _rms_m(cloud: PointCloud, planes: Planes, labels: NDArray[np.int16]) -> NDArray[np.float64]:
    """Return the RMS distance of points from their planes; the order of summation is fixed."""
    offsets = planes.offset - planes.normal @ cloud.origin
    sums = np.zeros(len(planes))
    for start in range(0, len(cloud), _CHUNK):
        part = np.flatnonzero(labels[start : start + _CHUNK] >= 0) + start
        own = labels[part]
        # Do not use a dot product, because its order of summation in BLAS depends on the number of
        # threads.
        distances = -offsets[own]
        for axis, values in enumerate((cloud.x, cloud.y, cloud.z)):
            distances += planes.normal[own, axis] * values[part]
        sums += np.bincount(own, distances**2, minlength=len(planes))
    return np.sqrt(sums / np.maximum(planes.n_points, 1))


@dataclass(frozen=True, kw_only=True)
class _Spots(Rows):
    """Positions on rectangles: indices (n,) of the rectangles, and (a, b) in metres (n, 2)."""

    rectangle: NDArray[np.int64]
    in_rectangle: NDArray[np.float64]

    def moved(self, step: NDArray[np.float64]) -> _Spots:
        """Return positions displaced by a common vector (2,) or by individual vectors (n, 2)."""
        return _Spots(rectangle=self.rectangle, in_rectangle=self.in_rectangle + step)

    def points(self, scene: Scene) -> NDArray[np.float64]:
        chosen = self.rectangle
        return (
            scene.centre[chosen]
            + self.in_rectangle[:, :1] * scene.axis_a[chosen]
            + self.in_rectangle[:, 1:] * scene.axis_b[chosen]
        )


def check_points(delivery: Delivery, views: SceneCameras, *, n_most: int) -> CheckPoints:
    """Choose check points of each class on the main wall.

    Points of the class `flat` are crossings of the painted lines of a fresco, surrounded by at
    least 4 cm of flat wall. Points of the class `vertical edge` are front corners of mouldings.
    Each point is visible from at least one station.

    Args:
        delivery: the scanned room.
        views: scene of the room, prepared for rendering.
        n_most: maximum number of points per class.
    """
    scene, stations = delivery.room.scene, np.unique(delivery.scan.stations, axis=0)
    chosen = {
        _FLAT: _spread(_crossings(scene, views, stations), n_most),
        _VERTICAL_EDGE: _spread(_corners(scene, views, stations), n_most),
    }
    points = np.concatenate(list(chosen.values())) @ delivery.world_from_room.T
    names = [
        f"{kind[0].upper()}{i:02d}" for kind, found in chosen.items() for i in range(len(found))
    ]
    return CheckPoints(
        names=tuple(names),
        points_world=points + delivery.shift_world_m,
        classes=tuple(kind for kind, found in chosen.items() for _ in found),
        wall=np.full(len(points), -1, dtype=np.int32),
        pixels_wall=np.full((len(points), 2), np.nan),
    )


def _crossings(
    scene: Scene, views: SceneCameras, stations: NDArray[np.float64]
) -> NDArray[np.float64]:
    frescos = (scene.plane_index == _MAIN_WALL) & (scene.texture == TextureKind.FRESCO)
    spots = _Spots.joined([_lattice(scene, int(index)) for index in np.flatnonzero(frescos)])
    around = [
        spots.moved(np.array([right, up]))
        for right in (-_CLEAR_M, 0.0, _CLEAR_M)
        for up in (-_CLEAR_M, 0.0, _CLEAR_M)
    ]
    clear = np.all([_are_seen(scene, views, place, stations) for place in around], axis=0)
    return spots.points(scene)[clear]


def _lattice(scene: Scene, index: int) -> _Spots:
    """Return the crossings of the painted lines of a fresco."""
    step = _LATTICE * scene.texture_params[index, 5]
    a0, a1, b0, b1 = scene.extent[index] / step
    a, b = np.meshgrid(np.arange(np.ceil(a0), a1), np.arange(np.ceil(b0), b1))
    places = step * np.column_stack([a.ravel(), b.ravel()])
    return _Spots(rectangle=np.full(len(places), index), in_rectangle=places)


def _corners(
    scene: Scene, views: SceneCameras, stations: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the corners of the front faces of mouldings."""
    walls = np.flatnonzero((scene.plane_index == _MAIN_WALL) & (scene.role == SurfaceRole.WALL))
    normal, foot = scene.normal[walls[0]], scene.centre[walls[0]]
    heights = (scene.centre - foot) @ normal
    fronts = np.flatnonzero(
        (scene.role == SurfaceRole.RELIEF)
        & (np.abs(scene.normal @ normal) > 1.0 - 1e-9)
        & (np.abs(heights) < 0.5)
    )
    inwards = np.tile([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]], (len(fronts), 1))
    spots = _Spots(
        rectangle=np.repeat(fronts, 4),
        in_rectangle=scene.extent[fronts][:, [[0, 2], [0, 3], [1, 2], [1, 3]]].reshape(-1, 2),
    )
    seen = _are_seen(scene, views, spots.moved(_INSIDE_M * inwards), stations)
    # If two bars meet at a corner, it is inside a larger face and not on an edge.
    beside = spots.moved(_INSIDE_M * inwards * np.array([-1.0, 1.0]))
    return spots.points(scene)[seen & ~_are_level(scene, views, beside)]


def _are_seen(
    scene: Scene, views: SceneCameras, spots: _Spots, stations: NDArray[np.float64]
) -> NDArray[np.bool_]:
    points = spots.points(scene)
    seen = np.zeros(len(points), dtype=np.bool_)
    for station in stations:
        hits = views.cast(station, points - station)
        seen |= (hits.rectangle == spots.rectangle) & (np.abs(hits.t - 1.0) < 1e-6)
    return seen


def _are_level(scene: Scene, views: SceneCameras, spots: _Spots) -> NDArray[np.bool_]:
    """Return a mask (n,) of positions that are on the visible surface, of any rectangle."""
    points, normals = spots.points(scene), scene.normal[spots.rectangle]
    inwards = np.where(np.einsum("ij,ij->i", normals, points) > 0.0, -1.0, 1.0)[:, None] * normals
    hits = views.cast(points + _LIFT_M * inwards, -inwards)
    return np.abs(hits.t - _LIFT_M) < 1e-4


def _spread(points: NDArray[np.float64], n_most: int) -> NDArray[np.float64]:
    """Choose points far apart: each is the one farthest from those chosen before."""
    if len(points) <= n_most:
        return points
    chosen = [0]
    nearest = np.linalg.norm(points - points[0], axis=1)
    while len(chosen) < n_most:
        chosen.append(int(np.argmax(nearest)))
        nearest = np.minimum(nearest, np.linalg.norm(points - points[chosen[-1]], axis=1))
    spread: NDArray[np.float64] = points[np.sort(chosen)]
    return spread
