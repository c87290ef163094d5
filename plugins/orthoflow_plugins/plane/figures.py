"""Pictures of what was found: deviations of points, planes in space, thickness of the cloud.

Margins are fixed: engines that find them out draw everything once more to measure it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from orthoflow.geometry.directions import basis_from_up
from orthoflow.products import Planes, PointCloud, Spread, Thickness
from orthoflow.sdk import StepContext
from orthoflow_plugins.plane.assembling import Assembly
from orthoflow_plugins.plane.measuring import Materials, Normality, RowPoints
from orthoflow_plugins.plane.slab_kernels import HISTOGRAM_BINS


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
    edges_mm = 1000.0 * np.linspace(-deviations.find_m, deviations.find_m, HISTOGRAM_BINS + 1)
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
        f"normal distribution of those within {1000.0 * deviations.fit_m:.0f} mm. Below, their "
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
