"""Pictures of a detection: deviations of the points, and the accumulator beside the plan."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.directions import basis_from_up
from orthoflow.geometry.plane_kernels import HISTOGRAM_BINS
from orthoflow.geometry.point_kernels import PlanGrid
from orthoflow.products import Planes, PointCloud
from orthoflow.sdk import StepContext
from orthoflow_plugins.plane.accumulators import Accumulator
from orthoflow_plugins.plane.assembling import Assembly
from orthoflow_plugins.plane.figure_margins import Margins, space_out
from orthoflow_plugins.plane.normality import Normality

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_PANELS_MOST: Final = 4
_PIXELS_MOST: Final = 900
_DEVIATIONS: Final = Margins(left=0.3, right=0.1, bottom=0.45, top=0.3, across=0.3, down=0.75)
# Between the panels stands the legend of the first.
_ACCUMULATOR: Final = Margins(left=0.6, right=0.2, bottom=0.5, top=0.1, across=1.5)


def draw_deviations(ctx: StepContext, assembly: Assembly) -> None:
    """Draw how the points of the first planes lie about them, with the Gauss curve of the fit."""
    from matplotlib.figure import Figure

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
        "quantiles against those of a normal distribution, which would lie on the line.",
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
    from matplotlib.figure import Figure

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
        f"{picture.voters}; circles mark the walls.",
    )


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
