"""Surfaces of revolution: cylinders, cones and spheres."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import Cone, CurvedShape, Cylinder, Sphere, basis_from_up
from orthoflow.geometry.surfaces import along_and_across, middle_direction, zero_direction
from orthoflow_plugins.surface.kernels import solve_weighted

# Tukey's constant, in standard deviations.
TUKEY: Final = 4.685
# Maximum number of iterations of a robust solution. It ends when the solution changes by less than
# _SETTLED (metres or radians). The scatter is estimated from about _SCATTER_SAMPLE observations.
_ROUNDS: Final = 12
_SETTLED: Final = 1e-8
_SCATTER_SAMPLE: Final = 4_000
# Maximum number of voxels in a fit.
_MOST_VOXELS: Final = 2_000


@dataclass(frozen=True, kw_only=True)
class Round:
    """A cylinder, a cone (if the radius changes along the axis), or a sphere.

    Attributes:
        point: (3,) float64 point of the axis or centre of the sphere, metres from the cloud's
            origin.
        axis: (3,) float64 unit vector; that of a sphere points to the middle of its points.
        radius_m: radius at the point, or of the sphere.
        slope: change of the radius per metre along the axis.
        is_sphere: whether the surface is a sphere.
    """

    point: NDArray[np.float64]
    axis: NDArray[np.float64]
    radius_m: float
    slope: float = 0.0
    is_sphere: bool = False

    @property
    def steepness(self) -> float:
        """Cosine of the angle between axis and generatrices."""
        return 1.0 / math.hypot(1.0, self.slope)

    @property
    def least_row_share(self) -> float:
        """Smallest occupied share of a row of cells around the axis that belongs to the surface.

        Rows with less are clutter. Of a sphere, pendentives may reach into rows.
        """
        return 0.02 if self.is_sphere else 0.1

    def row(self, zero: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the row (13,) for kernels; angles are measured from the direction `zero` (3,)."""
        numbers = (self.radius_m, self.slope, self.steepness, 0.0 if self.is_sphere else 1.0)
        return np.concatenate([self.point, self.axis, zero, numbers])

    def outwards(
        self, points: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return distances (n,), positive outside, and outward normals (n, 3) of points."""
        along, across = along_and_across(points, self.point, self.axis)
        if self.is_sphere:
            across = points - self.point
        radius = np.linalg.norm(across, axis=1)
        distances = (radius - self.radius_m - self.slope * along) * self.steepness
        normals = across / np.maximum(radius, 1e-12)[:, None] - self.slope * self.axis
        return distances, normals * self.steepness

    def places(
        self, points: NDArray[np.float64], zero: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return angles (n,), -pi to pi, and positions along the axis (n,) of points.

        Points are first moved to the surface of a sphere.
        """
        relative = points - self.point
        if self.is_sphere:
            lengths = np.maximum(np.linalg.norm(relative, axis=1, keepdims=True), 1e-12)
            relative = relative * self.radius_m / lengths
        sine = relative @ cross(self.axis, zero)
        return np.arctan2(sine, relative @ zero), relative @ self.axis

    def points(
        self,
        angles: NDArray[np.float64],
        along: NDArray[np.float64],
        distances: NDArray[np.float64],
        zero: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """Return points (n, 3) at angles, positions along the axis and distances (n,) outwards."""
        outwards = np.outer(np.cos(angles), zero) + np.outer(np.sin(angles), cross(self.axis, zero))
        if self.is_sphere:
            axial = np.clip(along / self.radius_m, -1.0, 1.0)
            outwards = np.sqrt(1.0 - axial**2)[:, None] * outwards + np.outer(axial, self.axis)
            return np.asarray(self.point + (self.radius_m + distances)[:, None] * outwards)
        radius = self.radius_m + self.slope * along + distances / self.steepness
        return np.asarray(self.point + np.outer(along, self.axis) + radius[:, None] * outwards)

    def corrected(self, zero: NDArray[np.float64], change: NDArray[np.float64]) -> Round:
        """Return the surface after a change of the parameters of `design`."""
        aside = cross(self.axis, zero)
        if self.is_sphere:
            moved = self.point + change[:3] @ np.array([zero, aside, self.axis])
            return replace(self, point=moved, radius_m=self.radius_m + float(change[3]))
        axis = self.axis + change[2] * zero + change[3] * aside
        return Round(
            point=self.point + change[0] * zero + change[1] * aside,
            axis=axis / np.linalg.norm(axis),
            radius_m=self.radius_m + float(change[4]),
            slope=self.slope + (float(change[5]) if len(change) > 5 else 0.0),
        )

    def moved(self, along_m: float) -> Round:
        """Return the same surface with its point moved along the axis, except the centre."""
        if self.is_sphere:
            return self
        return replace(
            self,
            point=self.point + along_m * self.axis,
            radius_m=self.radius_m + self.slope * along_m,
        )

    def aimed(self, points: NDArray[np.float64], up: NDArray[np.float64]) -> Round:
        """Return the same sphere with the axis to the middle of its points (n, 3)."""
        return replace(self, axis=middle_direction(self.outwards(points)[1], up))

    def directed(self, up: NDArray[np.float64]) -> Round:
        """Return the same surface with the axis in the direction that `Surface.shape` requires.

        The axis of a cone points from its apex to its wider end.
        """
        if self.is_sphere:
            return self
        along = basis_from_up(up) @ self.axis
        steep = abs(along[2]) >= math.sqrt(0.5)
        sign = along[2] if steep else along[int(np.argmax(np.abs(along[:2])))]
        if (self.slope or sign) < 0.0:
            return replace(self, axis=-self.axis, slope=-self.slope)
        return self

    def shape(self, origin: NDArray[np.float64], *, is_concave: bool) -> CurvedShape:
        """Return the surface in world coordinates: a cylinder if the radius does not increase."""
        if self.is_sphere:
            centre = origin + self.point
            return Sphere(centre_world=centre, radius_m=self.radius_m, is_concave=is_concave)
        if self.slope <= 0.0:
            return Cylinder(
                point_world=origin + self.point,
                axis_world=self.axis,
                radius_m=self.radius_m,
                is_concave=is_concave,
            )
        return Cone(
            apex_world=origin + self.point - self.radius_m / self.slope * self.axis,
            axis_world=self.axis,
            half_angle_rad=math.atan(self.slope),
            is_concave=is_concave,
        )

    def covariance(
        self, zero: NDArray[np.float64], own: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the covariance (7, 7) of a `Surface` from that of the parameters of `design`."""
        aside = cross(self.axis, zero)
        turn = np.zeros((7, len(own)))
        if self.is_sphere:
            turn[:3, :3] = np.array([zero, aside, self.axis]).T
            turn[6, 3] = 1.0
            return np.asarray(turn @ own @ turn.T)
        turn[:3, 0], turn[:3, 1] = zero, aside
        turn[3:6, 2], turn[3:6, 3] = zero, aside
        if self.slope <= 0.0:
            turn[6, 4] = 1.0
        else:
            reach_m = self.radius_m / self.slope
            turn[:3, 2], turn[:3, 3] = -reach_m * zero, -reach_m * aside
            turn[:3, 4] = -self.axis / self.slope
            turn[:3, 5] = reach_m / self.slope * self.axis
            turn[6, 5] = self.steepness**2
        return np.asarray(turn @ own @ turn.T)


def cross(one: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the cross product of two vectors (3,); `numpy.cross` takes ten times as long."""
    (a, b, c), (d, e, f) = one.tolist(), other.tolist()
    return np.array([b * f - c * e, c * d - a * f, a * e - b * d])


def design(
    found: Round, angles: NDArray[np.float64], along: NDArray[np.float64], *, is_cone: bool
) -> NDArray[np.float64]:
    """Return the derivatives (n, 4, 5 or 6) of the surface's displacement along its normal.

    The parameters are the displacement of the axis (2), its tilt (2), the radius, and, for cones,
    the slope; for spheres, the displacement of the centre (3) and the radius.
    """
    cosine, sine, steepness = np.cos(angles), np.sin(angles), found.steepness
    if found.is_sphere:
        axial = np.clip(along / found.radius_m, -1.0, 1.0)
        across = np.sqrt(1.0 - axial**2)
        return np.column_stack([across * cosine, across * sine, axial, np.ones_like(along)])
    columns = [cosine, sine, along * cosine, along * sine, np.ones_like(along)]
    if is_cone:
        columns.append(along)
    return steepness * np.column_stack(columns)


def robust_solution(
    matrix: NDArray[np.float64], distances: NDArray[np.float64], variances: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Solve matrix x = distances by least squares with Tukey's weights.

    Args:
        matrix: (n, k) design.
        distances: (n,) observations.
        variances: (n,) variances of the observations; additional scatter is estimated.

    Returns:
        The solution (k,), the weights (n,), and the standard deviation of the additional scatter.
    """
    matrix, distances = np.ascontiguousarray(matrix), np.ascontiguousarray(distances)
    (n, k), step = matrix.shape, max(1, len(matrix) // _SCATTER_SAMPLE)
    solution, squares, weights, extra = np.zeros(k), np.empty(n), 1.0 / variances, 0.0
    for _ in range(_ROUNDS):
        change = solve_weighted(matrix, distances, weights, solution, squares)
        # The median of squared residuals without measurement noise is 0.455 times the variance.
        # Compiling the median would take longer than compiling all the rest.
        extra = max(0.0, float(np.median(squares[::step] / 0.455 - variances[::step])))
        spread = variances + extra
        share = np.maximum(0.0, 1.0 - squares / (TUKEY * TUKEY * spread))
        weights = share * share / spread
        if change < _SETTLED or np.count_nonzero(share) < 2 * k:
            break
    return solution, weights, math.sqrt(extra)


def fitted(
    start: Round,
    points: NDArray[np.float64],
    sigma_m: float,
    up: NDArray[np.float64],
    *,
    is_cone: bool,
) -> Round:
    """Fit a surface to points (n, 3) near it, by Gauss-Newton with robust weights."""
    found = start
    points = points[:: max(1, len(points) // _MOST_VOXELS)]
    variances = np.full(len(points), max(sigma_m, 1e-4) ** 2)
    for _ in range(2):
        found = found.moved(float(np.mean((points - found.point) @ found.axis)))
        zero = zero_direction(found.axis, up)
        distances, _ = found.outwards(points)
        matrix = design(found, *found.places(points, zero), is_cone=is_cone)
        change, _, _ = robust_solution(matrix, distances, variances)
        n_shifts, of_radius = (3, 3) if found.is_sphere else (2, 4)
        most_m = 0.3 * found.radius_m
        change[:n_shifts] = np.clip(change[:n_shifts], -most_m, most_m)
        change[n_shifts:of_radius] = np.clip(change[n_shifts:of_radius], -0.3, 0.3)
        change[of_radius] = np.clip(change[of_radius], -0.5 * found.radius_m, found.radius_m)
        found = found.corrected(zero, change)
    return found
