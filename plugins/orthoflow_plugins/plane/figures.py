"""Figures of planes and of their detection: deviations, thickness, accumulators and normals."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import PowerNorm, SymLogNorm
from matplotlib.image import AxesImage
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from orthoflow.files.drawing import COLUMN_INCHES, column_figure, in_column_style, plane_ink
from orthoflow.geometry import omega_phi_deg, wall_axes
from orthoflow.geometry.frames import basis_from_up
from orthoflow.products import Planes, PointCloud, Thickness
from orthoflow.sdk import StepContext
from orthoflow_plugins.plane.kernels import HISTOGRAM_BINS
from orthoflow_plugins.plane.planes import Deviations, Normality
from orthoflow_plugins.plane.proposing import Materials
from orthoflow_plugins.plane.thickness import RowPoints

if TYPE_CHECKING:
    from orthoflow_plugins.plane.voxels import SurfaceVoxels


_PANELS_MOST: Final = 4
_POINTS_MOST: Final = 25_000
_NAMED_MOST: Final = 12
_NAMES_ABREAST: Final = 3
# Direction of the parallel projection, obliquely from above.
_AZIMUTH_DEG: Final = -60.0
_ELEVATION_DEG: Final = 35.0
_GREY: Final = "#c8c8c8"
_BLUE: Final = "#9db8d2"
_PLANES_MOST: Final = 12
_CLASSED_MOST: Final = 4


@in_column_style()
def draw_deviations(
    ctx: StepContext,
    planes: Planes,
    deviations: Deviations,
    normalities: Sequence[Normality | None],
) -> None:
    """Draw histograms of the distances of points from the first planes, with normal curves."""
    count = min(_PANELS_MOST, len(planes))
    figure = column_figure(0.3 + 1.15 * count)
    # Use the same scale for all planes, so that histograms can be compared.
    panels = figure.subplots(count, 2, squeeze=False, sharex="col", sharey="col")
    tolerance_mm = 1000.0 * deviations.tolerance_m
    edges_mm = np.linspace(-tolerance_mm, tolerance_mm, HISTOGRAM_BINS + 1)
    middles_mm = 0.5 * (edges_mm[1:] + edges_mm[:-1])
    width_mm = edges_mm[1] - edges_mm[0]
    for index, (axes, beside) in enumerate(panels):
        # Use the percentage of points per millimetre, so that planes of different sizes can be
        # compared.
        share = 100.0 / (max(1.0, float(deviations.histogram[index].sum())) * width_mm)
        axes.stairs(
            share * deviations.histogram[index], edges_mm, fill=True, color=plane_ink(index)
        )
        sigma_mm = 1000.0 * float(deviations.rms_fit_m[index])
        if sigma_mm > 0.0:
            offset_mm = middles_mm - 1000.0 * float(deviations.mean_fit_m[index])
            scale = share * float(deviations.n_fit[index]) * width_mm
            curve = np.exp(-0.5 * (offset_mm / sigma_mm) ** 2)
            curve *= scale / (sigma_mm * math.sqrt(2.0 * math.pi))
            axes.plot(middles_mm, curve, color="black", linewidth=0.8)
        axes.set_title(f"{planes.names[index]}: SD {sigma_mm:.1f} mm")
        axes.set_ylabel("points [% per mm]")
        shape = normalities[index]
        if shape is None:
            beside.set_axis_off()
            continue
        reach = float(shape.expected_sigmas[-1])
        beside.plot([-reach, reach], [-reach, reach], color="black", linewidth=0.8)
        beside.plot(
            shape.expected_sigmas,
            shape.found_sigmas,
            ".",
            markersize=2.5,
            color=plane_ink(index),
        )
        skewness, kurtosis = shape.skewness, shape.excess_kurtosis
        moments = f"skewness {skewness:+.2f}\nkurtosis {kurtosis:+.2f}"
        beside.text(0.04, 0.96, moments, va="top", transform=beside.transAxes)
        beside.set_ylabel("measured [sigma]")
    panels[-1, 0].set_xlabel("distance to the plane [mm]")
    panels[-1, 1].set_xlabel("normal quantile [sigma]")
    ctx.figure(
        "deviations",
        figure,
        "Left: distances of the points from their plane, positive towards the "
        "viewer; the curve is the normal distribution with the mean and standard deviation "
        f"of the distances within {1000.0 * deviations.fit_tolerance_m:.0f} mm. Right: "
        "quantiles of the distances over those of a normal distribution; if the distances "
        "were normally distributed, all points would be on the line. A second peak, or ends "
        "that leave the line early, indicate relief or another surface near the plane.",
    )


@in_column_style()
def draw_planes(
    ctx: StepContext,
    planes: Planes,
    points_m: NDArray[np.float64],
    plane_of_point: NDArray[np.int64],
    cloud: PointCloud,
) -> None:
    """Draw points coloured by plane, and below them the rectangles of the planes' parts.

    Args:
        ctx: receives the figure.
        planes: the planes, in world coordinates.
        points_m: (m, 3) offsets of a sample of the cloud.
        plane_of_point: (m,) plane of each point; -1 for points on no plane.
        cloud: the cloud.
    """
    every = max(1, len(points_m) // _POINTS_MOST)
    shown = points_m[::every]
    view = _view(planes.up)
    flat, index = shown @ view.T, plane_of_point[::every]
    corners = (planes.corners.reshape(-1, 3) - cloud.origin) @ view.T
    low, high = corners.min(axis=0), corners.max(axis=0)
    margin = 0.04 * (high - low)
    n_named = min(_NAMED_MOST, len(planes))
    # Do not use the constrained layout, because it would draw all points twice.
    panel_in = COLUMN_INCHES * float(np.clip((high[1] - low[1]) / (high[0] - low[0]), 0.3, 1.0))
    legend_in = 0.08 + 0.14 * -(-n_named // _NAMES_ABREAST)
    figure = column_figure(2.0 * panel_in + legend_in)
    figure.set_layout_engine("none")
    edges = {"left": 0.0, "right": 1.0, "top": 1.0, "hspace": 0.02}
    bottom = legend_in / (2.0 * panel_in + legend_in)
    above, below = figure.subplots(2, 1, gridspec_kw={**edges, "bottom": bottom})
    on_none = index < 0
    above.plot(*flat[on_none].T, ".", markersize=1.0, markeredgewidth=0.0, color=_GREY)
    below.plot(*flat.T, ",", color="#e4e4e4")
    from_the_front = planes.normal @ np.cross(*view) > 0.0
    # Draw the smallest planes last, so that the floor does not hide the objects that stand on it.
    for k in range(len(planes)):
        colour = plane_ink(k)
        if from_the_front[k]:
            above.plot(*flat[index == k].T, ".", markersize=1.5, markeredgewidth=0.0, color=colour)
        parts = planes.corners[k][None]
        if planes.part_corners is not None and planes.part_plane is not None:
            parts = planes.part_corners[planes.part_plane == k]
        for place, part in enumerate(parts):
            around = (part[[0, 1, 2, 3, 0]] - cloud.origin) @ view.T
            name = planes.names[k] if k < _NAMED_MOST and place == 0 else None
            below.plot(*around.T, color=colour, linewidth=1.3, label=name)
    for axes in (above, below):
        axes.set_aspect("equal")
        axes.set_xlim(low[0] - margin[0], high[0] + margin[0])
        axes.set_ylim(low[1] - margin[1], high[1] + margin[1])
        axes.set_axis_off()
    figure.legend(*below.get_legend_handles_labels(), loc="lower center", ncols=_NAMES_ABREAST)
    ctx.figure(
        "planes",
        figure,
        "Above: a sample of the points, coloured by plane, without planes seen from "
        f"behind; {np.mean(on_none):.1%} of the points are on no plane (grey). Below: the "
        "rectangles of the planes' connected parts. Each wall should have one colour: a "
        "wall with two colours was divided, and a grey wall was missed.",
    )


@in_column_style()
def draw_thickness(
    ctx: StepContext,
    planes: Planes,
    found: tuple[Thickness | None, ...],
    row: RowPoints | None,
    materials: Materials,
) -> None:
    """Draw the thickness of the cloud, unless no plane has enough points."""
    known = [(k, item) for k, item in enumerate(found) if item is not None][:_PLANES_MOST]
    if not known:
        return
    first = known[:_CLASSED_MOST]
    classes = [
        (label, name)
        for label, name in _CLASSES.items()
        if any(getattr(item, name) for _, item in first)
    ]
    bars = [
        (f"{spread.name}, {planes.names[k]}", 1000.0 * spread.sigma_m, plane_ink(k))
        for k, item in first
        for spread in item.material
    ]
    n_panels = 1 + len(classes) + bool(bars)
    n_rows = -(-n_panels // 2)
    figure = column_figure(1.75 * n_rows + (0.0 if row is None else 1.3))
    grid = figure.add_gridspec(n_rows + (row is not None), 2 if n_panels > 1 else 1)
    places = iter([grid[k // 2, k % 2] for k in range(n_panels)])
    sigmas = [(planes.names[k], 1000.0 * item.sigma_m, plane_ink(k)) for k, item in known]
    axes = _draw_bars(figure.add_subplot(next(places)), sigmas, "thickness [mm]")
    steps_mm = [1000.0 * item.scan_step_m for _, item in known]
    axes.plot(steps_mm, range(len(known)), "|", color="black", label="point spacing")
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0))
    for label, name in classes:
        axes = figure.add_subplot(next(places))
        for k, item in first:
            spreads = getattr(item, name)
            middles = [0.5 * (spread.low + spread.high) for spread in spreads]
            sigmas_mm = [1000.0 * spread.sigma_m for spread in spreads]
            axes.plot(middles, sigmas_mm, "o-", markersize=2, color=plane_ink(k))
        axes.set_ylim(bottom=0.0)
        axes.set_xlabel(label)
        axes.set_ylabel("thickness [mm]")
    if bars:
        _draw_bars(figure.add_subplot(next(places)), bars, "thickness by material [mm]")
    if row is not None:
        _draw_row(figure.add_subplot(grid[-1, :]), planes, row, materials)
    drawn = [label.partition(" [")[0] for label, _ in classes] + ["material"] * bool(bars)
    ctx.figure(
        "thickness",
        figure,
        "Thickness of the cloud (one standard deviation, in millimetres) on each plane, compared "
        f"with the point spacing{''.join(f', by {name}' for name in drawn)}."
        f"{'' if row is None else ' Below: a row of the scan on the first plane.'} If the "
        "thickness exceeds the point spacing, the cloud is noisy or its scans are misaligned.",
    )


# Attributes over which the thickness is plotted, by axis label.
_CLASSES: Final = {"angle of incidence [deg]": "incidence_deg", "range [m]": "range_m"}


def _view(up: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the directions (2, 3), in world axes, that are to the right and up in the figure."""
    azimuth, elevation = math.radians(_AZIMUTH_DEG), math.radians(_ELEVATION_DEG)
    right = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
    towards = np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
    rise = math.cos(elevation) * np.array([0.0, 0.0, 1.0]) - math.sin(elevation) * towards
    return np.array([right, rise]) @ basis_from_up(up)


def _draw_bars(
    axes: Axes, bars: Sequence[tuple[str, float, tuple[float, float, float]]], label: str
) -> Axes:
    names, values, colours = zip(*bars, strict=True)
    axes.barh(range(len(bars)), values, color=colours)
    axes.set_yticks(range(len(bars)), names)
    axes.invert_yaxis()
    axes.set_xlabel(label)
    return axes


def _draw_row(axes: Axes, planes: Planes, row: RowPoints, materials: Materials) -> None:
    axes.plot(row.along_m, 1000.0 * row.distance_m, ".", markersize=1, color="#333333")
    if row.intensity is not None:
        for name, (low, high) in materials.items():
            mine = (row.intensity >= low) & (row.intensity <= high)
            distance_mm = 1000.0 * row.distance_m[mine]
            axes.plot(row.along_m[mine], distance_mm, ".", markersize=1, label=name)
        if materials:
            axes.legend(markerscale=4)
    axes.set_xlabel(f"along {planes.names[0]} [m], row {row.row} of scan {row.scan}")
    axes.set_ylabel("distance [mm]")


_PIXELS_MOST: Final = 900
_SECTION_POINTS_MOST: Final = 2_000_000
_SECTION_CELLS_MOST: Final = 2_000
_BIN_DEG: Final = 1.0
# Maximum distance from the plane of the voxels in the map, which includes niches and objects in
# front of the wall.
_MAP_DEPTH_M: Final = 0.6
_MAP_MOST_DEG: Final = 15.0
_MAP_PIXELS_MOST: Final = 700


@in_column_style()
def draw_accumulator(
    ctx: StepContext,
    points_m: NDArray[np.float64],
    votes: NDArray[np.int32],
    centre_m: NDArray[np.float64],
    bin_m: float,
    planes: Planes,
    cloud: PointCloud,
) -> None:
    """Draw the plan with the detected walls, and the parameter space with the maxima of the walls.

    Args:
        ctx: receives the figure.
        points_m: (s, 2) positions of sample points in plan, along e1 and e2 from the centre; NaN
            for points to omit.
        votes: (angles, bins) votes for lines, before any plane was removed.
        centre_m: (2,) centre of the plan; lines through it have the distance 0, at the middle edge
            of the bins.
        bin_m: width of a bin, and minimum side of a pixel of the plan.
        planes: the planes, in world coordinates.
        cloud: the cloud.
    """
    basis, (n_angles, n_bins) = basis_from_up(planes.up), votes.shape
    reach_m, half_m = 0.5 * n_bins * bin_m, np.nanmax(np.abs(points_m), axis=0)
    pixel_m = max(bin_m, 2.0 * float(half_m.max()) / _PIXELS_MOST)
    # Add a margin of five pixels.
    edges_m = [pixel_m * np.arange(-n, n + 1) for n in np.ceil(half_m / pixel_m).astype(int) + 5]
    high = np.array([along_m[-1] for along_m in edges_m])
    low, high = centre_m - high, centre_m + high
    plan_in = float(np.clip(2.6 * (high[1] - low[1]) / (high[0] - low[0]), 1.0, 3.2))
    figure = column_figure(plan_in + 2.6)
    above, below = figure.subplots(2, 1, height_ratios=(plan_in, 2.2))
    inside_m = points_m[np.isfinite(points_m[:, 0])]
    image = np.histogram2d(inside_m[:, 0], inside_m[:, 1], edges_m)[0]
    plan = above.imshow(
        image.T,
        origin="lower",
        cmap="gray_r",
        extent=(low[0], high[0], low[1], high[1]),
        norm=SymLogNorm(1.0, vmin=0.0, vmax=max(1.0, float(image.max()))),
    )
    figure.colorbar(plan, ax=above, label="points per cell", format="{x:g}")
    extent = (*_around(0.0, 180.0, n_angles), -reach_m, reach_m)
    shown = _show_votes(below, _thinned_sum(votes), extent)
    figure.colorbar(shown, ax=below, label="votes")
    # Draw the global maximum as a line in the plan and as a point in the parameter space.
    row, column = np.unravel_index(int(votes.argmax()), votes.shape)
    angle, distance_m = math.pi * row / n_angles, reach_m * (2.0 * (column + 0.5) / n_bins - 1.0)
    across = np.array([math.cos(angle), math.sin(angle)])
    foot = centre_m + distance_m * across
    ends = foot + np.outer([-2.0 * reach_m, 2.0 * reach_m], [-across[1], across[0]])
    above.plot(*ends.T, color="k", linestyle=":", label="maximum")
    below.plot(math.degrees(angle), distance_m, "x", color="white", markersize=7)
    for index in np.flatnonzero(np.abs(planes.normal @ planes.up) < 0.5):
        corners = (planes.corners[index] - cloud.origin) @ basis.T
        colour, name = plane_ink(int(index)), planes.names[index]
        above.plot(*corners[[1, 2], :2].T, linewidth=1.2, color=colour, label=name)
        # Compute the position of the wall in the parameter space.
        normal = basis @ planes.normal[index]
        angle = math.atan2(normal[1], normal[0]) % math.pi
        direction = np.array([math.cos(angle), math.sin(angle)])
        distance_m = float(direction @ (corners.mean(axis=0)[:2] - centre_m))
        ring = dict[str, Any](color=colour, fillstyle="none", markersize=6)
        below.plot(math.degrees(angle), distance_m, "o", **ring)
    above.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    above.set_xlabel("e1 [m from the cloud's origin]")
    above.set_ylabel("e2 [m]")
    below.set_xlabel("direction of the normal [deg]")
    below.set_ylabel("distance from the centre [m]")
    # Draw the legend below the panels, because the plan of a single long wall has no space for it.
    figure.legend(*above.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    ctx.figure(
        "accumulator",
        figure,
        "Above: number of sample points in each cell of the plan, and the walls "
        "that were found. Below: votes in the parameter space; circles mark the walls, and "
        "the cross and the dotted line mark the bin with the most votes. A wall is a sharp "
        "bright spot. A bright spot without a circle is a missed wall, and a circle on a "
        "grey background may be due to chance.",
    )


@in_column_style()
def draw_space(
    ctx: StepContext,
    best: NDArray[np.float64],
    over_omega: Mapping[float, NDArray[np.float64]],
    over_phi: Mapping[float, NDArray[np.float64]],
    reach_m: float,
    planes: Planes,
) -> None:
    """Draw the best scores of an accumulator, with the detected planes, and its sections.

    Args:
        ctx: receives the figures.
        best: see `hough.sections_of`.
        over_omega: see `hough.sections_of`.
        over_phi: see `hough.sections_of`.
        reach_m: see `hough.sections_of`.
        planes: the planes, in world coordinates.
    """
    figure = column_figure(2.4)
    axes = figure.subplots()
    omegas = _around(0.0, 180.0, len(best))
    phis = _around(-90.0, 180.0 / len(best) + 90.0, best.shape[1])
    shown = _show_votes(axes, np.maximum(best, 0.0), (*omegas, *phis))
    figure.colorbar(shown, ax=axes, label="score [votes]")
    for index, normal in enumerate(planes.normal):
        omega_deg, phi_deg = omega_phi_deg(normal, planes.up)
        if omega_deg >= 180.0:
            omega_deg, phi_deg = omega_deg - 180.0, -phi_deg
        ring = dict[str, Any](color=plane_ink(index), fillstyle="none", markersize=6)
        axes.plot(omega_deg, phi_deg, "o", **ring)
    axes.set_xlabel("omega [deg]")
    axes.set_ylabel("phi [deg]")
    ctx.figure(
        "accumulator",
        figure,
        "Best score over all distances for each direction of the normal; circles "
        "mark the planes. Directions are distributed evenly over the hemisphere, so near "
        "the poles, one direction covers several pixels. A bright spot without a circle is "
        "the direction of a missed plane.",
    )
    figure = column_figure(5.0)
    panels = figure.subplots(3, 2, sharex="col", sharey=True)
    # Use the same scale for all sections, so that they can be compared.
    most = max(float(votes.max()) for votes in (*over_omega.values(), *over_phi.values()))
    for (left, right), phi_deg, omega_deg in zip(panels, over_omega, over_phi, strict=True):
        shown = _show_votes(left, over_omega[phi_deg], (*omegas, -reach_m, reach_m), most)
        _show_votes(right, over_phi[omega_deg], (*phis, -reach_m, reach_m), most)
        left.set_title(f"phi = {phi_deg:.0f} deg")
        right.set_title(f"omega = {omega_deg:.0f} deg")
        left.set_ylabel("distance [m]")
    panels[-1, 0].set_xlabel("omega [deg]")
    panels[-1, 1].set_xlabel("phi [deg]")
    bar = figure.colorbar(shown, ax=panels, label="votes", location="bottom", aspect=40)
    bar.locator = MaxNLocator(4)
    ctx.figure(
        "accumulator-sections",
        figure,
        "Votes for each direction and distance from the centre, before any plane "
        "was removed, in sections at constant phi (left) and constant omega (right); "
        "brightness is the square root of the votes. Planes are sharp spots where bands "
        "cross; without such spots, there are no planes.",
    )


def _around(first_deg: float, end_deg: float, count: int) -> tuple[float, float]:
    half_deg = 0.5 * (end_deg - first_deg) / count
    return first_deg - half_deg, end_deg - half_deg


def _show_votes(
    axes: Axes,
    votes: NDArray[np.float64],
    extent: tuple[float, float, float, float],
    most: float | None = None,
) -> AxesImage:
    """Draw votes (across, up) as grey levels, by their square roots; the maximum is white."""
    norm = PowerNorm(0.5, vmin=0.0, vmax=most)
    return axes.imshow(
        votes.T, origin="lower", aspect="auto", cmap="gray", norm=norm, extent=extent
    )


@in_column_style()
def draw_sections(ctx: StepContext, planes: Planes, cloud: PointCloud, *, cell_m: float) -> None:
    """Draw the number of points per voxel in three sections through the middle of the planes.

    Args:
        ctx: receives the figure.
        planes: the planes, in world coordinates; at least one.
        cloud: the cloud.
        cell_m: side of a voxel; it is increased if the scene would need too many voxels.
    """
    every = max(1, len(cloud) // _SECTION_POINTS_MOST)
    points_m = np.column_stack([cloud.x[::every], cloud.y[::every], cloud.z[::every]])
    basis = basis_from_up(planes.up)
    framed = points_m.astype(np.float64) @ basis.T
    # Do not use the extent of all points: some seem to be far away, behind mirrors and windows.
    corners = (planes.corners.reshape(-1, 3) - cloud.origin) @ basis.T
    low, high = corners.min(axis=0), corners.max(axis=0)
    cell_m = max(cell_m, float((high - low).max()) / _SECTION_CELLS_MOST)
    low, high = low - 5.0 * cell_m, high + 5.0 * cell_m
    middle = 0.5 * (low + high)
    names = ("e1", "e2", "up")
    views = ((0, 1, 2), (0, 2, 1), (1, 2, 0))
    sides_m = high - low
    # Use the same scale for all sections, so that the panels have different heights.
    heights = [float(np.clip(sides_m[up] / sides_m[:2].max(), 0.25, 1.5)) for _, up, _ in views]
    figure = column_figure(2.3 * sum(heights) + 0.5 * len(views))
    panels = figure.subplots(len(views), 1, height_ratios=heights)
    counted = []
    for first, second, across in views:
        inside = np.abs(framed[:, across] - middle[across]) < 0.5 * cell_m
        edges = [np.arange(low[k], high[k] + cell_m, cell_m) for k in (first, second)]
        counts = np.histogram2d(framed[inside, first], framed[inside, second], edges)[0]
        counted.append((counts, (edges[0][0], edges[0][-1], edges[1][0], edges[1][-1])))
    norm = SymLogNorm(1.0, vmin=0.0, vmax=max(1.0, *(float(one.max()) for one, _ in counted)))
    for axes, (first, second, across), (counts, extent) in zip(panels, views, counted, strict=True):
        shown = axes.imshow(
            counts.T, origin="lower", cmap="gray_r", extent=extent, aspect="equal", norm=norm
        )
        axes.set_xlabel(f"{names[first]} [m from the cloud's origin]")
        axes.set_ylabel(f"{names[second]} [m]")
        axes.set_title(f"{names[across]} = {middle[across]:.2f} m")
    figure.colorbar(
        shown, ax=panels, label="points per voxel", location="bottom", aspect=40, format="{x:g}"
    )
    ctx.figure(
        "voxels",
        figure,
        f"Points per voxel of {100.0 * cell_m:.3g} cm (darker is more, on a logarithmic scale) "
        "in three sections through the middle of the planes: walls are thin dark lines; where they "
        "are wide or double, the scans disagree or the cloud is noisy.",
    )


def draw_normals(
    ctx: StepContext, voxels: SurfaceVoxels, n_regions: int, planes: Planes, cloud: PointCloud
) -> None:
    """Report and draw the scatter of normals about the normal of the first plane.

    Args:
        ctx: receives the metrics and the figure.
        voxels: the voxels with their normals.
        n_regions: number of regions with enough points.
        planes: the planes, in world coordinates.
        cloud: the cloud.
    """
    centroids_m = voxels.table.centroids() @ voxels.table.basis
    normals = voxels.normals.astype(np.float64) @ voxels.table.basis
    first = planes.normal[0]
    away_deg = np.degrees(np.arccos(np.clip(np.abs(normals @ first), 0.0, 1.0)))
    depth_m = centroids_m @ first - (planes.offset[0] - float(first @ cloud.origin))
    on_plane = (np.abs(depth_m) < 0.5 * voxels.table.voxel_m) & (away_deg < 45.0)
    placed = (centroids_m - (planes.corners[0, 0] - cloud.origin)) @ wall_axes(first, planes.up).T
    size_m = np.linalg.norm(planes.corners[0, [3, 1]] - planes.corners[0, 0], axis=1)
    over = ((placed >= 0.0) & (placed < size_m)).all(axis=1)
    scatter_deg = float(np.median(away_deg[on_plane & over])) if (on_plane & over).any() else 0.0
    ctx.metric("n_regions", n_regions, "1")
    ctx.metric("neighbourhood_mm", 1000.0 * voxels.neighbourhood.size_m, "mm")
    ctx.metric("cell_mm", 1000.0 * voxels.table.voxel_m, "mm")
    ctx.metric("normal_scatter_deg", scatter_deg, "deg")
    shown = over & (np.abs(depth_m) < _MAP_DEPTH_M) & np.isfinite(voxels.spreads[:, 0])
    # For each pixel, the angle at the voxel nearest to the viewer; NaN if there is none.
    pixel_m = max(voxels.table.voxel_m, float(size_m.max()) / _MAP_PIXELS_MOST)
    picture = np.full(np.maximum(1, np.ceil(size_m / pixel_m).astype(int))[::-1], np.nan)
    order = np.flatnonzero(shown)[np.argsort(depth_m[shown], kind="stable")]
    columns, rows = (placed[order] / pixel_m).astype(np.int64).T
    picture[rows, columns] = away_deg[order]
    across_deg = np.degrees(np.arcsin(np.clip(normals @ basis_from_up(planes.up)[1], -1.0, 1.0)))
    angles_deg = {f"angle to {planes.names[0]}": away_deg, "Ny": across_deg}
    counts = voxels.counts.astype(np.float64)
    _draw_normals(ctx, angles_deg, counts, picture, size_m)


@in_column_style()
def _draw_normals(
    ctx: StepContext,
    angles_deg: Mapping[str, NDArray[np.float64]],
    counts: NDArray[np.float64],
    picture: NDArray[np.float64],
    size_m: NDArray[np.float64],
) -> None:
    map_in = float(np.clip(2.6 * size_m[1] / size_m[0], 0.8, 4.0))
    figure = column_figure(1.5 + map_in + 0.5)
    grid = figure.add_gridspec(2, 2, height_ratios=(1.5, map_in + 0.5))
    histograms = [figure.add_subplot(grid[0, column]) for column in range(2)]
    below = figure.add_subplot(grid[1, :])
    for axes, (name, values_deg) in zip(histograms, angles_deg.items(), strict=True):
        edges_deg = np.arange(-90.0 if values_deg.min() < 0.0 else 0.0, 90.0 + _BIN_DEG, _BIN_DEG)
        histogram, _ = np.histogram(values_deg, edges_deg, weights=counts)
        shares = histogram / max(1.0, float(counts.sum()))
        axes.stairs(shares, edges_deg, fill=True, color=_BLUE)
        axes.set_xlabel(f"{name} [deg]")
        axes.set_ylabel("points [share]")
    image = below.imshow(
        np.minimum(picture, _MAP_MOST_DEG),
        cmap="viridis",
        extent=(0.0, float(size_m[0]), float(size_m[1]), 0.0),
        vmin=0.0,
        vmax=_MAP_MOST_DEG,
    )
    figure.colorbar(
        image, ax=below, label="angle [deg]", location="bottom", aspect=40, extend="max"
    )
    below.set_xlabel("along the plane [m]")
    below.set_ylabel("down the plane [m]")
    ctx.figure(
        "normals",
        figure,
        "Left: angles between the normals of neighbourhoods and the normal of the "
        "first plane, weighted by numbers of points. Right: inclinations of the normals of "
        "neighbourhoods towards the second horizontal axis (Ny; Figure 8 of "
        "markiewicz2015). Below: map of the angles on the left, up to "
        f"{1000.0 * _MAP_DEPTH_M:.0f} mm in front of and behind the plane; surfaces with the "
        "colour of the wall differ from it only in depth. On a good wall, angles are close "
        "to 0 degrees; a wide peak indicates noise or relief.",
    )


def _thinned_sum(values: NDArray[np.int32]) -> NDArray[np.float64]:
    """Return the sums over blocks of an image, so that it is small enough to draw."""
    rows, columns = (max(1, -(-size // _PIXELS_MOST)) for size in values.shape)
    padded = np.pad(values, ((0, -values.shape[0] % rows), (0, -values.shape[1] % columns)))
    blocks = padded.reshape(padded.shape[0] // rows, rows, padded.shape[1] // columns, columns)
    thinned: NDArray[np.float64] = blocks.sum(axis=(1, 3)).astype(np.float64)
    return thinned
