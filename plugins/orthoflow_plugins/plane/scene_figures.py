"""Pictures of a detection in space: points coloured by plane, rectangles, sections of voxels."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.directions import basis_from_up
from orthoflow.products import Planes, PointCloud
from orthoflow.sdk import StepContext
from orthoflow_plugins.plane.figure_margins import Margins, space_out

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_POINTS_MOST: Final = 25_000
_SECTION_POINTS_MOST: Final = 2_000_000
_SECTION_CELLS_MOST: Final = 2_000
_NAMED_MOST: Final = 12
# The view is from above, a little aside, along parallel lines.
_AZIMUTH_DEG: Final = -60.0
_ELEVATION_DEG: Final = 35.0
_GREY: Final = "#c8c8c8"
_SCENE: Final = Margins(left=0.05, right=0.05, bottom=0.05, top=0.05, across=0.1)


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
    from matplotlib.figure import Figure

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
        f"(grey) are {np.mean(on_none):.1%}. Right: the rectangles of the planes' connected parts.",
    )


def draw_sections(ctx: StepContext, planes: Planes, cloud: PointCloud, *, cell_m: float) -> None:
    """Draw the points per voxel in three sections through the middle of the planes' parts.

    Args:
        ctx: takes the figure.
        planes: the planes, world; at least one.
        cloud: the cloud.
        cell_m: side of a voxel; drawn larger where a scene would need too many.
    """
    from matplotlib.figure import Figure

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
        "sections through the middle of the planes' parts.",
    )


def _view(up: NDArray[np.float64]) -> NDArray[np.float64]:
    """(2, 3) directions to the right and up in the picture, in world axes."""
    azimuth, elevation = math.radians(_AZIMUTH_DEG), math.radians(_ELEVATION_DEG)
    right = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
    towards = np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
    rise = math.cos(elevation) * np.array([0.0, 0.0, 1.0]) - math.sin(elevation) * towards
    view: NDArray[np.float64] = np.array([right, rise]) @ basis_from_up(up)
    return view


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
