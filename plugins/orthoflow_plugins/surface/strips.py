"""Tests whether planes are strips of curved surfaces."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.robust import median_deviation
from orthoflow_plugins.surface.rounds import robust_solution
from orthoflow_plugins.surface.voxels import Sample

_LEAST_POINTS: Final = 100
_MOST_POINTS: Final = 3_000
# The normal of a strip rotates by at least this angle across its width; that of a slightly bent
# wall rotates less.
_LEAST_TURN_DEG: Final = 4.0
# A plane is a strip if the scatter of its points about a curved surface is at most _LARGEST_SHARE
# of that about the plane, and if its sagitta is at least _LEAST_RATIO times the former.
_LARGEST_SHARE: Final = 0.6
_LEAST_RATIO: Final = 4.0


@dataclass(frozen=True, kw_only=True)
class PlaneTest:
    """Result of the test for whether a plane is a strip of a curved surface.

    Attributes:
        index: index of the plane.
        normal: (3,) float64 unit vector of the plane through its points.
        offset_m: offset of this plane from the cloud's origin.
        is_strip: whether the points are on a curved surface.
        sagitta_mm: height of the arc across the strip.
        sigma_mm: scatter of the points about the curved surface.
        plane_sigma_mm: scatter of the points about the plane.
        turn_deg: angle by which the normal of the surface rotates across the strip.
    """

    index: int
    normal: NDArray[np.float64]
    offset_m: float
    is_strip: bool
    sagitta_mm: float
    sigma_mm: float
    plane_sigma_mm: float
    turn_deg: float


def tested_planes(sample: Sample) -> list[PlaneTest]:
    """Test each plane; planes with few points are not tested and are regarded as flat."""
    order = np.argsort(sample.label, kind="stable")
    labels = sample.label[order]
    tests = []
    for index in np.unique(labels[labels >= 0]).tolist():
        own = order[np.searchsorted(labels, index) : np.searchsorted(labels, index, "right")]
        if len(own) >= _LEAST_POINTS:
            own = own[:: max(1, len(own) // _MOST_POINTS)]
            tests.append(_tested(index, sample.offsets_m[own]))
    return tests


def _tested(index: int, points: NDArray[np.float64]) -> PlaneTest:
    middle = points.mean(axis=0)
    relative = points - middle
    _, axes = np.linalg.eigh(relative.T @ relative)
    depth, v, u = (relative @ axes).T
    ones, noise = np.ones_like(u), np.full(len(u), 1e-6)
    flat = np.column_stack([ones, u, v])
    plane, _, _ = robust_solution(flat, depth, noise)
    curved = np.column_stack([flat, u * u, u * v, v * v])
    bent, _, _ = robust_solution(curved, depth, noise)
    plane_sigma_m = median_deviation(depth - flat @ plane, 0.0)
    sigma_m = median_deviation(depth - curved @ bent, 0.0)
    curvatures, directions = np.linalg.eigh(
        np.array([[2.0 * bent[3], bent[4]], [bent[4], 2.0 * bent[5]]])
    )
    largest = int(np.argmax(np.abs(curvatures)))
    across = np.column_stack([u, v]) @ directions[:, largest]
    width_m = float(np.diff(np.quantile(across, (0.02, 0.98)))[0])
    bend = abs(float(curvatures[largest]))
    sagitta_m, turn_deg = bend * width_m**2 / 8.0, math.degrees(bend * width_m)
    normal = axes[:, 0] - plane[1] * axes[:, 2] - plane[2] * axes[:, 1]
    normal /= np.linalg.norm(normal)
    return PlaneTest(
        index=index,
        normal=normal,
        offset_m=float(normal @ (middle + plane[0] * axes[:, 0])),
        is_strip=turn_deg >= _LEAST_TURN_DEG
        and sigma_m <= _LARGEST_SHARE * plane_sigma_m
        and sagitta_m >= _LEAST_RATIO * sigma_m,
        sagitta_mm=1000.0 * sagitta_m,
        sigma_mm=1000.0 * sigma_m,
        plane_sigma_mm=1000.0 * plane_sigma_m,
        turn_deg=turn_deg,
    )
