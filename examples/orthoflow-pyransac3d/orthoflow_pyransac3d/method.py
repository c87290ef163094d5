"""`plane.pyransac3d`: find planes one after the other with pyRANSAC-3D's `Plane.fit`."""

from __future__ import annotations

import random
from importlib.metadata import version

import numpy as np
from orthoflow.errors import MethodError
from orthoflow.geometry import wall_axes
from orthoflow.products import Planes, PointCloud, PointLabels
from orthoflow.sdk import Method, MethodParams, Ports, StepContext
from pydantic import Field


class PyRansac3d(Method):
    """Find the plane with the most points in a sample, then the next one in the remaining points.

    Each plane is fitted to the points near it, since a plane through three random points depends on
    their noise.
    """

    id = "plane.pyransac3d"
    result_version = 1
    determinism = "seeded"
    citations = ("pyRANSAC-3D, doi:10.5281/zenodo.7212567",)

    class Params(MethodParams):
        """Parameters of the search, and when it ends."""

        tolerance_m: float = Field(
            0.03, gt=0, description="Largest distance of a point to the plane it belongs to."
        )
        n_planes_max: int = Field(6, ge=1, description="Planes looked for at most.")
        n_trials: int = Field(300, ge=1, description="Random planes tried for each.")
        n_sampled: int = Field(20_000, ge=100, description="Points that are looked at.")
        min_share: float = Field(
            0.05,
            gt=0,
            le=1,
            description="Smaller planes, as a share of the sample, end the search.",
        )

    class In(Ports):
        """The cloud."""

        cloud: PointCloud

    class Out(Ports):
        """The planes and the labels of the points."""

        planes: Planes
        labels: PointLabels

    def run(self, inputs: In, params: Params, ctx: StepContext) -> Out:
        """Find planes until the next one is too small."""
        cloud = inputs.cloud
        cloud.require_points(100)
        points = np.column_stack([cloud.x, cloud.y, cloud.z]).astype(np.float64)
        n_sampled = min(params.n_sampled, len(points))
        rest = points[ctx.rng.choice(len(points), size=n_sampled, replace=False)]
        found = []
        while len(found) < params.n_planes_max and len(rest) >= 100:
            ctx.progress(len(found) / params.n_planes_max, f"plane {len(found)}")
            normal, centre = next_plane(rest, params, ctx)
            near = np.abs((rest - centre) @ normal) < params.tolerance_m
            if near.sum() < max(3, params.min_share * n_sampled):
                break
            found.append((normal, centre))
            rest = rest[~near]
        if not found:
            raise MethodError("no plane has enough of the points: lower min_share")
        return self.Out(**products(points, cloud, found, params, ctx))

    @classmethod
    def tools(cls) -> dict[str, str]:
        """Return the version of the library that determines the results."""
        return {"pyransac3d": version("pyransac3d")}


def next_plane(points, params, ctx):
    """Return normal and centre (3,) of the plane fitted to most of the points (n, 3)."""
    import pyransac3d

    # The library uses Python's global random generator; seed it from ours and restore it
    # afterwards.
    state = random.getstate()
    random.seed(int(ctx.rng.integers(2**32)))
    try:
        equation, inliers = pyransac3d.Plane().fit(
            points, thresh=params.tolerance_m, maxIteration=params.n_trials
        )
    finally:
        random.setstate(state)
    if len(equation) != 4:
        raise MethodError("no three of the points span a plane: are they all in one place?")
    near = points[inliers]
    normal, centre = fitted(near)
    for share in (0.5, 0.25, 0.25):  # points of the next wall would tilt a fit to all points
        distances_m = np.abs((points - centre) @ normal)
        normal, centre = fitted(points[distances_m < share * params.tolerance_m])
    return normal, centre


def fitted(points):
    """Return normal and centre (3,) of the plane that fits points (n, 3) best."""
    centre = points.mean(axis=0)
    _, axes = np.linalg.eigh((points - centre).T @ (points - centre))
    return axes[:, 0], centre


def products(points, cloud, found, params, ctx):
    """Return planes, largest first, and labels of all points."""
    signed_m = np.array([(points - centre) @ normal for normal, centre in found])
    nearest = np.abs(signed_m).argmin(axis=0)
    nearest[np.abs(signed_m).min(axis=0) >= params.tolerance_m] = -1
    n_points = np.array([np.count_nonzero(nearest == index) for index in range(len(found))])
    order = np.argsort(-n_points, kind="stable")
    viewer = points.mean(axis=0) if cloud.stations is None else cloud.stations[0] - cloud.origin
    normals, offsets, corners, covariances, rms_m = [], [], [], [], []
    labels = np.full(len(points), -1, dtype=np.int16)
    for place, index in enumerate(order):
        normal, centre = found[index]
        normal = normal if (viewer - centre) @ normal >= 0 else -normal
        own = nearest == index
        labels[own] = place
        normals.append(normal)
        offsets.append(normal @ (centre + cloud.origin))
        corners.append(rectangle(points[own], normal, centre, cloud.up) + cloud.origin)
        covariances.append(covariance(points[own], normal, centre + cloud.origin))
        rms_m.append(float(np.sqrt(np.mean(signed_m[index][own] ** 2))))
    ctx.metric("n_planes", len(found), "1")
    ctx.metric("rms_mm", 1000 * rms_m[0], "mm")
    planes = Planes(
        normal=np.array(normals),
        offset=np.array(offsets),
        corners=np.array(corners),
        covariance=np.array(covariances),
        n_points=n_points[order].astype(np.int64),
        rms_m=np.array(rms_m),
        up=cloud.up,
        names=tuple(f"plane {place}" for place in range(len(order))),
        viewpoint="guess" if cloud.stations is None else "stations",
    )
    return {"planes": planes, "labels": PointLabels(plane_index=labels)}


def covariance(points, normal, centre_world):
    """Return the covariance (4, 4) of the normal and the offset (metres) of a plane.

    It is that of a least-squares fit with independent errors, although the errors of neighbouring
    points in a scan are correlated.
    """
    from_middle = points - points.mean(axis=0)
    sigma2 = np.mean((from_middle @ normal) ** 2)
    spread, axes = np.linalg.eigh(from_middle.T @ from_middle)  # the first is the normal
    tilts = [
        np.append(axis, axis @ centre_world) * np.sqrt(sigma2 / max(total, 1e-12))
        for total, axis in zip(spread[1:], axes.T[1:])
    ]
    shift = np.array([0.0, 0.0, 0.0, np.sqrt(sigma2 / len(points))])
    return sum(np.outer(part, part) for part in (*tilts, shift))


def rectangle(points, normal, centre, up):
    """Return corners (4, 3) around points on a plane: top-left, then counter-clockwise."""
    axes = wall_axes(normal, up)
    in_plane = (points - centre) @ axes.T
    (left, top), (right, bottom) = in_plane.min(axis=0), in_plane.max(axis=0)
    corners = np.array([[left, top], [left, bottom], [right, bottom], [right, top]])
    return centre + corners @ axes
