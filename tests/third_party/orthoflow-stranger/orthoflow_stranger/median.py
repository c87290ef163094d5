"""A small, honest plane detector: a robust total least squares fit to the largest level surface."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from orthoflow.errors import MethodError
from orthoflow.geometry import basis_from_up, wall_axes
from orthoflow.products import Planes, PointCloud, PointLabels
from orthoflow.sdk import Method, MethodParams, Ports, StepContext


class MedianPlanes(Method):
    """The level surface with the most points: histogram of heights, then a trimmed fit."""

    id = "plane.median"
    result_version = 1
    determinism = "exact"
    citations = ("https://doi.org/10.1080/14786440109462720",)

    class Params(MethodParams):
        tolerance_m: float = Field(0.05, gt=0, description="Largest distance of a point.")
        fit_tolerance_m: float = Field(0.01, gt=0, description="Largest distance in the fit.")

    class In(Ports):
        cloud: PointCloud

    class Out(Ports):
        planes: Planes
        labels: PointLabels

    def run(self, inputs: In, params: Params, ctx: StepContext) -> Out:
        cloud = inputs.cloud
        cloud.require_points(10)
        points = np.column_stack([cloud.x, cloud.y, cloud.z]).astype(np.float64)
        level = points @ cloud.up
        edges = np.arange(level.min() - 0.01, level.max() + 0.02, 0.01)
        counts, _ = np.histogram(level, edges)
        height = edges[np.argmax(counts)] + 0.005
        inside = np.abs(level - height) < params.tolerance_m
        if inside.sum() < 10:
            raise MethodError("no level surface has ten points: raise tolerance_m")
        normal, centre = cloud.up, points[inside].mean(axis=0)
        for tolerance in (params.tolerance_m, params.fit_tolerance_m, params.fit_tolerance_m):
            near = np.abs((points - centre) @ normal) < tolerance
            centre = points[near].mean(axis=0)
            normal = _smallest_axis(points[near] - centre, normal)
        distances = (points - centre) @ normal
        near = np.abs(distances) < params.tolerance_m
        if cloud.stations is not None and (cloud.stations[0] - cloud.origin - centre) @ normal < 0:
            normal = -normal
        rms_m = float(np.sqrt(np.mean(distances[np.abs(distances) < params.fit_tolerance_m] ** 2)))
        ctx.metric("rms_mm", 1000 * rms_m, "mm")
        planes = Planes(
            normal=normal[None],
            offset=np.array([normal @ (centre + cloud.origin)]),
            corners=_rectangle(points[near], centre, normal, cloud.up)[None] + cloud.origin,
            covariance=np.zeros((1, 4, 4)),
            n_points=np.array([near.sum()]),
            rms_m=np.array([rms_m]),
            up=basis_from_up(cloud.up)[2],
            names=("level",),
        )
        labels = np.where(near, 0, -1).astype(np.int16)
        return self.Out(planes=planes, labels=PointLabels(plane_index=labels))


def _smallest_axis(
    centred: NDArray[np.float64], before: NDArray[np.float64]
) -> NDArray[np.float64]:
    _, axes = np.linalg.eigh(centred.T @ centred)
    axis: NDArray[np.float64] = axes[:, 0]
    return axis if axis @ before > 0 else -axis


def _rectangle(
    points: NDArray[np.float64],
    centre: NDArray[np.float64],
    normal: NDArray[np.float64],
    up: NDArray[np.float64],
) -> NDArray[np.float64]:
    axes = wall_axes(normal, up)
    in_plane = (points - centre) @ axes.T
    (left, top), (right, bottom) = in_plane.min(axis=0), in_plane.max(axis=0)
    corners = np.array([[left, top], [left, bottom], [right, bottom], [right, top]])
    rectangle: NDArray[np.float64] = centre + corners @ axes
    return rectangle
