"""Pictures of what was found and how: deviations, planes, thickness, accumulators, normals.

Margins are fixed: engines that find them out draw everything once more to measure it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final, Protocol

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from orthoflow.geometry import omega_phi_deg, wall_axes
from orthoflow.geometry.directions import basis_from_up
from orthoflow.products import Planes, PointCloud, Spread, Thickness
from orthoflow.sdk import StepContext
from orthoflow_plugins.plane.detector import Materials
from orthoflow_plugins.plane.kernels import PlanCounts, PlanGrid
from orthoflow_plugins.plane.planes import Assembly, Normality
from orthoflow_plugins.plane.slab_kernels import HISTOGRAM_BINS
from orthoflow_plugins.plane.thickness import RowPoints
from orthoflow_plugins.plane.voxels import SurfaceVoxels


@dataclass(frozen=True, kw_only=True)
class Margins:
    """Where the panels of a figure lie, in inches.

    Attributes:
        left: from the figure's edge to the panels; right, bottom and top alike.
        right: see left.
        bottom: see left.
        top: see left.
        across: between panels side by side.
        down: between panels one above the other.
    """

    left: float
    right: float
    bottom: float
    top: float
    across: float
    down: float = 0.0


def space_out(figure: Figure, margins: Margins, *, n_rows: int, n_columns: int) -> None:
    """Lay the panels of a figure, which stand in equal rows and columns, within its margins."""
    width, height = figure.get_size_inches()
    gaps_across, gaps_down = (n_columns - 1) * margins.across, (n_rows - 1) * margins.down
    panel_width = (width - margins.left - margins.right - gaps_across) / n_columns
    panel_height = (height - margins.bottom - margins.top - gaps_down) / n_rows
    figure.subplots_adjust(
        left=margins.left / width,
        right=1.0 - margins.right / width,
        bottom=margins.bottom / height,
        top=1.0 - margins.top / height,
        wspace=margins.across / panel_width,
        hspace=margins.down / panel_height,
    )


_PANELS_MOST: Final = 4
_DEVIATIONS: Final = Margins(left=0.3, right=0.1, bottom=0.45, top=0.3, across=0.3, down=0.75)
_POINTS_MOST: Final = 25_000
_NAMED_MOST: Final = 12
# The view is from above, a little aside, along parallel lines.
_AZIMUTH_DEG: Final = -60.0
_ELEVATION_DEG: Final = 35.0
_GREY: Final = "#c8c8c8"
_SCENE: Final = Margins(left=0.05, right=0.05, bottom=0.05, top=0.05, across=0.1)
_PLANES_MOST: Final = 12
_CLASSED_MOST: Final = 4
_THICKNESS: Final = Margins(left=0.7, right=0.1, bottom=0.45, top=0.1, across=0.45, down=0.5)
# The names of materials stand between panels.
_WITH_NAMES: Final = replace(_THICKNESS, across=1.3)


def draw_deviations(ctx: StepContext, assembly: Assembly) -> None:
    """Draw how the points of the first planes lie about them, with the Gauss curve of the fit."""
    deviations, names = assembly.deviations, assembly.planes.names
    count = min(_PANELS_MOST, len(names))
    figure = Figure(figsize=(3.2 * count, 5.4))
    space_out(figure, _DEVIATIONS, n_rows=2, n_columns=count)
    edges_mm = 1000.0 * np.linspace(
        -deviations.tolerance_m, deviations.tolerance_m, HISTOGRAM_BINS + 1
    )
    middles_mm = 0.5 * (edges_mm[1:] + edges_mm[:-1])
    for index in range(count):
        axes = figure.add_subplot(2, count, index + 1)
        axes.stairs(deviations.histogram[index], edges_mm, fill=True, color="#9db8d2")
        sigma_mm = 1000.0 * float(deviations.rms_fit_m[index])
        if sigma_mm > 0.0:
            offset_mm = middles_mm - 1000.0 * float(deviations.mean_fit_m[index])
            scale = float(deviations.n_fit[index]) * (edges_mm[1] - edges_mm[0])
            curve = np.exp(-0.5 * (offset_mm / sigma_mm) ** 2)
            curve *= scale / (sigma_mm * math.sqrt(2.0 * math.pi))
            axes.plot(middles_mm, curve, color="#b03a2e", linewidth=1.0)
        axes.set_title(f"{names[index]}: {sigma_mm:.1f} mm", fontsize=9)
        axes.set_xlabel("distance to the plane [mm]", fontsize=8)
        axes.tick_params(labelsize=7)
        axes.set_yticks([])
        shape = assembly.normalities[index]
        if shape is not None:
            _draw_quantiles(figure.add_subplot(2, count, count + index + 1), shape)
    ctx.figure(
        "deviations",
        figure,
        "Distances of the points to their plane, positive towards the viewer; the curve is the "
        f"normal distribution of those within {1000.0 * deviations.fit_tolerance_m:.0f} mm. "
        "Below, their "
        "quantiles against those of a normal distribution, which would lie on the line: a second "
        "hill, or ends that leave the line early, are relief or another surface on the plane.",
    )


def draw_planes(
    ctx: StepContext,
    planes: Planes,
    points_m: NDArray[np.float64],
    plane_of_point: NDArray[np.int64],
    cloud: PointCloud,
) -> None:
    """Draw points coloured by their plane beside the rectangles of the planes' parts.

    Args:
        ctx: takes the figure.
        planes: the planes, world.
        points_m: (m, 3) a sample of the cloud, offsets.
        plane_of_point: (m,) plane of each, -1 for none.
        cloud: where they are from.
    """
    every = max(1, len(points_m) // _POINTS_MOST)
    shown = points_m[::every]
    view = _view(planes.up)
    flat, index = shown @ view.T, plane_of_point[::every]
    figure = Figure(figsize=(11.0, 4.8))
    space_out(figure, _SCENE, n_rows=1, n_columns=2)
    left, right = figure.subplots(1, 2)
    on_none = index < 0
    left.plot(*flat[on_none].T, ".", markersize=0.8, color=_GREY)
    right.plot(*flat.T, ",", color="#e4e4e4")
    from_the_front = planes.normal @ np.cross(*view) > 0.0
    # The smallest last, so that the floor does not hide what stands on it.
    for k in range(len(planes)):
        colour = f"C{k % 10}"
        if from_the_front[k]:
            left.plot(*flat[index == k].T, ".", markersize=1.5, color=colour)
        _draw_rectangles(right, planes, k, view, cloud, colour)
    corners = (planes.corners.reshape(-1, 3) - cloud.origin) @ view.T
    low, high = corners.min(axis=0), corners.max(axis=0)
    margin = 0.04 * (high - low)
    for axes in (left, right):
        axes.set_aspect("equal")
        axes.set_xlim(low[0] - margin[0], high[0] + margin[0])
        axes.set_ylim(low[1] - margin[1], high[1] + margin[1])
        axes.set_axis_off()
    right.legend(fontsize=7, loc="upper left", ncols=2)
    ctx.figure(
        "planes",
        figure,
        "Left: a sample of the points, coloured by plane, without planes seen from behind; on none "
        f"(grey) are {np.mean(on_none):.1%}. Right: the rectangles of the planes' connected parts. "
        "Each wall should have one colour: two side by side are one wall taken for two, and a grey "
        "one was missed.",
    )


def draw_thickness(
    ctx: StepContext,
    planes: Planes,
    found: tuple[Thickness | None, ...],
    row: RowPoints | None,
    materials: Materials,
) -> None:
    """Draw what is known about the thickness; nothing where no plane has enough points."""
    known = [(k, item) for k, item in enumerate(found) if item is not None][:_PLANES_MOST]
    if not known:
        return
    first = known[:_CLASSED_MOST]
    classes = [
        label for label in _classes(known[0][1]) if any(_classes(item)[label] for _, item in first)
    ]
    named = any(item.material for _, item in first)
    n_rows, n_columns = 1 if row is None else 2, 1 + len(classes) + int(named)
    figure = Figure(figsize=(3.4 * n_columns, 2.9 * n_rows))
    grid = figure.add_gridspec(n_rows, n_columns)
    across = _WITH_NAMES if named else _THICKNESS
    space_out(figure, across, n_rows=n_rows, n_columns=n_columns)
    _draw_sigmas(figure.add_subplot(grid[0, 0]), planes, known)
    for place, label in enumerate(classes):
        axes = figure.add_subplot(grid[0, 1 + place])
        for k, item in first:
            spreads = _classes(item)[label]
            middles = [0.5 * (spread.low + spread.high) for spread in spreads]
            sigmas_mm = [1000.0 * spread.sigma_m for spread in spreads]
            axes.plot(middles, sigmas_mm, "o-", markersize=3, label=planes.names[k])
        axes.set_ylim(bottom=0.0)
        axes.set_xlabel(label, fontsize=8)
        axes.tick_params(labelsize=7)
        if place == 0:
            axes.legend(fontsize=7)
    if named:
        _draw_materials(figure.add_subplot(grid[0, -1]), planes, first)
    if row is not None:
        _draw_row(figure.add_subplot(grid[1, :]), planes, row, materials)
    ctx.figure(
        "thickness",
        figure,
        "Thickness of the cloud, one standard deviation in millimetres: on each plane beside the "
        f"scan step there{_drawn_by(classes, is_by_material=named)}."
        f"{'' if row is None else ' Below, one row of the scan on the first plane.'} "
        "A cloud thicker than its scan step shows noise, or scans that do not fit each other.",
    )


def _draw_quantiles(axes: Axes, shape: Normality) -> None:
    reach = float(shape.expected_sigmas[-1])
    axes.plot([-reach, reach], [-reach, reach], color="#b03a2e", linewidth=1.0)
    axes.plot(shape.expected_sigmas, shape.found_sigmas, ".", markersize=4, color="#33658a")
    axes.set_title(
        f"skewness {shape.skewness:+.2f}, kurtosis {shape.excess_kurtosis:+.2f}", fontsize=8
    )
    axes.set_xlabel("normal quantile [sigma]", fontsize=8)
    axes.tick_params(labelsize=7)


def _view(up: NDArray[np.float64]) -> NDArray[np.float64]:
    """(2, 3) directions to the right and up in the picture, in world axes."""
    azimuth, elevation = math.radians(_AZIMUTH_DEG), math.radians(_ELEVATION_DEG)
    right = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
    towards = np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
    rise = math.cos(elevation) * np.array([0.0, 0.0, 1.0]) - math.sin(elevation) * towards
    return np.array([right, rise]) @ basis_from_up(up)


def _draw_rectangles(
    axes: Axes,
    planes: Planes,
    k: int,
    view: NDArray[np.float64],
    cloud: PointCloud,
    colour: str,
) -> None:
    corners = planes.corners[k][None]
    if planes.part_corners is not None and planes.part_plane is not None:
        corners = planes.part_corners[planes.part_plane == k]
    label = planes.names[k] if k < _NAMED_MOST else None
    for part in corners:
        around = np.vstack([part, part[:1]]) - cloud.origin
        axes.plot(*(around @ view.T).T, color=colour, linewidth=1.3, label=label)
        label = None


def _drawn_by(classes: Sequence[str], *, is_by_material: bool) -> str:
    """Name what else the thickness is drawn along; empty where it is nothing."""
    drawn = [label.partition(" [")[0] for label in classes] + ["material"] * is_by_material
    *most, last = drawn or [""]
    return f", and by {', '.join(most)}{' and ' if most else ''}{last}" if last else ""


def _classes(thickness: Thickness) -> dict[str, tuple[Spread, ...]]:
    """Spreads by the quantity that is drawn along, by its label."""
    return {
        "angle of incidence [deg]": thickness.incidence_deg,
        "range [m]": thickness.range_m,
        "intensity [0..1]": thickness.intensity,
    }


def _draw_sigmas(axes: Axes, planes: Planes, known: list[tuple[int, Thickness]]) -> None:
    places = range(len(known))
    axes.barh(places, [1000.0 * item.sigma_m for _, item in known], color="#9db8d2")
    steps_mm = [1000.0 * item.scan_step_m for _, item in known]
    axes.plot(steps_mm, places, "|", color="#b03a2e", label="scan step")
    axes.set_yticks(places, [planes.names[k] for k, _ in known], fontsize=7)
    axes.invert_yaxis()
    axes.set_xlabel("thickness [mm]", fontsize=8)
    axes.tick_params(labelsize=7)
    axes.legend(fontsize=7)


def _draw_materials(axes: Axes, planes: Planes, known: list[tuple[int, Thickness]]) -> None:
    """Thickness of each material on the first planes."""
    bars = [
        (f"{spread.name}, {planes.names[k]}", 1000.0 * spread.sigma_m)
        for k, item in known
        for spread in item.material
    ]
    places = range(len(bars))
    axes.barh(places, [sigma_mm for _, sigma_mm in bars], color="#d2b89d")
    axes.set_yticks(places, [text for text, _ in bars], fontsize=7)
    axes.invert_yaxis()
    axes.set_xlabel("thickness by material [mm]", fontsize=8)
    axes.tick_params(labelsize=7)


def _draw_row(axes: Axes, planes: Planes, row: RowPoints, materials: Materials) -> None:
    """Distances of the points of a scan row from the first plane, coloured by material."""
    axes.plot(row.along_m, 1000.0 * row.distance_m, ".", markersize=2, color="#333333")
    if row.intensity is not None:
        for name, (low, high) in materials.items():
            mine = (row.intensity >= low) & (row.intensity <= high)
            distance_mm = 1000.0 * row.distance_m[mine]
            axes.plot(row.along_m[mine], distance_mm, ".", markersize=2, label=name)
        if materials:
            axes.legend(fontsize=7, markerscale=3)
    axes.set_xlabel(f"along {planes.names[0]} [m], row {row.row} of scan {row.scan}", fontsize=8)
    axes.set_ylabel("distance [mm]", fontsize=8)
    axes.tick_params(labelsize=7)


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


class PlanVotes(Protocol):
    """What a plan looked like before any plane was taken from it.

    Attributes:
        grid: where the cells of the plan lie.
        plan: points per cell.
        centre_m: (2,) centre of the plan in the (e1, e2) frame of the cloud's offsets.
        reach_m: distances of lines from there run from minus this to this.
        first: (angles, bins) votes of that plan, None where it did not vote.
        voters: who voted, to finish a sentence.
    """

    grid: PlanGrid
    plan: PlanCounts
    centre_m: NDArray[np.float64]
    reach_m: float
    first: NDArray[np.int64] | None
    voters: str


@dataclass(frozen=True, kw_only=True)
class SpacePicture:
    """What an accumulator held.

    Attributes:
        best: (o, p) best score of any distance, over omega 0..180 and phi -90..90 degrees; NaN
            where no direction of that phi was asked about.
        over_omega: (3, o, d) votes over omega and distance, for each phi of `sections_deg`; NaN
            where no direction was asked about.
        over_phi: (3, p, d) votes over phi and distance, for each omega of `sections_deg`.
        sections_deg: where it was cut.
        reach_m: distances run from minus this to this, from the middle of the scene's box.
    """

    best: NDArray[np.float64]
    over_omega: NDArray[np.float64]
    over_phi: NDArray[np.float64]
    sections_deg: tuple[float, ...]
    reach_m: float


def draw_accumulator(ctx: StepContext, votes: PlanVotes, planes: Planes, cloud: PointCloud) -> None:
    """Draw the plan with the walls found, and the parameter space with their maxima.

    Args:
        ctx: takes the figure.
        votes: the plan, and its votes before any plane was taken; nothing is drawn without.
        planes: the planes, world.
        cloud: where they are from.
    """
    if votes.first is None:
        return
    figure = Figure(figsize=(11.0, 4.6))
    space_out(figure, _ACCUMULATOR, n_rows=1, n_columns=2)
    left, right = figure.subplots(1, 2)
    basis, grid, reach_m = basis_from_up(planes.up), votes.grid, votes.reach_m
    low = grid.low_m[:2]
    high = low + grid.cell_m * np.array(grid.shape[:2])
    image = np.log1p(_thinned_sum(votes.plan.cells))
    left.imshow(image.T, origin="lower", cmap="gray_r", extent=(low[0], high[0], low[1], high[1]))
    right.imshow(
        np.sqrt(_thinned_sum(votes.first).T),
        origin="lower",
        aspect="auto",
        cmap="gray",
        extent=(0.0, 180.0, -reach_m, reach_m),
    )
    for index in np.flatnonzero(np.abs(planes.normal @ planes.up) < 0.5):
        corners = (planes.corners[index] - cloud.origin) @ basis.T
        left.plot(corners[[1, 2], 0], corners[[1, 2], 1], linewidth=1.2, label=planes.names[index])
        # Where the wall lies in the parameter space.
        normal = basis @ planes.normal[index]
        angle = math.atan2(normal[1], normal[0]) % math.pi
        direction = np.array([math.cos(angle), math.sin(angle)])
        distance_m = float(direction @ (corners.mean(axis=0)[:2] - votes.centre_m))
        right.plot(math.degrees(angle), distance_m, "o", fillstyle="none", markersize=9)
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
        f"{votes.voters}; circles mark the walls. A wall stands out as a sharp bright spot; a "
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


def draw_normals(
    ctx: StepContext, voxels: SurfaceVoxels, n_regions: int, planes: Planes, cloud: PointCloud
) -> None:
    """Report how normals scatter about the first plane, and draw their histogram and map.

    Args:
        ctx: takes metrics and figure.
        voxels: the voxels with their normals.
        n_regions: regions of them with points enough.
        planes: the planes, world.
        cloud: where they are from.
    """
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
    ctx.metric("n_regions", n_regions, "1")
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
