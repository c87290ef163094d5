"""Pictures of how planes were looked for: accumulators, points per voxel, normals."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from orthoflow.geometry import omega_phi_deg, wall_axes
from orthoflow.geometry.directions import basis_from_up
from orthoflow.products import Planes, PointCloud
from orthoflow.sdk import StepContext
from orthoflow_plugins.plane.accumulators import Accumulator
from orthoflow_plugins.plane.figures import Margins, space_out
from orthoflow_plugins.plane.kernels import PlanGrid
from orthoflow_plugins.plane.regions import Regions
from orthoflow_plugins.plane.space_accumulators import SpacePicture

_PIXELS_MOST: Final = 900
# Between the panels stands the legend of the first.
_ACCUMULATOR: Final = Margins(left=0.6, right=0.2, bottom=0.5, top=0.1, across=1.5)
_SECTION_POINTS_MOST: Final = 2_000_000
_SECTION_CELLS_MOST: Final = 2_000
_BIN_DEG: Final = 1.0
# The map shows voxels this near to the plane, so that niches and what stands before it are there.
_MAP_DEPTH_M: Final = 0.6
_MAP_MOST_DEG: Final = 15.0
_MAP_PIXELS_MOST: Final = 700


@dataclass(frozen=True, kw_only=True)
class VotePicture:
    """What a plan looked like before any plane was taken from it.

    Attributes:
        grid: where the cells of the plan lie.
        plan: (e1, e2) points per cell.
        accumulator: votes of that plan.
        voters: who voted, to finish a sentence.
    """

    grid: PlanGrid
    plan: NDArray[np.int64]
    accumulator: Accumulator
    voters: str


def draw_accumulator(
    ctx: StepContext, picture: VotePicture, planes: Planes, cloud: PointCloud
) -> None:
    """Draw the plan with the walls found, and the parameter space with their maxima.

    Args:
        ctx: takes the figure.
        picture: the plan and its votes.
        planes: the planes, world.
        cloud: where they are from.
    """
    figure = Figure(figsize=(11.0, 4.6))
    space_out(figure, _ACCUMULATOR, n_rows=1, n_columns=2)
    left, right = figure.subplots(1, 2)
    basis = basis_from_up(planes.up)
    grid, accumulator = picture.grid, picture.accumulator
    low = grid.low_m[:2]
    high = low + grid.cell_m * np.array(grid.shape[:2])
    image = np.log1p(_thinned_sum(picture.plan))
    left.imshow(image.T, origin="lower", cmap="gray_r", extent=(low[0], high[0], low[1], high[1]))
    votes = _thinned_sum(accumulator.votes)
    reach_m = -accumulator.low_m
    right.imshow(
        np.sqrt(votes.T),
        origin="lower",
        aspect="auto",
        cmap="gray",
        extent=(0.0, 180.0, -reach_m, reach_m),
    )
    for index in np.flatnonzero(np.abs(planes.normal @ planes.up) < 0.5):
        corners = (planes.corners[index] - cloud.origin) @ basis.T
        left.plot(corners[[1, 2], 0], corners[[1, 2], 1], linewidth=1.2, label=planes.names[index])
        omega, distance_m = _line_of(corners, basis @ planes.normal[index], accumulator)
        right.plot(omega, distance_m, "o", fillstyle="none", markersize=9)
    left.set_xlabel("e1 [m from the cloud's origin]")
    left.set_ylabel("e2 [m]")
    right.set_xlabel("direction of the normal [deg]")
    right.set_ylabel("distance from the middle of the plan [m]")
    if left.lines:
        # Beside the plan: one of a single long wall is too narrow to hold it.
        left.legend(fontsize=7, loc="upper left", bbox_to_anchor=(1.02, 1.0))
    ctx.figure(
        "accumulator",
        figure,
        "Left: points per plan cell with the walls found. Right: the parameter space, in which "
        f"{picture.voters}; circles mark the walls. A wall stands out as a sharp bright spot; a "
        "bright spot without a circle is a wall that was missed, a circle on grey ground a chance.",
    )


def draw_space(ctx: StepContext, picture: SpacePicture, planes: Planes) -> None:
    """Draw an accumulator's best votes with the planes found, and its sections.

    Args:
        ctx: takes the figures.
        picture: what it held.
        planes: the planes, world.
    """
    _draw_best(ctx, picture, planes)
    _draw_sections(ctx, picture)


def draw_sections(ctx: StepContext, planes: Planes, cloud: PointCloud, *, cell_m: float) -> None:
    """Draw the points per voxel in three sections through the middle of the planes' parts.

    Args:
        ctx: takes the figure.
        planes: the planes, world; at least one.
        cloud: the cloud.
        cell_m: side of a voxel; drawn larger where a scene would need too many.
    """
    every = max(1, len(cloud) // _SECTION_POINTS_MOST)
    points_m = np.column_stack([cloud.x[::every], cloud.y[::every], cloud.z[::every]])
    basis = basis_from_up(planes.up)
    framed = points_m.astype(np.float64) @ basis.T
    # Not what the points span: some lie far outside, behind mirrors and windows.
    corners = (planes.corners.reshape(-1, 3) - cloud.origin) @ basis.T
    low, high = corners.min(axis=0), corners.max(axis=0)
    cell_m = max(cell_m, float((high - low).max()) / _SECTION_CELLS_MOST)
    low, high = low - 5.0 * cell_m, high + 5.0 * cell_m
    middle = 0.5 * (low + high)
    figure = Figure(figsize=(12.0, 4.2), layout="constrained")
    names = ("e1", "e2", "up")
    for axes, (first, second, across) in zip(
        figure.subplots(1, 3), ((0, 1, 2), (0, 2, 1), (1, 2, 0)), strict=True
    ):
        inside = np.abs(framed[:, across] - middle[across]) < 0.5 * cell_m
        edges = [np.arange(low[k], high[k] + cell_m, cell_m) for k in (first, second)]
        counts = np.histogram2d(framed[inside, first], framed[inside, second], edges)[0]
        extent = (edges[0][0], edges[0][-1], edges[1][0], edges[1][-1])
        axes.imshow(
            np.log1p(counts.T), origin="lower", cmap="gray_r", extent=extent, aspect="equal"
        )
        axes.set_xlabel(f"{names[first]} [m from the cloud's origin]", fontsize=8)
        axes.set_ylabel(f"{names[second]} [m]", fontsize=8)
        axes.set_title(f"{names[across]} = {middle[across]:.2f} m", fontsize=9)
        axes.tick_params(labelsize=7)
    ctx.figure(
        "voxels",
        figure,
        f"Points per voxel of {100.0 * cell_m:.3g} cm (darker is more, logarithmic) in three "
        "sections through the middle of the planes' parts: walls are thin dark lines; where they "
        "are wide or double, the scans disagree or the cloud is noisy.",
    )


def draw_normals(ctx: StepContext, regions: Regions, planes: Planes, cloud: PointCloud) -> None:
    """Report how normals scatter about the first plane, and draw their histogram and map.

    Args:
        ctx: takes metrics and figure.
        regions: voxels and their regions.
        planes: the planes, world.
        cloud: where they are from.
    """
    voxels = regions.voxels
    centroids_m = voxels.centroids() @ voxels.grid.basis
    normals = voxels.normals.astype(np.float64) @ voxels.grid.basis
    first = planes.normal[0]
    away_deg = np.degrees(np.arccos(np.clip(np.abs(normals @ first), 0.0, 1.0)))
    depth_m = centroids_m @ first - (planes.offset[0] - float(first @ cloud.origin))
    on_plane = (np.abs(depth_m) < 0.5 * voxels.grid.cell_m) & (away_deg < 45.0)
    placed = (centroids_m - (planes.corners[0, 0] - cloud.origin)) @ wall_axes(first, planes.up).T
    size_m = np.linalg.norm(planes.corners[0, [3, 1]] - planes.corners[0, 0], axis=1)
    over = ((placed >= 0.0) & (placed < size_m)).all(axis=1)
    scatter_deg = float(np.median(away_deg[on_plane & over])) if (on_plane & over).any() else 0.0
    ctx.metric("n_regions", len(regions.planes), "1")
    ctx.metric("neighbourhood_mm", 1000.0 * voxels.neighbourhood.size_m, "mm")
    ctx.metric("cell_mm", 1000.0 * voxels.grid.cell_m, "mm")
    ctx.metric("normal_scatter_deg", scatter_deg, "deg")
    shown = over & (np.abs(depth_m) < _MAP_DEPTH_M) & np.isfinite(voxels.spreads[:, 0])
    picture = _normal_map(
        placed[shown], depth_m[shown], away_deg[shown], size_m, voxels.grid.cell_m
    )
    across_deg = np.degrees(np.arcsin(np.clip(normals @ basis_from_up(planes.up)[1], -1.0, 1.0)))
    angles_deg = {f"angle between normal and {planes.names[0]}": away_deg, "Ny": across_deg}
    _draw_normals(ctx, angles_deg, voxels.counts, picture, size_m)


def _line_of(
    corners: NDArray[np.float64], normal: NDArray[np.float64], accumulator: Accumulator
) -> tuple[float, float]:
    """Where a wall lies in the parameter space: degrees and metres."""
    angle = math.atan2(normal[1], normal[0]) % math.pi
    direction = np.array([math.cos(angle), math.sin(angle)])
    middle = corners.mean(axis=0)[:2] - accumulator.centre_m
    return math.degrees(angle), float(direction @ middle)


def _thinned_sum(values: NDArray[np.int64]) -> NDArray[np.float64]:
    """Sum blocks of an image until it is small enough to draw."""
    rows, columns = (max(1, -(-size // _PIXELS_MOST)) for size in values.shape)
    padded = np.pad(values, ((0, -values.shape[0] % rows), (0, -values.shape[1] % columns)))
    blocks = padded.reshape(padded.shape[0] // rows, rows, padded.shape[1] // columns, columns)
    thinned: NDArray[np.float64] = blocks.sum(axis=(1, 3)).astype(np.float64)
    return thinned


def _draw_best(ctx: StepContext, picture: SpacePicture, planes: Planes) -> None:
    figure = Figure(figsize=(7.0, 4.6), layout="constrained")
    axes = figure.subplots()
    axes.imshow(
        np.sqrt(np.maximum(picture.best.T, 0.0)),
        origin="lower",
        aspect="auto",
        cmap="gray",
        extent=(0.0, 180.0, -90.0, 90.0),
    )
    for normal in planes.normal:
        omega_deg, phi_deg = omega_phi_deg(normal, planes.up)
        if omega_deg >= 180.0:
            omega_deg, phi_deg = omega_deg - 180.0, -phi_deg
        axes.plot(omega_deg, phi_deg, "o", fillstyle="none", markersize=9)
    axes.set_xlabel("omega [deg]")
    axes.set_ylabel("phi [deg]")
    ctx.figure(
        "accumulator",
        figure,
        "The best votes of any distance over the direction of the normal; circles mark the planes. "
        "Directions are even over the hemisphere: towards the poles one stands for several. A "
        "bright spot without a circle is a direction whose plane was missed.",
    )


def _draw_sections(ctx: StepContext, picture: SpacePicture) -> None:
    figure = Figure(figsize=(10.0, 6.4), layout="constrained")
    axes = figure.subplots(2, 3)
    for place, cut_deg in enumerate(picture.sections_deg):
        _draw_section(axes[0, place], picture.over_omega[place], (0.0, 180.0), picture.reach_m)
        _draw_section(axes[1, place], picture.over_phi[place], (-90.0, 90.0), picture.reach_m)
        axes[0, place].set_title(f"phi = {cut_deg:.0f} deg", fontsize=9)
        axes[1, place].set_title(f"omega = {cut_deg:.0f} deg", fontsize=9)
        axes[0, place].set_xlabel("omega [deg]", fontsize=8)
        axes[1, place].set_xlabel("phi [deg]", fontsize=8)
    for row in axes:
        row[0].set_ylabel("distance from the middle [m]", fontsize=8)
    ctx.figure(
        "accumulator-sections",
        figure,
        "Votes over direction and distance before any plane was taken, in sections of one phi "
        "(above) and of one omega (below); the brighter the more, by the square root. Planes are "
        "sharp spots where bands cross; without any, there is no plane to find.",
    )


def _draw_section(
    axes: Axes, section: NDArray[np.float64], span_deg: tuple[float, float], reach_m: float
) -> None:
    axes.imshow(
        np.sqrt(section.T),
        origin="lower",
        aspect="auto",
        cmap="gray",
        extent=(*span_deg, -reach_m, reach_m),
    )
    axes.tick_params(labelsize=7)


def _normal_map(
    placed: NDArray[np.float64],
    depth_m: NDArray[np.float64],
    away_deg: NDArray[np.float64],
    size_m: NDArray[np.float64],
    cell_m: float,
) -> NDArray[np.float64]:
    """(rows, columns) angle of the voxel nearest to the viewer, NaN without one."""
    pixel_m = max(cell_m, float(size_m.max()) / _MAP_PIXELS_MOST)
    shape = np.maximum(1, np.ceil(size_m / pixel_m).astype(int))[::-1]
    picture = np.full(tuple(shape), np.nan)
    order = np.argsort(depth_m, kind="stable")
    columns, rows = (placed[order] / pixel_m).astype(np.int64).T
    picture[rows, columns] = away_deg[order]
    return picture


def _draw_normals(
    ctx: StepContext,
    angles_deg: Mapping[str, NDArray[np.float64]],
    counts: NDArray[np.int64],
    picture: NDArray[np.float64],
    size_m: NDArray[np.float64],
) -> None:
    figure = Figure(figsize=(14.0, 4.0), layout="constrained")
    *histograms, right = figure.subplots(1, 3, width_ratios=(2.0, 2.0, 3.0))
    for axes, (name, values_deg) in zip(histograms, angles_deg.items(), strict=True):
        edges_deg = np.arange(-90.0 if values_deg.min() < 0.0 else 0.0, 90.0 + _BIN_DEG, _BIN_DEG)
        histogram, _ = np.histogram(values_deg, edges_deg, weights=counts.astype(np.float64))
        shares = histogram / max(1.0, float(counts.sum()))
        axes.stairs(shares, edges_deg, fill=True, color="#9db8d2")
        axes.set_xlabel(f"{name} [deg]", fontsize=9)
    histograms[0].set_ylabel("share of the points", fontsize=9)
    image = right.imshow(
        np.minimum(picture, _MAP_MOST_DEG),
        cmap="viridis",
        extent=(0.0, float(size_m[0]), float(size_m[1]), 0.0),
        vmin=0.0,
        vmax=_MAP_MOST_DEG,
    )
    figure.colorbar(image, ax=right, label="angle [deg]", shrink=0.8)
    right.set_xlabel("along the plane [m]", fontsize=9)
    ctx.figure(
        "normals",
        figure,
        "Left: how the normals of the neighbourhoods lie to the first plane, by points. Middle: "
        "how far they point along the second horizontal axis (markiewicz2015, Figure 8). Right: "
        f"the first over the plane's rectangle, up to {1000.0 * _MAP_DEPTH_M:.0f} mm before and "
        "behind it; what has the wall's colour is told from it by its distance alone. Normals of a "
        "good wall gather near 0 degrees; a broad hill means noise or relief.",
    )
