"""What leaves the simulation: the cloud in the world, and the truth about it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import Plane, wall_axes
from orthoflow.products import JsonValue, Planes, PointCloud, Truth
from orthoflow_plugins.simulate.building import TruePlane
from orthoflow_plugins.simulate.palace import Room
from orthoflow_plugins.simulate.scanner import HIGHEST_ELEVATION_DEG, LOWEST_ELEVATION_DEG, Scan
from orthoflow_plugins.simulate.sweeping import SPOILT

_CHUNK = 1 << 20


@dataclass(frozen=True, kw_only=True)
class Delivery:
    """A scanned room and where it lies.

    Attributes:
        room: the room, in its own frame.
        scan: the scans, in the same frame.
        world_from_room: (3, 3) rotation of zeros, ones and minus ones: turning is exact.
        shift_world_m: (3,) world position of the room's origin.
    """

    room: Room
    scan: Scan
    world_from_room: NDArray[np.float64]
    shift_world_m: NDArray[np.float64]

    @property
    def stations_world(self) -> NDArray[np.float64]:
        """Station (s, 3) of each scan, metres."""
        stations: NDArray[np.float64] = (
            self.scan.stations @ self.world_from_room.T + self.shift_world_m
        )
        return stations

    @property
    def up_world(self) -> NDArray[np.float64]:
        """Up (3,) in world axes."""
        return self.world_from_room[:, 2].copy()


def cloud_of(delivery: Delivery) -> PointCloud:
    """Give the cloud; a shift of the world changes its origin and its stations, nothing else."""
    points = delivery.scan.points
    in_room = (points.x, points.y, points.z)
    x, y, z = (_turned_axis(row, in_room) for row in delivery.world_from_room)
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


def truth_of(delivery: Delivery, cloud: PointCloud, parameters: Mapping[str, JsonValue]) -> Truth:
    """Give the truth; planes come in the order of their numbers of points."""
    rectangle = delivery.scan.points.rectangle
    scene = delivery.room.scene
    # One more entry, for spoilt points: index -2 counts from the end.
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
        details={
            "parameters": dict(parameters),
            "lowest_elevation_deg": LOWEST_ELEVATION_DEG,
            "highest_elevation_deg": HIGHEST_ELEVATION_DEG,
            "n_points": len(cloud),
            "n_spoilt": int(np.count_nonzero(rectangle == SPOILT)),
        },
    )


def _turned_axis(
    row: NDArray[np.float64], in_room: tuple[NDArray[np.float32], ...]
) -> NDArray[np.float32]:
    axis = int(np.argmax(np.abs(row)))
    return in_room[axis] if row[axis] > 0.0 else -in_room[axis]


def _true_planes(
    delivery: Delivery, order: NDArray[np.int64], n_points: NDArray[np.int64]
) -> Planes:
    chosen = [delivery.room.planes[index] for index in order]
    turned = [item.plane.normal @ delivery.world_from_room.T for item in chosen]
    count = len(chosen)
    return Planes(
        normal=np.array(turned),
        offset=np.array(
            [
                item.plane.offset_m + float(normal @ delivery.shift_world_m)
                for item, normal in zip(chosen, turned, strict=True)
            ]
        ),
        corners=np.array(
            [
                _corners_world(item, normal, delivery)
                for item, normal in zip(chosen, turned, strict=True)
            ]
        ),
        covariance=np.zeros((count, 4, 4)),
        n_points=n_points.astype(np.int64),
        rms_m=np.zeros(count),
        up=delivery.up_world,
        names=tuple(item.name for item in chosen),
        viewpoint="stations",
        details={"true": True},
    )


def _corners_world(
    item: TruePlane, normal: NDArray[np.float64], delivery: Delivery
) -> NDArray[np.float64]:
    """Corners of the rectangle along the wall axes that holds the plane's outline."""
    outline = item.outline @ delivery.world_from_room.T
    axes = wall_axes(normal, delivery.up_world)
    low, high = (outline @ axes.T).min(axis=0), (outline @ axes.T).max(axis=0)
    ends = np.array([[low[0], low[1]], [low[0], high[1]], [high[0], high[1]], [high[0], low[1]]])
    corners: NDArray[np.float64] = (
        item.plane.offset_m * normal + ends @ axes + delivery.shift_world_m
    )
    return corners


def _rms_m(cloud: PointCloud, planes: Planes, labels: NDArray[np.int16]) -> NDArray[np.float64]:
    """Root mean square distance of each plane's points, summed block by block in order."""
    offsets = planes.offset - planes.normal @ cloud.origin
    sums = np.zeros(len(planes))
    for start in range(0, len(cloud), _CHUNK):
        part = slice(start, start + _CHUNK)
        label = labels[part]
        points = np.column_stack([cloud.x[part], cloud.y[part], cloud.z[part]])
        for index in range(len(planes)):
            distances = Plane(
                normal=planes.normal[index], offset_m=float(offsets[index])
            ).distances_m(points[label == index].astype(np.float64))
            sums[index] += float(distances @ distances)
    rms: NDArray[np.float64] = np.sqrt(sums / np.maximum(planes.n_points, 1))
    return rms
